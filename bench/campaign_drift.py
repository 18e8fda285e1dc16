"""How often `fieldlum campaign` sees a drift of k: in steady cameras, and in drifting ones.

    python bench/campaign_drift.py FOLDER [--rooms 8] [--captures 400]

Each room is photographed at random hours of a month, under skies that are not Perez's, with the
pyranometer 200 m away, a shaded horizon, a clock that drifts and an exposure that varies by 3 %.
A drift of k multiplies the ratios of measured to expected sky, so that one simulation gives both
answers. Three months with other seeds are made of each room.
"""

from __future__ import annotations

import argparse
from datetime import timedelta
from pathlib import Path

import numpy as np
from campaign_rooms import site_of

from fieldlum import simulate
from fieldlum.campaign.drift import LIMITS, series, sky_ratios
from fieldlum.records import parse_utc
from fieldlum.session import Session, create_session, open_session
from fieldlum.simulate.troubles import Trouble, Troubles

MONTHS = ("2027-03-06T00:00:00Z", "2027-06-06T00:00:00Z", "2027-12-06T00:00:00Z")
DAYS = 31
DRIFTS_PERCENT_A_DAY = (0.0, 0.1, 0.2, 0.5, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=8)
    parser.add_argument("--captures", type=int, default=400, help="at most, of a month")
    asked = parser.parse_args()
    ratios = []
    for room in range(1, asked.rooms + 1):
        for month in range(len(MONTHS)):
            session = simulated(asked.folder, room, month, asked.captures)
            values = sky_ratios(session)
            ratios.append(values)
            print(f"room {room}, month {month}: {series('k', *columns(values)).text}", flush=True)
    report(ratios)


def columns(rows: list[tuple]) -> tuple[list, list[float]]:
    return [t for t, _ in rows], [value for _, value in rows]


def report(ratios: list[list[tuple]]) -> None:
    """Print, for each drift, the share of rooms in which it is reported and its size."""
    print(f"\n{len(ratios)} room months; limit {LIMITS['k']:g} %")
    print("drift a day  reported  median change  95 % of the changes")
    for drift in DRIFTS_PERCENT_A_DAY:
        found = []
        for rows in ratios:
            times, values = columns(rows)
            days = np.array([(t - times[0]).total_seconds() / 86400 for t in times])
            fading = (100.0 + np.array(values)) * (1.0 - drift / 100.0) ** days - 100.0
            found.append(series("k", times, list(fading)))
        changes = np.array([one.change for one in found])
        share = np.mean([one.drifts for one in found])
        low, high = np.nanpercentile(changes, [2.5, 97.5])
        print(
            f"{drift:9.1f} %  {100 * share:6.0f} %  {np.nanmedian(changes):+9.1f} %"
            f"      {low:+.1f} to {high:+.1f} %"
        )


def simulated(folder: Path, room: int, month: int, captures: int) -> Session:
    """Return a month of truth of one room, rendered once."""
    root = folder / f"room-{room:02d}-{month}"
    if (root / "pairs.csv").is_file():
        return open_session(root)
    setup = site_of(room)
    weather = simulate.weather_for(setup)
    seed = 100 * room + month
    first = parse_utc(MONTHS[month])
    year = weather.daylight().t_utc
    outside = [t for t in year if not first <= t < first + timedelta(days=DAYS)]
    count = min(captures, len(year) - len(outside))
    slots = simulate.sample_slots(setup, weather, count, seed, outside)
    session = create_session(root, setup, slots, {"set": "month-sample", "count": len(slots)})
    wrong = Troubles(
        clouds=Trouble(0.2, seed),
        distant_instrument=Trouble(200.0, seed),
        horizon=Trouble(3.0, seed),
        clock_drift=Trouble(2.0, seed),
        exposures=Trouble(0.03, seed),
    )
    cache = folder / f"coefficients-{room:02d}"
    simulate.run(
        session, weather, height=12, quality="draft", troubles=wrong, cache=cache, workers=1
    )
    return session


if __name__ == "__main__":
    main()
