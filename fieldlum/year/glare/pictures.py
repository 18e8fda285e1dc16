"""Read any luminance picture with its view direction.

A picture states its view: by `VIEW=` with Radiance's options in a .hdr, by the attribute `view` in
an .exr, or by a mark that it is a panorama. For a missing or contradictory view, the error names
the option that helps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama
from fieldlum.optics.images import (
    RadianceHeader,
    read_exr,
    read_panorama,
    read_radiance_hdr,
)
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.year.glare.picture_view import HOW, PictureView, check_proportion, parse_view

HOW_PANORAMA = "a panorama needs FIELDLUM_VIEW= equirect heading_deg=180 in its header"
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_INHERITED = (
    "the picture inherited its VIEW from an input picture: the VIEW is wrong if "
    "that picture was cropped"
)


@dataclass(frozen=True, slots=True)
class Picture:
    """A luminance picture with its view.

    panorama : the pixels, rows from the top, also of a picture that is no panorama; heading_deg is
    then the azimuth of its view. view : the view of a fisheye or perspective picture; None for a
    panorama. directed : False if the view states no direction: its azimuth is then the heading of
    an .exr, or Radiance's default, north. notes : warnings of the reader.
    """

    panorama: Panorama
    view: PictureView | None
    directed: bool = True
    notes: tuple[str, ...] = ()


def read_picture(path: Path, view_options: str = "", part: str = "") -> Picture:
    """Return a .hdr or .exr picture with its view, which `view_options` replace if they are not "".

    view_options : Radiance's options, such as "-vta -vd 0 -1 0 -vh 180 -vv 180". part : name of the
    part, layer or stereo view of an .exr; "" for the only one. Raises InputError for a missing or
    damaged file, and a missing or contradictory view.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "a picture .hdr or .exr", "check the path")
    with path.open("rb") as file:
        is_exr = file.read(4) == _EXR_MAGIC or path.suffix.lower() == ".exr"
    if part and not is_exr:
        raise InputError(
            path, "a Radiance picture, which has no parts", "an .exr for --part", "omit --part"
        )
    return _read_exr(path, view_options, part) if is_exr else _read_hdr(path, view_options)


def _read_hdr(path: Path, view_options: str) -> Picture:
    image = read_radiance_hdr(path)
    header = image.header
    text = view_options or header.view
    if not view_options:
        _check_views(header, path)
    if header.heading_deg is not None and not view_options:
        return Picture(read_panorama(path), None)
    view = parse_view(_stated(text, path), path)
    height, width = image.luminance_cdm2.shape
    check_proportion(view, height, width, header.pixel_aspect, path)
    notes = (_INHERITED,) if header.view_is_inherited and not view_options else ()
    return Picture(
        Panorama(image.luminance_cdm2, view.azimuth_deg), view, "-vd" in text.split(), notes
    )


def _check_views(header: RadianceHeader, path: Path) -> None:
    """Raise InputError for views of different types, or for a panorama with a view."""
    remedy = "state the true view with --view"
    if header.heading_deg is not None and header.views:
        found = f"the header has the lines FIELDLUM_VIEW= (a panorama) and VIEW= {header.view[:80]}"
        raise InputError(path, found, "one of the two", "remove one of the two lines")
    types = {word for text in header.views for word in text.split() if word.startswith("-vt")}
    if len(types) > 1:
        found = f"VIEW lines of several types: {', '.join(sorted(types))}"
        raise InputError(path, found, "one VIEW", remedy)
    if not header.view and header.inherited_views:
        found = "different VIEW lines inherited from its input pictures"
        raise InputError(path, found, "one VIEW", remedy)


def _read_exr(path: Path, view_options: str, part: str) -> Picture:
    picture, stated = read_exr(path, part)
    if stated == "equirect" and not view_options:
        panorama = read_panorama_with_sun(path, part=part)
        return Picture(panorama, None, notes=_notes(panorama))
    notes = _notes(picture)
    text = view_options or ("" if stated == "equirect" else stated.removeprefix("VIEW=").strip())
    view = parse_view(_stated(text, path), path, picture.heading_deg)
    height, width = picture.luminance_cdm2.shape
    check_proportion(view, height, width, 1.0, path)
    directed = "-vd" in text.split() or not view_options
    pixels = np.asarray(picture.luminance_cdm2, np.float32)
    own = replace(picture, luminance_cdm2=pixels, heading_deg=view.azimuth_deg, rgb=None)
    return Picture(own, view, directed, notes)


def _notes(panorama: Panorama) -> tuple[str, ...]:
    return (panorama.attributes["note"],) if "note" in panorama.attributes else ()


def _stated(text: str, path: Path) -> str:
    if not text:
        raise InputError(
            path, "no VIEW in the header", "the picture's view", f"{HOW}; {HOW_PANORAMA}"
        )
    return text
