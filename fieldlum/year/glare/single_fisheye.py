"""Compute the answer of `fieldlum glare` for a fisheye or perspective picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.optics.photometry.melanopic import melanopic_edi
from fieldlum.optics.projection import FULLY_SEEN_SHARE, NOT_SEEN, signed_angle_deg
from fieldlum.year.glare.answers import (
    GlareAnswer,
    ViewAnswer,
    answer_of,
    bounds_verdict,
    plain,
    scaled_sun,
    seen_pixels,
    valid_pixels,
    verdict,
)
from fieldlum.year.glare.metrics import METRICS
from fieldlum.year.glare.own_pixels import GlareSources, disc_pixels, glare_of_pixels, region_ratios
from fieldlum.year.glare.picture_grid import PictureGrid, picture_grid
from fieldlum.year.glare.pictures import Picture
from fieldlum.year.glare.reference import reference_glare
from fieldlum.year.glare.unseen import (
    brightest_of_picture_cdm2,
    picture_coverage,
    unseen_dgp_bounds,
)

# most sources that are listed, because a noisy picture can have thousands; chosen
SHOWN_SOURCES = 20


def single_picture_glare(
    picture: Picture,
    path: Path,
    azimuths_deg: Sequence[float],
    reference: bool,
    factor: float,
    lamps: bool,
) -> GlareAnswer:
    """Return the `glare` answer of a fisheye or perspective picture in its own view direction.

    path : names the picture in the answer and in errors. factor : multiplies the luminance.
    reference : add evalglare's figures. lamps : electric light is on. Raises InputError if
    `azimuths_deg` has another azimuth than the picture's own (it may be empty), and for pixels that
    are not finite.
    """
    view = picture.view
    assert view is not None
    _check_azimuths(view.azimuth_deg, azimuths_deg, path)
    pixels, warnings = valid_pixels(picture.panorama, path)
    pixels *= np.float32(factor)
    sun = scaled_sun(picture.panorama.sun, factor)
    grid = _seen_grid(picture, *pixels.shape)
    parts, sources = glare_of_pixels(pixels, grid, sun)
    figures = {name: parts[name] for name in METRICS}
    figures |= region_ratios(pixels, grid)
    row: dict[str, Any] = {"azimuth_deg": view.azimuth_deg, "altitude_deg": view.altitude_deg}
    row |= {name: plain(value) for name, value in figures.items()}
    weights = grid.illuminance.reshape(-1, 1)
    sun_ev_lx = np.array([parts["sun_ev_lx"]])
    edi, u_edi = melanopic_edi(
        picture.panorama, pixels.ravel(), weights, sun, sun_ev_lx, lamps=lamps
    )
    row["melanopic_edi_lx"] = float(edi[0])
    row["u_melanopic_edi_lx"] = None if u_edi is None else plain(u_edi[0])
    row |= _seen_figures(pixels, grid, parts)
    row |= {"source_count": len(sources), "sources": _source_rows(sources)}
    if reference:
        shown = pixels if sun is None else pixels + disc_pixels(grid, sun)
        row["reference"] = asdict(reference_glare(shown, view=view.text))
    share = grid.covered_share
    if share < FULLY_SEEN_SHARE:
        warnings.append(
            f"the picture covers {100 * share:.0f} % of the hemisphere in front: Ev is a lower "
            "bound, and DGP counts the part outside the picture as black; a partly seen view has "
            "bounds of DGP too; use a 180-degree fisheye"
        )
    return answer_of(path, picture, [cast(ViewAnswer, row)], warnings, sun, share, factor)


def _seen_figures(
    pixels: Floats, grid: PictureGrid, parts: dict[str, float]
) -> dict[str, str | float]:
    """Return how much of the view was seen, the grade, and bounds of DGP for a partly seen view.

    pixels : [H, W] cd/m2; grid : their weights; parts : figures by `glare_of_pixels`.
    """
    coverage = picture_coverage(grid)
    row: dict[str, str | float] = {
        "seen": coverage.words[0],
        "seen_share": float(coverage.seen_share[0]),
    }
    if not coverage.judged[0]:
        return row | {"verdict": NOT_SEEN}
    if not coverage.partly[0]:
        return row | {"verdict": verdict(parts["dgp"])}
    most = np.array([brightest_of_picture_cdm2(pixels, grid)])
    ev_lx, contrast = (np.array([[parts[name]]]) for name in ("ev_lx", "contrast"))
    low, high = (float(bound[0, 0]) for bound in unseen_dgp_bounds(coverage, ev_lx, contrast, most))
    return row | {"dgp_low": low, "dgp_high": high, "verdict": bounds_verdict(low, high)}


def _seen_grid(picture: Picture, height: int, width: int) -> PictureGrid:
    """Return the weights of the pixels; 0 for pixels that no lens saw."""
    assert picture.view is not None
    grid = picture_grid(picture.view, height, width)
    seen_mask = seen_pixels(picture.panorama)
    if seen_mask is not None:
        grid.solid_angle[~seen_mask] = 0.0
        grid.illuminance[~seen_mask] = 0.0
    return grid


def _check_azimuths(azimuth_deg: float, asked: Sequence[float], path: Path) -> None:
    """Raise InputError for view directions other than the picture's own."""
    if asked and np.abs(signed_angle_deg(np.asarray(asked) - azimuth_deg)).max() > 1e-3:
        raise InputError(
            path,
            f"--view-azimuth with a picture that has one view direction, {azimuth_deg:.1f} deg",
            "--view-azimuth only with a panorama",
            "remove --view-azimuth",
        )


def _source_rows(sources: GlareSources) -> list[dict[str, float]]:
    """Return the figures of the strongest sources."""
    return [
        {
            "mean_cdm2": float(sources.mean_cdm2[i]),
            "solid_angle_sr": float(sources.solid_angle_sr[i]),
            "right_deg": float(np.degrees(sources.right_rad[i])),
            "up_deg": float(np.degrees(sources.up_rad[i])),
            "ev_lx": float(sources.ev_lx[i]),
        }
        for i in range(min(len(sources), SHOWN_SOURCES))
    ]
