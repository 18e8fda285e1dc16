"""Any luminance picture on disk as a panorama: Radiance views are read, checked, and resampled by
nearest rays.

A picture says where it looks: `VIEW=` with Radiance's options in a .hdr, the attribute `view` in an
.exr, or that it is a panorama. What is missing or contradicts itself is refused with the line to
write.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.images import read_exr, read_panorama, read_radiance_hdr
from fieldlum.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.records import Flag, Float, Panorama, SunSource

HOW = (
    "write VIEW= -vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180 (a 180-degree fisheye that looks south)"
)
HOW_PANORAMA = "or FIELDLUM_VIEW= equirect heading_deg=180 for a panorama"
VIEW_TYPES = {"a": "equidistant", "h": "hemispherical", "s": "stereographic", "v": "perspective"}


@dataclass(frozen=True, slots=True)
class PictureView:
    """A Radiance view: kind a, h, s or v; unit vectors; full angles. [deg]"""

    kind: str
    forward: NDArray[np.float64]
    up: NDArray[np.float64]
    horizontal_deg: float
    vertical_deg: float

    @property
    def azimuth_deg(self) -> float:
        return float(np.degrees(np.arctan2(self.forward[0], self.forward[1])) % 360.0)

    @property
    def altitude_deg(self) -> float:
        return float(np.degrees(np.arcsin(np.clip(self.forward[2], -1.0, 1.0))))


@dataclass(frozen=True, slots=True)
class Picture:
    """view is None for a panorama. covered_sr: how much of the hemisphere in front the picture
    covers, at most 2 pi.

    directed: it says where it looks; else its azimuth is Radiance's default, north.
    """

    panorama: Panorama
    view: PictureView | None
    covered_sr: float
    directed: bool = True


def read_picture(path: Path) -> Picture:
    """A .hdr or .exr picture as a panorama. Raises InputError for a missing or contradictory
    VIEW.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "a luminance picture .hdr or .exr")
    found = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    pixels, text = found.luminance_cdm2, found.view
    height, width = pixels.shape
    if found.panorama:
        if text:
            raise InputError(
                path,
                f"a panorama and VIEW= {text}",
                "one of the two",
                "take one of the two lines out",
            )
        return Picture(read_panorama(path), None, 2.0 * np.pi)
    if not text:
        raise InputError(path, "no VIEW", "where the picture looks", f"{HOW}, {HOW_PANORAMA}")
    view = parse_view(text, path, found.heading_deg)
    _check_shape(view, height, width, path)
    luminance, covered = to_panorama(pixels, view)
    directed = "-vd" in text.split() or path.suffix.lower() == ".exr"
    return Picture(Panorama(luminance, view.azimuth_deg, sun=found.sun), view, covered, directed)


@dataclass(frozen=True, slots=True)
class _Found:
    """A picture as it stands: view is Radiance's words; heading_deg is where it faces when those
    do not say it.
    """

    luminance_cdm2: Float
    view: str
    panorama: bool
    heading_deg: float = 0.0
    sun: SunSource | None = None


def _read_hdr(path: Path) -> _Found:
    image = read_radiance_hdr(path)
    views = [line[5:].strip() for line in image.header if line.startswith("VIEW=")]
    types = {word for text in views for word in text.split() if word.startswith("-vt")}
    if len(types) > 1:
        raise InputError(
            path, f"views {', '.join(sorted(types))}", "one VIEW", "keep the line that is true"
        )
    return _Found(image.luminance_cdm2, image.view, image.heading_deg is not None)


def _read_exr(path: Path) -> _Found:
    """Pixels that no lens saw are 0."""
    picture, view = read_exr(path)
    pixels = np.asarray(picture.luminance_cdm2, np.float32)
    if picture.flags is not None:
        pixels = np.where(picture.flags & Flag.OUTSIDE_LENS > 0, np.float32(0.0), pixels)
    words = "" if view == "equirect" else view.removeprefix("VIEW=").strip()
    return _Found(pixels, words, view == "equirect", picture.heading_deg, picture.sun)


# ----------------------------------------------------------------------------------------------
# VIEW


def parse_view(text: str, source: Path, heading_deg: float = 0.0) -> PictureView:
    """Radiance's view options; without -vd the view is level and faces `heading_deg` (Radiance's
    own default is north).

    Raises InputError for a type or an angle that cannot be.
    """
    options = _options(text, source)
    kind = options.get("vt", "")
    if kind not in VIEW_TYPES:
        shown = f"view type -vt{kind}" if kind else "a VIEW without a type"
        raise InputError(source, shown, "-vta, -vth, -vts or -vtv", HOW)
    forward = (
        _vector(options["vd"], "-vd", source) if "vd" in options else direction(0.0, heading_deg)
    )
    up = _vector(options.get("vu", "0 0 1"), "-vu", source)
    if abs(float(forward @ up)) > 0.9999:
        raise InputError(
            source,
            "-vd along -vu",
            "two different directions",
            "write -vu 0 1 0 for a picture of the sky",
        )
    default = "45" if kind == "v" else "180"
    angles = [_number(options.get(name, default), f"-{name}", source) for name in ("vh", "vv")]
    largest = {"a": 360.0, "h": 180.0, "s": 359.0, "v": 179.0}[kind]
    for name, angle in zip(("-vh", "-vv"), angles, strict=True):
        if not 0.0 < angle <= largest:
            raise InputError(
                source,
                f"{name} {angle:g} with -vt{kind}",
                f"above 0, at most {largest:g}",
                HOW.replace("-vta", "-vta"),
            )
    up = up - forward * float(up @ forward)
    return PictureView(kind, forward, up / np.linalg.norm(up), *angles)


def _options(text: str, source: Path) -> dict[str, str]:
    """-vta is vt = a; -vd x y z is vd = "x y z"; what is not about direction or angle is passed
    over.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(
            source, f"VIEW {text!r} ({error})", "Radiance's view options", HOW
        ) from None
    found: dict[str, str] = {}
    take = {"vp": 3, "vd": 3, "vu": 3, "vh": 1, "vv": 1, "vo": 1, "va": 1, "vs": 1, "vl": 1}
    at = 0
    while at < len(words):
        name = words[at].lstrip("-")
        at += 1
        if name.startswith("vt") and len(name) == 3:
            found["vt"] = name[2]
        elif name in take:
            found[name] = " ".join(words[at : at + take[name]])
            at += take[name]
    for shift in ("vs", "vl"):
        if shift in found and _number(found[shift], f"-{shift}", source) != 0.0:
            raise InputError(
                source,
                f"a shifted view -{shift} {found[shift]}",
                "an unshifted one",
                "render it without",
            )
    return found


def _number(text: str, name: str, source: Path) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(source, f"{name} {text!r}", "a number", HOW) from None
    if not np.isfinite(value):
        raise InputError(source, f"{name} {text!r}", "a number", HOW)
    return value


def _vector(text: str, name: str, source: Path) -> NDArray[np.float64]:
    parts = text.split()
    values = np.array([_number(part, name, source) for part in parts])
    if len(values) != 3 or not np.linalg.norm(values) > 0:
        raise InputError(source, f"{name} {text!r}", "three numbers that are not all 0", HOW)
    return values / np.linalg.norm(values)


def _reach(kind: str, angle_deg: float) -> float:
    """Radius that half an angle takes in a mapping, of focal length 1."""
    half = np.radians(angle_deg) / 2.0
    return float(
        {"a": half, "h": np.sin(half), "s": 2.0 * np.tan(half / 2.0), "v": np.tan(half)}[kind]
    )


def _check_shape(view: PictureView, height: int, width: int, source: Path) -> None:
    """Square pixels: the picture's proportion must be that of its angles."""
    expected = _reach(view.kind, view.horizontal_deg) / _reach(view.kind, view.vertical_deg)
    if abs(width / height / expected - 1.0) > 0.02 + 1.0 / min(width, height):
        raise InputError(
            source,
            f"{width} x {height} pixels with -vh {view.horizontal_deg:g} -vv {view.vertical_deg:g}",
            f"proportion {expected:.3f}",
            f"correct -vh and -vv, or crop the picture; a full fisheye: {HOW}",
        )


# ----------------------------------------------------------------------------------------------
# resampling


def to_panorama(
    pixels: Float, view: PictureView, height: int | None = None
) -> tuple[NDArray[np.float32], float]:
    """The picture's luminance on a panorama whose centre faces the view, 0 where it does not look;
    covered sr in front.

    Every panorama pixel is the mean of samples of the picture, fine enough for both grids.
    """
    rows, columns = pixels.shape
    size = height or int(np.clip(2 * round(rows * 90.0 / min(view.vertical_deg, 180.0)), 64, 900))
    per_pixel = rows / _reach(view.kind, view.vertical_deg) * np.pi / 2.0 / size
    samples = int(np.clip(np.ceil(2.0 * per_pixel), 1, 6))
    rays = equirect_rays(size * samples, 2 * size * samples, view.azimuth_deg)
    right = np.cross(view.forward, view.up)
    x, y, z = (rays @ axis for axis in (right, view.up, view.forward))
    off = np.hypot(x, y)
    radius = _radius(view.kind, np.arctan2(off, z))
    scale = np.divide(radius, off, out=np.zeros_like(off), where=off > 1e-12)
    u = 0.5 + 0.5 * x * scale / _reach(view.kind, view.horizontal_deg)
    v = 0.5 - 0.5 * y * scale / _reach(view.kind, view.vertical_deg)
    inside = np.isfinite(radius) & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    if view.kind != "v" and min(view.horizontal_deg, view.vertical_deg) >= 180.0:
        inside &= np.hypot((u - 0.5) * 2, (v - 0.5) * 2) <= 1.0
    values = np.zeros(inside.shape, np.float32)
    values[inside] = pixels[(v[inside] * rows).astype(int), (u[inside] * columns).astype(int)]
    shape = (size, samples, 2 * size, samples)
    share = inside.reshape(shape).mean(axis=(1, 3))
    ahead = (z > 0).reshape(shape).mean(axis=(1, 3))
    covered = float((equirect_solid_angles(size, 2 * size) * np.minimum(share, ahead)).sum())
    return values.reshape(shape).mean(axis=(1, 3)), covered


def _radius(kind: str, angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radius of an angle from the axis in a mapping of focal length 1; NaN where the mapping
    ends.
    """
    if kind == "a":
        return angle_rad
    if kind == "s":
        return 2.0 * np.tan(angle_rad / 2.0)
    beyond = angle_rad >= (np.pi / 2 if kind == "h" else np.pi / 2 - 1e-3)
    inner = np.where(beyond, 0.0, angle_rad)
    return np.where(beyond, np.nan, np.sin(inner) if kind == "h" else np.tan(inner))
