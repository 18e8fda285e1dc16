"""Convert a transport model to plain arrays and settings, and back; also read models of 0.1.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from typing import Any, NotRequired, TypedDict

import numpy as np

from fieldlum.core.arrays import Array
from fieldlum.core.records import Room
from fieldlum.core.strict_toml import build, plain
from fieldlum.learn.transport.features import (
    PatchDescriptor,
    StateColumns,
)
from fieldlum.learn.transport.open_sky import OpenSky
from fieldlum.learn.transport.physics import Physics
from fieldlum.learn.transport.pixel_fit import PixelFit, Recipe
from fieldlum.learn.transport.response import LightBasis, RoomResponse
from fieldlum.learn.transport.uncertainty import Uncertainty
from fieldlum.sky.light import Facades, Features, Kernel, Light

# absent from models of earlier versions
LIGHT_ARRAYS = ("sun_light", "sky_modes", "sky_light")
PHYSICS_ARRAYS = ("modes", "position", "axis", "sign", "share", "piece", *LIGHT_ARRAYS)
TRUST_FIGURES = ("novelty", "patch", "mse", "slip_deg")
TRUST_ARRAYS = ("inverse", "factors", "variances", "second")


class TransportTable(TypedDict):
    """The table "transport" of config.json.

    kernel: fields of `Kernel` without facades, absent ones have their defaults; recipe: fields of
    `Recipe`; patch_scale: factor on all sun patches; room: as in SITE.toml, None without a coarse
    room model (`Physics`); patchwork: fields of `PatchDescriptor`, None without sun patches;
    states: fields of `StateColumns`, absent in 0.1.0; trust: the single numbers of `Uncertainty`;
    tried: recipes that were compared, with their scores; sky_field: fields of `SkyField`, present
    if the fit used the skies that windows showed.
    """

    kernel: dict[str, float]
    recipe: dict[str, Any]
    patch_scale: float
    room: dict[str, Any] | None
    patchwork: dict[str, float] | None
    states: NotRequired[dict[str, Any]]
    trust: dict[str, float]
    tried: Sequence[Mapping[str, float]]
    sky_field: NotRequired[dict[str, float]]


def table_of(
    response: RoomResponse, unsure: Uncertainty, tried: Sequence[Mapping[str, float]]
) -> TransportTable:
    """Return the settings of a model, as the table "transport" of config.json.

    tried: scores of the recipes that were compared.
    """
    basis = response.basis
    kernel = {f.name: getattr(basis.kernel, f.name) for f in fields(Kernel) if f.name != "facades"}
    return {
        "kernel": kernel,
        "recipe": asdict(response.recipe),
        "patch_scale": response.patch_scale,
        "room": None if basis.physics is None else plain(basis.physics.room),
        "patchwork": None if basis.patches is None else asdict(basis.patches),
        "states": asdict(basis.states),
        "trust": {name: getattr(unsure, name) for name in TRUST_FIGURES},
        "tried": tried,
    }


def arrays_of(response: RoomResponse, unsure: Uncertainty) -> dict[str, Array]:
    """Return the arrays of a model for weights.npz by name, in the shapes of the dataclasses."""
    basis = response.basis
    light = basis.captured_light
    arrays: dict[str, Array] = {
        "seen": response.seen,
        "projector": basis.projector,
        "noise_dull": unsure.noise_dull.astype(np.float32),
        "noise_sun": unsure.noise_sun.astype(np.float32),
        "facade_azimuths": basis.kernel.facades.azimuths_deg,
        "facade_weights": basis.kernel.facades.weights,
        "train_sun": np.stack((light.sun_altitude_deg, light.sun_azimuth_deg)),  # [2, n]
    }
    arrays |= {f"trust_{name}": getattr(unsure, name) for name in TRUST_ARRAYS}
    pixels = {f.name: getattr(response.pixels, f.name) for f in fields(PixelFit)}
    arrays |= {f"pixel_{name}": value.astype(np.float32) for name, value in pixels.items()}
    arrays |= {f"sky_{f.name}": getattr(response.open_sky, f.name) for f in fields(OpenSky)}
    captured = {f.name: getattr(basis.captured, f.name) for f in fields(Features)}
    arrays |= {f"train_{name}": value for name, value in captured.items() if value is not None}
    if basis.physics is not None:
        arrays |= {f"physics_{name}": getattr(basis.physics, name) for name in PHYSICS_ARRAYS}
        arrays["physics_norm"] = np.array(basis.physics.norm)
    return arrays


def response_of(own: TransportTable, arrays: Mapping[str, Array]) -> RoomResponse:
    """Return the response stored in the table of `table_of` (`own`) and the arrays of `arrays_of`.

    Models of fieldlum 0.1.0 are read too.
    """
    return RoomResponse(
        seen=arrays["seen"],
        basis=_basis(own, arrays),
        pixels=_pixels(arrays),
        open_sky=OpenSky(*(arrays[f"sky_{f.name}"] for f in fields(OpenSky))),
        patch_scale=float(own["patch_scale"]),
        recipe=Recipe(**own["recipe"]),
    )


def uncertainty_of(own: TransportTable, arrays: Mapping[str, Array]) -> Uncertainty:
    """Return the uncertainty stored in the table of `table_of` and the arrays of `arrays_of`."""
    trust = {name: arrays[f"trust_{name}"] for name in TRUST_ARRAYS}
    noise = {name: arrays[name] for name in ("noise_dull", "noise_sun")}
    return Uncertainty(**{**own["trust"], **trust, **noise})


def _pixels(arrays: Mapping[str, Array]) -> PixelFit:
    """Return the pixels' values; models of earlier versions use no computed light."""
    unused = {"computed": np.zeros(len(arrays["pixel_scale"]), np.float32)}
    stored = {f.name: arrays.get(f"pixel_{f.name}", unused.get(f.name)) for f in fields(PixelFit)}
    return PixelFit(**stored)  # pyright: ignore[reportArgumentType]


def _basis(own: TransportTable, arrays: Mapping[str, Array]) -> LightBasis:
    altitude, azimuth = arrays["train_sun"]
    nothing = np.zeros(len(altitude))
    unknown = (datetime(2000, 1, 1, tzinfo=UTC),) * len(altitude)  # only the directions are used
    stored = (arrays.get(f"train_{f.name}") for f in fields(Features))
    captured = Features(*stored)  # pyright: ignore[reportArgumentType]
    physics = None
    if own["room"] is not None:
        parts: dict[str, Any] = {
            name: arrays[f"physics_{name}"]
            for name in PHYSICS_ARRAYS
            if f"physics_{name}" in arrays
        }
        room = build(Room, own["room"], "the model's room")
        physics = Physics(room, **parts, norm=float(arrays["physics_norm"]))
    patches = own["patchwork"]
    return LightBasis(
        _kernel(own, arrays),
        captured,
        Light(unknown, nothing, nothing, altitude, azimuth),
        arrays["projector"],
        physics,
        None if patches is None else PatchDescriptor(**patches),
        _states(own),
    )


def _states(own: TransportTable) -> StateColumns:
    """Return the room's states in a table; models of 0.1.0 have none."""
    table = own.get("states", {})
    lamps, changed = tuple(table.get("lamps", ())), tuple(table.get("changed", ()))
    return StateColumns(bool(table.get("always", False)), lamps, changed)


def _kernel(own: TransportTable, arrays: Mapping[str, Array]) -> Kernel:
    facades = Facades(arrays["facade_azimuths"], arrays["facade_weights"])
    settings = dict(own["kernel"])
    settings.pop("around", None)  # 0 in every model of 0.1.0, where it could not be set
    return Kernel(facades, **settings)
