"""Compute the signal of an exposure, the true time of a shutter, and a sensor's saturation."""

import math

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Exposure

# L = STONITS N^2 / (t S) cd/m2 at z = 1, f-number N, time t [s], ISO S: the empirical constant of
# hdrgen (Ward, panlib). A wrong value scales all luminances without a scale calibration.
STONITS = 87.0
# A nominal time further than this share from both grids is used unchanged. Nominal times of third
# stops are rounded by up to 6.3 % (13 s is 12.7 s). Chosen just above.
_OFF_GRID = 0.07
# A saturated run of counts is a spike if it is this many times the average of equal runs below it.
# Chosen so that a bright smooth scene is no spike; not measured.
_SPIKE_RATIO = 10
_SPIKE_SHARE = 2e-4  # minimum share of all pixels in a spike; chosen, not measured
_HOT_SHARE = 2e-5  # share of pixels that may be above the spike (hot pixels); chosen, not measured


# Relative standard uncertainty of a snapped shutter time, from SHORT_S on and below it: mechanical
# shutters are less accurate at short times. Chosen so that measured ratios outweigh them: errors of
# up to 3.9 % are found (docs/validation.md). Not measured on real cameras.
PRIOR_LONG = 0.003
PRIOR_SHORT = 0.03
SHORT_S = 1 / 1000


# Settings of cameras are a third of a stop apart: two values within the half of it are the same
# setting, rounded differently. Chosen.
SAME_SETTING_EV = 1 / 6


def same_exposure(a: Exposure, b: Exposure) -> bool:
    """Return whether shutter, aperture and ISO each differ by at most 1/6 EV.

    Filters are not compared, because cameras do not record them.
    """
    ratios = a.shutter_s / b.shutter_s, (a.f_number / b.f_number) ** 2, a.iso / b.iso
    return all(abs(math.log2(ratio)) <= SAME_SETTING_EV for ratio in ratios)


def z_per_cdm2(shutter_s: float, f_number: float, iso: float, k: float = 1.0) -> float:
    """Return the linear signal z (1 at full scale) per cd/m2, by L = k 87 N^2 / (t S) z.

    t: shutter time [s]; N: f-number; S: ISO; k: factor of the scale calibration.
    """
    return shutter_s * iso / (STONITS * f_number**2 * k)


def snap_shutter_s(nominal_s: float) -> float:
    """Return the true time of a nominal shutter time, in s.

    Shutters run in powers of 2^(1/3), or of 2^(1/2) in cameras with half stops: 1/60 is 1/64 s and
    13 s is 12.7 s. A time that differs from both grids by more than 7 % is returned unchanged.
    Source: linearhdr (Wasilewski), hdrmerge (Jakob); measured on simulated brackets.
    """
    exact = math.log2(nominal_s)
    grids = (round(exact * 3) / 3, round(exact * 2) / 2)
    snapped = 2.0 ** min(grids, key=lambda power: abs(power - exact))
    return snapped if abs(snapped / nominal_s - 1) <= _OFF_GRID else nominal_s


def prior_u_log(shutter_s: Floats) -> Floats:
    """Return the relative standard uncertainty of shutter times that were not measured, [n].

    0.003 from 1/1000 s on, 0.03 for shorter times. shutter_s : [n], s.
    """
    return np.where(np.asarray(shutter_s) < SHORT_S, PRIOR_SHORT, PRIOR_LONG)


def saturation_plateau(counts: NDArray[np.integer], white_dn: float) -> float | None:
    """Return the count at which a sensor saturates [DN]; None if the histogram has no such spike.

    counts : raw counts of any shape; white_dn : the white level in the file. Many sensors saturate
    below that white level. The spike is the run of counts up to the highest count (without a few
    hot pixels), if that is at least half of white_dn, and the run has at least 8 pixels, 0.02 % of
    all pixels and ten times the average of equal runs below it. The result is its mean count.
    """
    flat = np.maximum(counts.ravel(), 0)
    of_count = np.bincount(flat, minlength=1)
    above = flat.size - np.cumsum(of_count)  # pixels above each count
    top = int(np.argmax(above <= max(8, _HOT_SHARE * flat.size)))
    if top < 0.5 * white_dn:
        return None
    width = max(1, round(0.002 * white_dn))
    histogram = of_count[max(top + 1 - 12 * width, 0) : top + 1][::-1]  # from the highest count
    spike, below = histogram[:width].sum(), histogram[2 * width :].sum() / 10
    if spike < max(_SPIKE_SHARE * flat.size, 8) or spike < _SPIKE_RATIO * below:
        return None
    return float(top - np.average(np.arange(width), weights=histogram[:width]))
