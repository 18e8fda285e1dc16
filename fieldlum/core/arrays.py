"""Short names of array types (docstrings have shapes and units), and evenly spread indices."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def evenly_spread(count: int, maximum: int) -> Indices:
    """Return up to `maximum` of the indices 0 to `count` - 1, evenly from first to last, [k]."""
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).astype(np.intp))
