"""Check whether the rows of a pairs.csv can be from one room under one sun.

The checks detect errors in edited or joined tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Site
from fieldlum.session.files.pairs_csv import PairRow
from fieldlum.sky import sun

# Radiance's own sun differs from SPA by up to 1.1 degrees; a time wrong by an hour moves the sun by
# 15, by half an hour by 7.
MAX_SUN_DEG = 2.5


def check_plausible(path: Path, rows: Sequence[PairRow], site: Site) -> None:
    """Raise InputError, naming the line, for rows that contradict each other or the sun.

    It detects a repeated time or picture, a sun position in the csv more than 2.5 degrees from that
    computed for `site`, and irradiance that is too large or too small for any sky, such as values
    in kW/m2. path: the csv that the error names.
    """
    times = [row.t_utc for row in rows]
    pictures = [(path.parent / row.panorama).resolve() for row in rows]
    _check_once(path, rows, times, "have the same t_utc")
    _check_once(path, rows, pictures, "have the same panorama")
    position = sun.position(times, site)
    _check_sun(path, rows, position, site)
    _check_irradiance(path, rows, position.altitude_deg)


def _check_once(
    path: Path, rows: Sequence[PairRow], values: Sequence[datetime] | Sequence[Path], finding: str
) -> None:
    first: dict[datetime | Path, int] = {}
    for line, value in zip((row.line for row in rows), values, strict=True):
        if value in first:
            raise InputError(
                path,
                f"lines {first[value]} and {line} {finding}",
                "each bracket once",
                "remove one of the lines, or set its ok = 0",
            )
        first[value] = line


def _check_sun(path: Path, rows: Sequence[PairRow], position: sun.SunPosition, site: Site) -> None:
    stated = np.array([(row.sun_altitude_deg, row.sun_azimuth_deg) for row in rows]).T
    cosine = (
        sun.direction(stated[0], stated[1])
        * sun.direction(position.altitude_deg, position.azimuth_deg)
    ).sum(axis=1)
    apart = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    # Angles absent from the csv are NaN and compare False.
    if not (apart > MAX_SUN_DEG).any():
        return
    k = int(np.nanargmax(apart))
    raise InputError(
        path,
        f"line {rows[k].line}: sun at altitude {rows[k].sun_altitude_deg:.1f}, azimuth "
        f"{rows[k].sun_azimuth_deg:.1f} deg",
        f"altitude {position.altitude_deg[k]:.1f}, azimuth {position.azimuth_deg[k]:.1f} deg, "
        f"computed from t_utc and the place of {site.name}",
        "check t_utc, the sign of the site's longitude and the order of the rows, or empty "
        "both sun columns",
    )


def _check_irradiance(path: Path, rows: Sequence[PairRow], altitude_deg: Floats) -> None:
    top = sun.extraterrestrial_wm2([row.t_utc for row in rows])
    dni, dhi = np.array([(row.dni_wm2, row.dhi_wm2) for row in rows]).T
    sine = np.sin(np.radians(np.maximum(altitude_deg, 0.0)))
    up = altitude_deg > sun.CLEAR_SUN_DEG
    limits = sun.bsrn_limits(altitude_deg, top)
    weak = sun.too_weak(dhi + dni * sine, altitude_deg, top)
    for wrong, finding, remedy in (
        (
            dhi > limits.dhi_wm2[1],
            "more diffuse light than any sky gives",
            "check whether the column contains global irradiance",
        ),
        (
            dni > limits.dni_wm2[1],
            "more direct light than above the atmosphere",
            "correct the irradiance of that row, or set ok = 0",
        ),
        (
            weak,
            "less light than under the darkest clouds",
            "check whether the values are in kW/m2; otherwise set ok = 0",
        ),
    ):
        if (wrong & up).any():
            k = int(np.argmax(wrong & up))
            raise InputError(
                path,
                f"line {rows[k].line} has {finding}: DNI {dni[k]:g}, "
                f"DHI {dhi[k]:g} W/m2 with the sun at {altitude_deg[k]:.0f} deg",
                "possible irradiance in W/m2",
                remedy,
            )
