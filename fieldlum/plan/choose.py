"""Choose hours: spread evenly over suns and skies, or those that together teach the most."""

import warnings

import numpy as np

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.records import Room, Site
from fieldlum.plan.capture_days import DaylightHours
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at
from fieldlum.sky.daylight_kernel import Kernel, facades_of, greedy_hours, light_features
from fieldlum.weather import Weather

# The paper's normalisation of irradiances (Liu, Colburn and Inanici 2020). [W/m2]
_FULL_WM2 = (1100.0, 700.0)  # DNI, DHI
# Number of hours that represent the weather year, and of candidates for the greedy choice, whose
# memory grows with their square. Chosen so that the ranking is stable; not measured.
YEAR_HOURS = 800
POOL_HOURS = 2200


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
    """Return ascending indices of at most `count` hours whose suns and skies are spread evenly.

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


def best(
    hours: DaylightHours, weather: Weather, site: Site, room: Room | None, count: int
) -> Indices:
    """Return ascending indices of `count` hours that together most lower the year's uncertainty.

    It is the variance, over the weather year, of a covariance kernel of daylight for the facades of
    `room`. The choice is greedy; hours without daylight in the weather are not chosen.
    """
    lit = weather.daylight()
    year = lit[:: max(len(lit) // YEAR_HOURS, 1)]
    sky = weather.at(hours.t_utc)
    pool = np.flatnonzero(np.isfinite(sky.dni_wm2 + sky.dhi_wm2) & (sky.dhi_wm2 > 0))
    pool = pool[:: max(-(-len(pool) // POOL_HOURS), 1)]
    of_year = light_at(year.t_utc, site, year.dni_wm2, year.dhi_wm2)
    of_pool = light_at(hours[pool].t_utc, site, sky.dni_wm2[pool], sky.dhi_wm2[pool])
    features = light_features(of_year), light_features(of_pool)
    return np.sort(pool[greedy_hours(Kernel(facades_of(room)), *features, count)])
