"""Detect drift of a camera: of k by the sky in the window, of the heading, and of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from scipy.stats import t as student_t

from fieldlum.arrays import Floats, Floats32, Indices
from fieldlum.images import read_panorama
from fieldlum.light import light_at
from fieldlum.projection import equirect_rays, equirect_solid_angles, signed_angle_deg
from fieldlum.records import SiteFile
from fieldlum.session import Session
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import Sidecar, readable_sidecars
from fieldlum.statistics import robust_sigma

# A change over the campaign is reported if it exceeds these limits and is significant. k [%]:
# accuracy of calibrating k by spot readings (docs/accuracy.md). Heading [deg]: the sun's diameter,
# by which a sun patch would then miss its pixels. Residual [%]: three times a merge's usual 0.3 %.
# How often drifting cameras are reported: docs/validation.md, bench/campaign_drift.py.
LIMITS = {"k": 5.0, "heading": 0.5, "residual": 1.0}
UNITS = {"k": "%", "heading": "°", "residual": "%"}
FEWEST = 20  # least number of captures; chosen
FEWEST_DAYS = 3  # a line through the means of two days has no residual
# share of steady cameras that are reported: three standard errors of a normal distribution
SURE = 0.0027
_HUBER = 1.345  # robust scales; 95 % efficient for normal residuals (Huber 1981)
_ITERATIONS = 20  # weights then change by less than 1 %
# share of a pixel's sky that the glass must transmit, so that the pixel counts as window; chosen
WINDOW_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class DriftSeries:
    """One quantity over time: days since the first value [n], values [n], and their change.

    kind: k [%], heading [deg] or residual [%]; change: of a robust line from the first to the last
    value, in the unit of the values; low, high: its 95 % interval; reach: a larger change is
    significant; start: the line at the first day. NaN with fewer than 20 values or values of fewer
    than 3 days.
    """

    kind: str
    days: Floats
    values: Floats
    change: float = np.nan
    low: float = np.nan
    high: float = np.nan
    reach: float = np.nan
    start: float = np.nan

    @property
    def drifts(self) -> bool:
        """Whether the change is significant and over its limit.

        The limits are 5 % (k), 0.5 deg (heading) and 1 % (residual).
        """
        return bool(abs(self.change) > max(LIMITS[self.kind], self.reach))

    @property
    def text(self) -> str:
        """The change with its unit and 95 % interval; else the number of values ("–" for none)."""
        if not np.isfinite(self.change):
            return f"values: {len(self.values)}" if len(self.values) else "–"
        digits = 2 if LIMITS[self.kind] <= 1.0 else 1
        change, low, high = (
            f"{round(value, digits) + 0.0:+.{digits}f}"  # without a negative zero
            for value in (self.change, self.low, self.high)
        )
        return f"{change} {UNITS[self.kind]} ({low} to {high})"


def series(kind: str, t_utc: Sequence[datetime], values: Sequence[float] | Floats) -> DriftSeries:
    """Return a series, in order of time, with the change of a robust line from first to last value.

    kind: "k" [%], "heading" [deg] or "residual" [%]; values: at t_utc, [n], NaN is omitted. The
    captures of one day share its weather. Therefore the interval is computed from the scatter of
    days, and is wide for few days.
    """
    data = np.asarray(values, float)
    times = np.array([t.timestamp() for t in t_utc], float) / 86400.0
    good = np.isfinite(data)
    order = np.argsort(times[good], kind="stable")
    days, data = times[good][order], data[good][order]
    groups = np.unique(np.floor(days), return_inverse=True)[1]
    count = int(groups.max()) + 1 if len(groups) else 0
    days = days - days[0] if len(days) else days
    if len(data) < FEWEST or count < FEWEST_DAYS:
        return DriftSeries(kind, days, data)
    start, slope, error = _robust_line(days, data, groups)
    change, change_error = slope * days[-1], error * days[-1]
    half = float(student_t.ppf(0.975, count - 2)) * change_error
    reach = float(student_t.ppf(1.0 - SURE / 2, count - 2)) * change_error
    return DriftSeries(kind, days, data, change, change - half, change + half, reach, start)


def _robust_line(days: Floats, values: Floats, groups: Indices) -> tuple[float, float, float]:
    """Return start and slope of a line by Huber's weights, and the slope's standard error.

    The error is the sandwich estimate over groups (Liang and Zeger 1986), with its correction for a
    small number of groups.
    """
    a = np.column_stack([np.ones(len(days)), days])  # [n, 2]
    weights, residual = np.ones(len(days)), values
    line, inverse = np.zeros(2), np.zeros((2, 2))
    for _ in range(_ITERATIONS):
        inverse = np.linalg.inv(a.T @ (a * weights[:, None]))  # [2, 2]
        line = inverse @ (a.T @ (values * weights))
        residual = values - a @ line
        scale = _HUBER * robust_sigma(residual)
        weights = scale / np.maximum(np.abs(residual), max(scale, 1e-12))
        if scale == 0:
            weights = np.ones(len(days))
    scores = np.zeros((int(groups.max()) + 1, 2))
    np.add.at(scores, groups, a * (weights * residual)[:, None])
    count = len(scores)
    spread = inverse @ (scores.T @ scores) @ inverse * (count / (count - 2))
    return float(line[0]), float(line[1]), float(np.sqrt(spread[1, 1]))


def drifts_of(session: Session) -> dict[str, DriftSeries]:
    """Return a session's three series, by the names k, heading and residual.

    k: the scale factor of luminance, by the sky in the window [%]; heading: of the camera, by the
    sun [deg]; residual: disagreement of a bracket's frames [%]. A series without data is empty.
    """
    sidecars = readable_sidecars(session.sidecar_files())
    dated = [(note.t_utc, note) for note in sidecars if note.t_utc is not None]
    residuals = [
        (t, note.report.residual_percent)
        for t, note in dated
        if note.report.residual_percent is not None
    ]
    return {
        "k": series("k", *_columns(sky_ratios(session))),
        "heading": series("heading", *_columns(_headings(session, dated))),
        "residual": series("residual", *_columns(residuals)),
    }


def _columns(rows: Sequence[tuple[datetime, float]]) -> tuple[list[datetime], list[float]]:
    return [t for t, _ in rows], [value for _, value in rows]


def _headings(
    session: Session, dated: Sequence[tuple[datetime, Sidecar]]
) -> list[tuple[datetime, float]]:
    """Return (time, azimuth error [deg]) for each picture with a measured sun disc.

    The error is the disc's azimuth, by the stated heading, minus the computed azimuth. If the
    camera turns clockwise by 1 degree, the error falls by 1 degree.
    """
    from fieldlum import sun

    site = session.site_file().site
    rows: list[tuple[datetime, float]] = []
    for t, note in dated:
        centre = note.sun.measured if note.sun else None
        if centre is not None:
            true_deg = float(sun.position([centre.t_utc or t], site).azimuth_deg[0])
            rows.append((t, float(signed_angle_deg(centre.azimuth_deg - true_deg))))
    return rows


def sky_ratios(session: Session) -> list[tuple[datetime, float]]:
    """Return (time, how far the window's sky is above its median luminance [%]) of each capture.

    The list is empty without a room, pairs or glass in view. The value is the ratio of measured to
    expected luminance, divided by the median of this ratio, minus one; NaN if no light is expected.
    The expected luminance is that of the Perez sky for the logged irradiance. It can be wrong by
    tens of percent in one hour and is right on average, so only a change over many hours shows a
    drift of the scale factor k.
    """
    from fieldlum.scene import window_fraction

    setup = session.site_file()
    if setup.room is None or not session.pairs.is_file():
        return []
    rows = [row for row in PairsFile.read(session.pairs).usable if row.panorama]
    ratios: list[tuple[datetime, float]] = []
    share: Floats32 | None = None
    for row in rows:
        luminance_cdm2 = read_panorama(session.root / row.panorama).luminance_cdm2
        height = luminance_cdm2.shape[0]
        if share is None or share.shape[0] != height:
            share = window_fraction(setup.room, setup, height)
        if (share > WINDOW_SHARE).any():
            ratios.append((row.t_utc, _sky_ratio(row, luminance_cdm2, share, setup)))
    middle = np.nanmedian([value for _, value in ratios]) if ratios else np.nan
    return [(t, 100.0 * (value / middle - 1.0)) for t, value in ratios]


def _sky_ratio(row: PairRow, luminance_cdm2: Floats, share: Floats32, setup: SiteFile) -> float:
    """Return the measured over the expected luminance of the window's sky at one capture."""
    height, width = share.shape
    window = share > WINDOW_SHARE
    rays = equirect_rays(height, width, setup.camera.heading_deg)
    light = light_at([row.t_utc], setup.site, np.array([row.dni_wm2]), np.array([row.dhi_wm2]))
    sky = light.sky_at(rays[window])[0] * share[window]
    weight = equirect_solid_angles(height, width)[window]
    expected = float((sky * weight).sum())
    measured = float((np.asarray(luminance_cdm2)[window] * weight).sum())
    return measured / expected if expected > 0 else float("nan")
