"""Simulate an SPN1: the answers of the instrument, with noise and delay."""

from __future__ import annotations

import numpy as np

from fieldlum.core.records import IrradianceSample
from fieldlum.devices import InstrumentInfo
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated.world import World
from fieldlum.devices.spn1 import agreed_sample

TIME_CONSTANT_S = 0.1  # the SPN1 reaches 95 % within 200 ms (User Manual)


class SimulatedSpn1:
    """An SPN1 under a simulated sky; implements `Pyranometer`.

    noise_wm2 : standard deviation of its noise [W/m2], drawn by `seed`. Its answers have the form
    of the instrument's, and are read like those.
    """

    def __init__(self, world: World, clock: Clock, seed: int, noise_wm2: float) -> None:
        self._world, self._clock, self._noise_wm2 = world, clock, noise_wm2
        self._rng = np.random.default_rng([seed, 1])
        self._shown: np.ndarray | None = None
        self._shown_at = 0.0
        serial, gives = f"A{100 + seed % 900}", ("ghi", "dhi")
        self.info = InstrumentInfo("spn1", "Delta-T SPN1", serial, gives=gives, guard="asked twice")

    def read(self) -> IrradianceSample:
        """Return a reading on which two answers agree."""
        return agreed_sample(self._clock.now(), self.answer)

    def answer(self) -> bytes:
        """Return the instrument's answer to the command S, without the echo."""
        now, light = self._clock.boottime(), self._world.irradiance(self._clock.now())
        level = np.array([light.ghi_wm2, light.dhi_wm2])
        if self._shown is not None:
            late = np.exp(-max(now - self._shown_at, 0.0) / TIME_CONSTANT_S)
            level = late * self._shown + (1.0 - late) * level
        self._shown, self._shown_at = level, now
        total, diffuse = np.maximum(level + self._rng.normal(0.0, self._noise_wm2, 2), 0.0)
        # SPN1 User Manual, p. 20: sunshine where the beam is over 120 W/m2.
        sunshine = total > 1.35 * diffuse and total > 24.0
        return b"%6.1f,%6.1f,%d\r" % (total, diffuse, sunshine)

    def close(self) -> None:
        """Do nothing: no port is open."""
