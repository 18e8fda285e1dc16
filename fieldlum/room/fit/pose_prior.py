"""Estimate the camera's pose and clock from sun discs in panoramas, before sun patches are used."""

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.parameters import LEVEL_SD_DEG, NORTH_SD_DEG, POSE_NAMES
from fieldlum.sky.sky_view import measured_discs
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs, PoseFit, fit_pose

# uncertainty of an equidistant model without a lens calibration; chosen, not measured
_LENS_SCALE_SD = 0.01
# names in `measured_discs.NAMES`, in the order of `POSE_NAMES`
_FITTED = ("heading_deg", "tilt_deg", "roll_deg", "clock_min")


@dataclass(frozen=True, slots=True)
class PosePrior:
    """A normal distribution of north, tilt, roll [deg] and clock [min], in this order.

    values: the mean [4]; covariance [4, 4]: in products of these units. Signs are those of `Guess`.
    """

    values: Floats
    covariance: Floats

    def deviations(self, guess: Guess) -> Floats:
        """Return how far a guess's pose and clock are from the mean, in standard deviations [4].

        Their squares add up to the squared Mahalanobis distance.
        """
        off = np.array([getattr(guess, name) for name in POSE_NAMES]) - self.values
        return np.linalg.solve(np.linalg.cholesky(self.covariance), off)

    def applied(self, guess: Guess) -> Guess:
        """Return the guess with the mean pose and clock."""
        return replace(guess, **dict(zip(POSE_NAMES, self.values.tolist(), strict=True)))


def pose_of(
    discs: MeasuredDiscs, site: Site, heading_deg: float, clock_sd_min: float
) -> PoseFit | None:
    """Return the pose and clock that three or more discs determine; None for fewer.

    heading_deg: stated azimuth of the lens's axis, clockwise from north; clock_sd_min: standard
    uncertainty of the times. The other standard uncertainties before the fit are 2 degrees for
    north, 0.3 for tilt and roll, and 1 % for the lens scale.
    """
    if len(discs) < measured_discs.MIN_DISCS:
        return None
    prior = (NORTH_SD_DEG, LEVEL_SD_DEG, LEVEL_SD_DEG, _LENS_SCALE_SD, clock_sd_min)
    return fit_pose(discs, site, heading_deg, prior)


def prior_of(pose: PoseFit) -> PosePrior:
    """Return the fitted north, tilt, roll and clock as a prior of the search.

    The uncertainty of lens and mount, 0.02 degrees, is added (in quadrature) to those of the three
    angles.
    """
    rows = [measured_discs.NAMES.index(name) for name in _FITTED]
    least = np.diag([measured_discs.MIN_U_DEG**2] * 3 + [0.0])
    covariance = pose.covariance[np.ix_(rows, rows)] + least
    return PosePrior(pose.values[rows], covariance)


def pose_note(pose: PoseFit, discs: int) -> str:
    """Return a sentence with the fitted pose and clock, their uncertainties and the residual.

    discs: number of measured discs, including those that were omitted as gross errors.
    """
    differences = ", ".join(
        f"{kind} {pose[name]:+.2f} +- {pose.u[name]:.2f} {unit}"
        for name in _FITTED
        for kind, _, unit in [name.rpartition("_")]
    )
    left_out = f"; omitted as gross errors: {len(pose.dropped)}" if pose.dropped else ""
    found = f"correction by {counted(discs, 'measured sun disc')} (rms {pose.rms_deg:.2f} degrees)"
    return f"{found}: {differences}{left_out}"
