"""Estimate the sky view of a csv of panoramas from its maps; that of a session is by `pair`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.records import Panorama, Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.sky.sky_view import Captured, SkyPicture, SkyView, cut_panorama, sky_view_of
from fieldlum.sky.sky_view.measured_discs import NO_DISCS


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
    view = sky_view_of(captured, NO_DISCS, data.setup.site, data.heading_deg, progress=progress)
    return replace(data, sky_view=view)
