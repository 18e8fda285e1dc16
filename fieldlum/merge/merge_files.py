"""Merge files to one panorama or fisheye picture in .exr or .hdr (`fieldlum merge --frames`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, quiet
from fieldlum.merge.bracket import MergeResult, merge_frames
from fieldlum.merge.options import MergeOptions
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.photometry import vertical_illuminance_lx
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import Equirect
from fieldlum.optics.projection.grids import Target
from fieldlum.session import replacing_path


def axis_illuminance_lx(result: MergeResult, target: Target) -> float:
    """Return the illuminance [lx] at the camera on a plane that faces the picture's centre.

    target: pixel grid of the picture. This is the vertical illuminance for a camera that looks
    horizontally.
    """
    panorama = result.panorama
    if isinstance(target, Equirect):
        return vertical_illuminance_lx(
            panorama.luminance_cdm2, panorama.heading_deg, panorama.heading_deg
        )
    centre = np.arange(target.size) + 0.5
    cosine = np.maximum(np.cos(target.angles(centre, centre)), 0.0)
    return float((panorama.luminance_cdm2 * cosine * target.solid_angles()).sum())


def files_to_picture(
    files: Sequence[Path],
    profile: CameraProfile,
    out: Path,
    options: MergeOptions | None = None,
    *,
    heading_deg: float = 180.0,
    progress: Progress = quiet,
) -> tuple[MergeResult, dict[str, float]]:
    """Merge files and write the picture; return the result and {"vertical_illuminance_lx": lx}.

    The illuminance is that of `axis_illuminance_lx`. heading_deg: azimuth of the picture's centre,
    clockwise from true north. Raises InputError for a frame that cannot be merged, or if `out` ends
    neither in .exr nor in .hdr.
    """
    if out.suffix.lower() not in (".exr", ".hdr"):
        raise InputError(
            out,
            f"the file has the suffix '{out.suffix}'",
            ".exr or .hdr",
            "name --out with one of these suffixes",
        )
    options = options or MergeOptions()
    result = merge_frames(files, profile, options, heading_deg=heading_deg, progress=progress)
    panorama = result.panorama
    with replacing_path(out) as path:
        if out.suffix.lower() == ".exr":
            write_panorama(path, panorama, view=result.view or "equirect")
        else:
            colours = panorama.rgb if panorama.rgb is not None else panorama.luminance_cdm2
            heading = None if result.view else panorama.heading_deg
            write_radiance_hdr(path, colours, view=result.view, heading_deg=heading)
    illuminance_lx = axis_illuminance_lx(result, options.target(profile))
    return result, {"vertical_illuminance_lx": illuminance_lx}
