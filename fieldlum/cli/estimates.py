"""How long a command may take, from measured costs: printed before it starts.

The costs are CPU seconds of one core of a 2-core x86-64 machine (docs/scale.md). Another computer
may be three times faster or slower.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

# docs/scale.md: 4 s for a bracket of nine raw frames of 24 megapixels, 28 MB each.
_MERGE_S_PER_BYTE = 4.0 / 250e6
# A line through 39 s for 48 captures at 60 x 30 (bench/campaign_rooms.py) and 53 s for 108 captures
# at 460 x 230 (docs/scale.md): most of the time goes into the room's own light, for any size.
_TRANSPORT_FIXED_S = 38.0
_TRANSPORT_S = 15.0 / (108 * 460 * 230)
# A line through 30 s for 8 directions at 60 x 30 and 154 s for ten at 460 x 230, from the same.
_YEAR_FIXED_S = 30.0
_YEAR_S = 124.0 / (460 * 230 * 10)
_LEAST_PRINTED_S = 20.0


def merge_s(folders: Iterable[Path]) -> float:
    """Return the time to merge brackets, from the size of their frames, in s."""
    sizes = (f.stat().st_size for folder in folders for f in folder.iterdir() if f.is_file())
    return _MERGE_S_PER_BYTE * sum(sizes)


def train_s(model: str, captures: int, pixels: int, budget_min: float) -> float:
    """Return the time to train, in s: the complete budget if the dense network is tried."""
    if model in ("auto", "dense"):
        return 60.0 * budget_min
    transport = _TRANSPORT_FIXED_S + _TRANSPORT_S * captures * pixels
    return min(transport if model == "transport" else 0.0, 60.0 * budget_min)


def predict_s(pixels: int, directions: int) -> float:
    """Return the time to predict a year, in s."""
    return _YEAR_FIXED_S + _YEAR_S * pixels * directions


def duration_text(seconds: float) -> str:
    """Return a duration in one coarse unit, such as "about 3 minutes"."""
    if seconds < 90:
        return f"about {max(10, round(seconds, -1)):.0f} seconds"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} minutes"
    return f"about {seconds / 3600:.0f} hours"


def estimate_text(seconds: float, processes: int = 1) -> str:
    """Return a sentence for the start of a command; empty for a short one."""
    needed = seconds / max(processes, 1)
    if needed < _LEAST_PRINTED_S:
        return ""
    return f"this takes {duration_text(needed)}, less if parts were computed before"
