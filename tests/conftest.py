"""Fixtures that several test files share. Imports are local: most runs need none of them."""

from __future__ import annotations

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # the workers share the cores; before numpy is loaded
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tiny_field import Field


@pytest.fixture(scope="session", autouse=True)
def _own_settings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store permissions in a folder of the tests, not in that of the user."""
    with pytest.MonkeyPatch.context() as patch:
        folder = str(tmp_path_factory.mktemp("settings"))
        patch.setenv("XDG_CONFIG_HOME", folder)
        patch.setenv("APPDATA", folder)
        yield


@pytest.fixture
def rig(tmp_path: Path) -> Field:
    """Return a session of three slots with tiny devices, five minutes before the first slot."""
    from tiny_field import T0, Field, make_session

    from fieldlum.devices.clock import FastClock

    return Field(make_session(tmp_path / "s"), FastClock(T0 - timedelta(minutes=5)))
