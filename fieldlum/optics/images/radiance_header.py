"""Parse the header of a Radiance picture: format, exposure, primaries, view, orientation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError
from fieldlum.optics.images.primaries import (
    RADIANCE_CHROMATICITIES,
    luminance_weights,
    same_chromaticities,
)

# Radiance's own white efficacy (WHTEFFICACY of src/common/color.h), in lm/W: neither 683 nor a
# luminous efficacy of daylight.
RADIANCE_LM_PER_W = 179.0
# Luminance of Radiance's primaries (Ward Larson and Shakespeare 1998).
RADIANCE_Y = (0.265, 0.670, 0.065)
PANORAMA_LINE = "FIELDLUM_VIEW= equirect heading_deg="
# 12 bytes a pixel: 1.9 GB. The largest pictures in use, panoramas of 16k x 8k, have 134 million.
# Chosen.
MAX_PIXELS = 160_000_000
# A longer header is damaged: a year of pcomb and pcompos lines has a few thousand bytes. Chosen.
_MAX_HEADER_BYTES = 4_000_000
_RESOLUTION = re.compile(rb"\s*([+-])([XY])\s+(\d+)\s+([+-])([XY])\s+(\d+)\s*")
_FORMATS = ("32-bit_rle_rgbe", "32-bit_rle_xyze")
_CONVERT = {
    "Radiance_spectra": "convert it with Radiance's rcomb: rcomb -fc -c RGB IN > OUT",
    "float": "convert it with Radiance's rmtxop: rmtxop -fc IN > OUT.hdr",
    "double": "convert it with Radiance's rmtxop: rmtxop -fc IN > OUT.hdr",
    "ascii": "convert it with Radiance's rmtxop: rmtxop -fc IN > OUT.hdr",
}


@dataclass(frozen=True, slots=True)
class Resolution:
    """The order of pixels in a Radiance file: two axes, such as "-Y" and "+X", and their counts."""

    axes: tuple[str, str]
    counts: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the upright picture."""
        first, second = self.counts
        return (first, second) if self.axes[0][1] == "Y" else (second, first)

    def upright(self, pixels: Floats32) -> Floats32:
        """Return pixels in file order [first, second, ...] as an upright picture [H, W, ...]."""
        axes = self.axes
        if axes[0][1] == "X":
            pixels = pixels.swapaxes(0, 1)
            axes = (axes[1], axes[0])
        rows = slice(None, None, -1) if axes[0] == "+Y" else slice(None)
        columns = slice(None, None, -1) if axes[1] == "-X" else slice(None)
        return np.ascontiguousarray(pixels[rows, columns])


@dataclass(frozen=True, slots=True)
class RadianceHeader:
    """The content of a picture's header.

    exposure : [3], by which the decoded channels must be divided. chromaticities : x, y of red,
    green, blue and white, [8]. xyze : whether the pixels are XYZ. views : the picture's own VIEW
    lines in order; inherited_views : those of its input pictures. heading_deg : of a panorama, else
    None. pixel_aspect : height over width of a pixel. start : position of the first byte of pixels.
    """

    lines: tuple[str, ...]
    resolution: Resolution
    xyze: bool
    exposure: Floats
    chromaticities: tuple[float, ...]
    views: tuple[str, ...]
    inherited_views: tuple[str, ...]
    heading_deg: float | None
    pixel_aspect: float
    start: int

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
        weights = (
            np.asarray(RADIANCE_Y)
            if same_chromaticities(self.chromaticities, RADIANCE_CHROMATICITIES)
            else luminance_weights(self.chromaticities)
        )
        return RADIANCE_LM_PER_W * weights / self.exposure


def read_header(file: BinaryIO, path: Path) -> RadianceHeader:
    """Read the header, up to the first byte of the pixels.

    Raises InputError for a file that is no Radiance picture or has an unusable header.
    """
    lines = _header_lines(file, path)
    formats = [line[7:].strip() for line in lines if line.startswith("FORMAT=")]
    if not lines[0].startswith("#?") and not formats:
        raise _not_radiance(path)
    kind = formats[-1] if formats else _FORMATS[0]
    if kind not in _FORMATS:
        remedy = _CONVERT.get(kind, "convert it to Radiance RGBE or XYZE")
        raise InputError(path, f"pixel format {kind[:40]}", "Radiance RGBE or XYZE", remedy)
    resolution = _resolution(file.readline(200), path)
    marks = [line for line in lines if line.startswith(PANORAMA_LINE)]
    return RadianceHeader(
        lines=tuple(lines[1:] if lines[0].startswith("#?") else lines),
        resolution=resolution,
        xyze=kind == _FORMATS[1],
        exposure=_exposure(lines, path),
        chromaticities=_chromaticities(lines, path),
        views=tuple(_view_texts(lines)),
        inherited_views=tuple(_view_texts([x.lstrip("\t ") for x in lines if x[:1] in "\t "])),
        heading_deg=_heading(marks[-1], path) if marks else None,
        pixel_aspect=float(np.prod(_numbers(lines, "PIXASPECT=", 1, path))),
        start=file.tell(),
    )


def _not_radiance(path: Path) -> InputError:
    return InputError(
        path,
        "no Radiance header",
        "a Radiance .hdr picture",
        "check which program wrote the file",
    )


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    lines: list[str] = []
    size = 0
    while True:
        line = file.readline(_MAX_HEADER_BYTES)
        size += len(line)
        if not line.endswith(b"\n") or size > _MAX_HEADER_BYTES or (not lines and b"\0" in line):
            raise _not_radiance(path)
        text = line.decode("latin-1").rstrip("\r\n")
        if not text and lines:
            return lines
        if text or lines:
            lines.append(text)


def _resolution(line: bytes, path: Path) -> Resolution:
    match = _RESOLUTION.fullmatch(line)
    axes = (match[1] + match[2], match[4] + match[5]) if match else (b"", b"")
    if match is None or axes[0][1:] == axes[1][1:]:
        shown = line[:40].decode("latin-1").strip()
        raise InputError(
            path,
            f"resolution line {shown!r}",
            "two axes and their pixels, such as -Y 800 +X 800",
            "copy the file again, because it is damaged",
        )
    counts = (int(match[3]), int(match[6]))
    if not 0 < counts[0] * counts[1] <= MAX_PIXELS:
        raise InputError(
            path,
            f"{counts[1]} x {counts[0]} pixels",
            f"1 to {MAX_PIXELS:,} pixels",
            "reduce it with Radiance's pfilt -1 -x 4000 -y 4000, or copy the file again",
        )
    return Resolution((axes[0].decode(), axes[1].decode()), counts)


def _numbers(lines: Sequence[str], key: str, count: int, path: Path) -> Floats:
    """Return the values of all lines that begin with `key`, [lines, count]; all must be above 0.

    Zeros, which FreeImage writes as EXPOSURE, count as no line.
    """
    rows = []
    for line in lines:
        if not line.startswith(key):
            continue
        try:
            row = [float(word) for word in line[len(key) :].split()[:count]]
        except ValueError:
            row = []
        if len(row) == count and not any(row):
            continue
        if len(row) != count or not all(np.isfinite(v) and v > 0 for v in row):
            raise InputError(
                path,
                repr(line)[:80],
                f"{key} and {'a number' if count == 1 else f'{count} numbers'} above 0",
                "correct the header line",
            )
        rows.append(row)
    return np.asarray(rows, float).reshape(-1, count)


def _exposure(lines: Sequence[str], path: Path) -> Floats:
    """Return the product of all EXPOSURE and COLORCORR lines, [3]."""
    exposure = float(np.prod(_numbers(lines, "EXPOSURE=", 1, path)))
    total = np.prod(_numbers(lines, "COLORCORR=", 3, path), axis=0) * exposure  # [3]
    if not (np.isfinite(total).all() and (total > 0).all()):
        raise InputError(
            path,
            f"EXPOSURE and COLORCORR lines with the product {total}",
            "finite numbers above 0",
            "correct these header lines",
        )
    return total


def _chromaticities(lines: Sequence[str], path: Path) -> tuple[float, ...]:
    """Return the eight numbers of the last PRIMARIES line, or Radiance's own primaries.

    Adobe Photoshop writes eight zeros; they count as no line.
    """
    stated = [line[10:] for line in lines if line.startswith("PRIMARIES=")]
    if not stated or not stated[-1].replace("0", "").replace(".", "").strip():
        return RADIANCE_CHROMATICITIES
    try:
        values = tuple(float(word) for word in stated[-1].split())
        if len(values) != 8:
            raise ValueError(f"{len(values)} numbers")
        luminance_weights(values)
    except ValueError as error:
        raise InputError(
            path,
            f"PRIMARIES= {stated[-1].strip()[:60]!r} ({error})",
            "x and y of red, green, blue and white",
            "correct the header line, or remove it for Radiance's own primaries",
        ) from None
    return values


def _view_texts(lines: Sequence[str]) -> list[str]:
    return [line[5:].strip() for line in lines if line.startswith("VIEW=")]


def _heading(line: str, path: Path) -> float:
    try:
        heading = float((line.removeprefix(PANORAMA_LINE).split() or [""])[0])
    except ValueError:
        heading = np.nan
    if not np.isfinite(heading):
        raise InputError(
            path, repr(line)[:80], f"{PANORAMA_LINE} and a number", "correct the header line"
        )
    return heading
