"""Read raw frames as linear signals; provide what raw and JPEG frames have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Indices, Mask
from fieldlum.core.errors import InputError
from fieldlum.merge.estimator import Strip
from fieldlum.merge.frame_checks import Plateau
from fieldlum.merge.shift import Small, reduced
from fieldlum.merge.shots import Shot
from fieldlum.optics.linear_light import (
    black_dn,
    check_frame,
    frame_z_per_cdm2,
    full_dn,
    gain_e_per_dn,
    nd_factors,
)
from fieldlum.optics.photometry import linearity_factor
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import channel_positions, read_mosaic

# of the saturation: brighter pixels do not predict; noise is added to the limit; chosen
_GATE = 0.97
_FULL = 0.99  # of the saturation: a count above it is treated as saturated; chosen
# minimum signal-to-noise ratio of a pixel of a frame that is searched for edges; not measured
_SMALL_SNR = 8.0


@dataclass(frozen=True, slots=True)
class Crop:
    """The rectangle of the sensor that contains the images of all lenses, in sensor pixels.

    top, left: the first row and column of the rectangle, from 0. All four numbers are even, so that
    the rectangle consists of complete 2 x 2 cells of the mosaic.
    """

    top: int
    left: int
    height: int
    width: int


def lens_crop(profile: CameraProfile) -> Crop:
    """Return the rectangle of the sensor around all lens circles, with a margin of 3 pixels.

    Raises InputError if all lens circles are outside the sensor.
    """
    body = profile.camera
    top, left, bottom, right = body.height_px, body.width_px, 0, 0
    for lens in profile.lens:
        (x, y), r = lens.centre_px, lens.radius_px + 3
        top, bottom = min(top, int(y - r)), max(bottom, int(np.ceil(y + r)))
        left, right = min(left, int(x - r)), max(right, int(np.ceil(x + r)))
    top, left = max(top, 0) // 2 * 2, max(left, 0) // 2 * 2
    bottom = min(bottom + bottom % 2, body.height_px // 2 * 2)
    right = min(right + right % 2, body.width_px // 2 * 2)
    if bottom - top < 2 or right - left < 2:
        raise InputError(
            body.name,
            "no lens circle of the profile is on the sensor",
            "lens circles on the sensor",
            "correct centre_px and radius_px of [[lens]] in the profile",
        )
    return Crop(top, left, bottom - top, right - left)


# ----------------------------------------------------------------------------------------------
# which frames


@dataclass(frozen=True)
class RawSignal:
    """A cropped raw frame, shaped [rows / 2, 2, columns] so that each axis-1 row has two colours.

    counts: as in the file; black: the black level [DN]; saturation: counts above black at which
    a pixel saturates [DN]; per_cdm2: counts above black per cd/m2. Each of the last three is an
    array [2, columns] if the four colours differ, otherwise a scalar. through_nd: whether a
    filter was used. noise_dn2: variance of read noise and quantisation [DN^2]; linearity: the
    profile's coefficients, which correct shares of scale_dn; scale_dn: full scale above black.
    """

    counts: NDArray[np.uint16]
    black: Floats32
    saturation: Floats32
    per_cdm2: Floats32
    gain_e_per_dn: float
    noise_dn2: float
    through_nd: bool = False
    linearity: tuple[float, ...] = ()
    scale_dn: float = 65535.0

    def _linear(self, above: Floats32) -> Floats32:
        if self.linearity:
            above *= linearity_factor(above / np.float32(self.scale_dn), self.linearity)
        return above

    @cached_property
    def limit(self) -> Floats32:
        """Counts above black up to which a pixel may predict a luminance, corrected for linearity.

        The smaller of 97 % of saturation, and saturation less 4 standard deviations of noise.
        """
        sigma = np.sqrt(self.saturation / self.gain_e_per_dn + self.noise_dn2)
        limit = np.minimum(_GATE * self.saturation, self.saturation - 4 * sigma)
        return self._linear(limit.astype(np.float32))

    @cached_property
    def _limit_cdm2(self) -> Floats32:
        return np.asarray(self.limit / self.per_cdm2, np.float32)

    @cached_property
    def _per_gain(self) -> Floats32:
        return np.asarray(self.per_cdm2 / self.gain_e_per_dn, np.float32)

    @cached_property
    def _any_full(self) -> float:
        return float(np.min(_FULL * self.saturation + self.black))

    def strip(self, first: int, last: int) -> tuple[Strip, Mask | None]:
        """Return counts above black of rows first to last - 1, and a mask of the same shape.

        The counts are corrected for linearity. The mask is True at saturated pixels and within two
        pixels of them; None if nothing is saturated.
        """
        part = self.counts[first:last]
        above = part.astype(np.float32)
        above -= self.black
        above = self._linear(above)
        if part.max(initial=0) < self._any_full:
            a, b = max(first - 1, 0), min(last + 1, len(self.counts))
            edges = self.counts[a:first], self.counts[last:b]
            if all(e.max(initial=0) < self._any_full for e in edges):
                return above, None
        return above, self._near_full(first, last)

    def _near_full(self, first: int, last: int) -> Mask:
        """Return a mask of counts that are saturated, or within two pixels of a saturated one.

        Charge spills to neighbouring pixels and affects the other colours too.
        """
        import cv2

        a, b = max(first - 1, 0), min(last + 1, len(self.counts))
        part = self.counts[a:b]
        full = (part - self.black >= _FULL * self.saturation).reshape(-1, part.shape[-1])
        wide = cv2.dilate(full.view(np.uint8), np.ones((5, 5), np.uint8)).reshape(part.shape)
        return wide[first - a : last - a].view(np.bool_)

    def weight(self, predicted_cdm2: Strip) -> Strip:
        """Return per_cdm2 over the photon and read variance of a luminance, in its shape.

        The weight is 0 where the predicted luminance exceeds that of `limit`.
        """
        w = predicted_cdm2 * self._per_gain
        w += np.float32(self.noise_dn2)
        np.divide(self.per_cdm2, w, out=w)
        w *= predicted_cdm2 < self._limit_cdm2
        return w

    def usable(self, counts: Strip) -> Mask:
        """Return a mask, True for counts above black [rows, ...] below `limit`."""
        return counts < self.limit

    def readable(self, counts: Strip) -> tuple[Mask, Strip]:
        """Return a mask, True for counts [rows, ...] below `limit`, and all variances [DN^2]."""
        variance = np.maximum(counts, 0.0) / np.float32(self.gain_e_per_dn) + np.float32(
            self.noise_dn2
        )
        return counts < self.limit, variance.astype(np.float32)

    def max_cdm2(self) -> Floats32:
        """Return the luminance of `limit` [cd/m2], in a shape that broadcasts to the frame's."""
        return self._limit_cdm2

    def small(self) -> Small:
        """Return a reduced picture, the mean of all colours, to detect turns by its edges."""
        counts = self.counts.reshape(-1, self.counts.shape[-1])
        above = counts.astype(np.float32)
        above -= np.float32(self.black.mean())
        return reduced(
            above, counts < self._any_full, _SMALL_SNR * float(np.sqrt(self.noise_dn2)), cell=2
        )

    def sampled(self, rows: int, columns: int) -> tuple[RawSignal, Mask]:
        """Return a signal of evenly spread pixels, about [rows, 2, columns], and a mask.

        The mask, in the signal's shape, is True for pixels at or next to saturation.
        """
        at = evenly_spread(len(self.counts), rows)
        # An odd step samples both columns of the mosaic.
        step = max(1, self.counts.shape[-1] // columns) | 1
        full = np.concatenate([self._near_full(int(i), int(i) + 1) for i in at])[:, :, ::step]
        black, saturation, per = (
            c[..., ::step] if c.ndim else c for c in (self.black, self.saturation, self.per_cdm2)
        )
        counts = self.counts[at][:, :, ::step]
        part = replace(self, counts=counts, black=black, saturation=saturation, per_cdm2=per)
        return part, full


def evenly_spread(length: int, wanted: int) -> Indices:
    """Return at most `wanted` indices [n], spread evenly over 0 to `length` - 1."""
    return np.unique(np.linspace(0, length - 1, min(wanted, length)).astype(np.intp))


def over_mosaic(mask: Mask, change: Callable[..., Mask]) -> Mask:
    """Return `change` of a mask in the shape of raw frames, [h / 2, 2, w], in that shape.

    change: a function that takes and returns a mask [h, w].
    """
    return change(np.ascontiguousarray(mask.reshape(-1, mask.shape[-1]))).reshape(mask.shape)


def over_colours(mask: Mask, change: Callable[..., Mask]) -> Mask:
    """Return `change` of a mask in the shape of JPEG frames, [h, w, 3], in that shape.

    change: a function that takes and returns a mask [h, w]. It gets True where any colour is True,
    and all three colours get its result.
    """
    return np.repeat(change(mask.any(axis=2))[:, :, None], 3, axis=2)


def _cell_pattern(cfa: str, by_colour: Sequence[float], width: int) -> Floats32:
    """Return the values of R, G1, G2 and B arranged on the mosaic, [2, width].

    A scalar if all are equal.
    """
    if len(set(by_colour)) == 1:
        return np.asarray(by_colour[0], np.float32)
    cell = np.empty((2, 2), np.float32)
    for at, value in zip(channel_positions(cfa), by_colour, strict=True):
        cell[at] = value
    return np.tile(cell, (1, width // 2))


def load_raw(shot: Shot, profile: CameraProfile, crop: Crop, plateau: Plateau) -> RawSignal:
    """Read a raw frame, cropped, as a linear signal.

    crop: the rectangle of the sensor to read. plateau: counts at which R, G1, G2 and B saturate,
    measured in the frames; None for a colour without. Raises InputError for a frame that cannot be
    read or is of another camera.
    """
    mosaic = read_mosaic(shot.path, lens_f_number=shot.exposure.f_number)
    sensor, body = profile.sensor, profile.camera
    check_frame(shot.path, mosaic.counts.shape, mosaic.model, profile)
    if mosaic.cfa != sensor.cfa:
        raise InputError(
            shot.path,
            f"the colour filter pattern {mosaic.cfa}",
            f"{sensor.cfa}, as in {body.name}",
            "use the profile of the camera that took it",
        )
    part = mosaic.counts[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    counts = np.ascontiguousarray(part).reshape(crop.height // 2, 2, crop.width)
    black = black_dn(mosaic, profile)
    full = [f - b for f, b in zip(full_dn(mosaic, profile, plateau), black, strict=True)]
    per = frame_z_per_cdm2(shot.exposure, profile)
    red, green, blue = nd_factors(shot.exposure.nd, profile)
    per_colour = [
        per * (sensor.white_dn - b) / f
        for b, f in zip(black, (red, green, green, blue), strict=True)
    ]
    gain = gain_e_per_dn(shot.exposure.iso, profile)
    return RawSignal(
        counts,
        _cell_pattern(mosaic.cfa, black, crop.width),
        _cell_pattern(mosaic.cfa, full, crop.width),
        _cell_pattern(mosaic.cfa, per_colour, crop.width),
        gain,
        (sensor.read_noise_e / gain) ** 2 + 1 / 12,
        bool(shot.exposure.nd),
        sensor.linearity,
        float(sensor.white_dn - np.mean(black)),
    )
