"""Find the captures with direct sun on a window, from which a scene can be fitted and judged."""

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Room
from fieldlum.learn.models.training_data import Dataset
from fieldlum.sky.light_similarity import facades_of

# Least number of sunny hours: with every third held out, four hours are left to fit. Chosen.
MIN_SUNNY_HOURS = 6
# Chosen, not measured: below this altitude, refraction and horizon are uncertain.
_LOWEST_SUN_DEG = 2.0
# Share of the strongest direct sun on a window; hours with less teach a fit little. Chosen, not
# measured.
_STRONGEST_SHARE = 0.1
# Direct normal irradiance of sunshine: WMO-No. 8, Guide to Instruments and Methods of Observation,
# volume I, 8.1.1 (definition of sunshine duration).
SUNSHINE_WM2 = 120.0


def direct_on_windows_lx(data: Dataset, room: Room | None) -> Floats:
    """Return the direct illuminance of the window plane that has most, for each of n hours, [n] lx.

    It is 0 for a sun lower than 2 degrees. Without a box room with windows, the planes are eight
    vertical ones, every 45 degrees.
    """
    light = data.light
    cosine = np.maximum(light.apparent_sun_direction @ facades_of(room).normals.T, 0.0).max(axis=1)
    return np.where(light.sun_altitude_deg < _LOWEST_SUN_DEG, 0.0, cosine * light.direct_lx)


def sunny_hours(data: Dataset, room: Room | None) -> Mask:
    """Return a mask [n], True for hours with strong direct sun on the plane of a window.

    Without a box room with windows, the planes are eight vertical ones, every 45 degrees. Strong is
    over a tenth of the strongest hour. On overcast days this can be a faint sun: if fewer than six
    of the strong hours have sunshine (direct irradiance of at least 120 W/m2), only those with
    sunshine are True.
    """
    direct_lx = direct_on_windows_lx(data, room)
    strong = direct_lx > _STRONGEST_SHARE * max(float(direct_lx.max(initial=0.0)), 1.0)
    sunshine = data.light.dni_wm2 >= SUNSHINE_WM2
    return strong if (strong & sunshine).sum() >= MIN_SUNNY_HOURS else strong & sunshine
