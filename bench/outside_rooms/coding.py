"""Store pictures: logarithms in 16 bits for arrays, RGBE for pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

WHITE_EFFICACY = 179.0  # lm/W of Radiance's pictures
_STEP = 8  # code values are multiples of this, 0.25 %: half the bytes when compressed


def coded(cdm2: Array) -> Array:
    """Return luminance as uint16: 10 ** (q / 65535 * 9 - 0.5) cd/m2, 0 for none."""
    q = (np.log10(np.maximum(cdm2, 1e-9)) + 0.5) / 9 * 65535
    q = np.clip(np.round(q / _STEP) * _STEP, _STEP, 65528)
    return np.where(cdm2 > 10**-0.5, q, 0).astype(np.uint16)


def decoded(q: Array) -> Array:
    """Return luminance [cd/m2] of coded pictures."""
    return np.where(q > 0, 10.0 ** (q / 65535 * 9 - 0.5), 0).astype(np.float32)


def write_hdr(path: Path, cdm2: Array) -> None:
    """Write a grey luminance map as an RGBE picture."""
    height, width = cdm2.shape
    value = np.maximum(cdm2, 1e-9) / WHITE_EFFICACY
    mantissa, exponent = np.frexp(value)
    byte = np.round(mantissa * 256).clip(0, 255).astype(np.uint8)
    pixels = np.stack([byte, byte, byte, (exponent + 128).astype(np.uint8)], -1)
    pixels[value < 1e-20] = 0
    head = (
        "#?RADIANCE\nSOFTWARE=bench\nEXPOSURE=1\nFORMAT=32-bit_rle_rgbe\n\n"
        f"-Y {height} +X {width}\n"
    )
    path.write_bytes(head.encode() + pixels.tobytes())
