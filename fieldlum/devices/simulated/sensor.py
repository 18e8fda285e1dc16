"""Simulate a sensor: from luminance to counts or codes, with noise and clipping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import Exposure
from fieldlum.optics.images import RADIANCE_Y
from fieldlum.optics.linear_light import gain_e_per_dn, nd_factors, response_tables
from fieldlum.optics.photometry import z_per_cdm2
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import channel_positions

# Nominal shutter times of cameras, in thirds of a stop.
_SECONDS = "30 25 20 15 13 10 8 6 5 4 3.2 2.5 2 1.6 1.3 1"
_FRACTIONS = (
    "1.3 1.6 2 2.5 3 4 5 6 8 10 13 15 20 25 30 40 50 60 80 100 125 160 200 250 320 400 500 640 800 "
    "1000 1250 1600 2000 2500 3200 4000 5000 6400 8000 10000 12800 16000"
)
DIAL_S = (
    *(float(text) for text in _SECONDS.split()),
    *(1.0 / float(text) for text in _FRACTIONS.split()),
)
# A Poisson distribution of more electrons is approximated by a normal one, for speed. Chosen.
_GAUSSIAN_ABOVE_E = 60.0


def camera_from_scene(profile: CameraProfile) -> Floats:
    """Return the matrix from scene R, G, B [cd/m2] to camera channels, [3, 3].

    It is the inverse of the profile's colour. With a profile without a matrix, each channel gets
    luminance / sum(y_from_rgb), so that the camera sees grey only.
    """
    colour = profile.colour
    if colour.rgb_to_radiance:
        return np.linalg.inv(np.reshape(colour.rgb_to_radiance, (3, 3)))
    return np.tile(np.asarray(RADIANCE_Y) / sum(colour.y_from_rgb), (3, 1))


def camera_channels(scene: Floats32, profile: CameraProfile) -> Floats32:
    """Return camera channels [h, w, 3] of a scene [h, w, 3] or grey [h, w, 1], in cd/m2."""
    matrix = camera_from_scene(profile).astype(np.float32)
    return scene * matrix.sum(axis=1) if scene.shape[-1] == 1 else scene @ matrix.T


def mosaic_of(image: Floats32, cfa: str) -> Floats32:
    """Return each pixel's channel in the Bayer pattern `cfa`: R, G, B [h, w, 3] become [h, w].

    cfa : the letters of a cell of 2 x 2 pixels, row by row, such as RGGB.
    """
    out = np.empty(image.shape[:2], np.float32)
    for i, letter in enumerate(cfa):
        row, column = divmod(i, 2)
        out[row::2, column::2] = image[row::2, column::2, "RGB".index(letter)]
    return out


def _cells(cfa: str, by_colour: tuple[float, ...], shape: tuple[int, int]) -> Floats32:
    """Return the values of R, G1, G2, B at their pixels of a mosaic, [h, w]."""
    out = np.empty(shape, np.float32)
    for (row, column), value in zip(channel_positions(cfa), by_colour, strict=True):
        out[row::2, column::2] = value
    return out


class RawSensor:
    """A simulated Bayer sensor with the properties of a camera profile."""

    def __init__(self, profile: CameraProfile) -> None:
        sensor, body = profile.sensor, profile.camera
        shape = (body.height_px, body.width_px)
        self._profile = profile
        self._black = _cells(sensor.cfa, sensor.black_dn, shape)
        self._full = _cells(sensor.cfa, sensor.saturation_dn, shape)
        self._range = sensor.white_dn - self._black

    def counts(
        self, mosaic_cdm2: Floats32, exposure: Exposure, true_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the raw counts [h, w] of one frame, with shot noise and read noise, clipped.

        mosaic_cdm2 [h, w] : value of each pixel's channel after vignetting [cd/m2]; true_s : the
        true shutter time [s].
        """
        sensor, k = self._profile.sensor, self._profile.scale.k
        gain = gain_e_per_dn(exposure.iso, self._profile)
        per = z_per_cdm2(true_s, exposure.f_number, exposure.iso, k)
        red, green, blue = nd_factors(exposure.nd, self._profile)
        attenuation = _cells(sensor.cfa, (red, green, green, blue), mosaic_cdm2.shape)
        electrons = mosaic_cdm2 * (self._range * np.float32(per * gain)) / attenuation
        electrons = np.minimum(electrons, np.float32(4.0 * gain * sensor.white_dn))
        noisy = electrons + rng.standard_normal(electrons.shape, np.float32) * np.sqrt(
            np.where(electrons > _GAUSSIAN_ABOVE_E, electrons, 0.0)
            + np.float32(sensor.read_noise_e**2)
        )
        few = (electrons <= _GAUSSIAN_ABOVE_E) & (electrons > 0)
        mean = electrons[few]
        noisy[few] += rng.poisson(mean) - mean
        return np.clip(np.rint(noisy / np.float32(gain) + self._black), 0, self._full).astype(
            np.uint16
        )


class JpegSensor:
    """A simulated camera that writes 8-bit codes through the response of a profile."""

    def __init__(self, profile: CameraProfile) -> None:
        self._profile = profile
        self._z = response_tables(profile).T  # [3, 256]

    def codes(
        self, image_cdm2: Floats32, exposure: Exposure, true_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Return the 8-bit codes [h, w, 3] (R, G, B) of one frame, with noise.

        image_cdm2 [h, w, 3] : camera channels after vignetting [cd/m2]; true_s : the true shutter
        time [s].
        """
        sensor, k = self._profile.sensor, self._profile.scale.k
        per = z_per_cdm2(true_s, exposure.f_number, exposure.iso, k)
        full_e = sensor.gain_e_per_dn * sensor.white_dn * sensor.iso / exposure.iso
        z = (
            image_cdm2
            * np.float32(per)
            / np.asarray(nd_factors(exposure.nd, self._profile), np.float32)
        )
        spread = np.sqrt(np.maximum(z, 0) / full_e + (sensor.read_noise_e / full_e) ** 2)
        z = z + rng.standard_normal(z.shape, np.float32) * spread
        out = np.empty(z.shape, np.uint8)
        for c, table in enumerate(self._z):
            codes = np.interp(z[..., c], table + np.arange(256) * 1e-12, np.arange(256.0))
            out[..., c] = np.rint(codes)
        return out
