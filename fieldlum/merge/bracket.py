"""One bracket from files to a map: the order of work, and what is said about its quality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.images import calibration_mark
from fieldlum.linear_light import lens_geometry, true_shutter_s
from fieldlum.merge.defects import good_pixels
from fieldlum.merge.disc import MEASURED, MeasuredSun, sun_on_sensor, take_out_disc
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.frame_cache import FRAMES_BYTES, FrameStore
from fieldlum.merge.frame_checks import FirstLook, first_look, held_otherwise
from fieldlum.merge.frames import (
    Crop,
    lens_crop,
    load_jpeg,
    load_raw,
    over_colours,
    over_mosaic,
)
from fieldlum.merge.jpeg_noise import footprint_px, with_seen_noise
from fieldlum.merge.motion import leave_out_moved
from fieldlum.merge.noise import SeenNoise, seen_noise
from fieldlum.merge.project import LensView, SensorMap, blend, finish, view_through
from fieldlum.merge.quality import Offsets, quality_of, verdict
from fieldlum.merge.ratios import (
    Neighbours,
    RatioCurve,
    beyond,
    bracket_pairs,
    free_fit,
    neighbours,
    ratio_curve,
    take_samples,
    unexplained,
)
from fieldlum.merge.shift import Moved, shifts
from fieldlum.merge.shots import (
    Shot,
    exposure_covariance,
    shots_of_files,
    sorted_shots,
    stated_law,
    times_by_law,
)
from fieldlum.photometry import RatioFit, ShutterLaw, fit_ratios, law_of_frames
from fieldlum.profiles import CameraProfile
from fieldlum.projection import Equirect
from fieldlum.projection.resample import Target
from fieldlum.records import Flag, Panorama, Progress, quiet
from fieldlum.sun_disc import SunDisc


@dataclass(frozen=True, slots=True)
class MergeResult:
    """The map, one line about it, and the figures behind that line. view: Radiance's words,
    empty for a panorama. sun: where the disc is, when it was looked for and found.
    """

    panorama: Panorama
    quality: dict[str, Any]
    verdict: str
    view: str = ""
    sun: MeasuredSun | None = None


@dataclass(frozen=True, slots=True)
class SensorMerge:
    """One bracket of one heading, merged on the sensor; luminance in the camera's own colours."""

    merged: Merged
    shots: tuple[Shot, ...]
    crop: Crop
    fit: RatioFit
    neighbours: tuple[Neighbours, ...]
    moved: tuple[Moved, ...]
    look: FirstLook
    noise: SeenNoise
    off: Offsets
    u_ratio: float  # typical of its frames; `u_curve` is what a value gets
    u_curve: RatioCurve
    dropped: tuple[
        float, ...
    ]  # share of its pixels that each frame lost to motion; empty: not asked for
    law: ShutterLaw


def merge_sensor(
    shots: Sequence[Shot],
    profile: CameraProfile,
    *,
    fit: bool | None = None,
    drop_moved: bool = False,
    target: Target | None = None,
    budget_bytes: int = FRAMES_BYTES,
    progress: Progress = quiet,
) -> SensorMerge:
    """Merge frames of one heading, sorted by exposure. fit: estimate exposure ratios (default: of
    raw frames).

    target: what the result is meant for: a JPEG's noise depends on how many of its pixels go into
    one. drop_moved: leave frames out of pixels where most others agree that something moved through
    them.

    Raises InputError for a frame that cannot be read or does not belong.
    """
    crop = lens_crop(profile)
    law = stated_law(shots, profile)
    assumed = profile = replace(profile, shutter_law=law.law)  # as every frame is read
    raw = profile.camera.kind == "raw"
    look = first_look(shots, profile)

    def loader(i: int) -> Any:
        if raw:
            return load_raw(shots[i], assumed, crop, look.plateau(shots[i]))
        return load_jpeg(shots[i], assumed, crop, (i == 0, i == len(shots) - 1))

    store = FrameStore([lambda i=i: loader(i) for i in range(len(shots))], budget_bytes)
    lenses = [lens_geometry(lens, corner_px=(crop.left, crop.top)) for lens in profile.lens]
    moved = shifts([store.small(i) for i in range(len(store))], lenses)
    samples = take_samples(store)
    pairs = bracket_pairs(samples)
    if law.decided_by == "labels":
        by_law = times_by_law(shots, profile)
        law = law_of_frames(by_law, law, pairs)
        if law.law != profile.shutter_law:
            times = [true_shutter_s(shot.exposure.shutter_s, assumed)[0] for shot in shots]
            store.correct(by_law[law.law] / np.asarray(times))
            profile = replace(profile, shutter_law=law.law)
            samples = take_samples(store)
            pairs = bracket_pairs(samples)
    wanted = raw if fit is None else fit
    prior = exposure_covariance([s.exposure for s in shots], profile)
    ratios = fit_ratios(pairs if wanted else [], prior)
    store.correct(ratios.correction)
    noise = seen_noise(samples, pairs, ratios.correction) if raw and wanted else SeenNoise()
    store.noisier(noise.shot, noise.read)
    left = neighbours(pairs, ratios.correction)
    typical = float(np.median(ratios.u_log))
    response = 0.0 if raw else profile.response.u_rel
    explained = response if wanted else float(np.hypot(response, typical))
    seeming = ratios if wanted else free_fit(pairs, len(shots))
    off = Offsets(np.log(seeming.correction), np.hypot(np.sqrt(np.diag(prior)), response))
    extra = max(unexplained(left, explained), 0.0 if wanted else beyond(seeming, explained))
    apart = (
        float(np.median([abs(n.residual_percent) for n in left])) / 100
        if left and not wanted
        else typical
    )
    shape = (crop.height // 2, 2, crop.width) if raw else (crop.height, crop.width, 3)
    tolerance = max(
        0.003, 3 * apart, response
    )  # what a JPEG's response gets wrong is no motion either
    frames = [lambda i=i: store[i] for i in range(len(shots))]
    merged = merge_signals(
        frames, shape, u_ratio=tolerance, resident=store.resident, progress=progress
    )
    dropped: tuple[float, ...] = ()
    if drop_moved:
        over = over_mosaic if raw else over_colours
        merged, dropped = leave_out_moved(frames, merged, u_ratio=tolerance, over_picture=over)
    if not raw and target is not None:
        edge_px = float(np.mean([footprint_px(lens, target) for lens in lenses]))
        merged = with_seen_noise(merged, store, profile.colour.y_from_rgb, edge_px)
    u_ratio, curve = float(np.hypot(typical, extra)), ratio_curve(samples, ratios.covariance, extra)
    return SensorMerge(
        merged,
        tuple(shots),
        crop,
        ratios,
        tuple(left),
        tuple(moved),
        look,
        noise,
        off,
        u_ratio,
        curve,
        dropped,
        law,
    )


def look_through(
    shots: Sequence[Shot],
    profile: CameraProfile,
    *,
    target: Target,
    heading_deg: float,
    fit: bool | None = None,
    drop_moved: bool = False,
    progress: Progress = quiet,
) -> tuple[list[SensorMerge], list[LensView]]:
    """Merge each heading of sorted shots on the sensor, and look at the target grid through
    every lens of each.
    """
    views, parts = [], []
    for heading, group in groupby(shots, key=lambda s: s.heading_deg):
        part = merge_sensor(
            list(group), profile, fit=fit, drop_moved=drop_moved, target=target, progress=progress
        )
        parts.append(part)
        turn = 0.0 if heading is None else heading - heading_deg
        good = good_pixels(profile, part.crop, part.merged.flags)
        sensor = SensorMap(
            part.merged, part.crop, turn, part.shots[0].exposure.f_number, part.u_curve, good
        )
        views += [view_through(sensor, lens, profile, target) for lens in profile.lens]
    return parts, views


def merge_shots(
    shots: Sequence[Shot],
    profile: CameraProfile,
    *,
    target: Target,
    heading_deg: float,
    fit: bool | None = None,
    drop_moved: bool = False,
    sun_deg: tuple[float, float] | None = None,
    progress: Progress = quiet,
) -> MergeResult:
    """Merge a bracket of one or several headings to a target grid. Raises InputError.

    sun_deg: the sun's apparent altitude and azimuth; its disc is then taken out of a panorama.
    """
    ordered = sorted_shots(shots, profile)
    parts, views = look_through(
        ordered,
        profile,
        target=target,
        heading_deg=heading_deg,
        fit=fit,
        drop_moved=drop_moved,
        progress=progress,
    )
    done = finish(blend(views), profile, target)
    quality = {
        **quality_of(parts, done.flags, target),
        "held_otherwise": held_otherwise(ordered, profile),
    }
    times = [s.t_utc for s in ordered if s.t_utc is not None]
    middle = min(times) + (max(times) - min(times)) / 2 if times else None
    panorama = Panorama(
        done.luminance_cdm2,
        heading_deg,
        done.u_cdm2,
        done.flags,
        middle,
        None,
        done.rgb,
        calibration_mark(profile),
    )
    sun = None
    if sun_deg is not None and isinstance(target, Equirect):
        panorama, disc = take_out_disc(panorama, *sun_deg)
        sun = None if disc is None else _measured_sun(parts, profile, panorama, disc)
    view = "" if isinstance(target, Equirect) else target.view
    return MergeResult(panorama, quality, verdict(quality), view, sun)


def _measured_sun(
    parts: Sequence[SensorMerge], profile: CameraProfile, panorama: Panorama, disc: SunDisc
) -> MeasuredSun | None:
    """Return the disc's centre by the sensor pixels, and when the frames that show it were taken.

    These are the frames through a filter, else the least exposed one of each heading.
    """
    views = []
    for part in parts:
        light, flags = part.merged.value_cdm2, part.merged.flags
        if profile.camera.kind == "jpeg":
            light = light @ np.asarray(profile.colour.y_from_rgb, np.float32)  # [h, w]
            flags = np.bitwise_or.reduce(flags, axis=-1)
        clipped = (flags.reshape(part.crop.height, -1) & Flag.CLIPPED_HIGH) > 0
        turn_deg = (part.shots[0].heading_deg or panorama.heading_deg) - panorama.heading_deg
        for lens in profile.lens:
            geometry = lens_geometry(lens, turn_deg, (part.crop.left, part.crop.top))
            views.append((light.reshape(part.crop.height, -1), clipped, geometry))
    pixel_rad = np.pi / len(panorama.luminance_cdm2)
    place = sun_on_sensor(views, disc, panorama.heading_deg, pixel_rad)
    if place is None:
        return None
    filtered = [s for part in parts for s in part.shots if s.exposure.nd]
    through = panorama.sun is not None and panorama.sun.origin == MEASURED
    shown = filtered if through else [part.shots[-1] for part in parts]
    times = [s.t_utc.timestamp() for s in shown if s.t_utc is not None]
    t_utc = datetime.fromtimestamp(float(np.mean(times)), UTC) if times else None
    return MeasuredSun(*place, t_utc)


def merge_frames(
    files: Sequence[Path],
    profile: CameraProfile,
    *,
    height: int = 230,
    heading_deg: float = 180.0,
    shots: Sequence[Shot] | None = None,
    fit: bool | None = None,
    drop_moved: bool = False,
    sun_deg: tuple[float, float] | None = None,
    progress: Progress = quiet,
) -> MergeResult:
    """A bracket of raw or JPEG files to a luminance panorama [height, 2 height].

    shots: the same frames with what is known beside their EXIF (headings, times, filters).
    Raises InputError, naming the file, for anything that cannot be merged.
    """
    known = (
        list(shots) if shots is not None else shots_of_files(files, profile.camera.fixed_f_number)
    )
    return merge_shots(
        known,
        profile,
        target=Equirect(height),
        heading_deg=heading_deg,
        fit=fit,
        drop_moved=drop_moved,
        sun_deg=sun_deg,
        progress=progress,
    )
