"""Brackets and years on a real Dask cluster whose workers are killed, stopped, full or different.

    python bench/scheduler_faults.py FOLDER [--brackets 100] [--years 10] [--kill-every 5]

Compares every file with those of one process, byte for byte; then prints what a second worker
brings, and the overhead of a unit that only sleeps. Needs fieldlum[cluster]. A full disk needs
root on Linux (a small tmpfs in the worker's own mount namespace); without, that worker is left out.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from datetime import timedelta, timezone
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import psutil
import scheduler_units  # pyright: ignore[reportMissingImports]
from dask_cluster import SOURCE, Cluster, cluster  # pyright: ignore[reportMissingImports]
from test_merge_stage import START, profile, take  # pyright: ignore[reportMissingImports]

from fieldlum import merge
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot
from fieldlum.core.scheduler import (
    LOCAL,
    SHARED_VARIABLE,
    Scheduler,
    WorkUnit,
    parse_scheduler,
)
from fieldlum.learn import models
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.profiles import save_profile, shipped
from fieldlum.room import simulate
from fieldlum.session import Session, create_session
from fieldlum.session.site_toml import load_site
from fieldlum.weather import synthetic_weather
from fieldlum.year import predict

SEATTLE_STANDARD = timezone(timedelta(hours=-8))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--brackets", type=int, default=100)
    parser.add_argument("--years", type=int, default=10)
    parser.add_argument("--days", type=int, default=365, help="of each year")
    parser.add_argument("--kill-every", type=float, default=5.0, metavar="S")
    parser.add_argument("--sleepers", type=int, default=2000)
    parser.add_argument("--parts", default="brackets,years,scaling,sleepers")
    parser.add_argument("--session", type=Path, help="captured session for the scaling; copied")
    asked = parser.parse_args()
    shared = asked.folder.resolve() / "shared"
    shared.mkdir(parents=True, exist_ok=True)
    os.environ[SHARED_VARIABLE] = str(shared)
    parts = asked.parts.split(",")
    if "brackets" in parts:
        session = brackets(shared, asked.brackets)
        faults(
            f"{asked.brackets} brackets",
            asked,
            lambda how: merged(session, how),
            [session.panoramas],
            session.panoramas,
        )
    if "years" in parts:
        model, weathers = years(shared, asked.years, asked.days)
        outs = [shared / f"year-{k}" for k in range(asked.years)]
        faults(
            f"{asked.years} years of {asked.days} days",
            asked,
            lambda how: [
                predict.run(model, weather, out=out, maps=True, scheduler=how, force=True)
                for weather, out in zip(weathers, outs, strict=True)
            ],
            outs,
        )
    if "scaling" in parts:
        if asked.session is not None and not (shared / "captured").is_dir():
            shutil.copytree(asked.session, shared / "captured")
        known = None if asked.session is None else Session(shared / "captured")
        scaling(asked, known or brackets(shared, asked.brackets))
    if "sleepers" in parts:
        overhead(asked)


def brackets(shared: Path, count: int) -> Session:
    """Return a session of `count` small raw brackets."""
    root = shared / "room"
    if not root.is_dir():
        save_profile(shared / "small.toml", profile())
        camera = CameraSetup(str(shared / "small.toml"), 180.0)
        slots = [Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))]
        session = create_session(root, SiteFile(Site("here", 51.5, 0.0), camera), slots, {})
        for number in range(count):
            take(session, number)
    return Session(root)


def merged(session: Session, how: Scheduler, height: int = 32) -> None:
    states = {
        v.state
        for v in merge.run(session, merge.MergeOptions(height=height), force=True, scheduler=how)
    }
    assert states == {"merged"}, states


def years(shared: Path, count: int, days: int) -> tuple[Path, list[Path]]:
    """Return a model of the shipped office and `count` weather files."""
    root = shared / "office"
    if not (shared / "model").is_dir():
        setup = load_site(shipped("capture_plans") / "seattle-office.toml")
        weather = simulate.weather_for(setup)
        slots = simulate.sample_slots(setup, weather, 24, 1)
        session = create_session(root, setup, slots, {"set": "faults"})
        simulate.run(session, weather, height=12, quality="draft")
        data = load_pairs(session)
        models.save(shared / "model", models.fit("transport", data, patch="none"), data)
    paths = [shared / f"weather-{k}.csv" for k in range(count)]
    site = load_site(shipped("capture_plans") / "seattle-office.toml").site
    for k, path in enumerate(paths):
        year = synthetic_weather(site, seed=k + 1)
        lines = ["month,day,hour,dni_wm2,dhi_wm2"]
        hours = list(zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True))
        for t, dni, dhi in hours[: 24 * days]:
            local = t.astimezone(SEATTLE_STANDARD)
            hour = local.hour + local.minute / 60
            lines.append(f"{local.month},{local.day},{hour},{dni:.0f},{dhi:.0f}")
        path.write_text("\n".join(lines) + "\n")
    return shared / "model", paths


def contents(folders: list[Path]) -> dict[str, bytes]:
    """Return every file but the shutter survey's pictures of the contact sheet."""
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    return {str(path): path.read_bytes() for path in paths}


# ----------------------------------------------------------------------------------------------
# faults


def faults(
    title: str,
    asked: argparse.Namespace,
    work: Callable[[Scheduler], object],
    folders: list[Path],
    full: Path | None = None,
) -> None:
    """Run `work` in this process and on a cluster with every fault; compare all files."""
    work(LOCAL)
    expected = contents(folders)
    for folder in folders:
        shutil.rmtree(folder)
    place = asked.folder.resolve() / f"cluster-{title.split()[1]}"
    shutil.rmtree(place, ignore_errors=True)
    other = other_version(place)
    with cluster(place, asked.folder.resolve() / "shared", "w0", "w1") as made:
        made.worker("other", source=other)
        if full is not None:
            full_disk(made, full)
        how = parse_scheduler(str(made.file))
        stop = threading.Event()
        killer = threading.Thread(target=kill_some, args=(made, asked.kill_every, stop))
        killer.start()
        start_s = time.monotonic()
        try:
            with warnings.catch_warnings(record=True) as notes:
                warnings.simplefilter("always")
                work(how)
        finally:
            stop.set()
            killer.join()
        took_s = time.monotonic() - start_s
        killed = sum(name.startswith("killed") for name in made.processes)
    found = contents(folders)
    wrong = [name for name in expected if found.get(name) != expected[name]]
    extra = found.keys() - expected.keys()
    print(f"{title}: {took_s:.0f} s, {killed} workers killed, one stopped; {len(expected)} files")
    print(f"  different or missing: {len(wrong)}, not in the run of one process: {len(extra)}")
    for text in [
        *wrong[:3],
        *sorted(extra)[:3],
        *dict.fromkeys(str(note.message) for note in notes),
    ]:
        print(f"  {text}")
    sys.stdout.flush()


def other_version(place: Path) -> Path:
    """Return a copy of the source that differs in one line."""
    other = place / "other-version"
    shutil.copytree(SOURCE / "fieldlum", other / "fieldlum")
    with (other / "fieldlum" / "version.py").open("a") as file:
        file.write("# another\n")
    return other


def full_disk(made: Cluster, folder: Path) -> None:
    """Start a worker that sees a full disk at `folder`, where this computer allows it."""
    folder.mkdir(parents=True, exist_ok=True)
    if not shutil.which("unshare") or os.geteuid() != 0:
        print("  no worker with a full disk: that needs root on Linux")
        return
    mount = f"mount -t tmpfs -o size=4k tmpfs '{folder}' && dd if=/dev/zero of='{folder}/.fill'"
    made.worker("full", prefix=("unshare", "-m", "sh", "-c", f'{mount}; exec "$@"', "sh"))


def kill_some(made: Cluster, every_s: float, stop: threading.Event) -> None:
    """Stop one worker for good, then kill one of two every few seconds and start another."""
    rng, count = random.Random(0), 2
    alive = ["w0", "w1"]
    frozen = False
    while not stop.wait(every_s):
        name = alive.pop(rng.randrange(len(alive)))
        if frozen:
            made.signal(name)
            made.processes[name].wait()
            made.processes[f"killed-{name}"] = made.processes.pop(name)
        else:
            made.signal(name, signal.SIGSTOP)
            frozen = True
        alive.append(f"w{count}")
        made.worker(alive[-1])
        count += 1


# ----------------------------------------------------------------------------------------------
# speed


def scaling(asked: argparse.Namespace, session: Session) -> None:
    """Print what a second worker brings: the same brackets with one and with two, in turns."""
    shared = asked.folder.resolve() / "shared"
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(3):
        for count in (1, 2):
            place = asked.folder.resolve() / f"scaling-{turn}-{count}"
            with cluster(place, shared, *(f"w{k}" for k in range(count))) as made:
                how = parse_scheduler(str(made.file))
                wait_for(how, count)
                start_s = time.monotonic()
                merged(session, how, 32 if asked.session is None else 115)
                seconds[count].append(time.monotonic() - start_s)
    one, two = (float(np.median(seconds[count])) for count in (1, 2))
    brackets = len(session.captured_folders())
    print(f"{brackets} brackets: one worker {one:.1f} s, two {two:.1f} s, x {one / two:.2f}")
    sys.stdout.flush()


def wait_for(how: Scheduler, count: int) -> None:
    """Run units until `count` workers have imported what merging needs."""
    folder = Path(os.environ[SHARED_VARIABLE])
    pids: set[int] = set()
    while len(pids) < count:
        units = [WorkUnit(f"s{k}", scheduler_units.asleep, folder, 0.3) for k in range(2 * count)]
        pids |= {outcome.result() for outcome in scheduler_units.outcomes_of(units, how)}


def overhead(asked: argparse.Namespace) -> None:
    """Print the wall and CPU time that a unit costs beyond its sleep."""
    folder = asked.folder.resolve()
    with cluster(folder / "sleepers", folder / "shared", "w0", "w1") as made:
        how = parse_scheduler(str(made.file))
        wait_for(how, 2)
        others = [psutil.Process(p.pid) for p in made.processes.values()]
        before_s = cpu_s(others)
        start_s = time.monotonic()
        sleep_s = 0.02
        units = [
            WorkUnit(f"u{k}", scheduler_units.asleep, folder / "shared", sleep_s)
            for k in range(asked.sleepers)
        ]
        outcomes = scheduler_units.outcomes_of(units, how)
        wall_s = time.monotonic() - start_s
        assert len({o.unit.name for o in outcomes}) == asked.sleepers
        used_s = cpu_s(others) - before_s
    n = asked.sleepers
    print(
        f"{n} units of {sleep_s} s on two workers: {wall_s:.1f} s; beyond the sleep "
        f"{1e3 * (wall_s - n * sleep_s / 2) / n:.1f} ms a unit, "
        f"CPU of client, scheduler and workers {1e3 * used_s / n:.1f} ms a unit"
    )


def cpu_s(others: list[psutil.Process]) -> float:
    mine = time.process_time()
    return mine + sum(sum(p.cpu_times()[:2]) for p in others)


if __name__ == "__main__":
    main()
