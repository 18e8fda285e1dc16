"""Simulate a fisheye camera that photographs a `World` and writes DNG or JPEG files."""

import zlib
from dataclasses import replace
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, UInts8, UInts16
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices import Camera, CameraInfo, nearest
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated import optics
from fieldlum.devices.simulated.world import World, detail_of
from fieldlum.optics import images, linear_light, projection, raw
from fieldlum.optics.camera_curves import vignetting_at
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw.writing import write_dng, write_jpeg
from fieldlum.session import exposure_text

# ----------------------------------------------------------------------------------------------
# the sensor: from luminance to counts or codes, with noise and clipping

# Nominal shutter times of cameras, in thirds of a stop: seconds, and parts of a second.
_SECONDS = "30 25 20 15 13 10 8 6 5 4 3.2 2.5 2 1.6 1.3 1"
_PARTS = (
    "1.3 1.6 2 2.5 3 4 5 6 8 10 13 15 20 25 30 40 50 60 80 100 125 160 200 250 320 400 500 640 800 "
    "1000 1250 1600 2000 2500 3200 4000 5000 6400 8000 10000 12800 16000"
)
DIAL_S = (*map(float, _SECONDS.split()), *(1.0 / float(part) for part in _PARTS.split()))
# A Poisson distribution of more electrons is approximated by a normal one, for speed. Chosen.
_GAUSSIAN_ABOVE_E = 60.0


def camera_from_scene(profile: CameraProfile) -> Floats:
    """Return the matrix from scene R, G, B to camera channels, both in cd/m2, [3, 3].

    It is the inverse of the profile's colour matrix. Without such a matrix, each channel gets
    luminance / sum(y_from_rgb), so that the camera sees grey only.
    """
    colour = profile.colour
    if colour.rgb_to_radiance:
        return np.linalg.inv(np.reshape(colour.rgb_to_radiance, (3, 3)))
    return np.tile(np.asarray(images.RADIANCE_Y) / sum(colour.y_from_rgb), (3, 1))


def mosaic_of(image: Floats32, cfa: str) -> Floats32:
    """Return the one channel that each pixel has under the Bayer pattern `cfa`, [h, w].

    image: R, G, B of each pixel, [h, w, 3]; cfa : the letters of a cell of 2 x 2 pixels, row by
    row, such as RGGB.
    """
    mosaic = np.empty(image.shape[:2], np.float32)
    for (row, column), channel in zip(raw.channel_positions(cfa), (0, 1, 1, 2), strict=True):
        mosaic[row::2, column::2] = image[row::2, column::2, channel]
    return mosaic


@lru_cache(maxsize=4)  # the black level, filter and saturation of a bracket
def _mosaic_of_values(cfa: str, values: tuple[float, ...], shape: tuple[int, int]) -> Floats32:
    """Return a mosaic [h, w] with one value for each of R, G1, G2, B, which is cached: read only.

    cfa: letters of a cell of 2 x 2 pixels, row by row, such as RGGB; shape: (height, width).
    """
    mosaic = np.empty(shape, np.float32)
    for (row, column), value in zip(raw.channel_positions(cfa), values, strict=True):
        mosaic[row::2, column::2] = value
    return mosaic


def raw_counts(
    mosaic_cdm2: Floats32, profile: CameraProfile, exposure: Exposure, rng: np.random.Generator
) -> UInts16:
    """Return the raw counts [h, w] of one frame, with shot noise and read noise, clipped.

    mosaic_cdm2 : value of each pixel's channel after vignetting [cd/m2], [h, w]; exposure : with
    the true shutter time; rng : of the noise.
    """
    sensor, shape = profile.sensor, mosaic_cdm2.shape
    black_dn = _mosaic_of_values(sensor.cfa, sensor.black_dn, shape)
    gain = linear_light.gain_e_per_dn(exposure.iso, profile)
    # linear light z (1 at the white level) per cd/m2
    z_of_1 = z_per_cdm2(exposure.shutter_s, exposure.f_number, exposure.iso, profile.scale.k)
    red, green, blue = linear_light.nd_factors(exposure.nd, profile)
    electrons = (sensor.white_dn - black_dn) * np.float32(z_of_1 * gain)
    electrons *= mosaic_cdm2
    electrons /= _mosaic_of_values(sensor.cfa, (red, green, green, blue), shape)
    # far above saturation, so that a sun does not overflow the integers of the noise
    np.minimum(electrons, np.float32(4.0 * gain * sensor.white_dn), out=electrons)
    is_normal = electrons > _GAUSSIAN_ABOVE_E
    spread = np.sqrt(electrons * is_normal + np.float32(sensor.read_noise_e**2))
    counts = rng.standard_normal(shape, np.float32)  # in electrons, then in DN
    counts *= spread
    counts += electrons
    few = np.flatnonzero(~is_normal & (electrons > 0))
    expected = electrons.ravel()[few]
    counts.ravel()[few] += rng.poisson(expected) - expected
    counts /= np.float32(gain)
    counts += black_dn
    np.rint(counts, out=counts)
    saturation_dn = _mosaic_of_values(sensor.cfa, sensor.saturation_dn, shape)
    return np.clip(counts, 0, saturation_dn, out=counts).astype(np.uint16)


def jpeg_codes(
    image_cdm2: Floats32, profile: CameraProfile, exposure: Exposure, rng: np.random.Generator
) -> UInts8:
    """Return the 8-bit codes (R, G, B) of one frame, with noise, [h, w, 3].

    image_cdm2 : camera channels after vignetting [cd/m2], [h, w, 3]; exposure : with the true
    shutter time; rng : of the noise.
    """
    sensor = profile.sensor
    z_of_1 = z_per_cdm2(exposure.shutter_s, exposure.f_number, exposure.iso, profile.scale.k)
    full_e = sensor.gain_e_per_dn * sensor.white_dn * sensor.iso / exposure.iso  # at z = 1
    attenuation = np.asarray(linear_light.nd_factors(exposure.nd, profile), np.float32)
    z = image_cdm2 * np.float32(z_of_1) / attenuation  # linear light, 1 at the white level
    spread = np.sqrt(np.maximum(z, 0) / full_e + (sensor.read_noise_e / full_e) ** 2)
    z = z + rng.standard_normal(z.shape, np.float32) * spread
    codes = np.empty(z.shape, np.uint8)
    for channel, z_of_code in enumerate(linear_light.response_tables(profile).T):  # [256]
        # equal values of two codes would be no function of z
        increasing = z_of_code + np.arange(256) * 1e-12
        codes[..., channel] = np.rint(np.interp(z[..., channel], increasing, np.arange(256.0)))
    return codes


# ----------------------------------------------------------------------------------------------
# the camera


class SimulatedCamera(Camera):
    """A simulated camera, which writes raw DNG files, or JPEG files if its profile is of that kind.

    Its frames show the scene of `world`, at the time of `clock`.
    """

    def __init__(
        self,
        world: World,
        profile: CameraProfile,
        clock: Clock,
        *,
        heading_deg: float = 180.0,
        seed: int = 1,
        clock_offset_s: float = 0.0,
    ) -> None:
        """Point the camera.

        heading_deg: azimuth of its view, clockwise from true north, unless `expose` states another;
        seed: of the noise; clock_offset_s: its clock minus the computer's [s].
        """
        self._world, self._profile, self._clock = world, profile, clock
        self._heading_deg, self._seed = heading_deg, seed
        self._clock_offset_s = clock_offset_s
        body, lens = profile.camera, profile.lens[0].name
        self._shape, self._is_jpeg = (body.height_px, body.width_px), body.kind == "jpeg"
        about = ("sim", body.make, body.model, f"SIM{seed:04d}")
        self.info = CameraInfo(*about, lens=lens, clock_offset_s=clock_offset_s)
        self._vignetting = lru_cache(maxsize=8)(self._vignetting_at)
        # the newest image, and the panorama and heading that it is of
        self._last: tuple[Panorama, float, Floats32] | None = None

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame and return its file, `target` plus a suffix.

        heading_deg : view direction, clockwise from true north; None: that of the camera. The clock
        advances by the profile's seconds_per_frame plus the shutter time. Raises DeviceError for a
        setting that the camera does not have, and for a time without a picture in the session's
        truth/; InputError for a picture there that cannot be read.
        """
        dial_s = self._dial_s(exposure)
        set_to = replace(exposure, shutter_s=dial_s)
        opened = self._clock.now()
        heading = self._heading_deg if heading_deg is None else heading_deg
        image = self._image(self._world.scene(opened), heading)
        image = image * self._vignetting(exposure.f_number)
        true_s, _ = linear_light.true_shutter_s(dial_s, self._profile)
        taken = replace(set_to, shutter_s=true_s)
        # Each frame has its own seed, independent of earlier frames, so that a resumed capture
        # gives the same frames as an undisturbed one.
        name = f"{opened.timestamp():.0f} {set_to} {heading}".encode()
        rng = np.random.default_rng([self._seed, zlib.crc32(name)])
        t_camera = (opened + timedelta(seconds=self._clock_offset_s)).replace(tzinfo=None)
        body, sensor = self._profile.camera, self._profile.sensor
        # cameras write no time zone
        about: dict[str, Any] = {"make": body.make, "model": body.model, "t_camera": t_camera}
        path = target.with_name(f"{target.name}.{'jpg' if self._is_jpeg else 'dng'}")
        if self._is_jpeg:
            write_jpeg(path, jpeg_codes(image, self._profile, taken, rng), set_to, **about)
        else:
            about |= {"black_dn": sensor.black_dn, "white_dn": sensor.white_dn, "cfa": sensor.cfa}
            write_dng(path, raw_counts(image, self._profile, taken, rng), set_to, **about)
        self._clock.sleep(self._profile.bracket.seconds_per_frame + true_s)
        return path

    def _dial_s(self, exposure: Exposure) -> float:
        """Return the nominal shutter time of the camera's dial [s] for a planned exposure.

        Raises DeviceError for settings that the camera does not have.
        """
        profile = self._profile
        apertures = [v.f_number for v in profile.lens[0].vignetting] or [profile.bracket.f_number]
        filters = ["", *(nd.name for nd in profile.nd)]
        is_allowed = exposure.f_number in apertures and exposure.nd in filters
        if not (is_allowed and 50 <= exposure.iso <= 6400):
            expected = f"f-numbers {apertures}, filters {filters}, ISO 50 to 6400"
            remedy = "correct [bracket] of the profile, then plan a new session"
            found = f"no {exposure_text(exposure)}"
            raise DeviceError(f"simulated camera: {found}; expected {expected}; {remedy}")
        return nearest(exposure.shutter_s, DIAL_S, "simulated camera: shutter", "s")

    def _image(self, panorama: Panorama, heading_deg: float) -> Floats32:
        """Return the camera channels of a scene before vignetting [cd/m2].

        It is a mosaic [h, w] for a raw file, [h, w, 3] for a JPEG; it is computed once for all
        frames of the same scene. heading_deg: of the camera, clockwise from north.
        """
        if self._last is None or self._last[0] is not panorama or self._last[1] != heading_deg:
            height, width = panorama.luminance_cdm2.shape
            detail = detail_of(panorama)
            grid = None if detail is None else detail.grid
            turn_deg = heading_deg - panorama.heading_deg
            lenses = (linear_light.lens_geometry(lens, turn_deg) for lens in self._profile.lens)
            sampled = (self._shape, (height, width), grid)
            views = [optics.lens_sampling(lens, *sampled) for lens in lenses]
            image = optics.on_sensor(panorama, views, self._shape)  # R, G, B, or grey
            matrix = camera_from_scene(self._profile).astype(np.float32)
            image = image * matrix.sum(axis=1) if image.shape[-1] == 1 else image @ matrix.T
            if not self._is_jpeg:
                image = mosaic_of(image, self._profile.sensor.cfa)
            self._last = (panorama, heading_deg, image)
        return self._last[2]

    def _vignetting_at(self, f_number: float) -> Floats32:
        """Return the factor that reduces each pixel's light, [h, w], or [h, w, 1] for a JPEG."""
        factors = np.ones(self._shape, np.float32)
        columns = np.arange(self._shape[1]) + 0.5
        for lens in self._profile.lens:
            curve, _ = linear_light.vignetting_of(lens, f_number)
            for row, factors_of_row in enumerate(factors):
                radius = projection.relative_radius(lens, columns, row + 0.5)
                inside = radius <= 1.0
                angle_rad = optics.angle_of_radius(lens, radius[inside])
                factors_of_row[inside] = vignetting_at(curve, angle_rad / lens.half_angle_rad)
        return factors[..., None] if self._is_jpeg else factors
