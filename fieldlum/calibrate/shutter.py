"""Fit the true times of a shutter to the exposure ratios of many merged brackets.

The sidecar of each merged bracket (panoramas/<slot>.json) states how far neighbouring frames still
differ, and the corrections that were applied. The sum of both shows how much longer or shorter each
frame was than assumed, relative to its neighbour. In one bracket the light also changes. The median
over many brackets removes these changes, and a line over the seconds of each bracket removes a
drift. Pictures determine only ratios: the mean level stays that of the times that the merge
assumed.
"""

import math
from collections import defaultdict
from collections.abc import Container, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, compress, groupby, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.calibrate.fit_charts import Chart
from fieldlum.calibrate.fit_steps import choose, folds, require, require_raw
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import counted, shutter_text
from fieldlum.core.statistics import median_standard_error, robust_sigma
from fieldlum.optics.exposure import AUTO
from fieldlum.optics.linear_light import SAME_LABEL, U_FRAME_RATIO, true_shutter_s
from fieldlum.optics.profiles import CameraProfile, ShutterTime
from fieldlum.session import Session
from fieldlum.session.files.sidecar import FrameQuality, NeighbourQuality, Sidecar

MIN_BRACKETS = 5  # with a pair of times; chosen so that a median is robust
# relative spread of a pair over brackets, above which light or shutter are unsteady; chosen
MAX_SPREAD = 0.02

Pair = tuple[float, float]  # nominal times of the longer and the shorter frame [s]


class ShutterReading(NamedTuple):
    """The measured exposure ratio of two neighbouring frames of a bracket.

    pair: nominal times of the longer and of the shorter frame [s]. log_ratio: ln(true / assumed
    exposure) of the shorter frame minus the same of the longer one; u_log: standard uncertainty of
    log_ratio; seconds: time from the longer to the shorter frame, 0 if unknown.
    """

    pair: Pair
    log_ratio: float
    u_log: float
    seconds: float


Bracket = Sequence[ShutterReading]


class TimeRatio(NamedTuple):
    """The measured exposure ratio of one pair of shutter times, over all brackets.

    median: median of log_ratio (see `ShutterReading`); spread: standard deviation of log_ratio over
    brackets, without the noise of single readings; error: standard error of the median; brackets:
    number of readings of the pair; seconds: median time from the longer to the shorter frame [s].
    """

    median: float
    spread: float
    error: float
    brackets: int
    seconds: float


class ShutterFit(NamedTuple):
    """Fitted shutter times; each replaces the profile's time with the same nominal value.

    times: longest first. assumed_s: true time [s] by the profile before the fit, for each of
    `times`; brackets: largest number of brackets with a pair that contains the time, for each of
    `times`; left_out: texts on pairs that were not used, with the reason; line: about the choice,
    for the profile.
    """

    times: tuple[ShutterTime, ...]
    assumed_s: tuple[float, ...]
    brackets: tuple[int, ...]
    left_out: tuple[str, ...]
    line: str


# ----------------------------------------------------------------------------------------------
# readings


def from_session(
    session: Session, profile_sha256: str
) -> tuple[list[list[ShutterReading]], tuple[Path, ...]]:
    """Return the readings of every bracket that was merged with this profile, and their sidecars.

    profile_sha256: of the profile's file, as the sidecars record it. One list of readings for each
    bracket, in the order of the sidecars. Brackets without a usable ratio are omitted. Raises
    InputError if no bracket remains and some were merged with another profile, NotEnoughDataError
    if none remains otherwise.
    """
    brackets, files, others = [], [], 0
    for path in session.sidecar_files():
        with suppress(InputError):  # damaged, or not written by a merge
            sidecar = Sidecar.read(path)
            profile = sidecar.profile.get("sha256", "")
            others += profile not in ("", profile_sha256)
            if profile == profile_sha256 and (readings := readings_of(sidecar)):
                brackets.append(readings)
                files.append(path)
    if not brackets and others:
        finding = f"{counted(others, 'panorama')} merged with another profile"
        remedy = "merge again (fieldlum merge), or name the other profile"
        raise InputError(session.panoramas, finding, "the stated profile", remedy)
    what = f"{session.panoramas}: merged brackets with overlapping frames"
    require(len(brackets), 1, what, "run fieldlum merge first")
    return brackets, tuple(files)


def with_law_of(profile: CameraProfile, sidecars: Sequence[Path]) -> CameraProfile:
    """Return the profile with the shutter law of the merged brackets if its own is "auto".

    Another law of the profile remains. sidecars: files of the merged brackets. Raises InputError
    for a damaged sidecar, and if the law is "auto" and the brackets were merged with several laws.
    """
    reports = [Sidecar.read(path).report for path in sidecars]
    laws = sorted({report.shutter_law.law for report in reports if report.shutter_law})
    if profile.shutter_law != AUTO or not laws:
        return profile
    if len(laws) > 1:
        remedy = 'write shutter_law = "exact" (or another) into the profile and merge again'
        raise InputError(sidecars[0].parent, f"shutter laws {', '.join(laws)}", "one law", remedy)
    return replace(profile, shutter_law=laws[0])


def readings_of(sidecar: Sidecar) -> list[ShutterReading]:
    """Return the measured ratios of neighbouring frames in one merged bracket.

    Pairs with a filter, with two ISOs, with equal times or with an uncertainty above 1 % are
    omitted. The list is empty if the sidecar is damaged, or if frames of a heading do not overlap.
    """
    report = sidecar.report
    headings = [list(frames) for _, frames in groupby(report.frames, lambda f: f.heading_deg)]
    neighbours = report.neighbours  # their frames are counted from 0 at each heading
    # indices of the first pair of each heading
    starts = [i for i, n in enumerate(neighbours) if not i or n.long <= neighbours[i - 1].long]
    runs = [neighbours[first:end] for first, end in pairwise([*starts, len(neighbours)])]
    if len(runs) != len(headings):
        return []  # a heading has no overlap, so pairs cannot be assigned to headings
    readings = []
    for frames, run in zip(headings, runs, strict=True):
        if max(max(n.long, n.short) for n in run) >= len(frames):
            return []  # damaged: the sidecar lists frames that do not exist
        readings += [_reading(frames[n.long], frames[n.short], n) for n in run]
    return [r for r in readings if r is not None]


def _reading(
    long: FrameQuality, short: FrameQuality, neighbour: NeighbourQuality
) -> ShutterReading | None:
    """Return the ratio of two neighbouring frames; None for a pair to omit.

    long, short: the frames; neighbour: the comparison of their common pixels by merge.
    """
    of_long, of_short, u_log = long.exposure, short.exposure, neighbour.u_percent / 100
    log_ratio = neighbour.residual_percent / 100 + math.log(short.correction / long.correction)
    same_time = abs(of_short.shutter_s / of_long.shutter_s - 1) < SAME_LABEL
    is_sure = math.isfinite(log_ratio) and 0.0 < u_log < 0.01
    if of_long.nd or of_short.nd or of_long.iso != of_short.iso or same_time or not is_sure:
        return None
    seconds = (short.t_utc - long.t_utc).total_seconds() if short.t_utc and long.t_utc else 0.0
    pair = (of_long.shutter_s, of_short.shutter_s)
    return ShutterReading(pair, log_ratio=log_ratio, u_log=u_log, seconds=seconds)


# ----------------------------------------------------------------------------------------------
# fit


def pool(brackets: Sequence[Bracket], drift: bool = True) -> dict[Pair, TimeRatio]:
    """Return the exposure ratio of each pair of shutter times over all brackets, by the pair.

    drift: whether to remove the drift of the light, a line over time, from each bracket first.
    """
    logs: dict[Pair, list[tuple[float, float, float]]] = defaultdict(list)
    first = pool(brackets, drift=False) if drift else {}
    for bracket in brackets:
        rate = _drift_per_s(bracket, first) if drift else 0.0
        for r in bracket:
            logs[r.pair].append((r.log_ratio - rate * r.seconds, r.u_log, r.seconds))
    return {pair: _pair_ratio(np.array(values).T) for pair, values in logs.items()}


def _pair_ratio(values: Floats) -> TimeRatio:
    """Return the ratio of a pair of times; values [3, brackets]: log_ratio, its u, seconds."""
    median, noise, seconds = np.median(values, axis=1).tolist()
    sigma, n = robust_sigma(values[0]), values.shape[1]
    return TimeRatio(
        median=median,
        spread=math.sqrt(max(sigma**2 - noise**2, 0.0)),
        error=math.hypot(median_standard_error(max(sigma, noise), n), U_FRAME_RATIO),
        brackets=n,
        seconds=seconds,
    )


def _drift_per_s(bracket: Bracket, pooled: dict[Pair, TimeRatio]) -> float:
    """Return the relative change of the light in one bracket over time [1/s].

    It is a line through the differences from the pooled ratios; 0 for fewer than three of them.
    """
    rows = [(r.seconds, r.log_ratio - pooled[r.pair].median, r.u_log) for r in bracket if r.seconds]
    if len(rows) < 3:
        return 0.0
    seconds, residuals, u = np.array(rows).T
    weight = seconds / np.maximum(u, 1e-4) ** 2
    return float((weight * residuals).sum() / (weight * seconds).sum())


def fit(brackets: Sequence[Bracket], profile: CameraProfile) -> ShutterFit:
    """Fit the true times of a raw camera's shutter to the measured ratios of many brackets.

    A pair of times is used if at least five brackets have it and agree within 2 %. The mean level
    of the times stays that of the assumed ones. Raises NotEnoughDataError if brackets are too few
    or disagree, or if the fit is not better than the assumed times; InputError for a JPEG camera.
    """
    require_raw(profile, "calibrate only the response: it and the times cannot both be fitted")
    pooled = pool(brackets)
    reasons = {pair: _reason_to_omit(pair, ratio) for pair, ratio in pooled.items()}
    left_out = tuple(text for text in reasons.values() if text)
    steady = {pair: pooled[pair] for pair, text in reasons.items() if not text}
    if not steady:
        raise NotEnoughDataError(
            f"shutter: no ratio of two shutter times agrees in {MIN_BRACKETS} brackets or more: "
            f"{'; '.join(left_out) or 'no frames overlap'}; capture more brackets in steady light"
        )
    of_assumed, of_fitted = _held_out_errors(brackets, steady)
    table = ("table", len(steady), of_fitted)
    choice = choose("shutter", [("times as assumed", 0, of_assumed), table])
    if choice.index == 0:
        raise NotEnoughDataError(f"{choice.line}; expected better times; keep the profile")
    nominal = sorted({time for pair in steady for time in pair}, reverse=True)
    assumed_s, u_assumed = zip(*(true_shutter_s(time, profile) for time in nominal), strict=True)
    at_start = pool(brackets, drift=False)
    rates = np.array([_drift_per_s(bracket, at_start) for bracket in brackets])
    u_drift_per_s = median_standard_error(robust_sigma(rates), len(rates))
    delta, u = _times_at_common_level(steady, nominal, np.array(u_assumed), u_drift_per_s)
    times, counts = [], []
    for k, time in enumerate(nominal):
        of_time = [ratio for pair, ratio in steady.items() if time in pair]
        u_rel = math.hypot(u[k], min(ratio.spread for ratio in of_time))
        true_s = float(f"{assumed_s[k] * math.exp(delta[k]):.7g}")
        times.append(ShutterTime(time, true_s, round(max(u_rel, U_FRAME_RATIO), 6)))
        counts.append(max(ratio.brackets for ratio in of_time))
    return ShutterFit(tuple(times), assumed_s, tuple(counts), left_out, choice.line)


def _reason_to_omit(pair: Pair, ratio: TimeRatio) -> str:
    """Return a text on why a pair of times is not used; "" for a pair that is used."""
    what = f"{shutter_text(pair[0])} to {shutter_text(pair[1])} s"
    if ratio.brackets < MIN_BRACKETS:
        return f"{what}: brackets with both times: {ratio.brackets}, needed: {MIN_BRACKETS}"
    if ratio.spread <= MAX_SPREAD:
        return ""
    varies = f"the ratio varies by {100 * ratio.spread:.1f} % between brackets (standard deviation)"
    return f"{what}: {varies}: the light or the shutter is unsteady"


def _held_out_errors(brackets: Sequence[Bracket], pairs: Container[Pair]) -> Floats:
    """Return the squared errors of n ratios in held-out brackets, [2, n].

    The first row has the errors of the assumed times, the second those of a fit to the other
    brackets. pairs: the pairs of times that count.
    """
    errors = []
    for held_out in folds(np.arange(len(brackets))):
        fitted = pool(list(compress(brackets, ~held_out)))
        readings = chain.from_iterable(compress(brackets, held_out))
        usable = [r for r in readings if r.pair in pairs and r.pair in fitted]
        errors += [(r.log_ratio**2, (r.log_ratio - fitted[r.pair].median) ** 2) for r in usable]
    return np.array(errors).T


def _times_at_common_level(
    ratios: dict[Pair, TimeRatio], nominal: Sequence[float], u_prior: Floats, u_drift_per_s: float
) -> tuple[Floats, Floats]:
    """Return ln of true over assumed time, and its standard uncertainty, [n] each.

    The uncertainty is relative to the common level of all times, which is part of k. ratios: the
    measured ratio of each pair of times; nominal: the n times [s]; u_prior [n]: relative standard
    uncertainty of each before the measurement; u_drift_per_s: that of a drift which all brackets
    have in common, so that it cannot be separated from an error of the shutter.
    """
    long = np.array([nominal.index(pair[0]) for pair in ratios])
    short = np.array([nominal.index(pair[1]) for pair in ratios])
    design = np.eye(len(nominal))[short] - np.eye(len(nominal))[long]
    weight = 1.0 / np.array([ratio.error for ratio in ratios.values()]) ** 2
    normal = design.T @ (weight[:, None] * design) + np.diag(u_prior**-2.0)
    measured = np.array([(ratio.median, ratio.seconds) for ratio in ratios.values()])
    delta, seconds = np.linalg.solve(normal, design.T @ (weight[:, None] * measured)).T
    free = np.eye(len(nominal)) - u_prior**-2.0 / (u_prior**-2.0).sum()
    covariance = free @ np.linalg.inv(normal) @ free.T
    u = np.sqrt(np.diag(covariance) + (u_drift_per_s * (free @ seconds)) ** 2)
    return np.asarray(delta, np.float64), u


def with_times(profile: CameraProfile, shutter_fit: ShutterFit) -> tuple[ShutterTime, ...]:
    """Return the profile's shutter times with the fitted ones added or replaced, longest first."""
    new = np.array([t.nominal_s for t in shutter_fit.times])
    others = [t for t in profile.shutter if (abs(t.nominal_s / new - 1) >= SAME_LABEL).all()]
    return tuple(sorted((*others, *shutter_fit.times), key=lambda t: -t.nominal_s))


def chart(fit: ShutterFit) -> Chart:
    """Return a chart of fitted times, and of assumed times (blue), divided by nominal times.

    The x axis is the nominal time.
    """
    nominal, true = np.array([(t.nominal_s, t.true_s) for t in fit.times]).T
    assumed, label = np.array(fit.assumed_s), "true over nominal time"
    title = f"shutter: {len(fit.times)} times from {max(fit.brackets)} brackets"
    time, ratio = ("nominal time [s]", nominal), (label, true / nominal)
    return Chart(title, true / assumed - 1.0, (), time, ratio, assumed / nominal)
