"""Estimate the sky view of a csv of panoramas from its maps; that of a session is by `pair`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.records import Panorama, Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.sky.sky_view import Captured, SkyPicture, SkyView, cut_panorama, sky_view_of
from fieldlum.sky.sky_view.measured_discs import NO_DISCS, MeasuredDiscs

_PIXEL_SIGMA = 1 / np.sqrt(12.0)  # standard deviation of a place within a pixel


def with_sky_view(
    data: Dataset, file: Path | None = None, *, progress: Progress = quiet
) -> Dataset:
    """Return the captures with a sky view: of `file`, else their own, else estimated from the maps.

    Captures with blinds or snow are not used for it, unless all have the same. Raises InputError
    for a file that is not a sky view.
    """
    if file is not None:
        return replace(data, sky_view=SkyView.read(file))
    if data.sky_view is not None:
        return data
    light = data.light

    def read(k: int) -> SkyPicture:
        shown = np.where(data.seen, data.luminance_cdm2[k], np.nan)
        return cut_panorama(Panorama(shown, data.heading_deg, t_utc=light.t_utc[k]))

    captured = Captured(light, read, data.disc_lx / np.maximum(light.direct_lx, 1.0))
    site, discs = data.setup.site, _discs(data)
    view = sky_view_of(captured, discs, site, data.heading_deg, progress=progress)
    return replace(data, sky_view=view)


def _discs(data: Dataset) -> MeasuredDiscs:
    """Return the discs' places in the maps, which are known to a pixel."""
    if data.disc_deg is None or not (rows := np.flatnonzero(np.isfinite(data.disc_deg[:, 0]))).size:
        return NO_DISCS
    altitude, azimuth = data.disc_deg[rows].T
    sigma = np.full(len(rows), 180.0 / data.shape[0] * _PIXEL_SIGMA)
    return MeasuredDiscs(altitude, azimuth, sigma, tuple(data.light.t_utc[k] for k in rows))
