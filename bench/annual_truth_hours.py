"""The hours of raytraverse's validation set, and the sets of captures that models learn from."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from annual_truth_office import Array
from numpy.typing import NDArray

from fieldlum.sky.daylight import Light

YEAR = 2027  # of the labels only; the sun's vectors are the reference's own
UTC_OFFSET_H = 1.0  # of the weather file


@dataclass(frozen=True)
class Hours:
    """Hours of the reference, then further daylight hours of the weather file; suns [n, 3]."""

    ann_hour: NDArray[np.int64]
    reference: int
    suns: Array
    light: Light


def read_hours(folder: Path) -> Hours:
    """All daylight hours: the reference's with its own sun vectors and irradiance, the others
    from the weather file with the sun of fieldlum at the hour's middle."""
    from fieldlum.core.records import Site
    from fieldlum.sky import sun

    sky = np.loadtxt(folder / "refs" / "skydata.txt")
    with (folder / "refs" / "geneva.epw").open(encoding="latin-1") as file:
        rows = list(csv.reader(file))[8:]
    dni, dhi = (np.array([float(row[k]) for row in rows]) for k in (14, 15))
    start = datetime(YEAR, 1, 1, 0, 30, tzinfo=UTC) - timedelta(hours=UTC_OFFSET_H)
    times = [start + timedelta(hours=k) for k in range(8760)]
    found = sun.position(times, Site("Geneva", 46.25, 6.13, "Europe/Zurich", 416.0))
    vectors = np.asarray(sun.direction(found.altitude_deg, found.azimuth_deg), float)
    own = sky[:, 4] > 0
    vectors[own] = sky[own, :3] / np.linalg.norm(sky[own, :3], axis=1, keepdims=True)
    dni[own], dhi[own] = sky[own, 3], sky[own, 4]
    rest = ~own & (vectors[:, 2] > np.sin(np.radians(1.0))) & (dhi > 0)
    index = np.concatenate((np.flatnonzero(own), np.flatnonzero(rest)))
    suns = vectors[index]
    light = Light(
        t_utc=tuple(times[k] for k in index),
        dni_wm2=dni[index],
        dhi_wm2=dhi[index],
        sun_altitude_deg=np.degrees(np.arcsin(suns[:, 2])),
        sun_azimuth_deg=np.degrees(np.arctan2(suns[:, 0], suns[:, 1])) % 360.0,
        refraction=False,
    )
    return Hours(index, int(own.sum()), suns, light)


def chosen_hours(hours: Hours, count: int = 200, seed: int = 0) -> dict[str, NDArray[np.intp]]:
    """Rows of the 9-day set (three days around the March equinox and each solstice) and of an even
    set (k-means over sun and sky) of daylight hours."""
    from fieldlum.plan.capture_days import medoids

    day = np.array([t.strftime("%m%d") for t in hours.light.t_utc])
    nine = np.isin(
        day,
        [f"{m}{d}" for m, d0 in (("03", 19), ("06", 20), ("12", 20)) for d in range(d0, d0 + 3)],
    )
    points = np.column_stack(
        (hours.suns / 2, hours.light.dni_wm2 / 1000, hours.light.dhi_wm2 / 500)
    )
    even = medoids(points, count, np.random.default_rng(seed))
    return {"9-day": np.flatnonzero(nine), "even": np.sort(even)}
