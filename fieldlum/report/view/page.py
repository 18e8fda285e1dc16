"""The offline page of `fieldlum view`: pixels as 16-bit logarithms in the file itself."""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.core.false_colour import colour_table, shared_scale
from fieldlum.core.records import JsonTable
from fieldlum.report.figures import picture_grid, png
from fieldlum.report.view.measured_picture import MeasuredPicture, Region, region_mask

_INCHES, _DPI = 6.4, 150  # 960 pixels wide
_MAX_PIXELS = 1200  # drawn along an edge; more is not visible at this size; chosen


def write_png(
    path: Path, pictures: Sequence[MeasuredPicture], regions: Sequence[Region], isolines: bool
) -> None:
    """Draw the pictures next to each other on one scale, with the regions; write a PNG.

    isolines: draw lines at the powers of ten.
    """
    low, high = shared_scale(picture.ends_cdm2 for picture in pictures)
    maps = [
        np.where(picture.solid_angle_sr > 0, picture.luminance_cdm2, np.nan) for picture in pictures
    ]
    figure, cells = picture_grid(maps, map(_title, pictures), len(maps), _INCHES, (low, high))
    for axis, picture, values in zip(cells, pictures, maps, strict=True):
        _draw_marks(axis, picture, regions)
        if isolines:
            step = max(1, -(-max(values.shape) // _MAX_PIXELS))
            height, width = values.shape
            lines = axis.contour(
                np.maximum(values[::step, ::step], low * 1e-3),
                10.0 ** np.arange(np.ceil(np.log10(low)), np.floor(np.log10(high)) + 1),
                colors="white",
                linewidths=0.6,
                extent=(0.0, width, 0.0, height),
            )
            axis.clabel(lines, fontsize=6, fmt="%g")
    path.write_bytes(png(figure, _DPI))


def _title(picture: MeasuredPicture) -> str:
    figures = [] if picture.ev_lx is None else [f"Ev {picture.ev_lx:.0f} lx"]
    if picture.edi_lx is not None:
        figures.append("m-EDI {:.0f} ± {:.0f} lx".format(*picture.edi_lx))
    figures += [] if picture.dgp is None else [f"DGP {picture.dgp:.3f}"]
    return "  ".join([picture.name, *figures])


def _draw_marks(axis, picture: MeasuredPicture, regions: Sequence[Region]) -> None:
    for outline in picture.outlines:
        x, y = np.array([*outline, outline[0]]).T + 0.5
        axis.plot(x, y, color="cyan", linewidth=0.8)
    for number, region in enumerate(regions, start=1):
        mask = region_mask(region, picture)
        if not mask.any():
            continue
        height, width = mask.shape
        axis.contour(
            mask.astype(float), [0.5], colors="lime", linewidths=1.0, extent=(0, width, 0, height)
        )
        rows, columns = np.nonzero(mask)
        axis.text(columns.mean(), rows.mean(), str(number), color="lime", fontsize=8, ha="center")


# Code q of 1 to 65535 is 10^((q - 1) / 65534 * 14 - 4) cd/m2: steps of 0.05 %, up to 1e10.
# 0: no light, or no lens saw the pixel.
LOG_LOW, LOG_SPAN, CODES = -4.0, 14.0, 65534
_U_STEP = 4  # u is at a quarter of the size: bounds the page; chosen
_U_PER_PERCENT = 4.0  # code of relative u: quarters of a percent, at most 63 %; chosen


def encode_luminance(luminance_cdm2: Floats32) -> str:
    """Return luminances [H, W] as text for the page: base64 of deflated 16-bit logarithmic codes.

    Each code is stored as its difference from the pixel to the left, all high bytes first. Code 0:
    no light, or no lens saw the pixel.
    """
    positive = np.nan_to_num(luminance_cdm2, nan=0.0, posinf=0.0)
    logs = np.log10(np.maximum(positive, 10.0**LOG_LOW), dtype=np.float32)
    codes = np.clip(np.rint((logs - LOG_LOW) / LOG_SPAN * CODES) + 1, 1, CODES + 1)
    codes = np.where(positive > 0, codes, 0).astype(np.uint16)
    steps = codes.copy()
    steps[:, 1:] -= codes[:, :-1]  # modulo 65536
    planes = (steps >> 8).astype(np.uint8).tobytes() + (steps & 255).astype(np.uint8).tobytes()
    return base64.b64encode(zlib.compress(planes, 6)).decode("ascii")


def encode_uncertainty(picture: MeasuredPicture) -> str:
    """Return u over luminance at every fourth row and column, as text; "" without u.

    The text is base64 of deflated bytes: 4 per percent, 1 to 255; 0 where unknown.
    """
    if picture.u_cdm2 is None:
        return ""
    some = (slice(None, None, _U_STEP), slice(None, None, _U_STEP))
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100.0 * picture.u_cdm2[some] / picture.luminance_cdm2[some]
    codes = np.nan_to_num(np.clip(np.rint(percent * _U_PER_PERCENT), 1, 255), nan=0.0)
    return base64.b64encode(zlib.compress(codes.astype(np.uint8).tobytes(), 6)).decode("ascii")


def write_page(path: Path, pictures: Sequence[MeasuredPicture], rows: Sequence[JsonTable]) -> None:
    """Write one self-contained page: pictures, their figures, and the rows of the regions."""
    low, high = shared_scale(picture.ends_cdm2 for picture in pictures)
    about = {
        "pictures": [_about(picture) for picture in pictures],
        "rows": list(rows),
        "low": low,
        "high": high,
        "colours": colour_table().tolist(),
        "log": [LOG_LOW, LOG_SPAN, CODES],
        "uStep": _U_STEP,
        "uPerPercent": _U_PER_PERCENT,
    }
    text = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    # "<" cannot end the script early, whatever a file is called
    data = json.dumps(about).replace("<", "\\u003c")
    pixels = "".join(
        _data_script(f"pixels{k}", encode_luminance(picture.luminance_cdm2))
        + _data_script(f"u{k}", encode_uncertainty(picture))
        for k, picture in enumerate(pictures)
    )
    title = html.escape(", ".join(picture.name for picture in pictures)[:120])
    text = text.replace("@TITLE@", title).replace("@PIXELS@", pixels).replace("@DATA@", data)
    path.write_text(text, encoding="utf-8")


def _data_script(name: str, text: str) -> str:
    return f'<script type="application/octet-stream" id="{name}">{text}</script>'


def _about(picture: MeasuredPicture) -> JsonTable:
    height, width = picture.luminance_cdm2.shape
    view = None
    if picture.view is not None:
        view = asdict(picture.view) | {"frame": picture.view.frame.tolist()}
        view |= {"forward": None, "up": None}
    return {
        "name": picture.name,
        "width": width,
        "height": height,
        "view": view,
        "heading": picture.heading_deg,
        "ev": picture.ev_lx,
        "dgp": picture.dgp,
        "edi": picture.edi_lx,
        "outlines": picture.outlines,
        "notes": picture.notes,
    }
