"""Define a unit of work, what is sent to a worker, and what a worker does with it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from threadpoolctl import threadpool_limits

from fieldlum.errors import InputError
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
    this computer. recorded: further files with their recorded sha256. outputs: files, relative to
    `folder`, that exist when the unit has ended; the call writes them by rename.
    """

    name: str
    call: Callable[[Path, Any], Any]
    folder: Path
    argument: Any
    files: tuple[str, ...] = ()
    recorded: tuple[tuple[str, str], ...] = ()
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
# over the wire


@dataclass(frozen=True, slots=True)
class Task:
    """What a worker of a cluster receives; it contains no absolute path of this computer."""

    name: str
    call: Callable[[Path, Any], Any]
    folder: str
    argument: Any
    inputs: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a worker returns for a unit.

    kind "value": the result is `value`. "stale": the input file `text` does not have the expected
    content; `seen` is the hash that the worker found. "worker": the worker's computer has a fault,
    which `text` describes.
    """

    value: Any = None
    kind: Literal["value", "stale", "worker"] = "value"
    text: str = ""
    seen: str = ""


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
    files = tuple((name, sha256(unit.folder / name)) for name in unit.files)
    folder = relative_folder(unit.folder)
    return Task(unit.name, unit.call, folder, unit.argument, files + unit.recorded)


def perform(task: Task) -> Answer:
    """Run a task on a worker: check its inputs, call it, and report trouble of this computer.

    Raises the call's other errors, and ValueError for a path that leads out of its folder.
    """
    folder = shared_folder() / _inside(task.folder)
    try:
        for name, digest in task.inputs:
            content_digest = _digest(folder / _inside(name))
            if content_digest != digest:
                return Answer(kind="stale", text=name, seen=content_digest)
        return Answer(task.call(folder, task.argument))
    except (OSError, MemoryError) as error:
        if is_worker_trouble(error):
            return Answer(kind="worker", text=trouble_text(error))
        raise


def _digest(path: Path) -> str:
    try:
        return sha256(path)
    except FileNotFoundError:
        return "absent"


def _inside(name: str) -> PurePosixPath:
    """Return a path that stays in its folder. Raises ValueError for any other path."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"path {name!r} of a task leads out of its folder")
    return path


def corrected(unit: WorkUnit, answer: Answer) -> WorkUnit | None:
    """Return the unit with the recorded sha256 replaced, if this computer has the worker's content.

    answer: of kind "stale". The file that it names must have the hash here that the worker found
    (`answer.seen`); if it is absent on both, its record is removed. Return None for any other
    content, and for a file without a recorded sha256: then the worker's file system is out of date.
    A frame that was damaged after its capture differs from what capture.json records; `merge_slot`
    then refuses the bracket by the frame's name, on a worker as on this computer.
    """
    recorded = dict(unit.recorded)
    if answer.text not in recorded or _digest(unit.folder / answer.text) != answer.seen:
        return None
    if answer.seen == "absent":
        recorded.pop(answer.text)
    else:
        recorded[answer.text] = answer.seen
    return replace(unit, recorded=tuple(recorded.items()))
