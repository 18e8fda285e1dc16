"""Estimate the camera's true pose from the sun's discs in its captures, and state what is open.

Three discs determine heading, tilt, roll and the lens's scale. One or two leave a combination of
them open, which the covariance and a sentence describe. Without a disc the pose is as stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import JsonTable, Site
from fieldlum.optics.projection import rotation
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs
from fieldlum.sky.sky_view.sun_discs import NAMES, PoseFit, fit_pose, scaled

# Standard uncertainties of a stated pose: a compass near steel is within 5 degrees (two standard
# deviations), a spirit level on a camera within 1 degree, a lens profile within 1 %. Chosen.
STATED_SD = (2.5, 0.5, 0.5, 0.005)
# Recorded times of `capture` with NTP, and of `import` after comparing clocks. Chosen.
CLOCK_SD_MIN = 0.3
# Distance of a measured disc that the lens model and the mount explain: a calibrated lens is right
# to 0.1 degrees (docs/calibration.md). Chosen.
_LENS_U_DEG = 0.07
# A partly hidden disc's centre is away from the sun's by up to half of its radius.
_PARTLY_HIDDEN_U_DEG = 0.13
_PARTLY_HIDDEN_SHARE = (
    0.8  # of the illuminance of the brightest discs, relative to the beam; chosen
)
# Fewer than three discs cannot tell a reflection from a wrong pose: beyond this many standard
# uncertainties of the stated pose they are not used.
_CONTRADICTION = 3.5
_SITE = "heading_deg in SITE.toml"
_OPEN_DEG = 0.1  # a combination less certain than this is stated; half of the disc's radius
_SHOWN_SHARE = 0.3  # of a combination's largest part, below which a part is not named


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The pose of a camera: corrections of the stated one, with their covariance.

    heading_deg, tilt_deg, roll_deg: as of `projection.rotation`; lens_scale: true over stated angle
    from the lens's axis, minus 1. covariance [4, 4]: of these four in this order. axis_deg: stated
    azimuth of the lens's axis. discs: number of discs used. notes: sentences for the user.
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
        """Standard uncertainty of the heading."""
        return float(np.sqrt(self.covariance[0][0]))

    @property
    def level_sd_deg(self) -> float:
        """Standard uncertainty of tilt or roll, the larger."""
        return float(np.sqrt(max(self.covariance[1][1], self.covariance[2][2])))

    @classmethod
    def from_table(cls, table: JsonTable) -> CameraPose:
        """Build from a JSON object of the fields. Raises TypeError or KeyError for another one."""
        covariance = tuple(tuple(map(float, row)) for row in table["covariance"])
        return cls(**{**table, "covariance": covariance, "notes": tuple(table["notes"])})

    def drawn(self, rng: np.random.Generator, count: int) -> Floats:
        """Return draws of the four values, [count, 4]."""
        covariance = np.asarray(self.covariance, float)
        return rng.multivariate_normal(self.values, covariance, count, method="eigh")

    def with_heading(self, by_deg: float, u_deg: float) -> CameraPose:
        """Return the pose with a measured correction to its heading; what is correlated follows.

        A correction beyond what both uncertainties explain is named, and not used.
        """
        covariance = np.asarray(self.covariance, float)
        variance = float(covariance[0, 0]) + u_deg**2
        text = f"{by_deg:+.1f} +- {u_deg:.1f} degrees by the sky's brightness about the sun"
        if abs(by_deg) > _CONTRADICTION * np.sqrt(variance):
            return replace(self, notes=(*self.notes, f"heading {text}: not used; check {_SITE}"))
        gain = covariance[:, 0] / variance  # [4]: Kalman
        after = covariance - np.outer(gain, covariance[0])
        heading, tilt, roll, scale = (float(v) for v in self.values + gain * by_deg)
        rows = tuple(tuple(float(v) for v in row) for row in after)
        note = f"heading {text}; used: {heading:+.1f} +- {np.sqrt(after[0, 0]):.1f}"
        return CameraPose(
            heading, tilt, roll, scale, rows, self.axis_deg, self.discs, (*self.notes, note)
        )

    def in_pictures(self, suns: Floats, values: Floats | None = None) -> Floats:
        """Return where the pictures show true directions [n, 3], in the stated pose, [n, 3].

        values: another pose's four values, such as a draw; None for this pose's.
        """
        heading, tilt, roll, scale = self.values if values is None else values
        turned = suns @ rotation(heading, tilt, roll, self.axis_deg)  # inverse: the transpose
        return scaled(turned, 1.0 / (1.0 + scale) - 1.0, self.axis_deg)

    def true_directions(self, shown: Floats) -> Floats:
        """Return the true directions of what pictures show in stated directions [n, 3], [n, 3]."""
        turn = rotation(self.heading_deg, self.tilt_deg, self.roll_deg, self.axis_deg)
        return scaled(shown, self.lens_scale, self.axis_deg) @ turn.T


def pose_of_discs(
    discs: MeasuredDiscs,
    site: Site,
    axis_deg: float,
    shares: Floats | None = None,
    clock_sd_min: float = CLOCK_SD_MIN,
) -> CameraPose:
    """Return the pose that the discs of a session's captures give, together with the stated one.

    axis_deg: stated azimuth of the lens's axis. shares: illuminance of each disc over that of the
    beam [n], NaN if unknown; dim discs are partly hidden, and their centre counts less.
    clock_sd_min: standard uncertainty of the recorded times. The result is the stated pose without
    a disc, and with one or two that contradict it.
    """
    if not len(discs):
        return CameraPose(axis_deg=axis_deg, notes=(_NO_DISC,))
    sigma = np.hypot(discs.sigma_deg, _LENS_U_DEG)
    if shares is not None and np.isfinite(shares).any():
        full = float(np.nanpercentile(shares, 90))
        hidden = np.nan_to_num(shares, nan=full) < _PARTLY_HIDDEN_SHARE * full
        sigma = np.where(hidden, np.hypot(sigma, _PARTLY_HIDDEN_U_DEG), sigma)
    heading, tilt, roll, scale = STATED_SD
    prior = (heading, tilt, roll, clock_sd_min, scale)
    fit = fit_pose(
        discs.altitude_deg,
        discs.azimuth_deg,
        sigma,
        discs.t_utc,
        site,
        axis_deg,
        prior,
        least=1,
    )
    used = len(discs) - len(fit.dropped)
    off = float(np.max(np.abs(fit.values) / np.array(prior)))
    if used < 3 and off > _CONTRADICTION:
        return CameraPose(axis_deg=axis_deg, notes=(_contradiction(fit, used),))
    rows = [NAMES.index(f"{name}_deg") for name in ("heading", "tilt", "roll")]
    rows.append(NAMES.index("lens_scale"))
    covariance = fit.covariance[np.ix_(rows, rows)]
    return CameraPose(
        fit["heading_deg"],
        fit["tilt_deg"],
        fit["roll_deg"],
        fit["lens_scale"],
        tuple(tuple(float(v) for v in row) for row in covariance),
        axis_deg,
        used,
        _notes(fit, covariance, len(discs)),
    )


_NO_DISC = (
    f"no capture shows the sun's disc: heading and level are as stated, to {2 * STATED_SD[0]:g} "
    f"and {2 * STATED_SD[1]:g} degrees; a capture of a clear hour with the sun in view would "
    "settle them"
)


def _contradiction(fit: PoseFit, used: int) -> str:
    parts = f"heading {fit['heading_deg']:+.1f}, tilt {fit['tilt_deg']:+.1f} degrees"
    return (
        f"{used} measured sun discs contradict the stated pose ({parts}) and are not used: check "
        "the heading in SITE.toml, or capture three clear hours with the sun in view"
    )


def _notes(fit: PoseFit, covariance: Floats, discs: int) -> tuple[str, ...]:
    names = ("heading", "tilt", "roll")
    sd = np.sqrt(np.diag(covariance))
    parts = ", ".join(
        f"{name} {fit[f'{name}_deg']:+.2f} +- {sd[k]:.2f}" for k, name in enumerate(names)
    )
    scale = f"lens scale {100 * fit['lens_scale']:+.2f} +- {100 * sd[3]:.2f} %"
    dropped = f"; {len(fit.dropped)} omitted as gross errors" if fit.dropped else ""
    first = f"pose by {discs} measured sun discs{dropped}: {parts} degrees, {scale}"
    open_text = open_combination(covariance)
    return (first, open_text) if open_text else (first,)


def open_combination(covariance: Floats) -> str:
    """Return a sentence on the least certain combination of heading, tilt and roll; "" if none.

    covariance [4, 4]: of heading, tilt, roll [deg] and lens scale.
    """
    names = ("heading", "tilt", "roll")
    variances, parts = np.linalg.eigh(np.asarray(covariance)[:3, :3])
    sd, part = float(np.sqrt(max(variances[-1], 0.0))), parts[:, -1]
    if sd < _OPEN_DEG:
        return ""
    part = part * np.sign(part[np.argmax(np.abs(part))])
    shown = [k for k in range(3) if abs(part[k]) > _SHOWN_SHARE * abs(part).max()]
    together = " with ".join(f"{sd * part[k]:+.2f} {names[k]}" for k in shown)
    return (
        f"the discs leave open by {sd:.2f} degrees (standard uncertainty): {together}; a clear "
        "hour with the sun elsewhere in the window would settle it"
    )
