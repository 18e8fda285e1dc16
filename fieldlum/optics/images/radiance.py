"""Read Radiance pictures (RGBE, XYZE) through Radiance's own pvalue, and write RGBE.

pvalue decodes flat, new and old run-length scanlines. It runs as a separate process, so that a
damaged file cannot crash this one. It receives the pixels behind a plain header: exposure,
primaries and orientation are applied here (`radiance_header`).
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

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError, input_errors
from fieldlum.optics.images.primaries import RADIANCE_CHROMATICITIES, rgb_to_xyz
from fieldlum.optics.images.programs import radiance_program
from fieldlum.optics.images.radiance_header import (
    PANORAMA_LINE,
    RADIANCE_LM_PER_W,
    RADIANCE_Y,
    RadianceHeader,
    read_header,
)

# Brighter pixels are damaged. Infinity is written as 1e30, and single precision ends at 3e38.
# [W/sr/m2] Chosen between the two.
_MAX_RADIANCE = 2e30
# decoded at a time: limits memory to 6 MB; chosen; any value gives the same picture
_BLOCK_PIXELS = 500_000


@dataclass(frozen=True, slots=True)
class RadianceImage:
    """A Radiance picture with its colours.

    rgb : [H, W, 3] W/sr/m2, upright, with EXPOSURE and COLORCORR undone, in the file's own
    primaries (for XYZE, in Radiance's). header : its lines after "#?". view : the text after VIEW=,
    or "". heading_deg : stated by a header line of a panorama. cdm2_per_unit : [3] luminance of one
    unit of R, G and B.
    """

    rgb: Floats32
    header: tuple[str, ...] = ()
    view: str = ""
    heading_deg: float | None = None
    cdm2_per_unit: tuple[float, float, float] = (
        RADIANCE_LM_PER_W * RADIANCE_Y[0],
        RADIANCE_LM_PER_W * RADIANCE_Y[1],
        RADIANCE_LM_PER_W * RADIANCE_Y[2],
    )

    @property
    def luminance_cdm2(self) -> Floats32:
        """The luminance, [H, W], in cd/m2."""
        return self.rgb @ np.asarray(self.cdm2_per_unit, np.float32)


# ----------------------------------------------------------------------------------------------
# reading


def read_radiance_hdr(path: Path) -> RadianceImage:
    """Read a Radiance picture with its colours. Raises InputError for any other file."""
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


def read_radiance_luminance(path: Path) -> tuple[Floats32, RadianceHeader]:
    """Read the luminance [H, W] in cd/m2 and the header of a Radiance picture.

    This needs 4 bytes for each pixel. Raises InputError for any other file.
    """
    with _open(path) as file:
        header = read_header(file, path)
        weights = header.cdm2_per_unit.astype(np.float32)
        luminance = np.empty(header.resolution.counts, np.float32)
        for first, rows in _decoded_rows(file, header, path):
            luminance[first : first + len(rows)] = rows @ weights
    return header.resolution.upright(luminance), header


def read_radiance_header(path: Path) -> RadianceHeader:
    """Read the header of a Radiance picture only. Raises InputError for any other file."""
    with _open(path) as file:
        return read_header(file, path)


def _open(path: Path) -> BinaryIO:
    """Open a regular file. Raises InputError for any other, or an unreadable one."""
    remedy = "check the path and the permissions of the picture"
    with input_errors(path, "a readable file", remedy, OSError):
        if path.exists() and not path.is_file():
            raise InputError(
                path, "no regular file", "a Radiance .hdr picture", "check the path of the picture"
            )
        return path.open("rb")


def _decoded_rows(
    file: BinaryIO, header: RadianceHeader, path: Path
) -> Iterator[tuple[int, Floats32]]:
    """Yield the first scanline and values [scanlines, pixels, 3], in file order, before exposure.

    Raises InputError if the pixels are damaged or end early.
    """
    scanlines, width = header.resolution.counts
    plain = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {scanlines} +X {width}\n".encode()
    brightest = _MAX_RADIANCE * float(header.exposure.min())
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
                end = first + count
                raise InputError(
                    path,
                    f"the pixels are damaged, or end before scanline {end} of {scanlines}",
                    f"{scanlines} scanlines of Radiance pixels",
                    "copy the file again, because it is cut short",
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
    """Write a plain header and the rest of `file` to the decoder, which may stop reading early."""
    with suppress(OSError, ValueError):
        pipe.write(head)
        shutil.copyfileobj(file, pipe, 1 << 20)
    with suppress(OSError, ValueError):
        pipe.close()


def _check_brightness(rows: Floats32, brightest: float, path: Path) -> None:
    largest = float(rows.max(initial=0.0))
    if not largest <= brightest:
        raise InputError(
            path,
            f"a pixel value of {largest:.3g}",
            f"at most {brightest:.3g}",
            "copy the file again, because it is damaged",
        )


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
    lines += ["EXPOSURE=1", "FORMAT=32-bit_rle_rgbe", ""]
    step = max(1, _BLOCK_PIXELS // width)
    with path.open("wb") as file:
        file.write(("\n".join(lines) + f"\n-Y {height} +X {width}\n").encode())
        for first in range(0, height, step):
            rows = values[first : first + step]
            if rows.ndim == 2:
                rows = np.repeat(rows[..., None] / RADIANCE_LM_PER_W, 3, axis=-1)
            file.write(encode_rgbe(rows).tobytes())
