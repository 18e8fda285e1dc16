"""models/NAME/held_out.npz: measured and predicted maps of the hours that scores.json is about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import input_errors
from fieldlum.session.codec import NPZ_ERRORS
from fieldlum.session.writing import replacing

FORMAT = 1  # of the file; docs/file-formats.md
MAX_MAPS = 150  # most maps in the file, spread evenly: 4 MB at 116 x 58; chosen


@dataclass(frozen=True, slots=True)
class HeldOutMaps:
    """Hours that were held out of the fit which predicted them, in the order of the folds.

    slots: ids [n]; sun_altitude_deg, sun_azimuth_deg: [n] deg; log10_mse: weighted by solid angle
    [n]; dgp_measured, dgp_predicted: in ten view directions, both with the measured sun disc [n,
    10]; contrast_measured, contrast_predicted: mean local contrast of each level of a picture
    pyramid [n, 5] cd/m2; measured_log10, predicted_log10: log10 of cd/m2 [n, h, w], float16 (to 0.2
    %), reduced to fewer pixels, without the disc; season_deg: angle to the nearest sun in that
    fit's training data [n] deg.
    """

    slots: NDArray[np.str_]
    sun_altitude_deg: Floats
    sun_azimuth_deg: Floats
    log10_mse: Floats
    dgp_measured: Floats
    dgp_predicted: Floats
    contrast_measured: Floats
    contrast_predicted: Floats
    measured_log10: NDArray[np.float16]
    predicted_log10: NDArray[np.float16]
    season_deg: Floats

    def __len__(self) -> int:
        return len(self.slots)

    @classmethod
    def join(cls, parts: Sequence[HeldOutMaps]) -> HeldOutMaps | None:
        """Return the hours of several tests as one object; None without any test."""
        if not parts:
            return None
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS))

    def write(self, folder: Path) -> None:
        """Write held_out.npz: at most 150 hours, spread evenly from best to worst prediction."""
        order = np.argsort(self.log10_mse, kind="stable")
        spread = np.linspace(0, len(order) - 1, min(len(order), MAX_MAPS)).round().astype(int)
        kept = np.sort(order[spread])
        arrays: dict[str, Any] = {name: getattr(self, name)[kept] for name in _ARRAYS}
        with replacing(folder / "held_out.npz") as file:
            np.savez_compressed(file, format=FORMAT, **arrays)

    @classmethod
    def find(cls, folder: Path) -> HeldOutMaps | None:
        """Read held_out.npz of a folder; return None if it is missing, as in models of 0.1.0.

        Raises InputError for other content.
        """
        path = folder / "held_out.npz"
        if not path.is_file():
            return None
        expected = f"held-out maps of format 1 to {FORMAT}"
        remedy = "train the model again (fieldlum train)"
        with (
            input_errors(path, expected, remedy, *NPZ_ERRORS),
            path.open("rb") as file,
            np.load(file, allow_pickle=False) as stored,
        ):
            if int(stored["format"]) > FORMAT:
                raise ValueError(f"format {int(stored['format'])}")
            return cls(*(stored[name] for name in _ARRAYS))


_ARRAYS = tuple(field.name for field in fields(HeldOutMaps))
