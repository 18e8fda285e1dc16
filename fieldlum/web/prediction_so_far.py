"""Predict the year's glare classes from the captures so far, while a capture runs.

The commands merge, pair, train and predict run at low priority, each in its own process. The
running command is paused before a slot begins and continues after it, so that a capture on the same
computer never waits. Merge and pair write into the session; the model and the year are in its
folder watch/, separate from the user's own.
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
from typing import Literal, NamedTuple

import psutil

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable, parse_utc, utc_text
from fieldlum.session import Session, codec
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import Sidecar, newest_sidecar

# Nothing is computed this long before a slot, in which the camera wakes up. Chosen.
QUIET_BEFORE_S = 90.0
ANSWER_EVERY = timedelta(hours=6)  # fitting takes minutes: at most a few times a day; chosen
MIN_CAPTURES = 8  # with fewer, no glare class can be excluded; chosen
_MAIN = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
PROGRAM = (sys.executable, "-c", _MAIN)


class Moment(NamedTuple):
    """The present state of a capture, which decides whether there is time to compute.

    is_quiet: whether no bracket is running, none begins within 90 s, and time is not simulated.
    captured: number of complete slots.
    """

    is_quiet: bool
    captured: int


@dataclass(slots=True)
class Worker:
    """Runs merge, pair, train and predict of a session in a thread, while no slot is near.

    moment: returns the present state of the capture; it is called in the thread. weather: path of a
    weather file, or "synthetic". program: words of the command line that start fieldlum;
    look_every_s: pause before the thread looks for new work again. State, which other threads may
    read: problem: error of the last step, or ""; step: name of the command that is running, or "".
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
    _merged_at: int = -1  # number of complete slots at the last merge
    _answered_at: int = -1  # the same at the last training

    @property
    def folder(self) -> Path:
        """The session's folder watch/, with the model, the predicted year and error texts."""
        return self.session.root / "watch"

    def start(self) -> None:
        """Start the thread, which calls `work` again and again, and return at once."""
        self._thread = threading.Thread(target=self._loop, name="answer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Kill the running command, and wait up to 20 s for the thread to end."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(20.0)

    def _loop(self) -> None:
        """Look for work until `close`; the thread runs this."""
        while not self._stop.wait(self.look_every_s):
            with suppress(OSError):  # a share that is away: look again later
                self.work()

    def work(self) -> None:
        """Merge and pair new brackets if no slot is near; then train and predict if it is time.

        It is time if 8 or more slots are captured, slots were captured since the last training of
        this process, and the last predicted year is 6 or more hours old or missing. It returns
        after the last command, which is paused near slots. An error of a command is not raised but
        stored in `problem`. Raises OSError if a folder cannot be written or read.
        """
        now = self.moment()
        if not now.is_quiet or now.captured == 0:
            return
        if now.captured != self._merged_at:
            root = str(self.session.root)
            # With the options that the user chose, so that `merge` does not repeat finished work.
            before = newest_sidecar(self.session)
            options = () if before is None else _merge_options(before)
            succeeded = self._run("merge", root, "--scheduler", "processes:1", *options)
            succeeded = succeeded and self._run("pair", root)
            if not self._stop.is_set():
                self._merged_at = now.captured
            if not succeeded:
                return
        if now.captured != self._answered_at and now.captured >= MIN_CAPTURES:
            last = read_answer(self.session)
            if last is None or datetime.now(UTC) - parse_utc(last["t_utc"]) >= ANSWER_EVERY:
                self._answer(now.captured)

    def _answer(self, captured: int) -> None:
        """Train a model and predict a year with it; captured: number of complete slots."""
        root, model, annual = str(self.session.root), self.folder / "model", self.folder / "annual"
        if self._run("train", root, "--model", "transport", "--out", str(model)):
            self._run("predict", str(model), "--weather", self.weather, "--out", str(annual))
        if not self._stop.is_set():
            self._answered_at = captured

    def _run(self, name: str, *arguments: str) -> bool:
        """Run the command `name` at the lowest priority and return whether it succeeded.

        The command is paused while a slot is near. Its last line on stderr becomes `problem` if it
        fails.
        """
        if self._stop.is_set():
            return False
        self.folder.mkdir(exist_ok=True)
        self.step = name
        messages = self.folder / f"{name}.err"
        threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        env = {**os.environ, **dict.fromkeys(threads, "1")}
        how: JsonTable = {"env": env, "start_new_session": True}
        how |= dict.fromkeys(("stdin", "stdout"), subprocess.DEVNULL)
        try:
            messages.unlink(missing_ok=True)  # a link of this name would lead elsewhere
            with messages.open("xb") as stderr:
                process = psutil.Popen([*self.program, name, *arguments], stderr=stderr, **how)
                with suppress(psutil.Error):  # 19 is the lowest priority of POSIX
                    process.nice(getattr(psutil, "IDLE_PRIORITY_CLASS", 19))
                code = self._wait_with_pauses(process)
        finally:
            self.step = ""
        if code == 0:
            self.problem = ""
        elif not self._stop.is_set():
            lines = messages.read_text("utf-8", "replace").strip().splitlines()
            self.problem = (lines or [f"{name}: exit code {code}"])[-1][:400]
        return code == 0

    def _wait_with_pauses(self, process: psutil.Popen) -> int | None:
        """Wait until a process ends, pause it near slots, and return its exit code.

        `close` kills it.
        """
        is_paused = False
        while True:
            with suppress(psutil.TimeoutExpired, subprocess.TimeoutExpired):
                return process.wait(min(self.look_every_s, 1.0))
            if self._stop.is_set():
                _signal_tree(process, "kill")
                return process.wait()
            if self.moment().is_quiet == is_paused:
                _signal_tree(process, "resume" if is_paused else "suspend")
                is_paused = not is_paused


def _signal_tree(process: psutil.Popen, action: Literal["kill", "suspend", "resume"]) -> None:
    """Kill, suspend or resume a process and its children; those that have ended are skipped."""
    with suppress(psutil.Error):
        for member in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                getattr(member, action)()


def read_answer(session: Session) -> JsonTable | None:
    """Return what `Worker` predicted last, as JSON for the page; None if a file cannot be used.

    The files are in the session's folder watch/. t_utc: time at which the year was written;
    captures: number of captures from which its model was trained; weather: name of its weather;
    synthetic: whether this is a synthetic year; warnings: texts; protection: a `DirectionYear` for
    each view direction.
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
        "protection": codec.to_json(year.protection),
    }


def answer_table(session: Session, worker: Worker | None) -> JsonTable:
    """Return the last answer and what is computed now, as JSON for the page.

    Keys: last: `read_answer`; computes: whether this process has a worker; step: name of the
    running command or ""; problem: error of the last step or ""; least_captures: number that an
    answer needs. worker: None if this process computes nothing.
    """
    step, problem = (worker.step, worker.problem) if worker else ("", "")
    doing = {"computes": worker is not None, "step": step, "problem": problem}
    return {"last": read_answer(session), **doing, "least_captures": MIN_CAPTURES}


def _merge_options(sidecar: Sidecar) -> tuple[str, ...]:
    """Return the options of `fieldlum merge` with which a bracket was merged: size and fit."""
    height, fit = sidecar.inputs.get("height"), sidecar.inputs.get("fit")
    size = ("--size", f"{2 * height}x{height}") if isinstance(height, int) else ()
    return size if fit is None else (*size, "--fit" if fit else "--no-fit")
