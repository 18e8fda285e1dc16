"""Summarise many brackets: quality.csv and contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fieldlum.core.false_colour import RANGE_CDM2, UNSEEN_RGB, coloured, png_of
from fieldlum.core.records import JsonTable
from fieldlum.optics.images import read_panorama
from fieldlum.session import Session, replacing
from fieldlum.session.codec import write_csv
from fieldlum.session.files.sidecar import Sidecar, readable_sidecars

# ----------------------------------------------------------------------------------------------
# contact-1.png and so on: the panoramas of a session in false colour


# Layout of a sheet of 1 500 px that shows a day in a few rows: a thumbnail, its place, a page.
_WIDTH, _HEIGHT, _PLACE = 184, 92, (190, 112)
_PER_ROW, _PER_PAGE = 8, 96


def write_contact_sheets(session: Session, sidecars: Sequence[Sidecar]) -> None:
    """Write thumbnails of the panoramas to panoramas/contact-1.png and so on.

    One thumbnail for each sidecar, 96 on a page; its place stays white if the panorama is missing.
    False colour by log luminance from 1 to 10 000 cd/m2. Pixels with any flag are grey.
    """
    zone = ZoneInfo(session.site_file().site.timezone)
    for first in range(0, len(sidecars), _PER_PAGE):
        sheet = _sheet(session, sidecars[first : first + _PER_PAGE], zone)
        with replacing(session.panoramas / f"contact-{first // _PER_PAGE + 1}.png") as file:
            file.write(png_of(sheet))


def _sheet(session: Session, sidecars: Sequence[Sidecar], zone: ZoneInfo) -> NDArray[np.uint8]:
    """Return the picture of one page, RGB [H, W, 3], with the colour scale at its foot."""
    foot = -(-len(sidecars) // _PER_ROW) * _PLACE[1]
    sheet = np.full((foot + 34, _PER_ROW * _PLACE[0], 3), 255, np.uint8)
    for number, sidecar in enumerate(sidecars):
        x, y = number % _PER_ROW * _PLACE[0], number // _PER_ROW * _PLACE[1]
        local = f" {sidecar.t_utc.astimezone(zone):%H:%M}" if sidecar.t_utc else ""
        label = f"{sidecar.slot}{local} {sidecar.verdict.partition(':')[0]}"
        _write_text(sheet, label, (x + 2, y + _HEIGHT + 13))
        path = session.panorama(sidecar.slot)
        if path.is_file():
            sheet[y : y + _HEIGHT, x : x + _WIDTH] = _thumbnail(path)
    sheet[foot + 4 : foot + 16, 6:466] = coloured(np.geomspace(*RANGE_CDM2, 460))
    for k, text in enumerate(("1", "10", "100", "1000", "10 000 cd/m2")):
        _write_text(sheet, text, (6 + min(115 * k, 430), foot + 29))
    return sheet


def _write_text(sheet: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    import cv2

    cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)


def _thumbnail(path: Path) -> NDArray[np.uint8]:
    """Return one panorama as a picture [height, width, 3]."""
    panorama = read_panorama(path)
    rows, columns = (
        np.linspace(0, size - 1, count).astype(int)
        for size, count in zip(panorama.luminance_cdm2.shape, (_HEIGHT, _WIDTH), strict=True)
    )
    pick = np.ix_(rows, columns)
    picture = coloured(panorama.luminance_cdm2[pick])
    if panorama.flags is not None:
        picture[panorama.flags[pick] > 0] = UNSEEN_RGB
    return picture


def write_summary(session: Session) -> None:
    """Write contact sheets and quality.csv of all merged brackets.

    quality.csv is written last: its date shows that the summary is complete.
    """
    sidecars = [note for note in readable_sidecars(session.sidecar_files()) if note.report.frames]
    write_contact_sheets(session, sidecars)
    write_csv(session.quality, map(_row, sidecars), QUALITY_COLUMNS, digits=4)


def summary_due(session: Session) -> bool:
    """Return whether the summary must be written again.

    That is if a panorama's sidecar is newer than quality.csv, or if there are sidecars and no
    quality.csv.
    """
    path = session.quality
    written_ns = path.stat().st_mtime_ns if path.is_file() else -1
    return any(path.stat().st_mtime_ns > written_ns for path in session.sidecar_files())


QUALITY_COLUMNS = (
    "slot",
    "t_utc",
    "verdict",
    "frames",
    "residual_percent",
    "exposure_span_percent",
    "shift_px",
    "shift_u_px",
    "motion_percent",
    "clipped_percent",
    "bloom_percent",
    "below_noise_percent",
    "outside_percent",
    "u_ratio_percent",
    "sun_lx",
    "sun_origin",
    "vertical_illuminance_lx",
)
"""Of quality.csv; sun_lx: on a plane normal to the sun; an empty cell could not be determined."""


def _row(sidecar: Sidecar) -> JsonTable:
    sun = sidecar.sun
    return {
        **structs.asdict(sidecar.report),
        "slot": sidecar.slot,
        "t_utc": sidecar.t_utc,
        "verdict": sidecar.verdict,
        "frames": len(sidecar.report.frames),
        "sun_lx": sun and sun.normal_illuminance_lx,
        "sun_origin": sun and sun.origin,
    }
