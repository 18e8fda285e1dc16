"""Align captures to the pose that most of them share, when pairs are read.

The turns are stored in a table next to the csv of pairs; picture files do not change.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.records import Progress, counted
from fieldlum.learn.models.camera_turns import (
    MIN_CAPTURES,
    MIN_ROWS,
    CameraTurns,
    DirectLight,
    camera_turns,
    interpolation_u,
    turned_back,
    turned_rays,
)
from fieldlum.learn.models.hour_weights import weight_of_variance
from fieldlum.optics.projection import direction
from fieldlum.session.files.alignment_csv import (
    AlignmentRow,
    alignment_path,
    find_alignment,
    write_alignment,
)

_MIN_SEEN = 0.8  # a pixel is compared if this share of captures has a value; not measured
_MIN_WEIGHT = 0.5  # pixels with less weight by interpolation teach nothing; chosen
_MIN_CDM2 = 1e-3  # for logarithms; well below what any camera resolves; chosen


def find_turns(
    pairs: Path,
    pictures: Sequence[str],
    maps: Floats32,
    has_value: Mask,
    heading_deg: float,
    light: DirectLight,
    progress: Progress,
) -> CameraTurns:
    """Return how the camera of each capture was turned relative to most captures.

    pairs: path of pairs.csv. The other arguments have the n captures in the order of time:
    pictures: names of the panoramas as in the csv; maps: [n, H, W]; has_value: True for measured
    pixels [n, H, W]. heading_deg: azimuth of the maps' centre column. light: their direct light.

    The turns are read from a table next to the csv if its names and checksums are those of all
    maps. Otherwise `camera_turns` estimates them, and with at least 5 captures and 40 rows of
    pixels a new table is written. In a read-only folder nothing is written, and no error is raised.
    """
    path = alignment_path(pairs)
    digests = [f"{zlib.crc32(m.tobytes()):08x}" for m in maps]
    rows = find_alignment(path)
    if [(r.panorama, r.digest) for r in rows] == list(zip(pictures, digests, strict=True)):
        return CameraTurns(
            np.array([(r.heading_deg, r.tilt_deg, r.roll_deg) for r in rows]),
            np.array([(r.u_heading_deg, r.u_tilt_deg, r.u_roll_deg) for r in rows]),
            np.array([r.aligned for r in rows]),
        )
    compared = has_value.mean(axis=0) > _MIN_SEEN
    turns = camera_turns(np.nan_to_num(maps), compared, heading_deg, light=light, progress=progress)
    if len(maps) >= MIN_CAPTURES and maps.shape[1] >= MIN_ROWS:
        table = [
            AlignmentRow(name, digest, *angles, *u, aligned=bool(aligned))
            for name, digest, angles, u, aligned in zip(
                pictures,
                digests,
                turns.angles_deg.tolist(),
                turns.u_deg.tolist(),
                turns.aligned,
                strict=True,
            )
        ]
        # in a read-only folder the pictures are compared each time
        with contextlib.suppress(OSError):
            write_alignment(path, table)
    return turns


def align(
    maps: Floats32,
    has_value: Mask,
    counts: list[NDArray[np.float16] | None],
    heading_deg: float,
    turns: CameraTurns,
) -> None:
    """Turn maps, masks and weights of captures back to the pose that most captures share, in place.

    maps: [n, H, W] cd/m2; has_value: [n, H, W], True for measured pixels; counts: for each capture
    the weights of its pixels in training [H, W], None if all are 1; heading_deg: azimuth of the
    maps' centre column. A capture that was not turned, or that cannot be aligned, does not change.

    Interpolation blurs sharp edges, such as a window's. Therefore each pixel's weight is multiplied
    by the weight of the uncertainty that this causes; a factor below a half becomes 0.
    """
    for k in np.flatnonzero(turns.turned):
        angles = turns.angles_deg[k]
        logs = np.log(np.maximum(np.nan_to_num(maps[k]), _MIN_CDM2))
        maps[k] = np.exp(turned_back(logs, heading_deg, angles))
        weight = weight_of_variance(interpolation_u(logs, heading_deg, angles) ** 2)
        weight = np.where(weight < _MIN_WEIGHT, 0.0, weight)
        share = turned_back(has_value[k].astype(float), heading_deg, angles)
        has_value[k] = share > 1.0 - 1e-6
        if (count := counts[k]) is not None:
            weight *= turned_back(count.astype(float), heading_deg, angles)
        counts[k] = weight.astype(np.float16)


def shown_place(
    altitude_deg: float, azimuth_deg: float, heading_deg: float, angles_deg: Floats
) -> tuple[float, float]:
    """Return the altitude and azimuth [deg] at which a turned camera's panorama shows a direction.

    altitude_deg, azimuth_deg: the true direction, azimuth clockwise from north; heading_deg:
    azimuth of the panorama's centre column; angles_deg: the camera's turn in heading (clockwise
    positive), tilt (up) and roll (clockwise) [3].
    """
    if not angles_deg.any():
        return altitude_deg, azimuth_deg
    x, y, z = turned_rays(direction(altitude_deg, azimuth_deg), heading_deg, angles_deg)
    altitude = float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    return altitude, float(np.degrees(np.arctan2(x, y)) % 360.0)


def turn_notes(turns: CameraTurns, days: NDArray[np.datetime64], table: str) -> list[str]:
    """Return sentences for the user: one for each pose that was corrected, one on unused captures.

    Captures that cannot be aligned are not used. The list is empty if all captures are aligned and
    no camera was turned. days: local date of each capture [n]; table: name of the file with the
    turns.
    """
    notes = []
    for pose in np.unique(turns.angles_deg[turns.turned], axis=0):
        rows = turns.turned & (turns.angles_deg == pose).all(axis=1)
        u = np.median(turns.u_deg[rows], axis=0)
        parts = [
            f"{name} {angle:+.2f} +- {error:.2f}"
            for name, angle, error in zip(("heading", "tilt", "roll"), pose, u, strict=True)
        ]
        notes.append(
            f"the camera was turned, relative to most captures, in {_captures(rows, days)} by "
            f"{', '.join(parts)} degrees (positive: clockwise, up, clockwise); the pictures "
            f"were turned back in memory (angles of each capture: {table})"
        )
    if not turns.aligned.all():
        notes.append(
            f"WARNING: not used: {_captures(~turns.aligned, days)} that cannot be aligned with the "
            f"others (aligned = 0 in {table}): the camera was turned too far or moved; put them "
            "into a separate session"
        )
    return notes


def _captures(rows: Mask, days: NDArray[np.datetime64]) -> str:
    names = [str(day) for day in np.unique(days[rows])]
    shown = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
    count = int(rows.sum())
    return f"{counted(count, 'capture')} of {shown}"
