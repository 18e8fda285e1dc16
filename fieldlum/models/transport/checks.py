"""What captures say about their own setting: is north right, and did something in the room change?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.light import Kernel
from fieldlum.models.transport.material import material_of, patch_flux
from fieldlum.models.transport.recipe import Recipe, basis_of, hold_out
from fieldlum.records import Progress, quiet

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.models.transport.model import Transport

Array = NDArray[Any]

SCAN_DEG = tuple(float(a) for a in np.arange(-3.0, 3.01, 0.5))
SCAN_HOURS = 40
SCAN_PIXELS = 400
SCAN_RECIPE = Recipe(1e-2, rank=40)
CLEARLY = 1.2  # the loss at the stated north must be so many times the best before it is called wrong
ODD_TIMES, ODD_MSE = 8.0, 5e-3


@dataclass(frozen=True, slots=True)
class NorthScan:
    """Held-out-day loss [k] of the captures if the room were turned by angles_deg [k] (clockwise) from what is stated;
    best_deg by a parabola through the least loss and its neighbours; wrong: the captures clearly speak for it."""

    angles_deg: Array
    loss: Array
    best_deg: float
    wrong: bool


def north_scan(data: Dataset, angles_deg: tuple[float, ...] = SCAN_DEG, progress: Progress = quiet) -> NorthScan | None:
    """Turn the computed sun patches about the stated north and see when they fit the captured ones.

    Uses the hours with most direct sun in view and the pixels that it reaches. None without a box room or without
    three such hours. A wrong clock looks the same: 1 minute is about 0.25 degrees.
    """
    room = data.setup.room
    if room is None or room.kind != "box" or not room.window:
        return None
    sunny = _sunniest(data, _patches(data, 0.0))
    if len(sunny) < 3:
        return None
    some = data.take(sunny)
    loss, touched = [], None
    stacks = []
    for k, angle in enumerate(angles_deg):
        progress(k, len(angles_deg), "north")
        stacks.append(_patches(some, angle))
    touched = np.flatnonzero((np.stack([s.max(axis=0) for s in stacks]).max(axis=0) > 0)[data.seen])
    pixels = touched[:: max(1, len(touched) // SCAN_PIXELS)]
    for patch in stacks:
        material = material_of(replace(some, patch_cdm2=patch), with_patch=True)
        kernel = Kernel(material.facades)
        basis = basis_of(kernel(material.features, material.features), SCAN_RECIPE.rank)
        loss.append(float(hold_out(material[pixels], basis, SCAN_RECIPE).per_hour.mean()))
    return _least(np.array(angles_deg), np.array(loss))


def _least(angles: Array, loss: Array) -> NorthScan:
    k = int(np.argmin(loss))
    best = float(angles[k])
    if 0 < k < len(angles) - 1:
        before, at, after = loss[k - 1 : k + 2]
        bend = before - 2.0 * at + after
        best += float(0.5 * (before - after) / bend * (angles[k + 1] - angles[k])) if bend > 0 else 0.0
    stated = float(np.interp(0.0, angles, loss))
    return NorthScan(angles, loss, best, bool(stated > CLEARLY * loss[k] and abs(best) > 0.1))


def _patches(data: Dataset, turn_deg: float) -> NDArray[np.float32]:
    """Sun patches if the room stood turned by so much: the sun turned the other way round."""
    from fieldlum.scene import sun_patches

    room = data.setup.room
    assert room is not None
    light = data.light
    towards = sun.direction(light.sun_altitude_deg, light.sun_azimuth_deg - turn_deg)
    found = sun_patches(
        room, data.setup, towards, light.direct_lx, height=data.shape[0], heading_deg=data.heading_deg, sub=2
    )
    return found.luminance_cdm2


def _sunniest(data: Dataset, patch: NDArray[np.float32]) -> NDArray[np.intp]:
    flux = patch_flux(patch, np.zeros(data.shape, bool))[0]
    order = np.argsort(flux)[::-1][:SCAN_HOURS]
    return np.sort(order[flux[order] > 0.0])


def odd_captures(model: Transport, data: Dataset) -> list[str]:
    """Slots whose picture disagrees with what all other days say far beyond the model's own doubt.

    A moved blind, a lamp, a person before the lens, a reading of irradiance from another moment.
    """
    if model.held_out_mse is None or len(model.held_out_mse) != len(data):
        return []
    expected = model.predict(data.light, data.patch_cdm2 if model.patchwork is not None else None).expected_mse
    usual = np.maximum(expected, np.median(model.held_out_mse))
    odd = (model.held_out_mse > ODD_TIMES * usual) & (model.held_out_mse > ODD_MSE)
    return [slot for slot, is_odd in zip(data.slots, odd, strict=True) if is_odd]
