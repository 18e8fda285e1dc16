"""Weigh captured hours, and choose among candidates by what users decide: DGP in held-out hours.

Within its standard error the error of vertical illuminance decides, then that of log10 luminance.
`train` chooses its models with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.statistics import standard_error
from fieldlum.sky.sun import LOW_SUN_DEG, ZERO_OFFSET_WM2

if TYPE_CHECKING:
    from fieldlum.learn.models.training_data import Dataset
    from fieldlum.sky.daylight import Light

# Share of the weight of the hours with the largest errors that does not count: 1 hour of a day's
# 10 may have an irradiance that its picture contradicts. Chosen.
TRIM = 0.05
CRITERIA = {"dgp": "DGP", "ev": "Ev", "log10": "log10 luminance"}


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutErrors:
    """Errors of one candidate in n held-out hours, [n] each, NaN where not computed.

    dgp: mean absolute error of DGP over fully seen view directions, with the true disc; ev: mean
    absolute error of ln Ev over the same directions; log10: mean squared error of log10 luminance;
    day: date; weight: 0 to 1, by `choice_weights`.
    """

    dgp: Floats
    ev: Floats
    log10: Floats
    day: Array
    weight: Floats

    def figure(self, name: str) -> float:
        """Return the trimmed weighted mean of one error; NaN if no hour has it.

        name: one of `CRITERIA`, whose unit the result has.
        """
        values = getattr(self, name)
        rows = np.isfinite(values) & (self.weight > 0.0)
        return trimmed_mean(values[rows], self.weight[rows])

    @property
    def judged(self) -> int:
        """Number of hours with weight."""
        return int((self.weight > 0.0).sum())


def limit_of(values: Floats, weight: Floats) -> float:
    """Return the smallest of the values that is exceeded by at most a share TRIM of the weight.

    values, weight: [n], n at least 1; weights at least 0.
    """
    order = np.argsort(values)
    above = 1.0 - np.cumsum(weight[order]) / weight.sum()
    return float(values[order][np.argmax(above <= TRIM + 1e-9)])


def trimmed_mean(values: Floats, weight: Floats) -> float:
    """Return the weighted mean of the values [n] without the largest; NaN without values.

    weight: [n]; the largest values that have at most a share TRIM (5 %) of it are omitted.
    """
    if not len(values):
        return float("nan")
    used = values <= limit_of(values, weight)
    return float(np.average(values[used], weights=weight[used]))


def difference(candidate: HeldOutErrors, other: HeldOutErrors, name: str) -> tuple[float, float]:
    """Return a candidate's trimmed mean error minus that of another one, and its standard error.

    A negative difference: the candidate is better. Both candidates have the same hours. Hours
    without weight, or without the error of either candidate, do not count; at least one hour must
    count. Of each candidate, the hours with the largest errors are omitted, up to the share TRIM of
    the weight. name: one of `CRITERIA`, whose unit both results have. The standard error is that of
    the trimmed mean, by winsorised differences (Tukey and McLaughlin 1963), where only days are
    independent; it is 0 with one day.
    """
    own, others = getattr(candidate, name), getattr(other, name)  # errors of each hour [n]
    rows = np.isfinite(own) & np.isfinite(others) & (candidate.weight > 0.0)
    own, others, weight = own[rows], others[rows], candidate.weight[rows]
    mean = trimmed_mean(own, weight) - trimmed_mean(others, weight)
    winsorised = np.minimum(own, limit_of(own, weight))
    differences = winsorised - np.minimum(others, limit_of(others, weight))
    error = standard_error(differences * weight / weight.mean(), candidate.day[rows])
    return mean, float(np.nan_to_num(error)) / (1.0 - TRIM)


class HeldOutChoice(NamedTuple):
    """The index of the best candidate, and the criterion that decided.

    by: one of `CRITERIA`, in which all others are worse by over a standard error; None if no
    criterion separates them, so that the smallest error of DGP decided.
    """

    best: int
    by: str | None


def choose(candidates: Sequence[HeldOutErrors]) -> HeldOutChoice:
    """Choose the candidate, of one or more, with the smallest error; all have the same hours.

    Candidates whose error of DGP is within one standard error of the smallest are compared by Ev,
    those within a standard error there by log10 luminance. If several remain, the one with the
    smallest error of DGP is chosen, or of log10 luminance where DGP was not computed.
    """
    remaining = list(range(len(candidates)))
    first_means: list[float] = []  # errors of the first criterion that was computed
    for by in CRITERIA:
        means = [candidate.figure(by) for candidate in candidates]
        if not np.isfinite(means).all():
            continue
        first_means = first_means or means
        best = min(remaining, key=means.__getitem__)
        gaps = {i: difference(candidates[i], candidates[best], by) for i in remaining}
        remaining = [i for i, (gap, error) in gaps.items() if gap <= error]
        if len(remaining) == 1:
            return HeldOutChoice(best, by if len(gaps) > 1 else None)
    return HeldOutChoice(min(remaining, key=first_means.__getitem__), None)


# ----------------------------------------------------------------------------------------------
# weights of hours, by how well their irradiance was measured


UNSURE = 1e-2  # relative variance of an hour or a pixel that has half weight; not measured
UNCERTAIN_WEIGHT = 0.25  # of an hour with an uncertain beam, if over a third have one; chosen


def sun_is_unmeasured(light: Light) -> Mask:
    """Return a mask [n], True where direct light is recorded as zero only because it is unmeasured.

    That is so if the sun is under 3 degrees and its direct irradiance is zero or less.
    """
    # At a lower sun, closure divides by less than 0.05, so that 2 W/m2 in the horizontal become 40
    # W/m2 in the normal; sun.dni_by_closure gives 0 under 2 degrees
    return (light.sun_altitude_deg < 3.0) & (light.dni_wm2 <= 0.0)


def light_variance(data: Dataset) -> Array:
    """Return the relative variance of the irradiance of each hour, from its own readings, [n].

    The range of the readings in the bracket (change or noise), divided by the mean
    (`Dataset.steadiness`), counts as the width of a rectangular distribution (JCGM 100:2008,
    4.3.7). The sun's normal irradiance is a difference of two horizontal readings divided by the
    sine of its altitude, and so are its errors. For a sun under 3 degrees the readings give no
    value: a direct irradiance of zero is then unknown, and 1 is added.
    """
    light = data.light
    variance = (data.steadiness / (np.sqrt(12.0) * _sine_of_altitude(light))) ** 2
    # A sun that was not measured may give as much light as the sky: a relative variance of 1.
    return variance + sun_is_unmeasured(light)


def _sine_of_altitude(light: Light) -> Array:
    """Return the sine of the sun's altitude, [n]; altitudes below 1 degree count as 1 degree."""
    # Horizontal readings do not give the normal irradiance of a sun below 1 degree.
    return np.sin(np.radians(np.maximum(light.sun_altitude_deg, 1.0)))


def offset_variance(light: Light) -> Array:
    """Return the relative variance of the irradiance that a reading's zero offset causes, [n].

    The offset is 2 W/m2 (ISO 9060, zero offset B of class A). Divided by the sine of the sun's
    altitude, at least that of 1 degree, it is an error of DNI; the result is the square of that
    error over DNI + DHI.
    """
    total_wm2 = np.maximum(light.dhi_wm2 + light.dni_wm2, 1e-9)
    return (ZERO_OFFSET_WM2 / (_sine_of_altitude(light) * total_wm2)) ** 2


def beam_variance(light: Light) -> Array:
    """Return the relative variance of the light that errors of the direct irradiance cause, [n].

    It is twice `offset_variance`, because direct irradiance is a difference of two readings; it is
    0 without direct irradiance, and 1 at most. Without this variance, a beam of 100 W/m2 at 5
    degrees, whose efficacy differs from Perez's, made the patches of stronger beams nearby 1.7
    times as bright (measured in the room upstairs).
    """
    return np.where(light.dni_wm2 > 0.0, np.minimum(2.0 * offset_variance(light), 1.0), 0.0)


def weight_of_variance(variance: Floats) -> Floats:
    """Return weights 1 to 0 for relative variances [...], 1 / (1 + variance / UNSURE).

    It is the inverse of (variance + UNSURE), divided by its value for an exact value. UNSURE is
    0.01 (chosen), so that such a variance has half weight.
    """
    return 1.0 / (1.0 + variance / UNSURE)


def beam_is_uncertain(data: Dataset) -> Mask:
    """Return a mask [n], True for hours whose direct light was not measured well.

    These are hours with a beam and a sun under 5 degrees, hours with an unmeasured sun, and those
    whose irradiance `pair` marked (`Dataset.uncertain`).
    """
    light = data.light
    # Up to 20 W/m2 the DNI can be that of an overcast hour, by errors of two horizontal readings.
    low = (light.sun_altitude_deg < LOW_SUN_DEG) & (light.dni_wm2 > 20.0)
    uncertain = low | sun_is_unmeasured(light)
    return uncertain if data.uncertain is None else uncertain | data.uncertain


def is_badly_measured(data: Dataset) -> Mask:
    """Return a mask [n], True for hours whose pictures cannot contradict their irradiance.

    In these hours the beam is uncertain (`beam_is_uncertain`), or the errors of GHI and DHI exceed
    a tenth of the light. A low sun shines straight into a room: at 5 degrees an error of 2 W/m2 in
    GHI - DHI is a DNI of 23 W/m2.
    """
    return beam_is_uncertain(data) | (offset_variance(data.light) > UNSURE)


def choice_weights(data: Dataset) -> Floats:
    """Return the weights of hours in choices and warnings, 0 to 1, [n].

    Hours with an uncertain beam have the weight 0, or 0.25 if fewer than two thirds of the hours
    would remain. The weight of the others is 1 for steady light and less for unsteady light.
    """
    uncertain = beam_is_uncertain(data)
    minimum = 0.0 if (~uncertain).mean() >= 2.0 / 3.0 else UNCERTAIN_WEIGHT
    steady = weight_of_variance(np.where(uncertain, 0.0, light_variance(data)))
    return np.where(uncertain, minimum, steady)
