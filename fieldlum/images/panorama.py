"""Panoramas on disk: fieldlum's own EXR, or a Radiance picture twice as wide as high."""

from __future__ import annotations

from pathlib import Path

from fieldlum.errors import InputError
from fieldlum.images.exr import read_exr
from fieldlum.images.radiance import read_radiance_hdr
from fieldlum.records import Panorama


def read_panorama(path: Path) -> Panorama:
    """A panorama from .exr (ours) or .hdr (W = 2H). A .hdr without a heading line takes heading 180
    (south).

    Raises InputError for a missing, broken or other kind of file.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "a panorama .exr or .hdr")
    panorama = read_exr(path)[0] if path.suffix.lower() == ".exr" else _read_hdr_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(path, f"{width} x {height} pixels", "a panorama twice as wide as high")
    return panorama


def _read_hdr_panorama(path: Path) -> Panorama:
    image = read_radiance_hdr(path)
    heading = 180.0 if image.heading_deg is None else image.heading_deg
    return Panorama(image.luminance_cdm2, heading, rgb=image.rgb)
