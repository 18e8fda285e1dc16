"""Read panoramas: fieldlum's own EXR, or a Radiance picture that is twice as wide as high."""

from __future__ import annotations

from pathlib import Path

from fieldlum.errors import InputError
from fieldlum.images.exr import read_exr
from fieldlum.images.radiance import read_radiance_hdr
from fieldlum.records import Panorama


def read_panorama(path: Path) -> Panorama:
    """Read a panorama: fieldlum's .exr, or a Radiance .hdr that is twice as wide as high.

    A .hdr without a heading line gets the heading 180 (south). Raises InputError for a missing or
    broken file, and for other kinds and shapes.
    """
    if not path.is_file():
        raise InputError(
            path, "no such file", "a panorama .exr or .hdr", "check the path of the panorama"
        )
    panorama = read_exr(path)[0] if path.suffix.lower() == ".exr" else _read_hdr_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(
            path,
            f"{width} x {height} pixels",
            "a panorama twice as wide as high",
            "use a picture of all directions (equirectangular)",
        )
    return panorama


def _read_hdr_panorama(path: Path) -> Panorama:
    image = read_radiance_hdr(path)
    heading = 180.0 if image.heading_deg is None else image.heading_deg
    return Panorama(image.luminance_cdm2, heading, rgb=image.rgb)
