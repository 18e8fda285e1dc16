"""Compare a guess with the sky that the camera sees: window edges, buildings and trees outside."""

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.optics.projection import direction
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.renderer import sky_openness
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sun import OBLIQUITY_DEG, celestial_pole

# Directions on the upper half of the sphere, on a spiral of equal areas: 1.3 degrees apart. Chosen.
RAYS, GOLDEN_DEG = 12000, 180.0 * (3.0 - 5**0.5)
MARGIN_DEG = 1.0  # from the stated edges of a window: 5 cm of a tape at 3 m
# Openness from which a direction is open, and below which something is before the sky; largest
# standard uncertainty of openness that counts. Chosen.
OPEN, SHUT, MAX_U = 0.85, 0.5, 0.3


@dataclass(frozen=True)
class Skyline:
    """The sky in directions that the camera sees through the stated windows.

    rays [s, 3]: unit vectors, x east, y north, z up by the stated heading; openness [s]: share of
    the sky that is seen there, 0 to 1; spread: size of a pixel of the sky view, rad.
    """

    rays: Floats32
    openness: Floats32
    spread: float

    def error(self, guess: Guess) -> Floats32:
        """Return the guess's openness less the seen one, times the root of a ray's share, [s].

        The share is of the full sphere, so that a direction counts as much as a pixel.
        """
        shown = sky_openness(guess, self.rays, self.spread)
        return np.float32(np.sqrt(0.5 / RAYS)) * (shown - self.openness)


def skyline_of(view: SkyView | None, guess: Guess, latitude_deg: float) -> Skyline:
    """Return the skyline that a sky view shows inside the windows of the stated guess.

    Without a view it has no directions. A direction without open sky is omitted in two cases,
    because it does not show a building. First: it is at least as high as something that hangs above
    open sky in the same window, such as a blind, a canopy or a crown, and that the guess does not
    have. Second: the sun is there on no day of the year, and merge stored no luminance
    (transmittance 0 in the view). latitude_deg: of the place.
    """
    k = np.arange(RAYS) + 0.5
    rays = direction(np.degrees(np.arcsin(k / RAYS)), GOLDEN_DEG * k % 360.0).astype(np.float32)
    spread, kept, openness = 0.0, np.zeros(RAYS, bool), np.zeros(RAYS, np.float32)
    # a margin of a degree; that of merge is 3.4 degrees
    sun_passes = abs(rays @ celestial_pole(latitude_deg)) < np.sin(np.radians(OBLIQUITY_DEG + 1.0))
    if view is not None:
        inside, row, column = view.grid.indices(rays)
        known = np.where(view.u < MAX_U, view.openness, np.float32(np.nan))
        below = np.logical_or.accumulate((known > OPEN)[::-1])[::-1]  # open there or below
        openness = np.where(inside, known[row, column], np.float32(np.nan))
        spread = np.radians(view.grid.step_deg)
        margin = 2.0 * np.radians(MARGIN_DEG) + spread
        clear = sky_openness(guess, rays, margin) > OPEN  # of bars and solids that are stated
        for rect in guess.windows:
            alone = replace(guess, windows=(rect,), solids=(), bars=())
            glass = sky_openness(alone, rays, margin) > 0.99  # the margin is half a soft edge
            hangs = glass & clear & (openness < SHUT) & below[row, column]
            lowest = rays[hangs, 2].min(initial=1.0)
            decided = (rays[:, 2] < lowest) & (sun_passes | (view.transmittance[row, column] > 0.0))
            kept |= glass & (openness >= np.where(decided, 0.0, OPEN))
    return Skyline(rays[kept], openness[kept], spread)
