"""Predicted glare of many hours against its truth, for `hard_campaign.py`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.learn import models
from fieldlum.learn.models import Fitted
from fieldlum.learn.models.training_data import Dataset
from fieldlum.year.glare.sources import view_azimuths_deg
from fieldlum.year.glare.standards import class_of, exceeded_in_share, protection
from fieldlum.year.predict.hour_blocks import predict_figures, room_of
from fieldlum.year.predict.occupancy import default_occupancy

TOLERANCE = 1e-3  # of DGP: half a digit of what a report prints


@dataclass(frozen=True, slots=True)
class Year:
    """Predicted hours against their truth; all counts are of the ten view directions.

    inside: share of occupied hours and directions whose DGP is inside its 95 % interval;
    year_inside: directions whose exceeded DGP is; decided, wrong: directions with a stated class of
    EN 17037, and with a false one.
    """

    inside: float
    year_inside: int
    decided: int
    wrong: int
    directions: int


def predicted_year(
    model: Fitted,
    data: Dataset,
    hours: Dataset,
    true_dgp: Floats,
    folder: Path,
    *,
    patch: Literal["none", "absolute"] = "absolute",
    occupied_hours: int | None = None,
) -> Year:
    """Predict hours as `fieldlum predict` does, and compare.

    data: captures that trained the model; true_dgp: of the hours in ten directions [n, d]; folder:
    for the model and its prediction; occupied_hours: that the exceeded share refers to, None for
    those of `hours`.
    """
    models.save(folder / "model", model, data, patch=patch)
    room = room_of(models.read_config(folder / "model"), folder / "model")
    azimuths = view_azimuths_deg(room.heading_deg)
    found = predict_figures(folder / "model", room, hours.light, azimuths)
    occupied = default_occupancy().at(hours.light.t_utc, hours.setup.site.timezone)
    count = int(occupied.sum()) if occupied_hours is None else occupied_hours
    dgp, rng = found.views["dgp"][occupied], np.random.default_rng(0)
    stated = protection(dgp, found.uncertainty.hours(occupied), count, azimuths, rng)
    ends = np.array([(row.low, row.high) for row in stated], float)
    certain = np.array([row.certain for row in stated])
    low, high = found.views["dgp_low"] - TOLERANCE, found.views["dgp_high"] + TOLERANCE
    inside = (true_dgp >= low) & (true_dgp <= high)
    exceeded = exceeded_in_share(true_dgp[occupied], count)
    held = (exceeded >= ends[:, 0] - TOLERANCE) & (exceeded <= ends[:, 1] + TOLERANCE)
    right = np.array(
        [class_of(v) == row.glare_class for v, row in zip(exceeded, stated, strict=True)]
    )
    return Year(
        float(inside[occupied].mean()),
        int(held.sum()),
        int(certain.sum()),
        int((certain & ~right).sum()),
        len(azimuths),
    )
