"""Fit the response of a JPEG camera: from codes to linear light, for known exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.model_selection import OrderSelection, fit_and_choose
from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.core.statistics import median_standard_error, robust_sigma
from fieldlum.optics.linear_light import check_frame, true_shutter_s
from fieldlum.optics.photometry import (
    AUTO,
    EXACT,
    LAWS,
    ShutterLaw,
    dark_floor,
    fit_response,
    law_of_labels,
    response_table,
)
from fieldlum.optics.profiles import CameraProfile, Response
from fieldlum.optics.raw import is_jpeg, read_jpeg

# ----------------------------------------------------------------------------------------------
# exposure steps by the overlap of the frames, under an unknown response
#
# Labels are rounded to thirds of a stop, and some shutters keep the decimals: steps that are equal
# by the labels differ by up to 6.7 %. Frames that show the same places decide the deviations of
# single steps. They cannot decide the length of all steps together, because an unknown response
# leaves a power of the exposure free (Grossberg and Nayar 2003): the labels do.


_MIN_PLACES = 20  # places for which a step counts as measured; chosen
_SYSTEMATIC = 0.0025  # of light: rounding of codes and stray light; bench/bracket_steps.py
_LABEL_U = 0.05  # ln of light: prior of a label, of the order of rounding to thirds (6.7 %); chosen
_MEASURED_U = 0.02  # ln of light: a step with a larger uncertainty is the label's; chosen
_COVERAGE = 2.0  # standard uncertainties beyond which the overlap contradicts a label; chosen
_STIFFNESS = 30.0  # of the response meanwhile: a stiffer one would bend the steps
_ROUNDS, _SETTLED = 12, 2e-4  # the response adapts to the steps; ends below this change of ln light


@dataclass(frozen=True, slots=True)
class Steps:
    """The exposures of a bracket by its overlap, and how much single steps contradict the labels.

    log_exposure [exposures] : ln, corrected, with the labels' span. deviation, u [exposures - 1] :
    of each step from its label, ln of light, with its standard uncertainty; deviation is 0 where
    the overlap does not contradict the label.
    """

    log_exposure: Floats
    deviation: Floats
    u: Floats

    @property
    def text(self) -> str:
        """One line on the corrected steps, "" if there is none."""
        changed = np.flatnonzero(self.deviation)
        if not changed.size:
            return ""
        largest = 100.0 * float(np.abs(self.deviation).max())
        return (
            f"exposure steps: the overlap of the frames contradicts {changed.size} of "
            f"{len(self.deviation)} steps by the labels, by up to {largest:.1f} %, and was used; "
            "the span of all steps is the labels'"
        )


def labelled_steps(log_exposure: Floats) -> Steps:
    """Return the steps by the labels alone."""
    count = len(log_exposure) - 1
    return Steps(log_exposure, np.zeros(count), np.full(count, np.inf))


def steps_by_overlap(
    codes: NDArray[np.uint8], log_exposure: Floats, bracket: Indices, low: int, high: int
) -> Steps:
    """Return the exposures [exposures] by the overlap, starting from those by the labels.

    codes [places, exposures, 3] : 0 for an exposure that a place's bracket lacks; log_exposure
    [exposures] : ln, increasing; bracket [places] : index of each place's bracket; low, high :
    range of the codes that count.
    """
    if len(codes) < _MIN_PLACES:
        return labelled_steps(log_exposure)
    pairs = _pairs(codes, bracket)
    log_e, deviation = log_exposure, np.zeros(len(log_exposure) - 1)
    u = np.full(len(deviation), np.inf)
    for _ in range(_ROUNDS):
        light = _light(codes, log_e, low, high)
        further, u = _fitted(light, log_e, pairs)
        before = log_e
        deviation = _without_stretch(np.diff(before) - np.diff(log_exposure) + further, u, before)
        log_e = _exposures(log_exposure, deviation)
        if np.abs(log_e - before).max() < _SETTLED:
            break
    # A power is free: the one that agrees with most labels shows which of them are contradicted.
    step = np.diff(log_exposure)
    measured = u < _MEASURED_U
    power = float(np.median((deviation / step)[measured])) if measured.any() else 0.0
    against = np.where(measured, deviation - power * step, 0.0)
    kept = np.where(np.abs(against) > _COVERAGE * u, against, 0.0)
    stretched = _without_stretch(kept, u, log_exposure)
    return Steps(_exposures(log_exposure, stretched), kept, u)


def _exposures(log_exposure: Floats, deviation: Floats) -> Floats:
    """Return the exposures with these deviations of the steps; the first remains."""
    return log_exposure + np.r_[0.0, np.cumsum(deviation)]


def _pairs(codes: NDArray[np.uint8], bracket: Indices) -> list[tuple[int, int]]:
    """Return the neighbouring exposures of each bracket, as indices, each pair once."""
    pairs: set[tuple[int, int]] = set()
    for index in np.unique(bracket):
        present = np.flatnonzero(codes[bracket == index].any(axis=(0, 2)))
        pairs |= {(int(a), int(b)) for a, b in pairwise(present)}
    return sorted(pairs)


def _light(codes: NDArray[np.uint8], log_e: Floats, low: int, high: int) -> Floats:
    """Return ln of light over exposure [places, exposures, 3]; NaN for codes that do not count."""
    light = np.full(codes.shape, np.nan)
    for colour in range(3):
        own = codes[..., colour]
        table, _ = fit_response(own, log_e, smooth=_STIFFNESS)
        counts = (own >= low) & (own <= high) & (table[own] > 0)
        values = np.log(np.where(counts, table[own], 1.0)) - log_e
        light[..., colour] = np.where(counts, values, np.nan)
    return light


def _fitted(light: Floats, log_e: Floats, pairs: list[tuple[int, int]]) -> tuple[Floats, Floats]:
    """Return deviations of the steps [exposures - 1] in ln of light, with standard uncertainties.

    Least squares over the pairs, with the labels as a prior.
    """
    count = len(log_e) - 1
    normal, right = np.eye(count) / _LABEL_U**2, np.zeros(count)
    for first, second in pairs:
        off = light[:, second] - light[:, first]  # [places, 3]
        seen = np.isfinite(off)
        places = seen.any(axis=1)
        if places.sum() < _MIN_PLACES:
            continue
        of_place = np.nansum(off[places], axis=1) / seen[places].sum(axis=1)
        middle = float(np.median(of_place))
        u = median_standard_error(robust_sigma(of_place, middle), len(of_place))
        weight = 1.0 / (u**2 + _SYSTEMATIC**2)
        row = np.zeros(count)
        row[first:second] = 1.0
        normal += weight * np.outer(row, row)
        right += weight * row * middle
    return np.linalg.solve(normal, right), np.sqrt(np.diag(np.linalg.inv(normal)))


def _without_stretch(deviation: Floats, u: Floats, log_e: Floats) -> Floats:
    """Return deviations whose sum over the measured steps is 0: a power of exposure is removed."""
    measured = u < _MEASURED_U
    step = np.where(measured, np.diff(log_e), 0.0)
    own = np.where(measured, deviation, 0.0)
    return own - step * (own.sum() / max(float(step.sum()), 1e-9))


# ----------------------------------------------------------------------------------------------
# sampled places


PLACES = 500  # places used from a bracket; more did not change the table; chosen
BLOCKS = 60_000  # blocks in which places are searched; limits memory; chosen
LOW = 27  # codes from LOW to HIGH count for the residual, and have weight in a merge; chosen
HIGH = 228  # chosen, as LOW
# codes: largest difference of a place's neighbours in a frame that exposes it well; chosen
FLAT = 3.0
NEGLIGIBLE = 0.002  # of light: smaller differences between candidates do not matter; chosen
DOUBTFUL = 0.10  # of light: a still scene in steady light leaves 1 to 5 %
_LAW_GAIN = 0.8  # of the residual under the labels' law: another law must leave less
_LAW_SIGMA = 4.0  # minimum difference between two laws, in standard errors over the places; chosen
SMOOTH = (3000.0, 300.0, 30.0, 3.0)  # stiffness of the tables that are tried


@dataclass(frozen=True, slots=True)
class Places:
    """Codes of the same places in all frames of a bracket, pooled over brackets.

    codes [places, exposures, 3] : code of a place in R, G, B; 0 if its bracket has no such
    exposure. log_exposure [exposures] : ln of (true shutter time [s] times ISO); bracket [places] :
    index of each place's bracket; frames : files of all brackets; law : how log_exposure follows
    from the nominal shutter times; steps : where the overlap of the frames contradicts them,
    log_exposure is corrected.
    """

    codes: NDArray[np.uint8]
    log_exposure: Floats
    bracket: Indices
    frames: tuple[Path, ...]
    law: ShutterLaw
    steps: Steps


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """A fitted JPEG response, its residuals, and the choice among the tried responses.

    residual : for R, G, B the rms relative difference of a frame's light at a place from the mean
    of the frames there, a share.
    """

    response: Response
    residual: tuple[float, float, float]  # rms of ln z for each colour, within places
    choice: OrderSelection


def brackets_in(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the frames of each bracket: a folder is one bracket; all single files are one more.

    Raises InputError for a folder without JPEG frames.
    """
    single = [path for path in paths if path.is_file()]
    brackets = [single] if single else []
    for folder in (path for path in paths if not path.is_file()):
        frames = sorted(p for p in folder.glob("*") if is_jpeg(p))
        if not frames:
            expected = "a folder with the frames of one bracket"
            raise InputError(folder, "no JPEG frames", expected, "check the path of the folder")
        brackets.append(frames)
    return brackets


@dataclass(frozen=True, slots=True)
class _Part:
    """Flat places of one bracket: codes [places, frames, 3], and the exposures that EXIF states."""

    codes: NDArray[np.uint8]
    exposures: tuple[Exposure, ...]
    folder: Path


def sample(
    brackets: Sequence[Sequence[Path]], profile: CameraProfile, rng: np.random.Generator
) -> Places:
    """Sample the same flat places in every frame of a bracket, pooled over brackets.

    If the profile's shutter law is "auto", the law is that of the EXIF times, unless another one
    leaves a clearly smaller residual. The places are spread over the brightnesses. Raises
    InputError for a bracket of mixed apertures or sizes or with fewer than three exposures,
    NotEnoughDataError for one with fewer than 50 flat, well exposed places.
    """
    parts = [_flat_places(paths, profile, rng) for paths in brackets]
    places = _lawful(parts, tuple(path for paths in brackets for path in paths), profile)
    steps = steps_by_overlap(places.codes, places.log_exposure, places.bracket, LOW, HIGH)
    return replace(places, log_exposure=steps.log_exposure, steps=steps)


def _lawful(parts: Sequence[_Part], files: tuple[Path, ...], profile: CameraProfile) -> Places:
    """Return the places under the profile's shutter law, or the law that labels or codes show."""
    if profile.shutter_law != AUTO:
        return _pool(parts, files, profile, ShutterLaw(profile.shutter_law, "profile"))
    nominal_s = [e.shutter_s for part in parts for e in part.exposures]
    labels = law_of_labels(nominal_s, profile.camera.model)
    pooled = {law: _pool(parts, files, profile, ShutterLaw(law, "labels")) for law in LAWS}
    return pooled[labels.law] if labels.law == EXACT else _supported(pooled, labels)


def _supported(pooled: dict[str, Places], labels: ShutterLaw) -> Places:
    """Return the places under the law whose response has the smallest residual.

    The labels' law remains unless another law is better by more than chance, place by place.
    """
    errors: dict[str, Floats] = {}
    for law, places in pooled.items():
        green, log_e = places.codes[..., 1], places.log_exposure
        errors[law] = residuals(fit_response(green, log_e, smooth=SMOOTH[-1])[0], green, log_e)
    misfit = {law: round(100.0 * float(np.sqrt(np.nanmean(e))), 2) for law, e in errors.items()}
    best = min(LAWS, key=lambda law: (misfit[law], law != labels.law))
    gain = errors[labels.law] - errors[best]
    gain = gain[np.isfinite(gain)]
    chance = float(gain.std()) / np.sqrt(max(len(gain), 1))
    smaller = misfit[best] < _LAW_GAIN * misfit[labels.law]
    clear = smaller and float(gain.mean()) > _LAW_SIGMA * chance
    law = ShutterLaw(best if clear else labels.law, "frames" if clear else "labels", misfit)
    return replace(pooled[law.law], law=law)


def _pool(
    parts: Sequence[_Part], files: tuple[Path, ...], profile: CameraProfile, law: ShutterLaw
) -> Places:
    """Return the places of all brackets on one axis of exposures, under one shutter law."""
    with_law = replace(profile, shutter_law=law.law)
    exposures: list[Floats] = []
    for part in parts:
        log_e = [np.log(true_shutter_s(e.shutter_s, with_law)[0] * e.iso) for e in part.exposures]
        if (count := len({round(e, 3) for e in log_e})) < 3:
            finding = f"{len(part.exposures)} frames with {count} different exposures"
            expected = "a bracket with at least three different exposures"
            raise InputError(part.folder, finding, expected, "take a bracket with more exposures")
        exposures.append(np.array(log_e))
    grid = np.unique(np.round(np.concatenate(exposures), 4)).astype(float)
    codes = np.zeros((sum(len(part.codes) for part in parts), len(grid), 3), np.uint8)
    bracket, row = np.repeat(np.arange(len(parts)), [len(part.codes) for part in parts]), 0
    for part, log_e in zip(parts, exposures, strict=True):
        at = np.searchsorted(grid, np.round(log_e, 4))
        codes[row : row + len(part.codes), at] = part.codes
        row += len(part.codes)
    return Places(codes, grid, bracket, files, law, labelled_steps(grid))


def _flat_places(paths: Sequence[Path], profile: CameraProfile, rng: np.random.Generator) -> _Part:
    """Return the mean codes of a bracket's 3 x 3 blocks without an edge, inside the lens circles.

    At most BLOCKS blocks on a grid are read, one frame at a time, so that the memory needed does
    not grow with the sensor.
    """
    height, width = profile.camera.height_px, profile.camera.width_px
    step = max(3, int(np.ceil(np.sqrt(height * width / BLOCKS))))
    y, x = np.mgrid[1 : height - 1 : step, 1 : width - 1 : step]
    inside = np.zeros(x.shape, bool)
    for lens in profile.lens:
        off = np.hypot(x + 0.5 - lens.centre_px[0], y + 0.5 - lens.centre_px[1])
        inside |= off < 0.95 * lens.radius_px
    y, x, blocks, exposures = y[inside], x[inside], [], []
    for path in paths:
        frame = read_jpeg(path, camera_pixels=profile.camera.pixels)
        check_frame(path, frame.codes.shape, frame.model, profile)
        exposures.append(frame.exposure)
        if frame.exposure.f_number != exposures[0].f_number:
            finding = f"f/{frame.exposure.f_number:g}, but the first frame has another aperture"
            raise InputError(path, finding, "the frames of one bracket", "remove this frame")
        around = [frame.codes[y + down, x + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
        blocks.append(np.stack(around, axis=1))
    codes = np.stack(blocks)  # [frames, places, 9, 3]
    holds = ((codes >= LOW) & (codes <= HIGH)).all(axis=(2, 3))  # [frames, places]
    spread = np.where(holds, np.ptp(codes[..., 1], axis=2), 0)  # of green
    flat = np.flatnonzero((spread.max(axis=0) <= 3 * FLAT) & (holds.sum(axis=0) >= 2))
    if len(flat) < 50:
        raise NotEnoughDataError(
            f"{paths[0].parent}: {len(flat)} even places in the lens circle are exposed well (JPEG "
            f"codes {LOW} to {HIGH}) by two frames; expected at least 50; use exposure steps of at "
            "most 2 EV, and picture even surfaces such as walls and sky"
        )
    brightness = codes[:, flat][..., 1].mean(axis=(0, 2)) + rng.uniform(0, 1e-3, len(flat))
    chosen = flat[_spread(brightness, min(PLACES, len(flat)))]
    means = np.rint(codes[:, chosen].mean(axis=2)).astype(np.uint8).transpose(1, 0, 2)
    return _Part(means, tuple(exposures), paths[0].parent)


def _spread(level: Floats, count: int) -> Indices:
    """Return at most `count` indices of `level` [n], spread over levels and over places.

    Half is spread evenly over the levels. Otherwise there would be too few bright places, which are
    the only ones that short frames show.
    """
    order = np.argsort(level)
    wanted = np.linspace(level.min(), level.max(), count // 2)
    even = np.minimum(np.searchsorted(level[order], wanted), len(level) - 1)
    ranks = np.linspace(0, len(level) - 1, count - len(np.unique(even))).astype(int)
    return order[np.union1d(even, ranks)]


# ----------------------------------------------------------------------------------------------
# fit


def residuals(table: Floats, codes: NDArray[np.uint8], log_e: Floats, low: int = LOW) -> Floats:
    """Return for each place the variance of ln(z / exposure) over its frames, [places].

    With the right table it contains only noise, because the light of a place is the same in all
    frames. table [256] : linear light z of each code; codes [places, frames] : of one colour; log_e
    [frames] : ln of exposure. Codes from `low` to 228 count; NaN for places with fewer than two.
    """
    counts = (codes >= low) & (codes <= HIGH)
    light = np.where(counts, np.log(np.maximum(table[codes], 1e-9)) - log_e, 0.0)
    n = counts.sum(axis=1)
    mean = light.sum(axis=1) / np.maximum(n, 1)
    square = (np.where(counts, light - mean[:, None], 0.0) ** 2).sum(axis=1)
    return np.divide(square, n - 1, out=np.full(len(n), np.nan), where=n >= 2)


def _tables(places: Places, rows: Mask, model: str | float) -> list[Floats]:
    """Return the tables of R, G, B: a standard curve by its name, or fitted with a stiffness."""
    if isinstance(model, str):
        return [response_table(model)] * 3
    codes = places.codes[rows]
    return [fit_response(codes[..., c], places.log_exposure, smooth=model)[0] for c in range(3)]


def fit(places: Places) -> ResponseFit:
    """Fit the response: standard curves, then monotone tables from stiff to flexible.

    Held-out places choose among them. Complete brackets are held out if there are three or more,
    else an eighth of the places at a time. If the darkest codes do not follow the light (because of
    a black level), low_code rises to the first code that does. Raises NotEnoughDataError for fewer
    than 20 places that are well exposed in two frames.
    """
    low = max(LOW, *(dark_floor(places.codes[..., c], places.log_exposure) for c in range(3)))
    groups = places.bracket if places.bracket.max() >= 2 else np.arange(len(places.codes)) % 8
    models: list[tuple[str, int, str | float]] = [("linear", 0, "linear"), ("srgb", 0, "srgb")]
    models += [(f"table of stiffness {s:g}", n, s) for n, s in enumerate(SMOOTH, start=1)]
    _check_overlap(places, low)
    model, tables, choice = fit_and_choose(
        "response",
        models,
        groups,
        lambda model, rows: _tables(places, rows, model),
        lambda _, tables, held: _misfit(places, tables, held, low),
        unit="% of light",
        negligible=NEGLIGIBLE,
    )
    if isinstance(model, str):
        response = Response(kind=model)  # type: ignore[arg-type]
    else:
        red, green, blue = (tuple(round(float(z), 7) for z in t) for t in tables)
        response = Response("table", red, green, blue)
    red_rms, green_rms, blue_rms = (
        float(np.sqrt(np.nanmean(residuals(t, places.codes[..., c], places.log_exposure, low))))
        for c, t in enumerate(tables)
    )
    if choice.rms > DOUBTFUL:
        doubt = (
            f"CAUTION: the fitted light of the same places differs by {100 * choice.rms:.0f} % "
            "between frames: check that camera and light did not change, and take the bracket again"
        )
        choice = replace(choice, line=f"{choice.line}. {doubt}")
    u_rel = round(max(choice.rms, 0.001), 5)
    response = replace(response, low_code=low, high_code=HIGH, u_rel=u_rel)
    return ResponseFit(response, (red_rms, green_rms, blue_rms), choice)


def _misfit(places: Places, tables: list[Floats], held: Mask, low: int) -> Floats:
    """Return squared errors of places, averaged over colours; NaN unless two frames see a place."""
    codes, log_e = places.codes[held], places.log_exposure
    by_colour = np.stack([residuals(t, codes[..., c], log_e, low) for c, t in enumerate(tables)])
    count = np.isfinite(by_colour).sum(axis=0)
    total = np.nan_to_num(by_colour).sum(axis=0)
    return np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)


def _check_overlap(places: Places, low: int) -> None:
    """Raise NotEnoughDataError for fewer than 20 places that are well exposed in two frames."""
    good = ((places.codes >= low) & (places.codes <= HIGH)).sum(axis=1) >= 2  # [places, 3]
    if (count := int(good.any(axis=1).sum())) < 20:
        raise NotEnoughDataError(
            f"places that are well exposed in two frames: {count}; expected at least 20 to "
            "fit a response; take more frames"
        )
