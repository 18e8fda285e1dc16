"""Small units of work for the scheduler's tests; workers import this module too."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from typing import Any

from fieldlum.core.scheduler import Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.session import replacing


def outcomes_of(units: list[WorkUnit], scheduler: Scheduler) -> list[UnitOutcome]:
    found: list[UnitOutcome] = []
    run_each(units, scheduler, found.append)
    return found


def doubled(folder: Path, number: int) -> int:
    return 2 * number


def asleep(folder: Path, seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def thread_counts(folder: Path, argument: None) -> set[int]:
    """Return how many threads OpenCV and the libraries of NumPy and SciPy may use here."""
    import cv2
    import scipy.linalg  # noqa: F401 - loaded after the process started
    from threadpoolctl import threadpool_info

    return {cv2.getNumThreads(), *(library["num_threads"] for library in threadpool_info())}


def written(folder: Path, argument: dict[str, Any]) -> int:
    """Write out/NAME by rename; note in runs/ that this unit ran to its end."""
    time.sleep(argument.get("seconds", 0.0))
    with replacing(folder / "out" / argument["name"]) as file:
        file.write(argument["name"].encode() * 100)
    return len(argument["name"])


def troubled(folder: Path, argument: dict[str, Any]) -> str:
    """Kill the process or report a full disk, as often as `times` states; then succeed."""
    seen = len(list(folder.glob(f"{argument['name']}.try*")))
    (folder / f"{argument['name']}.try{seen}").write_text(str(os.getpid()))
    if seen < argument["times"]:
        if argument["how"] == "kill":
            os._exit(9)
        if argument["how"] == "full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / "x"))
        raise ValueError("a defect of the unit")
    return argument["name"]
