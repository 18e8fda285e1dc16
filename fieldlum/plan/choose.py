"""Choosing hours: spread evenly over suns and skies, or greedily by what a light-transport model
would learn.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from datetime import date

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.light import Features, Kernel, facades_of, greedy_hours, light_at, light_features
from fieldlum.plan.days import DaylightHours, span
from fieldlum.records import Progress, Room, Site, quiet
from fieldlum.weather import Weather

Index = NDArray[np.intp]
DNI_FULL_WM2, DHI_FULL_WM2 = 1100.0, 700.0  # the paper's normalisation
YEAR_HOURS, POOL_HOURS = (
    800,
    2200,
)  # enough to rank by; the greedy choice takes the square of the pool in memory
NOISE = 3e-3  # variance of one capture in the kernel's unit: the study's default


# ----------------------------------------------------------------------------------------------
# even


def space_filling(points: NDArray[np.float64], count: int, rng: np.random.Generator) -> Index:
    """Indices [count], ascending, by farthest-point sampling (Gonzalez 1985).

    The widest gap is at most twice the smallest possible; the first point is drawn by `rng`.
    """
    if count >= len(points):
        return np.arange(len(points))
    chosen = [int(rng.integers(len(points)))]
    gap = np.full(len(points), np.inf)
    while len(chosen) < count:
        gap = np.minimum(gap, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(np.argmax(gap)))
    return np.sort(np.array(chosen, np.intp))


def medoids(points: NDArray[np.float64], count: int, rng: np.random.Generator) -> Index:
    """Indices [count], ascending: the point nearest to the centre of each of `count` k-means
    clusters.
    """
    from scipy.cluster.vq import kmeans2

    if count >= len(points):
        return np.arange(len(points))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="One of the clusters is empty")  # made good below
        centres, label = kmeans2(points, count, iter=30, minit="++", rng=rng)
    away = ((points - centres[label]) ** 2).sum(axis=1)
    order = np.lexsort((away, label))
    first = np.unique(label[order], return_index=True)[1]
    chosen = set(order[first].tolist())
    for i in np.argsort(-away):  # an empty cluster goes to the point that is worst served
        if len(chosen) == count:
            break
        chosen.add(int(i))
    return np.sort(np.array(sorted(chosen), np.intp))


def even(
    hours: DaylightHours, weather: Weather | None, count: int, rng: np.random.Generator
) -> Index:
    """Hours spread evenly: over sun position and sky by k-means medoids (the paper's way), or
    over suns alone.
    """
    suns = sun.direction(hours.altitude_deg, hours.azimuth_deg)
    if weather is None:
        return space_filling(suns, count, rng)
    found = weather.at(hours.t_utc)
    known = np.flatnonzero(np.isfinite(found.dni_wm2 + found.dhi_wm2))
    sky = np.stack([found.dni_wm2 / DNI_FULL_WM2, found.dhi_wm2 / DHI_FULL_WM2], axis=-1)
    # half the direction: each axis then spans one, like the irradiances
    return known[medoids(np.concatenate([suns / 2, sky], axis=1)[known], count, rng)]


# ---------------------------------------------------------------------------------------------- by
# the kernel


@dataclass(frozen=True, slots=True)
class Learning:
    """What there is to learn: a kernel for the room and the features of a weather year's
    daylight hours.
    """

    kernel: Kernel
    year: Features
    site: Site
    weather: Weather


def learning(
    site: Site, room: Room | None, weather: Weather, kernel: Kernel | None = None
) -> Learning:
    """Every few hours of the weather year, about YEAR_HOURS of them; the kernel a trained one,
    else by the facades.
    """
    lit = weather.daylight()
    year = lit[np.arange(0, len(lit), max(len(lit) // YEAR_HOURS, 1))]
    light = light_at(year.t_utc, site, year.dni_wm2, year.dhi_wm2)
    return Learning(kernel or Kernel(facades_of(room)), light_features(light), site, weather)


def features_at(hours: DaylightHours, task: Learning) -> tuple[Index, Features]:
    """Features under the weather year's sky, of the hours that it knows; with their indices."""
    found = task.weather.at(hours.t_utc)
    known = np.flatnonzero(np.isfinite(found.dni_wm2 + found.dhi_wm2) & (found.dhi_wm2 > 0))
    chosen = hours[known]
    return known, light_features(
        light_at(chosen.t_utc, task.site, found.dni_wm2[known], found.dhi_wm2[known])
    )


def variance_left(task: Learning, captured: Features) -> float:
    """Mean predictive variance over the year after these captures, as a share of the prior's."""
    if not len(captured):
        return 1.0
    known = task.kernel(captured, captured) + NOISE * np.eye(len(captured))
    factor = np.linalg.cholesky(known)
    towards = np.linalg.solve(factor, task.kernel(captured, task.year))
    prior = task.kernel.diagonal(task.year)
    return float((prior - (towards**2).sum(axis=0)).clip(0).sum() / prior.sum())


def best(hours: DaylightHours, task: Learning, count: int, progress: Progress = quiet) -> Index:
    """Indices [count], ascending, of the hours that most lower the year's summed predictive
    variance, greedily.
    """
    known, features = features_at(hours, task)
    stride = -(-len(known) // POOL_HOURS)
    pool = np.arange(0, len(known), stride)
    found = greedy_hours(
        task.kernel, task.year, features[pool], count, noise=NOISE, progress=progress
    )
    return np.sort(known[pool[found.index]])


def month_windows(year: int, days: int) -> list[list[date]]:
    """Twelve windows of `days` days around the middle of each month."""
    starts = [date(year, month, 16).toordinal() - days // 2 for month in range(1, 13)]
    return [span(date.fromordinal(start), days) for start in starts]
