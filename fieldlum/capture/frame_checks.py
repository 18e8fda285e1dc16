"""Check a new frame while it can still be taken again.

It must be readable and have the requested exposure. At most half of the darkest frame may be
clipped.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.exposure import SAME_SETTING_EV
from fieldlum.optics.raw import is_jpeg, read_exif, read_jpeg, read_mosaic


def compare_exif(path: Path, asked: Exposure) -> tuple[str, Exposure]:
    """Return how a new frame's EXIF differs from the requested exposure, and the one to record.

    The text is "" for a good frame; it is the reason for a frame that cannot be read. A setting
    that EXIF does not state is not compared; others may differ by 1/6 EV. EXIF's exposure is
    recorded if it is complete and differs from the request, else the request.
    """
    try:
        taken = read_exif(path, lens_f_number=asked.f_number).exposure
    except InputError as error:
        return error.found, asked
    pairs = (
        ("shutter", taken.shutter_s, asked.shutter_s, 1.0),
        ("f-number", taken.f_number, asked.f_number, 2.0),
        ("ISO", taken.iso, asked.iso, 1.0),
    )
    text = ", ".join(
        f"{name} {is_:g} instead of {should:g}"
        for name, is_, should, per_octave in pairs
        if is_ > 0 and should > 0 and abs(per_octave * math.log2(is_ / should)) > SAME_SETTING_EV
    )
    is_complete = all(is_ > 0 for _, is_, _, _ in pairs)
    return text, replace(taken, nd=asked.nd) if text and is_complete else asked


def clipped_share(path: Path) -> float:
    """Return the share of a frame's clipped pixels, 0 to 1.

    A JPEG pixel is clipped if a colour has code 254 or 255. Raw pixels are clipped at the frame's
    highest count, if this is at least 0.8 of the white level. Raises InputError if the frame cannot
    be read.
    """
    if is_jpeg(path):
        return float(np.mean(read_jpeg(path).codes.max(axis=2) >= 254))
    mosaic = read_mosaic(path, lens_f_number=1.0)  # only the counts are used
    plateau = min(float(mosaic.white_dn), float(mosaic.counts.max()))
    near_white = plateau >= 0.8 * mosaic.white_dn
    return float(np.mean(mosaic.counts >= plateau)) if near_white else 0.0


def clipping_text(shortest: Path) -> str:
    """Return a warning if over half of the shortest frame is clipped, else "".

    If the frame cannot be read, return the reason.
    """
    try:
        share = clipped_share(shortest)
    except InputError as error:
        return error.found
    text = f"{100 * share:.0f} % of the shortest exposure's pixels are clipped"
    return text if share > 0.5 else ""
