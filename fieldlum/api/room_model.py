"""A fitted model with its room: what `predict` computes, as xarray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.sky.light import Light

if TYPE_CHECKING:
    import xarray as xr

    from fieldlum.learn.models import Fitted
    from fieldlum.year.predict.blocks import ModelRoom


@dataclass(frozen=True, slots=True, repr=False)
class RoomModel:
    """A model of a room: `predict` gives maps, `glare` their figures, as the command `predict`.

    fitted: the model itself; room: its site, mirrors and sky view.
    """

    fitted: Fitted
    room: ModelRoom

    @property
    def name(self) -> str:
        """Name of the kind of model, such as "transport"."""
        return self.fitted.name

    @property
    def parameters(self) -> int:
        """Number of fitted values."""
        return self.fitted.parameters

    def __repr__(self) -> str:
        room = self.room
        return (
            f"<model {self.name} of {room.setup.site.name}: {self.parameters:,} parameters, maps "
            f"of {room.width} x {room.height} px, heading {room.heading_deg:g} deg>"
        )

    def predict(self, light: Light) -> xr.Dataset:
        """Return maps over (time, y, x), with altitude y and azimuth x in degrees.

        Variables: luminance_cdm2 without the sun's disc, log10_sd (its standard deviation) where
        the model states it, and over time disc_lx (illuminance of the visible disc on a plane
        normal to the sun), the place of the sun in the picture, trusted and expected_log10_mse.
        Memory grows with the number of hours: 0.4 MB for one at 460 x 230.
        """
        import xarray as xr

        from fieldlum.year.predict.annual import unit_of
        from fieldlum.year.predict.blocks import blocks, map_coordinates

        parts = list(blocks(self.fitted, self.room, self._checked(light)))
        heading_deg = self.room.heading_deg
        maps = {"luminance_cdm2": [part.pictures_cdm2(heading_deg) for part in parts]}
        spreads = [part.prediction.log10_sd for part in parts]
        if not any(spread is None for spread in spreads):
            maps["log10_sd"] = [spread for spread in spreads if spread is not None]
        hours = {
            "disc_lx": [part.disc_lx for part in parts],
            "sun_altitude_deg": [light.apparent_altitude_deg],
            "sun_azimuth_deg": [light.sun_azimuth_deg],
            "trusted": [part.trusted for part in parts],
            "expected_log10_mse": [part.prediction.expected_mse for part in parts],
        }
        over = dict.fromkeys(maps, ("time", "y", "x")) | dict.fromkeys(hours, ("time",))
        variables = {
            name: (over[name], np.concatenate(values), {"units": unit_of(name)})
            for name, values in (maps | hours).items()
        }
        return xr.Dataset(
            variables,
            coords=map_coordinates(light.t_utc, self.room.height, heading_deg),
            attrs={"heading_deg": heading_deg, "site": self.room.setup.site.name},
        )

    def glare(self, light: Light, views: int = 10) -> xr.Dataset:
        """Return all metrics of glare over (time, azimuth), with the sun's disc.

        dgp_low and dgp_high are the 95 % interval, as the command has it: by the model's error, by
        unseen parts of the view, and by what the sky view leaves open about the disc; u_dgp is its
        standard uncertainty. views: number of view directions, evenly around from the model's
        heading.
        """
        from fieldlum.year.glare.sources import view_azimuths_deg
        from fieldlum.year.predict.annual import dataset_of
        from fieldlum.year.predict.blocks import room_figures

        azimuths_deg = view_azimuths_deg(self.room.heading_deg, views)
        found = room_figures(self.fitted, self.room, self._checked(light), azimuths_deg)
        hours = {name: v for name, v in found.hours.items() if name != "occupied"}
        figures = {name: v for name, v in found.views.items() if name not in _PARTS}
        return dataset_of(light.t_utc, azimuths_deg, hours, figures)

    @staticmethod
    def _checked(light: Light) -> Light:
        if not isinstance(light, Light) or not len(light):
            expected = "one hour or more from fieldlum.light_at"
            raise InputError("light", f"{light!r:.60}", expected, "call it first")
        return light


def load(folder: Path) -> RoomModel:
    """Read a model folder; the errors are those of `fieldlum.learn.models.load` and `room_of`."""
    from fieldlum.learn.models import load, read_config
    from fieldlum.year.predict.blocks import room_of

    return RoomModel(load(folder), room_of(read_config(folder), folder))


_PARTS = ("contrast", "sun_contrast", "sun_ev_lx")  # of DGP; no metrics
