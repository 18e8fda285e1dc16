"""Estimate how long a command will take, from measured costs; printed before it starts.

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
# A line through 30 s for 8 directions at 60 x 30 (bench/campaign_rooms.py) and 154 s for ten at 460
# x 230 (docs/scale.md).
_YEAR_FIXED_S = 30.0
_YEAR_S = 124.0 / (460 * 230 * 10)
# `fieldlum simulate` of the shipped office with 8 hours took 12, 33 and 80 CPU s at 60 x 30
# (draft, quick, paper) and 41 CPU s at 116 x 58 (quick). Without start and 8 hours. A pixel's
# rays are those of `simulate.truth.QUALITIES` over the square of its smoothing: 32, 100 and 64.
_SIMULATE_FIXED_S = {"draft": 10.0, "quick": 28.0, "paper": 75.0}
_SIMULATE_S = {"draft": 5e-4, "quick": 1.6e-3, "paper": 1.0e-3}  # a pixel
_HOUR_S = 0.025  # 292 more hours at 60 x 30 took 6.9 CPU s
# docs/validation.md, transport at 115 x 58: 8 s for 108 captures, 20 s for 200.
_FIT_S_PER_CAPTURE = 0.09
# The same page: 168 s for a picture of 115 x 58 by rtrace with the paper's options.
_RADIANCE_S = 168.0 / (115 * 58)
_STRESS_S = 90.0  # `bench.stress` takes one to two minutes
# `calibrate pixels` took 7 CPU s for 6 raw frames of 21 megapixels, `calibrate response` 7 CPU s
# for 16 JPEGs of 12 megapixels. Measured once; no command repeats it.
_FRAME_S_PER_MEGAPIXEL = 0.05
# `calibrate lens --chessboard`: 3.5 CPU s for a JPEG of 12 megapixels, 6.4 s for 21 megapixels.
# Measured once; no command repeats it.
_BOARD_S_PER_MEGAPIXEL = 0.3
_MIN_PRINTED_S = 20.0  # shorter times are not printed; chosen


def merge_s(folders: Iterable[Path]) -> float:
    """Return the estimated time to merge brackets [s], from the size of their frames."""
    sizes = (f.stat().st_size for folder in folders for f in folder.iterdir() if f.is_file())
    return _MERGE_S_PER_BYTE * sum(sizes)


def train_s(model: str, captures: int, pixels: int, budget_min: float) -> float:
    """Return the estimated time to train [s].

    It is the complete budget for the models auto and dense, and 0 for mean and nearest. captures:
    number of pairs; pixels: of one map.
    """
    if model in ("auto", "dense"):
        return 60.0 * budget_min
    transport = _TRANSPORT_FIXED_S + _TRANSPORT_S * captures * pixels
    return min(transport if model == "transport" else 0.0, 60.0 * budget_min)


def predict_s(pixels: int, directions: int) -> float:
    """Return the estimated time to predict a year [s]; pixels: of one map."""
    return _YEAR_FIXED_S + _YEAR_S * pixels * directions


def simulate_s(quality: str, pixels: int, hours: int) -> float:
    """Return the estimated time to simulate the hours of a plan [s]; pixels: of one map."""
    return _SIMULATE_FIXED_S[quality] + _SIMULATE_S[quality] * pixels + _HOUR_S * hours


def bench_s(
    transport: int,
    captures: int,
    pixels: int,
    *,
    folds: int,
    dense_min: float,
    render_hours: int,
    with_stress: bool,
) -> float:
    """Return the estimated time of a benchmark [s].

    transport: number of transport models; captures, pixels: number of pairs, and of pixels of one
    map; folds: fits of one model for the score table; dense_min: minutes of all trainings of the
    dense network; render_hours: number of hours that Radiance renders; with_stress: whether the
    stress tests run.
    """
    quick = transport * _FIT_S_PER_CAPTURE * folds * captures
    rendering = render_hours * _RADIANCE_S * pixels
    return quick + 60.0 * dense_min + rendering + _STRESS_S * with_stress


def frames_s(count: int, pixels: int, *, boards: bool = False) -> float:
    """Return the estimated time to read frames, or to detect chessboards in them [s].

    count: number of frames; pixels: of one frame; boards: detect chessboards.
    """
    per_megapixel = _BOARD_S_PER_MEGAPIXEL if boards else _FRAME_S_PER_MEGAPIXEL
    return per_megapixel * count * pixels / 1e6


def duration_text(seconds: float) -> str:
    """Return a duration in one coarse unit, such as "about 3 minutes"."""
    if seconds < 90:
        return f"about {max(10, round(seconds, -1)):.0f} seconds"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} minutes"
    return f"about {seconds / 3600:.0f} hours"


def estimate_text(seconds: float, processes: int = 1) -> str:
    """Return a sentence on the time that a command will take; "" for less than 20 s.

    seconds: on one core [s], divided evenly among `processes`.
    """
    needed = seconds / max(processes, 1)
    if needed < _MIN_PRINTED_S:
        return ""
    return f"this takes {duration_text(needed)}, or less if parts were computed before"
