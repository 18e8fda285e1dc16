"""Find hot and stuck pixels: they deviate from their neighbours in dark frames.

The neighbours are those of the same colour. A pixel must deviate in all frames. If good pixels
would do so by chance, there is no result. A dead pixel is dark like the others; a
merge averages it with its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.calibrate.pictures import Chart, Place
from fieldlum.calibrate.readings import own_mosaic, require, require_raw
from fieldlum.core.arrays import Indices
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.optics.linear_light import black_dn, gain_e_per_dn
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import channel_positions, is_jpeg, possible_frames

# Limits are chosen so that simulated defects are found and noise is not (tests); not measured on
# real sensors.
MAX_SHARE = 1e-3  # largest share of bad pixels; more are not a list of defects
_SIGMA = 6.0  # of the noise
_SPREAD = 4.0  # largest multiple of the neighbours' median deviation from their own median


class PixelDefects(NamedTuple):
    """Bad pixels (column, row) on the sensor, and the evidence.

    frames : the frames that were read; by_chance : number of good pixels expected among bad_px by
    chance; line : text for the profile.
    """

    bad_px: tuple[tuple[int, int], ...]
    frames: tuple[Path, ...]
    by_chance: float
    line: str


def find(sources: Sequence[Path], profile: CameraProfile) -> PixelDefects:
    """Find the bad pixels of a raw camera in frames with the cap on.

    sources : frames, or folders of frames. Raises InputError for frames that are not raw frames of
    this camera, and for a frame with light; NotEnoughDataError for fewer than two frames, or if too
    many pixels deviate.
    """
    require_raw(profile, "use the camera's raw files")
    folders = [possible_frames(path) if path.is_dir() else [path] for path in sources]
    frames = tuple(path for folder in folders for path in folder)
    require(len(frames), 2, "bad pixels: dark frames", "take more with the cap on")
    deviating = [_deviating(path, profile) for path in frames]
    pixels, times = np.unique(np.concatenate(deviating), return_counts=True)
    bad = pixels[times == len(frames)]
    share = float(np.mean([len(px) for px in deviating])) / profile.camera.pixels
    by_chance = profile.camera.pixels * share ** len(frames)
    if by_chance > 0.5:
        raise NotEnoughDataError(
            f"bad pixels: {100 * share:.2g} % deviate in each of {len(frames)} frames, so "
            f"{by_chance:.2g} good pixels would deviate in all of them by chance; take more dark "
            "frames"
        )
    if len(bad) > MAX_SHARE * profile.camera.pixels:
        raise NotEnoughDataError(
            f"bad pixels: {len(bad)} of {profile.camera.pixels}; expected at most "
            f"{100 * MAX_SHARE:g} %; check gain and read noise under [sensor] in the profile"
        )
    line = (
        f"bad pixels: {len(bad)}, which deviate from their neighbours in each of {len(frames)} "
        f"dark frames; {by_chance:.2g} good pixels would do so by chance"
    )
    rows, columns = np.unravel_index(bad, (profile.camera.height_px, profile.camera.width_px))
    places = tuple(zip(columns.tolist(), rows.tolist(), strict=True))
    return PixelDefects(places, frames, by_chance, line)


def _deviating(path: Path, profile: CameraProfile) -> Indices:
    """Return the pixels of a dark frame that deviate from the median of their neighbourhood.

    The result are indices into the mosaic [n]. The neighbourhood is the pixel and the eight next to
    it of the same colour. A pixel deviates if it differs by more than each of these: six times the
    noise, four times the spread of the neighbourhood. Raises InputError if light reached the frame.
    """
    import cv2

    if is_jpeg(path):
        expected = f"raw frames of {profile.camera.name}, because JPEG files blur bad pixels"
        raise InputError(path, "a JPEG frame", expected, "use the camera's raw frames")
    mosaic = own_mosaic(path, profile)
    far = np.zeros(mosaic.counts.shape, bool)
    gain = gain_e_per_dn(mosaic.exposure.iso, profile)
    read_dn = profile.sensor.read_noise_e / gain
    planes = zip(channel_positions(mosaic.cfa), black_dn(mosaic, profile), strict=True)
    for (row, column), black in planes:
        counts = np.ascontiguousarray(mosaic.counts[row::2, column::2])
        above = float(np.percentile(counts[::4, ::4], 90)) - black
        if above > max(5 * np.hypot(read_dn, 1.0), 0.01 * (profile.sensor.white_dn - black)):
            finding = f"the frame is {above:.0f} DN above the black level"
            remedy = "put the lens cap on and take the frame again"
            raise InputError(path, finding, "a dark frame, without light", remedy)
        middle = np.asarray(cv2.medianBlur(counts, 3), np.uint16)
        off = cv2.absdiff(counts, middle)
        light_dn2 = np.maximum(middle - black, 0.0) / gain
        noise = np.sqrt(light_dn2 + read_dn**2 + 1 / 12)
        far[row::2, column::2] = off > np.maximum(_SIGMA * noise, _SPREAD * cv2.medianBlur(off, 3))
    return np.flatnonzero(far)


def chart(defects: PixelDefects) -> Chart:
    """Show the bad pixels over a dark frame."""
    places = [Place(defects.frames[0], x + 0.5, y + 0.5) for x, y in defects.bad_px]
    return Chart(f"{len(places)} bad pixels", np.zeros(len(places)), places)
