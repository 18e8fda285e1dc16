"""Predict the maps of a year in blocks of hours, so that memory does not grow with the year."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, SiteFile, quiet
from fieldlum.learn.models import Fitted, Prediction, seen_of, trusted_hours
from fieldlum.learn.models.mirrors import Mirror, MirroredSun, read_mirrors
from fieldlum.room.scene import sun_patches
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.site_toml import site_from_table
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view import SkyView
from fieldlum.sky.sky_view.disc_in_view import disc_lx, disc_source
from fieldlum.sky.sky_view.view import NAME as SKY_VIEW
from fieldlum.sky.sun_disc import add_source

BLOCK = 64  # hours; about 30 MB for each map layer at 460 x 230; chosen


@dataclass(frozen=True, slots=True)
class HourBlock:
    """Consecutive hours of a year: the model's prediction with its uncertainty, and the sun.

    rows: the k hours in the light given to `blocks`; prediction: its maps [k, H, W] cd/m2 have no
    sun disc; disc_lx: illuminance of the disc as visible at the lens, on a plane normal to the sun
    [k] lx; images: of the sun, for each mirror of the room.
    """

    rows: slice
    light: Light
    prediction: Prediction
    disc_lx: Floats
    images: tuple[MirroredSun, ...] = ()

    def pictures_cdm2(self, heading_deg: float) -> Floats32:
        """Return the maps with the predicted mirror images of the sun, [k, H, W] cd/m2.

        Each image is one pixel; the sun's disc is not in the maps. heading_deg: azimuth of the
        centre column, clockwise from true north.
        """
        maps = self.prediction.luminance_cdm2
        for image in self.images:
            maps = add_source(maps, image.place_deg, image.shown_lx, heading_deg)
        return maps

    @property
    def trusted(self) -> Mask:
        """Mask [k]: True for hours whose maps are trusted.

        These are hours for which the model vouches, with an expected error factor of at most 1.2
        (or an unknown one), unless the captures do not decide whether a mirror shows the sun.
        """
        trusted = trusted_hours(self.prediction)
        for image in self.images:
            trusted &= ~image.doubtful
        return trusted


@dataclass(frozen=True, slots=True)
class ModelRoom:
    """Site and room for which a model was trained, the size of its maps, and mirrors of the sun.

    heading_deg: azimuth of the maps' centre column, clockwise from true north; needs_patch: whether
    the model needs maps of sun patches; seen [H, W]: True for pixels that a lens saw; sky_view: of
    the model's captures.
    """

    setup: SiteFile
    height: int
    width: int
    heading_deg: float
    needs_patch: bool
    # [H, W]; None if all pixels were seen, or for a model of 0.1.0
    seen: Mask | None = None
    mirrors: tuple[Mirror, ...] = ()
    sky_view: SkyView | None = None  # None for a model of an earlier version
    sky_view_file: str = ""  # name of a sky view in place of the model's

    @property
    def disc_from(self) -> str:
        """Text on how the disc's visibility is known."""
        return disc_source(self.sky_view, self.setup, self.sky_view_file)


def wants_patch(config: ModelConfig) -> bool:
    """Return whether the model in a config.json needs maps of sun patches.

    Without the key `with_patch`: a transport model (of 0.1.0) needs them if it has a patchwork,
    another model unless its `patch` is absent or "none".
    """
    state = config.state
    if "with_patch" in state:
        return bool(state["with_patch"])
    if "transport" in state:
        return state["transport"].get("patchwork") is not None
    return state.get("patch", "none") != "none"


def room_of(config: ModelConfig, folder: Path) -> ModelRoom:
    """Return the room of the model in `folder`.

    Raises InputError if the config lacks the site, size or heading, if the site or the mirrors are
    damaged, or if the model needs sun patches and the site has no room.
    """
    height, width, heading = config.height, config.width, config.heading_deg
    if height <= 0 or width <= 0 or heading is None or not config.setup:
        expected = "the site, size and heading of the model's pictures"
        raise InputError(folder / "config.json", "no such keys", expected, "train the model again")
    setup = site_from_table(config.setup, str(folder / "config.json"))
    if wants_patch(config) and setup.room is None:
        found = "the model needs sun patches, but its site has no [room]"
        remedy = "add [room] to the site and train again, or train with --patch none"
        raise InputError(folder, found, "a site with [room], or a model without patches", remedy)
    seen_mask = seen_of(folder)
    if seen_mask is not None and seen_mask.shape != (height, width):
        seen_mask = None  # `blocks` rejects the maps of such a model
    mirrors = read_mirrors(folder, config)
    view = SkyView.find(folder / SKY_VIEW)
    return ModelRoom(setup, height, width, heading, wants_patch(config), seen_mask, mirrors, view)


def blocks(
    fitted: Fitted,
    room: ModelRoom,
    light: Light,
    disc: Floats | None = None,
    *,
    progress: Progress = quiet,
) -> Iterator[HourBlock]:
    """Predict all hours of `light`, and yield them in blocks of 64; the last may be shorter.

    disc: illuminance of the sun's disc, normal to it [n] lx; None to compute it for the room.
    Raises InputError if the size of the maps differs from that in config.json, FloatingPointError
    for luminances that are not finite.
    """
    count, space = len(light), room.setup.room
    disc = disc_lx(room.sky_view, room.setup, light) if disc is None else disc  # [n]
    for start in range(0, count, BLOCK):
        rows = slice(start, min(start + BLOCK, count))
        part, patch = light[rows], None
        if room.needs_patch and space is not None:
            patch = sun_patches(
                space,
                part.shown_sun_direction,
                part.direct_lx,
                height=room.height,
                heading_deg=room.heading_deg,
            ).luminance_cdm2
        prediction = fitted.predict(part, patch)
        maps = prediction.luminance_cdm2
        if maps.shape[1:] != (room.height, room.width):
            expected = f"{room.width} x {room.height} pixels, as in its config.json"
            found = f"predicted maps of {maps.shape[2]} x {maps.shape[1]} pixels"
            raise InputError("the model", found, expected, "train the model again")
        if not np.isfinite(maps).all():
            raise FloatingPointError(
                f"hours {rows.start} to {rows.stop - 1}: predicted values that are not finite"
            )
        progress(rows.stop, count, "hours predicted")
        images = tuple(mirror.images(part, room.heading_deg) for mirror in room.mirrors)
        yield HourBlock(rows, part, prediction, disc[rows], images)
