"""Run the user's command after slots in a row gave no bracket."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fieldlum.capture.alerts import MISSES_IN_A_ROW
from fieldlum.capture.recorder import Recorder
from fieldlum.session.ledger import SlotState

_HOOK_TIMEOUT_S = 300.0  # the time until the next slot is usually longer; not measured


@dataclass(slots=True)
class MissedHook:
    """Counts slots in a row without a bracket; runs `command`, if not empty, after the second.

    command: run by the shell in `folder`; recorder: receives events about it.
    """

    command: str
    folder: Path
    recorder: Recorder
    _misses: int = 0

    def count(self, slot: str, state: SlotState) -> None:
        """Count slots in a row that were not done; at the second, run the command in a thread.

        Environment variables FIELDLUM_SLOT, _OUTCOME, _REASON and _SESSION describe the slot.
        """
        self._misses = 0 if state.outcome == "done" else self._misses + 1
        if self._misses != MISSES_IN_A_ROW or not self.command:
            return
        self.recorder.tell("hook", command=self.command)
        about = {
            "FIELDLUM_SLOT": slot,
            "FIELDLUM_OUTCOME": state.outcome,
            "FIELDLUM_REASON": state.why,
            "FIELDLUM_SESSION": str(self.folder.resolve()),
        }
        arguments = (self.command, self.folder, about, self.recorder.tell)
        threading.Thread(target=_run_hook, args=arguments, daemon=True).start()


def _run_hook(
    command: str, folder: Path, about: dict[str, str], tell: Callable[..., object]
) -> None:
    """Run the user's command for missed slots, and journal a failure of it.

    Environment variables state the slot, its outcome, the reason and the session's folder.
    """
    try:
        code = subprocess.run(
            command,
            shell=True,
            cwd=folder,
            env={**os.environ, **about},
            timeout=_HOOK_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
            check=False,
        ).returncode
        why = f"exit code {code}" if code else ""
    except (OSError, subprocess.SubprocessError) as error:
        why = type(error).__name__
    if why:
        tell("hook-failed", why=why)
