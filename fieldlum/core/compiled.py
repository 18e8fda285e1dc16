"""Compile numeric loops with numba, where array operations of NumPy are several times slower.

The first call compiles for some seconds; the result is stored next to the module, or in the user's
cache folder.
"""

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Return `function` compiled for the types of its arguments; used as a decorator.

    Division by zero gives inf or NaN, as in NumPy. Other threads can run in the meantime. Without
    numba, as on a computer that only captures, `function` is returned: a hundred times slower.
    """
    # Otherwise .numba_config.yaml in the current folder, which can be a session of somebody else,
    # could name a cache, whose files can run code.
    os.environ.setdefault("NUMBA_CACHE_DIR", "")
    try:
        from numba import njit
    except ModuleNotFoundError:
        return function
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(Function, njit(cache=True, **options)(function))
    except RuntimeError:  # no folder that can be written: compile in each process
        return cast(Function, njit(**options)(function))
