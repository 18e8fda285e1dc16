"""annual/NAME/hourly.csv: light, trust and glare of each hour of a predicted year."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import input_errors
from fieldlum.session.codec import check_format, read_columns, write_columns

FORMAT = 1  # of the file; docs/file-formats.md
NAME = "hourly.csv"
HOUR_COLUMNS = (
    "dni_wm2",
    "dhi_wm2",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "disc_lx",
    "occupied",
    "trusted",
    "expected_log10_mse",
    "disturbed_share",
)
# Chosen.
VIEW_COLUMNS = {  # name and number of digits written
    "dgp": 4,
    "u_dgp": 4,
    "dgp_low": 4,
    "dgp_high": 4,
    "dgps": 4,
    "ev_lx": 1,
    "melanopic_edi_lx_estimate": 1,
    "melanopic_edi_lx": 1,  # written only with calibrated colour, like its uncertainty
    "u_melanopic_edi_lx": 1,
    "ugr": 2,
    "dgi": 2,
    "task_cdm2": 1,
    "window_to_task": 2,
    "uniformity": 3,
}
# Columns that earlier versions did not write are NaN in their years.
COLOUR_COLUMNS = ("melanopic_edi_lx", "u_melanopic_edi_lx")
LATER_COLUMNS = ("dgp_low", "dgp_high", *COLOUR_COLUMNS)
_OTHER_DIGITS = 3  # of further metrics; chosen
LATER_HOUR_COLUMNS = ("disturbed_share",)


@dataclass(frozen=True, slots=True)
class HourlyFile:
    """The content of one hourly.csv: figures of n hours, and of each hour in d view directions.

    azimuths_deg: [d], clockwise from north. hours: each of `HOUR_COLUMNS`, [n]. views: each of
    `VIEW_COLUMNS` and further metrics, [n, d]; columns ``metric@azimuth`` in the file. NaN, an
    empty cell, means undefined.
    """

    t_utc: tuple[datetime, ...]
    azimuths_deg: Floats
    hours: dict[str, Floats]
    views: dict[str, Floats]

    @classmethod
    def read(cls, folder: Path, azimuths_deg: Floats, count: int) -> HourlyFile:
        """Read hourly.csv of a folder, with `count` rows and the view directions `azimuths_deg`.

        Warns of a file that changed after `write`. Columns that version 0.1.0 did not write become
        NaN. Raises InputError for a missing file, another number of rows or other content.
        """
        path = folder / NAME
        expected, remedy = (
            f"{count} hours that fieldlum predict wrote",
            "run fieldlum predict again",
        )
        column = read_columns(path, expected, remedy)
        newest = column.get("format", np.ones(1)).max(initial=1)
        check_format(path, int(newest), FORMAT)
        with input_errors(path, expected, remedy, ValueError, KeyError):
            if len(column["t_utc"]) != count:
                raise ValueError(f"{len(column['t_utc'])} hours")
            of_views = [f"{name}@{a:g}" for name in LATER_COLUMNS for a in azimuths_deg]
            later = dict.fromkeys([*LATER_HOUR_COLUMNS, *of_views], np.full(count, np.nan))
            column = {**later, **column}
            names = dict.fromkeys([*VIEW_COLUMNS, *_metrics_of(column)])
            views = {
                name: np.stack([column[f"{name}@{a:g}"] for a in azimuths_deg], 1).astype(float)
                for name in names
            }
            hours = {name: column[name].astype(float) for name in HOUR_COLUMNS}
        times = tuple(datetime.fromtimestamp(t, UTC) for t in column["t_utc"])
        return cls(times, azimuths_deg, hours, views)

    def write(self, folder: Path, timezone: str) -> None:
        """Write hourly.csv; its column t_local is in `timezone`, the IANA zone of the site."""
        local = [t.astimezone(ZoneInfo(timezone)) for t in self.t_utc]
        columns: dict[str, Any] = {
            "t_utc": [t.timestamp() for t in self.t_utc],
            "t_local": [f"{t:%Y-%m-%d %H:%M}" for t in local],
        }
        for name in HOUR_COLUMNS:
            digits = 6 if name == "expected_log10_mse" else 2
            columns[name] = np.round(np.asarray(self.hours[name], float), digits)
        for k, azimuth_deg in enumerate(self.azimuths_deg):
            for name in dict.fromkeys((*VIEW_COLUMNS, *self.views)):
                if name not in COLOUR_COLUMNS or np.isfinite(self.views[name]).any():
                    values = np.round(self.views[name][:, k], VIEW_COLUMNS.get(name, _OTHER_DIGITS))
                    columns[f"{name}@{azimuth_deg:g}"] = values
        write_columns(folder / NAME, {**columns, "format": FORMAT})


def _metrics_of(columns: Iterable[str]) -> list[str]:
    return [name.partition("@")[0] for name in columns if "@" in name]
