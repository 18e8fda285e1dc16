"""Measure the exposure steps of a JPEG bracket where its frames overlap, by an unknown response.

Labels are rounded to thirds of a stop, and some shutters keep the decimals: steps that are equal by
the labels differ by up to 6.7 %. Frames that show the same places decide the deviations of single
steps. They cannot decide the length of all steps together, because an unknown response leaves a
power of the exposure free (Grossberg and Nayar 2003): the labels do.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.statistics import median_standard_error, robust_sigma
from fieldlum.optics.photometry import fit_response

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
