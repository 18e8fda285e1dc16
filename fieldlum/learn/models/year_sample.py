"""The error that a trained model expects over a year, from a sample of the year's hours.

Held-out days are close to captured ones, so their errors are too small for other seasons.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Protocol

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Prediction, trusted_hours
from fieldlum.learn.models.data import Dataset
from fieldlum.room.scene.patches import sun_patches
from fieldlum.sky import sun
from fieldlum.sky.light import Light, light_at

YEAR_HOURS = 150  # measured: their mean expected error has a standard error of 10 to 15 %
_CHUNK = 50  # hours; about 20 MB for each map layer at 460 x 230; chosen
# Chosen, not measured: below these suns refraction and horizon, or clear-sky irradiance, are
# uncertain; beam and diffuse irradiance are at most these multiples of a cloudless sky's.
_LOWEST_SUN_DEG, _LOWEST_CLEAR_SUN_DEG = 2.0, 5.0
_MAX_BEAM, _MAX_DIFFUSE = 1.2, 4.0


class Predictor(Protocol):
    """A fitted model that predicts maps."""

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict maps of n hours; patch_cdm2: [n, H, W]."""
        ...


@dataclass(frozen=True, slots=True)
class YearExpectation:
    """The error that a model itself expects over a year, from a sample of hours.

    expected_log10_mse: mean over the sample, NaN if the model does not estimate its error;
    trusted_share: share of trusted hours, 0 to 1; hours: number of sampled hours.
    """

    expected_log10_mse: float
    trusted_share: float
    hours: int


def light_of_year(data: Dataset, rng: np.random.Generator) -> Light:
    """Return the light of 150 random daylight hours of a year, with weather of random captures.

    A capture's weather is the ratio of its direct normal and diffuse irradiance to those of a
    cloudless sky, at most 1.2 and 4; the hour has these ratios times its own cloudless sky. The
    year is that of the first capture; rng: source of the random draws.
    """
    site, first = data.setup.site, data.light.t_utc[0]
    begin = datetime(first.year, 1, 1, tzinfo=UTC)
    hours = [begin + timedelta(hours=hour) for hour in range(365 * 24)]
    up = np.asarray(sun.position(hours, site).altitude_deg) > _LOWEST_SUN_DEG
    times = [hours[k] for k in np.sort(rng.choice(np.flatnonzero(up), YEAR_HOURS, replace=False))]
    high = np.flatnonzero(data.light.sun_altitude_deg > _LOWEST_CLEAR_SUN_DEG)
    drawn = rng.choice(high if len(high) else np.arange(len(data)), YEAR_HOURS)
    there = sun.clearsky([data.light.t_utc[k] for k in drawn], site)
    here = sun.clearsky(times, site)

    beam = data.light.dni_wm2[drawn] / np.maximum(there.dni_wm2, 1.0)
    diffuse = data.light.dhi_wm2[drawn] / np.maximum(there.dhi_wm2, 1.0)
    beam, diffuse = np.minimum(beam, _MAX_BEAM), np.minimum(diffuse, _MAX_DIFFUSE)
    return light_at(times, site, beam * here.dni_wm2, diffuse * here.dhi_wm2)


def expect(
    fitted: Predictor, data: Dataset, light: Light, progress: Progress = quiet
) -> YearExpectation:
    """Return what a model of the captures `data` expects of the n hours of `light`.

    If `data` has sun patches, those of `light` are computed from the room of `data`. The expected
    log10 MSE is NaN for a model that does not estimate its error.
    """
    n = len(light)
    expected, trusted = np.full(n, np.nan), np.zeros(n, bool)
    for start in range(0, n, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, n))
        progress(start, n, "error of a year")
        prediction = fitted.predict(light[rows], _patches(data, light[rows]))
        expected[rows], trusted[rows] = prediction.expected_mse, trusted_hours(prediction)
    return YearExpectation(float(expected.mean()), float(trusted.mean()), n)


def _patches(data: Dataset, light: Light) -> Floats32 | None:
    """Return the sun patches of the hours of `light`, [n, H, W]; None if `data` has none."""
    if data.patch_cdm2 is None:
        return None
    assert data.setup.room is not None
    return sun_patches(
        data.setup.room,
        light.shown_sun_direction,
        light.direct_lx,
        height=data.shape[0],
        heading_deg=data.heading_deg,
    ).luminance_cdm2
