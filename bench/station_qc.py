"""Quality control of irradiance on a real station: marks per month, DIRINT's error.

    python bench/station_qc.py FOLDER [--latitude 55.79 --longitude 12.52 --altitude 50]

FOLDER holds months of minutes as *.csv or *.csv.gz with the columns Time(utc), GHI, DNI, DHI in
W/m2, as github.com/AssessingSolar/dtu_solar_station has them (Lyngby, Denmark: the default place).
A sunny minute has DNI over 120 W/m2 (WMO's sunshine) and the sun above the horizon.
"""

from __future__ import annotations

import argparse
import csv
import gzip
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site
from fieldlum.pair.irradiance import Mark, Series, check, sky_geometry, suspicions, with_dirint
from fieldlum.sky import sun

SUNNY_WM2 = 120.0
COMPARED = (
    Mark.IMPOSSIBLE,
    Mark.EXTREME,
    Mark.CLOSURE,
    Mark.DIFFUSE,
    Mark.STUCK,
    Mark.SPIKE,
    Mark.K_INDEX,
    Mark.HORIZON,
)


def read_month(path: Path) -> Series:
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    t = [datetime.fromisoformat(row["Time(utc)"]).replace(tzinfo=UTC).timestamp() for row in rows]
    ghi, dhi, dni = (
        np.array([float(row[name] or "nan") for row in rows]) for name in ("GHI", "DHI", "DNI")
    )
    return Series(np.array(t), ghi, dhi, dni, np.zeros(len(t), np.int64))


def flags_row(name: str, raw: Series, site: Site) -> str:
    altitude, top = sky_geometry(raw.t_unix_s, site)
    checked = check(raw, altitude, top)
    marks = checked.marks | suspicions(checked, altitude, top, site)
    sunny = (raw.dni_wm2 > SUNNY_WM2) & (altitude > 0)
    counts = [int(((marks & mark) != 0)[sunny].sum()) for mark in COMPARED]
    every = 0
    for mark in COMPARED:
        every |= int(mark)
    share = 100.0 * float(((marks & every) != 0)[sunny].mean())
    return f"| {name} | {int(sunny.sum())} | {' | '.join(map(str, counts))} | {share:.2f} |"


def episodes(name: str, raw: Series, site: Site) -> list[str]:
    """Days with closure marks in sunny minutes: how many, where the sun was, and the ratio."""
    altitude, top = sky_geometry(raw.t_unix_s, site)
    marked = (check(raw, altitude, top).marks & Mark.CLOSURE) != 0
    marked &= (raw.dni_wm2 > SUNNY_WM2) & (altitude > 0)
    ratio = sun.closure_ratio(raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
    shaded = np.abs(raw.ghi_wm2 - raw.dhi_wm2) < 5.0
    out: list[str] = []
    day = np.floor(raw.t_unix_s / 86400.0)
    for each in np.unique(day[marked]):
        rows = marked & (day == each)
        text = f"{datetime.fromtimestamp(raw.t_unix_s[rows][0], UTC):%Y-%m-%d %H:%M}"
        out.append(
            f"| {text} | {int(rows.sum())} | {altitude[rows].min():.0f} to "
            f"{altitude[rows].max():.0f} | {np.median(ratio[rows]):.2f} | "
            f"{100 * float(shaded[rows].mean()):.0f} |"
        )
    return out


def hourly(t_unix_s: Floats, value: Floats) -> Floats:
    """Means of the hours that have at least 50 minutes, [hours]."""
    hour = np.floor(t_unix_s / 3600.0).astype(np.int64)
    hour -= hour.min()
    good = np.isfinite(value)
    count = np.bincount(hour[good], minlength=hour.max() + 1)
    total = np.bincount(hour[good], weights=value[good], minlength=hour.max() + 1)
    return np.where(count >= 50, total / np.maximum(count, 1), np.nan)


def dirint_row(name: str, raw: Series, site: Site) -> str:
    """DNI from global alone against the pyrheliometer, sun over 5 degrees."""
    altitude, top = sky_geometry(raw.t_unix_s, site)
    nothing = np.full(len(raw), np.nan)
    alone = Series(raw.t_unix_s, raw.ghi_wm2, nothing, nothing, np.zeros(len(raw), np.int64))
    model = with_dirint(check(alone, altitude, top), altitude, site).dni_wm2
    usable = (altitude > 5.0) & np.isfinite(model + raw.dni_wm2)
    model, truth = np.where(usable, model, np.nan), np.where(usable, raw.dni_wm2, np.nan)
    cells: list[str] = []
    for a, b in ((model, truth), (hourly(raw.t_unix_s, model), hourly(raw.t_unix_s, truth))):
        cells.append(_error_text(a, b))
    return f"| {name} | {int(usable.sum())} | {' | '.join(cells)} |"


def _error_text(model: Floats, truth: Floats) -> str:
    good = np.isfinite(model + truth)
    error, mean = (model - truth)[good], float(truth[good].mean())
    rmse, bias = float(np.sqrt(np.mean(error**2))), float(error.mean())
    return f"{rmse:.0f} ({100 * rmse / mean:.0f} %) | {bias:+.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--latitude", type=float, default=55.79)
    parser.add_argument("--longitude", type=float, default=12.52)
    parser.add_argument("--altitude", type=float, default=50.0)
    options = parser.parse_args()
    site = Site("station", options.latitude, options.longitude, "UTC", options.altitude)
    months = {p.name.split(".")[0]: read_month(p) for p in sorted(options.folder.glob("*.csv*"))}
    names = " | ".join((mark.name or "").lower().replace("_", "-") for mark in COMPARED)
    print(f"| month | sunny minutes | {names} | any, % |\n|{'---|' * (3 + len(COMPARED))}")
    for name, raw in months.items():
        print(flags_row(name, raw, site))
    print("\n| from (UTC) | minutes | sun, degrees | closure ratio | global = diffuse, % |")
    print("|---|---|---|---|---|")
    for name, raw in months.items():
        print(*episodes(name, raw, site), sep="\n")

    print("\n| month | minutes | RMSE by minute | bias | RMSE by hour | bias |")
    print("|---|---|---|---|---|---|")
    for name, raw in months.items():
        print(dirint_row(name, raw, site))


if __name__ == "__main__":
    main()
