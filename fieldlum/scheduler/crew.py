"""Run units: in this process, or each in its own process, which can be killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from threadpoolctl import threadpool_limits

from fieldlum.scheduler.units import (
    WorkUnit,
    is_worker_trouble,
    trouble_text,
    use_one_thread,
)

POLL_S = 0.5  # seconds between two checks of time limits and new workers; chosen


@dataclass(frozen=True, slots=True)
class Ended:
    """How a unit of work ended; key: that of `submit`.

    kind: "value", what the call returned; "error" raised by the call; "lost" if its worker is gone;
    "worker" for a fault of the worker's computer; "changed" if the unit must be tried again as
    `value`, a unit with other recorded inputs. text: what to report, with the worker's name.
    """

    key: int
    kind: Literal["value", "error", "lost", "worker", "changed"]
    value: Any = None
    error: BaseException | None = None
    text: str = ""


class Crew(Protocol):
    """A set of workers that `run_units` uses; each submitted unit has its own key."""

    def __enter__(self) -> Crew: ...

    def __exit__(self, *error: object) -> None: ...

    def free(self) -> int:
        """Return how many more units may be submitted now."""
        ...

    def submit(self, key: int, unit: WorkUnit) -> None:
        """Start a unit, or queue it where it will start soon."""
        ...

    def ended(self) -> list[Ended]:
        """Return how units ended; if none did, wait for about `POLL_S` (0.5 s)."""
        ...

    def status(self) -> str:
        """Return a line about the workers, for the status view."""
        ...


@runtime_checkable
class RemoteCrew(Crew, Protocol):
    """A crew of other processes, whose units can be abandoned."""

    def give_up(self, key: int) -> str:
        """Stop waiting for a unit that takes too long; return what was done with its worker."""
        ...


class LocalCrew:
    """A crew that runs units in the current process, one at a time."""

    def __init__(self) -> None:
        self._next: tuple[int, WorkUnit] | None = None

    def __enter__(self) -> LocalCrew:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def free(self) -> int:
        """Return 1 if no unit is waiting, else 0."""
        return 0 if self._next else 1

    def submit(self, key: int, unit: WorkUnit) -> None:
        """Store the unit for the next `ended`."""
        self._next = (key, unit)

    def ended(self) -> list[Ended]:
        """Run the stored unit and return how it ended, as a list of one."""
        assert self._next is not None
        (key, unit), self._next = self._next, None
        try:
            with threadpool_limits(1, user_api="blas"):  # as in a worker, for equal rounding
                return [Ended(key, "value", unit.call(unit.folder, unit.argument))]
        except Exception as error:
            return [Ended(key, "error", error=error)]

    def status(self) -> str:
        """Return an empty text: there is no worker to name."""
        return ""


def _start_worker() -> None:
    """Limit a worker to one thread, and end it with its parent."""
    use_one_thread()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


class ProcessCrew:
    """A crew of processes on this computer, used in a `with` block.

    Each process has its own pool, so that a killed process is matched to its unit and affects no
    other.
    """

    def __init__(self, count: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._idle: list[ProcessPoolExecutor] = []
        self._count = count
        self._running: dict[Future[Any], tuple[int, ProcessPoolExecutor]] = {}
        self._pids: dict[ProcessPoolExecutor, Future[int]] = {}

    def __enter__(self) -> ProcessCrew:
        self._idle = [self._pool() for _ in range(self._count)]
        return self

    def _pool(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_start_worker)
        self._pids[pool] = pool.submit(os.getpid)
        return pool

    def __exit__(self, *error: object) -> None:
        for _, pool in self._running.values():
            self._kill(pool)
        for pool in self._pids:
            pool.shutdown(cancel_futures=True)

    def free(self) -> int:
        """Return the number of processes that have started and have no unit.

        Starting a process does not count as time of a unit.
        """
        self._idle.sort(key=lambda pool: self._pids[pool].done())
        return sum(self._pids[pool].done() for pool in self._idle)

    def submit(self, key: int, unit: WorkUnit) -> None:
        """Start a unit in a free process."""
        pool = self._idle.pop()
        try:
            future = pool.submit(unit.call, unit.folder, unit.argument)
        except BrokenProcessPool:  # the process was killed between two units
            pool = self._replaced(pool)
            future = pool.submit(unit.call, unit.folder, unit.argument)
        self._running[future] = (key, pool)

    def _replaced(self, pool: ProcessPoolExecutor) -> ProcessPoolExecutor:
        self._pids.pop(pool)
        pool.shutdown(wait=False)
        return self._pool()

    def ended(self) -> list[Ended]:
        """Return how units ended; empty if none did within 0.5 s."""
        if not self._running:  # every process is still starting
            starting = [self._pids[pool] for pool in self._idle]
            wait(starting, timeout=POLL_S, return_when=FIRST_COMPLETED)
            return []
        finished, _ = wait(self._running, timeout=POLL_S, return_when=FIRST_COMPLETED)
        return [self._outcome(future) for future in finished]

    def _outcome(self, future: Future[Any]) -> Ended:
        key, pool = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            self._idle.append(self._replaced(pool))
            return Ended(key, "lost", text="its process was killed")
        self._idle.append(pool)
        if error is None:
            return Ended(key, "value", future.result())
        if is_worker_trouble(error):
            return Ended(key, "worker", text=trouble_text(error))
        return Ended(key, "error", error=error)

    def give_up(self, key: int) -> str:
        """Kill the process of a unit and replace it; return this as a text."""
        future, (_, pool) = next(
            (future, entry) for future, entry in self._running.items() if entry[0] == key
        )
        del self._running[future]
        self._kill(pool)
        self._idle.append(self._replaced(pool))
        return "its process was stopped"

    def _kill(self, pool: ProcessPoolExecutor) -> None:
        """Kill a pool's process; a process without a known pid has never started."""
        pids = self._pids[pool]
        if pids.done() and pids.exception() is None:
            with suppress(ProcessLookupError):
                os.kill(pids.result(), getattr(signal, "SIGKILL", signal.SIGTERM))

    def status(self) -> str:
        """Return the number of processes, as text."""
        return f"{self._count} processes"
