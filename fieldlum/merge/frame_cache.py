"""Hold the frames of one bracket in memory as linear signals, up to a given number of bytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.merge.estimator import Signal
from fieldlum.merge.frames import RawSignal
from fieldlum.merge.jpeg_signal import JpegSignal
from fieldlum.merge.shift import Small

# Enough for 18 JPEG frames of a 13-megapixel fisheye, or for 16 raw frames of 24 megapixels.
# Together with the sums this takes about 1.5 GB. Chosen; other frames are read again in each pass.
FRAMES_BYTES = 800_000_000


class FrameStore:
    """Frames of a bracket, read when they are first needed; `store[i]` returns frame i, from 0.

    loaders: functions that read one frame each, most exposed first. A frame stays in memory if it
    fits in `budget_bytes` together with those before; otherwise it is read again at each access.
    """

    def __init__(
        self, loaders: Sequence[Callable[[], Signal]], budget_bytes: int = FRAMES_BYTES
    ) -> None:
        self._loaders, self._left = loaders, budget_bytes
        self._kept: dict[int, Signal] = {}
        self._scale, self._noise = np.ones(len(loaders)), (1.0, 1.0)

    def __len__(self) -> int:
        return len(self._loaders)

    @property
    def resident(self) -> bool:
        """Whether every frame is in memory now, because it was read and fitted in the budget."""
        return len(self._kept) == len(self)

    def correct(self, factors: Floats) -> None:
        """Multiply the assumed exposures by factors [frames], and so the counts per cd/m2.

        This applies to stored frames and to later reads.
        """
        self._scale = self._scale * factors
        self._kept = {i: _scaled(signal, float(factors[i])) for i, signal in self._kept.items()}

    def noisier(self, shot: float, read: float) -> None:
        """Multiply the variances of shot noise and of read noise by `shot` and by `read`.

        Only for raw frames. This applies to frames in memory and to later reads.
        """
        self._noise = shot, read
        self._kept = {i: _with_noise(signal, shot, read) for i, signal in self._kept.items()}

    def small(self, number: int) -> Small:
        """Return frame `number`, from 0, at a reduced size to detect turns of the camera."""
        signal = self[number]
        assert isinstance(signal, RawSignal | JpegSignal)
        return signal.small()

    def __getitem__(self, number: int) -> Signal:
        if number in self._kept:
            return self._kept[number]
        signal = _with_noise(
            _scaled(self._loaders[number](), float(self._scale[number])), *self._noise
        )
        size = getattr(signal, "counts", getattr(signal, "codes", np.empty(0))).nbytes
        if size <= self._left:
            self._left -= size
            self._kept[number] = signal
        return signal


def _scaled(signal: Any, factor: float) -> Any:
    return replace(signal, per_cdm2=(signal.per_cdm2 * np.float32(factor)).astype(np.float32))


def _with_noise(signal: Any, shot: float, read: float) -> Any:
    if shot == read == 1.0:
        return signal
    return replace(
        signal, gain_e_per_dn=signal.gain_e_per_dn / shot, noise_dn2=signal.noise_dn2 * read
    )
