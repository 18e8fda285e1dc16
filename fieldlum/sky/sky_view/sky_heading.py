"""Find the camera's heading by the sky alone: its luminance is symmetric about the sun.

Each standard sky has the same luminance to the left and to the right of the sun. The open sky in a
window is compared with Perez's sky in each sunny hour; what is left after a level, a stronger or
weaker gradation and a slope in altitude shows how far the sky is turned. Clouds are not symmetric,
but differ from hour to hour.
"""

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.optics.projection import rotation
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.sky_directions import BEAM_LX, usable_log

_MIN_HOURS, _MIN_DIRECTIONS = 5, 10  # of the estimate, and of an hour in it; chosen
_STEP_DEG = 0.1
_HUBER = 1.5  # standard uncertainties, beyond which an hour counts less
# Errors in eight rooms of other renderers (docs/sky-view.md) are 2.0 times the estimate's own; at
# least 0.2 degrees, because the sun moves so far in the seconds of a bracket. Chosen.
_TIMES, MIN_U_DEG = 2.0, 0.2
_NORMAL_MEDIAN = 0.455  # of chi squared with one degree of freedom


def heading_by_sky(
    luminance: Floats32, light: Light, rays: Floats, axis_deg: float
) -> tuple[float, float] | None:
    """Return the correction to add to the heading, clockwise, and its standard uncertainty [deg].

    luminance: of p directions of open sky in n hours [n, p] cd/m2, NaN if unusable; light: of the
    hours; rays [p, 3]: unit vectors (x east, y north, z up) to the directions, by the heading to be
    corrected; axis_deg: azimuth of the lens's axis, clockwise from north. None with fewer than five
    sunny hours (over 5 000 lx of direct light) that have ten usable directions each.
    """
    sunny = np.flatnonzero(light.direct_lx > 5.0 * BEAM_LX)
    if len(sunny) < _MIN_HOURS or len(rays) < _MIN_DIRECTIONS:
        return None
    sunlit, days = light[sunny], np.array([t.toordinal() for t in light.t_utc])[sunny]
    heading, u = 0.0, np.inf
    for _ in range(10):  # Newton: the turn that explains the difference, then again from there
        turned = rays @ rotation(heading, 0.0, 0.0, axis_deg).T
        ahead = rays @ rotation(heading + _STEP_DEG, 0.0, 0.0, axis_deg).T
        level = np.nanmedian(_log_ratio(luminance, light, turned), axis=0)
        off = _log_ratio(luminance[sunny], sunlit, turned) - level
        off_ahead = _log_ratio(luminance[sunny], sunlit, ahead) - level
        turns, variances = _turns(off, (off - off_ahead) / _STEP_DEG, sunlit, turned)
        usable = np.isfinite(turns)
        if usable.sum() < _MIN_HOURS:
            return None
        step, u = _mean(turns[usable], variances[usable], days[usable])
        heading += float(np.clip(step, -3.0, 3.0))
        if abs(step) < 0.1 * u:
            break
    return heading, float(np.hypot(_TIMES * u, MIN_U_DEG))


def _log_ratio(luminance: Floats32, light: Light, rays: Floats) -> Floats:
    """Return ln of (luminance [n, p] / that of Perez's sky) in p directions [p, 3], [n, p]."""
    return usable_log(luminance, light, rays) - np.log(np.maximum(light.sky_at(rays), 1e-3))


def _turns(off: Floats, slope: Floats, light: Light, rays: Floats) -> tuple[Floats, Floats]:
    """Return the turn [deg] that explains each hour's `off`, and its variance, [n] each.

    off [n, p]: ln of the measured over Perez's luminance in directions `rays` [p, 3]; slope [n, p]:
    by how much one degree of turn raises `off`; light: of the n hours. A constant, a factor on the
    log of the sky and a gradient with altitude are no turn: they are projected out. NaN for hours
    with fewer than ten usable directions.
    """
    altitude = np.arcsin(np.clip(rays[:, 2], -1.0, 1.0))
    usable = np.isfinite(off) & np.isfinite(slope)
    sky = np.log(np.maximum(light.sky_at(rays), 1e-3))
    turns, variances = np.full(len(off), np.nan), np.full(len(off), np.nan)
    for k, at in enumerate(usable):
        if at.sum() < _MIN_DIRECTIONS:
            continue
        symmetric = np.stack([np.ones(at.sum()), sky[k, at], altitude[at]], axis=1)
        basis, _ = np.linalg.qr(symmetric - [0.0, *symmetric[:, 1:].mean(axis=0)])
        off_rest = off[k, at] - basis @ (basis.T @ off[k, at])
        slope_rest = slope[k, at] - basis @ (basis.T @ slope[k, at])
        size = float(slope_rest @ slope_rest)
        if size > 1e-9:
            turns[k] = slope_rest @ off_rest / size
            residual = off_rest - turns[k] * slope_rest
            # 1e-4: a scatter of 1 %, so that a perfect fit is not certain
            variances[k] = (residual @ residual / len(residual) + 1e-4) / size
    return turns, variances


def _mean(turns: Floats, variances: Floats, days: np.ndarray) -> tuple[float, float]:
    """Return the robust mean of the hours' turns and its standard uncertainty, in degrees.

    The uncertainty is the larger of that by the scatter of hours and that between days. turns,
    variances: of each hour [n] deg, deg2; days: the day of each hour [n].
    """
    mean, weight = float(np.median(turns)), 1.0 / variances
    for _ in range(30):
        # Neighbouring directions have the same clouds: an hour is less certain by a common factor.
        factor = max(1.0, float(np.median((turns - mean) ** 2 / variances)) / _NORMAL_MEDIAN)
        sigmas = np.abs(turns - mean) / np.sqrt(factor * variances)
        weight = np.minimum(1.0, _HUBER / np.maximum(sigmas, 1e-9)) / (factor * variances)
        mean = float((weight * turns).sum() / weight.sum())
    others = days[None, :] != np.unique(days)[:, None]  # [days, n]: the jackknife leaves out a day
    without = (others @ (weight * turns)) / np.maximum(others @ weight, 1e-12)
    between = (len(without) - 1) * float(without.var())
    return mean, float(np.sqrt(max(1.0 / weight.sum(), between)))
