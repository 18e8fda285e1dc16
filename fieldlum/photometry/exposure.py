"""What an exposure collects, what a shutter dial really means, and where a sensor is full."""

import math

import numpy as np
from numpy.typing import NDArray

# cd/m2 at z = 1, f/1, 1 s, ISO 100 is STONITS / 100 * 100: hdrgen's empirical constant (Ward,
# panlib)
STONITS = 87.0
_OFF_GRID = 0.07  # a nominal time further than this from every grid is taken as it stands


def z_per_cdm2(shutter_s: float, f_number: float, iso: float, k: float = 1.0) -> float:
    """Linear signal z in [0, 1] per cd/m2: the inverse of L = k * 87 N^2 / (t S) * z."""
    return shutter_s * iso / (STONITS * f_number**2 * k)


def snap_shutter_s(nominal_s: float) -> float:
    """The time behind a nominal one: shutters run in powers of 2^(1/3), or of 2^(1/2) in half-stop
    cameras. [s]

    1/60 is 1/64 and 13 s is 12.7 s; the dial's own figures are off by up to 6.3 %. A time off both
    grids by more than 7 % is no dial figure and is kept. Source: linearhdr (Wasilewski), hdrmerge
    (Jakob); measured on simulated brackets.
    """
    exact = math.log2(nominal_s)
    grids = (round(exact * 3) / 3, round(exact * 2) / 2)
    snapped = 2.0 ** min(grids, key=lambda power: abs(power - exact))
    return snapped if abs(snapped / nominal_s - 1) <= _OFF_GRID else nominal_s


def saturation_plateau(
    counts: NDArray[np.integer], white_dn: float, *, share: float = 2e-4
) -> float | None:
    """The count at which a sensor is full, from the spike at the top of its histogram; None without
    a spike. [DN]

    Many sensors stop below the white level of their file. The spike is the highest short run of
    counts that holds at least `share` of all pixels and stands ten times above the counts below it.
    """
    top = int(counts.max(initial=0))
    if top < 0.5 * white_dn:
        return None
    width = max(1, round(0.002 * white_dn))
    flat = counts.ravel()
    near = flat[flat > top - 12 * width].astype(np.int64)
    histogram = np.bincount(top - near, minlength=12 * width)
    spike, below = histogram[:width].sum(), histogram[2 * width :].sum() / 10
    if spike < max(share * flat.size, 8) or spike < 10 * below:
        return None
    return float(top - np.average(np.arange(width), weights=histogram[:width]))
