"""annual/NAME/hourly.csv: light, trust and glare of each hour of a predicted year."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import input_errors
from fieldlum.session.codec import check_format, read_columns, write_columns

FORMAT = 1  # of the file; docs/file-formats.md
NAME = "hourly.csv"
_DIGITS = 5  # significant ones; chosen
HOUR_COLUMNS = (
    *("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg", "disc_lx"),
    *("occupied", "trusted", "expected_log10_mse", "disturbed_share"),
)
COLOUR_COLUMNS = ("melanopic_edi_lx", "u_melanopic_edi_lx")  # written only with calibrated colour
VIEW_COLUMNS = (
    *("dgp", "u_dgp", "dgp_low", "dgp_high", "dgps", "ev_lx", "melanopic_edi_lx_estimate"),
    *(*COLOUR_COLUMNS, "ugr", "dgi", "task_cdm2", "window_to_task", "uniformity"),
)
# Columns that earlier versions did not write; they are NaN in their years.
_LATER_COLUMNS = ("dgp_low", "dgp_high", *COLOUR_COLUMNS, "disturbed_share")


@dataclass(frozen=True, slots=True)
class HourlyFile:
    """The content of one hourly.csv: figures of n hours, and of each hour in d view directions.

    t_utc: middles of the hours. azimuths_deg: [d], clockwise from true north. hours: each of
    `HOUR_COLUMNS`, [n]. views: each of `VIEW_COLUMNS` and further metrics, [n, d]; columns
    ``metric@azimuth`` in the file. docs/file-formats.md explains each column. NaN, an empty cell,
    means undefined.
    """

    t_utc: tuple[datetime, ...]
    azimuths_deg: Floats
    hours: dict[str, Floats]
    views: dict[str, Floats]

    @classmethod
    def read(cls, folder: Path, azimuths_deg: Floats, count: int) -> Self:
        """Return the content of hourly.csv in a folder.

        azimuths_deg: of its view directions [d]; count: its number of rows. Warns of a file that
        changed after `write`. Raises InputError for a missing file, another number of rows or other
        content.
        """
        path, remedy = folder / NAME, "run fieldlum predict again"
        expected = f"{count} hours that fieldlum predict wrote"
        stored = read_columns(path, expected, remedy)
        check_format(path, int(stored.get("format", np.ones(1)).max(initial=1)), FORMAT)

        def values_of(name: str, column: str) -> Floats:
            """Return the values of a column of the file, [count]; name: of its metric, without @.

            A column that earlier versions did not write is NaN. Raises KeyError for another missing
            one.
            """
            if name in _LATER_COLUMNS and column not in stored:
                return np.full(count, np.nan)
            return stored[column].astype(float)

        with input_errors(path, expected, remedy, ValueError, KeyError):
            if len(stored["t_utc"]) != count:
                raise ValueError(f"{len(stored['t_utc'])} hours")
            metrics = (column.partition("@")[0] for column in stored if "@" in column)
            views = {
                name: np.stack([values_of(name, f"{name}@{a:g}") for a in azimuths_deg], axis=1)
                for name in dict.fromkeys([*VIEW_COLUMNS, *metrics])
            }
            hours = {name: values_of(name, name) for name in HOUR_COLUMNS}
        times = tuple(datetime.fromtimestamp(t, UTC) for t in stored["t_utc"])
        return cls(times, azimuths_deg, hours, views)

    def write(self, folder: Path, timezone: str) -> None:
        """Write hourly.csv and hourly.csv.sha256 into a folder; floats have five digits.

        timezone: IANA name of the zone of its local times. Columns of colour without any value are
        omitted.
        """
        zone = ZoneInfo(timezone)
        columns: dict[str, Any] = {
            "t_utc": [t.timestamp() for t in self.t_utc],
            "t_local": [f"{t.astimezone(zone):%Y-%m-%d %H:%M}" for t in self.t_utc],
        } | {name: self.hours[name] for name in HOUR_COLUMNS}
        for k, azimuth_deg in enumerate(self.azimuths_deg):
            for name, values in self.views.items():
                if name not in COLOUR_COLUMNS or np.isfinite(values).any():
                    columns[f"{name}@{azimuth_deg:g}"] = values[:, k]
        version = np.full(len(self.t_utc), FORMAT)
        write_columns(folder / NAME, {**columns, "format": version}, _DIGITS)
