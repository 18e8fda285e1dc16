"""Radiance's own programs, which pyradiance's wheel ships."""

from __future__ import annotations

from pathlib import Path


def radiance_program(name: str) -> str:
    """Return the path of one of Radiance's programs, such as ``pvalue``."""
    from pyradiance.anci import BINPATH

    return str(Path(BINPATH) / name)
