"""Fit vignetting by an even polynomial that falls towards the edge.

The order of the polynomial is the smallest that the readings support.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BPoly, PPoly
from scipy.optimize import least_squares, nnls

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place
from fieldlum.core.arrays import Array, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.statistics import median_standard_error, robust_sigma
from fieldlum.optics.camera_curves import check_vignetting, vignetting_at
from fieldlum.optics.profiles import CameraProfile, Lens, Vignetting
from fieldlum.optics.projection import angle_of_radius, relative_radius

# orders of the even polynomials that are tried; chosen, held-out readings select one
ORDERS = (0, 2, 4, 6, 8)
# Relative error that noise does not explain: a reading further from its neighbours is a gross
# error, and a larger rise towards the edge a wrong sign. Chosen, not measured.
MAX_ERROR = 0.03
# Readings must reach this share of the half angle. Extrapolated from 0.8, five simulated lenses
# have an edge wrong by up to 8 % (one that falls by half at the rim 36 %), from 0.7 by up to 37 %,
# and from 0.95, below which a note says so, by up to 1 % (3 %).
_MIN_REACH, _FULL_REACH = 0.8, 0.95
# A note says so where readings begin beyond this share: with noise of 0.1 to 0.3 %, seven simulated
# lenses are wrong by up to 3 % from 0.3 on, 8 % from 0.5 on. Chosen.
_AXIS_REACH = 0.3


class Samples(NamedTuple):
    """The n readings of one lens at one aperture.

    r [n]: angle from the axis over half of the lens's full angle; value [n]: light in any linear
    unit; u_rel [n]: relative uncertainty of the value; f_number: of all readings; lens: index of
    the lens in the profile; frames: files. Readings of equal angle are held out together. places:
    those of the readings, if they are patches.
    """

    r: Array
    value: Array
    u_rel: Array
    f_number: float
    lens: int
    frames: tuple[Path, ...]
    places: tuple[Place, ...] = ()


class VignettingFit(NamedTuple):
    """A fitted vignetting curve: transmission relative to the axis, in powers of r of `Samples`.

    u_rel: relative rms of held-out readings; residual_rel [n]: reading / fit - 1, also for omitted
    readings. coefficients: factors of the powers 0, 1, 2 ... of r; the first is 1. level: the
    readings' value on the axis. choice: how the number of powers was chosen.
    """

    coefficients: tuple[float, ...]
    level: float
    u_rel: float
    residual_rel: Array
    choice: fit_steps.OrderSelection


# ----------------------------------------------------------------------------------------------
# readings


def from_table(path: Path, profile: CameraProfile, lens: int = 0) -> Samples:
    """Read a csv of readings at angles from the axis, or of places of one patch in many frames.

    The first form has the columns angle_deg and value, the second file, x_px and y_px. Optional
    columns: reference (a meter's reading at that time, which corrects the drift of a lamp); u_rel
    (default 0.005) and f_number (equal in all lines; default that of the profile's bracket) in the
    first form; radius_px of the patch (default 12) in the second. lens: index for the first form;
    the second has the lens that shows the first patch. Files are relative to the csv. Raises
    InputError for other columns or values, unreadable frames, and several apertures.
    """
    if "angle_deg" not in fit_steps.columns_of(path):
        return _from_patches(path, profile)
    optional = {"reference": 1.0, "u_rel": 0.005, "f_number": profile.bracket.f_number}
    rows = fit_steps.read_table(path, ("angle_deg", "value"), optional)
    names = ("angle_deg", "value", "reference", "u_rel")
    angle, value, reference, u_rel = fit_steps.columns(rows, *names)
    away_deg, shown = np.abs(angle), profile.lens[lens]
    fit_steps.refuse_beyond_lens(away_deg.max(), shown, path)
    r = away_deg / (shown.full_angle_deg / 2)
    f_numbers = {Path(f"reading {k}"): row["f_number"] for k, row in enumerate(rows, 1)}
    return Samples(r, value / reference, u_rel, _one_aperture(path, f_numbers), lens, (path,))


def _from_patches(path: Path, profile: CameraProfile) -> Samples:
    """Read a csv of the places of one patch in frames: file, x_px, y_px; see `from_table`."""
    optional = {"radius_px": 12.0, "reference": 1.0}
    rows = fit_steps.read_table(path, ("file", "x_px", "y_px"), optional)
    weights = np.array(profile.colour.y_from_rgb)
    places = tuple(Place(row["file"], row["x_px"], row["y_px"]) for row in rows)
    lens = fit_steps.nearest_lens(profile, places[0].x, places[0].y)
    readings, f_numbers = [], {}
    for row, at in zip(rows, places, strict=True):
        frame = fit_steps.linear_frame(at.path, profile)
        rgb, u_patch = frame.patch(at.x, at.y, row["radius_px"])
        r = fit_steps.relative_angle(profile.lens[lens], at.x, at.y)
        value = float(rgb @ weights) / row["reference"]
        readings.append((r, value, float(np.hypot(u_patch, 0.002))))
        f_numbers[at.path] = frame.exposure.f_number
    f_number = _one_aperture(path, f_numbers)
    r, value, u_rel = np.array(readings).T
    return Samples(r, value, u_rel, f_number, lens, tuple(f_numbers), places)


def _one_aperture(
    source: Path, f_numbers: dict[Path, float], remedy: str = "write one table for each aperture"
) -> float:
    """Return the f-number of all frames or readings. Raises InputError if they have several."""
    files = {f_number: file.name for file, f_number in f_numbers.items()}
    if len(files) > 1:
        shown = "; ".join(f"f/{f_number:g}: {files[f_number]}" for f_number in sorted(files))
        raise InputError(source, f"several apertures ({shown})", "one aperture", remedy)
    return next(iter(files))


def from_uniform(paths: Sequence[Path], profile: CameraProfile, lens: int = 0) -> Samples:
    """Read frames of an evenly lit field (a sphere, a diffuser) as medians over 60 rings.

    lens: index of the lens in the profile; rings are of equal angle from its axis. Each frame gives
    its own readings. Raises InputError for unreadable frames, several apertures, or if all pixels
    are saturated or dark.
    """
    geometry, rings = profile.lens[lens], []
    weights, f_numbers = np.array(profile.colour.y_from_rgb), {}
    for path in paths:
        frame = fit_steps.linear_frame(path, profile)
        height, width = frame.bad.shape
        y, x = (np.mgrid[:height, :width] + 0.5) * frame.step
        radius = relative_radius(geometry, x, y)
        r = angle_of_radius(geometry, radius) / geometry.half_angle_rad
        rings += _rings(r, frame.rgb @ weights, ~frame.bad & (radius < 0.99))
        f_numbers[path] = frame.exposure.f_number
    f_number = _one_aperture(paths[0], f_numbers, "fit each aperture separately")
    if not rings:
        finding = "all pixels are saturated or dark"
        raise InputError(paths[0], finding, "a centre at half of saturation", "take it again")
    r, value, u_rel = np.array(rings).T
    return Samples(r, value, u_rel, f_number, lens, tuple(paths))


def _rings(r: Array, value: Array, good: Mask) -> list[tuple[float, float, float]]:
    """Return r in the middle, median luminance and its relative u, for each of 60 rings.

    r, value, good [h, w]: angle over half of the full angle, luminance, and whether the pixel
    counts. Rings with fewer than 20 good pixels are omitted.
    """
    ring, rings = np.minimum((r * 60).astype(int), 59), []
    for number in range(60):
        inside = value[good & (ring == number)]
        if len(inside) >= 20:
            middle = float(np.median(inside))
            u_rel = median_standard_error(robust_sigma(inside), len(inside)) / middle
            rings.append(((number + 0.5) / 60, middle, float(np.hypot(u_rel, 0.001))))
    return rings


# ----------------------------------------------------------------------------------------------
# fit


def _design(r: Array, order: int) -> Array:
    """Return the even powers r^0, r^2 ... r^order of each of n angles, [n, powers]."""
    return np.stack([r**power for power in range(0, order + 1, 2)], axis=1)


def _falling(r: Array, value: Array, u_rel: Array, order: int) -> Array:
    """Return the coefficients of 1, r^2, r^4 ... r^order that fit readings and fall to the edge.

    The fit is by least squares, with a slope of at most 0 up to r = 1. r: angle over half of the
    full angle [n]; value, u_rel: readings and their relative standard uncertainty [n]. The first
    coefficient is the readings' value on the axis.
    """
    scale = float(np.median(value))
    design, right = _design(r, order) / (u_rel * value / scale)[:, None], 1.0 / u_rel
    theta = np.linalg.lstsq(design, right, rcond=None)[0]
    if (np.diff(_design(np.linspace(0.0, 1.0, 51), order) @ theta) > 1e-11).any():
        # Bernstein polynomials of r^2 whose coefficients fall give a curve that falls.
        count = order // 2 + 1
        bernstein = BPoly(np.eye(count)[:, None], [0.0, 1.0])
        of_powers = PPoly.from_bernstein_basis(bernstein).c[::-1, 0]  # [powers, polynomials]
        steps = of_powers @ np.triu(np.ones((count, count)))
        theta = steps @ nnls(design @ steps, right)[0]
    return theta * scale


def fit(samples: Samples) -> VignettingFit:
    """Fit an even polynomial V(r) of the smallest order that the readings support.

    V is the transmission relative to the axis; r is the angle over half of the lens's full angle.
    Readings that contradict their neighbours, less than a quarter, are omitted and listed in the
    choice's line. Raises NotEnoughDataError for fewer than five readings, or none from r = 0.8 on;
    InputError for readings that are not positive or rise to the edge.
    """
    _check(samples)
    used = ~_contradicting(samples)
    r, value, u = samples.r[used], samples.value[used], samples.u_rel[used]
    axis, change = np.polynomial.polynomial.polyfit(r**2, value, 1, w=1.0 / (u * value))
    if (rise := float(change / axis)) > MAX_ERROR:  # such as correction factors
        finding = f"the readings rise by {100 * rise:.0f} % from the axis to the edge"
        remedy = "state readings, not correction factors"
        raise InputError(samples.frames[0], finding, "a loss towards the edge", remedy)
    groups = np.unique(np.round(r, 3), return_inverse=True)[1]
    angles = len(np.unique(np.round(samples.r, 3)))  # an omitted reading does not lower the order
    orders = [order for order in ORDERS if order // 2 + 1 <= max(angles // 2, 1)]
    _, theta, choice = fit_steps.fit_and_choose(
        f"vignetting f/{samples.f_number:g}",
        [(f"order {o}" if o else "no loss", o // 2, o) for o in orders],
        groups,
        lambda order, rows: _falling(r[rows], value[rows], u[rows], order),
        lambda order, t, held: (value[held] / (_design(r[held], order) @ t) - 1.0) ** 2,
    )
    coefficients = np.zeros(2 * len(theta) - 1)
    coefficients[::2] = theta / theta[0]
    curve = tuple(coefficients.tolist())
    if not used.all():
        left_out = ", ".join(f"one at {100 * a:.0f} % of the half angle" for a in samples.r[~used])
        text = f"left out, because neighbouring readings differ: {left_out}"
        choice = replace(choice, line=f"{choice.line}; {text}")
    if r.min() > _AXIS_REACH or r.max() < _FULL_REACH:
        reach = f"readings from {100 * r.min():.0f} to {100 * r.max():.0f} % of the half angle"
        text = f"CAUTION: {reach}: the rest is extrapolated, not in u"
        choice = replace(choice, line=f"{choice.line}; {text}")
    if wrong := check_vignetting(curve):
        remedy = "add readings up to the edge"
        raise InputError(samples.frames[0], wrong, "a curve above 0 up to the edge", remedy)
    residual = samples.value / (theta[0] * vignetting_at(curve, samples.r)) - 1.0
    return VignettingFit(curve, float(theta[0]), max(choice.rms, 0.001), residual, choice)


def _check(samples: Samples) -> None:
    """Raise NotEnoughDataError for few readings, InputError for one that is not positive."""
    r, value, files = samples.r, samples.value, samples.frames
    if len(r) < 5 or r.max() < _MIN_REACH:
        raise NotEnoughDataError(
            f"{files[0]}: {len(r)} readings up to {100 * r.max(initial=0):.0f} % of the half angle;"
            f" expected at least 5, up to {100 * _MIN_REACH:.0f} %; add readings, check that"
            " angles are in degrees, or lower the lens's full_angle_deg"
        )
    bad = np.flatnonzero(~(np.isfinite(value) & (value > 0)))
    if bad.size:
        source = f"{files[0]} to {files[-1].name}" if files[1:] else files[0]
        finding = f"the reading at {100 * r[bad[0]]:.0f} % of the half angle is {value[bad[0]]:g}"
        raise InputError(source, finding, "linear values above zero", "correct or remove it")


_SPARSE_ERROR = 0.1  # relative; a good reading of 6 to 8 is up to 5 % from the curve; chosen


def _contradicting(samples: Samples) -> Mask:
    """Return a mask [n], True for readings that contradict their neighbours.

    A shadow or a blinking lamp causes such readings: they are far from a smooth curve, and their
    neighbours are near it. At a steep rim several neighbouring readings are far from the curve; all
    of them are used, and so is an outermost reading without another at its angle.
    """
    r, scaled = samples.r, samples.value / np.median(samples.value)
    design = _design(r, 4 if len(r) < 12 else 6)
    start = np.eye(design.shape[1])[0]
    solved = least_squares(lambda t: design @ t / scaled - 1.0, start, loss="cauchy", f_scale=0.01)
    off = scaled / (design @ solved.x) - 1.0
    outliers = fit_steps.gross_errors(off, MAX_ERROR)
    for i in np.flatnonzero(outliers):
        away = np.where(np.arange(len(r)) == i, np.inf, np.abs(r - r[i]))
        outer = r[r > r[i]]
        # Compare with readings at the same angle, or else on both sides, up to the next outer one;
        # on the axis that one is also on the other side.
        near = away < 0.02
        if outer.size and not near.any():
            near = away < max(0.12, outer.min() - r[i] + 0.02)
        outliers[i] = near.any() and np.median(np.abs(off[near])) < MAX_ERROR / 2
        # between readings that are far apart, the curve is less certain
        outliers[i] &= bool((near & (away < 0.12)).any() or abs(off[i]) > _SPARSE_ERROR)
    return outliers


def with_curve(lens: Lens, f_number: float, vignetting: VignettingFit) -> Lens:
    """Return the lens with the fitted curve added for the aperture f_number.

    An older curve of this aperture is replaced.
    """
    others = tuple(v for v in lens.vignetting if abs(v.f_number - f_number) > 1e-6)
    rounded = tuple(round(c, 6) for c in vignetting.coefficients)
    curve = Vignetting(f_number, rounded, round(vignetting.u_rel, 5))
    return replace(lens, vignetting=tuple(sorted((*others, curve), key=lambda v: v.f_number)))


def chart(samples: Samples, fit: VignettingFit, half_angle_deg: float) -> Chart:
    """Return a chart of transmission over the angle from the axis.

    half_angle_deg: half of the lens's full angle.
    """
    angle = ("angle from the optical axis [deg]", samples.r * half_angle_deg)
    value = ("transmission relative to the axis", samples.value / fit.level)
    title = f"vignetting at f/{samples.f_number:g}; held-out rms {100 * fit.u_rel:.2g} %"
    curve = vignetting_at(fit.coefficients, samples.r)
    return Chart(title, fit.residual_rel, samples.places, angle, value, curve)
