"""Read panoramas: pictures of all directions, as EXR or Radiance files."""

from __future__ import annotations

from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama
from fieldlum.optics.images.exr import read_exr
from fieldlum.optics.images.radiance import read_radiance_hdr


def read_panorama(path: Path, part: str = "") -> Panorama:
    """Read a panorama: an .exr or a Radiance .hdr that is twice as wide as high.

    part : of an .exr, as for `read_exr`. A file without a heading gets 180 (south). The file's view
    is not checked. Raises InputError for
    a missing or broken file, and for other shapes.
    """
    if not path.is_file():
        raise InputError(
            path, "no such file", "a panorama .exr or .hdr", "check the path of the panorama"
        )
    panorama = (
        read_exr(path, part)[0] if path.suffix.lower() == ".exr" else _read_hdr_panorama(path)
    )
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
