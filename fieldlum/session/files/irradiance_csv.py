"""irradiance/clean.csv: quality-checked irradiance; truth/irradiance.csv: simulated irradiance."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.session.codec import read_columns, write_columns

MEASURED, DERIVED = "measured", "derived:dirint"
_NUMBERS = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2")
_AROUND_ROWS = 30  # rows on each side for the usual time between rows; not measured


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanIrradiance:
    """Global, diffuse and direct irradiance: arrays [n] in order of time [W/m2]; NaN is unusable.

    t_unix_s: Unix times [s]; ghi_wm2, dhi_wm2: on a horizontal plane; dni_wm2: on a plane normal to
    the sun; source: measured, or derived:dirint for a direct irradiance estimated from the global;
    flags: those of the quality checks, such as spike, separated by spaces (docs/capture.md).
    Simulated irradiance has neither source nor flags: these arrays are empty.
    """

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    source: Array = field(default_factory=lambda: np.empty(0, object))
    flags: Array = field(default_factory=lambda: np.empty(0, object))

    def every_s(self, moment_unix_s: float) -> float:
        """Return the median time [s] between rows near a moment; 60 with fewer than two rows.

        moment_unix_s: Unix time [s]. The 60 rows around it are used, because a session can have two
        loggers with different intervals.
        """
        at = int(np.searchsorted(self.t_unix_s, moment_unix_s))
        steps = np.diff(self.t_unix_s[max(at - _AROUND_ROWS, 0) : at + _AROUND_ROWS])
        return float(np.median(steps)) if len(steps) else 60.0

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the content of a clean.csv; warn if it changed after `write`.

        Raises InputError for a missing file or other content.
        """
        remedy = "log or import irradiance, then run fieldlum pair, which writes the file again"
        return cls._read(path, ("source", "flags"), remedy)

    @classmethod
    def _read(cls, path: Path, texts: tuple[str, ...], remedy: str) -> Self:
        """Return the content of a file; texts: columns that are no numbers; remedy: for errors."""
        expected = f"the columns {', '.join((*_NUMBERS, *texts))}"
        table = read_columns(path, expected, remedy)
        with input_errors(path, expected, remedy, ValueError, KeyError):
            words = ((name, table[name].astype(object)) for name in texts)
            columns = {name: np.where(word == word, word, "") for name, word in words}  # NaN: empty
            times, *light = (table[name].astype(float) for name in _NUMBERS)
            return cls(t_unix_s=times, **dict(zip(_NUMBERS[1:], light, strict=True)), **columns)

    @classmethod
    def read_truth(cls, path: Path) -> Self:
        """Return simulated irradiance, of a truth/irradiance.csv; it has two or more rows.

        Raises InputError for a missing file, other content, fewer rows, times that do not increase,
        and an empty cell.
        """
        remedy = "write the file again with: fieldlum simulate"
        table = cls._read(path, (), remedy)
        numbers = np.array([table.t_unix_s, table.ghi_wm2, table.dhi_wm2, table.dni_wm2])
        steps_s = np.diff(table.t_unix_s)
        if not (len(steps_s) and (steps_s > 0).all() and np.isfinite(numbers).all()):
            found = f"{len(table.t_unix_s)} rows, times that do not increase, or an empty cell"
            raise InputError(path, found, "two or more rows in order of time", remedy)
        return table

    def write(self, path: Path) -> None:
        """Write all rows to the csv `path`, with its SHA-256 in NAME.sha256.

        Without source and flags, these columns are omitted.
        """
        columns: dict[str, Any] = {"t_utc": self.t_unix_s}
        columns |= {name: getattr(self, name) for name in (*_NUMBERS[1:], "source", "flags")}
        write_columns(path, {name: v for name, v in columns.items() if len(v) or name in _NUMBERS})
