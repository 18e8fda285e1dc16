"""Vertical illuminance, DGP, DGPs, UGR and DGI for every direction around a panorama, at once.

Vertical illuminance of all hours and directions is one matrix product with exact solid angles;
glare sources are grouped once an hour (see `sources`) and summed for all directions by small
products. The sun is never a pixel: it is a source of its own with its direction, its normal
illuminance at the lens and its solid angle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.glare.geometry import Views, angles_from_view, panorama_views, position_index
from fieldlum.glare.sources import sources_of
from fieldlum.records import Float
from fieldlum.sun import SUN_SOLID_ANGLE_SR

METRICS = ("ev_lx", "dgp", "dgps", "ugr", "dgi")  # beside them contrast, sun_contrast, sun_ev_lx

# Wienold and Christoffersen 2006 print 5.87e-5, 9.18e-2 and 0.16; evalglare computes with these,
# and so do we.
DGP_EV, DGP_CONTRAST, DGP_BASE = 5.87e-5, 0.092, 0.159


def dgp(ev_lx: ArrayLike, contrast: ArrayLike) -> NDArray[np.float64]:
    """Daylight glare probability from vertical illuminance and the sum of L2 omega / P2 over
    sources; at most 1.

    No low-light correction (evalglare's default since 2.14).
    """
    ev = np.maximum(np.asarray(ev_lx, float), 1e-6)
    glare = np.log10(1.0 + np.asarray(contrast, float) / ev**1.87)
    return np.minimum(DGP_EV * ev + DGP_CONTRAST * glare + DGP_BASE, 1.0)


def dgps(ev_lx: ArrayLike) -> NDArray[np.float64]:
    """Simplified DGP, 6.22e-5 Ev + 0.184 (Wienold 2007); at most 1. Not for hours with the sun
    in view.
    """
    return np.minimum(6.22e-5 * np.asarray(ev_lx, float) + 0.184, 1.0)


def ugr(contrast: ArrayLike, background_cdm2: ArrayLike) -> NDArray[np.float64]:
    """8 log10(0.25 / Lb sum L2 omega / P2) (CIE 117); NaN where nothing is a source."""
    total = np.asarray(contrast, float)
    ratio = 0.25 * total / np.maximum(background_cdm2, 1e-6)
    return np.where(total > 0, 8.0 * np.log10(np.maximum(ratio, 1e-30)), np.nan)


def dgi(source_sum: ArrayLike) -> NDArray[np.float64]:
    """10 log10 of the sum over sources (Hopkinson 1972, with P for the window's place); NaN
    without a source.
    """
    total = np.asarray(source_sum, float)
    return np.where(total > 0, 10.0 * np.log10(np.maximum(total, 1e-30)), np.nan)


def glare_directions(
    luminance_cdm2: Float,
    heading_deg: float,
    azimuths_deg: ArrayLike,
    sun_direction: Float | None = None,
    disc_lx: Float | None = None,
    *,
    views: Views | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Glare of n panoramas in d horizontal view directions, each [n, d]: `METRICS`, and the parts
    that DGP is made of: contrast, the sum of L2 omega / P2 over sources; sun_contrast and
    sun_ev_lx, what the disc gives to it and to Ev.

    luminance_cdm2 : [n, H, W] without the sun's disc.
    sun_direction : [n, 3] unit vectors (x east, y north, z up).
    disc_lx : [n] normal illuminance at the lens from the visible disc; 0 where it is hidden. [lx]
    views : weights from `panorama_views`, to be made once by callers that stream.
    """
    maps = np.asarray(luminance_cdm2, np.float32)
    count, height, width = maps.shape
    views = views or panorama_views(height, width, heading_deg, azimuths_deg)
    flat = maps.reshape(count, -1)
    disc = np.zeros(count) if disc_lx is None else np.asarray(disc_lx, float)
    sun = np.zeros((count, 3)) if sun_direction is None else np.asarray(sun_direction, float)
    right, up, cosine = _sun_angles(sun, views)
    map_ev = (flat @ views.illuminance).astype(float)
    sums = np.stack([_source_sums(flat[i], maps[i], views, map_ev[i]) for i in range(count)])
    sun_cdm2 = disc[:, None] * (cosine > 0) / SUN_SOLID_ANGLE_SR
    return _combine(
        map_ev,
        disc[:, None] * np.clip(cosine, 0.0, None),
        sums,
        sun_cdm2,
        position_index(right, up),
    )


def sun_per_lx(
    sun_direction: Float, views: Views
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a disc of 1 lx adds to Ev, and a disc of 1 lx squared to the contrast, [n, d].

    A disc of E lx adds E times the first and E squared times the second; see `glare_directions`.
    """
    right, up, cosine = _sun_angles(np.asarray(sun_direction, float), views)
    ahead = cosine > 0
    contrast = ahead / (SUN_SOLID_ANGLE_SR * position_index(right, up) ** 2)
    return np.clip(cosine, 0.0, None).astype(float), contrast.astype(float)


def dgp_with_disc(
    found: dict[str, NDArray[np.float64]], per_lx: tuple[Float, Float], disc_lx: Float
) -> NDArray[np.float64]:
    """Return DGP with another disc than the one in `found`, [..., n, d].

    found : of `glare_directions`; per_lx : of `sun_per_lx`; disc_lx : [..., n].
    """
    disc = np.asarray(disc_lx, float)[..., None]
    ev = found["ev_lx"] - found["sun_ev_lx"] + disc * per_lx[0]
    contrast = np.maximum(found["contrast"] - found["sun_contrast"], 0.0) + disc**2 * per_lx[1]
    return dgp(ev, contrast)


def _sun_angles(sun: Float, views: Views) -> tuple[Float, Float, Float]:
    """(right, up, cosine) of n suns in d views, each [n, d]."""
    found = [angles_from_view(sun, frame) for frame in views.frames]
    return tuple(np.stack([part[k] for part in found], axis=1) for k in range(3))  # type: ignore[return-value]


def _source_sums(flat: Float, image: Float, views: Views, ev: Float) -> NDArray[np.float64]:
    """Over the map's sources, for d views: sum L2 omega / P2, illuminance of sources, sum for
    DGI, [3, d].
    """
    groups = sources_of(image)
    out = np.zeros((3, len(views.azimuths_deg)))
    if not groups:
        return out
    means, omegas, indices = [], [], []
    for pixels in groups:
        weights = views.moments[pixels]
        bright = flat[pixels]
        omega = weights[:, 0].sum(axis=0, dtype=float)
        power, right, up = np.tensordot(bright, weights, axes=1).astype(float)
        seen = np.maximum(power, 1e-30)
        means.append(power / np.maximum(omega, 1e-30))
        omegas.append(omega)
        indices.append(position_index(right / seen, up / seen))
        out[1] += bright @ views.illuminance[pixels]
    mean, omega, index = np.stack(means), np.stack(omegas), np.stack(indices)
    background = np.maximum(ev - out[1], 0.0) / np.pi
    out[0] = (mean**2 * omega / index**2).sum(axis=0)
    out[2] = _dgi_terms(mean, omega, index, background).sum(axis=0)
    return out


def _dgi_terms(mean: Float, omega: Float, index: Float, background: Float) -> Float:
    """0.478 L^1.6 (omega / P2)^0.8 / (Lb + 0.07 omega^0.5 L)."""
    share = np.maximum(background + 0.07 * np.sqrt(omega) * mean, 1e-12)
    return 0.478 * mean**1.6 * (omega / index**2) ** 0.8 / share


def _combine(
    map_ev: Float, sun_ev: Float, sums: Float, sun_cdm2: Float, sun_index: Float
) -> dict[str, NDArray[np.float64]]:
    """Put the sun to the other sources; sums: [n, 3, d], all others [n, d]."""
    ev = map_ev + sun_ev
    omega = np.asarray(SUN_SOLID_ANGLE_SR)
    sun_contrast = sun_cdm2**2 * omega / sun_index**2
    contrast = sums[:, 0] + sun_contrast
    background = (
        np.maximum(map_ev - sums[:, 1], 0.0) / np.pi
    )  # CIE: what is left of Ev without the sources
    return {
        "ev_lx": ev,
        "contrast": contrast,
        "sun_contrast": sun_contrast,
        "sun_ev_lx": np.asarray(sun_ev, float),
        "dgp": dgp(ev, contrast),
        "dgps": dgps(ev),
        "ugr": ugr(contrast, background),
        "dgi": dgi(sums[:, 2] + _dgi_terms(sun_cdm2, omega, sun_index, background)),
    }
