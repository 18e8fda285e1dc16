"""Estimate the camera's true pose from the sun's discs in its captures, and what they leave open.

Three discs determine heading, tilt, roll and the lens's scale. One or two leave a combination of
them open, which the covariance and a sentence describe. Without a disc the pose is as stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.optics.projection import altitude_azimuth_deg, direction, rotation, signed_angle_deg
from fieldlum.sky.sky_view import measured_discs

# Standard uncertainties of a stated pose: a compass near steel is within 5 degrees (two standard
# deviations), a spirit level on a camera within 1 degree, a lens profile within 1 %. Chosen.
STATED_SD = (2.5, 0.5, 0.5, 0.005)
_CLOCK_SD_MIN = 0.3  # of `capture` with NTP, and of `import` after comparing clocks; chosen
# Distance of a measured disc that the lens model, the mount and bars before the disc explain: a
# calibrated lens is right to 0.1 degrees (docs/calibration.md). Chosen.
_LENS_U_DEG = 0.07
# Fewer than three discs cannot tell a reflection from a wrong pose: beyond this many standard
# uncertainties of the stated pose they are not used.
_CONTRADICTION = 3.5
_OPEN_DEG = 0.1  # a combination less certain than this is stated; half of the disc's radius


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPose:
    """The pose of a camera: corrections of the stated one, with their covariance.

    heading_deg, tilt_deg, roll_deg: angles of `projection.rotation`, 0 for the stated pose;
    lens_scale: (true / stated angle from the lens's axis) - 1. covariance [4, 4]: of these four in
    this order. axis_deg: stated azimuth of the lens's axis, clockwise from north. discs: number of
    sun discs that determine it. notes: sentences for the user.
    """

    heading_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    lens_scale: float = 0.0
    covariance: tuple[tuple[float, ...], ...] = tuple(
        tuple(sd**2 if i == j else 0.0 for j in range(4)) for i, sd in enumerate(STATED_SD)
    )
    axis_deg: float = 180.0
    discs: int = 0
    notes: tuple[str, ...] = ()

    @property
    def values(self) -> Floats:
        """Corrections of heading, tilt and roll [deg], and the lens scale, [4]."""
        return np.array([self.heading_deg, self.tilt_deg, self.roll_deg, self.lens_scale])

    @property
    def heading_sd_deg(self) -> float:
        """Standard uncertainty of the heading [deg]."""
        return float(np.sqrt(self.covariance[0][0]))

    def drawn(self, rng: np.random.Generator, count: int) -> Floats:
        """Return `count` random draws of `values`, by their covariance, [count, 4]."""
        covariance = np.asarray(self.covariance, float)
        return rng.multivariate_normal(self.values, covariance, count, method="eigh")

    def moved(self, values: Floats, covariance: Floats, discs: int, *notes: str) -> CameraPose:
        """Return the pose with other values [4] and covariance [4, 4], and more notes.

        discs: number of discs that determine it.
        """
        named = dict(zip(measured_discs.NAMES[:4], map(float, values), strict=True))
        rows = tuple(tuple(map(float, row)) for row in covariance)
        notes = (*self.notes, *notes)
        return replace(self, **named, covariance=rows, discs=discs, notes=notes)

    def with_heading(self, by_deg: float, u_deg: float) -> CameraPose:
        """Return the pose after a measurement of its heading by the sky, with a note about it.

        by_deg, u_deg: measured minus present heading, and its standard uncertainty. Tilt, roll and
        lens scale change as far as they are correlated. A correction beyond 3.5 times the combined
        uncertainty is not used, which the note states.
        """
        text = f"heading {by_deg:+.1f} +- {u_deg:.1f} degrees by the sky's brightness about the sun"
        if abs(by_deg) > _CONTRADICTION * np.hypot(self.heading_sd_deg, u_deg):
            note = f"{text}: not used; check heading_deg in SITE.toml"
            return replace(self, notes=(*self.notes, note))
        after = self._updated(by_deg, u_deg)
        note = f"{text}; used: {after.heading_deg:+.1f} +- {after.heading_sd_deg:.1f}"
        if not self.discs:
            note += f"; level as stated, to {2 * STATED_SD[1]:g} degrees"
        return replace(after, notes=(*(n for n in self.notes if n != _NO_DISC), note))

    def turned(self, north_deg: float, u_deg: float) -> CameraPose:
        """Return the pose for a stated heading that was corrected by `north_deg` +- `u_deg`.

        Its own correction of the heading is reduced by as much, then averaged with 0 +- `u_deg` by
        the uncertainties: a pose by discs hardly changes, another one takes the corrected heading.
        """
        rest_deg, axis_deg = self.heading_deg - north_deg, (self.axis_deg + north_deg) % 360.0
        return replace(self, heading_deg=rest_deg, axis_deg=axis_deg)._updated(-rest_deg, u_deg)

    def at_clock(self, late_min: float, latitude_deg: float) -> CameraPose:
        """Return the pose by which its discs agree if their times were `late_min` minutes too late.

        Camera and sky then turn together about the celestial pole. A pose without discs does not
        change. latitude_deg: of the site.
        """
        if not self.discs or not late_min:
            return self
        stated = rotation(self.heading_deg, self.tilt_deg, self.roll_deg, self.axis_deg)
        axes = direction(0.0, self.axis_deg + np.array([0.0, 90.0]))  # ahead and to the right
        view, side = measured_discs.sun_earlier(axes @ stated.T, late_min, latitude_deg)
        tilt_deg, azimuth_deg = altitude_azimuth_deg(view)
        roll_deg = -np.degrees(np.arcsin(side[2] / np.cos(np.radians(tilt_deg))))
        heading_deg = signed_angle_deg(azimuth_deg - self.axis_deg)
        values = np.array([heading_deg, tilt_deg, roll_deg, self.lens_scale])
        return self.moved(values, np.asarray(self.covariance), self.discs)

    def _updated(self, by_deg: float, u_deg: float) -> CameraPose:
        """Return the pose after a measured correction to its heading, as a Kalman filter does."""
        covariance = np.asarray(self.covariance, float)
        gain = covariance[:, 0] / (covariance[0, 0] + u_deg**2)  # [4]
        after = np.asarray(covariance - np.outer(gain, covariance[0]), float)
        return self.moved(self.values + gain * by_deg, after, self.discs)

    def in_pictures(self, suns: Floats, values: Floats | None = None) -> Floats:
        """Return the directions at which pictures, read by the stated pose, show true ones, [n, 3].

        suns: the true directions, unit vectors [n, 3] (x east, y north, z up). values [4]: of
        another pose, such as a draw; None for this pose's.
        """
        heading, tilt, roll, scale = self.values if values is None else values
        turned = suns @ rotation(heading, tilt, roll, self.axis_deg)  # inverse: the transpose
        return measured_discs.scaled(turned, 1.0 / (1.0 + scale) - 1.0, self.axis_deg)

    def true_directions(self, shown: Floats) -> Floats:
        """Return the true directions of what the pictures show, [n, 3]: inverse of `in_pictures`.

        shown: directions by the stated pose. All are unit vectors, x east, y north, z up.
        """
        turn = rotation(self.heading_deg, self.tilt_deg, self.roll_deg, self.axis_deg)
        return measured_discs.scaled(shown, self.lens_scale, self.axis_deg) @ turn.T


def pose_of_discs(discs: measured_discs.MeasuredDiscs, site: Site, axis_deg: float) -> CameraPose:
    """Return the pose that agrees best with the measured discs and the stated pose.

    axis_deg: stated azimuth of the lens's axis, clockwise from north. The result is the stated pose
    if there is no disc, or if there are only one or two and these contradict it.
    """
    stated = CameraPose(axis_deg=axis_deg)
    if not len(discs):
        return replace(stated, notes=(_NO_DISC,))
    prior = (*STATED_SD, _CLOCK_SD_MIN)
    blurred = replace(discs, sigma_deg=np.hypot(discs.sigma_deg, _LENS_U_DEG))
    fit = measured_discs.fit_pose(blurred, site, axis_deg, prior, minimum=1)
    used = len(discs) - len(fit.dropped)
    if used < measured_discs.MIN_DISCS and np.max(np.abs(fit.values) / prior) > _CONTRADICTION:
        note = (
            f"measured sun discs contradict the stated pose: {used} ({_angles(fit)}), not used: "
            "check the heading in SITE.toml, or capture three clear hours with the sun in view"
        )
        return replace(stated, notes=(note,))
    dropped = f"; {len(fit.dropped)} omitted as gross errors" if fit.dropped else ""
    note = (
        f"pose by {counted(len(discs), 'measured sun disc')}{dropped}: {_angles(fit)}, lens scale "
        f"{100 * fit['lens_scale']:+.2f} +- {100 * fit.u['lens_scale']:.2f} %"
    )
    covariance = fit.covariance[:4, :4]
    notes = filter(None, (note, open_combination(covariance)))
    return stated.moved(fit.values[:4], covariance, used, *notes)


_NO_DISC = (
    f"no capture shows the sun's disc: heading and level are as stated, to {2 * STATED_SD[0]:g} "
    f"and {2 * STATED_SD[1]:g} degrees; a capture of a clear hour with the sun in view would "
    "settle them"
)
_ANGLES = ("heading", "tilt", "roll")


def _angles(fit: measured_discs.PoseFit) -> str:
    """Return heading, tilt and roll of a fit with their uncertainties, as text."""
    parts = (f"{n} {fit[f'{n}_deg']:+.2f} +- {fit.u[f'{n}_deg']:.2f}" for n in _ANGLES)
    return f"{', '.join(parts)} degrees"


def open_combination(covariance: Floats) -> str:
    """Return a sentence on the least certain combination of heading, tilt and roll; "" if small.

    It is "" if that standard uncertainty is under 0.1 degrees. covariance [4, 4]: of heading, tilt,
    roll [deg] and lens scale.
    """
    variances, parts = np.linalg.eigh(np.asarray(covariance)[:3, :3])
    sd, part = float(np.sqrt(max(variances[-1], 0.0))), parts[:, -1]
    if sd < _OPEN_DEG:
        return ""
    part = part * np.sign(part[np.argmax(np.abs(part))])  # the largest component is positive
    shown = np.flatnonzero(np.abs(part) > 0.3 * np.abs(part).max())
    together = " with ".join(f"{sd * part[k]:+.2f} {_ANGLES[k]}" for k in shown)
    return (
        f"the discs leave open by {sd:.2f} degrees (standard uncertainty): {together}; a clear "
        "hour with the sun elsewhere in the window would settle it"
    )
