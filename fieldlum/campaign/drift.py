"""Detect drift of a camera: of k by the sky in the window, of the heading, and of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.images import read_panorama
from fieldlum.light import light_at
from fieldlum.projection import equirect_rays, equirect_solid_angles, signed_angle_deg
from fieldlum.records import parse_utc
from fieldlum.session import Session
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.statistics import median_standard_error, robust_sigma

# A change over the campaign is reported when it exceeds this and three standard errors.
# k: what calibrating k by spot readings reaches (docs/accuracy.md). Heading: the sun's diameter,
# by which a sun patch would then miss its pixels. Residual: three times a merge's usual 0.3 %.
LIMITS = {"k": 5.0, "heading": 0.5, "residual": 1.0}
UNITS = {"k": "%", "heading": "°", "residual": "%"}
FEWEST = 20  # captures, so that a quarter has five
NORMAL_95 = 1.96  # standard errors of a 95 % interval
SURE_ERRORS = 3.0  # of a reported drift: one false alarm in 370 steady cameras
WINDOW_SHARE = 0.5  # of a pixel's sky that the glass must let through, to count as window


@dataclass(frozen=True, slots=True)
class DriftSeries:
    """One quantity over time: days since the first value, values, and the change.

    change: from the first to the last quarter of the values, with its 95 % interval; NaN with fewer
    than `FEWEST` values.
    """

    kind: str
    days: NDArray[np.float64]
    values: NDArray[np.float64]
    change: float
    low: float
    high: float

    @property
    def drifts(self) -> bool:
        """Whether the change is larger than its limit and its uncertainty."""
        error = (self.high - self.low) / (2 * NORMAL_95)
        return bool(abs(self.change) > max(LIMITS[self.kind], SURE_ERRORS * error))

    @property
    def text(self) -> str:
        """The change with its interval, for a table."""
        if not np.isfinite(self.change):
            return f"{len(self.values)} values" if len(self.values) else "–"
        unit = UNITS[self.kind]
        return f"{self.change:+.1f} {unit} ({self.low:+.1f} to {self.high:+.1f})"


def series(kind: str, t_utc: Sequence[datetime], values: Sequence[float]) -> DriftSeries:
    """Return a quantity with its change between the first and the last quarter of its values.

    Medians of quarters are robust to clouds, and state the change of a drift of any shape.
    """
    data = np.asarray(values, float)
    times = np.array([t.timestamp() for t in t_utc], float) / 86400.0
    good = np.isfinite(data)
    order = np.argsort(times[good], kind="stable")
    days, data = times[good][order], data[good][order]
    days = days - days[0] if len(days) else days
    quarter = len(data) // 4
    if len(data) < FEWEST or days[-1] < 1.0:
        return DriftSeries(kind, days, data, np.nan, np.nan, np.nan)
    ends = data[:quarter], data[-quarter:]
    change = float(np.median(ends[1]) - np.median(ends[0]))
    errors = [median_standard_error(robust_sigma(end), quarter) for end in ends]
    reach = NORMAL_95 * float(np.hypot(errors[0], errors[1]))
    return DriftSeries(kind, days, data, change, change - reach, change + reach)


def drifts_of(session: Session) -> dict[str, DriftSeries]:
    """Return the series k, heading and residual of a session; those without data are empty."""
    sidecars = [note for path in session.sidecar_files() if (note := _sidecar(path)) is not None]
    dated = [(note.t_utc, note) for note in sidecars if note.t_utc is not None]
    residuals = [(t, _number(note.report.residual_percent)) for t, note in dated]
    return {
        "k": series("k", *_columns(_sky_ratios(session))),
        "heading": series("heading", *_columns(_headings(session, dated))),
        "residual": series("residual", *_columns(residuals)),
    }


def _sidecar(path: Path) -> Sidecar | None:
    try:
        return Sidecar.read(path)
    except InputError:
        return None


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _columns(rows: Sequence[tuple[datetime, float]]) -> tuple[list[datetime], list[float]]:
    return [t for t, _ in rows], [value for _, value in rows]


def _headings(
    session: Session, dated: Sequence[tuple[datetime, Sidecar]]
) -> list[tuple[datetime, float]]:
    """Return the azimuth of the sun's disc in the pictures minus its true azimuth [deg]."""
    from fieldlum import sun

    site = session.site_file().site
    rows: list[tuple[datetime, float]] = []
    for t, note in dated:
        centre = (note.sun or {}).get("measured") or {}
        if "azimuth_deg" in centre:
            at = parse_utc(centre["t_utc"]) if centre.get("t_utc") else t
            true_deg = float(sun.position([at], site).azimuth_deg[0])
            offset_deg = signed_angle_deg(float(centre["azimuth_deg"]) - true_deg)
            rows.append((t, float(offset_deg)))
    return rows


def _sky_ratios(session: Session) -> list[tuple[datetime, float]]:
    """Return measured over expected luminance of the sky in the window, in percent of its median.

    Expected is the Perez sky of the logged irradiance. It is wrong by tens of percent in one hour
    and right on average, so only its change over many hours shows a drift of k.
    """
    from fieldlum.scene import window_fraction

    setup = session.site_file()
    if setup.room is None or not session.pairs.is_file():
        return []
    rows = [row for row in PairsFile.read(session.pairs).usable if row.panorama]
    ratios: list[tuple[datetime, float]] = []
    share: NDArray[np.float32] | None = None
    for row in rows:
        picture = read_panorama(session.root / row.panorama)
        height = picture.luminance_cdm2.shape[0]
        if share is None or share.shape[0] != height:
            share = window_fraction(setup.room, setup, height)
        if (share > WINDOW_SHARE).any():
            ratios.append((row.t_utc, _sky_ratio(row, picture.luminance_cdm2, share, session)))
    middle = np.nanmedian([value for _, value in ratios]) if ratios else np.nan
    return [(t, 100.0 * (value / middle - 1.0)) for t, value in ratios]


def _sky_ratio(
    row: PairRow, luminance_cdm2: NDArray[np.floating], share: NDArray[np.float32], session: Session
) -> float:
    setup = session.site_file()
    height, width = share.shape
    window = share > WINDOW_SHARE
    rays = equirect_rays(height, width, setup.camera.heading_deg)
    light = light_at([row.t_utc], setup.site, np.array([row.dni_wm2]), np.array([row.dhi_wm2]))
    sky = light.sky_at(rays[window])[0] * share[window]
    weight = equirect_solid_angles(height, width)[window]
    expected = float((sky * weight).sum())
    measured = float((np.asarray(luminance_cdm2)[window] * weight).sum())
    return measured / expected if expected > 0 else float("nan")
