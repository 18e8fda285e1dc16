"""Fit a lens's mapping and pose to targets at known directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldlum.calibrate.model_selection import OrderSelection, fit_and_choose, gross_errors
from fieldlum.calibrate.readings_csv import read_table
from fieldlum.core.arrays import Array, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.optics.profiles import Lens
from fieldlum.optics.projection import (
    LensGeometry,
    direction,
    lens_pixels,
    lens_rays,
    signed_angle_deg,
)

MIN_TARGETS = 8  # for the parameters of a lens with one free term, and its pose; chosen
# Powers of the polynomial mappings, from two to four terms. Chosen; held-out targets select one.
POWERS = {
    "two odd terms": (1, 3),
    "three odd terms": (1, 3, 5),
    "four terms": (1, 2, 3, 4),
}
# A target is a gross error if it misses by more than both: this many standard deviations, and this
# share of the radius. It is omitted and listed. Chosen, not measured.
OUTLIER_SIGMA, MIN_OUTLIER = 4.0, 0.02
MAX_OUTLIERS = 0.2  # largest share of targets that may be omitted; chosen
MISS_RADIUS = 0.01  # of the radius: with a larger median miss no lens fits the targets; chosen
BEYOND = 1.06  # of half of the full angle: targets further from the axis are errors; chosen
TURNED_DEG = 30.0  # a larger difference from the profile's pose causes a warning; chosen
_WANTED = "x right and y down in pixels, azimuth clockwise from the camera's heading, altitude up"

Model = tuple[str, tuple[int, ...]]  # the mapping, and the powers of a polynomial


@dataclass(frozen=True, slots=True)
class Targets:
    """Known directions of n targets, and their places on the sensor.

    x_px, y_px [n] : x to the right, y down. rays [n, 3] : unit vectors towards the targets, with y
    in the camera's heading, x to the right, z up. With pose_known y is the optical axis instead,
    and the fit does not change the lens's pose. frames : files, for errors and the profile.
    """

    x_px: Array
    y_px: Array
    rays: Array
    frames: tuple[Path, ...] = ()
    pose_known: bool = False

    @property
    def source(self) -> Path | str:
        """The first file, which errors about the targets name; "targets" without files."""
        return self.frames[0] if self.frames else "targets"


@dataclass(frozen=True, slots=True)
class LensFit:
    """A fitted lens, its held-out error, and warnings.

    residual_px [n] : distance of each target from its fitted place, omitted targets included;
    rms_px, rms_deg : rms distance of held-out targets, or of chessboard corners after
    `boards.fit`. widest_deg : largest angle of a target from the axis; the mapping extrapolates
    beyond it. choice : how the polynomial's order was chosen. doubts : sentences about omitted
    targets and a pose far from the profile's.
    """

    lens: Lens
    rms_px: float
    rms_deg: float
    residual_px: Array
    widest_deg: float
    choice: OrderSelection
    doubts: tuple[str, ...] = ()


# ----------------------------------------------------------------------------------------------
# known directions


def from_table(path: Path) -> Targets:
    """Read targets from a csv with the columns x_px, y_px, azimuth_deg and altitude_deg.

    azimuth_deg is clockwise from the camera's heading, altitude_deg upwards from the horizon; x_px
    is to the right, y_px down. Raises InputError for an invalid csv.
    """
    names = ("x_px", "y_px", "azimuth_deg", "altitude_deg")
    rows = read_table(path, names)
    x, y, azimuth, altitude = np.array([[row[n] for n in names] for row in rows]).T
    return Targets(x, y, direction(altitude, azimuth), (path,))


def geometry_of_figures(
    lens: Lens, figures: Array, mapping: str, powers: tuple[int, ...], pose: bool
) -> LensGeometry:
    """Return the lens geometry that the parameter vector of a fit describes.

    figures : [n], centre x, y and radius [px], then azimuth, tilt and roll [deg] if `pose` (else
    those of `lens` are used), then the polynomial's coefficients of all `powers` of the angle but
    the first, which follows because they add up to 1. powers : empty for other mappings. The full
    angle is that of `lens`.
    """
    x, y, radius, *rest = figures.tolist()
    angles = rest[:3] if pose else (lens.azimuth_deg, lens.tilt_deg, lens.roll_deg)
    coefficients: tuple[float, ...] = ()
    if mapping == "polynomial":
        terms = np.zeros(max(powers))
        extra = rest[3:] if pose else rest
        for power, share in zip(powers[1:], extra, strict=True):
            terms[power - 1] = share
        terms[powers[0] - 1] = 1.0 - sum(extra)  # r = 1 at half of the full angle
        coefficients = tuple(float(t) for t in terms)
    at = (x, y), radius
    return LensGeometry(*at, lens.full_angle_deg, mapping, coefficients, *angles)  # type: ignore


def _solve(
    targets: Targets, rows: Mask, lens: Lens, mapping: str, powers: tuple[int, ...]
) -> Array:
    from scipy.optimize import least_squares

    pose = not targets.pose_known
    start = [*lens.centre_px, lens.radius_px]
    start += [lens.azimuth_deg, lens.tilt_deg, lens.roll_deg] if pose else []
    start += [0.0] * (len(powers) - 1)
    scale = [lens.radius_px * 0.01] * 3 + ([1.0] * 3 if pose else []) + [0.05] * (len(powers) - 1)

    def misses(figures: Array) -> Array:
        x, y, _ = lens_pixels(
            geometry_of_figures(lens, figures, mapping, powers, pose), targets.rays[rows]
        )
        return np.concatenate([x - targets.x_px[rows], y - targets.y_px[rows]])

    return least_squares(misses, start, x_scale=scale, loss="soft_l1", f_scale=2.0, max_nfev=400).x


def fit(targets: Targets, lens: Lens) -> LensFit:
    """Fit centre, radius, pose and mapping by robust least squares in pixels.

    The fit starts from `lens`; with `targets.pose_known` the pose does not change. Mappings with
    none to three free terms are compared on held-out targets. Targets that no lens explains, at
    most a fifth, are omitted and listed in `doubts`. Raises NotEnoughDataError for fewer than eight
    targets; InputError for directions that are mirrored, outside the lens's full angle, or fit no
    lens.
    """
    n, pose = len(targets.x_px), not targets.pose_known
    if n < MIN_TARGETS:
        raise NotEnoughDataError(
            f"{n} targets for a lens; expected at least {MIN_TARGETS}, spread over the circle; add "
            "targets to the csv"
        )
    level = replace(lens, azimuth_deg=0.0, tilt_deg=0.0, roll_deg=0.0)
    start = _posed(targets, lens) if pose else level
    models: dict[str, Model] = {"equidistant": ("equidistant", ()), "equisolid": ("equisolid", ())}
    enough = {name: powers for name, powers in POWERS.items() if n >= 3 * (len(powers) + 5)}
    models |= {name: ("polynomial", powers) for name, powers in enough.items()}
    near = _near(targets, start, list(models.values()))
    kept = {name: getattr(targets, name)[near] for name in ("x_px", "y_px", "rays")}
    used = replace(targets, **kept)

    def squares(model: Model, figures: Array, held: Mask) -> Array:
        geometry = geometry_of_figures(start, figures, *model, pose)
        return _misses(geometry, used)[0][held] ** 2

    model, figures, choice = fit_and_choose(
        "lens",
        [(name, max(len(model[1]) - 1, 0), model) for name, model in models.items()],
        np.arange(near.sum()),
        lambda model, rows: _solve(used, rows, start, *model),
        squares,
        unit="px",
        scale=1.0,
    )
    geometry = geometry_of_figures(start, figures, *model, pose)
    residual, angle = _misses(geometry, targets)
    _check(geometry, residual[near], angle[near], targets)
    new = with_mapping(lens, geometry)
    if pose:
        azimuth = round(float(signed_angle_deg(geometry.azimuth_deg)), 4)
        tilt, roll = round(geometry.tilt_deg, 4), round(geometry.roll_deg, 4)
        new = replace(new, azimuth_deg=azimuth, tilt_deg=tilt, roll_deg=roll)
    per_px = lens.full_angle_deg / 2 / geometry.radius_px
    doubts = _doubts(targets, residual, near, new, lens)
    widest_deg = float(np.degrees(angle[near].max()))
    return LensFit(new, choice.rms, choice.rms * per_px, residual, widest_deg, choice, doubts)


def with_mapping(lens: Lens, geometry: LensGeometry) -> Lens:
    """Return `lens` with the centre, radius and mapping of `geometry`, rounded for the profile.

    Its full angle, pose and vignetting do not change.
    """
    return replace(
        lens,
        centre_px=(round(geometry.centre_px[0], 3), round(geometry.centre_px[1], 3)),
        radius_px=round(geometry.radius_px, 3),
        mapping=geometry.mapping,
        coefficients=tuple(round(c, 7) for c in geometry.coefficients),
    )


def _doubts(
    targets: Targets, residual: Array, near: Mask, new: Lens, before: Lens
) -> tuple[str, ...]:
    far = [
        f"{targets.x_px[i]:g}, {targets.y_px[i]:g} (off by {residual[i]:.0f} px)"
        for i in np.flatnonzero(~near)
    ]
    texts = [f"left out because no lens explains them: {'; '.join(far)}"] if far else []
    turn = new.geometry.axes() @ before.geometry.axes().T
    turned_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    if turned_deg > TURNED_DEG:
        pose = (
            f"azimuth {new.azimuth_deg:.1f}, tilt {new.tilt_deg:.1f}, roll {new.roll_deg:.1f} deg"
        )
        texts.append(
            f"the fitted pose ({pose}) is turned by {turned_deg:.0f} deg from the profile's pose: "
            "if the camera was not turned, state the targets' azimuths from the camera's "
            "heading, not from north"
        )
    return tuple(texts)


def _misses(geometry: LensGeometry, targets: Targets) -> tuple[Array, Array]:
    """Return each target's distance from its place by the lens [px], and its angle [rad].

    The angle is that from the lens's axis.
    """
    x, y, angle = lens_pixels(geometry, targets.rays)
    return np.hypot(x - targets.x_px, y - targets.y_px), angle


def _near(targets: Targets, start: Lens, models: Sequence[Model]) -> Mask:
    """Return a mask [n] of the targets that the best of the robust fits explains."""
    every, misses = np.ones(len(targets.x_px), bool), []
    for model in models:
        figures = _solve(targets, every, start, *model)
        geometry = geometry_of_figures(start, figures, *model, not targets.pose_known)
        misses.append(_misses(geometry, targets)[0])
    best = min(misses, key=lambda missed: float(np.median(missed)))
    limit = MIN_OUTLIER * start.radius_px
    return ~gross_errors(best, sigmas=OUTLIER_SIGMA, minimum=limit, max_share=MAX_OUTLIERS)


def _check(geometry: LensGeometry, missed: Array, angle: Array, targets: Targets) -> None:
    """Raise InputError for a lens that its own targets contradict."""
    if np.median(missed) > MISS_RADIUS * geometry.radius_px:
        finding = (
            f"with the lens that fits the targets best, half of them are over "
            f"{np.median(missed):.0f} px from where it puts them"
        )
        remedy = "check the targets' signs and units, and the columns x_px and y_px"
        raise InputError(targets.source, finding, _WANTED, remedy)
    if angle.max() > BEYOND * geometry.half_angle_rad:
        finding = (
            f"a target is {np.degrees(angle.max()):.0f} deg from the lens axis, and the lens ends "
            f"at {np.degrees(geometry.half_angle_rad):.0f} deg"
        )
        raise InputError(targets.source, finding, _WANTED, "correct the targets, or --full-angle")


def _posed(targets: Targets, lens: Lens) -> Lens:
    """Return the lens with the pose that its targets give.

    This lets the fit succeed for a turned camera. The pose is the rotation from measured to true
    directions. Raises InputError if only mirrored directions fit, which means that a sign is wrong.
    """
    level = replace(lens.geometry, azimuth_deg=0.0, tilt_deg=0.0, roll_deg=0.0)
    directions = lens_rays(level, targets.x_px, targets.y_px)
    (miss, turn), (mirrored, _) = (
        _turn(directions * (sign, 1.0, 1.0), targets.rays) for sign in (1.0, -1.0)
    )
    if mirrored < 0.5 * miss and miss > 0.1:
        raise InputError(
            targets.source,
            "the targets fit a lens only as a mirror image",
            "azimuth clockwise (to the right), altitude up, x right, y down",
            "check the targets for a wrong sign, or for x and y exchanged",
        )
    right, forward = turn[:, 0], turn[:, 1]
    azimuth = np.degrees(np.arctan2(forward[0], forward[1]))
    tilt = np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))
    level = direction(0.0, azimuth + 90.0)
    roll = np.degrees(np.arctan2(-right @ np.cross(level, forward), right @ level))
    return replace(lens, azimuth_deg=float(azimuth), tilt_deg=float(tilt), roll_deg=float(roll))


def _turn(directions: Array, true: Array) -> tuple[float, Array]:
    """Return the median distance (chord) of directions [n, 3] after rotation, and the rotation.

    The rotation [3, 3] solves Wahba's problem (1965), with less weight for gross errors.
    """
    from scipy.spatial.transform import Rotation

    weight, turn, off = np.ones(len(directions)), np.eye(3), np.zeros(len(directions))
    for _ in range(10):
        turn = Rotation.align_vectors(true, directions, weights=weight)[0].as_matrix()
        off = np.linalg.norm(true - directions @ turn.T, axis=1)
        weight = 1.0 / np.maximum(off, 0.02)
    return float(np.median(off)), turn
