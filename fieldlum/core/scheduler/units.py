"""Define a unit of work, what is sent to a worker, and what a worker does with it."""

from __future__ import annotations

import errno
import hashlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from fieldlum.core.errors import InputError
from fieldlum.optics.profiles import shipped
from fieldlum.session import sha256

SHARED_VARIABLE = "FIELDLUM_SHARED"
# Errors of a worker's computer, so that another computer may finish the unit: a full disk, a quota,
# a disk that does not answer, a share that went away, no memory.
WORKER_ERRNOS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EROFS,
    errno.ENOMEM,
    errno.EMFILE,
    getattr(errno, "ESTALE", errno.EIO),
)


# Read by BLAS and OpenMP libraries when they are loaded.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread() -> None:
    """Limit this process to one thread of OpenCV, BLAS and OpenMP.

    By default each of n processes would start a thread for each core, and they would wait for each
    other: two processes on two cores took twice as long to predict a year.
    """
    import cv2

    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))  # for libraries loaded later
    threadpool_limits(1)
    cv2.setNumThreads(1)


def is_worker_trouble(error: BaseException) -> bool:
    """Return whether an error is due to the computer that runs a unit, not to the unit."""
    if isinstance(error, OSError):
        return error.errno in WORKER_ERRNOS
    return isinstance(error, MemoryError)


def trouble_text(error: BaseException) -> str:
    """Return a text about the trouble of a worker, without paths."""
    return getattr(error, "strerror", None) or "out of memory"


@dataclass(frozen=True, slots=True)
class WorkUnit:
    """One piece of work: `call(folder, argument)`, which may run more than once.

    name: unique in the run. call: a function of a module. argument: plain values without paths.
    files: input files, relative to `folder`, whose content must be the same for a worker as for
    this computer. outputs: files, relative to `folder`, that exist when the unit has ended; the
    call writes them by rename.
    """

    name: str
    call: Callable[[Path, Any], Any]
    folder: Path
    argument: Any
    files: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UnitOutcome:
    """How a unit of work ended: with a value, or with an error of its call, or with trouble.

    trouble: what went wrong at its workers, "" if nothing did.
    """

    unit: WorkUnit
    value: Any = None
    error: BaseException | None = None
    trouble: str = ""

    def result(self) -> Any:
        """Return the value; raise the error of the call, or InputError for trouble of workers."""
        if self.error is not None:
            raise self.error
        if self.trouble:
            raise InputError(
                f"unit of work {self.unit.name}",
                self.trouble,
                "a worker that completes it",
                "check memory and disk of the workers, then start the command again",
            )
        return self.value


# ----------------------------------------------------------------------------------------------
# workers of a cluster


@dataclass(frozen=True, slots=True)
class Task:
    """What a worker of a cluster receives; it contains no absolute path of this computer.

    inputs: names and sha256 of input files, relative to `folder`; software: that of the client.
    """

    call: Callable[[Path, Any], Any]
    folder: str
    argument: Any
    inputs: tuple[tuple[str, str], ...]
    software: dict[str, str]


def shared_folder() -> Path:
    """Return the folder of task paths: FIELDLUM_SHARED, else the current folder."""
    return Path(os.environ.get(SHARED_VARIABLE) or Path.cwd())


def relative_folder(folder: Path) -> str:
    """Return `folder` relative to the shared folder. Raises InputError if it is outside."""
    shared = shared_folder()
    try:
        return folder.resolve().relative_to(shared.resolve()).as_posix()
    except ValueError:
        raise InputError(
            folder,
            f"this folder is outside the shared folder {shared}",
            "a folder inside it, so that workers can use it too",
            f"start the command in a folder above it, or set {SHARED_VARIABLE} here and "
            "on each worker",
        ) from None


def task_of(unit: WorkUnit) -> Task:
    """Return what a worker needs for `unit`, with the sha256 of its input files.

    Raises InputError if its folder is outside the shared folder.
    """
    inputs = tuple((name, _digest(unit.folder / name)) for name in unit.files)
    return Task(unit.call, relative_folder(unit.folder), unit.argument, inputs, software())


def perform(task: Task) -> tuple[Any, str]:
    """Run a task on a worker; return the call's value, and what is wrong with this computer or "".

    A computer is wrong if it has other software or other input files than the client, a full disk
    or no memory. Raises the call's other errors.
    """
    folder = shared_folder() / task.folder
    mine = software()
    other = [f"{k} {mine[k]} (here {v})" for k, v in task.software.items() if mine[k] != v]
    if other:
        return None, f"rejected: {', '.join(other)}; install the versions of this computer there"
    try:
        for name, digest in task.inputs:
            if _digest(folder / name) != digest:
                return None, f"its {name} differs from that of the command: file system out of date"
        return task.call(folder, task.argument), ""
    except (OSError, MemoryError) as error:
        if is_worker_trouble(error):
            return None, trouble_text(error)
        raise


def _digest(path: Path) -> str:
    return sha256(path) if path.is_file() else "absent"


@cache
def software() -> dict[str, str]:
    """Return the versions of Python and numeric packages, and digests of fieldlum's files."""
    facts = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    for name in ("fieldlum", "numpy", "scipy", "opencv-contrib-python-headless", "torch", "pvlib"):
        try:
            facts[name] = version(name).split("+")[0]
        except PackageNotFoundError:
            facts[name] = "none"
    package = Path(__file__).parents[2]
    for key, folder, pattern in (
        ("source", package, "*.py"),
        ("profiles", shipped("calibration"), "*.toml"),
    ):
        digests = "".join(sha256(path) for path in sorted(folder.rglob(pattern)))
        facts[key] = hashlib.sha256(digests.encode()).hexdigest()[:12]
    return facts
