"""Read Radiance pictures (RGBE, XYZE) through Radiance's own pvalue, and write RGBE.

pvalue decodes flat, new and old run-length scanlines. It runs as a separate process, so that a
damaged file cannot crash this one. It receives the pixels behind a plain header: exposure,
primaries and orientation are applied here.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError, input_errors

# Radiance's own white efficacy (WHTEFFICACY of src/common/color.h), in lm/W: neither 683 nor a
# luminous efficacy of daylight.
RADIANCE_LM_PER_W = 179.0
# Luminance of Radiance's primaries (Ward Larson and Shakespeare 1998).
RADIANCE_Y = (0.265, 0.670, 0.065)
# Its primaries, red, green, blue and white, as CIE xy (src/common/color.h).
RADIANCE_CHROMATICITIES = (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 1.0 / 3.0, 1.0 / 3.0)
PANORAMA_LINE = "FIELDLUM_VIEW= equirect heading_deg="
# 12 bytes a pixel: 1.9 GB. The largest pictures in use, panoramas of 16k x 8k, have 134 million.
MAX_PIXELS = 160_000_000
_RESOLUTION = re.compile(rb"\s*([+-])([XY])\s+(\d+)\s+([+-])([XY])\s+(\d+)\s*")
_RGBE, _XYZE = "32-bit_rle_rgbe", "32-bit_rle_xyze"


@dataclass(frozen=True, slots=True)
class RadianceHeader:
    """The content of a picture's header.

    axes, counts : order of the pixels in the file, such as "-Y" and "+X", and their counts.
    exposure : [3], by which the decoded channels must be divided. chromaticities : x, y of red,
    green, blue and white, [8]. xyze : whether the pixels are XYZ. views : the picture's own VIEW
    lines in order; inherited_views : those of its input pictures. heading_deg : of a panorama, else
    None. pixel_aspect : height over width of a pixel.
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

    @property
    def view(self) -> str:
        """Radiance's view options of the picture, else those its input pictures agree on, or ""."""
        if self.views:
            return " ".join(self.views)
        return self.inherited_views[0] if len(set(self.inherited_views)) == 1 else ""

    @property
    def view_is_inherited(self) -> bool:
        """Whether the view is stated only by an input picture."""
        return not self.views and bool(self.view)

    @property
    def cdm2_per_unit(self) -> Floats:
        """Luminance in cd/m2 of one unit of each decoded channel, [3], with exposure undone.

        XYZE has Y in cd/m2, because ra_xyze writes EXPOSURE = 1 / 179 for W/sr/m2.
        """
        if self.xyze:
            return np.array([0.0, 1.0, 0.0]) / self.exposure
        # programs write chromaticities to three decimals
        own = np.allclose(self.chromaticities, RADIANCE_CHROMATICITIES, rtol=0.0, atol=5e-4)
        weights = np.asarray(RADIANCE_Y) if own else luminance_weights(self.chromaticities)
        return RADIANCE_LM_PER_W * weights / self.exposure

    def upright(self, pixels: Floats32) -> Floats32:
        """Return pixels in file order [first, second, ...] as an upright picture [H, W, ...]."""
        axes = self.axes
        if axes[0][1] == "X":
            pixels, axes = pixels.swapaxes(0, 1), (axes[1], axes[0])
        rows = slice(None, None, -1) if axes[0] == "+Y" else slice(None)
        columns = slice(None, None, -1) if axes[1] == "-X" else slice(None)
        return np.ascontiguousarray(pixels[rows, columns])


@dataclass(frozen=True, slots=True)
class RadianceImage:
    """A Radiance picture.

    rgb : [H, W, 3] W/sr/m2, upright, with EXPOSURE and COLORCORR undone, in the file's own
    primaries (for XYZE, in Radiance's). luminance_cdm2 : [H, W].
    """

    rgb: Floats32
    luminance_cdm2: Floats32
    header: RadianceHeader


# ----------------------------------------------------------------------------------------------
# primaries


def rgb_to_xyz(chromaticities: Sequence[float]) -> Floats:
    """Return the matrix from RGB to XYZ with Y = 1 for R = G = B = 1, [3, 3].

    chromaticities : x, y of red, green, blue and white, [8]. A primary need not be a real colour:
    blue of ACES AP0 has y = -0.077 (SMPTE ST 2065-1). Raises ValueError for values that are not
    finite, a y of 0, and a white that is not between the primaries.
    """
    if len(chromaticities) != 8:
        raise ValueError(f"{len(chromaticities)} numbers in place of 8")
    xy = np.asarray(chromaticities, float).reshape(4, 2)
    if not np.isfinite(xy).all() or (xy[:, 1] == 0).any():
        raise ValueError("chromaticities must be finite numbers with y other than 0")
    corners = np.vstack([xy[:3].T, np.ones(3)])  # [3, 3]
    if abs(float(np.linalg.det(corners))) < 1e-4:
        raise ValueError("the three primaries are on one line")
    if (np.linalg.solve(corners, [*xy[3], 1.0]) <= 0).any():
        raise ValueError("white is not between the three primaries")
    xyz = np.stack([xy[:, 0], xy[:, 1], 1.0 - xy.sum(axis=1)], axis=1) / xy[:, 1:]  # [4, 3]
    columns = xyz[:3].T  # [3, 3]
    return columns * np.linalg.solve(columns, xyz[3])


def luminance_weights(chromaticities: Sequence[float]) -> Floats:
    """Return the shares of R, G and B in luminance, with sum 1, [3].

    The share of a primary that is no real colour may be negative. Raises the errors of
    `rgb_to_xyz`.
    """
    return rgb_to_xyz(chromaticities)[1]


# ----------------------------------------------------------------------------------------------
# reading


def radiance_program(name: str) -> str:
    """Return the path of a program of Radiance in the wheel of pyradiance, such as ``pvalue``."""
    from pyradiance.anci import BINPATH

    return str(Path(BINPATH) / name)


def read_radiance_hdr(path: Path) -> RadianceImage:
    """Read a Radiance picture. Raises InputError for any other file, or damaged pixels."""
    remedy = "check the path and the permissions of the picture"
    with input_errors(path, "a readable file", remedy, OSError):
        if path.exists() and not path.is_file():
            raise InputError(path, "no regular file", "a Radiance .hdr picture", remedy)
        with path.open("rb") as file:
            header = _read_header(file, path)
            values = header.upright(_decoded(file, header, path))  # [H, W, 3]
    luminance = values @ header.cdm2_per_unit.astype(np.float32)
    rgb = np.divide(values, header.exposure, out=np.empty_like(values), casting="same_kind")
    if header.xyze:
        to_rgb = np.linalg.inv(rgb_to_xyz(RADIANCE_CHROMATICITIES)) / RADIANCE_LM_PER_W  # [3, 3]
        rgb = rgb @ to_rgb.T.astype(np.float32)
    return RadianceImage(rgb, luminance, header)


def _decoded(file: BinaryIO, header: RadianceHeader, path: Path) -> Floats32:
    """Return the channels [scanlines, pixels, 3], in file order, before exposure is undone."""
    scanlines, width = header.counts
    plain = f"#?RADIANCE\nFORMAT={_RGBE}\n\n-Y {scanlines} +X {width}\n".encode()
    command = [radiance_program("pvalue"), "-h", "-H", "-df"]
    result = subprocess.run(command, input=plain + file.read(), capture_output=True, check=False)
    count = len(result.stdout) // (12 * width)
    if count < scanlines:
        finding = f"the pixels are damaged, or end after scanline {count} of {scanlines}"
        remedy = "copy the file again, because it is cut short"
        raise InputError(path, finding, f"{scanlines} scanlines of Radiance pixels", remedy)
    values = np.frombuffer(result.stdout, np.float32, 3 * scanlines * width)
    # Infinity is written as 1e30, and single precision ends at 3e38. [W/sr/m2]
    largest, brightest = float(values.max()), 2e30 * float(header.exposure.min())
    if not largest <= brightest:
        expected = f"at most {brightest:.3g}"
        remedy = "copy the file again, because it is damaged"
        raise InputError(path, f"a pixel value of {largest:.3g}", expected, remedy)
    return values.reshape(scanlines, width, 3)


# ----------------------------------------------------------------------------------------------
# the header


def _read_header(file: BinaryIO, path: Path) -> RadianceHeader:
    """Read the header, up to the first byte of the pixels."""
    lines = _header_lines(file, path)
    formats = [line[7:].strip() for line in lines if line.startswith("FORMAT=")]
    if not lines[0].startswith("#?") and not formats:
        raise _not_radiance(path)
    kind = formats[-1] if formats else _RGBE
    if kind not in (_RGBE, _XYZE):
        remedy = "convert it by rcomb -fc -c RGB IN > OUT (spectra), or rmtxop -fc IN > OUT.hdr"
        raise InputError(path, f"pixel format {kind[:40]}", "Radiance RGBE or XYZE", remedy)
    axes, counts = _resolution(file.readline(200), path)
    marks = [line for line in lines if line.startswith(PANORAMA_LINE)]
    return RadianceHeader(
        axes,
        counts,
        kind == _XYZE,
        _product(lines, "EXPOSURE=", 1, path) * _product(lines, "COLORCORR=", 3, path),
        _chromaticities(lines, path),
        _views(lines),
        _views([line.lstrip("\t ") for line in lines if line[:1] in "\t "]),
        _heading(marks[-1], path) if marks else None,
        float(_product(lines, "PIXASPECT=", 1, path)[0]),
    )


def _not_radiance(path: Path) -> InputError:
    remedy = "check which program wrote the file"
    return InputError(path, "no Radiance header", "a Radiance .hdr picture", remedy)


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    """Return the lines up to the first empty one; a header of over 4 MB is damaged."""
    lines: list[str] = []
    while line := file.readline(4_000_000):
        text = line.decode("latin-1").rstrip("\r\n")
        if not line.endswith(b"\n") or file.tell() > 4_000_000 or (not lines and b"\0" in line):
            break
        if not text and lines:
            return lines
        if text or lines:
            lines.append(text)
    raise _not_radiance(path)


def _resolution(line: bytes, path: Path) -> tuple[tuple[str, str], tuple[int, int]]:
    """Return the axes and their counts in the line before the pixels."""
    match = _RESOLUTION.fullmatch(line)
    if match is None or match[2] == match[5]:
        finding = f"resolution line {line[:40].decode('latin-1').strip()!r}"
        remedy = "copy the file again, because it is damaged"
        raise InputError(path, finding, "two axes and their pixels, such as -Y 800 +X 800", remedy)
    counts = (int(match[3]), int(match[6]))
    if not 0 < counts[0] * counts[1] <= MAX_PIXELS:
        expected = f"1 to {MAX_PIXELS:,} pixels"
        remedy = "reduce it with Radiance's pfilt -1 -x 4000 -y 4000, or copy the file again"
        raise InputError(path, f"{counts[1]} x {counts[0]} pixels", expected, remedy)
    return ((match[1] + match[2]).decode(), (match[4] + match[5]).decode()), counts


def _product(lines: Sequence[str], key: str, count: int, path: Path) -> Floats:
    """Return the product of the values of all lines that begin with `key`, [count].

    Zeros, which FreeImage writes as EXPOSURE, count as no line. Raises InputError for other values
    that are not finite numbers above 0.
    """
    total = np.ones(count)
    for line in lines:
        if not line.startswith(key):
            continue
        row, words = np.full(count, np.nan), line[len(key) :].split()[:count]
        with suppress(ValueError):
            row[: len(words)] = [float(word) for word in words]
        if not row.any():
            continue
        total = total * row
        if not (np.isfinite(total).all() and (row > 0).all() and (total > 0).all()):
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
        luminance_weights(values)
    return values


def _views(lines: Sequence[str]) -> tuple[str, ...]:
    return tuple(line[5:].strip() for line in lines if line.startswith("VIEW="))


def _heading(line: str, path: Path) -> float:
    words = line.removeprefix(PANORAMA_LINE).split()
    with suppress(ValueError, IndexError):
        if np.isfinite(heading := float(words[0])):
            return heading
    expected = f"{PANORAMA_LINE} and a number"
    raise InputError(path, repr(line)[:80], expected, "correct the header line")


# ----------------------------------------------------------------------------------------------
# writing


def encode_rgbe(rgb: Floats) -> NDArray[np.uint8]:
    """Encode RGB with a shared exponent (RGBE): floats [..., 3] become bytes [..., 4].

    Mantissas are truncated, because Radiance decodes (mantissa + .5) / 256.
    """
    values = np.maximum(np.nan_to_num(np.asarray(rgb, np.float64), posinf=1e30), 0.0)
    largest = values.max(axis=-1)
    fraction, exponent = np.frexp(largest)
    alive = largest > 1e-32
    scale = np.divide(fraction * 256.0, largest, out=np.zeros_like(largest), where=alive)
    out = np.zeros((*largest.shape, 4), np.uint8)
    out[..., :3] = np.minimum(values * scale[..., None], 255.0)
    out[..., 3] = np.where(alive, np.clip(exponent + 128, 1, 255), 0)
    return out


def write_radiance_hdr(
    path: Path,
    pixels: Floats,
    *,
    view: str = "",
    heading_deg: float | None = None,
    header: tuple[str, ...] = (),
) -> None:
    """Write cd/m2 [H, W] or radiance RGB [H, W, 3] in W/sr/m2 as a Radiance picture (flat RGBE).

    view : view options of Radiance, such as "-vta -vh 180 -vv 180"; a panorama has heading_deg
    instead; header : further lines.
    """
    values = np.asarray(pixels)
    height, width = values.shape[:2]
    lines = ["#?RADIANCE", *header]
    if heading_deg is not None:
        lines.append(f"{PANORAMA_LINE}{heading_deg:.6g}")
    if view:
        lines.append(f"VIEW= {view}")
    lines += ["EXPOSURE=1", f"FORMAT={_RGBE}", ""]
    step = max(1, 500_000 // width)  # limits memory
    with path.open("wb") as file:
        file.write(("\n".join(lines) + f"\n-Y {height} +X {width}\n").encode())
        for first in range(0, height, step):
            rows = values[first : first + step]
            if rows.ndim == 2:
                rows = np.repeat(rows[..., None] / RADIANCE_LM_PER_W, 3, axis=-1)
            file.write(encode_rgbe(rows).tobytes())
