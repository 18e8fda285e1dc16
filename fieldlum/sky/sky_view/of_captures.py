"""Estimate the sky view of captures in the pose that their measured discs give."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Progress, Site, quiet
from fieldlum.sky.sky_view.estimate import Captured, estimate, usual_rows
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs
from fieldlum.sky.sky_view.pose import pose_of_discs
from fieldlum.sky.sky_view.view import SkyView


def sky_view_of(
    captured: Captured,
    discs: MeasuredDiscs,
    site: Site,
    heading_deg: float,
    in_lens: Callable[[Floats], Mask] | None = None,
    progress: Progress = quiet,
) -> SkyView:
    """Return the sky view of captures. Those with blinds or snow are not used, unless all are.

    discs: that merge measured; heading_deg: stated azimuth of the pictures' centre column; in_lens:
    returns, for directions [p, 3], whether a lens saw them, for sky pictures that are cut. Raises
    NotEnoughDataError without a capture by daylight.
    """
    light = captured.light
    times = np.array([t.timestamp() for t in light.t_utc])
    nearest = [int(np.abs(times - t.timestamp()).argmin()) for t in discs.t_utc]
    pose = pose_of_discs(discs, site, heading_deg, captured.disc_share[nearest])
    usual = captured.take(usual_rows(light.states, len(light)))
    return estimate(usual, in_lens, progress, pose, site.latitude_deg)
