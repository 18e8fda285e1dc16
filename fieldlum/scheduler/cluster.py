"""Run units on a Dask cluster.

No other module imports dask, and this one imports it only if a cluster is used.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from fieldlum.errors import InputError, NotEnoughDataError, install_text
from fieldlum.records import counted
from fieldlum.scheduler.address import Scheduler
from fieldlum.scheduler.crew import POLL_S, Ended
from fieldlum.scheduler.identity import difference, sent_by_value, software_identity
from fieldlum.scheduler.units import (
    Answer,
    Task,
    WorkUnit,
    corrected,
    perform,
    task_of,
    use_one_thread,
)

# Units at a worker for each of its threads. While one runs the others wait there, so that a worker
# of short units never waits for the client. All other units wait at the client. Chosen.
UNITS_A_THREAD = 4
# timeout for an answer of the scheduler: ten times a slow handshake over TLS; chosen
CONNECT_S = 15.0
# longest time without a usable worker: a batch system starts jobs within minutes; chosen
PATIENCE_S = 600.0
TURN_S = 0.005  # pause between two looks for answers, short compared with any real unit; chosen
# longest time with refused workers only: a killed worker is replaced within a minute; chosen
REPLACED_S = 60.0
VISIBLE_S = 60.0  # timeout for a worker's file to appear here; NFS shows new names after up to 60 s


class ClusterCrew:
    """The workers of a Dask scheduler; only workers with exactly this software get units of work.

    Used in a `with` block; entering it raises InputError without dask, or if no scheduler answers.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._mine = software_identity()
        self._threads: dict[str, int] = {}  # number of threads of each connected worker
        self._usable: set[str] = set()
        self._asked: dict[str, Any] = {}  # worker, and the future of its identity
        self._avoided: dict[str, str] = {}  # worker, and why it gets no more units
        self._running: dict[int, tuple[Any, WorkUnit, frozenset[str]]] = {}
        self._keys: dict[Any, int] = {}  # future, and the key of its unit in `_running`
        self._looked_s = self._worked_s = 0.0

    def __enter__(self) -> ClusterCrew:
        self._client = _connect(self._scheduler)
        self._finished = _collector(self._client)
        link = self._client.dashboard_link
        shown = bool(self._client.scheduler_info(n_workers=0).get("services", {}).get("dashboard"))
        self.dashboard = link if shown else ""
        if self.dashboard:
            self._scheduler.say(f"dashboard: {self.dashboard}")
        self._worked_s = time.monotonic()
        self._look()
        return self

    def __exit__(self, *error: object) -> None:
        futures = [entry[0] for entry in self._running.values()] + list(self._asked.values())
        self._client.cancel(futures, reason="the command ended")
        self._client.close()

    # ------------------------------------------------------------------------------------------
    # workers

    def _look(self) -> None:
        """Update the list of workers, and query the software of new ones."""
        self._looked_s = time.monotonic()
        self._threads = dict(self._client.nthreads())
        for name in self._threads.keys() - self._asked.keys():
            self._asked[name] = self._client.submit(
                sent_by_value(), workers=[name], pure=False, key=f"identity-{name}-{id(self)}"
            )
        for name, future in self._asked.items():
            if name in self._threads and name not in self._usable and name not in self._avoided:
                self._judge(name, future)
        self._usable &= self._threads.keys()
        if self._usable:
            self._worked_s = self._looked_s

    def _judge(self, name: str, future: Any) -> None:
        if future.status == "error":
            self._avoid(name, f"it cannot state its software ({future.exception()})")
        elif future.status == "finished":
            other = difference(self._mine, future.result())
            if other:
                self._avoid(name, f"rejected: {other}; install the versions of this computer there")
            else:
                self._usable.add(name)

    def _avoid(self, name: str, why: str) -> None:
        if name not in self._avoided:
            self._avoided[name] = why
            self._usable.discard(name)
            self._scheduler.say(f"worker {name}: {why}; it gets no further units")

    def _check_patience(self) -> None:
        """Raise InputError if no worker is left that may run units."""
        idle_s = time.monotonic() - self._worked_s
        refused = self._threads.keys() & self._avoided.keys()
        if refused and refused == self._threads.keys() and idle_s > REPLACED_S:
            name = next(iter(refused))
            raise InputError(
                self._scheduler.address,
                f"no usable worker is left (worker {name}: {self._avoided[name]})",
                remedy="finished units are stored; start the command again",
            )
        if idle_s > PATIENCE_S:
            finding = f"no usable worker for {PATIENCE_S:.0f} s"
            remedy = (
                "start a worker: dask worker ADDRESS; finished units are stored, so start "
                "the command again"
            )
            raise NotEnoughDataError(f"{self._scheduler.address}: {finding}; {remedy}")

    # ------------------------------------------------------------------------------------------
    # units

    def free(self) -> int:
        """Return how many more units the usable workers can accept; it can be below 0.

        Raises InputError if all workers have been rejected for a minute, NotEnoughDataError if
        there was no usable worker for ten minutes.
        """
        if time.monotonic() - self._looked_s > POLL_S:
            self._look()
        self._check_patience()
        threads = sum(self._threads[name] for name in self._usable)
        return UNITS_A_THREAD * threads - len(self._running)

    def submit(self, key: int, unit: WorkUnit) -> None:
        """Send a unit to the scheduler, for the workers that are usable now."""
        places = frozenset(self._usable)
        future = self._client.submit(
            perform_here,
            task_of(unit),
            key=f"{unit.name}-{key}-{id(self)}",
            workers=sorted(places),
            pure=False,
        )
        self._running[key] = (future, unit, places)
        self._keys[future] = key
        self._finished.add(future)

    def ended(self) -> list[Ended]:
        """Return how units ended, including those that no worker can run; wait up to 0.5 s."""
        end_s = time.monotonic() + POLL_S
        while not self._finished.has_ready() and time.monotonic() < end_s:
            time.sleep(TURN_S)
        answers = [
            (self._keys.pop(future, 0), future, value)
            for future, value in self._finished.next_batch(block=False)
        ]
        outcomes = [
            self._outcome(key, future, value)
            for key, future, value in answers
            if key in self._running
        ]
        return [*outcomes, *self._orphans()]

    def _orphans(self) -> Iterable[Ended]:
        """Yield units for which no permitted worker remains; they would wait without end."""
        there = self._threads.keys()
        for key in [k for k, (_, _, places) in self._running.items() if not places & there]:
            future, _, _ = self._running.pop(key)
            future.cancel(reason="its workers left")
            yield Ended(key, "lost", text="its workers left the cluster")

    def _outcome(self, key: int, future: Any, value: Any) -> Ended:
        _, unit, _ = self._running.pop(key)
        if future.status != "finished":
            return _failure(key, future, value)
        worker, answer = value
        if answer.kind == "value":
            missing = _await_files(unit)
            if not missing:
                return Ended(key, "value", answer.value)
            why = (
                f"its output {missing} does not appear here: the worker may use another shared "
                "folder"
            )
        elif answer.kind == "stale":
            changed = corrected(unit, answer)
            if changed is not None:
                return Ended(key, "changed", changed)
            why = (
                f"its {answer.text} differs from that on this computer: its file system is out of "
                "date"
            )
        else:
            why = answer.text
        self._avoid(worker, why)
        return Ended(key, "worker", text=f"worker {worker}: {why}")

    def give_up(self, key: int) -> str:
        """Cancel a unit and stop using its worker; return what was done, as text."""
        future, _, _ = self._running.pop(key)
        processing = self._client.processing()
        names = [name for name, keys in processing.items() if future.key in keys]
        future.cancel(reason="it takes too long")
        for name in names:
            self._avoid(name, "it hangs")
        return f"worker {names[0]} hangs" if names else "no worker accepted it"

    def status(self) -> str:
        """Return the number of usable workers, and of those not used, as text."""
        count = len(self._usable)
        text = counted(count, "worker")
        return f"{text}, {len(self._avoided)} not used" if self._avoided else text


def _failure(key: int, future: Any, value: Any) -> Ended:
    """Return how a task without an answer ended; `value` has type, exception and traceback."""
    from distributed import KilledWorker

    error = value[1] if future.status == "error" else None
    if error is None or isinstance(error, KilledWorker):
        return Ended(key, "lost", text="its workers were killed or ran out of memory")
    return Ended(key, "error", error=error)


def _collector(client: Any) -> Any:
    """Return a function that fetches answers in the background.

    A lost worker then blocks nothing.
    """
    from distributed import as_completed

    return as_completed(with_results=True, raise_errors=False, loop=client.loop)


def perform_here(task: Task) -> tuple[str, Answer]:
    """Run a task on a worker; return the worker's address and the answer."""
    from distributed import get_worker

    use_one_thread()  # in the thread of this task: OpenMP has a limit for each thread
    return str(get_worker().address), perform(task)


def _connect(scheduler: Scheduler) -> Any:
    """Return a Dask client. Raises InputError without dask, or if no scheduler answers."""
    try:
        from distributed import Client, Security
    except ImportError:
        raise InputError(
            "--scheduler",
            "dask is not installed",
            remedy=install_text("cluster"),
        ) from None
    security: Any = None
    if scheduler.tls is not None:
        security = Security(
            require_encryption=True,
            tls_ca_file=str(scheduler.tls.ca),
            tls_client_cert=str(scheduler.tls.certificate),
            tls_client_key=str(scheduler.tls.key),
        )
    try:
        return Client(
            scheduler.address,
            security=security,
            timeout=CONNECT_S,
            set_as_default=False,
            name="fieldlum",
        )
    except (OSError, TimeoutError) as error:
        raise InputError(
            scheduler.address,
            f"no scheduler answers ({type(error).__name__})",
            remedy="start one with: dask scheduler --host 127.0.0.1, or check the certificates",
        ) from None


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
