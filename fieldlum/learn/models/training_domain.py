"""Decide whether an hour's light is like captured light; used for models without a variance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.sky.light import Light

# with less direct light the sun lights a room less than the sky does; not measured
SUNNY_WM2 = 60.0
# About 50 minutes of the sun's path, or three weeks of its declination near an equinox. Chosen.
SUN_GAP_DEG = 12.0
RANGE_SLACK = 0.15  # of the captured range of diffuse irradiance; not measured


class DomainTable(TypedDict):
    """The domain in config.json; the keys are the fields of `Domain`."""

    sun_directions: list[list[float]]
    dhi_wm2: list[float]
    dni_wm2: list[float]


@dataclass(frozen=True, slots=True)
class Domain:
    """The range of light in the captures of a model.

    sun_directions: unit vectors to the sun in captures with a DNI of 60 W/m2 or more [k, 3];
    dhi_wm2, dni_wm2: least and greatest diffuse horizontal and direct normal irradiance of all
    captures.
    """

    sun_directions: Floats
    dhi_wm2: tuple[float, float]
    dni_wm2: tuple[float, float]

    def holds(self, light: Light) -> Mask:
        """Return a mask [n], True for the hours of `light` that are similar to captured light.

        Diffuse irradiance must be in the captured range, widened by 15 % and 10 W/m2. In addition,
        the sun must be within 12 degrees of that of a sunny capture and its DNI at most 15 % and
        10 W/m2 above the captured maximum; or the DNI must be below 60 W/m2, if the least captured
        DNI is below 120 W/m2.
        """
        low, high = self.dhi_wm2
        slack = RANGE_SLACK * (high - low) + 10.0
        sky_known = (light.dhi_wm2 >= low - slack) & (light.dhi_wm2 <= high + slack)
        beam_known = light.dni_wm2 <= self.dni_wm2[1] + RANGE_SLACK * self.dni_wm2[1] + 10.0
        has_overcast = self.dni_wm2[0] < 2 * SUNNY_WM2
        return sky_known & (
            self._sun_known(light) & beam_known | (light.dni_wm2 < SUNNY_WM2) & has_overcast
        )

    def _sun_known(self, light: Light) -> Mask:
        if len(self.sun_directions) == 0:
            return np.zeros(len(light.dni_wm2), bool)
        nearest = (light.sun_direction @ self.sun_directions.T).max(axis=1)
        return nearest >= np.cos(np.radians(SUN_GAP_DEG))

    def state(self) -> DomainTable:
        """Return the domain as an object that JSON can store."""
        return {
            "sun_directions": np.round(self.sun_directions, 5).tolist(),
            "dhi_wm2": list(self.dhi_wm2),
            "dni_wm2": list(self.dni_wm2),
        }

    @staticmethod
    def from_state(state: DomainTable) -> Domain:
        """Return the domain that the method `state` described.

        Raises KeyError, TypeError or ValueError for other content.
        """
        dhi_low, dhi_high = map(float, state["dhi_wm2"])
        dni_low, dni_high = map(float, state["dni_wm2"])
        suns = np.asarray(state["sun_directions"], float).reshape(-1, 3)
        return Domain(suns, (dhi_low, dhi_high), (dni_low, dni_high))


def captured(light: Light) -> Domain:
    """Return the domain of the captures whose light is `light`."""
    sunny = light.dni_wm2 >= SUNNY_WM2
    return Domain(
        light.sun_direction[sunny],
        (float(light.dhi_wm2.min()), float(light.dhi_wm2.max())),
        (float(light.dni_wm2.min()), float(light.dni_wm2.max())),
    )
