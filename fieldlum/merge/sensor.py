"""Merge the frames of one heading on the sensor, step by step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fieldlum.core.arrays import Mask
from fieldlum.core.records import Progress, quiet
from fieldlum.merge.defects import good_pixels
from fieldlum.merge.estimator import Merged, Signal, merge_signals
from fieldlum.merge.exposures import (
    ExposureTrust,
    SampledFrames,
    decide_shutter_law,
    fit_exposures,
    sample_frames,
    trust_in,
)
from fieldlum.merge.frame_cache import FRAMES_BYTES, FrameStore
from fieldlum.merge.frame_checks import FirstLook, first_look
from fieldlum.merge.frames import Crop, lens_crop, load_raw, over_colours, over_mosaic
from fieldlum.merge.jpeg_noise import footprint_px, with_seen_noise
from fieldlum.merge.jpeg_signal import load_jpeg
from fieldlum.merge.motion import leave_out_moved
from fieldlum.merge.noise import SeenNoise, seen_noise
from fieldlum.merge.options import MergeOptions
from fieldlum.merge.ratios import RatioCurve
from fieldlum.merge.shift import Moved, shifts
from fieldlum.merge.shots import Shot, stated_law
from fieldlum.optics.linear_light import lens_geometry
from fieldlum.optics.photometry import RatioFit, ShutterLaw
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import LensGeometry
from fieldlum.optics.projection.grids import Target


@dataclass(frozen=True, slots=True)
class SensorImage:
    """Merged pixels of the sensor in the camera's own colours, and the direction of the camera.

    merged: pixels of the crop; crop: the part of the sensor that was read. turn_deg: heading of the
    camera minus that of the target, clockwise. f_number: of the frames. u_curve: relative
    uncertainty due to the exposures, over luminance. good: mask [height, width] of the crop, False
    at bad pixels; None if every pixel is good.
    """

    merged: Merged
    crop: Crop
    turn_deg: float
    f_number: float
    u_curve: RatioCurve
    good: Mask | None = None


@dataclass(frozen=True, slots=True)
class Findings:
    """What the frames of one heading showed about exposures, noise, saturation and motion.

    law: how nominal shutter times were read; fit: corrections of the exposures; trust: their
    uncertainty; look: saturation and black level; noise: noise over the profile's. moved: turns of
    the camera between frames, only for pairs of frames with enough common edges. dropped: share (0
    to 1) of its pixels that each frame lost to motion, empty without `drop_moved`.
    """

    shots: tuple[Shot, ...]
    law: ShutterLaw
    fit: RatioFit
    trust: ExposureTrust
    look: FirstLook
    noise: SeenNoise
    moved: tuple[Moved, ...]
    dropped: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Frames:
    """The opened frames of one heading, with what every later step needs."""

    shots: tuple[Shot, ...]
    profile: CameraProfile  # with the shutter law that the frames are read with
    crop: Crop
    look: FirstLook
    store: FrameStore

    @property
    def raw(self) -> bool:
        return self.profile.camera.kind == "raw"

    @property
    def lenses(self) -> list[LensGeometry]:
        """Geometry of each lens, in pixels of the crop."""
        corner_px = (self.crop.left, self.crop.top)
        return [lens_geometry(lens, corner_px=corner_px) for lens in self.profile.lens]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's array."""
        height, width = self.crop.height, self.crop.width
        return (height // 2, 2, width) if self.raw else (height, width, 3)


def merge_sensor(
    shots: Sequence[Shot],
    profile: CameraProfile,
    options: MergeOptions | None = None,
    *,
    turn_deg: float = 0.0,
    budget_bytes: int = FRAMES_BYTES,
    progress: Progress = quiet,
) -> tuple[SensorImage, Findings]:
    """Merge the frames of one heading.

    shots: sorted by exposure, longest first. turn_deg: heading of the camera minus that of the
    resulting picture, clockwise. budget_bytes: memory for frames; others are read again in each
    pass. Return the merged pixels, and what the frames showed. Raises InputError for a frame that
    cannot be read or is of another camera.
    """
    options = options or MergeOptions()
    fits = options.fits(profile)
    law = stated_law(shots, profile)
    frames = _open_frames(shots, replace(profile, shutter_law=law.law), budget_bytes)
    moved = shifts([frames.store.small(i) for i in range(len(shots))], frames.lenses)
    sampled, law = decide_shutter_law(
        frames.store, sample_frames(frames.store), law, shots, frames.profile
    )
    fit, prior = fit_exposures(sampled, shots, replace(profile, shutter_law=law.law), fits)
    frames.store.correct(fit.correction)
    noise = _check_noise(frames, sampled, fit, fits)
    trust = trust_in(fit, prior, sampled, profile, fits)
    merged, dropped = _merge_pixels(frames, trust.tolerance, options.drop_moved, progress)
    if not frames.raw:
        merged = _with_jpeg_noise(frames, merged, options.target(profile))
    image = SensorImage(
        merged,
        frames.crop,
        turn_deg,
        shots[0].exposure.f_number,
        trust.u_curve,
        good_pixels(profile, frames.crop, merged.flags),
    )
    findings = Findings(tuple(shots), law, fit, trust, frames.look, noise, tuple(moved), dropped)
    return image, findings


def _open_frames(shots: Sequence[Shot], profile: CameraProfile, budget_bytes: int) -> _Frames:
    """Prepare the frames; each is read when it is first needed."""
    crop, look = lens_crop(profile), first_look(shots, profile)
    last = len(shots) - 1
    loaders: Sequence[Callable[[], Signal]]
    if profile.camera.kind == "raw":
        loaders = [partial(load_raw, s, profile, crop, look.plateau(s)) for s in shots]
    else:
        loaders = [
            partial(load_jpeg, s, profile, crop, (i == 0, i == last)) for i, s in enumerate(shots)
        ]
    return _Frames(tuple(shots), profile, crop, look, FrameStore(loaders, budget_bytes))


def _check_noise(frames: _Frames, sampled: SampledFrames, fit: RatioFit, fits: bool) -> SeenNoise:
    """Return the factors of the frames' noise over the profile's, and apply them to the frames."""
    if not (frames.raw and fits):
        return SeenNoise()
    noise = seen_noise(sampled.samples, sampled.pairs, fit.correction)
    frames.store.noisier(noise.shot, noise.read)
    return noise


def _merge_pixels(
    frames: _Frames, tolerance: float, drop_moved: bool, progress: Progress
) -> tuple[Merged, tuple[float, ...]]:
    """Return the merged pixels, and the share of its pixels that each frame lost to motion."""
    store = frames.store
    loaders = [partial(store.__getitem__, i) for i in range(len(store))]
    merged = merge_signals(
        loaders, frames.shape, u_ratio=tolerance, resident=store.resident, progress=progress
    )
    if not drop_moved:
        return merged, ()
    over = over_mosaic if frames.raw else over_colours
    return leave_out_moved(loaders, merged, u_ratio=tolerance, over_picture=over)


def _with_jpeg_noise(frames: _Frames, merged: Merged, target: Target) -> Merged:
    """Return the pixels with the measured noise of means over one target pixel."""
    edge_px = float(np.mean([footprint_px(lens, target) for lens in frames.lenses]))
    return with_seen_noise(merged, frames.store, frames.profile.colour.y_from_rgb, edge_px)
