"""Compute glare metrics, contrast and bounds of DGP for all directions around a panorama.

Vertical illuminance of all hours and directions is one matrix product with exact solid angles.
Glare sources are grouped once for each hour (see `sources`) and summed for all directions by small
products. The sun must not be in the pixels: it is a separate source with a direction, a normal
illuminance at the lens and a solid angle.

RAMMG is the mean local contrast over the levels of a picture pyramid (Rizzi, Algeri, Medeghini and
Marini 2004). In cd/m2 it follows the code of Liu, Colburn and Inanici 2020: five levels, halved by
OpenCV's bilinear resize; eight neighbours weighted 1 and 1/sqrt(2) over 4 + 2 sqrt(2); border
pixels count as no contrast; no solid angles; no wrap at the seam.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Floats32, Mask
from fieldlum.optics.projection import NOT_SEEN, seen_words
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import BRIGHTEST_SURFACE_CDM2
from fieldlum.year.glare.sources import (
    SOURCE_CDM2,
    Sources,
    Views,
    angles_from_view,
    glare_sources,
    position_index,
)

# A sun disc or its mirror image: what 1 lx of it adds (the result of `sun_per_lx`), and its
# illuminance [..., n] in lx on a plane normal to it.
DiscLight = tuple[tuple[Floats, Floats], Floats]

_BLOCK = 1 << 16  # pixels whose light is summed in single precision: errors below 1e-5; chosen
# Wienold and Christoffersen 2006 print 5.87e-5, 9.18e-2 and 0.16. evalglare computes with the
# digits here, and so does fieldlum, so that both agree.
DGP_EV = 5.87e-5
DGP_CONTRAST = 0.092
DGP_BASE = 0.159


def dgp(ev_lx: ArrayLike, contrast: ArrayLike) -> Floats:
    """Return daylight glare probability, [...], at most 1 (Wienold and Christoffersen 2006).

    ev_lx : [...] vertical illuminance at the eye; contrast : [...] the sum of L^2 omega / P^2 over
    glare sources, with L luminance [cd/m2], omega solid angle [sr] and P position index. There is
    no low-light correction: without light the result is 0.159.
    """
    ev = np.maximum(np.asarray(ev_lx, float), 1e-6)
    glare = np.log10(1.0 + np.asarray(contrast, float) / ev**1.87)
    return np.minimum(DGP_EV * ev + DGP_CONTRAST * glare + DGP_BASE, 1.0)


def dgps(ev_lx: ArrayLike) -> Floats:
    """Return simplified DGP, 6.22e-5 Ev + 0.184, at most 1, [...] (Wienold 2007).

    ev_lx : vertical illuminance Ev at the eye. The formula is not valid for hours with the sun in
    view.
    """
    return np.minimum(6.22e-5 * np.asarray(ev_lx, float) + 0.184, 1.0)


def ugr(contrast: ArrayLike, background_cdm2: ArrayLike) -> Floats:
    """Return the unified glare rating UGR, 8 log10(0.25 / Lb sum L^2 omega / P^2), [...].

    contrast : [...] the sum of L^2 omega / P^2 over sources as in `dgp`, 0 without a source, for
    which the result is NaN; background_cdm2 : [...] the background luminance Lb. Source: CIE
    117:1995.
    """
    ratio = 0.25 * np.asarray(contrast, float) / np.maximum(background_cdm2, 1e-6)
    return _scaled_log10(8.0, ratio)


def _scaled_log10(factor: float, ratio: Floats) -> Floats:
    """Return factor * log10(ratio), [...]; NaN for a ratio of 0, which means no glare source."""
    return np.where(ratio > 0, factor * np.log10(np.maximum(ratio, 1e-30)), np.nan)


def dgi(source_sum: ArrayLike) -> Floats:
    """Return the daylight glare index DGI, 10 log10 of `source_sum`, [...]; NaN without a source.

    source_sum : [...] Hopkinson's terms summed over sources, the second row of `source_terms`; 0
    without a source. The formula is that of Hopkinson 1972, with the position index P for windows.
    """
    return _scaled_log10(10.0, np.asarray(source_sum, float))


def ugp(contrast: ArrayLike, background_cdm2: ArrayLike) -> Floats:
    """Return the unified glare probability UGP, 0.26 log10(0.25 / Lb sum L^2 omega / P^2), [...].

    contrast : [...] the sum of L^2 omega / P^2 over sources as in `dgp`, 0 without a source, for
    which the result is NaN; background_cdm2 : [...] the background luminance Lb. Source: Hirning,
    Isoardi and Cowling 2014.
    """
    return np.asarray(ugr(contrast, background_cdm2)) * (0.26 / 8.0)


def cgi(contrast: ArrayLike, ev_lx: ArrayLike, source_ev_lx: ArrayLike) -> Floats:
    """Return the CIE glare index, 8 log10(2 (1 + Ed / 500) / Ev sum L^2 omega / P^2), [...].

    contrast : [...] the sum of L^2 omega / P^2 over sources as in `dgp`, 0 without a source, for
    which the result is NaN; ev_lx : [...] Ev, vertical illuminance of the complete view;
    source_ev_lx : [...] Ed, the part of Ev from the sources. Source: Einhorn 1979.
    """
    total = np.asarray(contrast, float)
    ratio = 2.0 * (1.0 + np.asarray(source_ev_lx, float) / 500.0) / np.maximum(ev_lx, 1e-6) * total
    return _scaled_log10(8.0, ratio)


def veiling_cdm2(veiling_sum: ArrayLike, age_years: float) -> Floats:
    """Return the veiling luminance 10 (1 + (age / 70)^4) sum E / angle^2, in cd/m2, [...].

    veiling_sum : [...] sum over sources of their vertical illuminance E [lx] over the square of
    their angle from the line of sight [deg], of at least 1 degree. age_years : age of the observer.
    This is the age-adjusted Stiles-Holladay formula (CIE 146:2002).
    """
    return 10.0 * (1.0 + (age_years / 70.0) ** 4) * np.asarray(veiling_sum, float)


# ----------------------------------------------------------------------------------------------
# the registry


class ViewSums(NamedTuple):
    """The light of n maps in d view directions from which every metric is computed, [n, d] each.

    All sums include the sun and its images in mirrors. ev_lx : vertical illuminance; source_ev_lx :
    its part from glare sources; background_cdm2 : the rest of the map over pi. contrast : sum of
    L^2 omega / P^2 over sources; dgi_sum, veiling_sum : second and third row of `source_terms`.
    """

    ev_lx: Floats
    source_ev_lx: Floats
    background_cdm2: Floats
    contrast: Floats
    dgi_sum: Floats
    veiling_sum: Floats


class Metric(NamedTuple):
    """A glare metric.

    formula : computes the metric's values [n, d] from the sums of n maps in d view directions;
    in_year : whether hourly.csv of a predicted year has the metric as a column.
    """

    formula: Callable[[ViewSums], Floats]
    in_year: bool = False


METRICS: dict[str, Metric] = {  # True: also a column of hourly.csv
    "ev_lx": Metric(lambda view: view.ev_lx, True),
    "dgp": Metric(lambda view: dgp(view.ev_lx, view.contrast), True),
    "dgps": Metric(lambda view: dgps(view.ev_lx), True),
    "ugr": Metric(lambda view: ugr(view.contrast, view.background_cdm2), True),
    "dgi": Metric(lambda view: dgi(view.dgi_sum), True),
    "ugp": Metric(lambda view: ugp(view.contrast, view.background_cdm2)),
    "cgi": Metric(lambda view: cgi(view.contrast, view.ev_lx, view.source_ev_lx)),
    # for observers of 25 years and of 70 years, for whom CIE 146 doubles the veiling luminance
    "veiling_cdm2": Metric(lambda view: veiling_cdm2(view.veiling_sum, age_years=25.0)),
    "veiling_age70_cdm2": Metric(lambda view: veiling_cdm2(view.veiling_sum, age_years=70.0)),
}
"""All metrics by their name in `glare --json`, `glare --csv` and Python (CONTRIBUTING.md)."""


def glare_directions(
    luminance_cdm2: Floats,
    views: Views,
    sun_direction: Floats | None = None,
    disc_lx: Floats | None = None,
    *,
    sources: Sequence[Sources] | None = None,
) -> dict[str, Floats]:
    """Return the glare of n maps in d view directions by name, [n, d] each.

    luminance_cdm2 : [n, H, W] without the sun's disc; views : weights of their pixels.
    sun_direction : [n, 3] unit vectors to the sun (x east, y north, z up), or [m, n, 3] to the sun
    and m - 1 images of it in mirrors; None without a sun. disc_lx : [n] or [m, n] illuminance from
    each, at the lens, on a plane normal to it; 0 where it is hidden; None without a sun. sources :
    result of `glare_sources` for each map, None to compute it.

    Keys: those of `METRICS`, and the parts of DGP: contrast is the sum of L^2 omega / P^2 over
    sources; sun_contrast and sun_ev_lx are the parts of sun and images in contrast and Ev. ugr,
    dgi, ugp and cgi are NaN without a source.
    """
    maps = np.asarray(luminance_cdm2, np.float32)
    map_ev = map_ev_lx(maps, views)
    by_map = sources or [glare_sources(image, views) for image in maps]
    source_ev, background, source_sums = _sums_of_sources(by_map, map_ev)
    sun = np.zeros((len(maps), 3)) if sun_direction is None else sun_direction
    disc = np.zeros((len(maps), 1)) if disc_lx is None else np.asarray(disc_lx, float)[..., None]
    right, up, cosine = _sun_angles(sun, views)  # [n, d], or [m, n, d]
    ev, cdm2 = disc * np.clip(cosine, 0.0, None), disc * (cosine > 0) / SUN_SOLID_ANGLE_SR
    terms = source_terms(cdm2, np.asarray(SUN_SOLID_ANGLE_SR), right, up, ev, background)
    # of the sun and its images: Ev [n, d] lx, and the sums of their terms [3, n, d]
    sun_ev = ev.reshape(-1, *background.shape).sum(axis=0)
    sun_sums = terms.reshape(len(terms), -1, *background.shape).sum(axis=1)
    sums = source_sums + sun_sums  # [3, n, d]
    view = ViewSums(map_ev + sun_ev, source_ev + sun_ev, background, *sums)
    parts = {"contrast": view.contrast, "sun_contrast": sun_sums[0], "sun_ev_lx": sun_ev}
    return parts | {name: metric.formula(view) for name, metric in METRICS.items()}


def _sums_of_sources(by_map: Sequence[Sources], map_ev: Floats) -> tuple[Floats, Floats, Floats]:
    """Return Ev of the glare sources [n, d] lx, the background luminance [n, d], and sums of terms.

    by_map : the sources of each of n maps; map_ev : Ev of the complete maps in d view directions
    [n, d] lx. The sums [3, n, d] are those of the rows of `source_terms` over the sources of a map.
    """
    # number of the map of each source, and all maps' sources one after another, [s, d] each
    hour = np.repeat(np.arange(len(by_map)), [len(one_map.pixels) for one_map in by_map])
    columns = zip(*(one_map[:5] for one_map in by_map), strict=True)
    mean, omega, right, up, ev = map(np.concatenate, columns)
    source_ev = np.zeros_like(map_ev)
    np.add.at(source_ev, hour, ev)
    # CIE 117: the background is the part of Ev that is not from the sources.
    background = np.maximum(map_ev - source_ev, 0.0) / np.pi
    terms = source_terms(mean, omega, right, up, ev, background[hour])
    sums = np.zeros((len(by_map), len(terms), map_ev.shape[1]))
    np.add.at(sums, hour, terms.swapaxes(0, 1))
    return source_ev, background, sums.swapaxes(0, 1)


def source_terms(
    mean_cdm2: Floats, omega: Floats, right: Floats, up: Floats, ev_lx: Floats, background: Floats
) -> Floats:
    """Return the three terms of each glare source that metrics sum over sources, [3, ...].

    A sun is a source too. mean_cdm2 : mean luminance; omega : solid angle, sr; right, up :
    coordinates by `angles_from_view` [rad]; ev_lx : vertical illuminance by the source; background
    : luminance around the source [cd/m2], Lb; all [...]. Rows: L^2 omega / P^2 (`contrast`);
    Hopkinson's term 0.478 L^1.6 (omega / P^2)^0.8 / (Lb + 0.07 omega^0.5 L) for `dgi`; illuminance
    over the squared angle from the line of sight [lx/deg2] for `veiling_cdm2`.
    """
    index = position_index(right, up)
    adaptation_cdm2 = np.maximum(background + 0.07 * np.sqrt(omega) * mean_cdm2, 1e-12)
    dgi_term = 0.478 * mean_cdm2**1.6 * (omega / index**2) ** 0.8 / adaptation_cdm2
    # at least 1 degree: Stiles-Holladay is valid from 1 to 30 degrees
    angle_deg = np.degrees(np.maximum(np.hypot(right, up), np.radians(1.0)))
    return np.stack([mean_cdm2**2 * omega / index**2, dgi_term, ev_lx / angle_deg**2])


def map_ev_lx(luminance_cdm2: Floats, views: Views) -> Floats:
    """Return the vertical illuminance by n maps in d view directions, [n, d] in lx.

    luminance_cdm2 : [n, H, W] the maps; views : weights of their pixels. The sums of blocks of
    pixels are added in double precision.
    """
    flat = luminance_cdm2.reshape(len(luminance_cdm2), -1)
    starts = range(0, flat.shape[1], _BLOCK)
    parts = [flat[:, k : k + _BLOCK] @ views.illuminance[k : k + _BLOCK] for k in starts]
    return np.sum(parts, axis=0, dtype=float)


def sun_per_lx(sun_direction: Floats, views: Views) -> tuple[Floats, Floats]:
    """Return what a sun disc of 1 lx adds to Ev and to the contrast of DGP, [..., d] each.

    The 1 lx is on a plane normal to the sun. sun_direction : [..., 3] unit vectors to the sun (x
    east, y north, z up); views : the d view directions. Both are 0 for a sun behind the observer. A
    disc of E lx adds E times the first to Ev [lx], and E squared times the second to `contrast`
    (see `glare_directions`).
    """
    right, up, cosine = _sun_angles(sun_direction, views)
    contrast = (cosine > 0) / (SUN_SOLID_ANGLE_SR * position_index(right, up) ** 2)
    return np.clip(cosine, 0.0, None), contrast


def with_disc(parts: dict[str, Floats], *discs: DiscLight) -> tuple[Floats, Floats]:
    """Return Ev [lx] and contrast of n maps in d view directions with other suns, [..., n, d] each.

    parts : result of `glare_directions`; its sun and images of the sun are removed first. discs :
    for the sun and for each image of it, the result of `sun_per_lx` and a new illuminance [..., n]
    in lx, on a plane normal to it.
    """
    ev = parts["ev_lx"] - parts["sun_ev_lx"]
    contrast = np.maximum(parts["contrast"] - parts["sun_contrast"], 0.0)
    for (ev_per_lx, contrast_per_lx2), source_lx in discs:
        source = np.asarray(source_lx, float)[..., None]
        ev, contrast = ev + source * ev_per_lx, contrast + source**2 * contrast_per_lx2
    return ev, contrast


def _sun_angles(sun: Floats, views: Views) -> tuple[Floats, Floats, Floats]:
    """Return the coordinates right, up [rad] and the cosine of suns in d views, [..., d] each.

    sun : unit vectors [..., 3]. The coordinates and the cosine are those of `angles_from_view`.
    """
    by_view = [angles_from_view(np.asarray(sun, float), frame) for frame in views.frames]
    right, up, cosine = (np.stack(parts, axis=-1) for parts in zip(*by_view, strict=True))
    return right, up, cosine


# ----------------------------------------------------------------------------------------------
# The parts of a view that no lens saw are not dark. They are assumed to have one luminance, from 0
# to the brightest that is likely, which gives the minimum and maximum DGP. More light on the eye
# can lower DGP (the contrast term falls with Ev), so that the minimum is not always at 0 cd/m2.


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCoverage:
    """How much of each of d view directions the lenses saw.

    seen_share [d] : share (0 to 1) of the vertical illuminance of a uniform field that comes from
    seen pixels. unseen_illuminance [d] : integral of the cosine over the unseen part, sr; times the
    part's luminance it is what the part adds to Ev. unseen_sources [d] : integral of 1 over the
    squared position index, sr; times the squared luminance it is what the part adds to `contrast`.
    unseen_illuminance and unseen_sources are 0 for a complete direction. words [d] : "seen" (a
    share of 0.98 or more), "partly seen" (0.5 or more) or "not seen".
    """

    seen_share: Floats
    unseen_illuminance: Floats
    unseen_sources: Floats
    words: tuple[str, ...]

    @property
    def judged(self) -> Mask:
        """Mask [d], True for directions that are seen or partly seen and therefore have figures."""
        return np.array(self.words) != NOT_SEEN


def view_coverage(views: Views) -> ViewCoverage:
    """Return how much of each view direction the pixels with a weight in `views` cover.

    The unseen part is the rest of the hemisphere in front. The unseen part can be one large glare
    source, with the position index of its centre, or many: `unseen_sources` is the larger of both.
    """
    # [5, d] sums: illuminance, solid angle, moments right and up, solid angle / position index^2
    seen = np.zeros_like(views.hemisphere)
    seen[0] = views.illuminance.sum(axis=0, dtype=float)
    share = np.minimum(seen[0] / views.hemisphere[0], 1.0)
    # a picture's weights are exact to 0.1 % (`picture_views`)
    incomplete = share < 0.999
    for first in range(0, len(views.moments) if incomplete.any() else 0, _BLOCK):
        rows = slice(first, first + _BLOCK)
        part = views.moments[rows].astype(float)  # [n, 3, d]
        area = np.maximum(part[:, 0], 1e-30)
        index = position_index(part[:, 1] / area, part[:, 2] / area)
        seen[1:4] += part.sum(axis=0)
        seen[4] += (part[:, 0] / index**2).sum(axis=0)
    unseen = (views.hemisphere - seen) * incomplete
    illuminance, area, right_moment, up_moment, many_sources = unseen
    area = np.maximum(area, 1e-30)
    # the centre is at most 90 degrees from the line of sight
    off = np.maximum(np.hypot(right_moment, up_moment), 1e-30)
    shrink = np.minimum(1.0 / area, 0.5 * np.pi / off)
    one_source = area / position_index(right_moment * shrink, up_moment * shrink) ** 2
    return ViewCoverage(
        seen_share=share,
        unseen_illuminance=illuminance,
        unseen_sources=np.maximum(many_sources, one_source),
        words=seen_words(share),
    )


def brightest_cdm2(luminance_cdm2: Floats, views: Views) -> Floats:
    """Return the luminance that 1 % of the seen solid angle exceeds, [n] in cd/m2.

    luminance_cdm2 : [n, H, W] of n maps; views : weights of their pixels. 0 if nothing was seen.
    """
    # About 20 000 pixels are enough. The step is odd: an even one could hit the same columns only.
    step = luminance_cdm2[0].size // 20_000 | 1
    weights = views.moments[::step, 0].max(axis=1)
    flat = luminance_cdm2.reshape(len(luminance_cdm2), -1)[:, ::step]
    if not weights.any():
        return np.zeros(len(flat))
    # a window pane is larger than a hundredth, a bright pixel of a reflection smaller; chosen
    return np.quantile(flat.astype(float), 0.99, 1, weights=weights, method="inverted_cdf")


def unseen_dgp_bounds(
    coverage: ViewCoverage, ev_lx: Floats, contrast: Floats, max_cdm2: Floats
) -> tuple[Floats, Floats]:
    """Return the minimum and maximum DGP over possible luminances of the unseen part, [n, d] each.

    coverage : of the d view directions. ev_lx, contrast : [n, d] vertical illuminance, and sum of
    L^2 omega / P^2 over sources, of the seen part in n maps; max_cdm2 : [n] the brightest likely
    luminance of the unseen part, of which at least 1 is used. The unseen part has one luminance: 0
    and 12 values from 1 cd/m2 to the brightest are tried. If nothing is unseen, both results are
    the DGP of the seen part.
    """
    values = [dgp(ev_lx, contrast)]
    for share in np.linspace(0.0, 1.0, 12) if coverage.unseen_illuminance.any() else ():
        level = np.maximum(max_cdm2, 1.0)[:, None] ** share  # [n, 1], 1 cd/m2 up to the brightest
        power = np.where(level > SOURCE_CDM2, level, 0.0) ** 2
        of_sources = contrast + power * coverage.unseen_sources
        values.append(dgp(ev_lx + level * coverage.unseen_illuminance, of_sources))
    return np.min(values, axis=0), np.max(values, axis=0)


# ----------------------------------------------------------------------------------------------
# contrast

RAMMG_LEVELS = 5  # as the authors' code (Liu, Colburn and Inanici 2020)
# The task is a cone around a desk in front of an observer who looks horizontally. Chosen.
TASK_ALTITUDE_DEG = -30.0
TASK_RADIUS_DEG = 15.0
BAND_DEG = 20.0  # the 40-degree horizontal band of Van Den Wymelenberg and Inanici 2014


def local_contrast(image: Floats) -> Floats:
    """Return the weighted mean absolute difference of each pixel to its eight neighbours, [H, W].

    image : [H, W] in any unit, which the result has too. Diagonal neighbours have the weight 1 /
    sqrt(2), the others 1 (code of Liu, Colburn and Inanici 2020). The result is 0 on the border.
    """
    values = np.asarray(image, np.float64)
    out = np.zeros_like(values)
    for shift in product((-1, 0, 1), repeat=2):  # rows down, columns to the right
        distance_px = max(float(np.linalg.norm(shift)), 1.0)
        out += np.abs(values - np.roll(values, shift, (0, 1))) / distance_px
    out[[0, -1]] = out[:, [0, -1]] = 0.0
    return out / (4.0 + 2.0 * np.sqrt(2.0))


def rammg(luminance_cdm2: Floats) -> float:
    """Return RAMMG [cd/m2] of a map [H, W] in cd/m2: the mean contrast of five pyramid levels.

    The contrast of a level is the mean of its `local_contrast`. The first level is the map; each
    further one has half the rows and columns of the level before. Remove a sun disc from the map
    first, because it dominates the result. Source: Rizzi et al. 2004, as in the code of Liu,
    Colburn and Inanici 2020.
    """
    import cv2

    level, means = np.asarray(luminance_cdm2, np.float64), []
    for _ in range(RAMMG_LEVELS):
        means.append(local_contrast(level).mean())
        half = [max(1, size // 2) for size in reversed(level.shape)]
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_LINEAR), np.float64)
    return float(np.mean(means))


def region_weights(views: Views) -> tuple[Floats32, Floats32, Floats32]:
    """Return the solid angles of P pixels in three regions of d views: hemisphere, task cone, band.

    The result is for `region_ratios`, [P, d] sr each. Task cone: 15 degrees around 30 degrees below
    the line of sight (chosen); band: 20 degrees above and below the horizon (Van Den Wymelenberg
    and Inanici 2014). Task cone or band is NaN in a direction in which lenses saw less than 90 % of
    it.
    """
    rays, omega = views.rays()
    _, up, forward = np.moveaxis(rays, 1, 0)
    # without pixels on the edge of a fisheye, which are often half black
    half = omega * views.ahead
    below, radius, reach = np.radians((TASK_ALTITUDE_DEG, TASK_RADIUS_DEG, BAND_DEG))
    task = half * (up * np.sin(below) + forward * np.cos(below) > np.cos(radius))
    band = half * (np.abs(up) < np.sin(reach))
    for part, complete_sr in ((task, 1 - np.cos(radius)), (band, np.sin(reach))):
        # 58 rows of pixels give the cone to 5 %.
        part[:, part.sum(axis=0) < 0.9 * 2 * np.pi * complete_sr] = np.nan
    return half, task, band


def region_ratios(
    luminance_cdm2: Floats, weights: tuple[Floats32, Floats32, Floats32]
) -> dict[str, Floats]:
    """Return task luminance, window over task luminance and uniformity, by name, [n, d] each.

    They are of n maps in d view directions. luminance_cdm2 : [n, H, W]; weights : the result of
    `region_weights`. Keys: task_cdm2 : mean luminance of the task cone of 15 degrees radius, which
    is 30 degrees below the line of sight. window_to_task : mean luminance of the pixels above 2000
    cd/m2 in the front hemisphere, over task_cdm2; NaN without such pixels. uniformity : harmonic
    over arithmetic mean luminance of the band within 20 degrees of the horizon: 1 if the band is
    uniform, less with dark corners. More than `BRIGHTEST_SURFACE_CDM2` is the sun's disc and counts
    as this luminance. Figures are of the seen pixels; NaN if these are less than 90 %
    of the figure's task cone or band.
    """
    half, task, band = weights
    flat = np.asarray(luminance_cdm2, np.float32).reshape(len(luminance_cdm2), -1)
    flat = np.minimum(flat, np.float32(BRIGHTEST_SURFACE_CDM2))  # a sun's disc in a fisheye
    bright = flat > SOURCE_CDM2
    with np.errstate(divide="ignore", invalid="ignore"):  # regions outside the picture
        mean = flat @ task / task.sum(axis=0)
        window = (flat * bright) @ half / (bright.astype(np.float32) @ half)
        inverse = (1.0 / np.maximum(flat, 0.1)) @ band
        figures = {
            "task_cdm2": mean,
            "window_to_task": window / np.maximum(mean, 1e-6),
            "uniformity": band.sum(axis=0) ** 2 / (inverse * (flat @ band)),
        }
    return {name: values.astype(float) for name, values in figures.items()}
