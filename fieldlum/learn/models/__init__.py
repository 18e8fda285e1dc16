"""Models of a room: what a fitted model must provide, and its folder on disk.

A model is a module with a function that fits, ``fit(data, *, patch, seed, budget_s) -> Fitted`` (or
another name stated in `model_kinds.MODELS`), and one that loads, ``from_state(state: ModelState) ->
Fitted``. Model folders contain `config.json` and `weights.npz`: settings and plain arrays without
pickle, so that a model from another person cannot run code.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeVar

import msgspec
import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.learn.model_kinds import MODELS
from fieldlum.session import replacing
from fieldlum.session.codec import NPZ_ERRORS, open_arrays, read_arrays, write_object
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.sky.sky_view.view import SKY_VIEW
from fieldlum.version import __version__

if TYPE_CHECKING:
    from fieldlum.learn.models.mirrors import Mirror
    from fieldlum.learn.models.training_data import Dataset
    from fieldlum.sky.daylight import Light

_Part = TypeVar("_Part")
Patch = Literal["absolute", "gain", "none"]
"""How sun patches are used: in cd/m2, up to an unknown factor, or not at all."""


# Errors that `from_state` can raise for a damaged or hostile model, next to `NPZ_ERRORS`.
_BROKEN = (IndexError, TypeError, ArithmeticError, MemoryError, RuntimeError)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted maps of n hours without the sun's disc, and their uncertainty.

    luminance_cdm2: [n, H, W] float32; log10_sd: standard deviation of log10 L [n, H, W], None if
    the model gives none; expected_mse: the model's own estimate of each map's log10 MSE, weighted
    by solid angle [n] (NaN: unknown); trusted: True for hours that are like the captured ones [n].
    """

    luminance_cdm2: Floats32
    log10_sd: Floats32 | None
    expected_mse: Floats
    trusted: Mask


class ModelState(NamedTuple):
    """The content of a model folder.

    config: keys of config.json; before writing, only the model's own keys, after reading also those
    that all models share. arrays: plain arrays of weights.npz by name.
    """

    config: Mapping[str, Any]
    arrays: Mapping[str, Array]


# An hour is not trusted if the model expects a larger error factor. Measured on the office's nine
# days: no hour of clean days is beyond it; with a lamp on, a camera displaced by 1 px on three
# days, snow, or four days only, 5 to 77 % of the hours are (docs/models.md).
TRUSTED_FACTOR = 1.2
TRUSTED_MSE = float(np.log10(TRUSTED_FACTOR) ** 2)


def trusted_hours(prediction: Prediction) -> Mask:
    """Return a mask [n], True for trusted hours.

    These are the hours with `prediction.trusted`, without those whose expected error (root of
    `expected_mse`, in log10) is above log10(1.2). An unknown expected error (NaN) does not exclude
    an hour.
    """
    return prediction.trusted & ~(prediction.expected_mse > TRUSTED_MSE)


FORMAT = 5  # of fitted values in a model's folder


def state_of(model: Any, with_patch: bool) -> ModelState:
    """Return the content of the folder of a model that is a dataclass.

    Its fields are a table of config.json, whose key is `model.name`, such as transport. A NumPy
    array is stored in weights.npz, and the table has its name there. All other fields must be
    numbers, texts, None, or lists, tables or dataclasses of these; they become plain values of the
    table. with_patch: whether the model uses sun patches.
    """
    arrays: dict[str, Array] = {}  # `serialised` adds the model's arrays
    table = serialised(model, "array", arrays) | {"format": FORMAT}
    return ModelState({"with_patch": with_patch, model.name: table}, arrays)


def serialised(part: Any, prefix: str, arrays: dict[str, Array]) -> dict[str, Any]:
    """Return the fields of the dataclass `part` as plain values for config.json, by name.

    Arrays of any shape are added to `arrays`; instead of an array, its field contains the name in
    `arrays`: PREFIX followed by a number. `deserialised` reverses this.
    """

    def name_of(array: Array) -> str:
        """Add an array to `arrays` and return its name there."""
        name = f"{prefix}{len(arrays)}"
        arrays[name] = array
        return name

    return msgspec.to_builtins(part, enc_hook=name_of)


def deserialised(kind: type[_Part], table: Any, arrays: Mapping[str, Array]) -> _Part:
    """Return the dataclass of type `kind` that `serialised` described.

    table: result of `serialised`; arrays: those that it added, by name, of any shape [...]. Raises
    KeyError, TypeError or ValueError for missing or wrong content.
    """
    if table.get("format", FORMAT) != FORMAT:
        raise ValueError("a model of an earlier version")
    return msgspec.convert(table, kind, dec_hook=lambda _, name: arrays[name])


class Fitted(Protocol):
    """A trained model.

    `state` may add a key `with_patch` to config.json: whether `predict` requires sun patches.
    Without this key they are required unless the model was trained with patch "none".
    """

    @property
    def name(self) -> str:
        """Name of the model, such as transport."""
        ...

    @property
    def parameters(self) -> int:
        """Number of fitted values."""
        ...

    @property
    def held_out_mse(self) -> Floats | None:
        """MSE of log10 L of each training map [n], held out with its day; None if not computed."""
        ...

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict maps of the n hours of `light`, [n, H, W] cd/m2.

        patch_cdm2: luminance of direct sun only [n, H, W] cd/m2, for models that require it, which
        raise InputError or ValueError without it; None for others. Memory grows with the number of
        hours, so predict in chunks.
        """
        ...

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for the model's `from_state`."""
        ...


def fit(name: str, data: Dataset, **options: Any) -> Fitted:
    """Fit the model with a name of `MODELS`; options: arguments of that model's fit.

    Raises KeyError for an unknown name, and what that model's fit raises.
    """
    kind = MODELS[name]
    return getattr(importlib.import_module(kind.module), kind.fit)(data, **options)


def save(
    folder: Path, fitted: Fitted, data: Dataset, *, mirrors: Sequence[Mirror] = (), **more: Any
) -> None:
    """Write weights.npz, sky_view.exr, then config.json, each atomically, into a folder.

    data: the training data; config.json describes them, and weights.npz has their seen pixels.
    Without a sky view in `data`, an existing sky_view.exr is deleted. mirrors: plane mirrors of the
    sun. more: further keys of config.json and their values.
    """
    state = fitted.state()
    arrays = {"seen": data.seen, **state.arrays}
    planes = [serialised(mirror, f"mirror{k}.", arrays) for k, mirror in enumerate(mirrors)]
    with replacing(folder / "weights.npz") as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    table = {
        "model": fitted.name,
        "software": {"fieldlum": __version__},
        **data.about(),
        **({"mirrors": planes} if mirrors else {}),
        **more,
        **state.config,
    }
    if data.sky_view is not None:
        data.sky_view.write(folder / SKY_VIEW)
    else:
        (folder / SKY_VIEW).unlink(missing_ok=True)
    write_object(folder / ModelConfig.NAME, {"format": ModelConfig.FORMAT, **table}, digest=True)


def read_config(folder: Path) -> ModelConfig:
    """Read config.json of a model folder.

    Raises InputError if the file is missing, damaged or of another format, or for an unknown model.
    """
    config = ModelConfig.read(folder)
    if config.model not in MODELS:
        finding = f"the unknown model '{config.model}'"
        remedy = "train the model again (fieldlum train)"
        raise InputError(folder / "config.json", finding, f"one of {', '.join(MODELS)}", remedy)
    return config


def seen_of(folder: Path) -> Mask | None:
    """Return the mask [H, W] of the pixels that the camera saw, from a model's folder.

    It is None if weights.npz cannot be read.
    """
    path = folder / "weights.npz"
    with suppress(InputError), open_arrays(path, "weights", "train again") as stored:
        return stored["seen"].astype(bool)
    return None  # `load` reports the fault


def load(folder: Path) -> Fitted:
    """Return the model in a folder; nothing is unpickled.

    Raises InputError if config.json or weights.npz is missing, damaged or does not fit the other.
    """
    config = read_config(folder)
    path = folder / "weights.npz"
    try:
        state = ModelState(config.state, read_arrays(path))
        return importlib.import_module(MODELS[config.model].module).from_state(state)
    except (*NPZ_ERRORS, *_BROKEN) as error:
        finding = f"weights that cannot be used ({error})".replace("\n", " ")
        remedy = "train the model again (fieldlum train)"
        raise InputError(path, finding, "the arrays that config.json describes", remedy) from None


def is_usable(folder: Path) -> bool:
    """Return whether `load` can read a folder's model, which another version may have written."""
    with suppress(InputError):
        load(folder)
        return True
    return False
