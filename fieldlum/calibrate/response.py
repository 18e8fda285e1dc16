"""Fit the response of a JPEG camera: from codes to linear light, for known exposures."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.calibrate.fit_charts import Chart
from fieldlum.calibrate.fit_steps import OrderSelection, fit_and_choose, require
from fieldlum.core.arrays import Floats, Indices, Mask, UInts8
from fieldlum.core.errors import InputError
from fieldlum.core.progress import part_of_progress, progress
from fieldlum.core.records import Exposure
from fieldlum.core.statistics import median_standard_error, robust_sigma
from fieldlum.optics import linear_light, projection, raw
from fieldlum.optics.camera_curves import dark_floor, fit_response, response_table
from fieldlum.optics.exposure import ShutterLaw, stated_law
from fieldlum.optics.profiles import CameraProfile, Response

# Codes that count for the residual, and have weight in a merge: the profile's defaults.
LOW, HIGH = Response().low_code, Response().high_code
# of the tables that are tried; a stiffer first one hides bends of a phone's curve (simulated)
_STIFFNESSES = (1e5, 1e4, 1e3, 1e2, 10.0)
_MAX_RIPPLE = 0.015  # rms, ln of light: chosen curves of two cameras to 0.0083, scalloped ones 0.04
_NO_SPREAD = 255  # replaces the spread of codes in a block with a code outside LOW to HIGH
_PLACES_OF_STEP = 250  # u of the median is a 13th of that of one place; chosen
_MAX_SCATTER = 4.0  # chosen: a place with two frames passes with 99 % if it has only noise
_MIN_PLACES = 20  # below it `fit_response` has no result
_MIN_SHARED = 8  # places for the median of a step, whose weight follows from their scatter; chosen
_U_SYSTEMATIC = 0.0025  # ln of light: rounding of codes and stray light; bench/bracket_steps.py
_U_LABEL = 0.05  # ln of light: of a label before the fit, as labels round to thirds (6.7 %); chosen
_MAX_U_STEP = 0.02  # ln of light: a step with a larger uncertainty counts as not measured; chosen
# ln: a smaller change of colour is no change of white balance. The colours of a phone with a fixed
# white balance differ by up to 3 % in steps that only a lamp shows (measured); daylight and lamps
# are 30 % apart. Chosen between.
_MIN_BALANCE_CHANGE = 0.06


# ----------------------------------------------------------------------------------------------
# exposure steps by the overlap of the frames, under an unknown response
#
# The exposures that a camera states (labels) are rounded to thirds of a stop, but some shutters are
# exact: steps that are equal by the labels differ by up to 6.7 %. Frames that show the same places
# determine the deviations of single steps. They cannot determine the length of all steps together,
# because an unknown response leaves a power of the exposure free (Grossberg and Nayar 2003). The
# labels determine that power.


class Steps(NamedTuple):
    """The exposures of brackets by the overlap of frames, and how much steps contradict the labels.

    A label is an exposure as the camera states it. log_exposure [exposures]: ln of the exposures,
    ascending, corrected, with the same span as by the labels. deviation [exposures - 1]: of each
    step from that of the labels, ln of light; 0 where the overlap does not contradict them.
    balance: largest change of red or blue against green between two frames, ln; 0 for none. It is a
    lower limit, because each colour's response is fitted to the same frames.
    """

    log_exposure: Floats
    deviation: Floats
    balance: float = 0.0

    @property
    def text(self) -> str:
        """One line on the corrected steps and a changed white balance, "" if there is neither."""
        changed, percent = np.count_nonzero(self.deviation), 100.0 * np.abs(self.deviation)
        largest = f"by up to {percent.max(initial=0.0):.1f} %"
        off = f"{changed} of {len(self.deviation)} steps by the labels, {largest}"
        text = f"exposure steps: the overlap of the frames contradicts {off}, and was used"
        text += "; the span of all steps is the labels'"
        change = f"the white balance changes by over {100.0 * self.balance:.0f} % between frames"
        remedy = "their colours are not usable; fix it, and take the bracket again"
        texts = {text: changed, f"CAUTION: {change}: {remedy}": self.balance}
        return "; ".join(text for text, applies in texts.items() if applies)


def steps_by_overlap(codes: UInts8, log_exposure: Floats, bracket: Indices) -> Steps:
    """Correct the exposures of brackets by the overlap of the frames, starting from the labels.

    codes [places, exposures, 3]: 0 for an exposure that a place's bracket lacks; log_exposure
    [exposures]: ln of the exposures by the labels, increasing; bracket [places]: index of each
    place's bracket. With fewer than 20 places nothing is corrected.
    """
    step = np.diff(log_exposure)
    deviation, u, log_e = np.zeros(len(step)), np.full(len(step), np.inf), log_exposure
    balance = 0.0
    present = [codes[bracket == index].any(axis=(0, 2)) for index in np.unique(bracket)]
    pairs = {pair for shown in present for pair in pairwise(np.flatnonzero(shown).tolist())}
    for _ in range(12 if len(codes) >= _MIN_PLACES else 0):  # the response adapts to the steps
        further, u, balance = _deviations(_log_light(codes, log_e), sorted(pairs))
        deviation = _without_stretch(deviation + further, u, np.diff(log_e))
        before, log_e = log_e, log_exposure + np.r_[0.0, np.cumsum(deviation)]
        if np.abs(log_e - before).max() < 2e-4:
            break
    # A power is free: the one that agrees with most labels shows which of them are contradicted.
    measured = u < _MAX_U_STEP
    power = float(np.median((deviation / step)[measured])) if measured.any() else 0.0
    against = np.where(measured, deviation - power * step, 0.0)
    significant = np.where(np.abs(against) > 2.0 * u, against, 0.0)
    log_e = log_exposure + np.r_[0.0, np.cumsum(_without_stretch(significant, u, step))]
    return Steps(log_e, significant, balance)


def _log_light(codes: UInts8, log_e: Floats) -> Floats:
    """Return ln of light over exposure, [places, exposures, 3]; NaN for codes that do not count.

    A response is fitted to the codes [places, exposures, 3] of each colour first. log_e
    [exposures]: ln of the exposures.
    """
    light = np.full(codes.shape, np.nan)
    for colour in range(3):
        own = codes[..., colour]
        z = fit_response(own, log_e)[0][own]  # a stiffer one would bend the steps
        counts = (own >= LOW) & (own <= HIGH) & (z > 0)
        light[..., colour] = np.where(counts, np.log(np.where(counts, z, 1.0)) - log_e, np.nan)
    return light


def _deviations(light: Floats, pairs: Sequence[tuple[int, int]]) -> tuple[Floats, Floats, float]:
    """Return deviations of the steps, their standard uncertainties, and the change of colour.

    Deviations and uncertainties [exposures - 1] are in ln of light, by least squares over pairs and
    colours, each weighted by its own scatter, with the labels as a prior. The last value is the
    largest change of red or blue against green, ln; 0 for none. light: result of `_log_light`;
    pairs: indices of two exposures that show the same places.
    """
    count, balance = light.shape[1] - 1, 0.0
    normal, right = np.eye(count) / _U_LABEL**2, np.zeros(count)
    for first, second in pairs:
        middle, weight = np.zeros(3), np.zeros(3)
        for colour in range(3):
            off = light[:, second, colour] - light[:, first, colour]  # [places]
            off = off[np.isfinite(off)]
            if len(off) >= _MIN_SHARED:
                middle[colour] = np.median(off)
                scatter = robust_sigma(off, middle[colour])
                weight[colour] = 1.0 / max(median_standard_error(scatter, len(off)), 1e-4) ** 2
        if not weight.any():
            continue
        row = np.zeros(count)
        row[first:second] = 1.0
        variance = 1.0 / weight.sum() + _U_SYSTEMATIC**2
        normal += np.outer(row, row) / variance
        right += row * np.average(middle, weights=weight) / variance
        for colour in (0, 2) if weight.all() else ():  # red and blue against green
            change = abs(middle[colour] - middle[1])
            u = np.sqrt(1.0 / weight[colour] + 1.0 / weight[1])
            if change > max(_MIN_BALANCE_CHANGE, 4.0 * u):
                balance = max(balance, change)
    return np.linalg.solve(normal, right), np.sqrt(np.diag(np.linalg.inv(normal))), balance


def _without_stretch(deviation: Floats, u: Floats, step: Floats) -> Floats:
    """Return deviations [steps] without a power of exposure: their sum over measured steps is 0.

    u: uncertainty of each step, which decides whether it is measured; step: ln, by the labels.
    """
    own, measured = np.where(u < _MAX_U_STEP, [deviation, step], 0.0)
    return own - measured * (own.sum() / max(float(measured.sum()), 1e-9))


# ----------------------------------------------------------------------------------------------
# sampled places


class Places(NamedTuple):
    """The codes of the same places in all frames of a bracket, for several brackets.

    codes [places, exposures, 3]: code of a place in R, G, B; 0 if its bracket has no such exposure.
    log_exposure [exposures]: ln of (true shutter time [s] times ISO); bracket [places]: index of
    each place's bracket; law: how log_exposure follows from the nominal shutter times; steps: where
    the overlap of the frames contradicts them, log_exposure is corrected. frames: files of all
    brackets.
    """

    codes: UInts8
    log_exposure: Floats
    bracket: Indices
    law: ShutterLaw
    steps: Steps
    frames: tuple[Path, ...]


class ResponseFit(NamedTuple):
    """A fitted JPEG response, and the choice among the tried responses."""

    response: Response
    choice: OrderSelection


def brackets_in(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the frames of each bracket: a folder is one bracket; all single files are one more.

    Raises InputError for a folder without JPEG frames. A missing path with the suffix of a JPEG is
    a bracket of its own, which `sample` refuses.
    """
    single = [path for path in paths if path.is_file()]
    brackets = [single] if single else []
    for folder in (path for path in paths if not path.is_file()):
        brackets.append([p for p in raw.frame_files(folder) if raw.is_jpeg(p)])
        if not brackets[-1]:
            expected = "a folder with the frames of one bracket"
            raise InputError(folder, "no JPEG frames", expected, "check the path of the folder")
    return brackets


def sample(
    brackets: Sequence[Sequence[Path]], profile: CameraProfile, rng: np.random.Generator
) -> Places:
    """Sample the same flat places in every frame of a bracket, pooled over brackets.

    If the profile's shutter law is "auto", the law is that of the EXIF times; the overlap of the
    frames then corrects single steps. brackets: the frames of each; rng: for the choice of places,
    which are spread over the brightnesses. Raises InputError for a bracket of mixed apertures or
    sizes or with fewer than three exposures, NotEnoughDataError for one with fewer than 50 flat,
    well exposed places.
    """
    parts = []
    for k, paths in enumerate(brackets):
        with part_of_progress(k, len(brackets)):
            parts.append(_flat_places(paths, profile, rng))
    nominal_s = [exposure.shutter_s for _, exposures in parts for exposure in exposures]
    law = stated_law(nominal_s, profile.shutter_law, profile.camera.model)
    lawful, axes = replace(profile, shutter_law=law.law), []
    for (_, exposures), paths in zip(parts, brackets, strict=True):
        iso_s = [linear_light.true_shutter_s(e.shutter_s, lawful)[0] * e.iso for e in exposures]
        axes.append(np.round(np.log(iso_s), 4))  # of each frame of the bracket
        if (count := len(np.unique(np.round(axes[-1], 3)))) < 3:
            finding = f"{len(exposures)} frames with {count} different exposures"
            expected = "a bracket with at least three different exposures"
            raise InputError(paths[0].parent, finding, expected, "take more exposures")
    grid = np.unique(np.concatenate(axes))  # all exposures of all brackets
    # codes of each bracket's places on the grid, 0 for an exposure that the bracket lacks
    of_brackets = [np.zeros((len(part), len(grid), 3), np.uint8) for part, _ in parts]
    for on_grid, (part, _), log_e in zip(of_brackets, parts, axes, strict=True):
        on_grid[:, np.searchsorted(grid, log_e)] = part
    codes = np.concatenate(of_brackets)
    bracket = np.repeat(np.arange(len(parts)), [len(part) for part in of_brackets])
    steady = _is_steady(codes, grid)
    codes, bracket = codes[steady], bracket[steady]
    steps = steps_by_overlap(codes, grid, bracket)
    files = tuple(path for paths in brackets for path in paths)
    return Places(codes, steps.log_exposure, bracket, law, steps, files)


def _flat_places(
    paths: Sequence[Path], profile: CameraProfile, rng: np.random.Generator
) -> tuple[UInts8, list[Exposure]]:
    """Return the codes of places without an edge [places, frames, 3], and the frames' exposures.

    A place is a block of 3 x 3 pixels inside the lens circles; its code is the mean. Exposures are
    those of EXIF. rng: for the choice among places of one brightness. At most 2 million blocks on a
    grid are compared, one frame at a time. Half of the places are spread over the brightnesses, and
    each pair of neighbouring exposures has up to `_PLACES_OF_STEP` that both show.
    """
    height, width = profile.camera.height_px, profile.camera.width_px
    step = max(3, int(np.ceil(np.sqrt(height * width / 2_000_000))))  # px between places
    y, x = np.mgrid[1 : height - 1 : step, 1 : width - 1 : step]
    at = [projection.relative_radius(lens, x + 0.5, y + 0.5) for lens in profile.lens]
    inside = np.min(at, axis=0) < 0.95
    y, x = y[inside], x[inside]
    levels, spreads, exposures = [], [], []
    for number, path in enumerate(paths):
        progress(number, len(paths), f"reading {path.name}")
        frame = raw.read_jpeg(path, camera_pixels=profile.camera.pixels)
        linear_light.check_frame(path, frame.codes.shape, frame.model, profile)
        exposures.append(frame.exposure)
        if frame.exposure.f_number != exposures[0].f_number:
            finding = f"f/{frame.exposure.f_number:g}, but the first frame has another aperture"
            raise InputError(path, finding, "the frames of one bracket", "remove this frame")
        around = [frame.codes[y + down, x + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
        block = np.stack(around)  # [9, places, 3]
        is_valid = ((block >= LOW) & (block <= HIGH)).all(axis=(0, 2))
        levels.append(np.rint(block.mean(axis=0)).astype(np.uint8))
        spreads.append(np.where(is_valid, np.ptp(block[..., 1], axis=0), _NO_SPREAD))  # of green
    codes, spread = np.stack(levels), np.stack(spreads)  # [frames, places, 3], [frames, places]
    valid = spread < _NO_SPREAD
    is_flat = ~valid | (spread <= _noise_spread(spread, codes[..., 1])[codes[..., 1]])
    flat = np.flatnonzero(is_flat.all(axis=0) & (valid.sum(axis=0) >= 2))
    what = f"{paths[0].parent}: even places exposed well (JPEG codes {LOW} to {HIGH}) by two frames"
    require(len(flat), 50, what, "use steps of at most 2 EV, and picture walls and sky")
    brightness = codes[:, flat, 1].mean(axis=0) + rng.uniform(0, 1e-3, len(flat))
    # Half of the chosen places is spread evenly over the levels. Otherwise there would be too few
    # bright places, which are the only ones that short frames show.
    order, count = np.argsort(brightness), min(500, len(flat))  # more did not change the table
    wanted = np.linspace(brightness.min(), brightness.max(), count // 2)
    even = np.minimum(np.searchsorted(brightness[order], wanted), len(flat) - 1)
    ranks = np.linspace(0, len(flat) - 1, count - len(np.unique(even))).astype(int)
    chosen = order[np.union1d(even, ranks)]
    valid, unevenness = valid[:, flat], np.where(valid, spread, 0)[:, flat].max(axis=0)
    for first, second in pairwise(np.argsort([e.shutter_s * e.iso for e in exposures])):
        in_both = valid[first] & valid[second]
        lacking = max(0, _PLACES_OF_STEP - np.count_nonzero(in_both[chosen]))
        others = np.setdiff1d(np.flatnonzero(in_both), chosen)
        evenest = others[np.argsort(unevenness[others], kind="stable")[:lacking]]
        chosen = np.concatenate([chosen, evenest])
    return codes[:, flat[np.sort(chosen)]].transpose(1, 0, 2), exposures


def _is_steady(codes: UInts8, log_exposure: Floats) -> Mask:
    """Return a mask [places], True for places whose light is the same in all frames.

    Flickering lamps and moving leaves are not steady: their light scatters in a colour over
    `_MAX_SCATTER` times as much as that of most places. codes: [places, exposures, 3]; log_exposure
    [exposures]: ln. All are True if the places are too few.
    """
    steady = np.ones(len(codes), bool)
    for own in codes.transpose(2, 0, 1) if len(codes) >= _MIN_PLACES else ():
        scatter = place_variances(fit_response(own, log_exposure)[0], own, log_exposure)
        steady &= ~(scatter > _MAX_SCATTER**2 * np.nanmedian(scatter))
    return steady


def _noise_spread(spread: UInts8, level: UInts8) -> Floats:
    """Return the largest spread of 3 x 3 codes that noise explains, for each mean code, [256].

    spread, level: highest minus lowest, and mean code of the blocks [frames, places]. A code has
    the same noise in all frames, but in some frames only edges have it, such as a lamp's in a dark
    one. So the frame counts in which a quarter of the blocks of similar codes has the smallest
    spread. The limit is 1.5 times this spread, and at least 9 codes.
    """
    limit = np.full(256, 9.0)
    for first in range(0, 256, 32):  # 32 similar codes at a time
        near = (spread < _NO_SPREAD) & (level // 32 == first // 32)
        of_frames = [values[used] for values, used in zip(spread, near, strict=True)]
        quiet = [float(np.quantile(values, 0.25)) for values in of_frames if len(values) >= 200]
        limit[first : first + 32] = max(9.0, 1.5 * min(quiet, default=0.0))
    return limit


# ----------------------------------------------------------------------------------------------
# fit


def place_variances(
    table: Floats, codes: UInts8, log_e: Floats, low: int = LOW, scale: Floats | None = None
) -> Floats:
    """Return the variance of ln(z / exposure) over the frames of each place, [places].

    With the right table it contains only noise, because the light of a place is the same in all
    frames. table [256]: linear light z of each code; codes [places, frames]: those of one colour;
    log_e [frames]: ln of exposure. Codes from `low` to 228 count; NaN for places with fewer than
    two. scale [256]: another table, whose light states the difference between a code and the code
    that `table` expects. Errors of several tables are comparable only on a common scale: on its
    own, a curve gains by being flat where most codes are and steep between them.
    """
    off = _off_mean(table, codes, log_e, low)
    if scale is not None:
        log_z, common = (np.log(np.maximum(z, 1e-9)) for z in (table, scale))
        off = common[codes] - np.interp(log_z[codes] - off, log_z + 1e-9 * np.arange(256), common)
    freedom = np.isfinite(off).sum(axis=1) - 1
    none = np.full(len(off), np.nan)
    return np.divide(np.nansum(off**2, axis=1), freedom, out=none, where=freedom > 0)


def _off_mean(table: Floats, codes: UInts8, log_e: Floats, low: int) -> Floats:
    """Return ln(z / exposure) of each frame minus its mean over the frames, [places, frames].

    It is NaN for codes that are not from `low` to 228. table [256]: linear light z of each code;
    codes [places, frames]: those of one colour; log_e [frames]: ln of exposure.
    """
    counts = (codes >= low) & (codes <= HIGH)
    counts &= counts.sum(axis=1, keepdims=True) >= 2
    light = np.log(np.maximum(table[codes], 1e-9)) - log_e
    mean = np.average(light, axis=1, weights=counts + 1e-12, keepdims=True)
    return np.where(counts, light - mean, np.nan)


def fit(places: Places) -> ResponseFit:
    """Fit the response: standard curves, then monotone tables from stiff to flexible.

    Held-out places choose among them. Complete brackets are held out if there are three or more,
    else an eighth of the places at a time. The errors of all tables are stated in the light of the
    stiffest. If the darkest codes do not follow the light (because of a black level), low_code
    rises to the first code that does. A slope that swings with the bracket's steps increases u_rel;
    if by much, the line of the choice has a CAUTION. Raises NotEnoughDataError for fewer than 20
    places that are well exposed in two frames.
    """
    codes, log_e = places.codes, places.log_exposure
    low = max(LOW, *(dark_floor(codes[..., c], log_e) for c in range(3)))
    good = ((codes >= low) & (codes <= HIGH)).sum(axis=1) >= 2  # [places, 3]
    what = "places that are well exposed in two frames"
    require(int(good.any(axis=1).sum()), 20, what, "take more frames for a response")
    groups = places.bracket if places.bracket.max() >= 2 else np.arange(len(codes)) % 8
    models: list[tuple[str, int, str | float]] = [("linear", 0, "linear"), ("srgb", 0, "srgb")]
    models += [(f"table of stiffness {s:g}", n, s) for n, s in enumerate(_STIFFNESSES, 1)]

    def tables_of(model: str | float, rows: Mask) -> list[Floats]:
        """Return the table [256] of each colour: a standard curve, or fitted with a stiffness."""
        if isinstance(model, str):
            return [response_table(model)] * 3
        return [fit_response(codes[rows, :, c], log_e, smooth=model)[0] for c in range(3)]

    stiffest = tables_of(_STIFFNESSES[0], np.ones(len(codes), bool))

    def misfit(model: str | float, tables: list[Floats], held: Mask) -> Floats:
        """Return the variance of each held-out place by the tables, as a mean over colours."""
        scales = [None] * 3 if isinstance(model, str) else stiffest
        pairs = enumerate(zip(tables, scales, strict=True))
        spreads = [place_variances(t, codes[held, :, c], log_e, low, s) for c, (t, s) in pairs]
        count = np.isfinite(spreads).sum(axis=0)
        total = np.nansum(spreads, axis=0)
        return np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)

    model, tables, choice = fit_and_choose(
        "response", models, groups, tables_of, misfit, negligible=_U_SYSTEMATIC
    )
    kind: Any = model if isinstance(model, str) else "table"
    ripple = max(_ripple(table, places, low) for table in tables) if kind == "table" else 0.0
    line = choice.line
    if choice.rms > 0.1:  # a still scene in steady light leaves 1 to 5 %
        line += ". CAUTION: check that camera and light did not change; take the bracket again"
    if ripple > _MAX_RIPPLE:
        line += f". CAUTION: the curve has a ripple of {100 * ripple:.0f} % with the period of the "
        line += "bracket's steps: take frames between them too (1/3 stop), in the same folder"
    choice = replace(choice, line=line)
    u_rel = round(float(max(np.hypot(choice.rms, ripple), 0.001)), 5)
    response = Response(kind, low_code=low, high_code=HIGH, u_rel=u_rel)
    if kind == "table":
        red, green, blue = (tuple(np.round(table, 7).tolist()) for table in tables)
        response = replace(response, red=red, green=green, blue=blue)
    return ResponseFit(response, choice)


def _ripple(table: Floats, places: Places, low: int) -> float:
    """Return the rms of a colour's ripple in ln z with the period of the exposure steps.

    Frames whose steps are equal do not determine it: a curve with any such ripple explains them as
    well. table: z [256]; places: the first bracket has the steps; codes from `low` to 228 count.
    The ripple is a sine of ln z, next to a polynomial, in the logarithm of the code.
    """
    shown = places.codes[places.bracket == places.bracket[0]].any(axis=(0, 2))
    step, code = np.median(np.diff(places.log_exposure[shown])), np.arange(low, HIGH + 1)
    log_z = np.log(np.maximum(table[code], 1e-9))
    turn = 2.0 * np.pi * log_z / step
    design = np.column_stack([np.vander(log_z, 6), np.cos(turn), np.sin(turn)])
    in_code = np.linalg.lstsq(design, np.log(code), rcond=None)[0][-2:]
    return float(np.hypot(*in_code) / np.sqrt(2.0) * np.ptp(log_z) / np.ptp(np.log(code)))


def chart(places: Places, fit: ResponseFit) -> Chart:
    """Return a chart of the light of the sampled places over their codes, in all colours.

    A residual is ln of a place's light by one frame minus the mean by all frames.
    """
    response, parts = fit.response, []
    for c, curve in enumerate((response.red, response.green, response.blue)):
        table, codes = response_table(response.kind, curve), places.codes[..., c]
        off = _off_mean(table, codes, places.log_exposure, response.low_code)
        counts = np.isfinite(off)
        parts.append([values[counts] for values in (codes, table[codes], off)])
    codes, tables, off = (np.concatenate(values) for values in zip(*parts, strict=True))
    title = f"JPEG response, {response.kind}; held-out rms {100 * response.u_rel:.2g} %"
    return Chart(title, off, (), ("code", codes), ("linear light z", tables * np.exp(-off)), tables)
