"""Show luminance pictures: regions, a false-colour PNG, and an offline page of `fieldlum view`."""

import base64
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats32, Mask
from fieldlum.core.false_colour import colour_table, luminance_ends, shared_scale
from fieldlum.core.records import JsonTable
from fieldlum.optics.projection import direction
from fieldlum.session import write_file
from fieldlum.year.glare.picture_glare import glare_answer
from fieldlum.year.glare.pictures import Picture, picture_directions, read_picture
from fieldlum.year.glare.sources import Sources

_NUMBERS_OF_KIND = {"rect": 4, "circle": 3, "cone": 3}
FORMS = "rect:x,y,w,h, circle:x,y,r or cone:AZ,ALT,RADIUS"
_FIGURES = ("mean_cdm2", "median_cdm2", "min_cdm2", "max_cdm2", "sd_cdm2")
COLUMNS = ("file", "region", "pixels", "solid_angle_sr", *_FIGURES)


@dataclass(frozen=True, slots=True)
class MeasuredPicture:
    """A luminance picture with its figures of glare.

    name: of its file. picture: its pixels and view. luminance_cdm2: [H, W], NaN where no lens saw.
    solid_angle_sr: [H, W] of complete pixels, 0 where the view has no direction. figures: Ev,
    melanopic EDI and DGP in the view direction (the middle of a panorama), as one text. outlines:
    polygons around the 12 strongest glare sources of a fisheye, each a list of pixels [x, y] from 0
    at the top left; none for a panorama. notes: warnings of the glare figures, sentences.
    """

    name: str
    picture: Picture
    luminance_cdm2: Floats32
    solid_angle_sr: Floats32
    figures: str
    outlines: list[Any]
    notes: list[str]

    @property
    def shown_cdm2(self) -> Floats32:
        """The luminance [H, W], NaN also where the picture has no direction."""
        return np.where(self.solid_angle_sr > 0, self.luminance_cdm2, np.float32(np.nan))


class Region(NamedTuple):
    """A region of a picture.

    kind: "rect", "circle" or "cone"; text: the region as the user wrote it. values: of a rect left,
    top, width and height, of a circle x, y and radius, all in pixels from the top left corner; of a
    cone azimuth (clockwise from true north), altitude and radius (half its width), in degrees.
    """

    kind: str
    values: tuple[float, ...]
    text: str


def parse_region(text: str) -> Region:
    """Return the region that a text describes.

    text: rect:x,y,w,h or circle:x,y,r in pixels, or cone:AZ,ALT,RADIUS in degrees (`FORMS`); for
    the numbers see `Region`. Raises ValueError for any other text, for numbers that are not finite,
    and for a radius, width or height that is not above 0.
    """
    kind, _, rest = text.partition(":")
    try:
        values = tuple(float(part) for part in rest.split(","))
    except ValueError:
        values = ()
    if not np.isfinite(values).all() or len(values) != _NUMBERS_OF_KIND.get(kind):
        raise ValueError(f"{text!r}: write {FORMS}")
    if any(size <= 0 for size in values[2:]):  # after the two values of the place
        raise ValueError(f"{text!r}: its size must be above 0")
    return Region(kind, values, text)


def region_mask(region: Region, picture: MeasuredPicture) -> Mask:
    """Return a mask [H, W]: True for pixels whose centres are in the region.

    picture: to which the region is applied. Regions of all kinds include pixels that no lens saw; a
    cone has no pixels without a direction.
    """
    height, width = picture.luminance_cdm2.shape
    y, x = (np.arange(height) + 0.5)[:, None], (np.arange(width) + 0.5)[None, :]
    if region.kind == "rect":
        left, top, rect_width, rect_height = region.values
        return (x >= left) & (x < left + rect_width) & (y >= top) & (y < top + rect_height)
    if region.kind == "circle":
        centre_x, centre_y, radius = region.values
        return np.hypot(x - centre_x, y - centre_y) <= radius
    azimuth_deg, altitude_deg, radius_deg = region.values
    cosine = picture_directions(picture.picture)[0] @ direction(altitude_deg, azimuth_deg)
    return (cosine >= np.cos(np.radians(radius_deg))) & (picture.solid_angle_sr > 0)


def region_statistics(region: Region, picture: MeasuredPicture) -> dict[str, float | str | None]:
    """Return the statistics of a region in a picture: a value for each of `COLUMNS`.

    Mean and standard deviation [cd/m2] are weighted by solid angle, the median counts pixels.
    pixels, solid_angle_sr: number and total solid angle of the pixels that count: those with a
    direction that a lens saw. If there are none, pixels is 0 and the other figures are None.
    """
    mask = region_mask(region, picture) & np.isfinite(picture.luminance_cdm2)
    mask &= picture.solid_angle_sr > 0
    values = picture.luminance_cdm2[mask].astype(float)
    weights = picture.solid_angle_sr[mask].astype(float)
    row: dict[str, float | str | None] = dict.fromkeys(COLUMNS)
    row |= {"file": picture.name, "region": region.text, "pixels": len(values)}
    if len(values) == 0:
        return row
    mean = np.average(values, weights=weights)
    sd = np.sqrt(np.average((values - mean) ** 2, weights=weights))
    # in the order of the columns from solid_angle_sr
    figures = (weights.sum(), mean, np.median(values), values.min(), values.max(), sd)
    return row | dict(zip(COLUMNS[3:], map(float, figures), strict=True))


def read_measured_picture(path: Path, part: str = "", view_options: str = "") -> MeasuredPicture:
    """Read a picture and compute its glare, in the middle of a panorama or in a fisheye's view.

    part: name of the part, layer or stereo view of an .exr; "" for the only one. view_options: as
    for `read_picture`. Raises InputError for an unusable file, and for seen pixels that are not
    finite.
    """
    picture = read_picture(path, view_options, part)
    luminance = picture.panorama.seen_cdm2
    azimuths_deg = (picture.panorama.heading_deg,) if picture.view is None else ()
    answer, sources = glare_answer(picture, path, azimuths_deg)
    view, texts = answer["views"][0], []
    if view["ev_lx"] is not None:
        texts.append(f"Ev {view['ev_lx']:.0f} lx")
        if (u := view["u_melanopic_edi_lx"]) is not None:
            texts.append(f"m-EDI {view['melanopic_edi_lx']:.0f} ± {u:.0f} lx")
        texts.append(f"DGP {view['dgp']:.3f}")
        texts += [f"facing {azimuth % 360.0:.0f}°" for azimuth in azimuths_deg]
    return MeasuredPicture(
        path.name,
        picture,
        luminance_cdm2=luminance,
        solid_angle_sr=picture_directions(picture)[1].astype(np.float32),
        figures="; ".join(texts),
        outlines=[] if picture.view is None else _outlines(sources, luminance.shape),
        notes=answer["warnings"],
    )


def _outlines(sources: Sources, shape: tuple[int, ...]) -> list[Any]:
    """Return polygons of pixels (x, y) around the 12 strongest glare sources of a single view.

    shape: of the picture, (H, W).
    """
    import cv2

    outlines: list[Any] = []
    for number in np.argsort(sources.contrast[:, 0])[::-1][:12]:
        mask = np.zeros(shape, np.uint8)
        mask.flat[sources.pixels[number]] = 1
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        outlines += [cv2.approxPolyDP(c, 1.0, True).reshape(-1, 2).tolist() for c in contours]
    return outlines


# ----------------------------------------------------------------------------------------------
# PNG and page


def write_png(path: Path, pictures: Sequence[MeasuredPicture], regions: Sequence[Region]) -> None:
    """Write a PNG of the pictures next to each other, in false colour on one scale.

    path: of the PNG; an earlier file is replaced. regions: outlined in each picture, with numbers
    from 1.
    """
    from fieldlum.report.page import picture_grid, png

    maps = [picture.shown_cdm2 for picture in pictures]
    titles = [f"{picture.name}  {picture.figures}" for picture in pictures]
    scale = shared_scale(map(luminance_ends, maps))
    figure, cells = picture_grid(maps, titles, len(maps), 6.4, scale)
    for axis, picture in zip(cells, pictures, strict=True):
        _draw_marks(axis, picture, regions)
    write_file(path, png(figure, 150))  # 960 pixels wide


def _draw_marks(axis, picture: MeasuredPicture, regions: Sequence[Region]) -> None:
    """Draw the outlines of glare sources and the regions over a picture.

    axis: matplotlib's axes with the picture. The regions have numbers from 1.
    """
    for outline in picture.outlines:
        x, y = np.array([*outline, outline[0]]).T + 0.5
        axis.plot(x, y, color="cyan", linewidth=0.8)
    for number, region in enumerate(regions, start=1):
        mask = region_mask(region, picture)
        if not mask.any():
            continue
        extent = (0, mask.shape[1], 0, mask.shape[0])
        axis.contour(mask.astype(float), [0.5], colors="lime", linewidths=1.0, extent=extent)
        rows, columns = np.nonzero(mask)
        axis.text(columns.mean(), rows.mean(), str(number), color="lime", fontsize=8, ha="center")


# Code q of 1 to 65535 is 10^((q - 1) / 65534 * 14 - 4) cd/m2: steps of 0.05 %, up to 1e10.
# 0: no light, or no lens saw the pixel.
LOG_LOW, LOG_SPAN, CODES = -4.0, 14.0, 65534
_U_STEP = 4  # the page has the uncertainty of each fourth pixel, which limits its size; chosen


def encode_luminance(luminance_cdm2: Floats32) -> str:
    """Return luminances [H, W] as text for the page: base64 of deflated 16-bit logarithmic codes.

    Code q of 1 to 65535 is 10^((q - 1) / 65534 * 14 - 4) cd/m2, the nearest in this range; 0: no
    light, or no lens saw the pixel (NaN). Each code is stored as its difference, modulo 65536, from
    the pixel to the left, row by row from the top; all high bytes, then all low bytes.
    """
    positive = np.nan_to_num(luminance_cdm2, nan=0.0, posinf=0.0)
    logs = np.log10(np.maximum(positive, 10.0**LOG_LOW), dtype=np.float32)
    codes = np.clip(np.rint((logs - LOG_LOW) / LOG_SPAN * CODES) + 1, 1, CODES + 1)
    codes = np.where(positive > 0, codes, 0).astype(np.uint16)
    steps = np.diff(codes, axis=1, prepend=np.uint16(0))  # modulo 65536
    high_bytes, low_bytes = (steps >> 8).astype(np.uint8), (steps & 255).astype(np.uint8)
    stored = zlib.compress(high_bytes.tobytes() + low_bytes.tobytes(), 6)
    return base64.b64encode(stored).decode("ascii")


def write_page(path: Path, pictures: Sequence[MeasuredPicture], rows: Sequence[JsonTable]) -> None:
    """Write one self-contained HTML page: pictures, their figures, and statistics of regions.

    path: of the page; an earlier file is replaced. rows: results of `region_statistics`, in the
    order of the page's table.
    """
    low, high = shared_scale(luminance_ends(picture.shown_cdm2) for picture in pictures)
    about = {
        "pictures": [_about(picture) for picture in pictures],
        "rows": list(rows),
        "low": low,
        "high": high,
        "colours": colour_table().tolist(),
        "log": [LOG_LOW, LOG_SPAN, CODES],
        "uStep": _U_STEP,
    }
    text = Path(__file__).with_name("view.html").read_text(encoding="utf-8")
    # "<" cannot end the script early, whatever a file is called
    data = json.dumps(about).replace("<", "\\u003c")
    tag = '<script type="application/octet-stream" id="{}{}">{}</script>'
    pixels = ""
    for k, picture in enumerate(pictures):
        pixels += tag.format("pixels", k, encode_luminance(picture.luminance_cdm2))
        if (u := picture.picture.panorama.u_cdm2) is not None:
            pixels += tag.format("u", k, encode_luminance(u[::_U_STEP, ::_U_STEP]))
    title = html.escape(", ".join(picture.name for picture in pictures)[:120])
    text = text.replace("@TITLE@", title).replace("@PIXELS@", pixels).replace("@DATA@", data)
    write_file(path, text)


def _about(picture: MeasuredPicture) -> JsonTable:
    """Return what the page's script reads about a picture; keys as in view.html.

    The view has its axes as `frame`, not as separate vectors.
    """
    height, width = picture.luminance_cdm2.shape
    view = picture.picture.view
    arrays = {} if view is None else {"frame": view.frame.tolist(), "forward": None, "up": None}
    return {
        "name": picture.name,
        "width": width,
        "height": height,
        "view": view and asdict(view) | arrays,
        "heading": picture.picture.panorama.heading_deg,
        "figures": "; ".join(filter(None, (picture.figures, f"{width} x {height} pixels"))),
        "notes": picture.notes,
        "outlines": picture.outlines,
    }
