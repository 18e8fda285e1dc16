"""truth/irradiance.csv: the irradiance that simulated instruments measure."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.session.codec import read_rows, write_rows

TRUTH_COLUMNS: tuple[str, ...] = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2")
_REMEDY = "write the file again with: fieldlum simulate"


@dataclass(frozen=True, slots=True)
class _Row:
    t_utc: datetime
    ghi_wm2: float
    dhi_wm2: float
    dni_wm2: float


@dataclass(frozen=True, slots=True)
class TruthIrradiance:
    """Simulated irradiance, rows [n] in order of time [W/m2]; readers interpolate between them."""

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats

    @classmethod
    def read(cls, path: Path) -> TruthIrradiance:
        """Read the file. Raises InputError if it is missing, has other content or under two rows.

        It is raised also for times that do not increase and for a value that is not finite.
        """
        expected = f"the columns {', '.join(TRUTH_COLUMNS)}"
        rows = read_rows(_Row, path, expected, _REMEDY, TRUTH_COLUMNS)
        times = np.array([row.t_utc.timestamp() for row in rows])
        if len(times) < 2 or np.any(np.diff(times) <= 0):
            finding = f"{len(times)} rows" if len(times) < 2 else "times that do not increase"
            raise InputError(path, finding, "two or more rows, in order of time", _REMEDY)
        light = ([getattr(row, name) for row in rows] for name in TRUTH_COLUMNS[1:])
        return cls(times, *(np.array(column) for column in light))

    def write(self, path: Path) -> None:
        """Write all rows with three decimals; NaN becomes 0."""
        columns = self.t_unix_s, *map(np.nan_to_num, (self.ghi_wm2, self.dhi_wm2, self.dni_wm2))
        rows = (
            _Row(datetime.fromtimestamp(float(second), UTC), *light)
            for second, *light in zip(*columns, strict=True)
        )
        digits = dict.fromkeys(TRUTH_COLUMNS[1:], ".3f")
        write_rows(path, TRUTH_COLUMNS, rows, digits, end="\r\n")
