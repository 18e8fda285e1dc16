"""Check a new frame while it can still be taken again.

A frame must be readable and have the requested exposure. At most half of the darkest frame may be
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


def compare_exif(path: Path, requested: Exposure) -> tuple[str, Exposure]:
    """Return how a new frame's EXIF differs from the requested exposure, and which one to record.

    path: of the frame. The text is "" without a difference; for a frame that cannot be read it is
    the reason. A setting that EXIF does not state is not compared; others may differ by 1/6 EV.
    EXIF's exposure is to be recorded if it is complete and differs from the request, else the
    request.
    """
    try:
        taken = read_exif(path, lens_f_number=requested.f_number).exposure
    except InputError as error:
        return error.found, requested
    settings = (  # name, value in EXIF, requested value, EV by which light changes when it doubles
        ("shutter", taken.shutter_s, requested.shutter_s, 1.0),
        ("f-number", taken.f_number, requested.f_number, 2.0),
        ("ISO", taken.iso, requested.iso, 1.0),
    )
    text = ", ".join(
        f"{name} {actual:g} instead of {nominal:g}"
        for name, actual, nominal, ev in settings
        if actual > 0 and nominal > 0 and abs(ev * math.log2(actual / nominal)) > SAME_SETTING_EV
    )
    is_complete = all(actual > 0 for _, actual, _, _ in settings)
    return text, replace(taken, nd=requested.nd) if text and is_complete else requested


def clipped_share(path: Path) -> float:
    """Return the share of a frame's clipped pixels, 0 to 1.

    A JPEG pixel is clipped if a colour has code 254 or 255. Raw pixels are clipped at the frame's
    highest count, or at the white level if that is lower, because some sensors saturate below the
    white level; none is clipped if the highest count is below 0.8 of it. Both limits are chosen.
    Raises InputError if the frame cannot be read.
    """
    if is_jpeg(path):
        return float(np.mean(read_jpeg(path).codes.max(axis=2) >= 254))
    mosaic = read_mosaic(path, lens_f_number=1.0)  # only the counts are used
    highest_dn = min(float(mosaic.white_dn), float(mosaic.counts.max()))
    is_near_white = highest_dn >= 0.8 * mosaic.white_dn
    return float(np.mean(mosaic.counts >= highest_dn)) if is_near_white else 0.0


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
