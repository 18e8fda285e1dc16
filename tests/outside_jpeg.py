"""JPEG frames with EXIF as other programs write it, byte by byte."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from PIL import Image

Value = int | str | tuple[int, int]
GOOD: dict[int, Value] = {
    33434: (1, 60),
    33437: (28, 5),
    34855: 100,
    36867: "2027:03:20 07:30:00",
}


def _directory(tags: dict[int, Value], at: int, order: str) -> bytes:
    body, data = struct.pack(f"{order}H", len(tags)), b""
    free = at + 2 + 12 * len(tags) + 4
    for tag, value in sorted(tags.items()):
        if isinstance(value, str):
            kind, count, packed = 2, len(value) + 1, value.encode() + b"\0"
        elif isinstance(value, tuple):
            kind, count, packed = 5, 1, struct.pack(f"{order}2I", *value)
        elif value <= 0xFFFF and tag != 34665:
            kind, count, packed = 3, 1, struct.pack(f"{order}H", value)
        else:
            kind, count, packed = 4, 1, struct.pack(f"{order}I", value)
        if len(packed) > 4:
            data += packed + b"\0" * (len(packed) % 2)
            packed = struct.pack(f"{order}I", free + len(data) - len(packed) - len(packed) % 2)
        body += struct.pack(f"{order}HHI", tag, kind, count) + packed.ljust(4, b"\0")
    return body + struct.pack(f"{order}I", 0) + data


def exif_segment(tags: dict[int, Value], order: str = "<") -> bytes:
    """Return an APP1 segment; tags of the Exif directory, the camera is added."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    main: dict[int, Value] = {271: "Maker", 272: "Model 1", 34665: 0}
    main[34665] = 8 + len(_directory(main, 8, order))
    tiff = head + _directory(main, 8, order) + _directory(tags, int(main[34665]), order)
    return segment(0xE1, b"Exif\0\0" + tiff)


def segment(marker: int, content: bytes) -> bytes:
    return bytes((0xFF, marker)) + struct.pack(">H", len(content) + 2) + content


def jpeg(path: Path, *segments: bytes, size: tuple[int, int] = (24, 16), code: int = 120) -> Path:
    """Write a grey JPEG with these segments behind its start."""
    buffer = io.BytesIO()
    pixels = np.full((size[1], size[0], 3), code, np.uint8)
    Image.fromarray(pixels).save(buffer, "JPEG", quality=95)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\xff\xd8" + b"".join(segments) + buffer.getvalue()[2:])
    return path
