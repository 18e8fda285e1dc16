"""Radiance pictures: RGBE and XYZE in through Radiance's own pvalue, RGBE out.

pvalue decodes flat, new and old run-length scanlines; it runs as a process of its own, so that a
damaged file cannot harm this one. It is given the pixels behind a plain header: exposure, primaries
and orientation are applied here (`radiance_header`).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import IO, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.images.primaries import RADIANCE_CHROMATICITIES, rgb_to_xyz
from fieldlum.images.programs import radiance_program
from fieldlum.images.radiance_header import (
    PANORAMA_LINE,
    RADIANCE_LM_PER_W,
    RADIANCE_Y,
    RadianceHeader,
    read_header,
)
from fieldlum.records import Float

# W/sr/m2; the value written for infinity is 1e30, and single precision ends at 3e38
_BRIGHTEST = 2e30
_BLOCK_PIXELS = 500_000  # decoded at a time: 6 MB


@dataclass(frozen=True, slots=True)
class RadianceImage:
    """rgb : [H, W, 3] W/sr/m2, upright, with EXPOSURE and COLORCORR undone, in the file's own
    primaries (XYZE: in Radiance's). header : its lines. view : the text after VIEW=, or "".
    cdm2_per_unit : [3] luminance of one unit of R, G and B.
    """

    rgb: NDArray[np.float32]
    header: tuple[str, ...] = ()
    view: str = ""
    heading_deg: float | None = None  # set when a header line says that this is a panorama
    cdm2_per_unit: tuple[float, float, float] = (
        RADIANCE_LM_PER_W * RADIANCE_Y[0],
        RADIANCE_LM_PER_W * RADIANCE_Y[1],
        RADIANCE_LM_PER_W * RADIANCE_Y[2],
    )

    @property
    def luminance_cdm2(self) -> NDArray[np.float32]:
        return self.rgb @ np.asarray(self.cdm2_per_unit, np.float32)


def luminance_from_radiance(rgb: Float) -> NDArray[np.float32]:
    """179 (.265 R + .670 G + .065 B), [..., 3] to [...]. [cd/m2]"""
    weights = (RADIANCE_LM_PER_W * np.asarray(RADIANCE_Y)).astype(np.float32)
    return np.asarray(rgb, np.float32) @ weights


# ----------------------------------------------------------------------------------------------
# reading


def read_radiance_hdr(path: Path) -> RadianceImage:
    """Read a Radiance picture with its colours. Raises InputError for anything else."""
    with _open(path) as file:
        header = read_header(file, path)
        pixels = np.empty((*header.resolution.counts, 3), np.float32)
        for first, rows in _decoded_rows(file, header, path):
            pixels[first : first + len(rows)] = rows / header.exposure
    weights = header.cdm2_per_unit * header.exposure
    if header.xyze:
        to_rgb = np.linalg.inv(rgb_to_xyz(RADIANCE_CHROMATICITIES)) / RADIANCE_LM_PER_W  # [3, 3]
        pixels = (pixels.reshape(-1, 3) @ to_rgb.T.astype(np.float32)).reshape(pixels.shape)
        weights = RADIANCE_LM_PER_W * rgb_to_xyz(RADIANCE_CHROMATICITIES)[1]
    red, green, blue = (float(value) for value in weights)
    return RadianceImage(
        header.resolution.upright(pixels),
        header.lines,
        header.view,
        header.heading_deg,
        (red, green, blue),
    )


def read_radiance_luminance(path: Path) -> tuple[NDArray[np.float32], RadianceHeader]:
    """Read a Radiance picture's luminance [H, W] [cd/m2] and header, with 4 bytes a pixel.

    Raises InputError for anything else.
    """
    with _open(path) as file:
        header = read_header(file, path)
        weights = header.cdm2_per_unit.astype(np.float32)
        luminance = np.empty(header.resolution.counts, np.float32)
        for first, rows in _decoded_rows(file, header, path):
            luminance[first : first + len(rows)] = rows @ weights
    return header.resolution.upright(luminance), header


def read_radiance_header(path: Path) -> RadianceHeader:
    """Read the header alone. Raises InputError for what is no Radiance picture."""
    with _open(path) as file:
        return read_header(file, path)


def _open(path: Path) -> BinaryIO:
    """Open a regular file. Raises InputError for any other, or an unreadable one."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(path, "no regular file", "a Radiance .hdr picture")
        return path.open("rb")
    except OSError as error:
        raise InputError(path, error.strerror or str(error), "a readable file") from None


def _decoded_rows(
    file: BinaryIO, header: RadianceHeader, path: Path
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield (first scanline, values [scanlines, pixels, 3]) in file order, exposure not undone.

    Raises InputError when the pixels are damaged or end early.
    """
    scanlines, width = header.resolution.counts
    plain = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {scanlines} +X {width}\n".encode()
    brightest = _BRIGHTEST * float(header.exposure.min())
    process = subprocess.Popen(
        [radiance_program("pvalue"), "-h", "-H", "-df"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None and process.stdout is not None
    feeder = Thread(target=_feed, args=(plain, file, process.stdin), daemon=True)
    feeder.start()
    try:
        step = max(1, _BLOCK_PIXELS // width)
        for first in range(0, scanlines, step):
            count = min(step, scanlines - first)
            data = process.stdout.read(count * width * 12)
            if len(data) < count * width * 12:
                raise InputError(
                    path,
                    f"the pixels are damaged or end after {first} of {scanlines} scanlines",
                    "Radiance pixels",
                    "the file is cut short: copy it again",
                )
            rows = np.frombuffer(data, np.float32).reshape(count, width, 3)
            _check_brightness(rows, brightest, path)
            yield first, rows
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        feeder.join()


def _feed(head: bytes, file: BinaryIO, pipe: IO[bytes]) -> None:
    """Send a plain header and the rest of `file`; a decoder that stops early is no error here."""
    with suppress(OSError, ValueError):
        pipe.write(head)
        shutil.copyfileobj(file, pipe, 1 << 20)
    with suppress(OSError, ValueError):
        pipe.close()


def _check_brightness(rows: NDArray[np.float32], brightest: float, path: Path) -> None:
    largest = float(rows.max(initial=0.0))
    if not largest <= brightest:
        raise InputError(
            path, f"a pixel of {largest:.3g} W/sr/m2", "light", "the file is damaged: copy it again"
        )


# ----------------------------------------------------------------------------------------------
# writing


def encode_rgbe(rgb: Float) -> NDArray[np.uint8]:
    """Shared-exponent pixels, [..., 3] to [..., 4]. Mantissas are cut, as Radiance decodes
    (mantissa + .5) / 256.
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
    pixels: Float,
    *,
    view: str = "",
    heading_deg: float | None = None,
    header: tuple[str, ...] = (),
) -> None:
    """Write cd/m2 [H, W] or radiance RGB [H, W, 3] as flat RGBE with one EXPOSURE and one VIEW.

    view: Radiance view options, such as "-vta -vh 180 -vv 180"; heading_deg instead marks a
    panorama.
    """
    values = np.asarray(pixels)
    height, width = values.shape[:2]
    lines = ["#?RADIANCE", *header]
    if heading_deg is not None:
        lines.append(f"{PANORAMA_LINE}{heading_deg:.6g}")
    if view:
        lines.append(f"VIEW= {view}")
    lines += ["EXPOSURE=1", "FORMAT=32-bit_rle_rgbe", ""]
    step = max(1, _BLOCK_PIXELS // width)
    with path.open("wb") as file:
        file.write(("\n".join(lines) + f"\n-Y {height} +X {width}\n").encode())
        for first in range(0, height, step):
            rows = values[first : first + step]
            if rows.ndim == 2:
                rows = np.repeat(rows[..., None] / RADIANCE_LM_PER_W, 3, axis=-1)
            file.write(encode_rgbe(rows).tobytes())
