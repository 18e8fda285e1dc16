"""Find a clock that differs between days: stated time less true time of each day.

A clock that drifts, or is set now and then, moves the sun patches of each day by another amount.
Each day's offset is the one under which computed patches match the captured ones best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import HeldOutErrors, difference
from fieldlum.learn.transport.arrays import training_arrays_of
from fieldlum.learn.transport.misalignment import Evidence, below_patches, evidence_of
from fieldlum.learn.transport.solve import basis_of, hold_out
from fieldlum.room.scene import sun_patches
from fieldlum.room.scene.view import patch_rays
from fieldlum.sky import sun
from fieldlum.sky.light import Kernel

# Offsets that are tried, min: a clock that is 5 min off on one day and not on another was set.
_TRIED_MIN = np.array([-5.0, -4.0, -3.0, *np.arange(-2.0, 2.25, 0.5), 3.0, 4.0, 5.0])
# Factors on the patches' gain, tried in two rounds. Light below that is estimated without patches
# includes a part of them, so that the first gain is 0.5 to 0.7 of the true one, and offsets are off
# by up to 1.3 min.
_GAIN_FACTORS = ((1.0, 1.2, 1.45, 1.75, 2.1), (0.9, 1.0, 1.1))
_FEWEST_HOURS = 3  # sunny captures of a day whose offset is estimated; chosen
_FEWEST_DAYS = 3  # with such captures, to have a median; chosen
# Offsets of the clean office at 46 x 23 pixels have a standard deviation of 0.2 min, those of a
# clock that drifts by 2 min in a week 0.6 min. Chosen between the two
# (docs/decisions.md).
_LEAST_SPREAD_MIN = 0.3
_HELD_OUT_PIXELS = 250  # number of pixels that compare two clocks; chosen
_LEAST_GAIN = 0.1  # share of the held-out error that the offsets must explain; chosen


@dataclass(frozen=True, slots=True)
class ClockByDay:
    """Stated time less true time of the captures on each of k days.

    days: the days with at least three sunny captures [k]; late_min: stated minus true time [k] min,
    so positive if stated times are later than the true ones. An offset that is common to all days
    is included.
    """

    days: NDArray[np.datetime64]
    late_min: Array

    def at(self, days: NDArray[np.datetime64]) -> Array:
        """Return stated minus true time of captures on `days`, [n] min.

        A day that is not in `self.days` gets the median of `late_min`.
        """
        late_by_day = dict(zip(self.days.tolist(), self.late_min.tolist(), strict=True))
        middle = float(np.median(self.late_min))
        return np.array([late_by_day.get(day, middle) for day in days.tolist()])


def clock_by_day(data: Dataset, progress: Progress = quiet) -> ClockByDay | None:
    """Return the clock error of each day; None if it does not differ between days.

    Each day's offset is the one under which computed sun patches match the captured ones best; the
    light below them is then estimated again with these offsets, twice. With the offsets corrected,
    the held-out error must fall by a tenth and by one standard error, else the result is None. It
    is None also without sun patches or a box room, and if fewer than three days have three or more
    sunny captures.
    """
    evidence = evidence_of(data, patch_rays(data.shape[0]))  # as in the stated patches
    if evidence is None or evidence.points is None:
        return None
    days = data.days[evidence.rows]
    names, counts = np.unique(days, return_counts=True)
    names = names[counts >= _FEWEST_HOURS]
    if len(names) < _FEWEST_DAYS:
        return None
    late = _late(evidence, names, progress, 0)
    for done, factors in enumerate(_GAIN_FACTORS, start=1):
        maps = with_clock(data, ClockByDay(names, late)).patch_cdm2
        assert maps is not None
        patch = maps.reshape(len(data), -1)[:, evidence.pixels][evidence.rows]
        tries = [below_patches(evidence, maps, f * evidence.gains[1]) for f in factors]
        evidence = min(tries, key=lambda e: float(e.misfit(patch, e.gains[1]).mean()))
        late = _late(evidence, names, progress, done)
    if late.std() < _LEAST_SPREAD_MIN:
        return None
    # Both with patches of the same rays: those of `data` can be of an earlier version.
    clock, none = ClockByDay(names, late), ClockByDay(names, np.zeros(len(names)))
    before, after = (_held_out_errors(with_clock(data, c)) for c in (none, clock))
    gain, error = difference(before, after, "log10")
    return clock if gain > max(_LEAST_GAIN * before.figure("log10"), error) else None


def _held_out_errors(data: Dataset) -> HeldOutErrors:
    """Return the errors of each capture by a fit without its day, of log10 luminance alone."""
    arrays = training_arrays_of(data, with_patch=True)
    share = arrays.weights / arrays.weights.sum()
    count = min(_HELD_OUT_PIXELS, len(share))
    drawn = np.random.default_rng(0).choice(len(share), count, p=share)
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)
    return hold_out(arrays[drawn], basis_of(covariance), 1e-2).errors


def _late(
    evidence: Evidence, names: NDArray[np.datetime64], progress: Progress, done: int
) -> Array:
    """Return the offset of each of the days `names` under which patches match best, [k] min.

    done: number of earlier searches, for the progress.
    """
    total = len(_TRIED_MIN) * (1 + len(_GAIN_FACTORS))
    rows = []
    for k, late_min in enumerate(_TRIED_MIN):
        progress(done * len(_TRIED_MIN) + k, total, "clock of each day")
        rows.append(evidence.misfit(evidence.computed(0.0, float(late_min)), evidence.gains[1]))
    misfits = np.array(rows)  # [offsets, n]
    days = evidence.data.days[evidence.rows]
    return np.array([_least(misfits[:, days == day].sum(axis=1)) for day in names])


def _least(misfits: Array) -> float:
    """Return the offset of the least misfit, by a parabola between those tried."""
    best = int(np.argmin(misfits))
    if not 0 < best < len(misfits) - 1:
        return float(_TRIED_MIN[best])
    x, y = _TRIED_MIN[best - 1 : best + 2], misfits[best - 1 : best + 2]
    square, slope, _ = np.polyfit(x - x[1], y, 2)
    vertex = 0.0 if square <= 0.0 else -slope / (2.0 * square)
    return float(np.clip(x[1] + vertex, x[0], x[2]))


def with_clock(data: Dataset, clock: ClockByDay) -> Dataset:
    """Return the captures with the sun's position and sun patches computed at the corrected times.

    Corrected times are the stated ones minus `clock.at`. The stated times in `light.t_utc` and the
    slot names remain, although they are wrong. `data` must have sun patches and a box room.
    """
    light, site, room = data.light, data.setup.site, data.setup.room
    assert room is not None and data.patch_cdm2 is not None
    late = clock.at(data.days)  # [n] min
    true_utc = [t - timedelta(minutes=m) for t, m in zip(light.t_utc, late.tolist(), strict=True)]
    stated, true = (sun.position(times, site) for times in (list(light.t_utc), true_utc))
    moved = replace(
        light,
        sun_altitude_deg=np.maximum(
            light.sun_altitude_deg + true.altitude_deg - stated.altitude_deg, 0.05
        ),
        sun_azimuth_deg=light.sun_azimuth_deg + true.azimuth_deg - stated.azimuth_deg,
    )
    made = sun_patches(
        room,
        data.setup,
        moved.shown_sun_direction,
        moved.direct_lx,
        height=data.shape[0],
        heading_deg=data.heading_deg,
    )
    return replace(data, light=moved, patch_cdm2=made.luminance_cdm2)
