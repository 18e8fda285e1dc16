"""irradiance/clean.csv, quality-checked irradiance, and truth/irradiance.csv, simulated one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.session.codec import read_columns, write_columns

MEASURED, DERIVED = "measured", "derived:dirint"
_FIGURES = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2")
_AROUND_ROWS = 30  # rows on each side for the usual time between rows; not measured


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanIrradiance:
    """Irradiance with three components: arrays [n] in order of time [W/m2]; NaN is unusable.

    source: measured, or derived:dirint for a direct irradiance estimated from the global; flags:
    words separated by spaces. Simulated irradiance has neither.
    """

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    source: Array = field(default_factory=lambda: np.empty(0, object))
    flags: Array = field(default_factory=lambda: np.empty(0, object))

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
        remedy = "log or import irradiance, then run fieldlum pair, which writes the file again"
        return cls._read(path, ("source", "flags"), remedy)

    @classmethod
    def _read(cls, path: Path, texts: tuple[str, ...], remedy: str) -> CleanIrradiance:
        """Return a clean.csv; texts: its columns that are no numbers; remedy: for the error."""
        expected = f"the columns {', '.join((*_FIGURES, *texts))}"
        table = read_columns(path, expected, remedy)
        with input_errors(path, expected, remedy, ValueError, KeyError):
            words = {name: table[name].astype(object) for name in texts}
            cells = {name: np.where(text == text, text, "") for name, text in words.items()}
            times, *light = (table[name].astype(float) for name in _FIGURES)
            return cls(t_unix_s=times, **dict(zip(_FIGURES[1:], light, strict=True)), **cells)

    @classmethod
    def read_truth(cls, path: Path) -> CleanIrradiance:
        """Read simulated irradiance, two or more rows; readers interpolate between them.

        Raises InputError for other content, times that do not increase, and an empty cell.
        """
        remedy = "write the file again with: fieldlum simulate"
        table = cls._read(path, (), remedy)
        figures = np.array([table.t_unix_s, table.ghi_wm2, table.dhi_wm2, table.dni_wm2])
        steps = np.diff(table.t_unix_s)
        if not (len(steps) and (steps > 0).all() and np.isfinite(figures).all()):
            found = f"{len(table.t_unix_s)} rows, times that do not increase, or an empty cell"
            raise InputError(path, found, "two or more rows in order of time", remedy)
        return table

    def write(self, path: Path) -> None:
        """Write all rows."""
        columns: dict[str, Any] = {"t_utc": self.t_unix_s}
        columns |= {name: getattr(self, name) for name in (*_FIGURES[1:], "source", "flags")}
        write_columns(path, {name: v for name, v in columns.items() if len(v) or name in _FIGURES})
