"""Weigh captured hours by how well their irradiance was measured, for fits and for choices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.arrays import Array, Floats, Mask

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset
    from fieldlum.sky.light import Light

# lowest sun for which horizontal readings give the sun's normal irradiance; chosen
LOWEST_SUN_DEG = 1.0
# At a lower sun, closure divides by less than 0.05, so that 2 W/m2 in the horizontal become 40 W/m2
# in the normal; sun.dni_by_closure gives 0 under 2 degrees. Chosen.
UNMEASURED_SUN_DEG = 3.0
UNMEASURED_VARIANCE = 1.0  # relative variance: such a sun may give as much light as the sky; chosen
UNSURE = 1e-2  # relative variance of an hour or a pixel that has half weight; not measured
READING_WM2 = 2.0  # error of a horizontal reading: a pyranometer's zero offset (ISO 9060, class A)
# As `pair` marks it: under 5 degrees 2 W/m2 in the horizontal are 23 W/m2 and more in the normal.
LOW_SUN_DEG = 5.0
BEAM_WM2 = 20.0  # DNI of an overcast hour, within the errors of two horizontal readings; chosen
# Below this share of the hours, those that were not measured well are needed: at 62 degrees north
# all winter hours have a sun below 5 degrees. Chosen.
MIN_MEASURED_SHARE = 2.0 / 3.0
DOUBTED_WEIGHT = 0.25  # of an hour that is needed; half of the usual deviation; chosen


def sun_is_unmeasured(light: Light, direct: Array) -> Mask:
    """Return a mask [n], True where direct light is recorded as zero only because it is unmeasured.

    That is so if the sun is under 3 degrees and `direct` is zero or less. direct [n]: irradiance,
    illuminance or share of light of the sun.
    """
    return (light.sun_altitude_deg < UNMEASURED_SUN_DEG) & (direct <= 0.0)


def light_variance(data: Dataset) -> Array:
    """Return the relative variance of the irradiance, estimated from its own readings, [n].

    The range of the readings over the bracket (change or noise) counts as the width of a
    rectangular distribution (JCGM 100:2008, 4.3.7). The sun's normal irradiance is a difference of
    two horizontal readings divided by the sine of its altitude, and so are its errors. For a sun
    under 3 degrees the readings give no value: a direct irradiance of zero is then unknown, and 1
    is added.
    """
    light = data.light
    altitude = np.radians(np.maximum(light.sun_altitude_deg, LOWEST_SUN_DEG))
    variance = (data.steadiness / (np.sqrt(12.0) * np.sin(altitude))) ** 2
    unknown = sun_is_unmeasured(light, light.dni_wm2)
    return variance + np.where(unknown, UNMEASURED_VARIANCE, 0.0)


def weight_of_variance(variance: Floats) -> Floats:
    """Return 1 / (1 + variance / 0.01), the weight of values by their relative variance."""
    return 1.0 / (1.0 + variance / UNSURE)


def beam_is_doubted(data: Dataset) -> Mask:
    """Return a mask [n], True for hours whose direct light was not measured well.

    These are hours with a beam and a sun under 5 degrees, hours with an unmeasured sun, and those
    whose irradiance `pair` marked (`Dataset.doubted`).
    """
    light = data.light
    low = (light.sun_altitude_deg < LOW_SUN_DEG) & (light.dni_wm2 > BEAM_WM2)
    doubted = low | sun_is_unmeasured(light, light.dni_wm2)
    return doubted if data.doubted is None else doubted | data.doubted


def is_badly_measured(data: Dataset) -> Mask:
    """Return a mask [n], True for hours whose pictures cannot contradict their irradiance.

    Their beam is doubted, or two readings' errors exceed a tenth of the light.
    """
    light = data.light
    upwards = np.sin(np.radians(np.maximum(light.sun_altitude_deg, 0.0)))
    total_wm2 = light.dhi_wm2 + light.dni_wm2 * upwards
    return beam_is_doubted(data) | (UNSURE * total_wm2**2 < READING_WM2**2)


def choice_weights(data: Dataset) -> Floats:
    """Return the weights of hours in choices and warnings, 0 to 1, [n].

    Hours of a doubted beam have none. If fewer than two thirds of the hours would remain, they have
    a quarter instead. Unsteady light lowers the weight further.
    """
    doubted = beam_is_doubted(data)
    least = 0.0 if (~doubted).mean() >= MIN_MEASURED_SHARE else DOUBTED_WEIGHT
    steady = weight_of_variance(np.where(doubted, 0.0, light_variance(data)))
    return np.where(doubted, least, steady)
