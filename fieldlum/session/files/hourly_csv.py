"""annual/NAME/hourly.csv: light, trust and glare of each hour of a predicted year."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import input_errors
from fieldlum.core.records import parse_utc, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.codec import change_of, sealed
from fieldlum.session.writing import replacing

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
        table = read_table(path, NAME, "write the file with: fieldlum predict")
        expected, remedy = "what fieldlum predict wrote", "run fieldlum predict again"
        with input_errors(path, expected, remedy, ValueError, KeyError, IndexError):
            head, body = table.names, [cells for _, cells in table.rows]
            if len(body) != count:
                raise ValueError(f"{len(body)} hours, but {count} in predict.json")
            times = tuple(parse_utc(row[0]) for row in body)
            cells = [[float(cell) if cell else np.nan for cell in row[2:]] for row in body]
            column = dict(zip(head[2:], np.array(cells).T, strict=True))
            if column.get("format", np.ones(1)).max() > FORMAT:
                raise ValueError(f"a format over {FORMAT}: read the file with a newer fieldlum")
            blank = np.full(len(body), np.nan)
            for name in LATER_HOUR_COLUMNS:
                column.setdefault(name, blank)
            for name in LATER_COLUMNS:
                for a in azimuths_deg:
                    column.setdefault(_view_column(name, a), blank)
            views = {
                name: np.stack([column[_view_column(name, a)] for a in azimuths_deg], axis=1)
                for name in dict.fromkeys((*VIEW_COLUMNS, *_metrics_of(column)))
            }
            change_of(path)
            return cls(times, azimuths_deg, {name: column[name] for name in HOUR_COLUMNS}, views)

    def write(self, folder: Path, timezone: str) -> None:
        """Write hourly.csv; its column t_local is in `timezone`, the IANA zone of the site."""
        zone = ZoneInfo(timezone)
        columns = {
            name: VIEW_COLUMNS.get(name, _OTHER_DIGITS)
            for name in dict.fromkeys((*VIEW_COLUMNS, *self.views))
            if name not in COLOUR_COLUMNS or np.isfinite(self.views[name]).any()
        }
        names = [_view_column(name, a) for a in self.azimuths_deg for name in columns]
        digits = [figure for _ in self.azimuths_deg for figure in columns.values()]
        # One block for each direction: the columns of a view are next to each other.
        block = np.stack([self.views[name] for name in columns], axis=2)
        block = block.reshape(len(self.t_utc), -1)  # [n, d * metrics]
        path = folder / NAME
        with (
            sealed(path),
            replacing(path, "w", newline="", encoding="utf-8") as file,
        ):
            out = csv.writer(file)
            out.writerow(["t_utc", "t_local", *HOUR_COLUMNS, *names, "format"])
            for k, t in enumerate(self.t_utc):
                local = t.astimezone(zone).strftime("%Y-%m-%d %H:%M")
                light = [
                    _cell(self.hours[name][k], 6 if name == "expected_log10_mse" else 2)
                    for name in HOUR_COLUMNS
                ]
                views = [_cell(v, d) for v, d in zip(block[k].tolist(), digits, strict=True)]
                out.writerow([utc_text(t), local, *light, *views, FORMAT])


def _view_column(name: str, azimuth_deg: float) -> str:
    return f"{name}@{azimuth_deg:g}"


def _metrics_of(columns: Iterable[str]) -> list[str]:
    return [name.partition("@")[0] for name in columns if "@" in name]


def _cell(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
