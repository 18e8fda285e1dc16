"""irradiance/clean.csv: quality-checked irradiance, with three components in every usable row."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.session.codec import read_columns, write_columns

CLEAN_COLUMNS = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2", "source", "flags")
MEASURED, DERIVED = "measured", "derived:dirint"
_AROUND_ROWS = 30  # rows on each side for the usual time between rows; not measured


@dataclass(frozen=True, slots=True)
class CleanIrradiance:
    """Quality-checked irradiance: arrays [n] in order of time [W/m2]; NaN is unusable.

    source: measured, or derived:dirint for a direct irradiance estimated from the global; flags:
    words separated by spaces.
    """

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    source: NDArray[np.object_]
    flags: NDArray[np.object_]

    def every_s(self, moment_unix_s: float) -> float:
        """Return the median time between the 60 rows around a moment [s]; 60 for one row or none.

        The moment is in Unix seconds. A session can have two loggers with different intervals.
        """
        at = int(np.searchsorted(self.t_unix_s, moment_unix_s))
        steps = np.diff(self.t_unix_s[max(at - _AROUND_ROWS, 0) : at + _AROUND_ROWS])
        return float(np.median(steps)) if len(steps) else 60.0

    @classmethod
    def read(cls, path: Path) -> CleanIrradiance:
        """Read the file; warn if it changed after `write`.

        Raises InputError for a missing file or other content.
        """
        if not path.is_file():
            remedy = "log or import it (fieldlum log, fieldlum import), then run fieldlum pair"
            raise InputError(path, "no such file", "quality-checked irradiance", remedy)
        expected = f"the columns {', '.join(CLEAN_COLUMNS)}"
        remedy = "delete the file and run fieldlum pair, which writes it again"
        table = read_columns(path, expected, remedy)
        with input_errors(path, expected, remedy, ValueError, KeyError):
            numbers = (table[name].astype(float) for name in CLEAN_COLUMNS[:4])
            texts = (table[name].astype(object) for name in CLEAN_COLUMNS[4:])
            return cls(*numbers, *(np.where(text == text, text, "") for text in texts))

    def write(self, path: Path) -> None:
        """Write all rows, with three decimals."""
        light = {name: getattr(self, name).round(3) for name in CLEAN_COLUMNS[1:4]}
        texts = {"source": self.source, "flags": self.flags}
        write_columns(path, {"t_utc": self.t_unix_s, **light, **texts})
