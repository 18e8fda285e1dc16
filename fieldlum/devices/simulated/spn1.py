"""Simulate an SPN1 on a pseudo-terminal: the instrument's answers, noise and delay."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from fieldlum.core.errors import DeviceError
from fieldlum.devices import Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated.world import SimulatedLight, World

TIME_CONSTANT_S = 0.1  # the SPN1 reaches 95 % within 200 ms (User Manual)
_STATUS = b"SPN1 v1.03 Mar 13 2007\rUnits: W.m-2\r1mV radio off\rA%d\r"


class PtyInstrument(threading.Thread):
    """A thread that answers like an instrument on a pseudo-terminal; `port` is its device file.

    answer : returns the reply to each group of bytes received. The pty stays open until `unplug`,
    so that a client may close and open it.
    """

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        import tty

        super().__init__(name="simulated instrument", daemon=True)
        self._answer = answer
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._ours)
        tty.setraw(self._theirs)
        self.port = os.ttyname(self._theirs)
        self._wake_read, self._wake_write = os.pipe()
        self.start()

    def run(self) -> None:
        """Answer until `unplug`."""
        while True:
            ready = select.select([self._ours, self._wake_read], [], [])[0]
            if self._wake_read in ready:
                return
            try:
                reply = self._answer(os.read(self._ours, 256))
                while reply:
                    reply = reply[os.write(self._ours, reply) :]
            except OSError:
                return

    def unplug(self) -> None:
        """Stop answering and close the pty."""
        with suppress(OSError):
            os.write(self._wake_write, b"x")
        self.join(timeout=2.0)
        for handle in (self._ours, self._theirs, self._wake_read, self._wake_write):
            with suppress(OSError):
                os.close(handle)


class Spn1Voice:
    """The replies of a simulated SPN1; called with the bytes of a client, it returns the answer.

    It answers R with 0xAF, S with an echo, total, diffuse and sunshine, I with an echo and its
    status, and other characters with a question mark.
    """

    def __init__(
        self,
        light: Callable[[], tuple[float, SimulatedLight]],
        rng: np.random.Generator,
        noise_wm2: float,
        serial: int,
    ) -> None:
        """Store the source of light.

        light : returns a time [s], which never decreases, and the irradiance at that time.
        """
        self._light, self._rng, self._noise_wm2, self._serial = light, rng, noise_wm2, serial
        self._shown: np.ndarray | None = None
        self._shown_at = 0.0

    def __call__(self, data: bytes) -> bytes:
        """Return the reply to some bytes of the client."""
        out = b""
        for byte in data:
            command = bytes([byte])
            if command == b"R":
                out += b"\xaf"
            elif command == b"S":
                out += b"S" + self._reading()
            elif command == b"I":
                out += b"I" + _STATUS % self._serial
            else:
                out += b"? \xaf"
        return out

    def _reading(self) -> bytes:
        now, light = self._light()
        level = np.array([light.ghi_wm2, light.dhi_wm2])
        if self._shown is not None:
            late = np.exp(-max(now - self._shown_at, 0.0) / TIME_CONSTANT_S)
            level = late * self._shown + (1.0 - late) * level
        self._shown, self._shown_at = level, now
        total, diffuse = np.maximum(level + self._rng.normal(0.0, self._noise_wm2, 2), 0.0)
        # SPN1 User Manual, p. 20: sunshine where the beam is over 120 W/m2.
        sunshine = total > 1.35 * diffuse and total > 24.0
        return b"%6.1f,%6.1f,%d\r" % (total, diffuse, sunshine)


def open_simulated(world: World, clock: Clock, seed: int, noise_wm2: float) -> Pyranometer:
    """Open a simulated SPN1 on a pseudo-terminal through the real driver.

    noise_wm2 : standard deviation of its noise [W/m2], drawn by `seed`. Raises DeviceError on a
    system without pseudo-terminals (Windows).
    """
    from fieldlum.devices.spn1 import Spn1

    if not hasattr(os, "openpty"):
        raise DeviceError(
            "sim: this system has no pseudo-terminals, which the simulated pyranometer needs; use "
            "Linux or macOS"
        )
    world.irradiance(clock.now())  # load the truth before the driver's timeout starts
    voice = Spn1Voice(
        lambda: (clock.boottime(), world.irradiance(clock.now())),
        np.random.default_rng([seed, 1]),
        noise_wm2,
        100 + seed % 900,
    )
    instrument = PtyInstrument(voice)
    try:
        return Spn1(instrument.port, clock, close_too=instrument.unplug)
    except DeviceError:
        instrument.unplug()
        raise
