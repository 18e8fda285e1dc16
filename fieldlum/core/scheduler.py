"""Run units of work in this process, in several processes, or on a Dask cluster.

A stage turns its work into `WorkUnit`s and calls `run_each`. `parse_scheduler` reads the text of
the option `--scheduler`. Units run in executors of `concurrent.futures`: a pool of processes, or
that of a Dask client. Dask is imported only for a cluster.
"""

import errno
import hashlib
import json
import multiprocessing
import os
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from threadpoolctl import threadpool_limits

from fieldlum.core.errors import Caution, InputError, NotEnoughDataError, input_errors
from fieldlum.core.files import read_bytes
from fieldlum.core.progress import progress, quiet, shown_by
from fieldlum.optics.profiles import shipped
from fieldlum.session import sha256

SHARED_VARIABLE = "FIELDLUM_SHARED"
RETRIES = 3  # number of further tries of a unit after its worker was lost; chosen
# Longest wait for an answer of the Dask scheduler: ten times a slow handshake over TLS. Chosen.
_CONNECT_TIMEOUT_S = 15.0
# Longest wait for a first worker: a batch system starts jobs within minutes. Chosen.
_FIRST_WORKER_S = 600.0
# Longest wait if all workers are avoided: a killed worker is replaced within a minute. Chosen.
_WORKER_REPLACEMENT_S = 60.0
# Errors of a worker's computer, so that another computer may finish the unit: a full disk, a quota,
# a disk that does not answer, a share that went away, no memory.
_WORKER_ERRNOS = {getattr(errno, "ESTALE", errno.EIO), errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_WORKER_ERRNOS |= {errno.EIO, errno.EROFS, errno.ENOMEM, errno.EMFILE}
# Read by BLAS and OpenMP libraries when they are loaded.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Scheduler:
    """Where units of work run: in `processes` on this computer, or on a Dask cluster.

    address: of the Dask scheduler, tcp:// or tls://; "" for this computer.
    """

    processes: int = 1
    address: str = ""


LOCAL = Scheduler()


def parse_scheduler(text: str) -> Scheduler:
    """Return the scheduler that a value of the option `--scheduler` names.

    text: local, processes:N (or N), an address, or FILE.json as a Dask scheduler writes it. Raises
    InputError for any other text and for a FILE.json that cannot be used. Warns of an address that
    other computers can reach without TLS.
    """
    count = "1" if text == "local" else text.removeprefix("processes:")
    if count.isdigit() and int(count) > 0:
        return Scheduler(int(count))
    address = text
    if text.endswith(".json"):
        remedy = "let dask scheduler --scheduler-file write the file"
        kinds = (OSError, ValueError, KeyError, TypeError)
        with input_errors(text, "a JSON file of a Dask scheduler", remedy, *kinds):
            address = str(json.loads(read_bytes(Path(text)))["address"])
    with suppress(ValueError):  # a port that is no number
        url = urlsplit(address)
        if url.scheme in ("tcp", "tls") and url.hostname and url.port and "@" not in url.netloc:
            if url.scheme == "tcp" and url.hostname not in ("localhost", "127.0.0.1", "::1"):
                text = f"{address} has no TLS and is not on this computer: anyone who can reach "
                text += "that port can run programs on its workers. Use tls:// (docs/scale.md)."
                warnings.warn(text, Caution, stacklevel=2)
            return Scheduler(address=address)
    forms = "local, processes:N, tcp://HOST:PORT, tls://HOST:PORT or FILE.json"
    raise InputError("--scheduler", f"'{address}'", forms, "correct it, or omit --scheduler")


# ----------------------------------------------------------------------------------------------
# units


@dataclass(frozen=True, slots=True)
class WorkUnit:
    """One piece of work: `call(folder, argument)`, which may run more than once.

    name: unique in the run. call: a function of a module, which writes files by rename. argument:
    plain values without paths. files: input files, relative to `folder`, whose content must be the
    same for a worker as for this computer.
    """

    name: str
    call: Callable[[Path, Any], Any]
    folder: Path
    argument: Any
    files: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UnitOutcome:
    """How a unit of work ended: with the value of its call, or with an error; the other is None."""

    unit: WorkUnit
    value: Any = None
    error: BaseException | None = None

    def result(self) -> Any:
        """Return the value of the call, or raise the unit's error."""
        if self.error is not None:
            raise self.error
        return self.value


Outcomes = Generator[UnitOutcome, None, None]


def run_each(
    units: Iterable[WorkUnit], scheduler: Scheduler, take: Callable[[UnitOutcome], object]
) -> None:
    """Run every unit and pass each outcome to `take`, in the order in which units end.

    A unit whose process or worker is killed, has a full disk or an outdated file system is tried
    again, at most 3 times; then its outcome has an InputError, and other units continue. An error
    in `take` stops all units and is raised. On a cluster, raises InputError if no Dask scheduler
    answers, no usable worker is left, or a unit's folder is outside the shared folder;
    NotEnoughDataError if there is no worker for ten minutes.
    """
    waiting = list(units)
    count = min(scheduler.processes, len(waiting))
    if scheduler.address and waiting:
        outcomes = _on_cluster(waiting, scheduler.address)
    else:
        outcomes = _in_processes(waiting, count) if count > 1 else (_run_here(u) for u in waiting)
    with closing(outcomes):
        for done, outcome in enumerate(outcomes, start=1):
            progress(done, len(waiting), outcome.unit.name)
            take(outcome)


def _run_here(unit: WorkUnit) -> UnitOutcome:
    """Run a unit in this process; return its outcome."""
    try:
        with shown_by(quiet), threadpool_limits(1, user_api="blas"):  # as in a worker
            return UnitOutcome(unit, unit.call(unit.folder, unit.argument))
    except Exception as error:
        return UnitOutcome(unit, error=error)


def worker_fault(error: BaseException | None) -> str:
    """Return the reason of an error that is due to the computer on which a unit ran, else "".

    Such reasons are a full disk and too little memory. They contain no paths.
    """
    if isinstance(error, OSError) and error.errno in _WORKER_ERRNOS:
        return error.strerror or "no reason stated"
    return "out of memory" if isinstance(error, MemoryError) else ""


def _given_up(unit: WorkUnit, why: str) -> UnitOutcome:
    """Return the outcome of a unit that was tried too often; why: reason of the last failure."""
    source, expected = f"unit of work {unit.name}", "a worker that completes it"
    found = f"given up after {RETRIES + 1} tries, the last: {why}"
    remedy = "check memory and disk of the workers, then start the command again"
    return UnitOutcome(unit, error=InputError(source, found, expected, remedy))


def use_one_thread() -> None:
    """Limit this process to one thread of OpenCV, BLAS and OpenMP.

    Otherwise each worker would start a thread for each core, and the threads would wait for each
    other: two processes on two cores took twice as long to predict a year.
    """
    import cv2

    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))  # for libraries loaded later
    threadpool_limits(1)
    cv2.setNumThreads(1)


# ----------------------------------------------------------------------------------------------
# processes


def _in_processes(units: list[WorkUnit], count: int) -> Outcomes:
    """Run units in a pool of `count` processes, and yield their outcomes as they end.

    A killed process breaks the pool and ends all its units. So a unit that is tried again runs
    alone: if its process is killed, it is the cause.
    """
    waiting, tries, running = units[::-1], Counter[str](), dict[Future[Any], WorkUnit]()
    pool = start_pool(count)
    try:
        while waiting or running:
            while waiting and len(running) < (1 if tries[waiting[-1].name] else count):
                unit = waiting.pop()
                try:
                    future = pool.submit(unit.call, unit.folder, unit.argument)
                except BrokenProcessPool:
                    pool = start_pool(count)
                    future = pool.submit(unit.call, unit.folder, unit.argument)
                running[future] = unit
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                unit, error = running.pop(future), future.exception()
                is_killed = isinstance(error, BrokenProcessPool)
                fault = "its process was killed" if is_killed else worker_fault(error)
                if not fault:
                    yield UnitOutcome(unit, None if error else future.result(), error)
                elif tries[unit.name] < RETRIES:
                    tries[unit.name] += 1
                    waiting.insert(0, unit)  # last
                else:
                    yield _given_up(unit, fault)
    finally:
        pool.shutdown(cancel_futures=True)


def start_pool(count: int) -> Executor:
    """Return a pool of `count` processes, each with one thread, which end with this process.

    The caller ends it by its `shutdown`.
    """
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=spawn, initializer=_start_worker)


def _start_worker() -> None:
    """Limit a process of a pool to one thread, and let it end when its parent ends."""
    use_one_thread()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


# ----------------------------------------------------------------------------------------------
# a cluster


@dataclass(frozen=True, slots=True)
class Task:
    """A unit of work as a worker of a cluster receives it, without absolute paths.

    call, argument: of the `WorkUnit`; folder: relative to the shared folder, which is
    FIELDLUM_SHARED, else the current folder, on each computer; inputs: names (relative to `folder`)
    and sha256 of input files, "absent" for a missing one; software: result of `software` on the
    computer that sends it.
    """

    call: Callable[[Path, Any], Any]
    folder: str
    argument: Any
    inputs: tuple[tuple[str, str], ...]
    software: dict[str, str]


def task_of(unit: WorkUnit) -> Task:
    """Return a unit as a worker of a cluster receives it; read its input files for their sha256.

    Raises InputError if its folder is outside the shared folder (see `Task`).
    """
    shared = _shared_folder()
    try:
        folder = unit.folder.resolve().relative_to(shared.resolve()).as_posix()
    except ValueError:
        found = f"this folder is outside the shared folder {shared}"
        remedy = f"start the command above it, or set {SHARED_VARIABLE} here and on each worker"
        raise InputError(unit.folder, found, "a folder inside it", remedy) from None
    inputs = tuple((name, _digest(unit.folder / name)) for name in unit.files)
    return Task(unit.call, folder, unit.argument, inputs, software())


def _shared_folder() -> Path:
    """Return the folder that workers share: FIELDLUM_SHARED, else the current one."""
    return Path(os.environ.get(SHARED_VARIABLE) or Path.cwd())


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file in hex, "absent" if it does not exist."""
    return sha256(path) if path.is_file() else "absent"


def perform(task: Task) -> tuple[Any, str]:
    """Run a task on a worker; return the call's value and "", or None and this computer's fault.

    Faults are other software or other input files than on the computer that sent the task, a full
    disk, and too little memory. Raises the call's other errors.
    """
    folder, own = _shared_folder() / task.folder, software()
    # The text is shown on the computer that sent the task, which is "here".
    other = [f"{k} {own[k]} (here {v})" for k, v in task.software.items() if own[k] != v]
    if other:
        return None, f"rejected: {', '.join(other)}; install the versions of this computer there"
    try:
        for name, digest in task.inputs:
            if _digest(folder / name) != digest:
                return None, f"its {name} differs from that of the command: file system out of date"
        return task.call(folder, task.argument), ""
    except (OSError, MemoryError) as error:
        if fault := worker_fault(error):
            return None, fault
        raise


def _perform_here(task: Task) -> tuple[str, Any, str]:
    """Run a task on a worker; return the worker's address, and the result of `perform`."""
    from distributed import get_worker

    use_one_thread()  # in the thread of this task: OpenMP has a limit for each thread
    return (str(get_worker().address), *perform(task))


@cache
def software() -> dict[str, str]:
    """Return what results depend on: versions of Python and packages, digests of fieldlum's files.

    By name: python, the names of packages, source (the code) and profiles (of cameras). A package
    that is not installed has the version "none". A worker compares these facts with those of the
    computer that sent the task, and rejects the task if they differ (`perform`).
    """
    facts = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    for name in ("fieldlum", "numpy", "scipy", "opencv-contrib-python-headless", "torch", "pvlib"):
        facts[name] = "none"
        with suppress(PackageNotFoundError):
            # without the label of a build after "+", such as that for a GPU (2.9.0+cu128)
            facts[name] = version(name).split("+")[0]
    folders = {"source": Path(__file__).parents[1], "profiles": shipped("calibration")}
    for (key, folder), pattern in zip(folders.items(), ("*.py", "*.toml"), strict=True):
        digests = "".join(sha256(path) for path in sorted(folder.rglob(pattern)))
        facts[key] = hashlib.sha256(digests.encode()).hexdigest()[:12]
    return facts


def _on_cluster(units: list[WorkUnit], address: str) -> Outcomes:
    """Run units on the workers of a Dask scheduler, and yield their outcomes as they end.

    Dask runs a killed worker's units elsewhere. A worker with other software, outdated files or a
    full disk gets no further units. Raises InputError if no other worker is left.
    """
    avoided: dict[str, str] = {}  # why a worker gets no further units, by its address
    # running: the unit of a future, and the workers that may run it (the empty set: any)
    tries, running = Counter[str](), dict[Future[Any], tuple[WorkUnit, set[str]]]()
    with _connect(address) as client:

        def submit(unit: WorkUnit) -> None:
            """Send a unit to the workers that are not avoided, and add it to `running`."""
            places = _usable(client, address, avoided)
            executor = client.get_executor(workers=sorted(places) or None, pure=False)
            running[executor.submit(_perform_here, task_of(unit))] = unit, places

        for unit in units:
            submit(unit)
        while running:
            ended = wait(running, timeout=_WORKER_REPLACEMENT_S, return_when=FIRST_COMPLETED).done
            for future in ended:
                (unit, _), (worker, value, fault, error) = running.pop(future), _results_of(future)
                if worker and fault and worker not in avoided:
                    avoided[worker] = fault
                    text = f"worker {worker}: {fault}; it gets no further units"
                    warnings.warn(text, Caution, stacklevel=2)
                if not fault:
                    yield UnitOutcome(unit, value, error)
                elif tries[unit.name] < RETRIES:
                    tries[unit.name] += 1
                    submit(unit)
                else:
                    yield _given_up(unit, f"worker {worker}: {fault}" if worker else fault)
            present = set() if ended else client.nthreads().keys()
            for future, (_, places) in running.items():
                # None of its workers is present any more: it would wait for ever.
                if places and not ended and not places & present:
                    future.cancel()


def _usable(client: Any, address: str, avoided: dict[str, str]) -> set[str]:
    """Return the addresses of the workers that are not avoided; the empty set if none is avoided.

    client: of Dask, connected to `address`. Raises InputError if all workers are avoided for a
    minute.
    """
    end_s = time.monotonic() + _WORKER_REPLACEMENT_S
    while avoided:
        if usable := client.nthreads().keys() - avoided.keys():
            return usable
        if time.monotonic() > end_s:
            worker, why = next(iter(avoided.items()))
            finding = f"no usable worker is left (worker {worker}: {why})"
            remedy = "finished units are stored; start the command again"
            raise InputError(address, finding, remedy=remedy)
        time.sleep(1.0)
    return set()


def _results_of(future: Future[Any]) -> tuple[str, Any, str, BaseException | None]:
    """Return the results of a task that ended: worker, value, fault of the worker, and error.

    Those that are absent are "" (worker, fault) or None (value, error of the call).
    """
    error = None if future.cancelled() else future.exception()
    if future.cancelled() or type(error).__name__ == "KilledWorker":
        return "", None, "its workers were killed or ran out of memory", None
    return ("", None, "", error) if error else (*future.result(), None)


def _connect(address: str) -> Any:
    """Return a client of the Dask scheduler at an address, when a worker is present.

    For tls://, certificates are those of Dask's own configuration. Raises InputError if no
    scheduler answers, NotEnoughDataError without a worker for ten minutes.
    """
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False, name="fieldlum")
    # MemoryError: another program, such as Dask's dashboard, whose answer has no length in front.
    except (OSError, TimeoutError, ValueError, MemoryError) as error:
        finding = f"no scheduler answers ({type(error).__name__})"
        remedy = "start one with: dask scheduler --host 127.0.0.1, or check the certificates"
        raise InputError(address, finding, remedy=remedy) from None
    try:
        client.wait_for_workers(1, timeout=_FIRST_WORKER_S)
    except TimeoutError:
        client.close()
        raise NotEnoughDataError(
            f"{address}: no worker for {_FIRST_WORKER_S:.0f} s; start one with: dask worker "
            "ADDRESS; finished units are stored, so start the command again"
        ) from None
    return client
