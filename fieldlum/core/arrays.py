"""Define short names of array types; shapes and units are in docstrings. Spread indices evenly."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike as ArrayLike
from numpy.typing import NDArray

Array = NDArray[Any]
Floats16 = NDArray[np.float16]
Floats32 = NDArray[np.float32]
Floats = NDArray[np.floating]
UInts8 = NDArray[np.uint8]
UInts16 = NDArray[np.uint16]
Ints8 = NDArray[np.int8]
Ints32 = NDArray[np.int32]
Ints64 = NDArray[np.int64]
Integers = NDArray[np.integer]
Dates = NDArray[np.datetime64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def evenly_spread(count: int, maximum: int) -> Indices:
    """Return k of the indices 0 to `count` - 1, ascending: the first, the last, others between.

    These are spread evenly. k is `maximum`, or `count` if that is less; a single index is the
    first.
    """
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).astype(np.intp))
