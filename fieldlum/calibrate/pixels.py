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

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import counted
from fieldlum.optics.linear_light import black_dn, check_frame, full_dn, gain_e_per_dn
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import Mosaic, channel_positions, is_jpeg, possible_frames, read_mosaic

# Limits are chosen so that simulated defects are found and lights are not (tests); not measured on
# real sensors.
LEAST_VIEWS = 3
LEAST_DARK = 2
MOST = 1e-3  # largest share of bad pixels; more are not a list of defects
_SIGMA = 6.0  # of the noise
_LEAST_REL = 0.1  # of the light: smaller deviations are normal for a sensor
_SPREAD = 4.0  # largest multiple of the neighbours' median deviation from their own median
_CHANCE = 0.5  # largest number of pixels expected to deviate everywhere by chance
_INSIDE = 0.97  # of a lens's circle, because its edge is the same in every view
_BLOCK = 4  # pixels of one colour along the edge of a block of detail
_DETAIL = 5.0, 0.03  # sigma of the noise, share of the light: a smaller step is no detail
_LEAST_DETAIL = 30  # least number of blocks with detail
_SAME_VIEW_CORRELATION = 0.3  # of the detail of two frames, from which they show one view
_LIKE = 2  # neighbours that may be like a defect, as in a line of defects
_FULL = 0.9  # of the saturation; pixels in brighter surroundings are not judged

Detail = NDArray[np.int8]


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


def find(sources: Sequence[Path], profile: CameraProfile, *, dark: bool = False) -> PixelDefects:
    """Find the bad pixels of a raw camera.

    sources : frames, or folders of frames; frames with the same details count as one view, and
    frames with too little detail are not used. dark : the frames were taken with the cap on, and
    each counts as a view. Raises InputError for frames that are not raw frames of this camera, and
    for a frame with light if `dark`; NotEnoughDataError for fewer than three different views (or
    two dark frames), or if too many pixels deviate.
    """
    if profile.camera.kind != "raw":
        raise InputError(
            profile.camera.name,
            "the profile is of a JPEG camera, and JPEG files blur bad pixels",
            "a profile of a raw camera",
            "use the camera's raw files, and a profile for them",
        )
    area = (
        np.ones((profile.camera.height_px, profile.camera.width_px), bool)
        if dark
        else _inside_lenses(profile)
    )
    frames, views, plain = [], [], 0
    for source in sources:
        for path in _frames_of(source):
            mosaic = _mosaic(path, profile)
            frames.append(path)
            new = _View(deviating(mosaic, profile, alone=not dark) & area, [])
            if dark:
                _check_dark(path, mosaic, profile)
                views.append(new)
                continue
            detail = _detail(mosaic, profile, area)
            if np.count_nonzero(np.abs(detail) == 1) < _LEAST_DETAIL:
                plain += 1
                continue
            new.shown.append((path.parent.resolve(), detail))
            views = _join(views, new)
    return _decide([view.deviating for view in views], tuple(frames), int(area.sum()), dark, plain)


def _decide(
    views: list[Mask], frames: tuple[Path, ...], pixels: int, dark: bool, plain: int
) -> PixelDefects:
    from scipy.stats import binom

    least, kind, remedy = LEAST_DARK, "dark frames", "take more dark frames"
    if not dark:
        least, kind = LEAST_VIEWS, "views"
        remedy = "turn the camera between brackets, or take frames with the cap on (--dark)"
    if len(views) < least:
        blank = f" ({counted(plain, 'frame')} with too little detail)" if plain else ""
        views_text = counted(len(views), f"different {kind.removesuffix('s')}")
        raise NotEnoughDataError(
            f"bad pixels: {views_text}{blank}; expected at least {least}; {remedy}"
        )
    count = np.zeros(views[0].shape, np.uint16)
    for view in views:
        count += view
    shares = np.array([view.sum() / pixels for view in views])
    need = max(least, int(np.ceil(0.75 * len(views))))
    by_chance = [
        pixels * float(binom.sf(n - 1, len(views), shares.mean())) for n in range(len(views) + 1)
    ]
    while by_chance[need] > _CHANCE and need < len(views):
        need += 1
    rows, columns = np.nonzero(count >= need)
    if by_chance[need] > _CHANCE:
        raise NotEnoughDataError(
            f"bad pixels: {100 * shares.mean():.2g} % of the pixels deviate in each of the "
            f"{len(views)} {kind}, so {by_chance[need]:.2g} good pixels would deviate in all of "
            f"them by chance; {remedy}"
        )
    if len(rows) > MOST * pixels:
        raise NotEnoughDataError(
            f"bad pixels: {100 * len(rows) / pixels:.2g} % of the pixels were found to be bad; "
            f"expected at most {100 * MOST:g} %; check gain and read noise under [sensor] in the "
            "profile, and, unless the frames are dark, that the camera was turned between views"
        )
    line = (
        f"bad pixels: {len(rows)}, which deviate from their neighbours in {need} or more of "
        f"{len(views)} {kind}; {by_chance[need]:.2g} good pixels would do so by chance"
    )
    return PixelDefects(
        tuple((int(x), int(y)) for y, x in zip(rows, columns, strict=True)),
        len(views),
        frames,
        by_chance[need],
        line,
    )


def _frames_of(source: Path) -> list[Path]:
    if not source.is_dir():
        return [source]
    frames = possible_frames(source)
    if not frames:
        raise InputError(
            source,
            "no frames in this folder",
            "a folder of raw frames of one view",
            "check the path of the folder",
        )
    return frames


def _mosaic(path: Path, profile: CameraProfile) -> Mosaic:
    if is_jpeg(path):
        raise InputError(
            path,
            "a JPEG frame",
            f"raw frames of {profile.camera.name}, because JPEG files blur bad pixels",
            "use the camera's raw frames",
        )
    mosaic = read_mosaic(path, lens_f_number=profile.camera.fixed_f_number)
    check_frame(path, mosaic.counts.shape, mosaic.model, profile)
    return mosaic


def _check_dark(path: Path, mosaic: Mosaic, profile: CameraProfile) -> None:
    """Raise InputError if light reached a dark frame."""
    for plane, black, gain, _ in _planes(mosaic, profile):
        above = float(np.percentile(plane[::4, ::4], 90)) - black
        noise = float(np.hypot(profile.sensor.read_noise_e / gain, 1.0))
        if above > max(5 * noise, 0.01 * (profile.sensor.white_dn - black)):
            raise InputError(
                path,
                f"the frame is {above:.0f} DN above the black level",
                "a dark frame, without light",
                "put the lens cap on and take the frame again",
            )


def _planes(
    mosaic: Mosaic, profile: CameraProfile
) -> list[tuple[NDArray[np.uint16], float, float, float]]:
    """Return counts, black, electrons per count, and saturation of each of R, G1, G2 and B."""
    gain = gain_e_per_dn(mosaic.exposure.iso, profile)
    levels = zip(
        channel_positions(mosaic.cfa),
        black_dn(mosaic, profile),
        full_dn(mosaic, profile),
        strict=True,
    )
    return [
        (np.ascontiguousarray(mosaic.counts[r::2, c::2]), black, gain, full)
        for (r, c), black, full in levels
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
    read_dn2 = (
        profile.sensor.read_noise_e / (profile.sensor.gain_e_per_dn * profile.sensor.iso)
    ) ** 2
    read_dn2 = read_dn2 * mosaic.exposure.iso**2 + 1 / 12
    for (r, c), (plane, black, gain, full) in zip(
        channel_positions(mosaic.cfa), _planes(mosaic, profile), strict=True
    ):
        middle = np.asarray(cv2.medianBlur(plane, 3), np.uint16)
        off = cv2.absdiff(plane, middle)
        spread = cv2.medianBlur(off, 3).astype(np.float32)
        light = np.maximum(middle.astype(np.float32) - np.float32(black), 0)
        margin = np.maximum(
            _SIGMA * np.sqrt(light / np.float32(gain) + np.float32(read_dn2)), _LEAST_REL * light
        )
        far = (off > np.maximum(margin, _SPREAD * spread)) & (middle < _FULL * full)
        is_deviating[r::2, c::2] = _isolated(plane, middle, far) if alone else far
    return is_deviating


def _isolated(plane: NDArray[np.uint16], middle: NDArray[np.uint16], deviating_px: Mask) -> Mask:
    """Return a mask of the pixels with at most two of eight neighbours like them.

    Pixels of a line of defects remain, those at a corner of an object do not.
    """
    rows, columns = np.nonzero(deviating_px)
    own = plane[rows, columns].astype(np.int32) - middle[rows, columns]
    like = np.zeros(len(rows), np.int32)
    for down, across in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        y, x = (
            np.clip(v + d, 0, n - 1)
            for v, d, n in zip((rows, columns), (down, across), plane.shape, strict=True)
        )
        like += 2 * (plane[y, x].astype(np.int32) - middle[rows, columns]) * np.sign(own) > np.abs(
            own
        )
    deviating_px[rows, columns] = like <= _LIKE
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


def _detail(mosaic: Mosaic, profile: CameraProfile, area: Mask) -> Detail:
    """Return the detail of a frame, in blocks of one of the two green colours.

    A block is +1 or -1 if it is brighter or darker than its neighbours, else 0. It is 2 if this is
    unknown: outside the lens, saturated, or too dark.
    """
    import cv2

    plane, black, gain, full = _planes(mosaic, profile)[1]
    r, c = channel_positions(mosaic.cfa)[1]
    size = plane.shape[1] // _BLOCK, plane.shape[0] // _BLOCK
    # Remove single pixels, because defects are not details of a view.
    clean = cv2.medianBlur(plane, 3).astype(np.float32)
    block = np.asarray(
        cv2.resize(clean, size, interpolation=cv2.INTER_AREA), np.float32
    ) - np.float32(black)
    inside = (area[r::2, c::2] & (plane < _FULL * full)).astype(np.float32)
    around = np.maximum(np.asarray(cv2.medianBlur(block, 5), np.float32), 0)
    noise = (
        _DETAIL[0] * np.sqrt(around / gain + (profile.sensor.read_noise_e / gain) ** 2 + 1) / _BLOCK
    )
    step = block - around
    detail = np.where(
        np.abs(step) > np.maximum(noise, _DETAIL[1] * around), np.sign(step), 0
    ).astype(np.int8)
    detail[
        (cv2.resize(inside, size, interpolation=cv2.INTER_AREA) < 0.99) | (noise > 0.2 * around)
    ] = 2
    return detail


def _alike(a: Detail, b: Detail) -> float | None:
    """Return the correlation of the details of two frames: 1 equal, 0 unrelated, -1 opposite.

    Blocks known in both frames count, relative to the frame with less detail. Return None if these
    are too few.
    """
    both = (a != 2) & (b != 2)
    x, y = a[both].astype(np.int32), b[both].astype(np.int32)
    least = min(np.count_nonzero(x), np.count_nonzero(y))
    return None if least < _LEAST_DETAIL else float((x * y).sum() / least)


@dataclass(slots=True)
class _View:
    deviating: Mask
    shown: list[tuple[Path, Detail]]

    def shows(self, source: Path, detail: Detail) -> bool:
        """Return whether a frame shows this view.

        Frames of one folder that cannot be compared (long and short) count as the same view:
        undercounting views is safe.
        """
        for other, other_detail in self.shown:
            alike = _alike(detail, other_detail)
            if other == source if alike is None else alike > _SAME_VIEW_CORRELATION:
                return True
        return False


def _join(views: list[_View], new: _View) -> list[_View]:
    """Return all views after adding a frame to the views that it shows; these become one view."""
    source, detail = new.shown[0]
    apart = []
    for view in views:
        if view.shows(source, detail):
            new = _View(new.deviating | view.deviating, [*new.shown, *view.shown])
        else:
            apart.append(view)
    return [*apart, new]
