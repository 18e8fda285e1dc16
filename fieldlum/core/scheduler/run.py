"""Run units to their end, with retries, time limits and progress."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from fieldlum.core.records import Progress, quiet
from fieldlum.core.scheduler.address import Scheduler
from fieldlum.core.scheduler.units import UnitOutcome, WorkUnit
from fieldlum.core.scheduler.workers import POLL_S, Cluster, Here, Processes

# A unit counts as hanging after this many times the median time of completed units, but never
# before MIN_LIMIT_S. Until FEW units have ended, FIRST_LIMIT_S applies.
LIMIT_TIMES_MEDIAN = 20.0  # not measured
MIN_LIMIT_S = 300.0  # seconds; not measured
FIRST_LIMIT_S = 3600.0  # seconds; not measured
FEW = 5  # number of units; not measured


@dataclass
class _Attempt:
    unit: WorkUnit
    tries: int = 0
    started_s: float = 0.0


def _limit_s(scheduler: Scheduler, took_s: Sequence[float]) -> float:
    """Return the time after which a unit counts as hanging [s].

    It is the scheduler's, or a multiple of the median of took_s: the times of completed units.
    """
    if scheduler.unit_limit_s is not None:
        return scheduler.unit_limit_s
    if len(took_s) < FEW:
        return FIRST_LIMIT_S
    return max(MIN_LIMIT_S, LIMIT_TIMES_MEDIAN * statistics.median(took_s))


def run_units(
    units: Iterable[WorkUnit], scheduler: Scheduler, *, progress: Progress = quiet
) -> Generator[UnitOutcome, None, None]:
    """Run every unit and yield its outcome, in the order in which units end.

    With other processes, a unit whose worker is killed, hangs, has a full disk or an outdated file
    system is tried again, at most `scheduler.retries` times; then its outcome names the trouble,
    and other units continue. Raises InputError if no scheduler answers or no worker with this
    software is left, NotEnoughDataError if there is no worker for ten minutes.
    """
    waiting = deque(_Attempt(unit) for unit in units)
    total = len(waiting)
    if not total:
        return
    running: dict[Future[Any], _Attempt] = {}
    took_s: list[float] = []
    with _workers(scheduler, total) as workers:
        while waiting or running:
            for _ in range(min(workers.free(len(running)), len(waiting))):
                attempt = waiting.popleft()
                future = workers.submit(attempt.unit)
                attempt.started_s = time.monotonic()
                running[future] = attempt
            for future, ended in _ended(workers, running, _limit_s(scheduler, took_s)):
                attempt = running.pop(future)
                if isinstance(ended, str):
                    attempt.tries += 1
                    if attempt.tries <= scheduler.retries:
                        waiting.appendleft(attempt)
                        continue
                    trouble = f"given up after {attempt.tries} tries, the last: {ended}"
                    ended = UnitOutcome(attempt.unit, trouble=trouble)
                took_s.append(time.monotonic() - attempt.started_s)
                progress(len(took_s), total, workers.status() or attempt.unit.name)
                yield ended


def _ended(
    workers: Here, running: dict[Future[Any], _Attempt], limit_s: float
) -> Iterator[tuple[Future[Any], UnitOutcome | str]]:
    """Wait up to 0.5 s; yield futures that ended, were lost or hang, with outcome or trouble."""
    done = wait(running, timeout=POLL_S, return_when=FIRST_COMPLETED).done
    if not running:
        time.sleep(POLL_S)  # no worker is free yet
    for future in done:
        yield future, workers.settle(running[future].unit, future)
    oldest_s = time.monotonic() - limit_s
    for future in [f for f in workers.lost() if f in running]:
        yield future, workers.give_up(future)
    for future in [f for f, attempt in running.items() if attempt.started_s < oldest_s]:
        yield future, f"not complete after {limit_s:.0f} s: {workers.give_up(future)}"


def _workers(scheduler: Scheduler, total: int) -> Here:
    if scheduler.kind == "cluster":
        return Cluster(scheduler)
    count = min(scheduler.processes, total)
    return Processes(count) if scheduler.kind == "processes" and count > 1 else Here()


def run_each(
    units: Iterable[WorkUnit],
    scheduler: Scheduler,
    take: Callable[[UnitOutcome], object],
    progress: Progress = quiet,
) -> None:
    """Run every unit and pass each outcome to `take`; an error in `take` stops all units.

    Raises what `run_units` and `take` raise.
    """
    with closing(run_units(units, scheduler, progress=progress)) as outcomes:
        for outcome in outcomes:
            take(outcome)
