"""Read the sun disc centres that merge measured; fit north, level, clock, lens scale to them.

A late clock turns the sun about the celestial pole. Heading, tilt and roll of a camera together
form an arbitrary rotation, which includes that one: discs alone cannot separate the clock from
level and north. One of the two must be known from elsewhere: the clock by NTP or GPS, or the level
by a good spirit level.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Site, counted
from fieldlum.optics.projection import rotation
from fieldlum.session import Session
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.sky import sun

# Allowance for the lens model and the mount, which the sidecar's sigma_deg does not include: merge
# finds discs to 0.03 degrees (docs/merge.md), and no lens profile is better.
MIN_U_DEG = 0.02


@dataclass(frozen=True, slots=True)
class MeasuredDiscs:
    """Centres of n sun discs in panoramas, by the stated heading, with their recorded times.

    altitude_deg: apparent [n]; azimuth_deg: clockwise from north [n]; sigma_deg: standard
    uncertainty along each axis [n].
    """

    altitude_deg: Floats
    azimuth_deg: Floats
    sigma_deg: Floats
    t_utc: tuple[datetime, ...]

    def __len__(self) -> int:
        """Return the number of discs."""
        return len(self.t_utc)


NO_DISCS = MeasuredDiscs(np.zeros(0), np.zeros(0), np.zeros(0), ())


def read_discs(session: Session) -> MeasuredDiscs:
    """Return the sun discs in the sidecars (json files) of a session's panoramas, or an empty set.

    Sidecars without a measured disc or without a time are skipped. sigma_deg is at least 0.02.
    Raises InputError for a damaged sidecar.
    """
    times: list[datetime] = []
    rows: list[tuple[float, float, float]] = []  # altitude, azimuth and uncertainty
    for path in session.sidecar_files():
        sidecar = Sidecar.read(path)
        disc = sidecar.sun.measured if sidecar.sun else None
        if disc is not None and (when := disc.t_utc or sidecar.t_utc) is not None:
            times.append(when)
            rows.append((disc.altitude_deg, disc.azimuth_deg, max(disc.sigma_deg, MIN_U_DEG)))
    altitude, azimuth, sigma = np.array(rows, float).reshape(-1, 3).T
    return MeasuredDiscs(altitude, azimuth, sigma, tuple(times))


# ----------------------------------------------------------------------------------------------
# the pose from them

NAMES = ("heading_deg", "tilt_deg", "roll_deg", "lens_scale", "clock_min")
MIN_DISCS = 3  # six coordinates, one more than the five parameters
# Distance from the other discs at which one is a reflection or a lamp, in standard uncertainties;
# chosen.
_GROSS_SIGMAS = 5.0
# Apparent rotation of the sky: 360 degrees in a mean solar day; the sun's own motion in declination
# (at most 0.4 degrees a day) is below 0.003 degrees in ten minutes.
_SKY_TURN_DEG_PER_MIN = 0.25


@dataclass(frozen=True, slots=True)
class PoseFit:
    """What measured sun discs determine: values [5] and covariance [5, 5] in the order of `NAMES`.

    heading_deg: correction to add to the stated heading, clockwise. tilt_deg: how far the view axis
    points up; roll_deg: how far the picture's right-hand side is low. lens_scale: (true / stated
    angle from the lens's axis) - 1. clock_min: recorded time less true time [min]. rms_deg:
    distance of measured from computed discs without gross errors. dropped: indices from 0 of the
    discs that are gross errors.
    """

    values: Floats
    covariance: Floats
    rms_deg: float
    dropped: tuple[int, ...]

    @property
    def u(self) -> dict[str, float]:
        """Standard uncertainties by the names of `NAMES`, in the unit that a name ends with."""
        return dict(zip(NAMES, map(float, np.sqrt(np.diag(self.covariance))), strict=True))

    def __getitem__(self, name: str) -> float:
        """Return the fitted value of a parameter by its name in `NAMES`; else ValueError."""
        return float(self.values[NAMES.index(name)])


def fit_pose(
    discs: MeasuredDiscs,
    site: Site,
    axis_deg: float,
    prior_sd: Sequence[float],
    minimum: int = MIN_DISCS,
) -> PoseFit:
    """Fit north, level, lens scale and clock to n measured centres of the sun's disc.

    discs: by the stated heading, level and lens. axis_deg: the stated azimuth of the lens's axis,
    clockwise from north. prior_sd: standard uncertainties [5] before the fit, in the order of
    `NAMES`; each prior's mean is 0. The sun's position is by NREL SPA. Discs with gross errors are
    omitted if at least four others remain: they are over 5 standard uncertainties from their place,
    and over 5 times the median distance of all discs. Raises NotEnoughDataError for fewer than
    `minimum` discs.
    """
    from scipy.optimize import least_squares

    if len(discs) < minimum:
        needed = f"at least {minimum} are needed to fit north, level and clock"
        remedy = "capture clear hours with the sun in view"
        raise NotEnoughDataError(f"{counted(len(discs), 'measured sun disc')}, {needed}: {remedy}")
    place = sun.position(list(discs.t_utc), site)
    bent = place.apparent_altitude_deg - place.altitude_deg  # refraction [n] deg
    shown = sun.direction(discs.altitude_deg - bent, discs.azimuth_deg)
    suns = sun.direction(place.altitude_deg, place.azimuth_deg)
    sigma, prior = np.radians(discs.sigma_deg)[:, None], np.asarray(prior_sd, float)
    # excess: factor on the variance of the discs, by the scatter of the first fit
    keep, excess = np.ones(len(discs), bool), 1.0

    def off(values: Floats) -> Floats:
        """Return measured minus true directions over their uncertainty, [n, 3].

        values: pose and clock [5], in the order of `NAMES`.
        """
        heading, tilt, roll, scale, clock = values
        true = scaled(shown, scale, axis_deg) @ rotation(heading, tilt, roll, axis_deg).T
        return (true - sun_earlier(suns, clock, site.latitude_deg)) / sigma

    def residuals(units: Floats) -> Floats:
        """Return the residuals of discs and prior, by a pose in units of its prior_sd, [5]."""
        return np.append(off(units * prior)[keep] / np.sqrt(excess), units)

    start = least_squares(residuals, np.zeros(len(NAMES))).x
    robust = least_squares(residuals, start, loss="cauchy").x
    distance = np.linalg.norm(off(robust * prior), axis=1)
    gross = distance > _GROSS_SIGMAS * max(1.0, float(np.median(distance)))
    if len(discs) - gross.sum() > MIN_DISCS:
        keep = ~gross
    fit = least_squares(residuals, robust)
    residual = off(fit.x * prior)[keep]
    excess = max(1.0, float((residual**2).sum()) / max(2.0 * keep.sum() - len(NAMES), 1.0))
    fit = least_squares(residuals, fit.x)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * np.outer(prior, prior)
    rms_deg = np.degrees(np.sqrt(((residual * sigma[keep]) ** 2).sum(axis=1).mean()))
    return PoseFit(fit.x * prior, covariance, float(rms_deg), tuple(np.flatnonzero(~keep).tolist()))


def scaled(directions: Floats, scale: float, axis_deg: float) -> Floats:
    """Return directions [n, 3] with their angle from the axis times (1 + scale).

    directions: unit vectors, x east, y north, z up; axis_deg: azimuth of the lens's axis, clockwise
    from north, which is horizontal; the angle of directions behind the camera is that from the axis
    of a second lens, which faces backwards.
    """
    azimuth = np.radians(axis_deg)
    ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    axis = np.where((directions @ ahead)[:, None] < 0.0, -ahead, ahead)  # [n, 3]
    cosine = (directions * axis).sum(axis=1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    side = directions - cosine[:, None] * axis
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    wide = angle * (1.0 + scale)
    return np.cos(wide)[:, None] * axis + np.sin(wide)[:, None] * side


def sun_earlier(sun_direction: ArrayLike, minutes: float, latitude_deg: float) -> Floats:
    """Return the sun's directions `minutes` earlier (negative: later), [n, 3].

    sun_direction: [n, 3] unit vectors (x east, y north, z up); latitude_deg: north positive. The
    sky turns about the celestial pole from east to west.
    """
    from scipy.spatial.transform import Rotation

    angle = np.radians(_SKY_TURN_DEG_PER_MIN * minutes)  # counter-clockwise about the pole
    turn = Rotation.from_rotvec(angle * sun.celestial_pole(latitude_deg))
    return turn.apply(np.asarray(sun_direction, float))
