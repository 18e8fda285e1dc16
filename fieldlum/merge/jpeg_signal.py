"""Read JPEG frames as linear signals: tables of the response convert codes to light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats32, Indices, Mask
from fieldlum.merge.estimator import Strip
from fieldlum.merge.frames import Crop, evenly_spread
from fieldlum.merge.shift import Small, reduced
from fieldlum.merge.shots import Shot
from fieldlum.optics.linear_light import check_frame, frame_z_per_cdm2, nd_factors, response_tables
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import read_jpeg

# Noise of a JPEG pixel besides its quantisation, in codes. The sensor has 0.5; rounding to YCbCr
# and of its cosines 0.7. These errors are correlated between colours and neighbours, so that sums
# of pixels need 1.0 (bench/merge_budget.py --kind jpeg).
_SIGMA_CODE = 1.0


_Z_STEPS, _Z_TOP = 1 << 14, 1.02  # steps and upper end of the table over z; chosen


_TOP_CODE = 250  # code above which a JPEG pixel is treated as saturated; chosen


@dataclass(frozen=True)
class JpegSignal:
    """A JPEG frame: codes [h, w, 3], and for each colour a table that converts codes to light z.

    z is 1 at full scale; per_cdm2 is z per cd/m2. low_code, high_code: codes between which the
    response is well known. dark_end: this is the most exposed frame of the bracket, and is used
    below low_code too. bright_end: this is the least exposed frame, and is used up to code 250.
    through_nd: whether a filter was used. z_of_code: [256, 3]. per_cdm2: [w, 3]; a scalar or
    [3] also works, but is slower.
    """

    codes: NDArray[np.uint8]
    z_of_code: Floats32
    per_cdm2: Floats32
    low_code: int
    high_code: int
    dark_end: bool
    bright_end: bool
    through_nd: bool = False

    @cached_property
    def _top(self) -> int:
        return _TOP_CODE if self.bright_end else self.high_code

    def _rows(self, colours: Array) -> Array:
        """Return an array [3] repeated as [w, 3], because numpy processes long rows faster."""
        return np.ascontiguousarray(np.broadcast_to(colours, self.codes.shape[1:]))

    @cached_property
    def _limits(self) -> tuple[Floats32, Floats32, Floats32]:
        """Lowest and highest z that may predict, and highest readable z, [w, 3] each."""
        low = np.full(3, -1.0, np.float32) if self.dark_end else self.z_of_code[self.low_code]
        return (
            self._rows(low),
            self._rows(self.z_of_code[self._top]),
            self._rows(self.z_of_code[_TOP_CODE]),
        )

    @cached_property
    def _offsets(self) -> Indices:
        return self._rows(np.arange(3, dtype=np.intp) * _Z_STEPS)

    @cached_property
    def _tables(self) -> tuple[Floats32, Floats32]:
        """Variance of z, and weight of a predicted z, at equal steps of z, [3 steps].

        The tables of the three colours follow each other in one array.
        """
        z = (np.arange(_Z_STEPS) + 0.5) / _Z_STEPS * _Z_TOP
        variance, weight = np.empty((3, _Z_STEPS), np.float32), np.empty((3, _Z_STEPS), np.float32)
        codes = np.arange(256.0)
        low, per = 0 if self.dark_end else self.low_code, self._rows(self.per_cdm2)[0]
        for c in range(3):
            curve = self.z_of_code[:, c].astype(np.float64) + np.arange(256) * 1e-9
            code = np.interp(z, curve, codes)
            slope = np.interp(code, codes, np.maximum(np.gradient(curve), 1e-6))
            variance[c] = slope**2 * (_SIGMA_CODE**2 + 1 / 12)
            weight[c] = np.where((code >= low) & (code <= self._top), per[c] / variance[c], 0.0)
        return variance.reshape(-1), weight.reshape(-1)

    def _looked_up(self, table: Floats32, z: Strip) -> Strip:
        """Return the values of a table at z, overwriting z.

        An unknown luminance is infinite and counts as above the top code.
        """
        z *= np.float32(_Z_STEPS / _Z_TOP)
        np.minimum(z, np.float32(_Z_STEPS - 1), out=z)
        index = z.astype(np.intp)
        index += self._offsets
        return np.take(table, index, out=z, mode="clip")

    def strip(self, first: int, last: int) -> tuple[Strip, Mask | None]:
        """Return linear light z of rows first to last - 1 [rows, W, 3], and a mask of that shape.

        The mask is True at saturated pixels and next to them; None if nothing is saturated.
        """
        import cv2

        part = self.codes[first:last]
        linear = np.asarray(cv2.LUT(part, self.z_of_code.reshape(1, 256, 3)), np.float32)
        a, b = max(first - 2, 0), min(last + 2, len(self.codes))
        if self.codes[a:b].max(initial=0) <= _TOP_CODE:
            return linear, None
        # 255 where no colour is saturated.
        below = cv2.inRange(self.codes[a:b], (0, 0, 0), (_TOP_CODE,) * 3)
        wide = cv2.erode(below, np.ones((5, 5), np.uint8))[first - a : last - a] == 0
        return linear, np.repeat(wide[:, :, None], 3, axis=2)

    def weight(self, predicted_cdm2: Strip) -> Strip:
        """Return per_cdm2 over the variance of z that a luminance has, [rows, W, 3].

        The weight is 0 where the code of predicted_cdm2 would be outside the frame's range.
        """
        return self._looked_up(self._tables[1], predicted_cdm2 * self.per_cdm2)

    def usable(self, counts: Strip) -> Mask:
        """Return a mask [rows, W, 3], True where the linear light z is in the frame's usable range.

        counts: z [rows, W, 3]. The range is that of the codes low_code to high_code. The most
        exposed frame has no lower limit; the least exposed frame is usable up to code 250.
        """
        low, high, _ = self._limits
        ok = counts >= low
        ok &= counts <= high
        return ok

    def readable(self, counts: Strip) -> tuple[Mask, Strip]:
        """Return a mask, True for values z [rows, W, 3] up to code 250, and all variances of z."""
        return counts <= self._limits[2], self._looked_up(self._tables[0], counts.copy())

    def max_cdm2(self) -> Floats32:
        """Return the luminance of code 250, broadcastable to [H, W, 3], in cd/m2."""
        return np.asarray(self.z_of_code[_TOP_CODE] / self.per_cdm2, np.float32)

    def small(self) -> Small:
        """Return a reduced picture of the green colour, to detect turns by its edges."""
        import cv2

        green = np.ascontiguousarray(self.codes[..., 1])
        light = np.asarray(cv2.LUT(green, np.ascontiguousarray(self.z_of_code[:, 1])), np.float32)
        return reduced(light, (green >= self.low_code) & (green <= self.high_code), 0.0)

    def sampled(self, rows: int, columns: int) -> tuple[JpegSignal, Mask]:
        """Return a signal of evenly spread pixels, about [rows, columns, 3], and a mask.

        The mask, in the signal's shape, is True for pixels at or next to saturation.
        """
        at = evenly_spread(len(self.codes), rows)
        step = max(1, self.codes.shape[1] // columns)
        full = np.zeros((len(at), *self.codes.shape[1:]), bool)
        for row, i in enumerate(at.tolist()):
            _, mask = self.strip(i, i + 1)
            if mask is not None:
                full[row] = mask[0]
        per = self._rows(self.per_cdm2)[::step]
        codes = self.codes[at][:, ::step]
        part = replace(self, codes=codes, per_cdm2=per, bright_end=False, dark_end=False)
        return part, full[:, ::step]


def load_jpeg(
    shot: Shot,
    profile: CameraProfile,
    crop: Crop,
    ends: tuple[bool, bool] = (False, False),
) -> JpegSignal:
    """Read a JPEG frame, cropped, as a linear signal.

    crop: the rectangle of the sensor to read. ends: whether the frame is the most exposed of the
    bracket, and whether it is the least exposed. Raises InputError for a file that is no JPEG of
    this camera, and for a filter that the profile does not have.
    """
    frame = read_jpeg(shot.path, camera_pixels=profile.camera.pixels)
    check_frame(shot.path, frame.codes.shape, frame.model, profile)
    per, factors = frame_z_per_cdm2(shot.exposure, profile), nd_factors(shot.exposure.nd, profile)
    part = frame.codes[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    return JpegSignal(
        np.ascontiguousarray(part),
        response_tables(profile).astype(np.float32),
        np.tile(np.asarray([per / f for f in factors], np.float32), (crop.width, 1)),
        profile.response.low_code,
        profile.response.high_code,
        *ends,
        bool(shot.exposure.nd),
    )
