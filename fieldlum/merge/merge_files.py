"""`fieldlum merge --frames`: a list of files to one picture, .exr or .hdr, panorama or fisheye."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldlum.errors import InputError
from fieldlum.images import write_panorama, write_radiance_hdr
from fieldlum.merge.bracket import MergeResult, merge_shots
from fieldlum.merge.shots import shots_of_files
from fieldlum.photometry import vertical_illuminance_lx
from fieldlum.profiles import CameraProfile
from fieldlum.projection import Equirect, Fisheye
from fieldlum.projection.resample import Target
from fieldlum.records import Progress, quiet
from fieldlum.session import replacing_path


def fisheye_target(profile: CameraProfile, pixels: int) -> Fisheye:
    """Along the axis of the camera's first lens, with its full angle."""
    lens = profile.lens[0]
    return Fisheye(pixels, lens.full_angle_deg, lens.geometry)


def axis_illuminance_lx(result: MergeResult, target: Target) -> float:
    """On a plane across the picture's axis: vertical illuminance for a camera that looks
    horizontally. [lx]
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
    *,
    pixels: int,
    projection: str = "equirect",
    heading_deg: float = 180.0,
    fit: bool | None = None,
    drop_moved: bool = False,
    progress: Progress = quiet,
) -> tuple[MergeResult, dict[str, float]]:
    """Merge and write; returns the result and its illuminance. Raises InputError."""
    if out.suffix.lower() not in (".exr", ".hdr"):
        raise InputError(out, f"suffix '{out.suffix}'", ".exr or .hdr")
    target: Target = (
        Equirect(pixels) if projection == "equirect" else fisheye_target(profile, pixels)
    )
    result = merge_shots(
        shots_of_files(files, profile.camera.fixed_f_number),
        profile,
        target=target,
        heading_deg=heading_deg,
        fit=fit,
        drop_moved=drop_moved,
        progress=progress,
    )
    panorama = result.panorama
    with replacing_path(out) as path:
        if out.suffix.lower() == ".exr":
            write_panorama(path, panorama, view=result.view or "equirect")
        else:
            colours = panorama.rgb if panorama.rgb is not None else panorama.luminance_cdm2
            heading = None if result.view else panorama.heading_deg
            write_radiance_hdr(path, colours, view=result.view, heading_deg=heading)
    return result, {"vertical_illuminance_lx": axis_illuminance_lx(result, target)}
