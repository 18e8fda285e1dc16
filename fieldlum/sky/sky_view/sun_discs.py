"""Fit north, level, clock and lens scale to measured centres of the sun's disc, without a room.

A late clock turns the sun about the celestial pole. Heading, tilt and roll of a camera together
form an arbitrary rotation, which includes that one: discs alone cannot separate the clock from
level and north. One of the two must be known from elsewhere: the clock by NTP or GPS, or the level
by a good spirit level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Site
from fieldlum.optics.projection import rotation
from fieldlum.sky import sun
from fieldlum.sky.sky_view.sun_path import sun_earlier

NAMES = ("heading_deg", "tilt_deg", "roll_deg", "clock_min", "lens_scale")
# Standard uncertainties before any disc was measured: a compass near steel, a camera set by hand, a
# camera clock compared with NTP (`import` and `capture` record this), an equidistant lens model.
# Chosen.
PRIOR_SD = (5.0, 1.0, 1.0, 0.1, 0.01)
LEAST_DISCS = 3  # least number of discs: six coordinates, one more than the five parameters
# Chosen, not measured: distance from the other discs at which one is a reflection or a lamp; four
# times the steps that errors of a few degrees need; half of the prior's uncertainty, above which
# the discs did not determine a parameter; correlation at which only a combination of two parameters
# is known.
_GROSS_SIGMAS = 5.0
_STEPS = 12
_OPEN_SHARE = 0.5
_VALLEY_CORRELATION = 0.98


@dataclass(frozen=True, slots=True)
class PoseFit:
    """What measured sun discs determine: values [5] and covariance [5, 5] in the order of `NAMES`.

    heading_deg: correction to add to the stated heading. tilt_deg: how far the view axis points up;
    roll_deg: how far the picture's right-hand side is low. clock_min: recorded time less
    true time. lens_scale: true over stated angle from the lens's axis, minus 1. rms_deg: distance
    of measured from computed discs without gross errors. dropped: indices from 0 of the discs that
    are gross errors. open: names of parameters with over half of their uncertainty before the fit,
    and "A and B" for pairs correlated by over 0.98.
    """

    values: Floats
    covariance: Floats
    rms_deg: float
    dropped: tuple[int, ...]
    open: tuple[str, ...]

    @property
    def u(self) -> dict[str, float]:
        """Return standard uncertainties by the names of `NAMES`; lens_scale has no unit."""
        return dict(zip(NAMES, map(float, np.sqrt(np.diag(self.covariance))), strict=True))

    def __getitem__(self, name: str) -> float:
        return float(self.values[NAMES.index(name)])


def fit_pose(
    altitude_deg: ArrayLike,
    azimuth_deg: ArrayLike,
    sigma_deg: ArrayLike,
    t_utc: Sequence[datetime],
    site: Site,
    axis_deg: float,
    prior_sd: Sequence[float] = PRIOR_SD,
    least: int = LEAST_DISCS,
) -> PoseFit:
    """Fit north, level, clock and lens scale to n measured centres of the sun's disc.

    altitude_deg (apparent), azimuth_deg: [n], by the stated heading, level and lens; sigma_deg:
    [n], their standard uncertainty along each axis. t_utc: recorded times [n]. axis_deg: the stated
    azimuth of the lens's axis. prior_sd: standard uncertainties [5] before the fit, in the order of
    `NAMES`; each prior's mean is 0. The sun's position is by NREL SPA. Gross errors (5 sigma) are
    omitted, as long as four discs remain. Raises NotEnoughDataError for fewer than `least` discs.
    """
    altitude, azimuth, sigma = (
        np.atleast_1d(np.asarray(v, float)) for v in (altitude_deg, azimuth_deg, sigma_deg)
    )
    if len(altitude) < least:
        raise NotEnoughDataError(
            f"{len(altitude)} measured sun discs, but at least {least} are needed to "
            "fit north, level and clock: capture clear hours with the sun in view"
        )
    place = sun.position(list(t_utc), site)
    bent = place.apparent_altitude_deg - place.altitude_deg  # refraction [n] deg
    problem = _Problem(
        sun.direction(altitude - bent, azimuth),
        sun.direction(place.altitude_deg, place.azimuth_deg),
        np.radians(sigma),
        site.latitude_deg,
        axis_deg,
        np.asarray(prior_sd, float),
    )
    keep = np.ones(len(altitude), bool)
    while keep.sum() > LEAST_DISCS + 1:
        worst, sigmas = _least_explained(problem, keep)
        if sigmas < _GROSS_SIGMAS:
            break
        keep[worst] = False
    values, _ = problem.solve(keep)
    residual = problem.residuals(values)[keep]  # [m, 3] in sigmas
    excess = float((residual**2).sum()) / max(2.0 * keep.sum() - len(NAMES), 1.0)
    values, covariance = problem.solve(keep, max(1.0, excess))
    off_deg = np.degrees(np.linalg.norm(residual, axis=1) * problem.sigma[keep])
    return PoseFit(
        values,
        covariance,
        float(np.sqrt((off_deg**2).mean())),
        tuple(int(k) for k in np.flatnonzero(~keep)),
        _undetermined(covariance, problem.prior_sd),
    )


@dataclass(frozen=True, slots=True)
class _Problem:
    """The measurements and priors of a fit to n discs.

    measured, expected: directions [n, 3]; sigma: [n] rad; axis_deg: azimuth of the lens's axis;
    prior_sd: of heading, tilt, roll, clock and lens scale.
    """

    measured: Floats
    expected: Floats
    sigma: Floats
    latitude_deg: float
    axis_deg: float
    prior_sd: Floats

    def residuals(self, values: Floats) -> Floats:
        """Return measured minus true directions of the sun, in standard uncertainties, [n, 3]."""
        heading, tilt, roll, clock, scale = values
        true = scaled(self.measured, scale, self.axis_deg) @ (
            rotation(heading, tilt, roll, self.axis_deg).T
        )
        suns = sun_earlier(self.expected, clock, self.latitude_deg)
        return (true - suns) / self.sigma[:, None]

    def solve(self, keep: Mask, excess: float = 1.0) -> tuple[Floats, Floats]:
        """Return the parameters [5] and their covariance [5, 5], fitted with the priors.

        keep: which discs count [n]. excess: factor on the discs' variance, sigma squared.
        """
        values = np.zeros(len(NAMES))
        normal = np.eye(len(NAMES))
        for _ in range(_STEPS):
            base = self.residuals(values)[keep].ravel()
            slopes = np.stack(
                [
                    (self.residuals(values + step)[keep].ravel() - base) / step.max()
                    for step in np.diag(1e-4 * self.prior_sd)
                ],
                axis=1,
            )  # [3 m, 5]
            normal = slopes.T @ slopes / excess + np.diag(self.prior_sd**-2)
            values = values - np.linalg.solve(
                normal, slopes.T @ base / excess + values / self.prior_sd**2
            )
        return values, np.asarray(np.linalg.inv(normal), float)


def _least_explained(problem: _Problem, keep: Mask) -> tuple[int, float]:
    """Return the disc whose removal improves the fit of the others most, and its distance.

    The distance from that fit is in standard uncertainties of the disc and of the others' fit; the
    scatter of the others increases these.
    """
    worst, most, gain = -1, 0.0, 0.0
    for k in np.flatnonzero(keep):
        others = keep.copy()
        others[k] = False
        values, covariance = problem.solve(others)
        residuals = problem.residuals(values)
        chi2 = float((residuals[others] ** 2).sum())
        spread = max(1.0, chi2 / max(2.0 * others.sum() - len(NAMES), 1.0))
        slopes = np.stack(
            [
                (problem.residuals(values + step)[k] - residuals[k]) / step.max()
                for step in np.diag(1e-4 * problem.prior_sd)
            ],
            axis=1,
        )  # [3, 5]
        own = spread * (slopes @ covariance @ slopes.T + np.eye(3))
        sigmas = float(np.sqrt(residuals[k] @ np.linalg.solve(own, residuals[k])))
        if worst < 0 or chi2 < gain:
            worst, most, gain = int(k), sigmas, chi2
    return worst, most


def scaled(directions: Floats, scale: float, axis_deg: float) -> Floats:
    """Return directions [n, 3] with their angle from the axis times (1 + scale).

    axis_deg: azimuth of the lens's axis; directions behind the camera count from a second lens's.
    """
    a = np.radians(axis_deg)
    ahead = np.array([np.sin(a), np.cos(a), 0.0])
    axis = np.where((directions @ ahead)[:, None] < 0.0, -ahead, ahead)  # [n, 3]
    cosine = (directions * axis).sum(axis=1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    side = directions - cosine[:, None] * axis
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    wide = angle * (1.0 + scale)
    return np.cos(wide)[:, None] * axis + np.sin(wide)[:, None] * side


def _undetermined(covariance: Floats, prior_sd: Floats) -> tuple[str, ...]:
    """Return the names of undetermined parameters, and of strongly correlated pairs.

    An undetermined parameter has more than half of the prior's uncertainty.
    """
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    names = [
        name
        for name, after, before in zip(NAMES, sd, prior_sd, strict=True)
        if after > _OPEN_SHARE * before
    ]
    names += [
        f"{NAMES[i]} and {NAMES[j]}"
        for i in range(len(NAMES))
        for j in range(i)
        if abs(correlation[i, j]) > _VALLEY_CORRELATION
    ]
    return tuple(names)
