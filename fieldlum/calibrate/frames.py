"""Frames as linear camera colours, patch by patch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.photometry import (
    response_table,
    saturation_plateau,
    time_under,
    vignetting_at,
    z_per_cdm2,
)
from fieldlum.profiles import CameraProfile, Lens
from fieldlum.projection import LensGeometry, angle_of_radius
from fieldlum.raw import JPEG_SUFFIXES, channel_positions, read_jpeg, read_mosaic
from fieldlum.records import Exposure

FULL = 0.97  # of the saturation: brighter pixels are left out


@dataclass(frozen=True, slots=True)
class Patch:
    """Mean camera R, G, B [cd/m2 at the profile's k] of a disc on the sensor and its relative
    standard uncertainty.
    """

    rgb: NDArray[np.float64]
    u_rel: float
    clipped: float  # share of its pixels that were full, or too dark to mean anything


@dataclass(frozen=True, slots=True)
class LinearFrame:
    """Camera colours [h, w, 3] in cd/m2 at the profile's k, not corrected for vignetting; `step`
    sensor pixels a pixel.

    bad [h, w]: full, or outside the codes that a JPEG's response holds for.
    """

    path: Path
    rgb: NDArray[np.float32]
    bad: NDArray[np.bool_]
    step: int
    exposure: Exposure
    colour_matrix: NDArray[np.float64] | None = None

    def patch(self, x_px: float, y_px: float, radius_px: float) -> Patch:
        """Raises InputError for a patch outside the picture or clipped by more than a fifth."""
        h, w = self.bad.shape
        x, y, r = x_px / self.step, y_px / self.step, max(radius_px / self.step, 1.0)
        if not (r <= x <= w - r and r <= y <= h - r):
            found = f"a patch at {x_px:g}, {y_px:g} of radius {radius_px:g} px"
            raise InputError(self.path, found, f"one inside {w * self.step} x {h * self.step} px")
        rows, columns = slice(int(y - r), int(y + r) + 1), slice(int(x - r), int(x + r) + 1)
        yy, xx = np.mgrid[rows, columns]
        disc = (xx + 0.5 - x) ** 2 + (yy + 0.5 - y) ** 2 <= r**2
        values, bad = self.rgb[rows, columns][disc], self.bad[rows, columns][disc]
        if bad.mean() > 0.2:
            found = f"{100 * bad.mean():.0f} % of the patch at {x_px:g}, {y_px:g} is clipped"
            raise InputError(
                self.path,
                found,
                "an exposure that holds it",
                "take a frame that is neither full nor dark",
            )
        return _mean(values[~bad], float(bad.mean()))


def _mean(values: NDArray[np.float32], clipped: float) -> Patch:
    """Trimmed mean of [n, 3] and its uncertainty from the spread of the green."""
    from scipy.stats import trim_mean

    rgb = np.asarray(trim_mean(values.astype(float), 0.1, axis=0), float)
    spread = float(values[:, 1].std(ddof=1)) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return Patch(rgb, spread / max(float(rgb[1]), 1e-12), clipped)


def true_shutter_s(exposure: Exposure, profile: CameraProfile) -> float:
    """Return the profile's measured time where it has one, else the time under its shutter law."""
    known = (s.true_s for s in profile.shutter if abs(s.nominal_s / exposure.shutter_s - 1) < 0.02)
    return next(known, time_under(profile.shutter_law, exposure.shutter_s))


def linear_frame(path: Path, profile: CameraProfile) -> LinearFrame:
    """Raises InputError for a frame that cannot be read or that another camera took."""
    return (
        _from_jpeg(path, profile)
        if path.suffix.lower() in JPEG_SUFFIXES
        else _from_mosaic(path, profile)
    )


def _from_jpeg(path: Path, profile: CameraProfile) -> LinearFrame:
    frame, r = read_jpeg(path), profile.response
    check_size(path, frame.codes.shape[:2], profile)
    tables = [response_table(r.kind, curve) for curve in (r.red, r.green, r.blue)]
    z = np.stack([table[frame.codes[..., c]] for c, table in enumerate(tables)], axis=-1)
    bad = (frame.codes.max(axis=-1) > r.high_code) | (frame.codes.max(axis=-1) < r.low_code)
    return LinearFrame(
        path, (z / _per(frame.exposure, profile)).astype(np.float32), bad, 1, frame.exposure
    )


def _from_mosaic(path: Path, profile: CameraProfile) -> LinearFrame:
    mosaic, sensor = read_mosaic(path), profile.sensor
    check_size(path, mosaic.counts.shape, profile)
    black = sensor.black_dn if any(sensor.black_dn) else mosaic.black_dn
    at = channel_positions(mosaic.cfa)
    rows, columns = (n // 2 * 2 for n in mosaic.counts.shape)
    cells = [mosaic.counts[r:rows:2, c:columns:2].astype(np.float32) for r, c in at]
    plateaus = (
        saturation_plateau(mosaic.counts[r:rows:2, c:columns:2], mosaic.white_dn) or np.inf
        for r, c in at
    )
    full = [
        min(s, mosaic.white_dn, plateau)
        for s, plateau in zip(sensor.saturation_dn, plateaus, strict=True)
    ]
    bad = np.logical_or.reduce(
        [cell > FULL * limit for cell, limit in zip(cells, full, strict=True)]
    )
    z = [(cell - b) / (sensor.white_dn - b) for cell, b in zip(cells, black, strict=True)]
    rgb = np.stack([z[0], (z[1] + z[2]) / 2, z[3]], axis=-1) / _per(mosaic.exposure, profile)
    return LinearFrame(path, rgb.astype(np.float32), bad, 2, mosaic.exposure, mosaic.colour_matrix)


def _per(exposure: Exposure, profile: CameraProfile) -> float:
    exposed = replace(exposure, shutter_s=true_shutter_s(exposure, profile))
    return z_per_cdm2(exposed.shutter_s, exposed.f_number, exposed.iso, profile.scale.k)


def check_size(path: Path, shape: tuple[int, ...], profile: CameraProfile) -> None:
    """Raises InputError for a frame of another size than the profile's."""
    body = profile.camera
    if shape != (body.height_px, body.width_px):
        found = f"{shape[1]} x {shape[0]} pixels"
        raise InputError(
            path,
            found,
            f"{body.width_px} x {body.height_px}, as {body.name} says",
            "use its own profile",
        )


# ----------------------------------------------------------------------------------------------
# lens


def geometry_of(lens: Lens) -> LensGeometry:
    return LensGeometry(
        lens.centre_px,
        lens.radius_px,
        lens.full_angle_deg,
        lens.mapping,
        lens.coefficients,
        lens.azimuth_deg,
        lens.tilt_deg,
        lens.roll_deg,
    )


def nearest_lens(profile: CameraProfile, x_px: float, y_px: float) -> int:
    """Index of the lens whose circle the place lies in, relative to its radius."""
    away = [
        np.hypot(x_px - lens.centre_px[0], y_px - lens.centre_px[1]) / lens.radius_px
        for lens in profile.lens
    ]
    return int(np.argmin(away))


def relative_angle(lens: Lens, x_px: float, y_px: float) -> float:
    """Angle from the optical axis over half of the full angle."""
    geometry = geometry_of(lens)
    radius = np.hypot(x_px - lens.centre_px[0], y_px - lens.centre_px[1]) / lens.radius_px
    return float(angle_of_radius(geometry, radius) / geometry.half_angle_rad)


def transmission(lens: Lens, f_number: float, x_px: float, y_px: float) -> float:
    """V of the profile at a place, of the curve nearest in aperture; 1 without a curve."""
    if not lens.vignetting:
        return 1.0
    curve = min(lens.vignetting, key=lambda v: abs(np.log(v.f_number / f_number)))
    return float(vignetting_at(curve.coefficients, relative_angle(lens, x_px, y_px)))
