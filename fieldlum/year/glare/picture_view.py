"""Parse Radiance's view options: the view direction of a picture, and its pixels' directions.

The mappings are those of Radiance's viewray (src/common/image.c): x and y run from -1/2 to 1/2 over
the picture, plus shift (-vs) and lift (-vl) in picture widths and heights.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.optics.projection import direction
from fieldlum.year.glare.contrast import BAND_DEG, TASK_ALTITUDE_DEG, TASK_RADIUS_DEG

_BLOCK_PIXELS = 250_000  # pixels processed at a time: about 40 MB of temporary arrays; chosen
# Samples along an edge of the picture, which make solid angles exact to 1e-4. Chosen.
_FINE_SAMPLES = 400
# Samples along an edge of a pixel that the hemisphere's edge crosses; chosen, not measured.
_RIM_SAMPLES = 8
# below this cosine, the solid angle of a -vth pixel varies within the pixel; chosen
_GRAZING_COSINE = 0.1


@dataclass(frozen=True, slots=True)
class PictureGrid:
    """The weights of each pixel of a picture with the view `view`, [H, W] each.

    solid_angle : of the pixel's part in front of the observer, sr; illuminance : this times the
    cosine to the view direction, sr. Both are 0 behind the observer. task, band : masks, True for
    pixels in the task cone and in the horizontal band (see `contrast.ViewRegions`).
    """

    view: PictureView
    solid_angle: Floats32
    illuminance: Floats32
    task: Mask
    band: Mask

    @property
    def covered_share(self) -> float:
        """Share (0 to 1) of the front hemisphere's solid angle that the picture covers."""
        return min(1.0, float(self.solid_angle.sum(dtype=float)) / (2.0 * np.pi))


def picture_grid(view: PictureView, height: int, width: int) -> PictureGrid:
    """Return the weights of each pixel of a picture of height x width pixels with a Radiance view.

    They need 10 bytes of memory for each pixel.
    """
    solid_angle = np.zeros((height, width), np.float32)
    illuminance = np.zeros((height, width), np.float32)
    task, band = np.zeros((height, width), bool), np.zeros((height, width), bool)
    samples = int(np.clip(np.ceil(_FINE_SAMPLES / min(height, width)), 1, _RIM_SAMPLES))
    for rows in row_blocks(height, width):
        y, x = centres(rows, height, width)
        rays = picture_rays(view, x, y)
        task[rows], band[rows] = _regions(rays.up, rays.forward)
        solid_angle[rows], illuminance[rows] = _weights(view, x, y, (height, width), samples)
        rim = _rim(view, x, y, (height, width))
        if samples < _RIM_SAMPLES and rim.any():
            row, column = np.nonzero(rim)
            fine = _weights(view, x[0, column], y[row, 0], (height, width), _RIM_SAMPLES)
            solid_angle[rows][rim], illuminance[rows][rim] = fine
    return PictureGrid(view, solid_angle, illuminance, task, band)


def row_blocks(height: int, width: int) -> Iterator[slice]:
    """Yield slices of rows, from the top, that divide a picture of height x width pixels.

    A slice has at most 250 000 pixels, but at least one row.
    """
    step = max(1, _BLOCK_PIXELS // width)
    for first in range(0, height, step):
        yield slice(first, min(first + step, height))


def centres(rows: slice, height: int, width: int) -> tuple[Floats, Floats]:
    """Return y [k, 1] and x [1, W] of the centres of pixels in the k rows of the slice `rows`.

    Both run from -1/2 to 1/2 over the picture of height x width pixels, x to the right, y upwards;
    row 0 is at the top.
    """
    y = 0.5 - (np.arange(rows.start, rows.stop) + 0.5) / height
    x = (np.arange(width) + 0.5) / width - 0.5
    return y[:, None], x[None, :]


def _weights(
    view: PictureView, x: Floats, y: Floats, shape: tuple[int, int], samples: int
) -> tuple[Floats, Floats]:
    """Return solid angle, and solid angle times cosine, of each pixel's part in front, in sr."""
    height, width = shape
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    solid_angle, illuminance = np.zeros(1), np.zeros(1)
    for dy in steps / height:
        for dx in steps / width:
            rays = picture_rays(view, x + dx, y + dy)
            part = np.where(rays.forward > 0.0, rays.density, 0.0)
            solid_angle = solid_angle + part
            illuminance = illuminance + part * np.maximum(rays.forward, 0.0)
    pixel = 1.0 / (height * width * samples**2)
    return solid_angle * pixel, illuminance * pixel


def _rim(view: PictureView, x: Floats, y: Floats, shape: tuple[int, int]) -> Mask:
    """Return a mask [k, W] of pixels on the edge of the hemisphere, and of grazing -vth ones."""
    height, width = shape
    corner_y = np.append(y[:, 0] + 0.5 / height, y[-1, 0] - 0.5 / height)[:, None]  # [k + 1, 1]
    corner_x = np.append(x[0] - 0.5 / width, x[0, -1] + 0.5 / width)[None, :]  # [1, W + 1]
    rays = picture_rays(view, corner_x, corner_y)
    ahead = (rays.forward > 0.0) & (rays.density > 0.0)
    grazing = (rays.forward < _GRAZING_COSINE) & (view.kind == "h")
    count = sum(
        part.astype(np.int8)
        for part in (ahead[:-1, :-1], ahead[1:, :-1], ahead[:-1, 1:], ahead[1:, 1:])
    )
    return (count > 0) & ((count < 4) | grazing[:-1, :-1])


def _regions(up: Floats, forward: Floats) -> tuple[Mask, Mask]:
    """Return two masks: pixels in the task cone, and pixels in the 40-degree horizontal band.

    The task cone is 30 degrees below the line of sight. up, forward : components of each pixel's
    direction along the axes of the view.
    """
    below = np.radians(TASK_ALTITUDE_DEG)
    to_task = up * np.sin(below) + forward * np.cos(below)
    task = to_task > np.cos(np.radians(TASK_RADIUS_DEG))
    return task, (forward > 0.0) & (np.abs(up) < np.sin(np.radians(BAND_DEG)))


VIEW_TYPES = {"a": "equidistant", "h": "hemispherical", "s": "stereographic", "v": "perspective"}
EXAMPLE_VIEW = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"
HOW = f'state the true view, such as --view "{EXAMPLE_VIEW}" for a fisheye that looks south'
# Angles that Radiance accepts for each type, and the numbers after each view option (rpict -v).
_LARGEST_DEG = {"a": 360.0, "h": 180.0, "s": 359.0, "v": 179.0}
_ARGUMENTS = {"vp": 3, "vd": 3, "vu": 3, "vh": 1, "vv": 1, "vo": 1, "va": 1, "vs": 1, "vl": 1}
# The solid angle of -vth is infinite at its rim; directions with a smaller cosine are 0.1 % of the
# hemisphere. Chosen.
_LEAST_COSINE = 1e-3
_SAME_PROPORTION = 0.02  # relative; -vh and -vv are often rounded to degrees; chosen


@dataclass(frozen=True, slots=True)
class PictureView:
    """A Radiance view, which gives the direction of each point of a picture.

    kind : mapping: a (equidistant), h (hemispherical), s (stereographic) or v (perspective);
    forward, up : perpendicular unit vectors (x east, y north, z up); horizontal_deg, vertical_deg :
    full angles of view; shift, lift : offset to the right and upwards in picture widths and
    heights.
    """

    kind: str
    forward: Floats
    up: Floats
    horizontal_deg: float
    vertical_deg: float
    shift: float = 0.0
    lift: float = 0.0

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the view direction, clockwise from north, in [0, 360)."""
        return float(np.degrees(np.arctan2(self.forward[0], self.forward[1])) % 360.0)

    @property
    def altitude_deg(self) -> float:
        """Altitude of the view direction above the horizon, negative for a view downwards."""
        return float(np.degrees(np.arcsin(np.clip(self.forward[2], -1.0, 1.0))))

    @property
    def frame(self) -> Floats:
        """Unit vectors right, up and forward of the view as rows, [3, 3]; x east, y north, z up."""
        return np.stack([np.cross(self.forward, self.up), self.up, self.forward])

    @property
    def text(self) -> str:
        """The view as Radiance's options, such as "-vta -vp 0 0 0 -vd 0 -1 0 ..."."""
        vectors = [" ".join(f"{v:.9g}" for v in vector) for vector in (self.forward, self.up)]
        return (
            f"-vt{self.kind} -vp 0 0 0 -vd {vectors[0]} -vu {vectors[1]} "
            f"-vh {self.horizontal_deg:.9g} -vv {self.vertical_deg:.9g} "
            f"-vo 0 -va 0 -vs {self.shift:.9g} -vl {self.lift:.9g}"
        )


@dataclass(frozen=True, slots=True)
class PictureRays:
    """Directions of points of a picture, and how much solid angle a unit of picture area has there.

    right, up, forward : components of unit vectors along the axes of the view. density : solid
    angle [sr] over picture area, where the complete picture has the area 1; 0 where the mapping has
    no direction. All have one shape.
    """

    right: Floats
    up: Floats
    forward: Floats
    density: Floats


def picture_rays(view: PictureView, x: ArrayLike, y: ArrayLike) -> PictureRays:
    """Return the directions of points of a picture with the view `view`.

    x, y : [...] coordinates of the points, from -1/2 to 1/2 over the picture, x to the right, y
    upwards; the view's shift and lift are added to them.
    """
    reach = [_reach(view.kind, angle) for angle in (view.horizontal_deg, view.vertical_deg)]
    across = (np.asarray(x, float) + view.shift) * 2.0 * reach[0]
    upwards = (np.asarray(y, float) + view.lift) * 2.0 * reach[1]
    across, upwards = np.broadcast_arrays(across, upwards)
    square = across**2 + upwards**2
    scale = 4.0 * reach[0] * reach[1]
    if view.kind == "a":
        angle = np.sqrt(square)
        shrink = np.sinc(angle / np.pi)  # sin(angle) / angle
        density = np.where(angle < np.pi, shrink * scale, 0.0)
        return PictureRays(across * shrink, upwards * shrink, np.cos(angle), density)
    if view.kind == "h":
        forward = np.sqrt(np.maximum(1.0 - square, 0.0))
        density = np.where(square < 1.0, scale / np.maximum(forward, _LEAST_COSINE), 0.0)
        return PictureRays(across, upwards, forward, density)
    if view.kind == "s":
        ratio = 4.0 / (4.0 + square)
        forward = (4.0 - square) / (4.0 + square)
        return PictureRays(across * ratio, upwards * ratio, forward, ratio**2 * scale)
    forward = 1.0 / np.sqrt(1.0 + square)
    return PictureRays(across * forward, upwards * forward, forward, forward**3 * scale)


def _reach(kind: str, angle_deg: float) -> float:
    """Return the radius of half an angle in a mapping with focal length 1."""
    half = np.radians(angle_deg) / 2.0
    return float(
        {"a": half, "h": np.sin(half), "s": 2.0 * np.tan(half / 2.0), "v": np.tan(half)}[kind]
    )


def check_proportion(
    view: PictureView, height: int, width: int, pixel_aspect: float, source: Path
) -> None:
    """Raise InputError if a picture's width over height contradicts the view's angles by over 2 %.

    height, width : in pixels, one pixel more is tolerated. pixel_aspect : height over width of a
    pixel, from the header's PIXASPECT lines. source : the file that the error names.
    """
    expected = _reach(view.kind, view.horizontal_deg) / _reach(view.kind, view.vertical_deg)
    actual = width / height / pixel_aspect
    if abs(actual / expected - 1.0) > _SAME_PROPORTION + 1.0 / min(width, height):
        raise InputError(
            source,
            f"{width} x {height} pixels with -vh {view.horizontal_deg:g} -vv {view.vertical_deg:g}",
            f"width over height {expected:.3f}",
            "the picture was cropped, or its VIEW is wrong: state the true view with --view",
        )


# ----------------------------------------------------------------------------------------------
# options


def parse_view(text: str, source: Path, heading_deg: float = 0.0) -> PictureView:
    """Return the view that Radiance's view options `text` describe.

    The last of repeated options counts; unknown ones are ignored. Without -vd the view is
    horizontal and faces `heading_deg`, clockwise from north (Radiance's own default is north).
    Raises InputError, which names `source`, for a missing or unknown view type, and for impossible
    numbers.
    """
    options = _options(text, source)
    kind = options.get("vt", "")
    if kind not in VIEW_TYPES:
        forms = "-vta, -vth, -vts or -vtv"
        if kind:
            raise InputError(
                source, f"the view type -vt{kind}", forms, "render the picture with -vta"
            )
        raise InputError(source, "a VIEW without a view type", forms, HOW)
    forward = direction(0.0, heading_deg)
    if "vd" in options:
        forward = _vector(options["vd"], "-vd", source)
    up = _vector(options.get("vu", "0 0 1"), "-vu", source)
    if abs(float(forward @ up)) > 0.9999:
        raise InputError(
            source,
            "-vd and -vu are parallel",
            "two different directions",
            "write -vu 0 1 0 for a picture of the sky",
        )
    default = "45" if kind == "v" else "180"
    angles = [_number(options.get(name, default), f"-{name}", source) for name in ("vh", "vv")]
    for name, angle in zip(("-vh", "-vv"), angles, strict=True):
        if not 0.0 < angle <= _LARGEST_DEG[kind]:
            raise InputError(
                source,
                f"{name} {angle:g} with -vt{kind}",
                f"an angle above 0 and at most {_LARGEST_DEG[kind]:g} deg",
                HOW,
            )
    up = up - forward * float(up @ forward)
    shift, lift = (_number(options.get(name, "0"), f"-{name}", source) for name in ("vs", "vl"))
    return PictureView(kind, forward, up / np.linalg.norm(up), angles[0], angles[1], shift, lift)


def _options(text: str, source: Path) -> dict[str, str]:
    """Return options by name; ignore unknown ones.

    For example vt = "a" for -vta, and vd = "x y z" for -vd x y z.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(
            source, f"VIEW {text[:80]!r} ({error})", "Radiance's view options", HOW
        ) from None
    options: dict[str, str] = {}
    at = 0
    while at < len(words):
        name = words[at].lstrip("-")
        at += 1
        if name.startswith("vt") and len(name) == 3:
            options["vt"] = name[2]
        elif name in _ARGUMENTS:
            options[name] = " ".join(words[at : at + _ARGUMENTS[name]])
            at += _ARGUMENTS[name]
    return options


def _number(text: str, name: str, source: Path) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(source, f"{name} {text[:40]!r}", "a number", HOW)
    return value


def _vector(text: str, name: str, source: Path) -> Floats:
    values = np.array([_number(part, name, source) for part in text.split()])
    length = float(np.linalg.norm(values)) if len(values) == 3 else 0.0
    if not 0.0 < length < np.inf:
        raise InputError(source, f"{name} {text[:80]!r}", "three numbers that are not all 0", HOW)
    return values / length
