"""Keep this computer awake while a capture runs, by a lock of systemd-logind."""

import select
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

# Locks of systemd, requested in this order until one set is granted. A remote login, for example,
# may not lock the lid's switch.
_LOCKS = ("sleep:idle:handle-lid-switch", "sleep:idle")
_PATIENCE_S = 5.0  # for an answer of the lock's process; chosen, not measured


@contextmanager
def kept_awake() -> Iterator[str]:
    """Keep the computer awake inside the `with` block; yield the names of the granted locks.

    The names are those of systemd, joined by colons (``sleep:idle:handle-lid-switch``), or "" if no
    lock was granted. The lock ends with this process, even after a crash.
    """
    with ExitStack() as processes:
        yield next((locks for locks in _LOCKS if _is_granted(locks, processes)), "")


def _is_granted(locks: str, processes: ExitStack) -> bool:
    """Return whether systemd grants some locks; hold them until `processes` closes.

    systemd-inhibit holds them while its command runs. The command is `cat`, which repeats a line
    once the locks are granted, and ends when this process ends and so closes its input.
    """
    command = ["systemd-inhibit", f"--what={locks}", "--who=fieldlum", "--why=captures are planned"]
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
