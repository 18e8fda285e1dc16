"""Read and write luminance pictures: EXR and Radiance .hdr, with headers for other programs.

Panoramas are written as OpenEXR; RGB or luminance of other programs is read. Radiance pictures
(RGBE, XYZE) are read through Radiance's own pvalue, which decodes flat, new and old run-length
scanlines. pvalue runs as a separate process, so that a damaged file cannot crash this one. It
receives the pixels behind a plain header: exposure, primaries and orientation are applied here.
"""

import errno
import hashlib
import io
import json
import math
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any, BinaryIO, cast

import numpy as np

from fieldlum.core import records
from fieldlum.core.arrays import Floats, Floats32, Mask, UInts8
from fieldlum.core.errors import InputError, input_errors, kind_of, library_messages
from fieldlum.core.files import open_to_read, replacing_path
from fieldlum.core.records import MAX_PIXELS, Flag, Panorama, SunSource, counted
from fieldlum.core.strict_toml import plain
from fieldlum.optics import melanopic
from fieldlum.optics.profiles import CameraProfile

# Radiance's own white efficacy (WHTEFFICACY of src/common/color.h), in lm/W: neither 683 nor a
# luminous efficacy of daylight.
RADIANCE_LM_PER_W = 179.0
# Luminance of Radiance's primaries (Ward Larson and Shakespeare 1998).
RADIANCE_Y = (0.265, 0.670, 0.065)
# Its primaries, red, green, blue and white, as CIE xy (src/common/color.h).
RADIANCE_CHROMATICITIES = (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 1.0 / 3.0, 1.0 / 3.0)
PANORAMA_LINE = "FIELDLUM_VIEW= equirect heading_deg="
PANORAMA_VIEW = re.compile(r"\s*(?:FIELDLUM_VIEW=)?\s*equirect\s+heading_deg=(-?\d+(?:\.\d+)?)\s*")
# Header line of a Radiance picture in which pixels of 0 are those that no lens saw; others have at
# least this luminance, a millionth of that of a night sky.
_UNSEEN_LINE, _DARKEST_CDM2 = "FIELDLUM_UNSEEN= 0", 1e-9
_CLIPPED_KEY = "FIELDLUM_CLIPPED="  # number of pixels that are clipped in every frame
_RESOLUTION = re.compile(rb"\s*([+-])([XY])\s+(\d+)\s+([+-])([XY])\s+(\d+)\s*")
_RGBE, _XYZE = "32-bit_rle_rgbe", "32-bit_rle_xyze"
# Values a byte of the file in large pictures (128 MB as .exr, 512 MB as .hdr when decoded).
# Measured: noise-free gradients have up to 22, pictures of one colour 500 and 48.
_EXR_VALUES, _HDR_VALUES = (2**25, 100), (2**27, 30)


def _max_values(path: Path, large: int, per_byte: int) -> int:
    """Return how many values, of all channels, a picture's file may be decoded to.

    large: allowed in any file; per_byte: allowed in a larger file for each of its bytes. The limit
    protects the computer's memory from damaged files: it is at most 2.6 GB.
    """
    return min(4 * MAX_PIXELS, max(large, per_byte * path.stat().st_size))


@dataclass(frozen=True, slots=True)
class RadianceHeader:
    """The content of a picture's header.

    axes, counts: the two axes in the order of the file, slowest first, such as ("-Y", "+X") for
    rows from the top and columns from the left, and the numbers of pixels along them. exposure:
    [3], by which the decoded channels must be divided. chromaticities: x, y of red, green, blue and
    white, [8]. xyze: whether the pixels are XYZ instead of RGB. views: the picture's own VIEW lines
    in order; inherited_views: those of its input pictures. heading_deg: azimuth of a panorama's
    centre, clockwise from north, None if the file states none. pixel_aspect: height over width of a
    pixel. black_is_unseen: whether pixels of 0 are those that no lens saw; clipped: number of
    pixels that were clipped in every frame, as far as the file states it.
    """

    axes: tuple[str, str]
    counts: tuple[int, int]
    xyze: bool
    exposure: Floats
    chromaticities: tuple[float, ...]
    views: tuple[str, ...]
    inherited_views: tuple[str, ...]
    heading_deg: float | None
    pixel_aspect: float
    black_is_unseen: bool = False
    clipped: int = 0

    @property
    def view(self) -> str:
        """Radiance's view options of the picture, else those its input pictures agree on, or ""."""
        if self.views:
            return " ".join(self.views)
        return self.inherited_views[0] if len(set(self.inherited_views)) == 1 else ""

    @property
    def cdm2_per_unit(self) -> Floats:
        """Luminance in cd/m2 of one unit of each decoded channel, [3], with exposure undone.

        XYZE has Y in cd/m2, because ra_xyze writes EXPOSURE = 1 / 179 for W/sr/m2.
        """
        if self.xyze:
            return np.array([0.0, 1.0, 0.0]) / self.exposure
        # programs write chromaticities to three decimals
        own = np.allclose(self.chromaticities, RADIANCE_CHROMATICITIES, rtol=0.0, atol=5e-4)
        weights = np.asarray(RADIANCE_Y) if own else rgb_to_xyz(self.chromaticities)[1]
        return RADIANCE_LM_PER_W * weights / self.exposure

    def upright(self, pixels: Floats32) -> Floats32:
        """Return pixels in file order [first axis, second axis, ...] as a picture [H, W, ...]."""
        axes = self.axes
        if axes[0][1] == "X":
            pixels, axes = pixels.swapaxes(0, 1), (axes[1], axes[0])
        rows = slice(None, None, -1) if axes[0] == "+Y" else slice(None)
        columns = slice(None, None, -1) if axes[1] == "-X" else slice(None)
        return np.ascontiguousarray(pixels[rows, columns])


# ----------------------------------------------------------------------------------------------
# primaries


def rgb_to_xyz(chromaticities: Sequence[float]) -> Floats:
    """Return the matrix from RGB to XYZ with Y = 1 for R = G = B = 1, [3, 3].

    Its second row has the shares of R, G and B in luminance, negative for a primary that is no real
    colour. chromaticities: x, y of red, green, blue and white, [8]. A primary need not be a real
    colour: blue of ACES AP0 has y = -0.077 (SMPTE ST 2065-1), red and blue of CIE XYZ have y = 0.
    Raises ValueError for another number of values, values that are not finite, primaries on one
    line, a white with y = 0, and one that is not between the primaries.
    """
    if len(chromaticities) != 8:
        raise ValueError(f"{len(chromaticities)} numbers in place of 8")
    xy = np.asarray(chromaticities, float).reshape(4, 2)
    if not np.isfinite(xy).all() or xy[3, 1] == 0:
        raise ValueError("chromaticities must be finite numbers, with y of white other than 0")
    xyz = np.vstack([xy.T, 1.0 - xy.sum(axis=1)])  # [3, 4]
    primaries, white = xyz[:, :3], xyz[:, 3] / xy[3, 1]
    if abs(float(np.linalg.det(primaries))) < 1e-4:
        raise ValueError("the three primaries are on one line")
    shares = np.linalg.solve(primaries, white)
    if (shares * white[1] <= 0).any():
        raise ValueError("white is not between the three primaries")
    return primaries * shares


# ----------------------------------------------------------------------------------------------
# reading Radiance pictures


def radiance_program(name: str) -> str:
    """Return the path of a program of Radiance, such as pvalue, in the wheel of pyradiance."""
    from pyradiance.anci import BINPATH

    return str(Path(BINPATH) / name)


def read_radiance_hdr(path: Path) -> tuple[Panorama, RadianceHeader]:
    """Return a Radiance picture, of a panorama or not, and its header.

    Exposure is undone: luminance_cdm2 is in cd/m2, rgb in W/sr/m2, in the file's own primaries, for
    XYZE in Radiance's; heading_deg is 180 (south) without a heading. Raises InputError for a
    missing file, any other format, or damaged pixels.
    """
    remedy = "check the path and the permissions of the picture"
    with input_errors(path, "a readable file", remedy, OSError), open_to_read(path) as file:
        header = _read_header(file, path)
        values = header.upright(_decoded(file, header, path))  # [H, W, 3]
    luminance = values @ header.cdm2_per_unit.astype(np.float32)
    rgb = np.divide(values, header.exposure, out=values, casting="same_kind")
    if header.xyze:
        to_rgb = np.linalg.inv(rgb_to_xyz(RADIANCE_CHROMATICITIES)) / RADIANCE_LM_PER_W  # [3, 3]
        rgb = rgb @ to_rgb.T.astype(np.float32)
    heading_deg = 180.0 if header.heading_deg is None else header.heading_deg
    unseen = Flag.OUTSIDE_LENS * (rgb == 0.0).all(axis=-1).astype(np.uint16)
    flags = unseen if header.black_is_unseen else None
    attributes = {"note": clipped_text(header.clipped)} if header.clipped else {}
    return Panorama(luminance, heading_deg, flags=flags, rgb=rgb, attributes=attributes), header


def clipped_text(count: int) -> str:
    """Return the warning of a number of pixels that are clipped in every frame."""
    return (
        f"clipped in every frame: {counted(count, 'pixel')}; the true luminance there, and "
        "DGP, may be higher; capture shorter exposures as well, unless it is the sun's disc"
    )


def _decoded(file: BinaryIO, header: RadianceHeader, path: Path) -> Floats32:
    """Return the channels [scanlines, pixels, 3], in file order, before exposure is undone.

    file: open at the first byte of the pixels; path: of the file, for errors.
    """
    scanlines, width = header.counts
    plain = f"#?RADIANCE\nFORMAT={_RGBE}\n\n-Y {scanlines} +X {width}\n".encode()
    command = [radiance_program("pvalue"), "-h", "-H", "-df"]
    values = np.empty(3 * scanlines * width, np.float32)
    with TemporaryFile() as coded:  # a pipe for both would need a thread
        coded.write(plain)
        copyfileobj(file, coded)
        coded.seek(0)
        quiet, pipe = subprocess.DEVNULL, subprocess.PIPE
        with subprocess.Popen(command, stdin=coded, stdout=pipe, stderr=quiet) as process:
            output = cast("io.BufferedReader", process.stdout)
            count = output.readinto(values.data.cast("B")) // (12 * width)
    if count < scanlines:
        finding = f"the pixels are damaged, or end after scanline {count} of {scanlines}"
        raise InputError(path, finding, "all scanlines", "it is cut short: copy it again")
    # Infinity is written as 1e30, and single precision ends at 3e38. [W/sr/m2]
    largest, brightest = float(values.max()), 2e30 * float(header.exposure.min())
    if not largest <= brightest:
        finding = f"a pixel value of {largest:.3g}"
        raise InputError(path, finding, f"at most {brightest:.3g}", "copy the file again")
    return values.reshape(scanlines, width, 3)


# ----------------------------------------------------------------------------------------------
# the header of a Radiance picture


def _read_header(file: BinaryIO, path: Path) -> RadianceHeader:
    """Read the header of an open Radiance picture, up to the first byte of the pixels."""
    lines = _header_lines(file)
    formats = [line[7:].strip() for line in lines if line.startswith("FORMAT=")]
    if not lines or not (lines[0].startswith("#?") or formats):
        file.seek(0)
        finding = kind_of(file.read(16)) or "no Radiance header"
        remedy = "merge photos: fieldlum merge --frames FILES --camera PROFILE --out MAP.exr"
        raise InputError(path, finding, "a luminance .hdr or .exr", remedy)
    kind = formats[-1] if formats else _RGBE
    if kind not in (_RGBE, _XYZE):
        remedy = "convert it by rcomb -fc -c RGB IN > OUT (spectra), or rmtxop -fc IN > OUT.hdr"
        raise InputError(path, f"pixel format {kind[:40]}", "Radiance RGBE or XYZE", remedy)
    if (gamma := float(_product(lines, "GAMMA=", 1, path)[0])) != 1.0:
        remedy = "write the picture again with linear values"
        raise InputError(path, f"values with a gamma of {gamma:g}", "linear values", remedy)
    axes, counts = _resolution(file.readline(200), path)
    marks = [line for line in lines if line.startswith(PANORAMA_LINE)]
    clipped = [line for line in lines if line.startswith(_CLIPPED_KEY)][-1:]
    return RadianceHeader(
        axes=axes,
        counts=counts,
        xyze=kind == _XYZE,
        exposure=_product(lines, "EXPOSURE=", 1, path) * _product(lines, "COLORCORR=", 3, path),
        chromaticities=_chromaticities(lines, path),
        views=_views(lines),
        inherited_views=_views([line.lstrip("\t ") for line in lines if line[:1] in "\t "]),
        heading_deg=_heading(marks[-1], path) if marks else None,
        pixel_aspect=float(_product(lines, "PIXASPECT=", 1, path)[0]),
        black_is_unseen=_UNSEEN_LINE in lines,
        clipped=int(min(_product(clipped, _CLIPPED_KEY, 1, path)[0], 1e9)) if clipped else 0,
    )


def _header_lines(file: BinaryIO) -> list[str]:
    """Return the lines up to the first empty one; [] if the header is damaged, or over 4 MB."""
    lines: list[str] = []
    while line := file.readline(4_000_000):
        text = line.decode("latin-1").rstrip("\r\n")
        if not line.endswith(b"\n") or file.tell() > 4_000_000 or (not lines and b"\0" in line):
            break
        if not text and lines:
            return lines
        if text:
            lines.append(text)
    return []


def _resolution(line: bytes, path: Path) -> tuple[tuple[str, str], tuple[int, int]]:
    """Return the axes, such as "-Y" and "+X", and their counts in the line before the pixels."""
    match = _RESOLUTION.fullmatch(line)
    if match is None or match[2] == match[5]:
        finding = f"resolution line {line[:40].decode('latin-1').strip()!r}"
        raise InputError(path, finding, "two axes, as -Y 800 +X 800", "copy the file again")
    counts = (int(match[3]), int(match[6]))
    if not 0 < counts[0] * counts[1] <= min(MAX_PIXELS, _max_values(path, *_HDR_VALUES) // 3):
        finding, expected = f"{counts[1]} x {counts[0]} pixels", f"1 to {MAX_PIXELS:,} pixels"
        expected += f", {_HDR_VALUES[1] // 3} for each byte of a large file"
        raise InputError(path, finding, expected, "reduce it with pfilt -1 -x 4000 -y 4000")
    return ((match[1] + match[2]).decode(), (match[4] + match[5]).decode()), counts


def _product(lines: Sequence[str], key: str, count: int, path: Path) -> Floats:
    """Return the product of the values of all lines that begin with `key`, [count].

    Zeros, which FreeImage writes as EXPOSURE, count as no line. Raises InputError for other values
    that are not finite numbers above 0.
    """
    total = np.ones(count)
    for line in (line for line in lines if line.startswith(key)):
        row, words = np.full(count, np.nan), line[len(key) :].split()[:count]
        with suppress(ValueError):
            row[: len(words)] = [float(word) for word in words]
        total = total * np.where(row.any(), row, 1.0)
        if not (np.isfinite(total).all() and (row >= 0).all() and (total > 0).all()):
            expected = f"{key} and {'a number' if count == 1 else f'{count} numbers'} above 0"
            raise InputError(path, repr(line)[:80], expected, "correct the header line")
    return total


def _chromaticities(lines: Sequence[str], path: Path) -> tuple[float, ...]:
    """Return the eight numbers of the last PRIMARIES line, or Radiance's own primaries.

    Adobe Photoshop writes eight zeros; they count as no line.
    """
    stated = [line[10:] for line in lines if line.startswith("PRIMARIES=")]
    remedy = "correct the line PRIMARIES=, or remove it for Radiance's own primaries"
    with input_errors(path, "x and y of red, green, blue and white", remedy, ValueError):
        values = tuple(float(word) for word in stated[-1].split()) if stated else ()
        if not any(values):
            return RADIANCE_CHROMATICITIES
        rgb_to_xyz(values)
    return values


def _views(lines: Sequence[str]) -> tuple[str, ...]:
    """Return the view options of the lines that begin with VIEW=, in order."""
    return tuple(line[5:].strip() for line in lines if line.startswith("VIEW="))


def _heading(line: str, path: Path) -> float:
    """Return the heading [deg] in the line by which fieldlum marks a panorama."""
    words = line.removeprefix(PANORAMA_LINE).split()
    with suppress(ValueError, IndexError):
        if np.isfinite(heading := float(words[0])):
            return heading
    expected = f"{PANORAMA_LINE} and a number"
    raise InputError(path, repr(line)[:80], expected, "correct the header line")


# ----------------------------------------------------------------------------------------------
# writing


def encode_rgbe(rgb: Floats) -> UInts8:
    """Encode RGB with a shared exponent (RGBE): floats [H, W, 3] become bytes [H, W, 4].

    rgb: radiance in W/sr/m2; NaN and negative values become 0, infinite ones 1e30. Mantissas are
    truncated, because Radiance decodes (mantissa + .5) / 256.
    """
    import cv2

    values = np.maximum(np.nan_to_num(np.asarray(rgb, np.float64), posinf=1e30), 0.0)
    flat = [cv2.IMWRITE_HDR_COMPRESSION, cv2.IMWRITE_HDR_COMPRESSION_NONE]
    _, file = cv2.imencode(".hdr", values[..., ::-1].astype(np.float32), flat)
    size = (*values.shape[:2], 4)
    return np.ravel(file)[-math.prod(size) :].reshape(size)


def write_radiance_hdr(
    path: Path,
    pixels: Floats,
    *,
    view: str = "",
    heading_deg: float | None = None,
    seen: Mask | None = None,
    clipped: int = 0,
) -> None:
    """Write cd/m2 [H, W] or radiance RGB [H, W, 3] in W/sr/m2 as a Radiance picture (flat RGBE).

    view: view options of Radiance, such as "-vta -vh 180 -vv 180"; a panorama has heading_deg
    instead, the azimuth of its centre, clockwise from north. seen [H, W]: pixels that a lens saw,
    all if None; others are 0, which a line of the header states; so does one the number of clipped
    pixels. Raises OSError if the file cannot be written.
    """
    values = np.asarray(pixels)
    height, width = values.shape[:2]
    lines = ["#?RADIANCE"]
    if heading_deg is not None:
        lines.append(f"{PANORAMA_LINE}{heading_deg:.6g}")
    if view:
        lines.append(f"VIEW= {view}")
    if clipped:
        lines.append(f"{_CLIPPED_KEY} {clipped}")
    lines += ["EXPOSURE=1", f"FORMAT={_RGBE}", "", f"-Y {height} +X {width}", ""]
    if values.ndim == 2:
        values = np.repeat(values[..., None] / RADIANCE_LM_PER_W, 3, axis=-1)
    if seen is not None and not seen.all():
        lines.insert(1, _UNSEEN_LINE)
        dark = values.max(axis=-1, keepdims=True) < _DARKEST_CDM2 / RADIANCE_LM_PER_W
        values = np.where(dark, _DARKEST_CDM2 / RADIANCE_LM_PER_W, values) * seen[..., None]
    path.write_bytes("\n".join(lines).encode() + encode_rgbe(values).tobytes())


def calibration_mark(profile: CameraProfile) -> dict[str, str]:
    """Return the attributes that a merged picture stores about its calibration, as texts.

    camera: its name; k: the scale factor; calibration: digest of the profile's lenses, sensor,
    shutter times, response, colour, filters and stray light. `calibrate scale` needs the old k: it
    multiplies k by the ratio of the meters to the picture.
    """
    p = profile
    colour = {k: v for k, v in plain(p.colour).items() if not k.startswith("melanopic")}
    parts = plain([p.lens, p.sensor, p.shutter, p.response, colour, p.nd])
    if p.stray.angle_deg:  # absent without it, so that earlier pictures have the same digest
        parts.append(plain(p.stray))
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return {"camera": p.camera.name, "k": f"{p.scale.k:.8g}", "calibration": digest[:16]}


PICTURE_SUFFIXES = (".exr", ".hdr")


def write_picture(path: Path, panorama: Panorama, view: str = "") -> None:
    """Write an .exr, or a Radiance .hdr of luminance or colour only, complete or not at all.

    view: Radiance's view options, for a picture that is not a panorama. A .hdr has the colour of
    `rgb` with the luminance of `luminance_cdm2`, of which NaN counts as not seen; the sun of a
    panorama is drawn in one pixel, because no line of the header can state it. Raises InputError
    for another suffix, OSError if the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in PICTURE_SUFFIXES:
        raise InputError(path, f"the suffix '{suffix}'", ".exr or .hdr", "correct the name")
    with replacing_path(path) as temporary:
        if suffix == ".exr":
            write_panorama(temporary, panorama, view=view or "equirect")
        else:
            from fieldlum.sky.sun_disc import add_source

            light, rgb, sun = panorama.luminance_cdm2, panorama.rgb, panorama.sun
            seen = panorama.seen & ~np.isnan(light)
            if sun is not None and not view:
                place = np.array([sun.altitude_deg]), np.array([sun.azimuth_deg])
                lx = np.array([sun.normal_illuminance_lx])
                nothing = np.zeros((1, *light.shape), np.float32)
                disc = add_source(nothing, place, lx, panorama.heading_deg)[0]
                light = np.where(disc > 0.0, np.nan_to_num(light) + disc, light)
                seen |= disc > 0.0  # the sun was measured, even if its pixel is not valid
            if rgb is not None:
                of_rgb = RADIANCE_LM_PER_W * (rgb @ np.asarray(RADIANCE_Y))
                grey = np.repeat(light[..., None] / RADIANCE_LM_PER_W, 3, axis=-1)
                factor = (light / np.where(of_rgb > 0.0, of_rgb, 1.0))[..., None]
                light = np.where(of_rgb[..., None] > 0.0, rgb * factor, grey)
            heading = None if view else panorama.heading_deg
            clipped = panorama.clipped_count
            about = {"view": view, "heading_deg": heading, "seen": seen, "clipped": clipped}
            write_radiance_hdr(temporary, light, **about)


def write_panorama(path: Path, panorama: Panorama, *, view: str = "equirect") -> None:
    """Write a float32 EXR with the channel Y and, if present, u, flags, R, G and B.

    Attributes: view, heading_deg, t_utc, sun and `Panorama.attributes`. view: Radiance's view
    options, for a picture that is not a panorama. Raises OSError if the file cannot be written.
    """
    import OpenEXR

    layers = {"Y": panorama.luminance_cdm2, "u": panorama.u_cdm2, "flags": panorama.flags}
    if panorama.rgb is not None:
        layers |= dict(zip("RGB", np.moveaxis(panorama.rgb, -1, 0), strict=True))
    present = {name: values for name, values in layers.items() if values is not None}
    channels = {name: np.ascontiguousarray(v, np.float32) for name, v in present.items()}
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "view": view,
        "heading_deg": f"{panorama.heading_deg:.6g}",
        **({"t_utc": records.utc_text(panorama.t_utc)} if panorama.t_utc else {}),
        **({"sun": _sun_text(panorama.sun)} if panorama.sun else {}),
        **{f"fieldlum:{key}": value for key, value in panorama.attributes.items()},
    }
    try:
        OpenEXR.File(header, channels).write(str(path))
    except RuntimeError as error:
        for number in errno.errorcode:  # of a full disk, for example
            if os.strerror(number).lower() in str(error).lower():
                raise OSError(number, os.strerror(number), str(path)) from None
        raise


def _sun_text(sun: SunSource) -> str:
    """Return the attribute `sun`: altitude, azimuth [deg], lx, visible fraction and origin."""
    light = f"{sun.normal_illuminance_lx:.6g} {sun.visible_fraction:.4f}"
    return f"{sun.altitude_deg:.4f} {sun.azimuth_deg:.4f} {light} {sun.origin or 'unknown'}"


def _sun_parse(text: str) -> SunSource:
    """Return the sun of a text that `_sun_text` wrote. Raises ValueError for another text."""
    *numbers, origin = text.split(maxsplit=4)
    altitude, azimuth, normal, fraction = map(float, numbers)
    return SunSource(altitude, azimuth, normal, visible_fraction=fraction, origin=origin)


# ----------------------------------------------------------------------------------------------
# reading EXR


# ITU-R BT.709, which OpenEXR assumes where a file has no attribute `chromaticities`.
_BT709_CHROMATICITIES = (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, 0.3127, 0.3290)
NO_UNIT = "the EXR states no unit (no whiteLuminance): its values are taken as cd/m2"


def read_panorama(path: Path, part: str = "") -> Panorama:
    """Read a panorama: an .exr or a Radiance .hdr that is twice as wide as high.

    part: name of the part, layer or stereo view of an .exr; "" for the only one. A file without a
    heading gets 180 (south). The file's view is not checked. Raises InputError for a missing or
    broken file, and for other shapes.
    """
    is_exr = path.suffix.lower() == ".exr"
    panorama = (read_exr(path, part) if is_exr else read_radiance_hdr(path))[0]
    require_panorama(panorama, path)
    return panorama


def require_panorama(panorama: Panorama, source: Path | str) -> None:
    """Raise InputError, which names `source`, for a map that is not twice as wide as high."""
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        found, expected = f"a map of {width} x {height} pixels", "a panorama twice as wide as high"
        raise InputError(source, found, expected, "use a map of all directions of such a shape")


def read_exr(path: Path, part: str = "") -> tuple[Panorama, str]:
    """Return a luminance picture and its view: ``equirect``, Radiance's view options, or "".

    part: name of the part, layer or stereo view to read; "" for the only one. The luminance is
    channel Y, or R, G and B weighted by the attribute chromaticities (BT.709 without it) times
    whiteLuminance (1 cd/m2 without it). Without a heading it gets 180 (south). For files of other
    programs `Panorama.attributes["note"]` states a missing unit, and other layers. Pixels outside
    of the data window are flagged as outside the lens.

    Raises InputError for a file that is no EXR, is missing, broken, too large, has neither Y nor R,
    G, B, or pixels that are not square, and for several pictures of which `part` names none.
    """
    headers = exr_headers(path)
    number, names, layer_note = _chosen(headers, part, path)
    header = headers[number]
    aspect = header.get("pixelAspectRatio", 1.0)
    if isinstance(aspect, float) and aspect > 0.0 and abs(aspect - 1.0) > 0.01:
        found, remedy = f"pixels {aspect:g} times as wide as high", "resample the picture"
        raise InputError(path, found, "square pixels", remedy)
    channels = _channels(path, number, names, header)
    luminance, unit_note = _luminance(channels, header, path)
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1) if set("RGB") <= set(channels) else None
    flags = channels["flags"].astype(np.uint16) if "flags" in channels else None
    # OpenEXR returns a damaged attribute as bytes of unknown type.
    expected = "attributes as fieldlum writes them"
    remedy = "merge the panorama again, or copy the file again"
    with input_errors(path, expected, remedy, ValueError, TypeError, AttributeError):
        attributes = {
            str(key).removeprefix("fieldlum:"): str(value)
            for key, value in header.items()
            if str(key).startswith("fieldlum:")
        }
        # OpenEXR itself names the view of a stereo picture in this attribute, such as "left".
        view, heading = str(header.get("view", "")), _stated_heading(header)
        heading = 180.0 if heading is None else heading
        t_utc = records.parse_utc(header["t_utc"]) if header.get("t_utc") else None
        sun = _sun_parse(header["sun"]) if header.get("sun") else None
        more = (flags, t_utc, sun, rgb, attributes)
        panorama = Panorama(luminance, heading, channels.get("u"), *more)
        weights = np.array(attributes.get(melanopic.ATTRIBUTE, "0 0 0 0").split(), float)
        numbers = (heading, *panorama.shared_u_rel.values(), *weights.reshape(4))
        if not np.isfinite(numbers).all():
            raise ValueError("an attribute with a number that is not finite")
    if note := "; ".join(filter(None, (unit_note, layer_note))):
        attributes["note"] = note
    view = "equirect" if PANORAMA_VIEW.fullmatch(view) else view
    has_view = view.startswith(("equirect", "-v", "VIEW=", "rvu "))
    return panorama, view if has_view else ""


def _stated_heading(header: Mapping[str, Any]) -> float | None:
    """Return the heading [deg] in the attributes of an .exr, also in those of another program.

    It is `heading_deg`, else that in the text of `view`; None without both. Raises ValueError or
    TypeError for a damaged one.
    """
    if "heading_deg" in header:
        return float(header["heading_deg"])
    stated = PANORAMA_VIEW.fullmatch(str(header.get("view", "")))
    return float(stated[1]) if stated else None


def stated_heading_deg(path: Path) -> float | None:
    """Return the heading that a panorama's .exr or .hdr states, None if it states none.

    It is the azimuth of the centre column, clockwise from north. Raises InputError or OSError for a
    file that cannot be read.
    """
    if path.suffix.lower() == ".exr":
        with input_errors(path, "a heading_deg", "merge it again", ValueError, TypeError):
            return _stated_heading(exr_headers(path)[0])
    with open_to_read(path) as file:
        return _read_header(file, path).heading_deg


class _OwnOutput(io.StringIO):
    """An output that collects what one thread prints; other threads print to the former output."""

    def __init__(self) -> None:
        super().__init__()
        self._thread, self._output = threading.get_ident(), sys.stdout

    def write(self, text: str, /) -> int:
        """Collect the text of the thread that created this output, and print that of others."""
        is_own = threading.get_ident() == self._thread
        return super().write(text) if is_own else self._output.write(text)


@contextmanager
def opened_exr(path: Path, **how: bool) -> Iterator[Any]:
    """Yield the OpenEXR.File of a path; how: keyword arguments of its constructor.

    Raises OSError for a file that cannot be opened, ValueError for one that is no EXR, and with the
    cause for one that is broken. OpenEXR would print the cause, in the middle of what a command
    prints: while it opens the file, stderr of the process and stdout of this thread are collected,
    one thread at a time.
    """
    import OpenEXR

    with open_to_read(path) as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError("not an OpenEXR file")
    try:
        # One thread at a time, because standard output is one for all.
        with library_messages("(EXR_ERR"), redirect_stdout(_OwnOutput()) as printed:
            exr = OpenEXR.File(str(path), **how)
        if cause := printed.getvalue().removeprefix("Warning: ").strip():
            raise ValueError(cause)
    except Exception as error:
        raise ValueError(f"broken EXR ({error})".replace("\n", " ")) from None
    with exr:
        yield exr


_COMPLETE = ("a complete EXR", "copy the file again")


def exr_headers(path: Path) -> list[dict[str, Any]]:
    """Return the attributes of each part of an .exr, with the names of its channels as `channels`.

    Raises InputError for a file that is missing, broken or no EXR, and for one with too many pixels
    to be decoded.
    """
    remedy = "check the path of the picture, and which program wrote it"
    with (
        input_errors(path, "a complete .exr picture", remedy, Exception),  # of OpenEXR
        opened_exr(path, header_only=True) as exr,
    ):
        headers = [
            {**part.header, "channels": [c.name for c in part.header["channels"]]}
            for part in exr.parts
        ]
    _check_size(headers, path)
    return headers


def _window(header: Mapping[str, Any], name: str) -> tuple[int, int, int, int]:
    """Return top, left, and the row and column after the last [px] of a window of an .exr.

    header: attributes of a part; name: dataWindow (the stored pixels) or displayWindow (the
    picture).
    """
    (x0, y0), (x1, y1) = header[name]
    return int(y0), int(x0), int(y1) + 1, int(x1) + 1


def _check_size(headers: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Raise InputError for more values than `_max_values`, before anything is decoded.

    headers: of each part of an .exr. All parts count, because OpenEXR decodes all of them.
    """
    maximum = _max_values(path, *_EXR_VALUES)
    for header, name in ((h, name) for h in headers for name in ("dataWindow", "displayWindow")):
        with input_errors(path, *_COMPLETE, KeyError, TypeError, ValueError):
            top, left, bottom, right = _window(header, name)
        count = max(1, len(header["channels"])) * len(headers)
        height, width = bottom - top, right - left
        if min(width, height) < 1 or width * height * count > maximum:
            finding = f"{width} x {height} pixels of {count} channels"
            expected = f"at most {maximum:,} values in a file of this size"
            raise InputError(path, finding, expected, "reduce the picture")


def _channels(
    path: Path, part: int, names: Mapping[str, str], header: Mapping[str, Any]
) -> dict[str, Floats32]:
    """Return the channels [H, W] of a picture, on its display window, by their plain name.

    part: its number; header: of this part; names: plain name by the name in the file. Pixels
    without data are NaN, and get a flag.
    """
    with (
        input_errors(path, *_COMPLETE, Exception),  # of OpenEXR
        opened_exr(path, separate_channels=True) as exr,
    ):
        of_part = exr.parts[part].channels
        channels = {
            plain_name: np.asarray(of_part[name].pixels).astype(np.float32, copy=False)
            for name, plain_name in names.items()
        }
    # top, left, bottom, right
    data, display = (np.array(_window(header, name)) for name in ("dataWindow", "displayWindow"))
    if (data == display).all():
        return channels
    first = np.maximum(data[:2], display[:2])  # row and column of what both windows contain
    last = np.maximum(first, np.minimum(data[2:], display[2:]))
    in_data = tuple(map(slice, first - data[:2], last - data[:2]))
    in_display = tuple(map(slice, first - display[:2], last - display[:2]))
    channels.setdefault("flags", np.zeros(data[2:] - data[:2], np.float32))
    for name, values in channels.items():
        empty = Flag.OUTSIDE_LENS if name == "flags" else np.nan
        channels[name] = np.full(display[2:] - display[:2], empty, np.float32)
        channels[name][in_display] = values[in_data]
    return channels


def _luminance(
    channels: Mapping[str, Floats32], header: Mapping[str, Any], path: Path
) -> tuple[Floats32, str]:
    """Return the luminance [H, W] in cd/m2, and a note if the file does not state its unit.

    channels: by plain name, [H, W] each. A header with a key "fieldlum:..." or "heading_deg" is of
    a file that fieldlum wrote, so that Y is in cd/m2.
    """
    white = header.get("whiteLuminance")
    white = white if isinstance(white, int | float) and 0 < white < np.inf else None
    scale = float(white or 1.0)
    by_fieldlum = any(str(key).startswith("fieldlum:") or key == "heading_deg" for key in header)
    note = "" if by_fieldlum or white else NO_UNIT
    stated = channels["Y"] * np.float32(scale) if "Y" in channels else None
    if stated is not None and (by_fieldlum or "R" not in channels):
        return stated, note
    expected = "chromaticities as x and y of R, G, B and white"
    remedy = "write the picture again with a correct attribute, or without it"
    with input_errors(path, expected, remedy, TypeError, ValueError):
        weights = rgb_to_xyz(tuple(header.get("chromaticities", _BT709_CHROMATICITIES)))[1]
    luminance = np.zeros_like(channels["R"])
    with np.errstate(invalid="ignore"):  # of infinite pixels, which are refused where they count
        for name, weight in zip("RGB", weights * scale, strict=True):
            luminance += channels[name] * np.float32(weight)
    if stated is not None and np.nanmedian(abs(stated - luminance)) > 0.01 * np.nanmean(luminance):
        finding = "channel Y is not the luminance of R, G and B"
        raise InputError(path, finding, "one luminance", "write only Y, or only R, G and B")
    return luminance, note


# ----------------------------------------------------------------------------------------------
# one picture of an EXR file that has several parts, layers or views


def _chosen(
    headers: Sequence[Mapping[str, Any]], name: str, path: Path
) -> tuple[int, Mapping[str, str], str]:
    """Return part and channels of the picture with this name, or of the only one, and a note.

    headers: of each part of an .exr; name: of the part, layer or view, "" for the only one. The
    channels are plain name by the name in the file. Plain channels are the picture of a file with
    one part: the note, else "", names layers next to them. Raises InputError, with the names, if
    several parts, layers or views could be meant, if there is no such name, and for a file without
    a flat picture with Y or R, G, B.
    """
    pictures = {title: (part, channels) for title, part, channels in _pictures(headers)}
    remedy = "name one with --part NAME (glare, view, info), or write only that picture"
    if not pictures:
        shown = ", ".join(sorted({c for header in headers for c in header["channels"]}))[:120]
        finding = f"{'deep data, ' if any(map(_is_deep, headers)) else ''}channels {shown}"
        expected = "a channel Y in cd/m2, or R, G and B, of one flat layer"
        raise InputError(path, finding, expected, "write only that layer")
    listed = ", ".join(title or "(plain channels)" for title in pictures)[:200]
    if name and name not in pictures:
        finding = f"no flat picture with luminance in a part {name[:80]}"
        remedy = remedy if any(pictures) else "omit --part"
        raise InputError(path, finding, f"one of {listed}", remedy)
    part, channels = pictures.get(name) or next(iter(pictures.values()))
    if name or len(headers) == len(pictures) == 1:
        return part, channels, ""
    views = _stereo_views(headers[0])
    kind, names = "views" if views else "layers", list(pictures)
    if len(headers) > 1:
        kind, names = "parts", [str(header.get("name", "")) for header in headers]
    elif len(views) < 2 and "." not in next(iter(channels)):
        others = ", ".join(names[1:])[:200]
        note = f"the plain channels are read; the EXR has further layers: {others}"
        return part, channels, note
    finding = f"{len(names)} {kind}: {', '.join(names)[:200]}"
    raise InputError(path, finding, f"one of {listed}", remedy)


def _stereo_views(header: Mapping[str, Any]) -> list[str]:
    """Return the names of the views of a stereo part; the plain channels are the first one."""
    stated = header.get("multiView")
    return [str(view) for view in stated] if isinstance(stated, list | tuple) else []


def _is_deep(header: Mapping[str, Any]) -> bool:
    """Return whether a part's pixels have several samples at several depths."""
    return "deep" in str(header.get("type", "")).lower()


def _pictures(headers: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, int, Mapping[str, str]]]:
    """Yield name, part and channels of each flat picture; a part's plain channels come first.

    name: of part, layer or view; "" for plain channels of a file with one part without a name.
    channels: plain name, such as R, by the name in the file.
    """
    several = len(headers) > 1
    for part, header in enumerate(headers):
        names = [] if _is_deep(header) else header["channels"]
        prefixes = sorted({name[: name.rfind(".") + 1] for name in names})
        layers = [prefix for prefix in prefixes if _is_picture(prefix, names)]
        for prefix in layers:
            layer = prefix.rstrip(".") or next(iter(_stereo_views(header)), "")
            part_name = str(header.get("name", "")) if several or not layer else ""
            if several and len(layers) == 1:
                layer = ""
            plain = ("Y", "R", "G", "B") if prefix else ("Y", "R", "G", "B", "u", "flags")
            channels = {f"{prefix}{c}": c for c in plain if f"{prefix}{c}" in names}
            yield ".".join(filter(None, (part_name, layer))), part, channels


def _is_picture(prefix: str, names: Sequence[str]) -> bool:
    """Return whether a layer has the channels R, G, B, or a luminance Y.

    prefix: of the layer's names, such as "glare."; "" for plain channels; names: of the part's
    channels. X, Y, Z of a layer are a position or a normal; without a layer they are CIE XYZ.
    """
    has_y = f"{prefix}Y" in names and (not prefix or f"{prefix}X" not in names)
    return has_y or all(f"{prefix}{c}" in names for c in "RGB")
