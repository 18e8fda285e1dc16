"""Compute glare and uncertainty of a block of predicted hours."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.year.glare.contrast import ViewRegions
from fieldlum.year.glare.geometry import Views
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import SOURCE_CDM2
from fieldlum.year.glare.standards import dgp_uncertainty
from fieldlum.year.glare.unseen import ViewCoverage, brightest_cdm2, unseen_dgp_bounds
from fieldlum.year.predict.blocks import HourBlock, ModelRoom

# Relative standard uncertainty of the disc's illuminance, for luminous efficacy and glass together.
# Not measured.
U_DISC = 0.05


def unseen_bounds(
    block: HourBlock, room: ModelRoom, coverage: ViewCoverage, figures: dict[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the least and the largest DGP that unseen parts of the views allow, [k, d] each.

    An unseen part gets one luminance between 0 and the larger of the sky's mean luminance and the
    luminance exceeded in the brightest hundredth of the seen solid angle. For views without unseen
    pixels both results are the DGP itself. figures: the result of `view_figures`.
    """
    most = block.light.diffuse_lx / np.pi
    if room.seen is not None and coverage.partly.any():
        most = np.maximum(most, brightest_cdm2(block.prediction.luminance_cdm2, room.seen))
    return unseen_dgp_bounds(coverage, figures["ev_lx"], figures["contrast"], most)


def hour_figures(block: HourBlock) -> dict[str, Array]:
    """Return the figures of k hours that have no direction, by column of hourly.csv, [k] each.

    `disturbed_share` is missing, and `occupied` is 0, because they need more than the block.
    """
    light, predicted = block.light, block.prediction
    return {
        "dni_wm2": light.dni_wm2,
        "dhi_wm2": light.dhi_wm2,
        "sun_altitude_deg": light.sun_altitude_deg,
        "sun_azimuth_deg": light.sun_azimuth_deg,
        "disc_lx": block.disc_lx,
        "occupied": np.zeros(len(light)),
        "trusted": block.trusted.astype(float),
        "expected_log10_mse": predicted.expected_mse,
    }


def view_figures(
    block: HourBlock, room: ModelRoom, views: Views, regions: ViewRegions
) -> dict[str, Floats]:
    """Return the figures of k hours in d view directions, by column of hourly.csv, [k, d] each.

    `dgp_low` and `dgp_high` are missing; `u_dgp` has only the errors of the maps and of the visible
    disc's illuminance. All further keys of `glare_directions` are included.
    """
    maps = block.prediction.luminance_cdm2
    figures = glare_directions(
        maps,
        room.heading_deg,
        views.azimuths_deg,
        np.stack([block.light.shown_sun_direction, *(image.towards for image in block.images)]),
        np.stack([block.disc_lx, *(image.shown_lx for image in block.images)]),
        views=views,
    )
    figures["u_dgp"] = dgp_uncertainty(
        figures["ev_lx"], figures["contrast"], *relative_uncertainty(block, views, figures)
    )
    figures["melanopic_edi_lx_estimate"] = figures["ev_lx"]
    return figures | regions.ratios(maps)


def relative_uncertainty(
    block: HourBlock, views: Views, figures: dict[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the relative standard uncertainty of Ev and of the sources' luminance, [k, d] each.

    They are NaN where the model does not state its error. Errors of the pixels of one picture count
    as fully correlated, because a model is often too bright or too dark on a complete wall. The
    disc has 5 %. figures: the result of `glare_directions`.
    """
    map_ev, map_source = _relative_of_map(block, views)
    share_ev = figures["sun_ev_lx"] / np.maximum(figures["ev_lx"], 1e-6)
    share = np.divide(
        figures["sun_contrast"],
        figures["contrast"],
        out=np.zeros_like(share_ev),
        where=figures["contrast"] > 0,
    )
    return (
        np.hypot((1.0 - share_ev) * map_ev, share_ev * U_DISC),
        np.hypot((1.0 - share) * map_source, share * U_DISC),
    )


def _relative_of_map(block: HourBlock, views: Views) -> tuple[Floats, Floats]:
    predicted = block.prediction
    shape = (len(predicted.trusted), len(views.azimuths_deg))
    if predicted.log10_sd is None:
        same = np.log(10.0) * np.sqrt(np.asarray(predicted.expected_mse, float))[:, None]
        return np.broadcast_to(same, shape), np.broadcast_to(same, shape)
    flat = predicted.luminance_cdm2.reshape(shape[0], -1)
    spread = np.float32(np.log(10.0)) * predicted.log10_sd.reshape(shape[0], -1)
    ev = flat @ views.illuminance
    ev_off = (flat * spread) @ views.illuminance
    power = np.where(flat > SOURCE_CDM2, flat, np.float32(0.0)) ** 2
    source, source_off = power @ views.illuminance, (power * spread) @ views.illuminance
    return (
        (ev_off / np.maximum(ev, 1e-6)).astype(float),
        np.divide(source_off, source, out=np.zeros_like(source), where=source > 0).astype(float),
    )
