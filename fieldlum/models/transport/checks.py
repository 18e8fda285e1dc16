"""What captures say about the room: did something in it change?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.models.transport.model import Transport

ODD_TIMES, ODD_MSE = 8.0, 5e-3


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
