"""truth/irradiance.csv: the irradiance that simulated instruments measure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.session.codec import read_columns, write_columns

_NAMES = ("ghi_wm2", "dhi_wm2", "dni_wm2")


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
        expected = f"two or more rows of t_utc, {', '.join(_NAMES)}, in order of time"
        remedy = "write the file again with: fieldlum simulate"
        table = read_columns(path, expected, remedy)
        with input_errors(path, expected, remedy, ValueError, KeyError):
            columns = [table[name].astype(float) for name in ("t_utc", *_NAMES)]
        if len(columns[0]) < 2 or not (np.diff(columns[0]) > 0).all():
            found = f"{len(columns[0])} rows, or times that do not increase"
            raise InputError(path, found, expected, remedy)
        if not np.isfinite(columns).all():
            raise InputError(path, "an empty cell", expected, remedy)
        return cls(*columns)

    def write(self, path: Path) -> None:
        """Write all rows; NaN becomes 0."""
        light = {name: np.nan_to_num(getattr(self, name)).round(3) for name in _NAMES}
        write_columns(path, {"t_utc": self.t_unix_s, **light})
