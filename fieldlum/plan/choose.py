"""Choose hours that are spread evenly over suns and skies."""

import warnings

import numpy as np

from fieldlum.core.arrays import Floats, Indices
from fieldlum.plan.capture_days import DaylightHours
from fieldlum.sky import sun
from fieldlum.weather import Weather

# The paper's normalisation of irradiances (Liu, Colburn and Inanici 2020). [W/m2]
_FULL_WM2 = (1100.0, 700.0)  # DNI, DHI


def medoids(points: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Return indices [count], ascending, of the points nearest to the centres of k-means clusters.

    points : [n, k]. Each of `count` clusters has one point; instead of one of an empty cluster, the
    point furthest from its own centre is taken. All points are returned if there are no more than
    `count`.
    """
    from scipy.cluster.vq import kmeans2

    if count >= len(points):
        return np.arange(len(points))
    with warnings.catch_warnings():
        # Empty clusters are filled below.
        warnings.filterwarnings("ignore", message="One of the clusters is empty")
        centres, label = kmeans2(points, count, iter=30, minit="++", rng=rng)
    away = ((points - centres[label]) ** 2).sum(axis=1)
    order = np.lexsort((away, label))
    nearest = order[np.unique(label[order], return_index=True)[1]]
    furthest = np.argsort(-away)
    others = furthest[~np.isin(furthest, nearest)]
    return np.sort(np.concatenate([nearest, others[: count - len(nearest)]]))


def even(
    hours: DaylightHours, weather: Weather | None, count: int, rng: np.random.Generator
) -> Indices:
    """Return ascending indices [k] of at most `count` hours whose suns and skies are spread evenly.

    They are k-means medoids over sun direction, DNI and DHI (Liu, Colburn and Inanici 2020); hours
    without weather are not chosen. If `weather` is None: over sun direction alone.
    """
    suns = sun.direction(hours.altitude_deg, hours.azimuth_deg)
    if weather is None:
        return medoids(suns, count, rng)
    sky_now = weather.at(hours.t_utc)
    with_weather = np.flatnonzero(np.isfinite(sky_now.dni_wm2 + sky_now.dhi_wm2))
    sky = np.stack([sky_now.dni_wm2, sky_now.dhi_wm2], axis=-1) / _FULL_WM2
    # Halve the direction, so that each of its axes has a range of one, as the irradiances have.
    points = np.concatenate([suns / 2, sky], axis=1)  # (n, 5)
    return with_weather[medoids(points[with_weather], count, rng)]
