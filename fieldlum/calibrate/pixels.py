"""Find hot, dead and stuck pixels: they deviate from their neighbours in most views.

The neighbours are those of the same colour. A small light or the edge of an object deviates too,
but in fewer views. The camera must be turned between the views; the details of the pictures show
whether it was. With the cap on (`dark`) no light can be mistaken for a defect, but dead pixels are
invisible. A pixel must deviate in three quarters of the views, or in more views if good pixels
would otherwise do so by chance. If even all views are too few, there is no result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.readings import own_mosaic, require
from fieldlum.core.arrays import Indices, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import counted
from fieldlum.optics.linear_light import black_dn, full_dn, gain_e_per_dn
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import Mosaic, channel_positions, is_jpeg, possible_frames

# Limits are chosen so that simulated defects are found and lights are not (tests); not measured on
# real sensors.
MIN_VIEWS, MIN_DARK = 3, 2
MAX_SHARE = 1e-3  # largest share of bad pixels; more are not a list of defects
_SIGMA = 6.0  # of the noise
_MIN_REL = 0.1  # of the light: smaller deviations are normal for a sensor
_SPREAD = 4.0  # largest multiple of the neighbours' median deviation from their own median
_CHANCE = 0.5  # largest number of pixels expected to deviate everywhere by chance
_INSIDE = 0.97  # of a lens's circle, because its edge is the same in every view
_BLOCK = 4  # pixels of one colour along the edge of a block of detail
_DETAIL = 5.0, 0.03  # sigma of the noise, share of the light: a smaller step is no detail
_MIN_DETAIL = 30  # number of blocks with detail
_SAME_VIEW_CORRELATION = 0.3  # of the detail of two pictures, from which they show one view
_MAX_ALIKE = 2  # neighbours that may be like a defect, as in a line of defects
_FULL = 0.9  # of the saturation; pixels in brighter surroundings are not judged

View = tuple[Indices, NDArray[np.int8]]  # deviating pixels in the mosaic, and details


@dataclass(frozen=True, slots=True)
class PixelDefects:
    """Bad pixels (column, row) on the sensor, and the evidence.

    views : number of different views, or of dark frames; frames : the frames that were read;
    by_chance : number of good pixels expected among bad_px by chance; line : text for the profile.
    """

    bad_px: tuple[tuple[int, int], ...]
    views: int
    frames: tuple[Path, ...]
    by_chance: float
    line: str


class _Plane(NamedTuple):
    """One of R, G1, G2 and B: where it is in the mosaic, its counts, and its levels."""

    at: tuple[slice, slice]
    counts: NDArray[np.uint16]
    black: float
    gain: float  # electrons per count
    full: float


def find(sources: Sequence[Path], profile: CameraProfile, *, dark: bool = False) -> PixelDefects:
    """Find the bad pixels of a raw camera.

    sources : a frame or a folder of frames for each view; those with the same details count as one
    view, and those with too little detail are not used. dark : the frames were taken with the cap
    on, and each counts as a view. Raises InputError for frames that are not raw frames of this
    camera, and for a frame with light if `dark`; NotEnoughDataError for fewer than three different
    views (or two dark frames), or if too many pixels deviate.
    """
    if profile.camera.kind != "raw":
        finding, remedy = "the profile is of a JPEG camera", "use the camera's raw files"
        raise InputError(profile.camera.name, finding, "a profile of a raw camera", remedy)
    size = profile.camera.height_px, profile.camera.width_px
    area = np.ones(size, bool) if dark else _inside_lenses(profile)
    brackets = [_frames_of(source) for source in sources]
    frames = tuple(frame for bracket in brackets for frame in bracket)
    seen = [_view([f], profile, area, dark) for f in frames] if dark else []
    seen = seen or [_view(bracket, profile, area, dark) for bracket in brackets]
    views = [pixels for pixels, _ in seen] if dark else _different(seen)
    kind, remedy = "dark frames", "take more dark frames"
    if not dark:
        kind, remedy = "different views", "turn the camera, or put the cap on (--dark)"
        if blank := sum(int(np.count_nonzero(d % 2)) < _MIN_DETAIL for _, d in seen):
            kind += f" ({counted(blank, 'view')} with too little detail)"
    require(len(views), MIN_DARK if dark else MIN_VIEWS, f"bad pixels: {kind}", remedy)
    need, by_chance = _needed_views(views, int(area.sum()), remedy)
    pixels, times = np.unique(np.concatenate(views), return_counts=True)
    bad = pixels[times >= need]
    if len(bad) > MAX_SHARE * area.sum():
        raise NotEnoughDataError(
            f"bad pixels: {100 * len(bad) / area.sum():.2g} % of the pixels; expected at most "
            f"{100 * MAX_SHARE:g} %; check gain and read noise under [sensor], and {remedy}"
        )
    rows, columns = np.unravel_index(bad, size)
    line = (
        f"bad pixels: {len(bad)}, which deviate from their neighbours in {need} or more of "
        f"{len(views)} {kind}; {by_chance:.2g} good pixels would do so by chance"
    )
    places = tuple(zip(columns.tolist(), rows.tolist(), strict=True))
    return PixelDefects(places, len(views), frames, by_chance, line)


def _needed_views(views: Sequence[Indices], pixels: int, remedy: str) -> tuple[int, float]:
    """Return in how many views a bad pixel must deviate, and how many good pixels would by chance.

    It is three quarters of the views, or more. Raises NotEnoughDataError if all are too few.
    """
    from scipy.stats import binom

    share = float(np.mean([len(view) / pixels for view in views]))
    by_chance = 0.0
    for need in range(max(2, int(np.ceil(0.75 * len(views)))), len(views) + 1):
        by_chance = pixels * float(binom.sf(need - 1, len(views), share))
        if by_chance <= _CHANCE:
            return need, by_chance
    raise NotEnoughDataError(
        f"bad pixels: {100 * share:.2g} % of the pixels deviate in each of {len(views)} pictures, "
        f"so {by_chance:.2g} good pixels would deviate in all of them by chance; {remedy}"
    )


def _frames_of(source: Path) -> list[Path]:
    frames = possible_frames(source) if source.is_dir() else [source]
    if not frames:
        expected, remedy = "a folder of raw frames of one view", "check the path of the folder"
        raise InputError(source, "no frames in this folder", expected, remedy)
    return frames


def _view(frames: Sequence[Path], profile: CameraProfile, area: Mask, dark: bool) -> View:
    """Return the pixels that deviate in any of a view's frames, and the richest detail."""
    pixels, details = [], []
    for path in frames:
        if is_jpeg(path):
            expected = f"raw frames of {profile.camera.name}, because JPEG files blur bad pixels"
            raise InputError(path, "a JPEG frame", expected, "use the camera's raw frames")
        mosaic = own_mosaic(path, profile)
        planes = _planes(mosaic, profile)
        if dark:
            _check_dark(path, planes, profile)
        details.append(np.zeros(0, np.int8) if dark else _detail(planes[1], profile, area))
        pixels.append(np.flatnonzero(deviating(mosaic, profile, alone=not dark) & area))
    best = max(details, key=lambda detail: np.count_nonzero(detail % 2))
    return np.unique(np.concatenate(pixels)), best


def _check_dark(path: Path, planes: Sequence[_Plane], profile: CameraProfile) -> None:
    """Raise InputError if light reached a dark frame."""
    for plane in planes:
        above = float(np.percentile(plane.counts[::4, ::4], 90)) - plane.black
        noise = float(np.hypot(profile.sensor.read_noise_e / plane.gain, 1.0))
        if above > max(5 * noise, 0.01 * (profile.sensor.white_dn - plane.black)):
            finding = f"the frame is {above:.0f} DN above the black level"
            remedy = "put the lens cap on and take the frame again"
            raise InputError(path, finding, "a dark frame, without light", remedy)


def _planes(mosaic: Mosaic, profile: CameraProfile) -> list[_Plane]:
    gain = gain_e_per_dn(mosaic.exposure.iso, profile)
    places = [np.s_[r::2, c::2] for r, c in channel_positions(mosaic.cfa)]
    levels = zip(places, black_dn(mosaic, profile), full_dn(mosaic, profile), strict=True)
    return [
        _Plane(at, np.ascontiguousarray(mosaic.counts[at]), black, gain, full)
        for at, black, full in levels
    ]


def deviating(mosaic: Mosaic, profile: CameraProfile, *, alone: bool) -> Mask:
    """Return a mask [h, w] of the raw pixels that deviate from the median of their neighbourhood.

    True for a pixel that deviates. The neighbourhood is the pixel and the eight next to it of the
    same colour. A pixel deviates if it differs by more than each of these: six times the noise, a
    tenth of the light, four times the spread of the neighbourhood. False in nearly saturated
    neighbourhoods. alone : also False for a pixel with three or more neighbours that differ like
    it, as at the corner of an object.
    """
    import cv2

    is_deviating = np.zeros(mosaic.counts.shape, bool)
    for plane in _planes(mosaic, profile):
        read_dn2 = (profile.sensor.read_noise_e / plane.gain) ** 2 + 1 / 12
        middle = np.asarray(cv2.medianBlur(plane.counts, 3), np.uint16)
        off = cv2.absdiff(plane.counts, middle)
        spread = cv2.medianBlur(off, 3).astype(np.float32)
        light = np.maximum(middle.astype(np.float32) - np.float32(plane.black), 0)
        noise = np.sqrt(light / np.float32(plane.gain) + np.float32(read_dn2))
        margin = np.maximum(np.maximum(_SIGMA * noise, _MIN_REL * light), _SPREAD * spread)
        far = (off > margin) & (middle < _FULL * plane.full)
        is_deviating[plane.at] = _isolated(plane.counts, middle, far) if alone else far
    return is_deviating


def _isolated(plane: NDArray[np.uint16], middle: NDArray[np.uint16], deviating_px: Mask) -> Mask:
    """Return a mask of the pixels with at most two of eight neighbours like them.

    Pixels of a line of defects remain, those at a corner of an object do not.
    """
    rows, columns = np.nonzero(deviating_px)
    around = np.pad(plane.astype(np.int32), 1, mode="edge")
    own = around[rows + 1, columns + 1] - middle[rows, columns]
    alike = np.full(len(rows), -1)  # the pixel itself is not counted
    for down, right in np.ndindex(3, 3):
        step = around[rows + down, columns + right] - middle[rows, columns]
        alike += 2 * step * np.sign(own) > np.abs(own)
    deviating_px[rows, columns] = alike <= _MAX_ALIKE
    return deviating_px


def _inside_lenses(profile: CameraProfile) -> Mask:
    rows, columns = np.ogrid[: profile.camera.height_px, : profile.camera.width_px]
    inside = np.zeros((profile.camera.height_px, profile.camera.width_px), bool)
    for lens in profile.lens:
        (x, y), r = lens.centre_px, _INSIDE * lens.radius_px
        inside |= (columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 <= r**2
    return inside


# ----------------------------------------------------------------------------------------------
# which view


def _detail(plane: _Plane, profile: CameraProfile, area: Mask) -> NDArray[np.int8]:
    """Return the detail of a frame, in blocks of one of the two green colours.

    A block is +1 or -1 if it is brighter or darker than its neighbours, else 0. It is 2 if this is
    unknown: outside the lens, saturated, or too dark.
    """
    import cv2

    size = plane.counts.shape[1] // _BLOCK, plane.counts.shape[0] // _BLOCK
    # Remove single pixels, because defects are not details of a view.
    clean = cv2.medianBlur(plane.counts, 3).astype(np.float32) - np.float32(plane.black)
    block = np.asarray(cv2.resize(clean, size, interpolation=cv2.INTER_AREA), np.float32)
    inside = (area[plane.at] & (plane.counts < _FULL * plane.full)).astype(np.float32)
    around = np.maximum(np.asarray(cv2.medianBlur(block, 5), np.float32), 0)
    variance = around / plane.gain + (profile.sensor.read_noise_e / plane.gain) ** 2 + 1
    noise = _DETAIL[0] * np.sqrt(variance) / _BLOCK
    step = block - around
    detail = np.sign(step) * (np.abs(step) > np.maximum(noise, _DETAIL[1] * around))
    hidden = cv2.resize(inside, size, interpolation=cv2.INTER_AREA) < 0.99
    return np.where(hidden | (noise > 0.2 * around), 2, detail).astype(np.int8)


def _different(seen: Sequence[View]) -> list[Indices]:
    """Return the deviating pixels of each different view, without those with too little detail.

    Two views whose common details agree are one, and so are two that cannot be compared:
    undercounting views is safe.
    """
    from scipy.sparse.csgraph import connected_components

    used = [view for view in seen if np.count_nonzero(view[1] % 2) >= _MIN_DETAIL]
    if not used:
        return []
    is_same = np.ones((len(used), len(used)), bool)
    for i, j in np.ndindex(is_same.shape):
        a, b = used[i][1].astype(int), used[j][1].astype(int)
        both = (a != 2) & (b != 2)
        common = min(np.count_nonzero(a[both]), np.count_nonzero(b[both]))
        if common >= _MIN_DETAIL:
            is_same[i, j] = (a[both] * b[both]).sum() > _SAME_VIEW_CORRELATION * common
    count, number = connected_components(is_same)
    of_view = [[v[0] for v, n in zip(used, number, strict=True) if n == k] for k in range(count)]
    return [np.unique(np.concatenate(pixels)) for pixels in of_view]
