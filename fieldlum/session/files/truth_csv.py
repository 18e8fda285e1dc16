"""truth/irradiance.csv: the irradiance that simulated instruments measure."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import parse_utc, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.writing import write_table

TRUTH_COLUMNS = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2")


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
        remedy = "write the file again with: fieldlum simulate"
        rows = [
            cells for _, cells in read_table(path, expected, remedy, needed=TRUTH_COLUMNS).dicts()
        ]
        with input_errors(path, expected, remedy, ValueError):
            times = np.array([parse_utc(row["t_utc"]).timestamp() for row in rows])
            light = [np.array([float(row[name]) for row in rows]) for name in TRUTH_COLUMNS[1:]]
        if len(times) < 2 or np.any(np.diff(times) <= 0) or not np.isfinite(light).all():
            finding = f"{len(times)} rows"
            if len(times) > 1:
                finding = "times that do not increase, or a value that is not finite"
            raise InputError(path, finding, "two or more rows of numbers, in order of time", remedy)
        return cls(times, *light)

    def write(self, path: Path) -> None:
        """Write all rows with three decimals; NaN becomes 0."""
        columns = self.t_unix_s, self.ghi_wm2, self.dhi_wm2, self.dni_wm2
        rows = []
        for second, *figures in zip(*columns, strict=True):
            moment = utc_text(datetime.fromtimestamp(float(second), UTC))
            rows.append((moment, *(f"{np.nan_to_num(value):.3f}" for value in figures)))
        write_table(path, TRUTH_COLUMNS, rows, end="\r\n")
