"""Hold rows of a pyranometer as arrays, each row with marks for possible faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import IrradianceSample

_BLOCK = 64  # rows over which the usual time between rows is computed; not measured


class Mark(IntFlag):
    """Possible faults of a row. Rows with IMPOSSIBLE, STATUS or STUCK get NaN values."""

    IMPOSSIBLE = 1  # outside BSRN's physically possible limits
    EXTREME = 2  # outside BSRN's extremely rare limits
    CLOSURE = 4  # for half an hour global differs from diffuse + direct, if all three are measured
    DIFFUSE = 8  # diffuse above global
    STUCK = 16  # the same value for over ten minutes of daylight
    STATUS = 32  # the instrument reported an error
    LOW_SUN = 64  # sun under 5 degrees, where DNI from horizontal readings is inaccurate
    GAP = 128  # the first row after a gap
    DISORDER = 256  # the row is later in the file than its time requires
    DERIVED = 512  # DNI and DHI are from a model, not from an instrument
    # one reading deviates from both neighbours: a damaged line, a bird, a very small cloud
    SPIKE = 1024
    DOUBLE = 2048  # another row of the same time has other values; the first one is used


UNUSABLE = Mark.IMPOSSIBLE | Mark.STATUS | Mark.STUCK


@dataclass(frozen=True, slots=True)
class Series:
    """Irradiance rows as arrays [n] in order of time, in W/m2 (NaN: unknown), with marks."""

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    marks: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.t_unix_s)


def poll_period_s(t_unix_s: Floats) -> float:
    """Return the median time between two rows [s]; t_unix_s : [n]."""
    return float(np.median(np.diff(t_unix_s))) if len(t_unix_s) > 1 else 60.0


def local_period_s(t_unix_s: Floats) -> Floats:
    """Return the usual time between two rows around each row [n] s.

    It varies because one session can have several loggers.
    """
    step = np.diff(t_unix_s, prepend=t_unix_s[:1] - poll_period_s(t_unix_s))
    blocks = [step[first : first + _BLOCK] for first in range(0, len(step), _BLOCK)]
    usual = [float(np.median(block)) for block in blocks]
    if len(blocks) > 1 and len(blocks[-1]) < _BLOCK // 2:
        usual[-1] = usual[-2]
    return np.repeat(usual, [len(block) for block in blocks])


def series_of(samples: Sequence[IrradianceSample]) -> Series:
    """Return samples as arrays in order of time; of samples with one time, only the first.

    STATUS, DISORDER and DOUBLE are marked.
    """
    t = np.array([s.t_utc.timestamp() for s in samples])
    light = np.array([(s.ghi_wm2, s.dhi_wm2, s.dni_wm2) for s in samples], float).reshape(-1, 3).T
    # An error makes a reading unusable; more diffuse than global only makes it doubtful.
    status = {"": Mark(0), "total below diffuse": Mark.DIFFUSE}
    marks = np.array([status.get(s.status, Mark.STATUS) for s in samples], np.int64)
    if len(t) > 1:
        marks[1:][t[1:] < np.maximum.accumulate(t)[:-1]] |= Mark.DISORDER
    _, keep, which = np.unique(t, return_index=True, return_inverse=True)
    first = keep[which]
    same = (light == light[:, first]) | (np.isnan(light) & np.isnan(light[:, first]))
    marks[first[~same.all(axis=0)]] |= Mark.DOUBLE
    ghi, dhi, dni = light[:, keep]
    return Series(t[keep], ghi, dhi, dni, marks[keep])
