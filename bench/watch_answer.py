"""The answer so far of `fieldlum watch`, from raw frames on: each step with its CPU time.

    python bench/watch_answer.py FOLDER [--captures 12] [--height 15] [--days 2]

A simulated office is photographed at random hours of a year. Then what `watch` runs between slots
is run as it is: the real commands in processes of their own. `--days` repeats it with more captures
each time, so that the page shows how the answer moved.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

from fieldlum import demo, merge
from fieldlum.optics.profiles import bracket_exposures, load_camera_profile, shipped
from fieldlum.room import simulate
from fieldlum.session import create_session, open_session, write_plan
from fieldlum.session.site_toml import load_site
from fieldlum.web import prediction_so_far
from fieldlum.web.snapshot import Snapshots


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--captures", type=int, default=12, help="of each round")
    parser.add_argument("--height", type=int, default=15)
    parser.add_argument("--days", type=int, default=2, help="rounds")
    asked = parser.parse_args()
    setup = load_site(shipped("capture_plans") / "seattle-office.toml")
    weather = simulate.weather_for(setup)
    ladder = tuple(bracket_exposures(load_camera_profile(setup.camera.profile).bracket))
    hours = simulate.sample_slots(setup, weather, asked.captures * asked.days, 3)
    slots = [replace(hour, exposures=ladder) for hour in hours]
    prediction_so_far.ANSWER_EVERY = (
        prediction_so_far.ANSWER_EVERY * 0
    )  # the rounds of this script follow at once
    for day in range(1, asked.days + 1):
        now = slots[: day * asked.captures]
        if day == 1:
            session = create_session(asked.folder, setup, now, {"set": "year-sample"})
        else:
            session = open_session(asked.folder)
            write_plan(session.plan, now, setup.site.timezone)
        simulate.run(session, weather, height=asked.height, quality="draft", workers=1)
        demo.capture(session, 1)
        if day == 1:
            merge.run(session, merge.MergeOptions(asked.height))
        worker = prediction_so_far.Worker(session, Snapshots(session).moment)
        started, cpu = time.monotonic(), sum(os.times()[2:4])
        worker.work()
        cost = f"{sum(os.times()[2:4]) - cpu:.0f} CPU s, {time.monotonic() - started:.0f} s"
        print(f"\n{len(now)} captures: {cost} {worker.problem}")
        last = prediction_so_far.answer_table(session, worker)["last"]
        for row in last["protection"]:
            sure = "" if row["certain"] else " (cannot tell yet)"
            print(
                f"  {row['azimuth_deg']:5.0f} deg  {row['class']:8s} {row['dgp_exceeded']:.3f}"
                f" ({row['low']:.3f} to {row['high']:.3f}){sure}"
            )


if __name__ == "__main__":
    main()
