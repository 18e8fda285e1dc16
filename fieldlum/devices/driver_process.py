"""Run a driver in its own process, which is killed if it hangs and restarted after a crash.

The child process runs `serve(pipe)`: it receives (command, arguments) and answers ("ok", result),
("error", text), or ("full", errno) for a full disk, which is not the device's fault.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from fieldlum.core.errors import DeviceError
from fieldlum.session import disk_is_full

Serve = Callable[[Connection], None]


def failure(error: Exception) -> tuple[str, Any]:
    """Return the child's answer to an exception: ("full", errno) or ("error", text)."""
    return (
        ("full", error.errno)
        if isinstance(error, OSError) and disk_is_full(error)
        else ("error", str(error))
    )


class Child:
    """A child process that starts with the first command and runs one command at a time.

    name : for errors; serve : function that the child runs; starts : number of times that it was
    started. The next command after its end starts it again.
    """

    def __init__(self, name: str, serve: Serve) -> None:
        self._name, self._serve = name, serve
        self._lock = threading.Lock()
        self._process: Any = None
        self._pipe: Connection | None = None
        self.starts = 0

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.is_alive()

    def ask(self, command: str, *arguments: Any, timeout_s: float) -> Any:
        """Send a command to the child and return its answer.

        Raises DeviceError if the child reports an error, dies, or does not answer within
        `timeout_s` (it is then killed); OSError if the child found the disk full.
        """
        with self._lock:
            pipe = self._ready()
            try:
                pipe.send((command, arguments))
                if not pipe.poll(timeout_s):
                    self._kill()
                    raise DeviceError(
                        f"{self._name}: '{command}' did not answer within {timeout_s:g} s "
                        "and its process was killed; check cable and battery"
                    )
                kind, result = pipe.recv()
            except (EOFError, OSError):
                code = self._kill(grace_s=5.0)  # the process is ending, so wait for its exit code
                why = (
                    f"signal {signal.Signals(-code).name}"
                    if code is not None and code < 0
                    else f"exit code {code}"
                )
                raise DeviceError(
                    f"{self._name}: the driver crashed in '{command}' ({why}); check cable and "
                    "battery, then run the command again"
                ) from None
        if kind == "full":
            raise OSError(result, os.strerror(result))
        if kind == "error":
            raise DeviceError(f"{self._name}: {result}")
        return result

    def _ready(self) -> Connection:
        if self._pipe is None or not self.alive:
            self._kill()
            # Never fork, because neither libusb nor threads survive it.
            context = multiprocessing.get_context("spawn")
            ours, theirs = context.Pipe()
            self._process = context.Process(
                target=self._serve, args=(theirs,), daemon=True, name=self._name
            )
            self._process.start()
            theirs.close()
            self._pipe, self.starts = ours, self.starts + 1
        return self._pipe

    def _kill(self, grace_s: float = 0.1) -> int | None:
        """End the process and return its exit code."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._process is None:
            return None
        self._process.join(grace_s)
        if self._process.is_alive():
            self._process.kill()
        self._process.join(5.0)
        code = self._process.exitcode
        with suppress(ValueError):
            self._process.close()
        self._process = None
        return code

    def close(self, timeout_s: float = 3.0) -> None:
        """Tell the child to end, and kill it if it still runs after `timeout_s`."""
        with self._lock:
            if self._pipe is not None and self.alive:
                with suppress(OSError, EOFError):
                    self._pipe.send(("close", ()))
                    self._process.join(timeout_s)
            self._kill()
