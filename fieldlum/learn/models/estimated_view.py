"""Estimate the sky view of captures: from merge's sky pictures and discs, else from the maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Array
from fieldlum.core.records import Panorama, Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import altitude_azimuth_deg, equirect_pixel
from fieldlum.session import Session
from fieldlum.sky.sky_view import (
    Captured,
    SkyPicture,
    SkyView,
    cut_panorama,
    estimate,
    read_sky_picture,
    usual_rows,
)
from fieldlum.sky.sky_view.measured_discs import read_discs
from fieldlum.sky.sky_view.pose import CameraPose, pose_of_discs


def with_sky_view(
    data: Dataset, file: Path | None = None, *, progress: Progress = quiet
) -> Dataset:
    """Return the captures with a sky view: of `file`, else their own, else estimated from them.

    It is estimated from merge's sky pictures and discs, without sky pictures from the maps.
    Captures with blinds or snow are not used for it, unless all have the same. Raises InputError
    for a file that is not a sky view.
    """
    if file is not None:
        return replace(data, sky_view=SkyView.read(file))
    if data.sky_view is not None:
        return data
    light = data.light
    measured = data.disc_lx / np.maximum(light.direct_lx, 1.0)
    pictures = _sky_pictures(data)

    def read(k: int) -> SkyPicture:
        if pictures:
            return read_sky_picture(pictures[k])
        shown = np.where(data.seen, data.luminance_cdm2[k], np.nan)
        return cut_panorama(Panorama(shown, data.heading_deg, t_utc=light.t_utc[k]))

    def seen(rays: Array) -> Array:
        height, width = data.seen.shape
        row, column = equirect_pixel(*altitude_azimuth_deg(rays), height, width, data.heading_deg)
        return data.seen[np.minimum(row.astype(int), height - 1), column.astype(int) % width]

    captured = Captured(light, read, measured).take(usual_rows(light.states, len(light)))
    view = estimate(captured, seen if pictures else None, progress, _pose(data, measured))
    return replace(data, sky_view=view)


def _sky_pictures(data: Dataset) -> list[Path]:
    """Return merge's sky pictures of all captures; an empty list if one has none."""
    session = Session(Path(data.source).parent)
    files = [session.sky_picture(slot) for slot in data.slots]
    return files if all(file.is_file() for file in files) else []


def _pose(data: Dataset, shares: Array) -> CameraPose:
    """Return the camera's pose by the discs that merge measured; the stated one without any.

    shares: illuminance of each capture's disc over that of the beam [n].
    """
    discs = read_discs(Session(Path(data.source).parent))
    times = np.array([t.timestamp() for t in data.light.t_utc])
    nearest = [int(np.abs(times - t.timestamp()).argmin()) for t in discs.t_utc]
    return pose_of_discs(discs, data.setup.site, data.heading_deg, shares[nearest])
