"""What many brackets say together: quality.csv, the shutter's true times, the drift of the light, a
contact sheet.

Each bracket's exposure ratios hold two things: how long the shutter really opened, the same in
every bracket, and how the light changed while the bracket was taken, different in each. The median
over brackets is the shutter; what is left in one bracket, fitted over its seconds, is the drift.
The pyranometer saw the same seconds.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.images import read_panorama
from fieldlum.records import Exposure, utc_text
from fieldlum.session import Session, exposure_text, read_day, replacing
from fieldlum.session.files.quality_csv import QUALITY_COLUMNS, QualityRow, write_quality
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.statistics import median_standard_error, robust_sigma

MIN_BRACKETS = 5  # before a shutter table is believed
_THUMB = (184, 92)
_PER_ROW, _PER_PAGE = 8, 96


@dataclass(frozen=True, slots=True)
class ShutterEntry:
    """One setting of the dial over all brackets: median correction, its standard error, how many
    brackets.
    """

    exposure: str
    nominal_s: float
    correction: float
    u_rel: float
    brackets: int


def shutter_table(sidecars: Sequence[Sidecar]) -> list[ShutterEntry]:
    """True over assumed exposure of each setting, from brackets whose neighbours agree; longest
    first.
    """
    corrections: dict[Exposure, list[float]] = defaultdict(list)
    for sidecar in sidecars:
        residual = sidecar.report.residual_percent
        if residual is None or abs(residual) > 3.0:
            continue
        for frame in sidecar.report.frames:
            corrections[frame.exposure].append(frame.correction)
    table = []
    for exposure, values in corrections.items():
        logs = np.log(values)
        spread = robust_sigma(logs)
        u = max(median_standard_error(spread, len(logs)), 2e-4)
        table.append(
            ShutterEntry(
                exposure_text(exposure),
                exposure.shutter_s,
                float(np.exp(np.median(logs))),
                u,
                len(logs),
            )
        )
    return sorted(table, key=lambda e: -e.nominal_s)


def drift_percent(sidecar: Sidecar, table: Sequence[ShutterEntry]) -> float | None:
    """Change of the light from the first frame to the last, by what the shutter table leaves.
    None: cannot tell. [%]
    """
    known = {e.exposure: e.correction for e in table if e.brackets >= MIN_BRACKETS}
    rows = [
        (
            f.t_utc.timestamp(),
            float(np.log(f.correction / known[exposure_text(f.exposure)])),
            f.u_percent,
        )
        for f in sidecar.report.frames
        if f.t_utc and exposure_text(f.exposure) in known and f.u_percent < 1.0
    ]
    if len(rows) < 3 or max(r[0] for r in rows) - min(r[0] for r in rows) <= 0:
        return None
    seconds, left, u = (np.array(column) for column in zip(*rows, strict=True))
    slope = np.polyfit(seconds - seconds.mean(), left, 1, w=1 / np.maximum(u, 0.02))[0]
    return float(100 * slope * np.ptp(seconds))


def ghi_change_percent(session: Session, opened: datetime, closed: datetime) -> float | None:
    """Change of global irradiance over the same seconds, by a line through the samples. None: no
    samples. [%]
    """
    days = {t.strftime("%Y-%m-%d") for t in (opened, closed)}
    rows = [
        (s.t_utc.timestamp(), s.ghi_wm2)
        for day in sorted(days)
        if (path := session.irradiance / f"{day}.csv").is_file()
        for s in read_day(path)[0]
        if opened <= s.t_utc <= closed and s.ghi_wm2 is not None
    ]
    if len(rows) < 3:
        return None
    seconds, ghi = (np.array(column, float) for column in zip(*rows, strict=True))
    if ghi.mean() < 5.0 or np.ptp(seconds) <= 0:
        return None
    slope = np.polyfit(seconds - seconds.mean(), ghi, 1)[0]
    return float(100 * slope * (closed - opened).total_seconds() / ghi.mean())


def read_sidecars(session: Session) -> list[Sidecar]:
    """Sidecars of all panoramas in order of time; a damaged one is passed over."""
    sidecars = []
    for path in session.sidecar_files():
        with suppress(InputError):
            sidecar = Sidecar.read(path)
            if sidecar.report.frames:
                sidecars.append(sidecar)
    return sidecars


def write_summary(session: Session) -> None:
    """panoramas/quality.csv, panoramas/shutter.csv and contact sheets, of everything merged so
    far.
    """
    notes = read_sidecars(session)
    table = shutter_table(notes)
    with replacing(session.panoramas / "shutter.csv", "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("exposure", "nominal_s", "true_over_assumed", "u_rel", "brackets"))
        rows.writerows(
            (e.exposure, f"{e.nominal_s:.7g}", f"{e.correction:.6f}", f"{e.u_rel:.2g}", e.brackets)
            for e in table
        )
    _contact_sheets(session, notes)
    write_quality(session.quality, [_row(session, note, table) for note in notes])


def summary_due(session: Session) -> bool:
    """Whether a sidecar is newer than quality.csv, which is written last: also after a kill in
    the middle.
    """
    known = session.quality
    written = known.stat().st_mtime_ns if known.is_file() else -1
    return any(path.stat().st_mtime_ns > written for path in session.sidecar_files())


def _row(session: Session, note: Sidecar, table: Sequence[ShutterEntry]) -> QualityRow:
    sun = note.sun or {}
    times = [frame.t_utc for frame in note.report.frames if frame.t_utc]
    figures = {
        name: getattr(note.report, name, None)
        for name in QUALITY_COLUMNS
        if name.endswith(("_percent", "_px", "vertical_illuminance_lx"))
    }
    figures["drift_percent"] = drift_percent(note, table)
    figures["ghi_change_percent"] = (
        ghi_change_percent(session, min(times), max(times)) if times else None
    )
    return QualityRow(
        slot=note.slot,
        t_utc=utc_text(note.t_utc) if note.t_utc else "",
        verdict=note.verdict,
        frames=len(note.report.frames),
        sun_lx=sun.get("normal_illuminance_lx"),
        sun_origin=str(sun.get("origin", "")),
        **figures,
    )


def _contact_sheets(session: Session, notes: Sequence[Sidecar]) -> None:
    """contact-1.png ...: every panorama in false colour, log 1 to 10 000 cd/m2, flagged pixels
    in grey.
    """
    import cv2

    width, height = _THUMB
    zone = ZoneInfo(session.site_file().site.timezone)
    for page in range(0, len(notes), _PER_PAGE):
        part = notes[page : page + _PER_PAGE]
        rows = -(-len(part) // _PER_ROW)
        sheet = np.full((rows * (height + 20) + 34, _PER_ROW * (width + 6), 3), 255, np.uint8)
        _draw_scale(sheet, rows * (height + 20) + 4)
        for number, note in enumerate(part):
            x, y = (number % _PER_ROW) * (width + 6), number // _PER_ROW * (height + 20)
            black = (0, 0, 0)
            local = f" {note.t_utc.astimezone(zone):%H:%M}" if note.t_utc else ""
            label = f"{note.slot}{local} {note.verdict.partition(':')[0]}"
            cv2.putText(
                sheet,
                label,
                (x + 2, y + height + 13),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.36,
                black,
                1,
                cv2.LINE_AA,
            )
            path = session.panorama(note.slot)
            if path.is_file():
                sheet[y : y + height, x : x + width] = _thumbnail(path)
        with replacing(session.panoramas / f"contact-{page // _PER_PAGE + 1}.png") as file:
            file.write(cv2.imencode(".png", sheet)[1].tobytes())


def _draw_scale(sheet: NDArray[np.uint8], top: int) -> None:
    """Draw the colours of 1 to 10 000 cd/m2 into the foot of a sheet [H, W, 3]."""
    import cv2

    width = min(460, sheet.shape[1] - 100)
    ramp = np.broadcast_to(np.linspace(0, 255, width).astype(np.uint8), (12, width))
    colours = cv2.applyColorMap(np.ascontiguousarray(ramp), cv2.COLORMAP_TURBO)
    sheet[top : top + 12, 6 : 6 + width] = colours
    for k, text in enumerate(("1", "10", "100", "1000", "10 000 cd/m2")):
        at = (6 + min(k * width // 4, width - 30), top + 25)
        cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)


def _thumbnail(path: Path) -> NDArray[np.uint8]:
    """[height, width, 3], blue first."""
    import cv2

    panorama = read_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    pick = np.ix_(
        *(
            np.linspace(0, n - 1, m).astype(int)
            for n, m in ((height, _THUMB[1]), (width, _THUMB[0]))
        )
    )
    level = np.log10(np.clip(panorama.luminance_cdm2[pick], 1.0, 1e4)) / 4.0
    picture = np.asarray(
        cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO), np.uint8
    )
    if panorama.flags is not None:
        picture[panorama.flags[pick] > 0] = 150
    return picture
