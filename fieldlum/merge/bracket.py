"""Merge one bracket, of one or several headings, from its frames to a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, JsonTable, Panorama, Progress, quiet
from fieldlum.merge.disc import MEASURED, sun_on_sensor, take_out_disc
from fieldlum.merge.project import blend, finish, view_through
from fieldlum.merge.quality import floating_white_balance, report_of, verdict
from fieldlum.merge.sensor import Findings, SensorImage, merge_sensor
from fieldlum.merge.shots import Shot, middle_of, shots_of_files, sorted_shots
from fieldlum.merge.sky_cut import sky_cut
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.linear_light import lens_geometry
from fieldlum.optics.photometry import vertical_illuminance_lx
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import Equirect, Fisheye, Target
from fieldlum.session import replacing_path
from fieldlum.session.files.merge_report import MergeReport
from fieldlum.session.files.sidecar import MeasuredSun
from fieldlum.sky.sky_view import SkyPicture
from fieldlum.sky.sun_disc import SunDisc


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How brackets are merged.

    height: rows of the result [px]; 230 are pixels of 0.8 degrees (docs/design.md). projection:
    "equirect" (a panorama, twice as wide as high) or "fisheye" (a square picture along the first
    lens). fit: whether exposure ratios are estimated from the frames, instead of taken from the
    profile; None: for raw frames only.
    """

    height: int = 230
    projection: str = "equirect"
    fit: bool | None = None

    def target(self, profile: CameraProfile) -> Target:
        """Return the pixel grid of the result: a panorama, or a fisheye like the first lens."""
        if self.projection == "equirect":
            return Equirect(self.height)
        lens = profile.lens[0]
        return Fisheye(self.height, lens.full_angle_deg, lens)


@dataclass(frozen=True, slots=True)
class MergeResult:
    """A merged bracket: its map, a one-line verdict, and the figures that the verdict rests on.

    view: Radiance's view options of a fisheye picture, empty for a panorama. sun: the measured
    centre of the sun's disc; None if the disc was not searched for or is not visible. sky: the
    luminance around what can be sky; None if it was not requested or there is none.
    """

    panorama: Panorama
    report: MergeReport
    verdict: str
    view: str = ""
    sun: MeasuredSun | None = None
    sky: SkyPicture | None = None

    @property
    def quality(self) -> JsonTable:
        """Return the report as the object `quality` of `merge --json`."""
        return self.report.table()


def merge_headings(
    shots: Sequence[Shot],
    profile: CameraProfile,
    options: MergeOptions,
    *,
    heading_deg: float,
    progress: Progress = quiet,
) -> tuple[list[SensorImage], list[Findings]]:
    """Merge the frames of each heading on the sensor.

    shots: in the order of `sorted_shots`: by heading, then longest exposure first. heading_deg:
    azimuth of the resulting picture's centre, clockwise from true north. Return two lists with one
    item for each heading: the merged pixels of the sensor, and what its frames showed.
    """
    images, findings = [], []
    for heading, group in groupby(shots, key=lambda s: s.heading_deg):
        turn_deg = 0.0 if heading is None else heading - heading_deg
        image, part = merge_sensor(
            list(group), profile, fit=options.fit, turn_deg=turn_deg, progress=progress
        )
        images.append(image)
        findings.append(part)
    return images, findings


def merge_shots(
    shots: Sequence[Shot],
    profile: CameraProfile,
    options: MergeOptions | None = None,
    *,
    heading_deg: float = 180.0,
    sun_deg: tuple[float, float] | None = None,
    latitude_deg: float | None = None,
    progress: Progress = quiet,
) -> MergeResult:
    """Merge a bracket of one or several headings.

    shots: in any order. heading_deg: azimuth of the resulting picture's centre, clockwise from true
    north. sun_deg: the sun's apparent altitude and azimuth; if the disc is visible there, it is
    removed from a panorama (not from a fisheye picture). None: the disc is not searched for.
    latitude_deg: of the camera, for the luminance around what can be sky; None: it is not cut.
    Raises InputError if the frames cannot be merged.
    """
    options = options or MergeOptions()
    target = options.target(profile)
    floating = floating_white_balance(shots, profile)
    if floating:
        profile = replace(profile, colour=replace(profile.colour, melanopic_from_rgb=()))
    images, findings = merge_headings(
        sorted_shots(shots, profile), profile, options, heading_deg=heading_deg, progress=progress
    )
    views = [
        view_through(image, lens, profile, target) for image in images for lens in profile.lens
    ]
    seen = blend(views)
    panorama = finish(seen, profile, target, heading_deg=heading_deg, t_utc=middle_of(shots))
    assert panorama.flags is not None  # `finish` always sets the flags
    report = report_of(findings, panorama.flags, target, profile)
    sun = sky = None
    if latitude_deg is not None and isinstance(target, Equirect):
        sky = sky_cut(images, views, seen, profile, target, heading_deg, latitude_deg)
    if sun_deg is not None and isinstance(target, Equirect):
        panorama, disc = take_out_disc(panorama, *sun_deg)
        sun = None if disc is None else _measured_sun(images, findings, profile, panorama, disc)
    view = "" if isinstance(target, Equirect) else target.view(heading_deg)
    text = verdict(report)
    if floating:
        text += (
            f"; no melanopic colour, because EXIF of {floating} states no fixed white balance: "
            "set one in the camera, the same as in the calibration"
        )
    return MergeResult(panorama, report, text, view, sun, sky)


def _measured_sun(
    images: Sequence[SensorImage],
    findings: Sequence[Findings],
    profile: CameraProfile,
    panorama: Panorama,
    disc: SunDisc,
) -> MeasuredSun | None:
    """Return the disc's centre, measured on the sensor pixels, and the time of those frames.

    The centre comes from the frames taken through a filter. Without a filter it comes from the
    least exposed frame of each heading.
    """
    views = []
    for image in images:
        light, flags, crop = image.merged.value_cdm2, image.merged.flags, image.crop
        if profile.camera.kind == "jpeg":
            light = light @ np.asarray(profile.colour.y_from_rgb, np.float32)  # [h, w]
            flags = np.bitwise_or.reduce(flags, axis=-1)
        clipped = (flags.reshape(crop.height, -1) & Flag.CLIPPED_HIGH) > 0
        for lens in profile.lens:
            geometry = lens_geometry(lens, image.turn_deg, (crop.left, crop.top))
            views.append((light.reshape(crop.height, -1), clipped, geometry))
    pixel_rad = np.pi / len(panorama.luminance_cdm2)
    place = sun_on_sensor(views, disc, panorama.heading_deg, pixel_rad)
    if place is None:
        return None
    filtered = [s for part in findings for s in part.shots if s.exposure.nd]
    through = panorama.sun is not None and panorama.sun.origin == MEASURED
    shown = filtered if through else [part.shots[-1] for part in findings]
    times = [s.t_utc.timestamp() for s in shown if s.t_utc is not None]
    t_utc = datetime.fromtimestamp(float(np.mean(times)), UTC) if times else None
    altitude_deg, azimuth_deg, sigma_deg = place
    return MeasuredSun(
        round(altitude_deg, 4), round(azimuth_deg, 4), float(f"{sigma_deg:.3g}"), t_utc
    )


def merge_frames(
    files: Sequence[Path],
    profile: CameraProfile,
    options: MergeOptions | None = None,
    *,
    heading_deg: float = 180.0,
    progress: Progress = quiet,
) -> MergeResult:
    """Merge raw or JPEG files of one bracket and one heading; exposures come from their EXIF.

    heading_deg: azimuth of the picture's centre, clockwise from true north. The sun's disc is not
    searched for. Raises InputError if the files cannot be merged.
    """
    shots = shots_of_files(files, profile.camera.fixed_f_number)
    return merge_shots(shots, profile, options, heading_deg=heading_deg, progress=progress)


# ----------------------------------------------------------------------------------------------
# one picture file (`fieldlum merge --frames`)


def _axis_illuminance_lx(result: MergeResult, target: Target) -> float:
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

    The illuminance is at the camera, on a plane that faces the picture's centre. heading_deg:
    azimuth of the picture's centre, clockwise from true north. Raises InputError for a frame that
    cannot be merged, or if `out` ends neither in .exr nor in .hdr.
    """
    if out.suffix.lower() not in (".exr", ".hdr"):
        remedy = "name --out with one of these suffixes"
        raise InputError(out, f"the file has the suffix '{out.suffix}'", ".exr or .hdr", remedy)
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
    illuminance_lx = _axis_illuminance_lx(result, options.target(profile))
    return result, {"vertical_illuminance_lx": illuminance_lx}
