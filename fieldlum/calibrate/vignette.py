"""Fit vignetting by an even polynomial that falls towards the edge.

Its order is the smallest that the readings support.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldlum.calibrate.frames import Place, linear_frame, nearest_lens, relative_angle
from fieldlum.calibrate.model_selection import OrderSelection, fit_and_choose
from fieldlum.calibrate.readings_csv import columns_of, needed, read_table
from fieldlum.core.arrays import Array, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.statistics import robust_sigma
from fieldlum.optics.photometry import check_vignetting, vignetting_at
from fieldlum.optics.profiles import CameraProfile, Lens, Vignetting
from fieldlum.optics.projection import angle_of_radius, relative_radius

# of the even polynomials that are tried; chosen, held-out readings select one
ORDERS = (0, 2, 4, 6, 8)
BINS = 60  # number of rings of an evenly lit frame; chosen
LEAST = 5  # least number of readings; chosen
# A reading is a gross error if it misses by more than both (sigma; relative) and its neighbours do
# not. Chosen, not measured.
FAR_SIGMA = 5.0
FAR = 0.03
NEIGHBOURS = 0.12  # of the half angle: distance within which readings are neighbours; chosen
SAME = 0.02  # of the half angle: distance within which readings have one angle; chosen
BEYOND = 1.02  # of the half angle: readings further out are errors; chosen
RISING = 0.03  # a parabola that rises by more than this to the edge means a wrong sign; chosen


@dataclass(frozen=True, slots=True)
class Samples:
    """Readings [n] of one aperture and lens.

    r : angle from the axis over half of the lens's full angle; value : in any linear unit; u_rel :
    relative uncertainty of the value; lens : index of the lens in the profile; frames : files.
    Readings of equal angle are held out together. places : of the readings, if they are patches.
    """

    r: Array
    value: Array
    u_rel: Array
    f_number: float
    lens: int
    frames: tuple[Path, ...]
    places: tuple[Place, ...] = ()


@dataclass(frozen=True, slots=True)
class VignettingFit:
    """A fitted vignetting curve: transmission relative to the axis, in powers of r of `Samples`.

    u_rel : relative rms of held-out readings; residual_rel [n] : reading over fit minus 1, also
    for omitted readings. coefficients : of the powers 0, 1, 2 ... of r; the first is 1. level :
    the readings' value on the axis. choice : how the number of powers was chosen.
    """

    coefficients: tuple[float, ...]
    level: float
    u_rel: float
    residual_rel: Array
    choice: OrderSelection


# ----------------------------------------------------------------------------------------------
# readings


def from_table(path: Path, profile: CameraProfile, lens: int = 0) -> Samples:
    """Read readings from a csv with angle_deg and value, or of one patch in many frames.

    The second form has the columns file, x_px and y_px. Optional columns: reference (a meter's
    reading at that time, which corrects the drift of a lamp); u_rel and f_number in the first form;
    radius_px of the patch (default 12) in the second. lens : index for the first form; the second
    has the lens that shows the first patch. Raises InputError for other columns or values.
    """
    if "angle_deg" in columns_of(path):
        rows = read_table(path, ("angle_deg", "value"), ("reference", "u_rel", "f_number"))
        half = profile.lens[lens].full_angle_deg / 2
        r = np.array([abs(needed(row, "angle_deg", path)) / half for row in rows])
        if r.max() > BEYOND:
            raise InputError(
                path,
                f"an angle_deg of {half * r.max():g} deg",
                f"at most {half:g} deg, half of the profile's full_angle_deg",
                "check that angles are from the optical axis, or correct full_angle_deg",
            )
        value = np.array(
            [needed(row, "value", path) / (row.get("reference") or 1.0) for row in rows]
        )
        u = np.array([row.get("u_rel") or 0.005 for row in rows])
        return Samples(
            r, value, u, rows[0].get("f_number") or profile.bracket.f_number, lens, (path,)
        )
    rows = read_table(path, ("file", "x_px", "y_px"), ("radius_px", "reference"))
    return _from_patches(path, rows, profile)


def _from_patches(path: Path, rows: Sequence[dict], profile: CameraProfile) -> Samples:
    weights = np.array(profile.colour.y_from_rgb)
    lens = nearest_lens(profile, needed(rows[0], "x_px", path), needed(rows[0], "y_px", path))
    r, value, u, f_numbers = [], [], [], {}
    for row in rows:
        x, y = needed(row, "x_px", path), needed(row, "y_px", path)
        file = needed(row, "file", path)
        frame = linear_frame(file, profile)
        patch = frame.patch(x, y, row.get("radius_px") or 12.0)
        r.append(relative_angle(profile.lens[lens], x, y))
        value.append(float(patch.rgb @ weights) / (row.get("reference") or 1.0))
        u.append(float(np.hypot(patch.u_rel, 0.002)))
        f_numbers[file] = frame.exposure.f_number
    f_number = _one_aperture(path, f_numbers, "write one table for each aperture")
    files = tuple(row["file"] for row in rows)
    places = tuple(Place(row["file"], row["x_px"], row["y_px"]) for row in rows)
    return Samples(np.array(r), np.array(value), np.array(u), f_number, lens, files, places)


def _one_aperture(source: Path, f_numbers: dict[Path, float], remedy: str) -> float:
    """Return the f-number of all frames. Raises InputError if they have several."""
    several = sorted(set(f_numbers.values()))
    if len(several) > 1:
        shown = "; ".join(
            f"f/{n:g}: {_names([file for file, other in f_numbers.items() if other == n])}"
            for n in several
        )
        raise InputError(
            source, f"frames with several apertures ({shown})", "frames with one aperture", remedy
        )
    return several[0]


def _names(files: Sequence[Path]) -> str:
    return ", ".join(file.name for file in files[:3]) + (" ..." if len(files) > 3 else "")


def from_uniform(paths: Sequence[Path], profile: CameraProfile, lens: int = 0) -> Samples:
    """Read frames of an evenly lit field (a sphere, a diffuser) as medians over 60 rings.

    lens : index of the lens in the profile; rings are of equal angle from its axis. Each frame
    gives its own readings. Raises InputError for frames of several apertures, or if all pixels are
    saturated or dark.
    """
    geometry, rings = profile.lens[lens].geometry, []
    weights, f_numbers = np.array(profile.colour.y_from_rgb), {}
    for path in paths:
        frame = linear_frame(path, profile)
        h, w = frame.bad.shape
        y, x = (np.mgrid[:h, :w] + 0.5) * frame.step
        radius = relative_radius(geometry, x, y)
        r = angle_of_radius(geometry, radius) / geometry.half_angle_rad
        rings += _rings(r, frame.rgb @ weights, ~frame.bad & (radius < 0.99))
        f_numbers[path] = frame.exposure.f_number
    f_number = _one_aperture(paths[0], f_numbers, "fit each aperture separately")
    if not rings:
        raise InputError(
            paths[0],
            "all pixels are saturated or dark",
            "a frame exposed to the middle of its range",
            "take a frame whose centre is at half of saturation",
        )
    table = np.array(rings)
    return Samples(table[:, 0], table[:, 1], table[:, 2], f_number, lens, tuple(paths))


def _rings(r: Array, value: Array, good: Mask) -> list[tuple[float, float, float]]:
    ring = np.minimum((r * BINS).astype(int), BINS - 1)
    rings = []
    for number in range(BINS):
        inside = value[good & (ring == number)]
        if len(inside) >= 20:
            spread = robust_sigma(inside) / np.sqrt(len(inside))
            middle = float(np.median(inside))
            rings.append(
                ((number + 0.5) / BINS, middle, float(np.hypot(1.25 * spread / middle, 0.001)))
            )
    return rings


# ----------------------------------------------------------------------------------------------
# fit


def _design(r: Array, order: int) -> Array:
    return np.stack([r**power for power in range(0, order + 1, 2)], axis=1)


def _falling(r: Array, value: Array, u_rel: Array, order: int) -> Array:
    """Fit level * V(r) in even powers of r by least squares, with V' <= 0 up to the edge."""
    from scipy.optimize import LinearConstraint, minimize

    scale = float(np.median(value))
    a, b = _design(r, order) / (u_rel * value / scale)[:, None], 1.0 / u_rel
    theta = np.linalg.lstsq(a, b, rcond=None)[0]
    if order == 0:
        return theta * scale
    grid = np.linspace(0.02, 1.0, 50)
    slope = np.stack(
        [power * grid ** (power - 1) if power else 0 * grid for power in range(0, order + 1, 2)],
        axis=1,
    )
    if (slope @ theta).max() > 1e-9:
        hessian, gradient = a.T @ a, a.T @ b
        size = float(np.trace(hessian))
        solution = minimize(
            lambda t: 0.5 * (t @ hessian @ t - 2 * t @ gradient) / size,
            np.array([1.0] + [0.0] * (len(theta) - 1)),
            jac=lambda t: (hessian @ t - gradient) / size,
            constraints=[LinearConstraint(slope, -np.inf, 0.0)],
            method="SLSQP",
            options={"maxiter": 400, "ftol": 1e-15},
        )
        theta = solution.x
    return theta * scale


def fit(samples: Samples) -> VignettingFit:
    """Fit an even polynomial V(r) of the smallest order that the readings support.

    V is the transmission relative to the axis; r is the angle over half of the lens's full angle.
    Readings that contradict their neighbours, less than a quarter, are omitted and listed in the
    choice's line. Raises NotEnoughDataError for fewer than five readings, or none from r = 0.5 on;
    InputError for readings that are not positive or rise to the edge.
    """
    r, value, u = samples.r, samples.value, samples.u_rel
    if len(r) < LEAST or r.max() < 0.5:
        raise NotEnoughDataError(
            f"{samples.frames[0]}: {len(r)} readings up to {100 * r.max(initial=0):.0f} % of "
            f"the lens's half angle; expected at least {LEAST} readings, the outermost at 50 % or "
            "further; add readings, and check that angles are in degrees"
        )
    if not (np.isfinite(value).all() and (value > 0).all()):
        bad = int(np.flatnonzero(~(np.isfinite(value) & (value > 0)))[0])
        names = (samples.frames[0], samples.frames[-1])
        raise InputError(
            names[0] if names[0] == names[1] else f"{names[0]} to {names[1].name}",
            f"the reading at {100 * r[bad]:.0f} % of the half angle is {value[bad]:g}",
            "linear values above zero",
            "correct or remove this reading",
        )
    near = ~_slips(samples)
    left_out = ", ".join(f"one at {100 * a:.0f} % of the half angle" for a in r[~near])
    r, value, u = r[near], value[near], u[near]
    _refuse_rising(replace(samples, r=r, value=value, u_rel=u))
    groups = np.unique(np.round(r, 3), return_inverse=True)[1]
    orders = [order for order in ORDERS if order // 2 + 1 <= max(len(np.unique(groups)) // 2, 1)]
    _, theta, choice = fit_and_choose(
        f"vignetting f/{samples.f_number:g}",
        [(f"order {o}" if o else "no loss", o // 2, o) for o in orders],
        groups,
        lambda order, rows: _falling(r[rows], value[rows], u[rows], order),
        lambda order, t, held: (value[held] / (_design(r[held], order) @ t) - 1.0) ** 2,
    )
    even = theta / theta[0]
    coefficients = [0.0] * (2 * len(even) - 1)
    coefficients[::2] = even.tolist()
    residual = samples.value / (theta[0] * vignetting_at(tuple(coefficients), samples.r)) - 1.0
    if left_out:
        text = f"left out, because neighbouring readings differ: {left_out}"
        choice = replace(choice, line=f"{choice.line}; {text}")
    wrong = check_vignetting(tuple(coefficients))
    if wrong:
        raise InputError(
            samples.frames[0],
            wrong,
            "a curve that is above 0 up to the edge",
            "add readings up to the edge of the lens's image, and check the last ones",
        )
    u_rel = max(choice.rms, 0.001)
    return VignettingFit(tuple(coefficients), float(theta[0]), u_rel, residual, choice)


def _slips(samples: Samples) -> Mask:
    """Return a mask [n] of readings that contradict their neighbours.

    A shadow or a blinking lamp causes such readings. A reading is compared only if its neighbours
    are near the curve. At a steep rim several neighbouring readings are far from the curve: all of
    them are used.
    """
    r, value, u = samples.r, samples.value, samples.u_rel
    order = 4 if len(r) < 12 else 6
    nearby = np.abs(r[:, None] - r) < 2 * NEIGHBOURS
    off = np.array([v / np.median(value[row]) - 1.0 for v, row in zip(value, nearby, strict=True)])
    for _ in range(8):
        sigma = max(robust_sigma(off, 0.0), 1e-4)
        weight = np.minimum(2 * sigma / np.maximum(np.abs(off), 1e-12), 1.0) ** 2
        off = value / (_design(r, order) @ _falling(r, value, u / np.sqrt(weight), order)) - 1.0
    limit = max(FAR_SIGMA * robust_sigma(off, 0.0), FAR)
    slips = np.abs(off) > limit
    for i in np.flatnonzero(slips):
        away = np.where(np.arange(len(r)) == i, np.inf, np.abs(r - r[i]))
        same = off[away < SAME]
        # Compare with readings at the same angle, or else with readings on both sides.
        judged = same if len(same) else off[away < NEIGHBOURS]
        between = len(same) > 0 or r[i] < r.max()
        slips[i] = len(judged) > 0 and between and np.median(np.abs(judged)) < limit / 2
    return slips if slips.mean() < 0.25 else np.zeros(len(r), bool)


def _refuse_rising(samples: Samples) -> None:
    """Raise InputError for values that rise, which are corrections and not losses.

    This sign error is common: the result would darken where it should brighten.
    """
    a = _design(samples.r, 2) / (samples.u_rel * samples.value)[:, None]
    theta, *_ = np.linalg.lstsq(a, 1.0 / samples.u_rel, rcond=None)
    rise = float(theta[1] / theta[0])
    if rise > RISING:
        raise InputError(
            samples.frames[0],
            f"the readings rise by {100 * rise:.0f} % from the axis to the edge",
            "a loss towards the edge",
            "state readings, not correction factors, of one patch with the same light in all "
            "frames",
        )


def with_curve(lens: Lens, f_number: float, vignetting: VignettingFit) -> Lens:
    """Return the lens with the fitted curve added; an older curve of this aperture is replaced."""
    others = tuple(v for v in lens.vignetting if abs(v.f_number - f_number) > 1e-6)
    curve = Vignetting(
        f_number, tuple(round(c, 6) for c in vignetting.coefficients), round(vignetting.u_rel, 5)
    )
    return replace(lens, vignetting=tuple(sorted((*others, curve), key=lambda v: v.f_number)))
