"""Read and train a month of captures at ten-minute steps: time and memory by number of captures.

    python bench/month_of_captures.py render OUT [--height 58]
    python bench/month_of_captures.py measure OUT [COUNT ...]

`render` simulates a month of the shipped office. `measure` takes evenly spaced captures, and prints
a row for each count, each in a process of its own: CPU seconds of the first reading (of which the
search for a turned camera), of one fit of light transport and of `train`, with the largest memory.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.records import Slot
from fieldlum.learn import models, train
from fieldlum.learn.models import training_data
from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.site_toml import load_site
from fieldlum.sky import sun

COUNTS = (100, 400, 1300, 2200)
DAYS, STEP_MIN, YEAR = 31, 10, 2027


def render(out: Path, height: int) -> None:
    """Write the session OUT/session with all daylight hours of a month at ten-minute steps."""
    setup = load_site(shipped("capture_plans") / "seattle-office.toml")
    begin = sun.standard_midnight(date(YEAR, 5, 1), setup.site.timezone)
    steps = [begin + timedelta(minutes=m) for m in range(0, 1440 * DAYS, STEP_MIN)]
    at = sun.position(steps, setup.site)
    up = np.flatnonzero(at.altitude_deg > 0.5)
    slots = [Slot(steps[k], float(at.altitude_deg[k]), float(at.azimuth_deg[k]), ()) for k in up]
    session = simulate.make_session(out / "session", setup, slots, {"set": "month"})
    weather = simulate.weather_for(setup)
    simulate.run(session, weather, height=height, quality="draft")


def measure(out: Path, count: int) -> None:
    """Print one row of the table for evenly spaced captures."""
    table = PairsFile.read(out / "session" / "truth" / "pairs.csv")
    usable = table.usable
    rows = [usable[k] for k in np.linspace(0, len(usable) - 1, count).round().astype(int)]
    path = table.path.with_name(f"first-{count}.csv")
    PairsFile(path, tuple(rows)).write()
    path.with_suffix(".alignment.csv").unlink(missing_ok=True)
    spent: dict[str, float] = {}

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            begin = time.process_time()
            result = call(*args, **kwargs)
            spent[name] = time.process_time() - begin
            return result

        return run

    training_data.camera_turns = timed("turns", training_data.camera_turns)
    data = timed("read", training_data.load_pairs)(path)
    timed("fit", models.fit)("transport", data)
    wall = time.monotonic()
    timed("train", train.run)(data, "transport", budget_min=5.0, out=out / f"model-{count}")
    wall = time.monotonic() - wall
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"| {len(data)} | {spent['read']:.1f} | {spent['turns']:.1f} | {spent['fit']:.1f} | "
        f"{spent['train']:.0f} | {wall:.0f} | {memory:.1f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("step", choices=["render", "measure", "row"])
    parser.add_argument("out", type=Path)
    parser.add_argument("counts", nargs="*", type=int)
    parser.add_argument("--height", type=int, default=58)
    asked = parser.parse_args()
    if asked.step == "render":
        return render(asked.out, asked.height)
    if asked.step == "row":
        return measure(asked.out, asked.counts[0])
    print("| captures | read CPU s | of it turns | fit CPU s | train CPU s | by the clock s | GB |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for count in asked.counts or COUNTS:
        command = [sys.executable, __file__, "row", str(asked.out), str(count)]
        subprocess.run(command, check=True)
    return None


if __name__ == "__main__":
    main()
