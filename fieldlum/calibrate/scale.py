"""The absolute factor k from spot luminances and illuminances, with its uncertainty and every reading's residual."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.keep import needed, read_table
from fieldlum.calibrate.order import Candidate, Choice, choose
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.images import read_panorama
from fieldlum.photometry import illuminance_lx
from fieldlum.projection import direction, equirect_rays
from fieldlum.records import Panorama

SPOT_DEG = 0.5  # half of a spot meter's field of 1 degree
METER_U = 0.02  # relative, common to all readings of one meter: its calibration
READING_U = 0.02  # of a single reading: aiming, flicker, a passing cloud
FAR = 3.0  # readings further off than this many u count less, and are named


@dataclass(frozen=True, slots=True)
class Reading:
    """One comparison: what the meter read and what the picture says there, in the same unit."""

    kind: str  # spot or illuminance
    label: str
    meter: float
    image: float
    u_rel: float


@dataclass(frozen=True, slots=True)
class Fit:
    factor: float  # multiplies the profile's k
    u_rel: float
    residual: NDArray[np.float64]  # meter over corrected image, less one, [n]
    far: tuple[str, ...]
    choice: Choice


def from_table(path: Path) -> tuple[list[Reading], list[Path]]:
    """Readings from a csv: panorama, azimuth_deg, altitude_deg, and luminance_cdm2 or illuminance_lx; u_rel optional.

    Azimuth clockwise from north. A spot is the trimmed mean over 1 degree; an illuminance that of the plane that looks
    there. Raises InputError for both or neither in a line.
    """
    rows = read_table(path, ("panorama", "azimuth_deg", "altitude_deg"), ("luminance_cdm2", "illuminance_lx", "u_rel"))
    pictures = {file: read_panorama(file) for file in dict.fromkeys(needed(row, "panorama", path) for row in rows)}
    found = []
    for row in rows:
        azimuth, altitude = needed(row, "azimuth_deg", path), needed(row, "altitude_deg", path)
        spot, plane = row.get("luminance_cdm2"), row.get("illuminance_lx")
        if (spot is None) == (plane is None):
            raise InputError(path, "a line with both or neither reading", "luminance_cdm2 or illuminance_lx")
        picture, u = pictures[row["panorama"]], row.get("u_rel") or READING_U
        label = f"{row['panorama'].stem} {azimuth:g}/{altitude:g} deg"
        if spot is not None:
            image, u_image = spot_cdm2(picture, azimuth, altitude)
            found.append(Reading("spot", label, spot, image, float(np.hypot(u, u_image))))
        else:
            image = illuminance_lx(picture.luminance_cdm2, picture.heading_deg, altitude, azimuth, picture.sun)
            found.append(Reading("illuminance", label, plane or 0.0, image, u))
    return found, list(pictures)


def spot_cdm2(picture: Panorama, azimuth_deg: float, altitude_deg: float) -> tuple[float, float]:
    """Trimmed mean over the meter's field, at least a few pixels, and its relative spread."""
    from scipy.stats import trim_mean

    height, width = picture.luminance_cdm2.shape
    radius = np.radians(max(SPOT_DEG, 1.2 * 180.0 / height))
    rays = equirect_rays(height, width, picture.heading_deg)
    inside = rays @ direction(altitude_deg, azimuth_deg) >= np.cos(radius)
    values = np.asarray(picture.luminance_cdm2, float)[inside]
    values = values[np.isfinite(values)]
    if not len(values) or values.max() <= 0:
        raise InputError("picture", f"no light at {azimuth_deg:g}/{altitude_deg:g} deg", "a place that it shows")
    spread = float(values.std() / values.mean() / np.sqrt(len(values)))
    return float(trim_mean(values, 0.1)), spread


def fit(readings: list[Reading], meter_u: float = METER_U) -> Fit:
    """k by weighted least squares of ln(meter / image) with Huber weights; u(k) holds the meter's own u.

    A second model with an offset (stray light) is tried on held-out readings; it is never put into the profile, but
    said. Raises NotEnoughDataError without readings, InputError for readings that are not positive.
    """
    if not readings:
        raise NotEnoughDataError("no readings: one spot or one vertical illuminance is the least")
    meter, image, u = (np.array([getattr(r, name) for r in readings], float) for name in ("meter", "image", "u_rel"))
    if not ((meter > 0).all() and (image > 0).all()):
        bad = readings[int(np.argmin(np.minimum(meter, image)))]
        raise InputError(bad.label, f"meter {bad.meter:g}, image {bad.image:g}", "readings above zero")
    log = np.log(meter / image)
    centre, weight = _centre(log, u)
    off = np.abs(log - centre) / u
    scatter = float((weight * (log - centre) ** 2).sum() / max(len(log) - 1, 1))
    u_log = np.sqrt(max(scatter, 1.0) / weight.sum())
    far = tuple(r.label for r, o in zip(readings, off, strict=True) if o > FAR)
    spots = np.array([r.kind == "spot" for r in readings])
    choice = _choice(meter, image, u, log, spots)
    residual = meter / (image * np.exp(centre)) - 1.0
    return Fit(float(np.exp(centre)), float(np.hypot(u_log, meter_u)), residual, far, choice)


def _centre(log: NDArray[np.float64], u: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    weight = 1.0 / u**2
    centre = float(np.median(log))
    for _ in range(30):
        pull = np.abs(log - centre) / u
        weight = 1.0 / u**2 * np.minimum(1.0, 2.0 / np.maximum(pull, 1e-12))
        centre = float((weight * log).sum() / weight.sum())
    return centre, weight


def _choice(
    meter: NDArray[np.float64], image: NDArray[np.float64], u: NDArray[np.float64], log: NDArray[np.float64],
    spots: NDArray[np.bool_],
) -> Choice:  # fmt: skip
    """One factor, or a factor and an offset, on spots left out one by one."""
    n = len(log)
    if n < 2:
        return Choice(0, "scale: one reading, one factor: nothing to hold out")
    plain = np.array([log[i] - _centre(np.delete(log, i), np.delete(u, i))[0] for i in range(n)]) ** 2
    candidates = [Candidate("one factor", 1, plain)]
    if spots.sum() >= 5 and spots.all():
        errors = [
            _offset_error(np.delete(meter, i), np.delete(image, i), np.delete(u, i), meter[i], image[i])
            for i in range(n)
        ]
        candidates.append(Candidate("factor and offset", 2, np.array(errors)))
    return choose("scale", candidates)


def _offset_error(
    meter: NDArray[np.float64], image: NDArray[np.float64], u: NDArray[np.float64], held: float, held_image: float
) -> float:
    a = np.stack([image, np.ones_like(image)], axis=1) / (u * meter)[:, None]
    slope, offset = np.linalg.lstsq(a, 1.0 / u, rcond=None)[0]
    return float(np.log(max(slope * held_image + offset, 1e-3 * held) / held) ** 2)
