"""Find the programs of Radiance in the wheel of pyradiance."""

from __future__ import annotations

from pathlib import Path


def radiance_program(name: str) -> str:
    """Return the path of a program of Radiance, such as ``pvalue``."""
    from pyradiance.anci import BINPATH

    return str(Path(BINPATH) / name)
