"""A look at each new frame while it can still be taken again: it opens, it is what was asked, it
is not all clipped.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.errors import InputError
from fieldlum.raw import JPEG_SUFFIXES, FrameInfo, read_exif, read_jpeg, read_mosaic
from fieldlum.records import Exposure

TOLERANCE_EV = 1 / 6  # a camera that snapped to another setting is at least 1/3 EV away
ALL_CLIPPED = 0.5  # share of clipped pixels from which even the shortest frame tells little


def doubts(path: Path, asked: Exposure) -> str:
    """What is wrong with a new frame, or nothing."""
    try:
        info = read_exif(path, lens_f_number=asked.f_number)
    except InputError as error:
        return error.found
    return wrong_settings(info, asked)


def as_taken(path: Path, asked: Exposure) -> Exposure:
    """The exposure of a doubtful frame: EXIF's where that can be read and departs from the
    request, else as asked.
    """
    try:
        info = read_exif(path, lens_f_number=asked.f_number)
    except InputError:
        return asked
    found = info.exposure
    known = found.shutter_s > 0 and found.f_number > 0 and found.iso > 0
    return replace(found, nd=asked.nd) if known and wrong_settings(info, asked) else asked


def wrong_settings(info: FrameInfo, asked: Exposure) -> str:
    """Where EXIF and the request differ by more than the rounding of nominal values."""
    found = info.exposure
    pairs = (
        ("shutter", found.shutter_s, asked.shutter_s, 1.0),
        ("f-number", found.f_number, asked.f_number, 2.0),
        ("ISO", found.iso, asked.iso, 1.0),
    )
    said = [
        f"{name} {is_:g} instead of {should:g}"
        for name, is_, should, per_octave in pairs
        if is_ > 0 and should > 0 and abs(per_octave * math.log2(is_ / should)) > TOLERANCE_EV
    ]
    return ", ".join(said)


def clipped_share(path: Path) -> float:
    """Share of a frame's pixels at its highest value, or at the top code of a JPEG. Raises
    InputError.
    """
    if path.suffix.lower() in JPEG_SUFFIXES:
        return float(np.mean(read_jpeg(path).codes.max(axis=2) >= 254))
    mosaic = read_mosaic(path, lens_f_number=1.0)  # counts alone are looked at
    plateau = min(float(mosaic.white_dn), float(mosaic.counts.max()))
    near_white = plateau >= 0.8 * mosaic.white_dn
    return float(np.mean(mosaic.counts >= plateau)) if near_white else 0.0


def bracket_doubts(shortest: Path) -> str:
    """Whether even the shortest frame of a bracket is clipped all over."""
    try:
        share = clipped_share(shortest)
    except InputError as error:
        return error.found
    return f"{100 * share:.0f} % of the shortest frame is clipped" if share > ALL_CLIPPED else ""
