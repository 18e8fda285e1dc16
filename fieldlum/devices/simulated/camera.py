"""Simulate a fisheye camera that photographs a `World` and writes DNG or JPEG files."""

from __future__ import annotations

import zlib
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices import CameraInfo, nearest
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated import optics, sensor
from fieldlum.devices.simulated.world import World, detail_of
from fieldlum.optics.linear_light import lens_geometry, true_shutter_s, vignetting_of
from fieldlum.optics.photometry import vignetting_at
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import relative_radius
from fieldlum.optics.raw import write_dng, write_jpeg
from fieldlum.sky.sky_view import SkyGrid


class SimulatedCamera:
    """A simulated camera; implements `Camera`.

    heading_deg : its view direction unless `expose` states another; clock_offset_s : its clock
    minus the computer's; overhead_s : time of a frame in addition to its shutter time
    [s] (None: the profile's).
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
        self._world, self._profile, self._clock = world, profile, clock
        self._heading_deg, self._seed = heading_deg, seed
        self._clock_offset_s = clock_offset_s
        self._overhead_s = profile.bracket.seconds_per_frame if overhead_s is None else overhead_s
        self._shape = (profile.camera.height_px, profile.camera.width_px)
        self._raw = sensor.RawSensor(profile) if profile.camera.kind == "raw" else None
        self._jpeg = sensor.JpegSensor(profile) if profile.camera.kind == "jpeg" else None
        self._views = lru_cache(maxsize=8)(self._views_of)
        self._shading = lru_cache(maxsize=8)(self._shading_of)
        self._last: tuple[Panorama, float, Floats32] | None = None

    @property
    def info(self) -> CameraInfo:
        """Return what the simulated camera reports about itself."""
        body = self._profile.camera
        return CameraInfo(
            "sim",
            body.make,
            body.model,
            f"SIM{self._seed:04d}",
            lens=self._profile.lens[0].name,
            clock_offset_s=self._clock_offset_s,
        )

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame and return its file, `target` plus a suffix.

        heading_deg : view direction; None: that of the camera. The clock advances by the overhead
        plus the shutter time. Raises DeviceError for a setting that the camera does not have, and
        for a time without a picture in the session's truth/.
        """
        dial_s = self._allowed(exposure)
        set_to = Exposure(dial_s, exposure.f_number, exposure.iso, exposure.nd)
        opened = self._clock.now()
        heading = self._heading_deg if heading_deg is None else heading_deg
        image = self._image(self._world.scene(opened), heading) * self._shading(exposure.f_number)
        true_s, _ = true_shutter_s(dial_s, self._profile)
        # Each frame has its own seed, independent of earlier frames, so that a resumed capture
        # gives the same frames as an undisturbed one.
        name = f"{opened.timestamp():.0f} {set_to} {heading}".encode()
        rng = np.random.default_rng([self._seed, zlib.crc32(name)])
        path = self._write(image, set_to, true_s, target, opened, rng)
        self._clock.sleep(self._overhead_s + true_s)
        return path

    def close(self) -> None:
        """Forget the last simulated picture, which is stored for repeated exposures."""
        self._last = None

    def _allowed(self, exposure: Exposure) -> float:
        """Return the true shutter time of the dial [s].

        Raises DeviceError for settings that the camera does not have.
        """
        profile = self._profile
        apertures = [v.f_number for v in profile.lens[0].vignetting] or [profile.bracket.f_number]
        if exposure.f_number not in apertures:
            raise DeviceError(
                f"simulated camera: no f/{exposure.f_number:g}; expected "
                f"{', '.join(f'f/{n:g}' for n in apertures)}; "
                "correct f_number in [bracket] of the profile, then plan a new session"
            )
        if exposure.nd not in {"", *(nd.name for nd in profile.nd)}:
            filters = ", ".join(nd.name for nd in profile.nd) or "an exposure without a filter"
            raise DeviceError(
                f"simulated camera: no filter '{exposure.nd}'; expected {filters}; correct nd in "
                "[bracket] of the profile, or add the filter to [[nd]], then plan a new session"
            )
        if not 50 <= exposure.iso <= 6400:
            raise DeviceError(
                f"simulated camera: no ISO {exposure.iso:g}; expected 50 to 6400; correct iso in "
                "[bracket] of the profile, then plan a new session"
            )
        return nearest(exposure.shutter_s, sensor.DIAL_S, "simulated camera: shutter", "s")

    def _image(self, panorama: Panorama, heading_deg: float) -> Floats32:
        """Return camera channels before vignetting, [h, w] on the mosaic or [h, w, 3].

        The result is stored and used again while the scene does not change.
        """
        if self._last is None or self._last[0] is not panorama or self._last[1] != heading_deg:
            height, width = panorama.luminance_cdm2.shape
            detail = detail_of(panorama)
            grid = None if detail is None else detail.grid
            views = self._views(heading_deg - panorama.heading_deg, (height, width), grid)
            scene = optics.on_sensor(panorama, views, self._shape)
            image = sensor.camera_channels(scene, self._profile)
            if self._raw is not None:
                image = sensor.mosaic_of(image, self._profile.sensor.cfa)
            self._last = (panorama, heading_deg, image)
        return self._last[2]

    def _views_of(
        self, turn_deg: float, panorama: tuple[int, int], grid: SkyGrid | None
    ) -> list[optics.LensSampling]:
        lenses = (lens_geometry(lens, turn_deg) for lens in self._profile.lens)
        return [optics.look(lens, self._shape, panorama, grid) for lens in lenses]

    def _shading_of(self, f_number: float) -> Floats32:
        """Return the vignetting on the sensor, [h, w] or [h, w, 1]."""
        out = np.ones(self._shape, np.float32)
        rows, columns = np.mgrid[0.5 : self._shape[0], 0.5 : self._shape[1]]
        for lens in self._profile.lens:
            geometry = lens.geometry
            distance = relative_radius(geometry, columns, rows)
            angle = optics.angle_of_radius(geometry, np.minimum(distance, 1.0))
            relative = angle / geometry.half_angle_rad
            curve, _ = vignetting_of(lens, f_number)
            inside = distance <= 1.0
            out[inside] = vignetting_at(curve, relative)[inside]
        return out if self._jpeg is None else out[..., None]

    def _write(
        self,
        image: Floats32,
        exposure: Exposure,
        true_s: float,
        target: Path,
        opened: datetime,
        rng: np.random.Generator,
    ) -> Path:
        body = self._profile.camera
        camera_time = opened + timedelta(seconds=self._clock_offset_s)
        t_camera = camera_time.replace(tzinfo=None)  # cameras write no time zone
        if self._jpeg is not None:
            path = target.with_name(f"{target.name}.jpg")
            codes = self._jpeg.codes(image, exposure, true_s, rng)
            write_jpeg(path, codes, exposure, t_camera=t_camera, make=body.make, model=body.model)
            return path
        assert self._raw is not None
        path, s = target.with_name(f"{target.name}.dng"), self._profile.sensor
        counts = self._raw.counts(image, exposure, true_s, rng)
        write_dng(
            path,
            counts,
            exposure,
            black_dn=s.black_dn,
            white_dn=s.white_dn,
            cfa=s.cfa,
            t_camera=t_camera,
            make=body.make,
            model=body.model,
        )
        return path
