"""Choose hours: spread evenly over suns and skies, or greedily by a kernel's variance."""

import warnings
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.records import Room, Site
from fieldlum.plan.capture_days import DaylightHours
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at
from fieldlum.sky.daylight_kernel import Features, Kernel, facades_of, greedy_hours, light_features
from fieldlum.weather import Weather

# The paper's normalisation of irradiances (Liu, Colburn and Inanici 2020). [W/m2]
_FULL_WM2 = (1100.0, 700.0)  # DNI, DHI
# Number of hours that represent the weather year, and of candidates for the greedy choice, whose
# memory grows with their square. Chosen so that the ranking is stable; not measured.
YEAR_HOURS = 800
POOL_HOURS = 2200


# ----------------------------------------------------------------------------------------------
# even


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


# ----------------------------------------------------------------------------------------------
# by the kernel


@dataclass(frozen=True, slots=True)
class Learning:
    """What a greedy choice of hours needs: a covariance kernel of light, and a weather year.

    year: features of some of the year's daylight hours, at which the variance is computed.
    """

    kernel: Kernel
    year: Features
    site: Site
    weather: Weather


def learning(
    site: Site, room: Room | None, weather: Weather, kernel: Kernel | None = None
) -> Learning:
    """Return what a greedy choice of hours needs, with at most 1600 of the year's daylight hours.

    They are every k-th hour. kernel : of a trained model; None: a kernel for the facades of `room`.
    """
    lit = weather.daylight()
    year = lit[np.arange(0, len(lit), max(len(lit) // YEAR_HOURS, 1))]
    light = light_at(year.t_utc, site, year.dni_wm2, year.dhi_wm2)
    return Learning(kernel or Kernel(facades_of(room)), light_features(light), site, weather)


def features_at(
    hours: DaylightHours, task: Learning, sky: sun.Irradiance | None = None
) -> tuple[Indices, Features]:
    """Return the hours with daylight (DHI above 0), and the k light features of these.

    The hours are indices [k] into `hours`, ascending. sky: at the n hours, None for the weather's.
    """
    sky = sky or task.weather.at(hours.t_utc)
    lit = np.flatnonzero(np.isfinite(sky.dni_wm2 + sky.dhi_wm2) & (sky.dhi_wm2 > 0))
    light = light_at(hours[lit].t_utc, task.site, sky.dni_wm2[lit], sky.dhi_wm2[lit])
    return lit, light_features(light)


def variance_left(task: Learning, captured: Features) -> float:
    """Return the share of the year's prior variance that remains after some captures, 0 to 1.

    Both variances are sums over the hours of `task.year`. Without captures the share is 1.
    """
    return float(greedy_hours(task.kernel, task.year, task.year[:0], 0, taken=captured).variance[0])


def best(hours: DaylightHours, task: Learning, count: int) -> Indices:
    """Return ascending indices of at most `count` hours that together reduce the variance most.

    The variance is summed over the year. The choice is greedy, among at most 2200 hours with
    daylight in the weather; the result is empty without such hours.
    """
    hours_known, features = features_at(hours, task)
    if not len(hours_known):
        return hours_known
    stride = -(-len(hours_known) // POOL_HOURS)
    pool = np.arange(0, len(hours_known), stride)
    ranked = greedy_hours(task.kernel, task.year, features[pool], count)
    return np.sort(hours_known[pool[ranked.rows]])
