"""Scale light that was computed for the stated room to the captures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Array, Floats32, Indices
from fieldlum.learn.transport.features import TrainingArrays, pixel_scale

# Computed light has no meaning below; far under that of any wall by day. Chosen.
LEAST_COMPUTED_CDM2 = 1e-3
# Largest gain of a pixel's computed light over the median of all pixels; chosen: black to white
MOST_GAIN = 20.0


@dataclass(frozen=True, slots=True)
class ComputedLight:
    """Luminance that was computed for the room in SITE.toml, at n hours and P pixels.

    luminance: of surfaces, without direct sun on them [n, P] cd/m2; gain: captured over computed
    luminance of each pixel, 0 at window pixels [P]; perez: the same as `luminance`, but under
    Perez's skies [n, P] cd/m2. It is None if `luminance` is already under Perez's skies, and set if
    `luminance` is under the skies that captures show through the windows.
    """

    luminance: Floats32
    gain: Array
    perez: Floats32 | None = None

    def __getitem__(self, pixels: Indices | slice) -> ComputedLight:
        """Return the computed light of the selected pixels, at all hours."""
        perez = None if self.perez is None else self.perez[:, pixels]
        return ComputedLight(self.luminance[:, pixels], self.gain[pixels], perez)

    def under_perez(self) -> ComputedLight:
        """Return the light under Perez's skies, with the same gains."""
        return self if self.perez is None else ComputedLight(self.perez, self.gain)


def computed_light(arrays: TrainingArrays, open_sky: Indices, luminance: Floats32) -> ComputedLight:
    """Return the computed luminance [n, P] cd/m2, with the gain of each pixel from the captures.

    The gain is captured over computed luminance, limited to a factor of 20 below or above the
    median of all pixels. open_sky: indices of the window pixels, whose gain is 0.
    """
    gain = pixel_scale(arrays, np.maximum(luminance, np.float32(LEAST_COMPUTED_CDM2)))
    middle = np.median(gain)
    gain = np.clip(gain, middle / MOST_GAIN, middle * MOST_GAIN)
    gain[open_sky] = 0.0
    return ComputedLight(luminance, gain)
