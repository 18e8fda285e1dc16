"""Submit units to this process, to processes of this computer, or to a Dask cluster.

All three return futures of `concurrent.futures`. Only this module imports dask, if it is used.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

from threadpoolctl import threadpool_limits

from fieldlum.core.errors import InputError, NotEnoughDataError, install_text
from fieldlum.core.records import counted
from fieldlum.core.scheduler.address import Scheduler
from fieldlum.core.scheduler.units import (
    Task,
    UnitOutcome,
    WorkUnit,
    is_worker_trouble,
    perform,
    task_of,
    trouble_text,
    use_one_thread,
)

POLL_S = 0.5  # seconds between two checks of time limits and new workers; chosen
# Units at a worker for each of its threads, so that a worker of short units never waits. Chosen.
UNITS_A_THREAD = 4
# timeout for an answer of the scheduler: ten times a slow handshake over TLS; chosen
CONNECT_S = 15.0
# longest time without any worker: a batch system starts jobs within minutes; chosen
PATIENCE_S = 600.0
# longest time with refused workers only: a killed worker is replaced within a minute; chosen
REPLACED_S = 60.0
VISIBLE_S = 60.0  # timeout for a worker's file to appear here; NFS shows new names after up to 60 s


class Here:
    """The current process, which runs a unit when it is submitted; base of the other workers."""

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def free(self, running: int) -> int:
        """Return how many more units may be submitted while `running` units run."""
        return 1 - running

    def submit(self, unit: WorkUnit) -> Future[Any]:
        """Start a unit, or queue it where it will start soon."""
        future: Future[Any] = Future()
        try:
            with threadpool_limits(1, user_api="blas"):  # as in a worker, for equal rounding
                future.set_result(unit.call(unit.folder, unit.argument))
        except Exception as error:
            future.set_exception(error)
        return future

    def settle(self, unit: WorkUnit, future: Future[Any]) -> UnitOutcome | str:
        """Return how a unit ended, or the trouble of its worker: then another may finish it."""
        error = future.exception()
        return UnitOutcome(unit, None if error else future.result(), error)

    def lost(self) -> list[Future[Any]]:
        """Return futures that no worker can finish any more."""
        return []

    def give_up(self, future: Future[Any]) -> str:
        """Stop waiting for a unit; return what was done with its worker."""
        raise NotImplementedError

    def status(self) -> str:
        """Return the number of workers, as text for the progress line; "" for this process."""
        return ""


# ----------------------------------------------------------------------------------------------
# processes


class Processes(Here):
    """Processes of this computer, each in its own pool: a killed one costs only its unit."""

    def __init__(self, count: int) -> None:
        self._pids: dict[Executor, Future[int]] = {}
        self._running: dict[Future[Any], Executor] = {}
        self._idle = [self._pool() for _ in range(count)]
        self._count = count

    def _pool(self) -> Executor:
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_start_worker)
        self._pids[pool] = pool.submit(os.getpid)
        return pool

    def __exit__(self, *error: object) -> None:
        for pool in self._running.values():
            self._kill(pool)
        for pool in self._pids:
            pool.shutdown(cancel_futures=True)

    def free(self, running: int) -> int:
        """Return the number of processes without a unit."""
        return len(self._idle)

    def submit(self, unit: WorkUnit) -> Future[Any]:
        """Start a unit in a free process, once that has started."""
        pool = self._idle.pop(0)
        try:
            self._pids[pool].result()
            future = pool.submit(unit.call, unit.folder, unit.argument)
        except BrokenProcessPool:  # the process was killed between two units
            self._replace(pool)
            return self.submit(unit)
        self._running[future] = pool
        return future

    def settle(self, unit: WorkUnit, future: Future[Any]) -> UnitOutcome | str:
        """Return how a unit ended, or the trouble of its process."""
        pool, error = self._running.pop(future), future.exception()
        if isinstance(error, BrokenProcessPool):
            self._replace(pool)
            return "its process was killed"
        self._idle.append(pool)
        if error is not None and is_worker_trouble(error):
            return trouble_text(error)
        return super().settle(unit, future)

    def give_up(self, future: Future[Any]) -> str:
        """Kill the process of a unit and replace it."""
        pool = self._running.pop(future)
        self._kill(pool)
        self._replace(pool)
        return "its process was stopped"

    def _replace(self, pool: Executor) -> None:
        del self._pids[pool]
        pool.shutdown(wait=False)
        self._idle.append(self._pool())

    def _kill(self, pool: Executor) -> None:
        with suppress(ProcessLookupError):
            os.kill(self._pids[pool].result(), getattr(signal, "SIGKILL", signal.SIGTERM))

    def status(self) -> str:
        """Return the number of processes."""
        return f"{self._count} processes"


def _start_worker() -> None:
    """Limit a worker to one thread, and end it with its parent."""
    use_one_thread()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


# ----------------------------------------------------------------------------------------------
# a cluster


class Cluster(Here):
    """The workers of a Dask scheduler. Dask runs a killed worker's units elsewhere.

    A worker with other software, stale files or a full disk gets no further units. Raises
    InputError without dask, or if no scheduler answers.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._client = _connect(scheduler)
        self._threads: dict[str, int] = {}  # number of threads of each connected worker
        self._avoided: dict[str, str] = {}  # worker, and why it gets no more units
        self._running: dict[Future[Any], tuple[str, frozenset[str]]] = {}  # key, allowed workers
        self._looked_s, self._worked_s = 0.0, time.monotonic()
        self._count = 0

    def __exit__(self, *error: object) -> None:
        for future in self._running:
            future.cancel()
        self._client.close()

    def _usable(self) -> frozenset[str]:
        """Return the workers that get units; look for new ones every 0.5 s.

        Raises InputError after a minute with refused workers only, NotEnoughDataError after ten
        minutes without a worker.
        """
        now_s = time.monotonic()
        if now_s - self._looked_s > POLL_S:
            self._looked_s, self._threads = now_s, dict(self._client.nthreads())
        usable = frozenset(self._threads.keys() - self._avoided.keys())
        if usable:
            self._worked_s = now_s
        refused = [name for name in self._threads if name in self._avoided]
        if refused and now_s - self._worked_s > REPLACED_S:
            finding = f"no usable worker is left (worker {refused[0]}: {self._avoided[refused[0]]})"
            remedy = "finished units are stored; start the command again"
            raise InputError(self._scheduler.address, finding, remedy=remedy)
        if now_s - self._worked_s > PATIENCE_S:
            raise NotEnoughDataError(
                f"{self._scheduler.address}: no worker for {PATIENCE_S:.0f} s; start a worker: "
                "dask worker ADDRESS; finished units are stored, so start the command again"
            )
        return usable

    def free(self, running: int) -> int:
        """Return how many more units the usable workers can accept."""
        threads = sum(self._threads[name] for name in self._usable())
        return UNITS_A_THREAD * threads - running

    def submit(self, unit: WorkUnit) -> Future[Any]:
        """Send a unit to the workers that are usable now."""
        places = self._usable()
        self._count += 1
        key = f"{unit.name}-{self._count}-{id(self)}"
        executor = self._client.get_executor(workers=sorted(places), pure=False)
        future = executor.submit(_perform_here, task_of(unit), key=key)
        self._running[future] = key, places
        return future

    def settle(self, unit: WorkUnit, future: Future[Any]) -> UnitOutcome | str:
        """Return how a unit ended, or the trouble of its worker."""
        from distributed import KilledWorker

        del self._running[future]
        if future.cancelled() or isinstance(future.exception(), KilledWorker):
            return "its workers were killed or ran out of memory"
        if future.exception() is not None:
            return super().settle(unit, future)
        worker, value, trouble = future.result()
        missing = "" if trouble else _await_files(unit)
        if missing:
            trouble = f"its output {missing} does not appear here: it may use another shared folder"
        if not trouble:
            return UnitOutcome(unit, value)
        self._avoid(worker, trouble)
        return f"worker {worker}: {trouble}"

    def _avoid(self, worker: str, why: str) -> None:
        if worker not in self._avoided:
            self._avoided[worker] = why
            self._scheduler.say(f"worker {worker}: {why}; it gets no further units")

    def lost(self) -> list[Future[Any]]:
        """Return futures whose allowed workers all left the cluster."""
        there = self._threads.keys()
        return [future for future, (_, places) in self._running.items() if not places & there]

    def give_up(self, future: Future[Any]) -> str:
        """Cancel a unit, and stop using the worker that has it."""
        key, _ = self._running.pop(future)
        workers = [name for name, keys in self._client.processing().items() if key in keys]
        future.cancel()
        for worker in workers:
            self._avoid(worker, "it hangs")
        return f"worker {workers[0]} hangs" if workers else "its workers left the cluster"

    def status(self) -> str:
        """Return the number of connected workers, and of those that get no units."""
        text = counted(len(self._threads.keys() - self._avoided.keys()), "worker")
        return f"{text}, {len(self._avoided)} not used" if self._avoided else text


def _perform_here(task: Task) -> tuple[str, Any, str]:
    """Run a task on a worker; return the worker's address, the value, and the trouble or ""."""
    from distributed import get_worker

    use_one_thread()  # in the thread of this task: OpenMP has a limit for each thread
    return (str(get_worker().address), *perform(task))


def _connect(scheduler: Scheduler) -> Any:
    """Return a Dask client. Raises InputError without dask, or if no scheduler answers."""
    try:
        from distributed import Client, Security
    except ImportError:
        remedy = install_text("cluster")
        raise InputError("--scheduler", "dask is not installed", remedy=remedy) from None
    secure: Any = Security(require_encryption=True, **dict(scheduler.tls))
    try:
        return Client(
            scheduler.address,
            security=secure if scheduler.tls else None,
            timeout=CONNECT_S,
            set_as_default=False,
            name="fieldlum",
        )
    except (OSError, TimeoutError) as error:
        finding = f"no scheduler answers ({type(error).__name__})"
        remedy = "start one with: dask scheduler --host 127.0.0.1, or check the certificates"
        raise InputError(scheduler.address, finding, remedy=remedy) from None


def _await_files(unit: WorkUnit) -> str:
    """Wait until each output is visible here; return an output that is not, or ""."""
    end_s = time.monotonic() + VISIBLE_S
    for name in unit.outputs:
        path = unit.folder / name
        while not path.is_file():
            if time.monotonic() > end_s:
                return name
            time.sleep(0.2)
            with suppress(OSError):
                # makes a network share that caches names read them again
                list(path.parent.iterdir())
    return ""
