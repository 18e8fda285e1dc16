"""Read raw and JPEG frames as linear signals: two classes with the same methods.

"Counts" are raw counts above black, or for a JPEG frame its linear light z. Frames are read in
strips along their first axis, at the same places in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask, UInts8, UInts16, evenly_spread
from fieldlum.core.errors import InputError
from fieldlum.core.progress import progress
from fieldlum.merge.shift import ReducedFrame, reduce_frame
from fieldlum.merge.shots import Shot
from fieldlum.optics import linear_light
from fieldlum.optics.camera_curves import linearity_factor
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import Mosaic, channel_positions, read_jpeg, read_mosaic

Plateau = tuple[float | None, ...]  # of R, G1, G2, B [DN]
_FULL = 0.99  # of the saturation: a count above it is treated as saturated
# Noise of a JPEG pixel besides its quantisation, in codes. The sensor has 0.5; rounding to YCbCr
# and of its cosines 0.7. These errors are correlated between colours and neighbours, so that sums
# of pixels need 1.0 (bench/merge_budget.py --kind jpeg).
_SIGMA_CODE = 1.0
_Z_STEPS, _Z_TOP = 1 << 14, 1.02  # steps and upper end of the table over z
_TOP_CODE = 250  # code above which a JPEG pixel is treated as saturated


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
    centres = np.array([lens.centre_px for lens in profile.lens])  # [lenses, 2]
    reach = np.array([[lens.radius_px + 3] for lens in profile.lens])
    left, top = np.maximum((centres - reach).min(axis=0), 0).astype(int) // 2 * 2
    ends = -(-np.ceil((centres + reach).max(axis=0)).astype(int) // 2) * 2
    right, bottom = np.minimum(ends, np.array([body.width_px, body.height_px]) // 2 * 2)
    if bottom - top < 2 or right - left < 2:
        finding = "no lens circle of the profile is on the sensor"
        remedy = "correct centre_px and radius_px of [[lens]] in the profile"
        raise InputError(body.name, finding, "lens circles on the sensor", remedy)
    return Crop(top=int(top), left=int(left), height=int(bottom - top), width=int(right - left))


@dataclass(slots=True)
class Saturation:
    """Saturation and black level of raw frames, by the most exposed frame of each ISO.

    plateau_dn: counts at which R, G1, G2 and B saturate by ISO, black included, None for a colour
    that does not saturate in the frame. One colour can saturate at lower counts than the others. At
    a low ISO the full well limits, at a high ISO the converter. black_off_dn: the files' black
    level minus the profile's, for the colour with the largest difference, 0 if the profile has
    none.
    """

    plateau_dn: dict[float, Plateau] = field(default_factory=dict)
    black_off_dn: float = 0.0

    def measured(self, mosaic: Mosaic, profile: CameraProfile) -> Plateau:
        """Return counts at which R, G1, G2, B saturate at the frame's ISO, by its first frame.

        A count is None for a colour without a visible plateau. The first frame of an ISO is
        remembered.
        """
        iso, black = mosaic.exposure.iso, profile.sensor.black_dn
        if iso not in self.plateau_dn:
            step = 2 * max(1, mosaic.counts.size // 6_000_000)  # limits the time
            places = channel_positions(mosaic.cfa)
            colours = [mosaic.counts[row::step, column::2] for row, column in places]
            self.plateau_dn[iso] = tuple(
                linear_light.saturation_plateau(counts, mosaic.white_dn) for counts in colours
            )
            off = np.subtract(mosaic.black_dn, black).tolist() if any(black) else ()
            self.black_off_dn = max([self.black_off_dn, *off], key=abs)
        return self.plateau_dn[iso]


@dataclass(frozen=True)
class RawSignal:
    """A cropped raw frame, shaped [rows / 2, 2, columns] so that each axis-1 row has two colours.

    counts: as in the file; black: the black level [DN]; saturation: counts above black at which a
    pixel saturates [DN]; per_cdm2: counts above black per cd/m2. Each of the last three is an array
    [2, columns] if the four colours differ, otherwise a scalar. gain_e_per_dn: electrons per count.
    noise_dn2: variance of read noise and quantisation [DN^2]. through_nd: whether a filter was
    used. linearity: the profile's coefficients, a polynomial of the counts' share of scale_dn;
    scale_dn: full scale above black.
    """

    counts: UInts16
    black: Floats32
    saturation: Floats32
    per_cdm2: Floats32
    gain_e_per_dn: float
    noise_dn2: float
    through_nd: bool = False
    linearity: tuple[float, ...] = ()
    scale_dn: float = 65535.0

    def _linear(self, above: Floats32) -> Floats32:
        """Return counts above black [...] corrected in place for the sensor's linearity."""
        if self.linearity:
            above *= linearity_factor(above / np.float32(self.scale_dn), self.linearity)
        return above

    @cached_property
    def usable_limit(self) -> Floats32:
        """Counts above black, corrected for linearity, below which a pixel is used.

        The smaller of 97 % of saturation, and saturation less 4 standard deviations of noise; it
        broadcasts to [h, 2, w].
        """
        sigma = np.sqrt(self.saturation / self.gain_e_per_dn + self.noise_dn2)
        limit = np.minimum(0.97 * self.saturation, self.saturation - 4 * sigma)
        return self._linear(limit.astype(np.float32))

    @cached_property
    def max_cdm2(self) -> Floats32:
        """Luminance of `usable_limit` [cd/m2], in a shape that broadcasts to the frame's."""
        return np.asarray(self.usable_limit / self.per_cdm2, np.float32)

    @cached_property
    def _any_full(self) -> float:
        """Lowest count, black included, at which a pixel of some colour is saturated."""
        return float(np.min(_FULL * self.saturation + self.black))

    def strip(self, first: int, last: int) -> tuple[Floats32, Mask | None]:
        """Return counts above black of rows first to last - 1, [rows, 2, w], and a mask.

        A row is a pair of rows of the sensor, from 0. The counts are corrected for linearity. The
        mask [rows, 2, w] is True at saturated pixels and within two pixels of them; None if nothing
        is saturated.
        """
        above = self._linear(self.counts[first:last] - self.black)
        if self.counts[max(first - 1, 0) : last + 1].max(initial=0) < self._any_full:
            return above, None
        return above, self._near_full(first, last)

    def _near_full(self, first: int, last: int) -> Mask:
        """Return a mask of counts that are saturated, or within two pixels of a saturated one.

        Charge spills to neighbouring pixels and affects the other colours too.
        """
        start = max(first - 1, 0)
        above = self.counts[start : last + 1] - self.black
        full = (above >= _FULL * self.saturation).view(np.uint8)
        near = cv2.dilate(full.reshape(-1, full.shape[-1]), np.ones((5, 5), np.uint8))
        return np.reshape(near, full.shape)[first - start : last - start].view(np.bool_)

    def weight(self, predicted_cdm2: Floats32) -> Floats32:
        """Return the weight in the merge: per_cdm2 over photon and read variance, [...].

        predicted_cdm2: luminance by all frames [...], from which the variance follows. The weight
        is 0 where it exceeds `max_cdm2`.
        """
        weight = predicted_cdm2 * np.asarray(self.per_cdm2 / self.gain_e_per_dn, np.float32)
        weight += np.float32(self.noise_dn2)  # now the variance [DN^2]
        np.divide(self.per_cdm2, weight, out=weight)
        weight *= predicted_cdm2 < self.max_cdm2
        return weight

    def usable(self, counts: Floats32) -> Mask:
        """Return a mask, True for counts above black [rows, ...] below `usable_limit`."""
        return counts < self.usable_limit

    def readable(self, counts: Floats32) -> tuple[Mask, Floats32]:
        """Return the mask of `usable` for counts [rows, ...], and the variances of all [DN^2]."""
        gain, noise = np.float32(self.gain_e_per_dn), np.float32(self.noise_dn2)
        variance = np.maximum(counts, 0.0) / gain + noise
        return self.usable(counts), variance.astype(np.float32)

    def reduced_frame(self) -> ReducedFrame:
        """Return a reduced picture, the mean of all colours, to detect turns by its edges."""
        counts = self.counts.reshape(-1, self.counts.shape[-1])
        above = counts.astype(np.float32)
        above -= np.float32(self.black.mean())
        dark_dn = 8.0 * float(np.sqrt(self.noise_dn2))  # below, noise would look like edges
        return reduce_frame(above, counts < self._any_full, dark_dn, cell=2)

    def sampled(self, rows: int, columns: int) -> tuple[RawSignal, Mask]:
        """Return a signal of evenly spread pixels, about [rows, 2, columns], and a mask.

        The mask, in the signal's shape, is True for pixels at or next to saturation.
        """
        at = evenly_spread(len(self.counts), rows)  # indices of pairs of rows
        # An odd step samples both columns of the mosaic.
        step = max(1, self.counts.shape[-1] // columns) | 1
        full = np.concatenate([self._near_full(i, i + 1) for i in at.tolist()])
        patterns = {
            name: value[..., ::step] if (value := getattr(self, name)).ndim else value
            for name in ("black", "saturation", "per_cdm2")
        }
        return replace(self, counts=self.counts[at][..., ::step], **patterns), full[..., ::step]


def _cell_pattern(cfa: str, by_colour: Sequence[float], width: int) -> Floats32:
    """Return values of R, G1, G2 and B [4] repeated over two rows of the mosaic, [2, width].

    Return a scalar, with which numpy computes faster, if the four are equal.
    """
    if len(set(by_colour)) == 1:
        return np.asarray(by_colour[0], np.float32)
    cell = np.empty((2, 2), np.float32)
    for at, value in zip(channel_positions(cfa), by_colour, strict=True):
        cell[at] = value
    return np.tile(cell, (1, width // 2))


def load_raw(
    shot: Shot, profile: CameraProfile, crop: Crop, saturation: Saturation | None = None
) -> RawSignal:
    """Read a raw frame, cropped, as a linear signal.

    crop: the rectangle of the sensor to read. saturation: of the bracket, to which this frame adds
    what is not measured yet; None: of this frame. Raises InputError for a frame that cannot be read
    or is of another camera.
    """
    mosaic = read_mosaic(shot.path, lens_f_number=shot.exposure.f_number)
    sensor, body = profile.sensor, profile.camera
    linear_light.check_frame(shot.path, mosaic.counts.shape, mosaic.model, profile)
    if mosaic.cfa != sensor.cfa:
        expected, remedy = f"{sensor.cfa}, as in {body.name}", "use the profile of its camera"
        raise InputError(shot.path, f"the colour filter pattern {mosaic.cfa}", expected, remedy)
    plateau = (saturation or Saturation()).measured(mosaic, profile)
    part = mosaic.counts[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    counts = np.ascontiguousarray(part).reshape(crop.height // 2, 2, crop.width)
    black = linear_light.black_dn(mosaic, profile)
    full = np.subtract(linear_light.full_dn(mosaic, profile, plateau), black).tolist()
    z_per_cdm2 = linear_light.frame_z_per_cdm2(shot.exposure, profile)
    red, green, blue = linear_light.nd_factors(shot.exposure.nd, profile)
    # the linear signal z is 1 at white_dn, by definition
    of_colours = zip(black, (red, green, green, blue), strict=True)
    per_cdm2 = [z_per_cdm2 * (sensor.white_dn - dark) / factor for dark, factor in of_colours]
    gain = linear_light.gain_e_per_dn(shot.exposure.iso, profile)
    return RawSignal(
        counts=counts,
        black=_cell_pattern(mosaic.cfa, black, crop.width),
        saturation=_cell_pattern(mosaic.cfa, full, crop.width),
        per_cdm2=_cell_pattern(mosaic.cfa, per_cdm2, crop.width),
        gain_e_per_dn=gain,
        noise_dn2=(sensor.read_noise_e / gain) ** 2 + 1 / 12,
        through_nd=bool(shot.exposure.nd),
        linearity=sensor.linearity,
        scale_dn=float(sensor.white_dn - np.mean(black)),
    )


@dataclass(frozen=True)
class JpegSignal:
    """A JPEG frame: codes [h, w, 3], and for each colour a table that converts codes to light z.

    z, the linear light, is 1 at full scale; per_cdm2 is z per cd/m2. low_code, high_code: codes
    between which the response is well known. dark_end: this is the most exposed frame of the
    bracket, and is used below low_code too. bright_end: this is the least exposed frame, and is
    used up to code 250. through_nd: whether a filter was used. z_of_code: [256, 3]. per_cdm2: [w,
    3]; a scalar or [3] also works, but is slower.
    """

    codes: UInts8
    z_of_code: Floats32
    per_cdm2: Floats32
    low_code: int
    high_code: int
    dark_end: bool
    bright_end: bool
    through_nd: bool = False

    @cached_property
    def _top(self) -> int:
        """Highest code that is used."""
        return _TOP_CODE if self.bright_end else self.high_code

    def _rows(self, colours: Array) -> Array:
        """Return an array [3] repeated as [w, 3], because numpy processes long rows faster."""
        return np.ascontiguousarray(np.broadcast_to(colours, self.codes.shape[1:]))

    @cached_property
    def _limits(self) -> tuple[Floats32, Floats32, Floats32]:
        """Lowest and highest light z that is used, and z of code 250, [w, 3] each.

        z is linear light, 1 at full scale, of w columns and 3 colours. Above code 250 a pixel
        counts as saturated.
        """
        low = np.full(3, -1.0, np.float32) if self.dark_end else self.z_of_code[self.low_code]
        high, top = self.z_of_code[self._top], self.z_of_code[_TOP_CODE]
        return self._rows(low), self._rows(high), self._rows(top)

    @cached_property
    def _tables(self) -> tuple[Floats32, Floats32]:
        """Variance of z, and weight of a predicted z, at equal steps of z, [3 steps].

        z is the linear signal of a code, and a code's noise is constant. The tables of the three
        colours follow each other in one array.
        """
        z = (np.arange(_Z_STEPS) + 0.5) / _Z_STEPS * _Z_TOP
        variance, weight = np.empty((3, _Z_STEPS), np.float32), np.empty((3, _Z_STEPS), np.float32)
        codes = np.arange(256.0)
        low, per_cdm2 = 0 if self.dark_end else self.low_code, self._rows(self.per_cdm2)[0]
        for c in range(3):
            # strictly rising, because the response is inverted
            curve = self.z_of_code[:, c].astype(np.float64) + np.arange(256) * 1e-9
            code = np.interp(z, curve, codes)
            slope = np.interp(code, codes, np.maximum(np.gradient(curve), 1e-6))
            variance[c] = slope**2 * (_SIGMA_CODE**2 + 1 / 12)  # 1/12: of rounding to a code
            used = (code >= low) & (code <= self._top)
            weight[c] = np.where(used, per_cdm2[c] / variance[c], 0.0)
        return variance.reshape(-1), weight.reshape(-1)

    def _looked_up(self, table: Floats32, z: Floats32) -> Floats32:
        """Return the values of one of `_tables` at linear light z [rows, W, 3], overwriting z.

        z of an unknown luminance is infinite and gets the last value of the table.
        """
        z *= np.float32(_Z_STEPS / _Z_TOP)
        np.minimum(z, np.float32(_Z_STEPS - 1), out=z)
        index = z.astype(np.intp)
        index += self._rows(np.arange(3) * _Z_STEPS)  # the three colours' tables follow each other
        return np.take(table, index, out=z, mode="clip")

    def strip(self, first: int, last: int) -> tuple[Floats32, Mask | None]:
        """Return linear light z of rows first to last - 1 [rows, W, 3], and a mask of that shape.

        The mask is True at saturated pixels and next to them; None if nothing is saturated.
        """
        part = self.codes[first:last]
        linear = np.asarray(cv2.LUT(part, self.z_of_code.reshape(1, 256, 3)), np.float32)
        if self.codes[max(first - 2, 0) : last + 2].max(initial=0) <= _TOP_CODE:
            return linear, None
        return linear, self._near_full(first, last)

    def _near_full(self, first: int, last: int) -> Mask:
        """Return a mask of pixels that are saturated, or within two pixels of a saturated one."""
        start = max(first - 2, 0)
        # 255 where no colour is saturated
        below = cv2.inRange(self.codes[start : last + 2], (0, 0, 0), (_TOP_CODE,) * 3)
        near = cv2.erode(below, np.ones((5, 5), np.uint8))[first - start : last - start] == 0
        return np.repeat(near[:, :, None], 3, axis=2)

    def weight(self, predicted_cdm2: Floats32) -> Floats32:
        """Return the weight in the merge: per_cdm2 over the variance of the light z, in its shape.

        predicted_cdm2: luminance [rows, W, 3] by all frames, from which the variance follows. The
        weight is 0 where the code of predicted_cdm2 would be outside the frame's range.
        """
        return self._looked_up(self._tables[1], predicted_cdm2 * self.per_cdm2)

    def usable(self, counts: Floats32) -> Mask:
        """Return a mask [rows, W, 3], True where the linear light z is in the frame's usable range.

        counts: z [rows, W, 3]. The range is that of the codes low_code to high_code. The most
        exposed frame has no lower limit; the least exposed frame is usable up to code 250.
        """
        low, high, _ = self._limits
        return (counts >= low) & (counts <= high)

    def readable(self, counts: Floats32) -> tuple[Mask, Floats32]:
        """Return a mask, True for values z [rows, W, 3] up to code 250, and all variances of z."""
        return counts <= self._limits[2], self._looked_up(self._tables[0], counts.copy())

    @property
    def max_cdm2(self) -> Floats32:
        """Luminance of code 250, broadcastable to [H, W, 3], in cd/m2."""
        return np.asarray(self.z_of_code[_TOP_CODE] / self.per_cdm2, np.float32)

    def reduced_frame(self) -> ReducedFrame:
        """Return a reduced picture of the green colour, to detect turns by its edges."""
        green = np.ascontiguousarray(self.codes[..., 1])
        light = np.asarray(cv2.LUT(green, np.ascontiguousarray(self.z_of_code[:, 1])), np.float32)
        return reduce_frame(light, (green >= self.low_code) & (green <= self.high_code), 0.0)

    def sampled(self, rows: int, columns: int) -> tuple[JpegSignal, Mask]:
        """Return a signal of evenly spread pixels, about [rows, columns, 3], and a mask.

        The mask, in the signal's shape, is True for pixels at or next to saturation.
        """
        at = evenly_spread(len(self.codes), rows)
        step = max(1, self.codes.shape[1] // columns)
        full = np.concatenate([self._near_full(i, i + 1) for i in at.tolist()])
        codes, per_cdm2 = self.codes[at][:, ::step], self._rows(self.per_cdm2)[::step]
        part = replace(self, codes=codes, per_cdm2=per_cdm2, bright_end=False, dark_end=False)
        return part, full[:, ::step]


def load_jpeg(
    shot: Shot, profile: CameraProfile, crop: Crop, ends: tuple[bool, bool] = (False, False)
) -> JpegSignal:
    """Read a JPEG frame, cropped, as a linear signal.

    crop: the rectangle of the sensor to read. ends: whether the frame is the most exposed of the
    bracket, and whether it is the least exposed. Raises InputError for a file that is no JPEG of
    this camera, and for a filter that the profile does not have.
    """
    frame = read_jpeg(shot.path, camera_pixels=profile.camera.pixels)
    linear_light.check_frame(shot.path, frame.codes.shape, frame.model, profile)
    factors = np.array(linear_light.nd_factors(shot.exposure.nd, profile))
    per_cdm2 = linear_light.frame_z_per_cdm2(shot.exposure, profile) / factors
    part = frame.codes[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    return JpegSignal(
        codes=np.ascontiguousarray(part),
        z_of_code=linear_light.response_tables(profile).astype(np.float32),
        per_cdm2=np.tile(per_cdm2.astype(np.float32), (crop.width, 1)),
        low_code=profile.response.low_code,
        high_code=profile.response.high_code,
        dark_end=ends[0],
        bright_end=ends[1],
        through_nd=bool(shot.exposure.nd),
    )


Signal = RawSignal | JpegSignal


def read_frames(
    shots: Sequence[Shot], profile: CameraProfile, crop: Crop
) -> tuple[list[Signal], Saturation]:
    """Read the frames of a bracket, and measure at which counts raw frames saturate.

    shots: most exposed first; crop: the rectangle of the sensor to read. Raises InputError for a
    frame that cannot be read or is of another camera.
    """
    signals: list[Signal] = []
    saturation = Saturation()
    for i, shot in enumerate(shots):
        if profile.camera.kind == "raw":
            signals.append(load_raw(shot, profile, crop, saturation))
        else:
            signals.append(load_jpeg(shot, profile, crop, (i == 0, i == len(shots) - 1)))
        progress(i + 1, len(shots), "frames")
    return signals, saturation


def scale_exposures(frames: Sequence[Signal], factors: Floats) -> list[Signal]:
    """Return frames whose assumed exposures are multiplied by factors [frames]."""
    return [
        replace(frame, per_cdm2=frame.per_cdm2 * np.float32(factor))
        for frame, factor in zip(frames, factors, strict=True)
    ]
