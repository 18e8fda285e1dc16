"""Write contact-1.png and so on: the panoramas of a session in false colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum.optics.images import read_panorama
from fieldlum.session import Session, replacing
from fieldlum.session.files.sidecar import Sidecar

# Layout, chosen for a sheet of 1 500 px that shows a day in a few rows.
_THUMB_PX = (184, 92)
_PER_ROW, _PER_PAGE = 8, 96
_BLACK, _GREY = (0, 0, 0), 150
_FONT_SCALE = 0.36


def write_contact_sheets(session: Session, sidecars: Sequence[Sidecar]) -> None:
    """Write thumbnails of the panoramas to panoramas/contact-1.png and so on.

    One thumbnail for each sidecar, 96 on a page; its place stays white if the panorama is missing.
    False colour by log luminance from 1 to 10 000 cd/m2. Pixels with any flag are grey.
    """
    import cv2

    zone = ZoneInfo(session.site_file().site.timezone)
    for first in range(0, len(sidecars), _PER_PAGE):
        sheet = _sheet(session, sidecars[first : first + _PER_PAGE], zone)
        with replacing(session.panoramas / f"contact-{first // _PER_PAGE + 1}.png") as file:
            file.write(cv2.imencode(".png", sheet)[1].tobytes())


def _sheet(session: Session, sidecars: Sequence[Sidecar], zone: ZoneInfo) -> NDArray[np.uint8]:
    """Return the picture of one page [H, W, 3], in blue, green, red."""
    width, height = _THUMB_PX
    rows = -(-len(sidecars) // _PER_ROW)
    sheet = np.full((rows * (height + 20) + 34, _PER_ROW * (width + 6), 3), 255, np.uint8)
    _draw_scale(sheet, rows * (height + 20) + 4)
    for number, sidecar in enumerate(sidecars):
        x, y = (number % _PER_ROW) * (width + 6), number // _PER_ROW * (height + 20)
        local = f" {sidecar.t_utc.astimezone(zone):%H:%M}" if sidecar.t_utc else ""
        label = f"{sidecar.slot}{local} {sidecar.verdict.partition(':')[0]}"
        _write_text(sheet, label, (x + 2, y + height + 13))
        path = session.panorama(sidecar.slot)
        if path.is_file():
            sheet[y : y + height, x : x + width] = _thumbnail(path)
    return sheet


def _write_text(sheet: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    import cv2

    cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, _FONT_SCALE, _BLACK, 1, cv2.LINE_AA)


def _draw_scale(sheet: NDArray[np.uint8], top: int) -> None:
    """Draw the colour scale from 1 to 10 000 cd/m2 at the foot of a page [H, W, 3]."""
    import cv2

    width = min(460, sheet.shape[1] - 100)
    ramp = np.broadcast_to(np.linspace(0, 255, width).astype(np.uint8), (12, width))
    colours = cv2.applyColorMap(np.ascontiguousarray(ramp), cv2.COLORMAP_TURBO)
    sheet[top : top + 12, 6 : 6 + width] = colours
    for k, text in enumerate(("1", "10", "100", "1000", "10 000 cd/m2")):
        _write_text(sheet, text, (6 + min(k * width // 4, width - 30), top + 25))


def _thumbnail(path: Path) -> NDArray[np.uint8]:
    """Return one panorama as a picture [height, width, 3], in blue, green, red."""
    import cv2

    panorama = read_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    rows = np.linspace(0, height - 1, _THUMB_PX[1]).astype(int)
    columns = np.linspace(0, width - 1, _THUMB_PX[0]).astype(int)
    pick = np.ix_(rows, columns)
    level = np.log10(np.clip(panorama.luminance_cdm2[pick], 1.0, 1e4)) / 4.0
    picture = np.asarray(
        cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO), np.uint8
    )
    if panorama.flags is not None:
        picture[panorama.flags[pick] > 0] = _GREY
    return picture
