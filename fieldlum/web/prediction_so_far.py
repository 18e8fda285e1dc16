"""Compute the answer so far: the commands from frames to glare classes, at low priority.

Each command runs in its own process. It is paused before a slot begins and continues after it, so
that a capture on the same computer never waits. Merge and pair write into the
session; the model and the year are in its folder watch/, separate from the user's own.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import psutil

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable, parse_utc, utc_text
from fieldlum.session import Session
from fieldlum.session.codec import to_json
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import Sidecar, newest_sidecar

# A bracket begins with the camera waking up: a minute before it the computer is the capture's.
# Chosen.
QUIET_BEFORE_S = 90.0
ANSWER_EVERY = timedelta(hours=6)  # fitting takes minutes: at most a few times a day; chosen
MIN_CAPTURES = 8  # fewer leave every class open; chosen
_MAIN = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
PROGRAM = (sys.executable, "-c", _MAIN)


class Moment(NamedTuple):
    """State that decides whether there is time to compute.

    is_quiet: no bracket is running, none begins within 90 s, and time is not simulated and fast.
    captured: number of complete slots.
    """

    is_quiet: bool
    captured: int


@dataclass(slots=True)
class Worker:
    """Runs merge, pair, train and predict of a session in a thread, while no slot is near.

    moment: returns the present state of the capture. weather: a file, or "synthetic". program:
    starts fieldlum; look_every_s: pause between two looks for work; problem: error of the last
    step, or ""; step: what is computed now, or "".
    """

    session: Session
    moment: Callable[[], Moment]
    weather: str = "synthetic"
    program: Sequence[str] = PROGRAM
    look_every_s: float = 5.0
    problem: str = ""
    step: str = ""
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _merged_at: int = -1
    _answered_at: int = -1

    @property
    def folder(self) -> Path:
        """The session's folder watch/, with the model, the year and the last answer."""
        return self.session.root / "watch"

    def start(self) -> None:
        """Start the thread and return at once."""
        self._thread = threading.Thread(target=self._loop, name="answer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the running command and the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(20.0)

    def _loop(self) -> None:
        while not self._stop.wait(self.look_every_s):
            with suppress(OSError):  # a share that is away: look again later
                self.work()

    def work(self) -> None:
        """Merge and pair new brackets if no slot is near; then train and predict if it is time.

        It is time if 8 or more slots are captured, slots were captured since the last training of
        this process, and the last answer (predicted year) is 6 or more hours old or missing.
        """
        now = self.moment()
        if not now.is_quiet or now.captured == 0:
            return
        if now.captured != self._merged_at:
            root = str(self.session.root)
            before = newest_sidecar(self.session)  # what the user merged is not merged otherwise
            options = () if before is None else _merge_options(before)
            good = self._run("merge", "merge", root, "--scheduler", "processes:1", *options)
            good = good and self._run("pair", "pair", root)
            if not self._stop.is_set():
                self._merged_at = now.captured
            if not good:
                return
        if now.captured != self._answered_at and now.captured >= MIN_CAPTURES:
            last = read_answer(self.session)
            if last is None or datetime.now(UTC) - parse_utc(last["t_utc"]) >= ANSWER_EVERY:
                self._answer(now.captured)

    def _answer(self, captured: int) -> None:
        model, annual, root = self.folder / "model", self.folder / "annual", str(self.session.root)
        fitting = ("train", root, "--model", "transport", "--out", str(model))
        year = ("predict", str(model), "--weather", self.weather, "--out", str(annual))
        _ = self._run("train", *fitting) and self._run("predict", *year)
        if not self._stop.is_set():
            self._answered_at = captured

    def _run(self, name: str, *arguments: str) -> bool:
        """Run one command at the lowest priority and return whether it succeeded.

        The command is paused while a slot is near.
        """
        if self._stop.is_set():
            return False
        self.folder.mkdir(exist_ok=True)
        self.step = name
        notes = self.folder / f"{name}.err"
        one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        how: JsonTable = {"env": {**os.environ, **one}, "start_new_session": True}
        how |= dict.fromkeys(("stdin", "stdout"), subprocess.DEVNULL)
        try:
            notes.unlink(missing_ok=True)  # a link of this name would lead elsewhere
            with notes.open("xb") as errors:
                process = psutil.Popen([*self.program, *arguments], stderr=errors, **how)
                with suppress(psutil.Error):  # 19 is the lowest priority of POSIX
                    process.nice(getattr(psutil, "IDLE_PRIORITY_CLASS", 19))
                code = self._wait_with_pauses(process)
        finally:
            self.step = ""
        if code == 0:
            self.problem = ""
        elif not self._stop.is_set():
            lines = notes.read_text("utf-8", "replace").strip().splitlines()
            self.problem = (lines or [f"{name}: exit code {code}"])[-1][:400]
        return code == 0

    def _wait_with_pauses(self, process: psutil.Popen) -> int | None:
        """Wait until a process ends, pause it near slots, and return its exit code."""
        stopped = False
        while True:
            with suppress(psutil.TimeoutExpired, subprocess.TimeoutExpired):
                return process.wait(min(self.look_every_s, 1.0))
            if self._stop.is_set():
                _signal_tree(process, "kill")
                return process.wait()
            if self.moment().is_quiet == stopped:
                _signal_tree(process, "resume" if stopped else "suspend")
                stopped = not stopped


def _signal_tree(process: psutil.Popen, act: str) -> None:
    """Kill, suspend or resume a process and its children; those that have ended are skipped."""
    with suppress(psutil.Error):
        for member in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                getattr(member, act)()


def read_answer(session: Session) -> JsonTable | None:
    """Return what `Worker` predicted last, from the folder watch/; None for a missing or bad file.

    t_utc: its time; captures: number of captures of its model; weather: its name; synthetic:
    whether it is a synthetic year; warnings: texts; protection: a `DirectionYear` for each view
    direction.
    """
    folder = session.root / "watch"
    try:
        year, model = PredictFile.read(folder / "annual"), ModelConfig.read(folder / "model")
        written_s = (folder / "annual" / PredictFile.NAME).stat().st_mtime
    except (OSError, InputError):
        return None
    return {
        "t_utc": utc_text(datetime.fromtimestamp(written_s, UTC)),
        "captures": len(model.training.slots),
        "weather": year.weather.name,
        "synthetic": year.weather.synthetic,
        "warnings": [*year.model_warnings, *year.notes],
        "protection": to_json(year.protection),
    }


def answer_table(session: Session, worker: Worker | None) -> JsonTable:
    """Return the last answer and what is computed now, with the keys of the page's JSON.

    last: `read_answer`, or None; computes: whether this process has a worker; step: what it
    computes now, ""; problem: error of its last step, ""; least_captures: needed for an answer.
    worker: None if nothing is computed here.
    """
    step, problem = (worker.step, worker.problem) if worker else ("", "")
    doing = {"computes": worker is not None, "step": step, "problem": problem}
    return {"last": read_answer(session), **doing, "least_captures": MIN_CAPTURES}


def _merge_options(sidecar: Sidecar) -> tuple[str, ...]:
    """Return options of `fieldlum merge`, with which it merges as it merged this bracket."""
    height, fit = sidecar.inputs.get("height"), sidecar.inputs.get("fit")
    size = ("--size", f"{2 * height}x{height}") if isinstance(height, int) else ()
    return size if fit is None else (*size, "--fit" if fit else "--no-fit")
