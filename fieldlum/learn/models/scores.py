"""Compare predicted maps with the truth, as Liu, Colburn and Inanici (2020), and by solid angle.

Luminance errors and `dgp_mse` use the true sun disc in truth and prediction, so they judge only the
map. For the prediction, `dgp_mse_own_disc` uses the disc that a user gets: from the sky view.

That paper's way: floor 1 cd/m2; unweighted log10 MSE over all pixels and images; one RER = sqrt(sum
e^2 / sum t^2) of log10 L over the complete test; DGP of ten views; RAMMG in cd/m2 of five pyramid
levels. By solid angle: weights with a mean of 1; mean, median, 90th percentile and worst image.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Array, Dates, Floats, Floats32, Ints64, Mask, evenly_spread
from fieldlum.core.progress import progress, quiet, shown_by
from fieldlum.learn.models import Fitted, Prediction, trusted_hours
from fieldlum.learn.models.held_out_choice import HeldOutErrors, choice_weights
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import SEEN
from fieldlum.session.files.model_files import HeldOutMaps, ScoreFigures
from fieldlum.sky import sun, sun_disc
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.visible_disc import disc_lx
from fieldlum.year.glare import metrics
from fieldlum.year.glare.sources import Views, panorama_views, view_azimuths_deg

FLOOR_CDM2 = 1.0  # paper
# Fields of `Scores` that `compare` leaves NaN and `evaluate` adds: errors of glare, and times.
_ADDED = ("dgp_mse", "dgp_mse_own_disc", "dgp_mae", "rammg_error", "ev_error", "seconds", "cpu_s")


@dataclass(slots=True)
class Scores:
    """The scores of n predicted maps: arrays [n] with a value for each map, NaN if not computed.

    Errors are predicted minus true values of log10 luminance L. mse_weighted, mse: mean squared
    error of the pixels, by solid angle or equally weighted; truth2_weighted, truth2: the same means
    of the squared true log10 L; dgp_mse, dgp_mae: mean squared and mean absolute error of DGP over
    the view directions, with the true sun disc in the prediction; dgp_mse_own_disc: dgp_mse with
    the disc by the sky view, as a user gets it; bias_log10: mean error by solid angle; rammg_error:
    predicted minus true RAMMG [cd/m2]; expected_mse: error that the model itself expected; trusted:
    whether the model trusts the hour; in_band: share of pixels whose truth is in the model's 90 %
    interval; ev_error: mean absolute error of ln Ev over the view directions; day: local date;
    weight: of the hour in choices (`choice_weights`); seconds, cpu_s: time to predict the map, by
    the clock and by the processor; slots: names of the hours; maps: stored maps of the hours whose
    glare was computed, None without any. View directions are those of the ten that lenses saw
    fully, or all ten if no lens saw one fully.
    """

    mse_weighted: Floats
    mse: Floats
    truth2: Floats
    truth2_weighted: Floats
    dgp_mse: Floats
    dgp_mse_own_disc: Floats
    bias_log10: Floats
    dgp_mae: Floats
    rammg_error: Floats
    expected_mse: Floats
    trusted: Mask
    in_band: Floats
    ev_error: Floats
    day: Dates
    weight: Floats
    seconds: Floats
    cpu_s: Floats
    slots: tuple[str, ...] = ()
    maps: HeldOutMaps | None = None

    def __len__(self) -> int:
        return len(self.mse)

    @property
    def errors(self) -> HeldOutErrors:
        """Errors of each hour [n] by which models are chosen: of DGP, Ev and log10 luminance."""
        return HeldOutErrors(
            dgp=self.dgp_mae,
            ev=self.ev_error,
            log10=self.mse_weighted,
            day=self.day,
            weight=self.weight,
        )


def join(parts: Sequence[Scores]) -> Scores:
    """Return the scores of one or more tests as those of one test, one part after the other."""
    arrays = [f.name for f in fields(Scores) if f.name not in ("slots", "maps")]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    slots = tuple(slot for part in parts for slot in part.slots)
    maps = HeldOutMaps.join([part.maps for part in parts if part.maps is not None])
    return Scores(**joined, slots=slots, maps=maps)


# ----------------------------------------------------------------------------------------------
# comparing


class Truth(NamedTuple):
    """Everything about a test set that does not depend on the model.

    data: n test captures; views: ten view directions; glare_maps: mask [n] of the maps for which
    glare is computed; dgp, ev_lx: true DGP and vertical illuminance of the views [n, 10];
    rammg_cdm2: true contrast of the map [n]; all three NaN where not computed; full: mask [10] of
    the views that a lens saw completely, all True if there are none; weight: of the hours in
    choices [n]; own_disc_lx: the sun disc's illuminance by the sky view [n], NaN without glare.
    """

    data: Dataset
    views: Views
    glare_maps: Mask
    dgp: Floats
    rammg_cdm2: Floats
    ev_lx: Floats
    full: Mask
    weight: Floats
    own_disc_lx: Floats


def truth(data: Dataset, *, glare: bool = True) -> Truth:
    """Return what `evaluate` needs to know about the test captures `data`, for any model.

    glare: also compute DGP and RAMMG of at most 150 true maps, spread evenly over `data`, and
    the sun discs by the sky view; if False, glare is scored for no map. Raises InputError for an
    impossible room.
    """
    n = len(data)
    with_glare = np.isin(np.arange(n), evenly_spread(n, 150)) & glare
    azimuths_deg = view_azimuths_deg(data.heading_deg)
    views = panorama_views(*data.shape, data.heading_deg, azimuths_deg, data.seen)
    by_view = (n, len(views.azimuths_deg))
    dgp, ev, rammg = np.full(by_view, np.nan), np.full(by_view, np.nan), np.full(n, np.nan)
    for rows in _chunks(np.flatnonzero(with_glare)):
        part = data.take(rows)
        suns, maps = part.light.apparent_sun_direction, part.luminance_cdm2
        glare_of = metrics.glare_directions(maps, views, suns, part.disc_lx)
        dgp[rows], ev[rows] = glare_of["dgp"], glare_of["ev_lx"]
        rammg[rows] = _rammg(maps, part)
    own_disc = disc_lx(data.sky_view, data.setup, data.light) if glare else np.full(n, np.nan)
    full = np.array(metrics.view_coverage(views).words) == SEEN
    full = full if full.any() else ~full
    return Truth(data, views, with_glare, dgp, rammg, ev, full, choice_weights(data), own_disc)


def _chunks(rows: Ints64) -> Iterator[Ints64]:
    """Yield indices of hours in parts of at most 24."""
    for start in range(0, len(rows), 24):  # limits the memory
        yield rows[start : start + 24]


def _rammg(maps: Floats32, data: Dataset) -> Floats:
    """Return RAMMG of maps of n hours [n, H, W], with the true sun disc of `data`, [n] cd/m2."""
    with_disc = sun_disc.add_disc(maps, data.light, data.disc_lx, data.heading_deg)
    return np.array([metrics.rammg(image) for image in with_disc])


def evaluate(fitted: Fitted, test: Truth) -> Scores:
    """Predict the hours of a test set and return the scores against the true maps.

    Raises FloatingPointError for a predicted value that is not finite.
    """
    parts = []
    for rows in _chunks(np.arange(len(test.data))):
        progress(int(rows[0]), len(test.data), f"{fitted.name}: test")
        part = test.data.take(rows)
        wall, cpu = time.monotonic(), time.process_time()
        prediction = fitted.predict(part.light, part.patch_cdm2)
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        scores = compare(prediction, part)
        scores.weight = test.weight[rows]
        scores.seconds[:], scores.cpu_s[:] = wall / len(rows), cpu / len(rows)
        _glare_errors(scores, prediction, part, test, rows)
        parts.append(scores)
    return join(parts)


def _log10(maps: Floats32, data: Dataset) -> Floats32:
    """Return log10 L of maps [n, H, W] of the n hours of `data`, with the true sun disc."""
    with_disc = sun_disc.add_disc(maps, data.light, data.disc_lx, data.heading_deg)
    return np.log10(np.maximum(with_disc, np.float32(FLOOR_CDM2)))


def compare(prediction: Prediction, data: Dataset) -> Scores:
    """Return the scores of predicted maps against captures; glare and times are NaN.

    The true sun disc is added to both; luminances below 1 cd/m2 count as 1. Raises
    FloatingPointError for a predicted value that is not finite.
    """
    if not np.isfinite(prediction.luminance_cdm2).all():
        raise FloatingPointError("a predicted map has values that are not finite")
    target = _log10(data.luminance_cdm2, data)
    error = (_log10(prediction.luminance_cdm2, data) - target)[:, data.seen].astype(np.float64)
    truth2, error2 = target[:, data.seen].astype(np.float64) ** 2, error**2  # [n, P]
    weights = data.weights[data.seen]
    blank = np.full(len(data), np.nan)
    in_band = blank
    if prediction.log10_sd is not None:
        # A 90 % interval of a normal distribution is 1.6449 standard deviations to each side.
        in_band = (np.abs(error) <= 1.6449 * prediction.log10_sd[:, data.seen]).mean(axis=1)
    added = {name: blank.copy() for name in _ADDED}
    return Scores(
        mse_weighted=error2 @ weights / weights.sum(),
        mse=error2.mean(axis=1),
        truth2=truth2.mean(axis=1),
        truth2_weighted=truth2 @ weights / weights.sum(),
        bias_log10=error @ weights / weights.sum(),
        expected_mse=prediction.expected_mse,
        trusted=trusted_hours(prediction),
        in_band=in_band,
        day=data.days,
        weight=np.ones(len(data)),
        slots=data.slots,
        **added,  # pyright: ignore[reportArgumentType]
    )


def _glare_errors(
    scores: Scores, prediction: Prediction, part: Dataset, test: Truth, rows: Array
) -> None:
    """Add the errors of glare to `scores`, for the maps of `part` for which glare is computed.

    prediction: of the n hours of `part`; test: the captured values of all hours; rows: the indices
    of the hours of `part` in it [n].
    """
    with_glare = test.glare_maps[rows]
    if not with_glare.any():
        return
    judged, maps = part.take(with_glare), prediction.luminance_cdm2[with_glare]
    suns = judged.light.apparent_sun_direction
    glare = metrics.glare_directions(maps, test.views, suns, judged.disc_lx)
    true_dgp, true_ev = test.dgp[rows[with_glare]], test.ev_lx[rows[with_glare]]
    # DGP with the disc that the model would use, instead of the captured one.
    own_disc = (metrics.sun_per_lx(suns, test.views), test.own_disc_lx[rows[with_glare]])
    own_disc_dgp = metrics.dgp(*metrics.with_disc(glare, own_disc))

    def mean(values: Floats) -> Floats:
        """Return means over the fully seen of 10 directions, [k]; values: of k hours [k, 10]."""
        return values[:, test.full].mean(axis=1)

    scores.dgp_mse_own_disc[with_glare] = mean((own_disc_dgp - true_dgp) ** 2)
    scores.dgp_mse[with_glare] = mean((glare["dgp"] - true_dgp) ** 2)
    scores.dgp_mae[with_glare] = mean(np.abs(glare["dgp"] - true_dgp))
    scores.ev_error[with_glare] = mean(np.abs(np.log((glare["ev_lx"] + 1.0) / (true_ev + 1.0))))
    scores.rammg_error[with_glare] = _rammg(maps, judged) - test.rammg_cdm2[rows[with_glare]]
    # Maps are stored with 58 rows at least, as the smallest panoramas of a demo have.
    measured, predicted = (
        np.log10(np.maximum(m.thin(58).luminance_cdm2, FLOOR_CDM2)).astype(np.float16)
        for m in (judged, replace(judged, luminance_cdm2=maps))
    )
    scores.maps = HeldOutMaps(
        slots=np.array(judged.slots),
        log10_mse=scores.mse_weighted[with_glare],
        measured_log10=measured,
        predicted_log10=predicted,
    )


# ----------------------------------------------------------------------------------------------
# summing up


def _mean(values: Floats | float) -> float | None:
    """Return the mean of the values that were computed (not NaN); None without any."""
    finite = np.asarray(values)[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None


def summary(scores: Scores) -> ScoreFigures:
    """Return the figures of a test under the keys of `ScoreFigures`; None if not computed."""
    errors, truth2_weighted = scores.errors, max(scores.truth2_weighted.sum(), 1e-12)
    return {
        "log10_mse_weighted": float(scores.mse_weighted.mean()),
        "rer_weighted": float(np.sqrt(scores.mse_weighted.sum() / truth2_weighted)),
        "median": float(np.median(scores.mse_weighted)),
        "p90": float(np.quantile(scores.mse_weighted, 0.9)),
        "worst": float(scores.mse_weighted.max()),
        "paper_log10_mse": float(scores.mse.mean()),
        "paper_rer": float(np.sqrt(scores.mse.sum() / max(scores.truth2.sum(), 1e-12))),
        "dgp_mse": _mean(scores.dgp_mse),
        "dgp_mse_own_disc": _mean(scores.dgp_mse_own_disc),
        "bias_log10": float(scores.bias_log10.mean()),
        "expected_log10_mse": _mean(scores.expected_mse),
        "trusted_share": float(scores.trusted.mean()),
        "dgp_mae": _mean(scores.dgp_mae),
        "rammg_mse": _mean(scores.rammg_error**2),
        "n_test": len(scores),
        "predict_s_per_map": float(scores.seconds.mean()),
        "predict_cpu_s_per_map": float(scores.cpu_s.mean()),
        "in_90_band": _mean(scores.in_band),
        "judged_dgp_error": _mean(errors.figure("dgp")),
        "judged_ev_error": _mean(errors.figure("ev")),
        "judged_log10_mse": _mean(errors.figure("log10")),
        "n_judged": errors.judged,
    }


# ----------------------------------------------------------------------------------------------
# error over a year: held-out days are close to captured days, so that their error is too small


class YearExpectation(NamedTuple):
    """The error that a model itself expects over a year, from a sample of hours.

    expected_log10_mse: mean over the sample, NaN if the model does not estimate its error;
    trusted_share: share of trusted hours, 0 to 1; hours: number of hours in the sample.
    """

    expected_log10_mse: float
    trusted_share: float
    hours: int


def light_of_year(data: Dataset, rng: np.random.Generator) -> Light:
    """Return the light of 150 random daylight hours of a year, with weather of random captures.

    A capture's weather is the ratio of its direct normal and diffuse irradiance to those of a
    cloudless sky (`sun.clearsky`), at most 1.2 and 4 (chosen); the hour has these ratios times its
    own cloudless sky. Daylight: the sun above 2 degrees. The year is that of the first capture;
    rng: source of the random draws.
    """
    site, first = data.setup.site, data.light.t_utc[0]
    begin = datetime(first.year, 1, 1, tzinfo=UTC)
    hours = [begin + timedelta(hours=hour) for hour in range(365 * 24)]
    daylight = np.flatnonzero(np.asarray(sun.position(hours, site).altitude_deg) > 2.0)
    count = 150  # their mean expected error has a standard error of 10 to 15 %
    times = [hours[k] for k in np.sort(rng.choice(daylight, count, replace=False))]
    high = np.flatnonzero(data.light.sun_altitude_deg > 5.0)  # captures with a reliable ratio
    drawn = rng.choice(high if len(high) else np.arange(len(data)), count)
    of_captures = sun.clearsky([data.light.t_utc[k] for k in drawn], site)
    of_hours = sun.clearsky(times, site)

    beam = np.minimum(data.light.dni_wm2[drawn] / np.maximum(of_captures.dni_wm2, 1.0), 1.2)
    diffuse = np.minimum(data.light.dhi_wm2[drawn] / np.maximum(of_captures.dhi_wm2, 1.0), 4.0)
    return light_at(times, site, beam * of_hours.dni_wm2, diffuse * of_hours.dhi_wm2)


def expect_year(fitted: Fitted, data: Dataset, rng: np.random.Generator) -> YearExpectation:
    """Return what a model of the captures `data` expects of the hours of `light_of_year`.

    If `data` has sun patches, those of the hours are computed from the room of `data`, which it
    must have then. rng: source of the random draws. The expected log10 MSE is NaN for a model that
    does not estimate its error. Raises InputError for an impossible room.
    """
    light = light_of_year(data, rng)
    n = len(light)
    expected, trusted = np.full(n, np.nan), np.zeros(n, bool)
    for rows in _chunks(np.arange(n)):
        progress(int(rows[0]), n, "error of a year")
        hours = light[rows]
        with shown_by(quiet):
            patch = None if data.patch_cdm2 is None else data.patches(hours)
        prediction = fitted.predict(hours, patch)
        expected[rows], trusted[rows] = prediction.expected_mse, trusted_hours(prediction)
    return YearExpectation(float(expected.mean()), float(trusted.mean()), n)
