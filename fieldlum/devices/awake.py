"""Keep this computer awake while a capture runs, by a lock of systemd-logind."""

import select
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

# A closed lid needs a lock of its own. If it is refused (for example in a remote login), the other
# two locks are still requested.
_WHAT = ("sleep:idle:handle-lid-switch", "sleep:idle")
_PATIENCE_S = 5.0  # for an answer of the lock's process


@contextmanager
def kept_awake() -> Iterator[str]:
    """Keep the computer awake inside the `with` block; yield the names of the granted locks.

    The names are those of systemd, joined by colons (``sleep:idle:handle-lid-switch``), or "" if no
    lock was granted. The lock ends with this process, even after a crash.
    """
    with ExitStack() as processes:
        yield next((what for what in _WHAT if _is_granted(what, processes)), "")


def _is_granted(what: str, processes: ExitStack) -> bool:
    """Start `cat` under the lock, until `processes` closes; return whether the lock is granted.

    The process answers once the lock is granted, and ends when this process ends.
    """
    command = ["systemd-inhibit", f"--what={what}", "--who=fieldlum", "--why=captures are planned"]
    pipe = subprocess.PIPE
    pipes: dict[str, Any] = {"stdin": pipe, "stdout": pipe, "stderr": subprocess.DEVNULL}
    with suppress(OSError):
        process = subprocess.Popen([*command, "cat"], bufsize=0, start_new_session=True, **pipes)
        processes.enter_context(process)
        processes.callback(process.kill)
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(b"?\n")
        answered = select.select([process.stdout], [], [], _PATIENCE_S)[0]
        return bool(answered) and process.stdout.read(2) == b"?\n"
    return False
