"""Simulate a fisheye camera that photographs a `World` and writes DNG or JPEG files."""

import zlib
from dataclasses import replace
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices import Camera, CameraInfo, nearest
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated import optics
from fieldlum.devices.simulated.world import World, detail_of
from fieldlum.optics import linear_light
from fieldlum.optics.camera_curves import vignetting_at
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.images import RADIANCE_Y
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import relative_radius
from fieldlum.optics.raw import channel_positions
from fieldlum.optics.raw.writing import write_dng, write_jpeg
from fieldlum.session import exposure_text
from fieldlum.sky.sky_view.picture import SkyGrid

# ----------------------------------------------------------------------------------------------
# the sensor: from luminance to counts or codes, with noise and clipping

# Nominal shutter times of cameras, in thirds of a stop.
_SECONDS = "30 25 20 15 13 10 8 6 5 4 3.2 2.5 2 1.6 1.3 1"
_FRACTIONS = (
    "1.3 1.6 2 2.5 3 4 5 6 8 10 13 15 20 25 30 40 50 60 80 100 125 160 200 250 320 400 500 640 800 "
    "1000 1250 1600 2000 2500 3200 4000 5000 6400 8000 10000 12800 16000"
)
DIAL_S = (*map(float, _SECONDS.split()), *(1.0 / float(text) for text in _FRACTIONS.split()))
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
    """Return camera channels [h, w, 3] in cd/m2 of a scene.

    scene: R, G, B of `simulated.optics.channels` [h, w, 3], or luminance of a grey scene [h, w, 1],
    cd/m2; the profile's colour converts it.
    """
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


@lru_cache(maxsize=4)  # the black level, filter and saturation of a bracket
def _cells(cfa: str, by_colour: tuple[float, ...], shape: tuple[int, int]) -> Floats32:
    """Return the values of R, G1, G2, B at their pixels of a mosaic, [h, w], not to be written."""
    out = np.empty(shape, np.float32)
    for (row, column), value in zip(channel_positions(cfa), by_colour, strict=True):
        out[row::2, column::2] = value
    return out


def raw_counts(
    mosaic_cdm2: Floats32, profile: CameraProfile, exposure: Exposure, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the raw counts [h, w] of one frame, with shot noise and read noise, clipped.

    mosaic_cdm2 [h, w] : value of each pixel's channel after vignetting [cd/m2]; exposure : with the
    true shutter time.
    """
    sensor, shape = profile.sensor, mosaic_cdm2.shape
    black = _cells(sensor.cfa, sensor.black_dn, shape)
    gain = linear_light.gain_e_per_dn(exposure.iso, profile)
    per = z_per_cdm2(exposure.shutter_s, exposure.f_number, exposure.iso, profile.scale.k)
    red, green, blue = linear_light.nd_factors(exposure.nd, profile)
    electrons = (sensor.white_dn - black) * np.float32(per * gain)
    electrons *= mosaic_cdm2
    electrons /= _cells(sensor.cfa, (red, green, green, blue), shape)
    np.minimum(electrons, np.float32(4.0 * gain * sensor.white_dn), out=electrons)
    normal = electrons > _GAUSSIAN_ABOVE_E
    spread = np.sqrt(electrons * normal + np.float32(sensor.read_noise_e**2))
    counted = rng.standard_normal(shape, np.float32)
    counted *= spread
    counted += electrons
    few = np.flatnonzero(~normal & (electrons > 0))
    expected = electrons.ravel()[few]
    counted.ravel()[few] += rng.poisson(expected) - expected
    counted /= np.float32(gain)
    counted += black
    np.rint(counted, out=counted)
    full = _cells(sensor.cfa, sensor.saturation_dn, shape)
    return np.clip(counted, 0, full, out=counted).astype(np.uint16)


def jpeg_codes(
    image_cdm2: Floats32, profile: CameraProfile, exposure: Exposure, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the 8-bit codes [h, w, 3] (R, G, B) of one frame, with noise.

    image_cdm2 [h, w, 3] : camera channels after vignetting [cd/m2]; exposure : with the true
    shutter time.
    """
    sensor = profile.sensor
    per = z_per_cdm2(exposure.shutter_s, exposure.f_number, exposure.iso, profile.scale.k)
    full_e = sensor.gain_e_per_dn * sensor.white_dn * sensor.iso / exposure.iso
    attenuation = np.asarray(linear_light.nd_factors(exposure.nd, profile), np.float32)
    z = image_cdm2 * np.float32(per) / attenuation
    spread = np.sqrt(np.maximum(z, 0) / full_e + (sensor.read_noise_e / full_e) ** 2)
    z = z + rng.standard_normal(z.shape, np.float32) * spread
    out = np.empty(z.shape, np.uint8)
    for c, table in enumerate(linear_light.response_tables(profile).T):  # [256]
        codes = np.interp(z[..., c], table + np.arange(256) * 1e-12, np.arange(256.0))
        out[..., c] = np.rint(codes)
    return out


# ----------------------------------------------------------------------------------------------
# the camera


class SimulatedCamera(Camera):
    """A simulated camera.

    heading_deg : azimuth of its view, clockwise from true north, unless `expose` states another;
    clock_offset_s : its clock minus the computer's; overhead_s : time of a frame in addition to its
    shutter time [s] (None: the profile's).
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
        overhead_s: float | None = None,
    ) -> None:
        """Point a camera at `world`.

        heading_deg: clockwise from north; seed: of the noise; clock_offset_s: of its own clock;
        overhead_s: time that a frame takes next to its exposure, None for the profile's.
        """
        self._world, self._profile, self._clock = world, profile, clock
        self._heading_deg, self._seed = heading_deg, seed
        self._clock_offset_s = clock_offset_s
        self._overhead_s = profile.bracket.seconds_per_frame if overhead_s is None else overhead_s
        body, lens = profile.camera, profile.lens[0].name
        self._shape, self._is_jpeg = (body.height_px, body.width_px), body.kind == "jpeg"
        about = ("sim", body.make, body.model, f"SIM{seed:04d}")
        self.info = CameraInfo(*about, lens=lens, clock_offset_s=clock_offset_s)
        self._shading = lru_cache(maxsize=8)(self._shading_of)
        self._last: tuple[Panorama, float, Floats32] | None = None

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame and return its file, `target` plus a suffix.

        heading_deg : view direction; None: that of the camera. The clock advances by the overhead
        plus the shutter time. Raises DeviceError for a setting that the camera does not have, and
        for a time without a picture in the session's truth/.
        """
        dial_s = self._allowed(exposure)
        set_to = replace(exposure, shutter_s=dial_s)
        opened = self._clock.now()
        heading = self._heading_deg if heading_deg is None else heading_deg
        image = self._image(self._world.scene(opened), heading) * self._shading(exposure.f_number)
        true_s, _ = linear_light.true_shutter_s(dial_s, self._profile)
        taken = replace(set_to, shutter_s=true_s)
        # Each frame has its own seed, independent of earlier frames, so that a resumed capture
        # gives the same frames as an undisturbed one.
        name = f"{opened.timestamp():.0f} {set_to} {heading}".encode()
        rng = np.random.default_rng([self._seed, zlib.crc32(name)])
        t_camera = opened + timedelta(seconds=self._clock_offset_s)
        body, sensor = self._profile.camera, self._profile.sensor
        about: dict[str, Any] = {"make": body.make, "model": body.model}
        about["t_camera"] = t_camera.replace(tzinfo=None)  # cameras write no time zone
        path = target.with_name(f"{target.name}.{'jpg' if self._is_jpeg else 'dng'}")
        if self._is_jpeg:
            write_jpeg(path, jpeg_codes(image, self._profile, taken, rng), set_to, **about)
        else:
            about |= {"black_dn": sensor.black_dn, "white_dn": sensor.white_dn, "cfa": sensor.cfa}
            write_dng(path, raw_counts(image, self._profile, taken, rng), set_to, **about)
        self._clock.sleep(self._overhead_s + true_s)
        return path

    def _allowed(self, exposure: Exposure) -> float:
        """Return the true shutter time of the dial [s].

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
        """Return camera channels before vignetting, [h, w] on the mosaic or [h, w, 3].

        The result is stored and used again while the scene does not change. heading_deg: of the
        camera, clockwise from north.
        """
        if self._last is None or self._last[0] is not panorama or self._last[1] != heading_deg:
            height, width = panorama.luminance_cdm2.shape
            detail = detail_of(panorama)
            grid = None if detail is None else detail.grid
            views = self._views(heading_deg - panorama.heading_deg, (height, width), grid)
            image = camera_channels(optics.on_sensor(panorama, views, self._shape), self._profile)
            if not self._is_jpeg:
                image = mosaic_of(image, self._profile.sensor.cfa)
            self._last = (panorama, heading_deg, image)
        return self._last[2]

    def _views(
        self, turn_deg: float, panorama: tuple[int, int], grid: SkyGrid | None
    ) -> list[optics.LensSampling]:
        lenses = (linear_light.lens_geometry(lens, turn_deg) for lens in self._profile.lens)
        return [optics.lens_sampling(lens, self._shape, panorama, grid) for lens in lenses]

    def _shading_of(self, f_number: float) -> Floats32:
        """Return the vignetting on the sensor, [h, w] or [h, w, 1]."""
        out = np.ones(self._shape, np.float32)
        columns = np.arange(self._shape[1]) + 0.5
        for lens in self._profile.lens:
            curve, _ = linear_light.vignetting_of(lens, f_number)
            for row, shading in enumerate(out):
                distance = relative_radius(lens, columns, row + 0.5)
                inside = distance <= 1.0
                angle = optics.angle_of_radius(lens, distance[inside])
                shading[inside] = vignetting_at(curve, angle / lens.half_angle_rad)
        return out[..., None] if self._is_jpeg else out
