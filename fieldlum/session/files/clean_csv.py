"""irradiance/clean.csv: quality-checked irradiance, with three components in every usable row."""

from __future__ import annotations

from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.strict_csv import plain_rows
from fieldlum.session.codec import change_of, sealed
from fieldlum.session.writing import replacing

CLEAN_COLUMNS = ("t_utc", "ghi_wm2", "dhi_wm2", "dni_wm2", "source", "flags")
MEASURED, DERIVED = "measured", "derived:dirint"
_BLOCK_ROWS = 20_000  # the texts of a million rows at once would take 300 MB; chosen
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
        import pandas as pd

        if not path.is_file():
            raise InputError(
                path,
                "no such file",
                "quality-checked irradiance",
                "log or import irradiance (fieldlum log, fieldlum import), then run fieldlum pair",
            )
        expected = "the columns that fieldlum pair writes"
        remedy = "delete the file and run fieldlum pair, which writes it again"
        with input_errors(path, expected, remedy, ValueError, KeyError, TypeError):
            text = plain_rows(path, expected, remedy, len(CLEAN_COLUMNS))
            table = pd.read_csv(StringIO(text), dtype={"source": str, "flags": str})
            when = pd.to_datetime(table["t_utc"], format="ISO8601", utc=True)
            t = when.to_numpy("datetime64[ns]").astype(np.int64) / 1e9
            ghi, dhi, dni = (table[f"{name}_wm2"].to_numpy(float) for name in ("ghi", "dhi", "dni"))
            source, flags = (
                table[name].fillna("").to_numpy(object) for name in ("source", "flags")
            )
        change_of(path)
        return cls(t, ghi, dhi, dni, source, flags)

    def write(self, path: Path) -> None:
        """Write all rows, with three decimals."""
        import pandas as pd

        count = len(self.t_unix_s)
        with (
            sealed(path),
            replacing(path, "w", newline="", encoding="utf-8") as file,
        ):
            for first in range(0, max(count, 1), _BLOCK_ROWS):
                rows = slice(first, first + _BLOCK_ROWS)
                when = pd.to_datetime(self.t_unix_s[rows], unit="s", utc=True).round("ms")
                table = pd.DataFrame(
                    {
                        "t_utc": when.strftime("%Y-%m-%dT%H:%M:%S.%f").str[:-3] + "Z",
                        "ghi_wm2": self.ghi_wm2[rows].round(3),
                        "dhi_wm2": self.dhi_wm2[rows].round(3),
                        "dni_wm2": self.dni_wm2[rows].round(3),
                        "source": self.source[rows],
                        "flags": self.flags[rows],
                    },
                    columns=list(CLEAN_COLUMNS),
                )
                table.to_csv(file, index=False, header=first == 0, lineterminator="\n")
