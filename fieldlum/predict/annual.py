"""What a predicted year leaves on disk, and reading it again.

annual/<name>/hourly.csv      one row an hour: t_utc, t_local, light, trust, and `metric@azimuth`
for each direction
             predict.json     settings, versions, repairs, and the glare protection of each
             direction
             pictures.npz     the maps of some telling hours
             maps.zarr        all maps, where asked for (Zarr v3; dims time, y, x)
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.records import parse_utc, utc_text
from fieldlum.session import replacing

HOUR_COLUMNS = (
    "dni_wm2",
    "dhi_wm2",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "disc_lx",
    "occupied",
    "trusted",
    "expected_log10_mse",
)
VIEW_COLUMNS = {  # name: digits written
    "dgp": 4,
    "u_dgp": 4,
    "dgp_low": 4,
    "dgp_high": 4,
    "dgps": 4,
    "ev_lx": 1,
    "melanopic_edi_lx_estimate": 1,
    "ugr": 2,
    "dgi": 2,
    "task_cdm2": 1,
    "window_to_task": 2,
    "uniformity": 3,
}
# Years predicted by 0.1.0 lack these columns; they are NaN there.
LATER_COLUMNS = ("dgp_low", "dgp_high")


@dataclass(frozen=True, slots=True)
class Annual:
    """A predicted year. hours: `HOUR_COLUMNS`, [n] each; views: `VIEW_COLUMNS`, [n, d] each;
    about: predict.json.
    """

    folder: Path
    about: dict[str, Any]
    t_utc: tuple[datetime, ...]
    azimuths_deg: NDArray[np.float64]
    hours: dict[str, NDArray[np.float64]]
    views: dict[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.t_utc)

    @property
    def occupied(self) -> NDArray[np.bool_]:
        return self.hours["occupied"] > 0

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Directions that have figures: not those that no lens saw, [d]."""
        return np.asarray(np.isfinite(self.views["dgp"]).any(axis=0))


@dataclass(frozen=True, slots=True)
class Pictures:
    """Maps of telling hours without the disc [k, H, W]; rows [k] into the year; kinds [k] say
    why.
    """

    kinds: tuple[str, ...]
    rows: NDArray[np.int64]
    luminance_cdm2: NDArray[np.float32]
    disc_lx: NDArray[np.float64]
    heading_deg: float


def azimuth_text(azimuth_deg: float) -> str:
    return f"{azimuth_deg:g}"


def write_hourly(path: Path, annual: Annual, timezone: str) -> None:
    """The year as csv; empty cells are undefined values (no source, no uncertainty)."""
    zone = ZoneInfo(timezone)
    names = [f"{name}@{azimuth_text(a)}" for a in annual.azimuths_deg for name in VIEW_COLUMNS]
    digits = [figure for _ in annual.azimuths_deg for figure in VIEW_COLUMNS.values()]
    # One block a direction: everything of one view stands together.
    block = np.stack([annual.views[name] for name in VIEW_COLUMNS], axis=2).reshape(len(annual), -1)
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["t_utc", "t_local", *HOUR_COLUMNS, *names])
        for k, t in enumerate(annual.t_utc):
            local = t.astimezone(zone).strftime("%Y-%m-%d %H:%M")
            light = [
                _cell(annual.hours[name][k], 6 if name == "expected_log10_mse" else 2)
                for name in HOUR_COLUMNS
            ]
            views = [_cell(value, d) for value, d in zip(block[k].tolist(), digits, strict=True)]
            out.writerow([utc_text(t), local, *light, *views])


def _cell(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def write_about(path: Path, about: dict[str, Any]) -> None:
    with replacing(path, "w", encoding="utf-8") as file:
        json.dump(about, file, indent=1, ensure_ascii=False, default=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def write_pictures(path: Path, pictures: Pictures) -> None:
    with replacing(path) as file:
        np.savez_compressed(
            file,
            kinds=np.array(pictures.kinds),
            rows=pictures.rows,
            luminance_cdm2=rounded(pictures.luminance_cdm2),
            disc_lx=pictures.disc_lx,
            heading_deg=pictures.heading_deg,
        )


def rounded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Float32 with 12 bits of mantissa left (0.01 %): what is cut could not be known, and
    compresses badly.
    """
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 10)) & np.uint32(0xFFFFF800)).view(np.float32)


# ----------------------------------------------------------------------------------------------
# reading


def read_annual(folder: Path) -> Annual:
    """Raises InputError when `folder` holds no predicted year."""
    about, path = _read_about(folder), folder / "hourly.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise InputError(
            path, error.strerror or str(error), "hourly.csv", "make it with: fieldlum predict"
        ) from None
    try:
        head, body = rows[0], rows[1:]
        azimuths = np.array(about["azimuths_deg"], float)
        if len(body) != about["hours"]:
            raise ValueError(f"{len(body)} hours, {about['hours']} in predict.json")
        times = tuple(parse_utc(row[0]) for row in body)
        values = np.array([[float(cell) if cell else np.nan for cell in row[2:]] for row in body])
        column = {name: values[:, k] for k, name in enumerate(head[2:])}
        hours = {name: column[name] for name in HOUR_COLUMNS}
        blank = np.full(len(body), np.nan)
        for name in LATER_COLUMNS:
            for a in azimuths:
                column.setdefault(f"{name}@{azimuth_text(a)}", blank)
        views = {
            name: np.stack([column[f"{name}@{azimuth_text(a)}"] for a in azimuths], axis=1)
            for name in VIEW_COLUMNS
        }
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(path, str(error), "what fieldlum predict wrote", "predict again") from None
    return Annual(folder, about, times, azimuths, hours, views)


def _read_about(folder: Path) -> dict[str, Any]:
    path = folder / "predict.json"
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        about["azimuths_deg"]
    except OSError:
        raise InputError(
            folder, "no predict.json in it", "a predicted year", "make one: fieldlum predict"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, str(error), "what fieldlum predict wrote", "predict again") from None
    return about


def read_pictures(folder: Path) -> Pictures:
    """Raises InputError when there are none."""
    path = folder / "pictures.npz"
    try:
        with np.load(path, allow_pickle=False) as found:
            return Pictures(
                tuple(str(kind) for kind in found["kinds"]),
                found["rows"],
                found["luminance_cdm2"],
                found["disc_lx"],
                float(found["heading_deg"]),
            )
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            path, str(error), "pictures of a predicted year", "predict again"
        ) from None
