"""Fixtures that several test files share. Imports are local: most runs need none of them."""

from __future__ import annotations

import gc
import os
import sys

if "PYTEST_XDIST_WORKER" in os.environ:  # the workers share the cores; before numpy is loaded
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import pandas as pd
    from tiny_field import Field


def pytest_collection_finish() -> None:
    """Search modules and tests for garbage no more: they are a million objects that all stay."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _own_settings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store permissions in a folder of the tests, not in that of the user."""
    with pytest.MonkeyPatch.context() as patch:
        folder = str(tmp_path_factory.mktemp("settings"))
        patch.setenv("XDG_CONFIG_HOME", folder)
        patch.setenv("APPDATA", folder)
        yield


@pytest.fixture(scope="session", autouse=True)
def _suns_of_equal_years() -> Iterator[None]:
    """Compute NREL's positions of the sun once for equal moments and places.

    Hundreds of tests read a year of 8 760 hours, most at the same place. Where no test imports
    pvlib, nothing is changed.
    """
    if "pvlib" not in sys.modules:
        yield
        return
    from pvlib import solarposition

    computed, stored = solarposition.get_solarposition, {}

    def position(time: pd.DatetimeIndex, *place: float, **options: Any) -> pd.DataFrame:
        key = time.asi8.tobytes(), time.dtype, place, tuple(options.items())
        if key not in stored:
            if len(stored) > 63:  # under 100 MB
                stored.clear()
            stored[key] = computed(time, *place, **options)
        return stored[key].copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solarposition, "get_solarposition", position)
        yield


@pytest.fixture
def rig(tmp_path: Path) -> Field:
    """Return a session of three slots with tiny devices, five minutes before the first slot."""
    from tiny_field import T0, Field, make_session

    from fieldlum.devices.clock import FastClock

    return Field(make_session(tmp_path / "s"), FastClock(T0 - timedelta(minutes=5)))
