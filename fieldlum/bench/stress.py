"""Test conditions in which methods fail: how errors grow, and whether the tool reports it.

A condition changes the training data, the test data, or both. The error under a condition is
divided by the error of the same data without it, the normal case. "Reported" means one of three:
the training warned (`learn.train.held_out_warnings`, `room.fit.misplaced_patches.warnings_of`); the
model expected, on average, more than a third of the error; or it did not trust most of the hours,
or most of those with a large error.

A gross error is a map that is wrong by more than a factor of 1.6 (log10 MSE over 0.04). It counts
as unflagged if the training did not warn, the hour is trusted, and less than a third of the error
was expected.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldlum.bench.score_rows import Spec
from fieldlum.core.arrays import Floats
from fieldlum.core.progress import progress
from fieldlum.core.records import JsonTable
from fieldlum.learn.models.scores import Scores, evaluate, truth
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import fit_timed, held_out_warnings, patch_mode
from fieldlum.room.fit.apply_scene import earlier, with_patches
from fieldlum.room.fit.misplaced_patches import misplacement_of, warnings_of
from fieldlum.sky.daylight import Light

MIN_HOURS = 8  # hours of training and of test that a condition needs; chosen
GROSS_MSE = 0.04  # log10 MSE of a gross error: a factor of 1.6
REPORTED_SHARE = 1.0 / 3.0  # share of the error that the model must expect; chosen, not measured


@dataclass(frozen=True, slots=True)
class Case:
    """A condition to test.

    name: of the condition; train, test: hours to fit to and to predict, changed as the condition
    states; normal: name of the case with which its error is compared; seed: of the fit.
    """

    name: str
    train: Dataset
    test: Dataset
    normal: str = "normal"
    seed: int = 0


# ----------------------------------------------------------------------------------------------
# changing data


def with_light(data: Dataset, **columns: Floats) -> Dataset:
    """Return the captures with other irradiance or sun angles; the maps do not change.

    columns: fields of `Light` and their new values [n]. `Light.perez`, which belongs to the old
    values, becomes None.
    """
    return replace(data, light=replace(data.light, perez=None, **columns))


def wrong_north(data: Dataset, degrees: float) -> Dataset:
    """Return the data as if north were wrong: the sun's azimuth is `degrees` larger (clockwise).

    Sun patches are computed again for this sun, if there is a [room]; the maps do not change.
    """
    azimuth_deg = (data.light.sun_azimuth_deg + degrees) % 360.0
    return _patched(with_light(data, sun_azimuth_deg=azimuth_deg))


def late_clock(data: Dataset, minutes: float) -> Dataset:
    """Return the data as if the clock were fast: the sun is where it is `minutes` after the time.

    Sun patches are computed again for this sun, if there is a [room]; the maps do not change.
    """
    later = earlier(data.light, -minutes, data)
    altitude_deg, azimuth_deg = later.sun_altitude_deg, later.sun_azimuth_deg
    return _patched(with_light(data, sun_altitude_deg=altitude_deg, sun_azimuth_deg=azimuth_deg))


def _patched(data: Dataset) -> Dataset:
    """Return the data with sun patches computed from [room] for the sun in `data`.

    Data without a [room] or without patches do not change.
    """
    has_patches = data.setup.room is not None and data.patch_cdm2 is not None
    return with_patches(data) if has_patches else data


def _noise(shape: tuple[int, ...], share: float, seed: int) -> Floats:
    """Return random log-normal factors of a shape; share: standard deviation of their ln."""
    return np.exp(share * np.random.default_rng(seed).standard_normal(shape))


def noisy_pixels(data: Dataset) -> Dataset:
    """Return the data with a random log-normal factor on each pixel of the maps, of 5 %."""
    factor = _noise(data.luminance_cdm2.shape, 0.05, 1).astype(np.float32)
    return replace(data, luminance_cdm2=data.luminance_cdm2 * factor)


def disagreeing(data: Dataset, share: float, seed: int) -> Dataset:
    """Return the data with noise in DNI, and with a DHI that keeps the global irradiance.

    share: standard deviation of the ln of the factor on DNI; seed: of the noise. The beam is at
    most 97 % of the global irradiance, and DHI at least 1 W/m2.
    """
    light = data.light
    sin_altitude = np.maximum(np.sin(np.radians(light.sun_altitude_deg)), 0.02)
    ghi_wm2 = light.dni_wm2 * sin_altitude + light.dhi_wm2
    dni_wm2 = light.dni_wm2 * _noise((len(data),), share, seed)
    dni_wm2 = np.minimum(dni_wm2, 0.97 * ghi_wm2 / sin_altitude)
    dhi_wm2 = np.maximum(ghi_wm2 - dni_wm2 * sin_altitude, 1.0)
    return with_light(data, dni_wm2=dni_wm2, dhi_wm2=dhi_wm2)


def from_global(data: Dataset) -> Dataset:
    """Return the data with DNI and DHI derived from global horizontal irradiance.

    The model is that of Erbs, Klein and Duffie (Solar Energy 28, 1982). DIRINT cannot be used,
    because it needs a series and the hours are isolated. The maps do not change.
    """
    from pvlib.irradiance import erbs

    light = data.light
    zenith_deg = 90.0 - light.sun_altitude_deg
    ghi_wm2 = light.dni_wm2 * np.maximum(np.cos(np.radians(zenith_deg)), 0.0) + light.dhi_wm2
    derived = erbs(ghi_wm2, np.minimum(zenith_deg, 88.0), light.day_of_year)
    dni, dhi = (np.nan_to_num(np.asarray(derived[name], float)) for name in ("dni", "dhi"))
    return with_light(data, dni_wm2=np.clip(dni, 0.0, 1100.0), dhi_wm2=np.maximum(dhi, 1.0))


def blind_moved(data: Dataset) -> Dataset:
    """Return the data as if a blind were down on a third of the days, at least one.

    On these days the captured maps have no sun patch and two fifths of the remaining luminance; the
    sun patches in `data` do not change.
    """
    days = np.unique(data.days)
    down = np.random.default_rng(4).permutation(days)[: max(1, round(1 / 3 * len(days)))]
    rows = np.isin(data.days, down)
    maps = data.luminance_cdm2.copy()
    if data.patch_cdm2 is not None:
        maps[rows] = np.maximum(maps[rows] - data.patch_cdm2[rows], 0.02 * maps[rows])
    maps[rows] *= np.float32(0.4)
    return replace(data, luminance_cdm2=maps)


# ----------------------------------------------------------------------------------------------
# regimes


def _sun_share(light: Light) -> Floats:
    """Return the share of DNI in DNI + DHI of each hour, 0 to 1, [n]."""
    return light.dni_wm2 / np.maximum(light.dni_wm2 + light.dhi_wm2, 1e-9)


def _months(data: Dataset) -> NDArray[np.int64]:
    """Return the month of each hour, 1 to 12, [n]."""
    return np.array([day.astype(object).month for day in data.days])


def cases(data: Dataset, test: Dataset) -> Iterator[Case]:
    """Yield every condition that the data allow, beginning with the normal case.

    data, test: hours to fit to and to predict, without any condition. The normal case of another
    case precedes it.
    """
    yield Case("normal", data, test)
    # five fits of the normal case differ only by chance
    for seed in range(1, 5):
        yield Case(f"another seed ({seed})", data, test, seed=seed)
    yield from _subsets(data, test)
    yield Case("pixel noise 5 %", noisy_pixels(data), test)
    yield Case("mixed sky: DNI off by 30 %, global kept", disagreeing(data, 0.3, 3), test)
    yield Case("DNI derived from global", from_global(data), test)
    yield Case("blind down in a third of the days", blind_moved(data), test)
    if data.setup.room is not None and data.patch_cdm2 is not None:
        yield from _geometry(data, test)


def _subsets(data: Dataset, test: Dataset) -> Iterator[Case]:
    """Yield fits to the captures of one sky or season, and tests on hours of one kind.

    A condition is omitted if it has fewer than `MIN_HOURS` hours of training or of test.
    """
    light, test_months, months = test.light, _months(test), _months(data)
    days = data.days.astype("datetime64[D]").astype(int)
    # numbers of the days from the first day in March, if there is one, else from the first day
    days = days - (days[months == 3].min() if (months == 3).any() else days.min())
    low = light.sun_altitude_deg < 10.0
    all_data, all_test = np.ones(len(data), bool), np.ones(len(test), bool)
    # for each condition, masks of the training hours and of the test hours
    masks = {
        "sun disc in view": (all_data, test.disc_lx > 0.0),
        "low sun, under 10 degrees": (all_data, low & (light.dni_wm2 > 20.0)),
        "overcast captures only, clear test": (
            _sun_share(data.light) < 0.2,
            _sun_share(light) > 0.6,
        ),
        "December captures only, June test": (months == 12, test_months == 6),
        "one week of captures": ((days >= 0) & (days < 7), all_test),
        "two weeks of captures": ((days >= 0) & (days < 14), all_test),
    }
    for name, (in_training, in_test) in masks.items():
        if in_training.sum() >= MIN_HOURS and in_test.sum() >= MIN_HOURS:
            yield Case(name, data.take(in_training), test.take(in_test))


def _geometry(data: Dataset, test: Dataset) -> Iterator[Case]:
    """Yield cases with a wrong north or a wrong clock, and sun patches computed from [room].

    The patches of their normal case are computed from [room] too.
    """
    base = "normal, patches from [room]"
    yield Case(base, _patched(data), _patched(test), base)
    for degrees in (0.2, 0.5, 1.0, 2.0):
        name = f"north off by {degrees:g} degrees"
        yield Case(name, wrong_north(data, degrees), wrong_north(test, degrees), base)
    for minutes in (5, 15):
        name = f"clock off by {minutes} min"
        yield Case(name, late_clock(data, minutes), late_clock(test, minutes), base)


# ----------------------------------------------------------------------------------------------
# results


def run(spec: Spec, data: Dataset, test: Dataset, *, budget_s: float = 60.0) -> list[JsonTable]:
    """Fit the model under each condition that the data allow; return one row per condition.

    spec: the model; data, test: training and test hours. budget_s: time limit of each training [s].
    Columns: name: label of `spec`; regime: name of the condition; n_train, n_test: numbers of
    hours; log10_mse_weighted, median, worst: mean, median and largest error of the test hours;
    expected_mse: mean error that the model expected, None if it expects none; untrusted_share: of
    the test hours, 0 to 1; warned: whether the fit warned; reported: whether the tool reported the
    error in any way (docstring of this module); gross, gross_unflagged: number of hours with gross
    errors (log10 MSE over 0.04), and of those without any warning, distrust or large expected
    error; fit_cpu_s: processor time of the fit [s]; times_normal: the mean error divided by that of
    the normal case. Errors are log10 MSE by solid angle. Maps are thinned to about 20 rows.
    """
    rows: list[JsonTable] = []
    normal: dict[str, float] = {}
    for case in cases(data, test):
        progress(len(rows), 0, case.name)
        # with maps of 20 rows thirty fits take a minute or two
        train, test_maps = case.train.thin(20), case.test.thin(20)
        mode = patch_mode(train, spec.patch)
        fitted, spent = fit_timed(spec.name, train, patch=mode, seed=case.seed, budget_s=budget_s)
        misplaced = warnings_of(misplacement_of(case.train, mode))
        warned = bool(held_out_warnings(fitted, train) or misplaced)
        row = _row(evaluate(fitted, truth(test_maps, glare=False)), warned)
        about = {"name": spec.label, "regime": case.name, "n_train": len(train)}
        error = normal.setdefault(case.name, row["log10_mse_weighted"])
        times = {"fit_cpu_s": spent.cpu_s, "times_normal": error / normal[case.normal]}
        rows.append(about | row | times)
    return rows


def _row(scores: Scores, warned: bool) -> JsonTable:
    """Return the columns of a condition that follow from the scores of its n test hours.

    warned: whether the training warned.
    """
    error, expected, doubted = scores.mse_weighted, scores.expected_mse, ~scores.trusted  # [n]
    large = error > max(GROSS_MSE, 4.0 * float(np.median(error)))
    gross = error > GROSS_MSE
    flagged = warned | doubted | (np.nan_to_num(expected) > REPORTED_SHARE * error)
    # NaN, of a model that does not estimate its error, compares False
    is_expected = expected.mean() > REPORTED_SHARE * error.mean()
    is_doubted = doubted.mean() > 0.5 or 2 * doubted[large].sum() > large.sum()
    return {
        "n_test": len(scores),
        "log10_mse_weighted": float(error.mean()),
        "median": float(np.median(error)),
        "worst": float(error.max()),
        "expected_mse": float(expected.mean()) if np.isfinite(expected).all() else None,
        "untrusted_share": float(doubted.mean()),
        "warned": warned,
        "reported": bool(warned or is_expected or is_doubted),
        "gross": int(gross.sum()),
        "gross_unflagged": int((gross & ~flagged).sum()),
    }
