"""Define short names of array types; shapes and units are in docstrings. Spread indices evenly."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def evenly_spread(count: int, maximum: int) -> Indices:
    """Return at most `maximum` of the indices 0 to `count` - 1, [k]: the first, the last, between.

    The others are spread evenly between these.
    """
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).astype(np.intp))
