"""Read any luminance picture with its view, compute its pixels' directions, resample panoramas.

A picture states its view: by `VIEW=` with Radiance's options in a .hdr, by the attribute `view` in
an .exr, or by a mark that it is a panorama. For a missing or contradictory view, the error names
the option that helps. The mappings are those of Radiance's viewray (src/common/image.c): x and y
run from -1/2 to 1/2 over the picture, plus shift (-vs) and lift (-vl) in picture widths and
heights.

evalglare of pyradiance is the reference. It is by J. Wienold, EPFL and Fraunhofer ISE. Its version
and flags are reported with every figure, because both change the result: the threshold in 2.05, the
low-light correction in 2.14 and 3.05, the position index in 2.12 to 3.02.
"""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from fieldlum.core import files, room_states
from fieldlum.core.arrays import ArrayLike, Floats, Floats32, Ints32, Mask
from fieldlum.core.errors import FieldlumError, InputError, input_errors
from fieldlum.core.records import Panorama, SunSource
from fieldlum.optics import images, projection
from fieldlum.session import Session, marks
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import SUN_RADIUS_RAD
from fieldlum.year.glare.sources import Views, angles_from_view

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_INHERITED = "the VIEW is that of an input picture: it is wrong if that picture was cropped"


class Picture(NamedTuple):
    """A luminance picture with its view.

    panorama : the pixels, rows from the top, also of a picture that is no panorama; its heading_deg
    is then the azimuth of the view. view : the view of a fisheye or perspective picture; None for a
    panorama. directed : False if the view states no direction: its azimuth is then the heading of
    an .exr, or Radiance's default, north. notes : warnings of the reader, sentences. lamps :
    whether electric light is on; None if unknown. `read_picture` sets True if the journal of the
    picture's session marks a lamp as on, else None.
    """

    panorama: Panorama
    view: PictureView | None
    directed: bool = True
    notes: tuple[str, ...] = ()
    lamps: bool | None = None


def read_picture(path: Path, view_options: str = "", part: str = "") -> Picture:
    """Return a .hdr or .exr picture with its view, which `view_options` replace if they are not "".

    view_options : Radiance's options as for `parse_view`, such as "-vta -vd 0 -1 0 -vh 180 -vv
    180", or for a panorama "equirect heading_deg=180". part : name of the part, layer or stereo
    view of an .exr; "" for the only one. Raises InputError for a missing or damaged file, a missing
    or contradictory view, a `part` that the file does not have, and any `part` of a .hdr.
    """
    what = "a picture .hdr or .exr"
    with input_errors(path, what, "check the path", OSError), files.open_to_read(path) as file:
        is_exr = file.read(4) == _EXR_MAGIC or path.suffix.lower() == ".exr"
    if part and not is_exr:
        raise InputError(path, "a picture without parts", "an .exr for --part", "omit --part")
    if stated := images.PANORAMA_VIEW.fullmatch(view_options):
        own = replace(read_panorama_with_sun(path, part=part), heading_deg=float(stated[1]))
        return Picture(own, None, notes=_notes(own))
    return _read_exr(path, view_options, part) if is_exr else _read_hdr(path, view_options)


def _notes(panorama: Panorama) -> tuple[str, ...]:
    """Return the note that the reader of a picture's file made, if it made one."""
    return tuple(filter(None, [panorama.attributes.get("note")]))


def _read_hdr(path: Path, view_options: str) -> Picture:
    """Return a Radiance picture with the view that view_options, or else its header, state."""
    picture, header = images.read_radiance_hdr(path)
    text = view_options or header.view
    if not view_options:
        _check_views(header, path)
        if header.heading_deg is not None:
            return Picture(images.read_panorama(path), None, notes=_notes(picture))
    view = parse_view(text, path)
    check_proportion(view, picture.luminance_cdm2.shape, header.pixel_aspect, path)
    notes = _notes(picture) if header.views or view_options else (*_notes(picture), _INHERITED)
    own = replace(picture, heading_deg=view.azimuth_deg, rgb=None)
    return Picture(own, view, "-vd" in text.split(), notes)


def _check_views(header: images.RadianceHeader, path: Path) -> None:
    """Raise InputError for views of different types, or for a panorama with a view."""
    types = {word for text in header.views for word in text.split() if word.startswith("-vt")}
    found = ""
    if header.heading_deg is not None and header.views:
        found = f"the header has the lines FIELDLUM_VIEW= (a panorama) and VIEW= {header.view[:80]}"
    elif len(types) > 1:
        found = f"VIEW lines of several types: {', '.join(sorted(types))}"
    elif not header.view and header.inherited_views:
        found = "different VIEW lines inherited from its input pictures"
    if found:
        raise InputError(path, found, "one VIEW", "state the true view with --view")


def _read_exr(path: Path, view_options: str, part: str) -> Picture:
    """Return an .exr picture, or its part; view_options replace the view that it states.

    A panorama gets its sun and lamps from its session, and has no view.
    """
    picture, stated = images.read_exr(path, part)
    is_panorama = stated == "equirect" and not view_options
    if is_panorama:
        picture = read_panorama_with_sun(path, part=part)
    notes = _notes(picture)
    if is_panorama:
        # panoramas/ can be a link to another disk
        marked = marks(Session(path.absolute().parent.parent)).get(path.stem, "")
        return Picture(picture, None, notes=notes, lamps=room_states.is_lit(marked) or None)
    text = view_options or stated.removeprefix("VIEW=").strip()
    view = parse_view(text, path, picture.heading_deg)
    check_proportion(view, picture.luminance_cdm2.shape, 1.0, path)
    own = replace(picture, heading_deg=view.azimuth_deg, rgb=None)
    return Picture(own, view, "-vd" in text.split() or not view_options, notes)


# ----------------------------------------------------------------------------------------------
# views

# Sum of solid angle over squared position index of a hemisphere, sr: the integral of
# `position_index` (test_a_hemisphere_has_its_sources).
HEMISPHERE_SOURCES_SR = 0.84636
# Samples along an edge of the picture and most along an edge of a pixel, with which solid angles
# are exact to 5e-3 (test_a_uniform_hemisphere_gives_pi_l_in_every_mapping).
_FINE_SAMPLES, _MAX_PIXEL_SAMPLES = 1000, 8


def picture_views(
    view: PictureView, height: int, width: int, seen_mask: Mask | None = None
) -> Views:
    """Return the weights of each pixel of a picture of height x width pixels with a Radiance view.

    The only view direction (d = 1) is that of the picture. seen_mask : True for pixels that a lens
    saw [H, W]; None for all. A pixel on the edge of the hemisphere has the weight of its part in
    front. The weights need 16 bytes of memory for each pixel.
    """
    # samples along the edge of a pixel, and their places in it, in pixels from its centre
    samples = np.ceil(_FINE_SAMPLES / min(height, width)).clip(1, _MAX_PIXEL_SAMPLES).astype(int)
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    # of each pixel: illuminance weight, solid angle, its moments right and up
    weights, ahead = np.zeros((height, width, 4), np.float32), np.zeros((height, width), bool)
    sample_area = 1.0 / (height * width * samples**2)
    # about 40 MB of temporary arrays at a time
    block = max(1, 250_000 // width)
    for first in range(0, height, block):
        rows = slice(first, first + block)
        y, x = picture_centres(height, width, rows)
        ahead[rows] = picture_rays(view, x, y)[0][..., 2] > 0.0
        for dy, dx in product(steps / height, steps / width):
            rays, density = picture_rays(view, x + dx, y + dy)
            right, up, cosine = angles_from_view(rays, np.eye(3))
            omega = np.where(cosine > 0.0, density * sample_area, 0.0)
            weights[rows] += np.stack([omega * cosine, omega, omega * right, omega * up], axis=-1)
    if seen_mask is not None:
        weights[~seen_mask] = 0.0
        ahead &= seen_mask
    flat, azimuths = weights.reshape(-1, 4, 1), np.array([view.azimuth_deg])
    hemisphere = np.array([[np.pi], [2.0 * np.pi], [0.0], [0.0], [HEMISPHERE_SOURCES_SR]])
    parts = (view.frame[None], flat[:, 0], flat[:, 1:], ahead.reshape(-1, 1), hemisphere)
    return Views(azimuths, *parts, is_panorama=False)


def picture_centres(height: int, width: int, rows: slice = slice(None)) -> tuple[Floats, Floats]:
    """Return y [k, 1] and x [1, W] of the centres of pixels in the k rows of the slice `rows`.

    Both run from -1/2 to 1/2 over the picture of height x width pixels, x to the right, y upwards;
    row 0 is at the top.
    """
    y = 0.5 - (np.arange(height)[rows] + 0.5) / height
    return y[:, None], (np.arange(width)[None, :] + 0.5) / width - 0.5


EXAMPLE_VIEW = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"
HOW = f'state the true view, such as --view "{EXAMPLE_VIEW}" for a fisheye that looks south'
# Angles that Radiance accepts for equidistant (a), hemispherical, stereographic and perspective
# views.
_MAX_DEG = {"a": 360.0, "h": 180.0, "s": 359.0, "v": 179.0}


@dataclass(frozen=True, slots=True, kw_only=True)
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
        return float(projection.altitude_azimuth_deg(self.forward)[1]) % 360.0

    @property
    def altitude_deg(self) -> float:
        """Altitude of the view direction above the horizon, negative for a view downwards."""
        return float(projection.altitude_azimuth_deg(self.forward)[0])

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


def picture_rays(view: PictureView, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    """Return directions [..., 3] of points of a picture, and their solid angle over area [...].

    x, y : [...] coordinates of the points, from -1/2 to 1/2 over the picture, x to the right, y
    upwards; the view's shift and lift are added to them. A direction is a unit vector (right, up,
    forward) along the axes of the view. The second result times the share of a small part in the
    picture's area is the part's solid angle, sr; it is 0 where the mapping has no direction. The
    mappings are Radiance's (viewray in src/common/image.c).
    """
    reach = [_reach(view.kind, angle) for angle in (view.horizontal_deg, view.vertical_deg)]
    right, up = np.asarray(x, float) + view.shift, np.asarray(y, float) + view.lift
    across, upwards = np.broadcast_arrays(right * 2.0 * reach[0], up * 2.0 * reach[1])
    square = across**2 + upwards**2
    if view.kind == "a":
        angle = np.sqrt(square)
        shrink = np.sinc(angle / np.pi)  # sin(angle) / angle
        forward, density = np.cos(angle), np.where(angle < np.pi, shrink, 0.0)
    elif view.kind == "h":
        shrink, forward = np.ones_like(square), np.sqrt(np.maximum(1.0 - square, 0.0))
        # infinite at the rim; directions with a smaller cosine are 0.1 % of the hemisphere
        density = np.where(square < 1.0, 1.0 / np.maximum(forward, 1e-3), 0.0)
    elif view.kind == "s":
        shrink = 4.0 / (4.0 + square)
        forward, density = 2.0 * shrink - 1.0, shrink**2
    else:
        shrink = forward = 1.0 / np.sqrt(1.0 + square)
        density = forward**3
    rays = np.stack([across * shrink, upwards * shrink, forward], axis=-1)
    return rays, density * 4.0 * reach[0] * reach[1]


def picture_directions(picture: Picture) -> tuple[Floats, Floats]:
    """Return directions [H, W, 3] (x east, y north, z up) of pixels, and solid angles [H, W] in sr.

    Directions are unit vectors. The solid angle is that of a complete pixel, also behind the
    observer; 0 where the view has no direction.
    """
    height, width = picture.panorama.luminance_cdm2.shape
    if picture.view is None:
        rays = projection.equirect_rays(height, width, picture.panorama.heading_deg)
        return rays, projection.equirect_solid_angles(height, width)
    y, x = picture_centres(height, width)
    rays, density = picture_rays(picture.view, x, y)
    return rays @ picture.view.frame, density / (height * width)


def _reach(kind: str, angle_deg: float) -> float:
    """Return the radius in a picture at half of the angle angle_deg from the axis.

    kind : mapping: a (equidistant), h (hemispherical), s (stereographic) or v (perspective); the
    focal length of the picture is 1.
    """
    half = np.radians(angle_deg) / 2.0
    reach = {"a": half, "h": np.sin(half), "s": 2.0 * np.tan(half / 2.0), "v": np.tan(half)}
    return float(reach[kind])


def check_proportion(
    view: PictureView, shape: tuple[int, ...], pixel_aspect: float, source: Path
) -> None:
    """Raise InputError if a picture's width over height contradicts the view's angles by over 2 %.

    shape : height and width in pixels, one pixel more is tolerated. pixel_aspect : height over
    width of a pixel, from the header's PIXASPECT lines. source : the file that the error names.
    """
    height, width = shape
    expected = _reach(view.kind, view.horizontal_deg) / _reach(view.kind, view.vertical_deg)
    actual = width / height / pixel_aspect
    # -vh and -vv are often rounded to degrees
    if abs(actual / expected - 1.0) > 0.02 + 1.0 / min(width, height):
        angles = f"-vh {view.horizontal_deg:g} -vv {view.vertical_deg:g}"
        found = f"{width} x {height} pixels with {angles}"
        remedy = "the picture was cropped, or its VIEW is wrong: state the true view with --view"
        raise InputError(source, found, f"width over height {expected:.3f}", remedy)


# ----------------------------------------------------------------------------------------------
# options


def parse_view(text: str, source: Path, heading_deg: float = 0.0) -> PictureView:
    """Return the view that Radiance's view options `text` describe, such as `EXAMPLE_VIEW`.

    text : one of -vta, -vth, -vts and -vtv; -vd and -vu with three numbers each, the directions
    forward and up (x east, y north, z up); -vh and -vv, the full angles of view (180 degrees if
    missing, 45 with -vtv); -vs and -vl, shift and lift. Only the type is required. The last of
    repeated options counts; unknown ones are ignored. Without -vd the view is horizontal and faces
    `heading_deg`, clockwise from north (Radiance's own default is north). Raises InputError, which
    names `source`, for an empty text, a missing or unknown view type, and impossible numbers.
    """
    if not text:
        remedy = f'{HOW}, or --view "equirect heading_deg=180" for a panorama'
        raise InputError(source, "no VIEW in the header", "the picture's view", remedy)
    kind = (re.findall(r"(?<!\S)-vt(\S)(?!\S)", text) or [""])[-1]
    if kind not in _MAX_DEG:
        found = f"the view type -vt{kind}" if kind else "a VIEW without a view type"
        raise InputError(source, found, "-vta, -vth, -vts or -vtv", HOW)

    def numbers(name: str, *default: float) -> Floats:
        """Return the numbers after the last option `name`, or `default`; three as a unit vector.

        name : without its dash, such as "vd"; default : as many numbers as the option has. Raises
        InputError for too few numbers, other words, and a vector of length 0.
        """
        is_vector = len(default) == 3
        found = re.findall(rf"(?<!\S)-{name}((?:\s+\S+){{1,{len(default)}}})", text) or [""]
        with input_errors(f"{source}: -{name}{found[-1][:80]}", "a number", HOW, ValueError):
            values = np.array(found[-1].split() or default, float)
        length = float(np.linalg.norm(values)) if is_vector else 1.0
        if len(values) < len(default) or not np.isfinite(values).all() or not 0 < length < np.inf:
            expected = "three numbers that are not all 0" if is_vector else "a number"
            raise InputError(source, f"-{name}{found[-1][:80]}", expected, HOW)
        return values / length

    forward = numbers("vd", *projection.direction(0.0, heading_deg))
    up = numbers("vu", 0.0, 0.0, 1.0)
    if abs(float(forward @ up)) > 0.9999:
        remedy = "write -vu 0 1 0 for a picture of the sky"
        raise InputError(source, "-vd and -vu are parallel", "two different directions", remedy)
    default = 45.0 if kind == "v" else 180.0
    angles = [float(numbers(name, default)[0]) for name in ("vh", "vv")]
    for name, angle in zip(("-vh", "-vv"), angles, strict=True):
        if not 0.0 < angle <= _MAX_DEG[kind]:
            expected = f"an angle above 0 and at most {_MAX_DEG[kind]:g} deg"
            raise InputError(source, f"{name} {angle:g} with -vt{kind}", expected, HOW)
    up = up - forward * float(up @ forward)
    return PictureView(
        kind=kind,
        forward=forward,
        up=up / np.linalg.norm(up),
        horizontal_deg=angles[0],
        vertical_deg=angles[1],
        shift=float(numbers("vs", 0.0)[0]),
        lift=float(numbers("vl", 0.0)[0]),
    )


# ----------------------------------------------------------------------------------------------
# Fisheyes of a panorama preserve its flux, and the energy of the sun.

FISHEYE_VIEW = "-vta -vh 180 -vv 180"


def panorama_to_fisheye(
    luminance_cdm2: Floats,
    heading_deg: float,
    azimuth_deg: float,
    *,
    size: int = 800,
    sun: SunSource | None = None,
) -> Floats32:
    """Return an equidistant 180-degree picture (`FISHEYE_VIEW`) of a panorama, [size, size], cd/m2.

    luminance_cdm2 : the panorama [H, W = 2H]; heading_deg : azimuth of its centre column.
    azimuth_deg : the horizontal view direction of the picture. Azimuths are clockwise from north.
    size : pixels per side of the picture. sun : its light is added to the pixels of its disc;
    nothing is added for None or a sun behind the observer.

    A pixel is the mean of samples of the panorama, fine enough for both grids, so that the flux is
    preserved. Pixels outside the circle are 0.
    """
    view = parse_view(FISHEYE_VIEW, Path(), azimuth_deg)
    inside, index = _fisheye_samples(*luminance_cdm2.shape, heading_deg, azimuth_deg, size)
    values = np.zeros(inside.shape, np.float32)
    values[inside] = luminance_cdm2.ravel()[index]
    samples = len(inside) // size
    cells = (size, samples, size, samples)
    shares = inside.reshape(cells).sum(axis=(1, 3))
    picture = values.reshape(cells).sum(axis=(1, 3)) / np.maximum(shares, 1)
    y, x = picture_centres(size, size)
    picture[np.hypot(x, y) > 0.5] = 0.0
    if sun is not None:
        picture += disc_pixels(picture_views(view, size, size), picture.shape, sun)
    return picture.astype(np.float32)


@lru_cache(maxsize=4)  # 13 MB each at 800 pixels; 66 MB for maps of 2 000 rows
def _fisheye_samples(
    height: int, width: int, heading_deg: float, azimuth_deg: float, size: int
) -> tuple[Mask, Ints32]:
    """Return which samples of a fisheye are in front [k size, k size], and their panorama pixels.

    There are k x k samples in each pixel of the fisheye. Panorama pixels are flat indices into the
    panorama [height, width], one for each sample in front. heading_deg : azimuth of the panorama's
    centre column; azimuth_deg : of the fisheye's view; size : its pixels per side.
    """
    samples = max(2, int(np.ceil(2.0 * height / size)))
    y, x = picture_centres(size * samples, size * samples)
    view = parse_view(FISHEYE_VIEW, Path(), azimuth_deg)
    rays = picture_rays(view, x, y)[0]
    inside = rays[..., 2] > 0.0
    pixels = projection.flat_pixels(rays[inside] @ view.frame, (height, width), heading_deg)
    return inside, pixels.astype(np.int32)


def disc_pixels(views: Views, shape: tuple[int, int], sun: SunSource) -> Floats32:
    """Return the luminance [H, W] that the sun's disc adds to the pixels of a picture, in cd/m2.

    views : weights of the picture's pixels, in one view direction; shape : (H, W) of the picture.
    The pixels nearest to the sun that together have the disc's solid angle, at least one, get the
    same luminance, so that they have the disc's energy. Nothing is added for a sun behind the
    observer or outside the picture: further from the nearest pixel than this pixel's diagonal and
    the disc's radius together.
    """
    out = np.zeros(shape, np.float32)
    rays, omega = views.rays()
    towards = views.frames[0] @ projection.direction(sun.altitude_deg, sun.azimuth_deg)
    off = np.linalg.norm(rays[:, :, 0] - towards.astype(np.float32), axis=1)  # chords, rad
    off[omega[:, 0] <= 0.0] = np.inf
    near = np.argsort(off)
    diagonal_rad = np.sqrt(2.0 * omega[near[0], 0])
    if towards[2] <= 0.0 or off[near[0]] > SUN_RADIUS_RAD + diagonal_rad:
        return out
    total = np.cumsum(omega[near, 0], dtype=float)
    disc = near[: int(np.argmin(np.abs(total - SUN_SOLID_ANGLE_SR))) + 1]
    out.flat[disc] = sun.normal_illuminance_lx / omega[disc, 0].sum(dtype=float)
    return out


# ----------------------------------------------------------------------------------------------
# evalglare

FLAGS = ("-b", "2000", "-C", "l-", "-d")  # threshold 2000 cd/m2, no low-light correction, detailed


class ReferenceGlare(NamedTuple):
    """evalglare's figures of one picture; NaN for figures that its version does not print.

    dgp, dgi, ugr, ugp, cgi : its indices, as functions of these names in `metrics`. ev_lx :
    vertical illuminance. background_cdm2 : background luminance. veiling_cdm2 : veiling luminance
    of Stiles and Holladay without the age term (evalglare's Lveil_cie). sources : number of glare
    sources. version : text that evalglare prints about itself; flags : options it was run with.
    """

    dgp: float
    ev_lx: float
    dgi: float
    ugr: float
    background_cdm2: float
    ugp: float
    cgi: float
    veiling_cdm2: float
    sources: int
    version: str
    flags: str


_NAMES = ("dgp", "E_v", "dgi", "ugr", "lum_backg", "ugp", "cgi", "Lveil_cie")  # in the output


@lru_cache(maxsize=1)
def reference_version() -> str:
    """Return the version text that evalglare prints.

    It is the evalglare in the wheel of pyradiance, which is run once. Raises OSError if it cannot
    be run.
    """
    command = [images.radiance_program("evalglare"), "-v"]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    return (shown.stdout or shown.stderr).strip()


def reference_glare(picture_cdm2: Floats, *, view: str = FISHEYE_VIEW) -> ReferenceGlare:
    """Return evalglare's figures for a picture [H, W] in cd/m2.

    view : its view as Radiance's options, by default an equidistant 180-degree one. The picture is
    written to a temporary file. Raises FieldlumError if evalglare prints no figures, OSError if it
    cannot be run.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "view.hdr"
        images.write_radiance_hdr(path, picture_cdm2, view=view)
        return reference_glare_of_file(path)


def reference_glare_of_file(path: Path) -> ReferenceGlare:
    """Return evalglare's figures for a .hdr picture on disk whose header states its VIEW.

    evalglare is run with `FLAGS`. Raises FieldlumError if it prints no figures, OSError if it
    cannot be run.
    """
    command = [images.radiance_program("evalglare"), *FLAGS, str(path)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    return _parse(process.stdout, f"{process.stderr.strip()} (exit {process.returncode})")


def _parse(text: str, trouble: str) -> ReferenceGlare:
    """Return the figures in the text that evalglare printed.

    It has the number of sources first, and a line `dgp,av_lum,E_v,lum_backg,...: 0.34 ...`.
    trouble: what evalglare reported as error. Raises FieldlumError without that line.
    """
    line = next((line for line in text.splitlines() if line.startswith("dgp,")), "")
    names, _, values = line.partition(":")
    row = dict(zip(names.split(","), values.split(), strict=False))
    if "dgp" not in row:
        remedy = "expected a line that begins with 'dgp,'; install pyradiance again"
        raise FieldlumError(f"evalglare printed no result: {trouble}; {remedy}")
    figures = [float(row.get(name, "nan")) for name in _NAMES]
    sources = int((re.match(r"\d+", text) or "0")[0])
    return ReferenceGlare._make([*figures, sources, reference_version(), " ".join(FLAGS)])
