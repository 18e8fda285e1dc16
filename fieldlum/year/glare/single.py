"""Compute the glare of one picture on disk, as plain numbers for a terminal or a pipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, SunSource
from fieldlum.optics.photometry.melanopic import melanopic_edi
from fieldlum.optics.projection import FULLY_SEEN_SHARE, NOT_SEEN, SEEN, direction, signed_angle_deg
from fieldlum.sky.sun_disc import find_disc, without_disc
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
from fieldlum.year.glare.contrast import ViewRegions, rammg, rammg_lightness
from fieldlum.year.glare.fisheye import panorama_to_fisheye
from fieldlum.year.glare.geometry import panorama_views, view_azimuths_deg
from fieldlum.year.glare.metrics import METRICS, glare_directions
from fieldlum.year.glare.own_pixels import GlareSources, disc_pixels, glare_of_pixels, region_ratios
from fieldlum.year.glare.picture_view import PictureGrid, picture_grid
from fieldlum.year.glare.pictures import Picture, read_picture
from fieldlum.year.glare.reference import reference_glare
from fieldlum.year.glare.unseen import (
    brightest_cdm2,
    brightest_of_picture_cdm2,
    picture_coverage,
    unseen_dgp_bounds,
    view_coverage,
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


def picture_glare(
    path: Path,
    azimuths_deg: Sequence[float] = (),
    *,
    reference: bool = False,
    view_options: str = "",
    part: str = "",
    measured_ev_lx: float | None = None,
    lamps: bool = False,
) -> GlareAnswer:
    """Return the object that `glare --json` prints for a .hdr or .exr picture.

    azimuths_deg : view directions, clockwise from north; if empty, ten around a panorama, or a
    fisheye's own. reference : add evalglare's figures. view_options : Radiance's options that
    replace the view in the file; "" to use the file's. part : name of the part, layer or stereo
    view of an .exr; "" for the only one. measured_ev_lx : scale the picture so that its first view
    has this vertical illuminance; None for no scaling. lamps : electric light is on, so that
    melanopic EDI is less certain. Raises InputError for an unusable picture,
    or if a picture to scale has no light in its first view.
    """
    picture = read_picture(path, view_options, part)
    judge = _panorama_answer if picture.view is None else single_picture_glare
    if measured_ev_lx is None:
        return judge(picture, path, azimuths_deg, reference, 1.0, lamps)
    ev = judge(picture, path, azimuths_deg, False, 1.0, lamps)["views"][0]["ev_lx"]
    if not ev or ev <= 0.0:
        raise InputError(
            path,
            "no light was seen in the first view direction",
            "light there, so that the picture can be scaled to the measured illuminance",
            "check the view direction, or omit the measured illuminance (--calibrate-ev)",
        )
    factor = measured_ev_lx / ev
    answer = judge(picture, path, azimuths_deg, reference, factor, lamps)
    answer["calibration_factor"] = factor
    return answer


def panorama_glare(panorama: Panorama, azimuths_deg: Sequence[float] = ()) -> GlareAnswer:
    """Return the same as `picture_glare`, for a panorama in memory; the answer's `file` is "".

    azimuths_deg : view directions, clockwise from north; ten if empty. Raises InputError for a map
    that is not twice as wide as high, or has seen pixels that are not finite.
    """
    source = Path("panorama")
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(
            source,
            f"a map of {width} x {height} pixels",
            "a map twice as wide as high",
            "use a map of all directions (equirectangular)",
        )
    picture = Picture(panorama, None)
    answer = _panorama_answer(picture, source, azimuths_deg, False, 1.0, False)
    answer["file"] = ""
    return answer


def _panorama_answer(
    picture: Picture,
    path: Path,
    azimuths_deg: Sequence[float],
    reference: bool,
    factor: float,
    lamps: bool,
) -> GlareAnswer:
    """Judge a panorama in the given directions, with its luminance times `factor`."""
    panorama = picture.panorama
    azimuths = np.asarray(azimuths_deg or view_azimuths_deg(panorama.heading_deg), float) % 360.0
    maps, warnings = valid_pixels(panorama, path)
    maps *= np.float32(factor)
    seen_mask = seen_pixels(panorama)
    if seen_mask is not None:
        warnings.insert(0, _unseen_text(seen_mask))
    maps, sun = take_out_sun(maps, panorama.heading_deg, scaled_sun(panorama.sun, factor))
    views = _view_rows(maps, panorama, azimuths, sun, seen_mask, lamps)
    for row in views:
        if reference and row["seen"] == SEEN:
            azimuth = row["azimuth_deg"]
            fisheye = panorama_to_fisheye(maps, panorama.heading_deg, azimuth, sun=sun)
            row["reference"] = asdict(reference_glare(fisheye))
    answer = answer_of(path, picture, views, warnings, sun, 1.0, factor)
    answer["rammg_cdm2"], answer["rammg_lightness"] = rammg(maps), rammg_lightness(maps)
    return answer


def _view_rows(
    maps: Floats,
    panorama: Panorama,
    azimuths: np.ndarray,
    sun: SunSource | None,
    seen_mask: np.ndarray | None,
    lamps: bool,
) -> list[ViewAnswer]:
    """Return the figures of each direction.

    maps : luminance [H, W] of the panorama without the sun; seen_mask [H, W], None if all pixels
    were seen.
    """
    heading_deg = panorama.heading_deg
    rays = None if sun is None else direction(sun.altitude_deg, sun.azimuth_deg)[None]
    disc = None if sun is None else np.array([sun.normal_illuminance_lx])
    height, width = maps.shape
    grid = panorama_views(height, width, heading_deg, azimuths)
    coverage = view_coverage(seen_mask, grid)
    parts = glare_directions(maps[None], heading_deg, azimuths, rays, disc, views=grid)
    figures = {name: parts[name] for name in METRICS}
    figures |= ViewRegions(height, width, heading_deg, azimuths, seen_mask).ratios(maps[None])
    most = np.zeros(1) if seen_mask is None else brightest_cdm2(maps[None], seen_mask)
    low, high = unseen_dgp_bounds(coverage, parts["ev_lx"], parts["contrast"], most)
    edi, u_edi = melanopic_edi(
        panorama, maps.ravel(), grid.illuminance, sun, parts["sun_ev_lx"][0], lamps=lamps
    )
    views = []
    for i, azimuth in enumerate(azimuths):
        row: dict[str, Any] = {"azimuth_deg": float(azimuth)}
        row |= {name: plain(values[0, i]) for name, values in figures.items()}
        row["melanopic_edi_lx"] = float(edi[i])
        row["u_melanopic_edi_lx"] = None if u_edi is None else plain(u_edi[i])
        row["verdict"] = verdict(row["dgp"])
        row |= {"seen": coverage.words[i], "seen_share": float(coverage.seen_share[i])}
        if coverage.partly[i]:
            row |= {"dgp_low": float(low[0, i]), "dgp_high": float(high[0, i])}
            row["verdict"] = bounds_verdict(row["dgp_low"], row["dgp_high"])
        if not coverage.judged[i]:
            row |= dict.fromkeys((*figures, "melanopic_edi_lx", "u_melanopic_edi_lx"))
            row["verdict"] = NOT_SEEN
        views.append(cast(ViewAnswer, row))
    return views


def _unseen_text(seen_mask: np.ndarray) -> str:
    return (
        f"no lens saw {100 * (~seen_mask).mean():.0f} % of the panorama: view directions that are "
        "mostly unseen have no result; partly seen ones have two values of DGP, the lowest and the "
        "highest for an unseen part between black and the brightest 1 % of the seen part"
    )


def take_out_sun(
    luminance_cdm2: Floats, heading_deg: float, recorded: SunSource | None
) -> tuple[Floats, SunSource | None]:
    """Return the map without a sun disc in its pixels, and the sun as a source; None without a sun.

    luminance_cdm2 : [H, W = 2H]; heading_deg : azimuth of its centre column, clockwise from north.
    recorded : the sun that the picture records separately: it is returned, and the map is
    unchanged. If it is None, a disc in the pixels (of a rendering) is searched and removed.
    """
    disc = None if recorded else find_disc(luminance_cdm2, heading_deg)
    if disc is None:
        return luminance_cdm2, recorded
    sun = SunSource(disc.altitude_deg, disc.azimuth_deg, disc.normal_lx, 1.0, "picture")
    return without_disc(luminance_cdm2, disc), sun
