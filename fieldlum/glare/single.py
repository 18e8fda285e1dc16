"""Glare of one picture on disk, as plain numbers for a terminal or a pipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.errors import InputError
from fieldlum.glare.contrast import ViewRegions, melanopic_edi_lx, rammg, rammg_lightness
from fieldlum.glare.fisheye import panorama_to_fisheye
from fieldlum.glare.geometry import panorama_views, view_azimuths_deg
from fieldlum.glare.metrics import METRICS, glare_directions
from fieldlum.glare.pictures import Picture, read_picture
from fieldlum.glare.reference import reference_glare
from fieldlum.glare.sources import group_pixels, widen
from fieldlum.glare.unseen import brightest_cdm2, unseen_dgp_bounds, view_coverage
from fieldlum.projection import (
    NOT_SEEN,
    SEEN,
    direction,
    equirect_rays,
    equirect_solid_angles,
    signed_angle_deg,
)
from fieldlum.records import Flag, Float, Panorama, SunSource, utc_text
from fieldlum.sun import SUN_SOLID_ANGLE_SR

DISC_CDM2 = 1e6  # no matt surface and no sky is that bright
BRIGHTEST_SUN_CDM2 = 2.2e9
VERDICTS = (
    (0.35, "imperceptible"),
    (0.40, "perceptible"),
    (0.45, "disturbing"),
    (np.inf, "intolerable"),
)


def verdict(dgp: float) -> str:
    """Wienold's four grades of DGP."""
    return next(name for limit, name in VERDICTS if dgp < limit)


def _bounds_verdict(low: float, high: float) -> str:
    """One grade, or both ends where the unseen part decides."""
    least, most = verdict(low), verdict(high)
    return least if least == most else f"{least} to {most}"


def picture_glare(
    path: Path, azimuths_deg: Sequence[float] = (), *, reference: bool = False
) -> dict[str, Any]:
    """Return file, views (one dict each), contrast of the panorama and warnings of a file.

    Raises InputError for an unusable picture.
    """
    return _glare_of(read_picture(path), path, azimuths_deg, reference)


def panorama_glare(
    panorama: Panorama, azimuths_deg: Sequence[float] = (), *, reference: bool = False
) -> dict[str, Any]:
    """Return the same for a panorama in memory; its `file` is "".

    Raises InputError for a map that is not twice as wide as high, or not finite.
    """
    source = Path("panorama")
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(source, f"{width} x {height} pixels", "a map twice as wide as high")
    picture = Picture(panorama, None, 2.0 * np.pi)
    return _glare_of(picture, source, azimuths_deg, reference) | {"file": ""}


def _glare_of(
    picture: Picture, path: Path, azimuths_deg: Sequence[float], reference: bool
) -> dict[str, Any]:
    panorama = picture.panorama
    azimuths = _azimuths(picture, azimuths_deg, path)
    maps, warnings = _sound(panorama, path)
    warnings += _warnings(picture)
    maps, sun = take_out_sun(maps, panorama.heading_deg, panorama.sun)
    rays = None if sun is None else direction(sun.altitude_deg, sun.azimuth_deg)[None]
    disc = None if sun is None else np.array([sun.normal_illuminance_lx])
    height, width = maps.shape
    seen = None if picture.view is not None else _seen(panorama)
    grid = panorama_views(height, width, panorama.heading_deg, azimuths)
    coverage = view_coverage(seen, grid)
    parts = glare_directions(maps[None], panorama.heading_deg, azimuths, rays, disc, views=grid)
    found = {name: parts[name] for name in METRICS}
    found |= ViewRegions(height, width, panorama.heading_deg, azimuths, seen).ratios(maps[None])
    most = np.zeros(1) if seen is None else brightest_cdm2(maps[None], seen)
    low, high = unseen_dgp_bounds(coverage, parts["ev_lx"], parts["contrast"], most)
    views = []
    for i, azimuth in enumerate(azimuths):
        row: dict[str, Any] = {"azimuth_deg": float(azimuth)}
        row |= {name: _plain(values[0, i]) for name, values in found.items()}
        row["melanopic_edi_lx"] = float(melanopic_edi_lx(found["ev_lx"][0, i]))
        row["verdict"] = verdict(row["dgp"])
        row |= {"seen": coverage.words[i], "seen_share": float(coverage.seen_share[i])}
        if coverage.partly[i]:
            row |= {"dgp_low": float(low[0, i]), "dgp_high": float(high[0, i])}
            row["verdict"] = _bounds_verdict(row["dgp_low"], row["dgp_high"])
        if not coverage.judged[i]:
            row |= dict.fromkeys((*found, "melanopic_edi_lx")) | {"verdict": NOT_SEEN}
        if reference and coverage.words[i] == SEEN:
            view = panorama_to_fisheye(maps, panorama.heading_deg, float(azimuth), sun=sun)
            row["reference"] = asdict(reference_glare(view))
        views.append(row)
    whole = (
        {"rammg_cdm2": rammg(maps), "rammg_lightness": rammg_lightness(maps)}
        if picture.view is None
        else {}
    )
    return {
        "file": str(path),
        "t_utc": utc_text(panorama.t_utc) if panorama.t_utc else None,
        "heading_deg": panorama.heading_deg,
        "covered_share": min(1.0, picture.covered_sr / (2 * np.pi)),
        "sun": None if sun is None else asdict(sun),
        "melanopic_der": "D65, assumed",
        **whole,
        "views": views,
        "warnings": warnings,
    }


def take_out_sun(
    luminance_cdm2: Float, heading_deg: float, known: SunSource | None
) -> tuple[Float, SunSource | None]:
    """A disc that a rendering left in its picture becomes a source of its own, of the sun's own
    solid angle.

    The brightest spot from `DISC_CDM2` up, no larger than a disc that a coarse grid has smeared,
    and no brighter than the sun once its energy is put into the disc. A sun that the picture names
    is taken as it stands.
    """
    peaks = luminance_cdm2 >= DISC_CDM2
    if known is not None or not peaks.any():
        return luminance_cdm2, known
    height, width = luminance_cdm2.shape
    omega = equirect_solid_angles(height, width)
    groups = group_pixels(peaks)
    spot = groups == groups.flat[int(np.argmax(luminance_cdm2))]
    energy = float((luminance_cdm2 * omega)[spot].sum())
    room = 4.0 * SUN_SOLID_ANGLE_SR + 9.0 * float(omega[spot].max())
    if (
        omega[spot].sum() > room
        or not DISC_CDM2 <= energy / SUN_SOLID_ANGLE_SR <= BRIGHTEST_SUN_CDM2
    ):
        return luminance_cdm2, None
    weights = (luminance_cdm2 * omega)[spot][:, None]
    x, y, z = (weights * equirect_rays(height, width, heading_deg)[spot]).sum(axis=0)
    around = np.where(
        spot, float(np.median(luminance_cdm2[widen(spot, np.radians(3.0)) & ~spot])), luminance_cdm2
    )
    altitude, azimuth = (
        np.degrees(np.arctan2(z, np.hypot(x, y))),
        np.degrees(np.arctan2(x, y)) % 360.0,
    )
    return around.astype(np.float32), SunSource(
        float(altitude), float(azimuth), energy, 1.0, "picture"
    )


def _azimuths(picture: Picture, asked: Sequence[float], path: Path) -> np.ndarray:
    view = picture.view
    if view is None:
        return np.asarray(asked or view_azimuths_deg(picture.panorama.heading_deg), float) % 360.0
    if abs(view.altitude_deg) > 1.0:
        raise InputError(
            path,
            f"a view {view.altitude_deg:.1f} degrees off the horizon",
            "a level view",
            "take it with a level head",
        )
    if asked and np.abs(signed_angle_deg(np.asarray(asked) - view.azimuth_deg)).max() > 1e-3:
        raise InputError(
            path,
            f"--view-azimuth on a fisheye that looks to {view.azimuth_deg:.1f}",
            "a panorama",
            "leave --view-azimuth away",
        )
    return np.array([view.azimuth_deg])


def _sound(panorama: Panorama, path: Path) -> tuple[np.ndarray, list[str]]:
    """Negative values are noise and count as 0, and so does what no lens saw; what else is no
    number is refused.
    """
    pixels, said = np.asarray(panorama.luminance_cdm2, np.float32), []
    if panorama.flags is not None and (outside := panorama.flags & Flag.OUTSIDE_LENS > 0).any():
        pixels = np.where(outside, np.float32(0.0), pixels)
        said.append(
            f"{100 * outside.mean():.0f} % of the panorama was seen by no lens: directions that "
            f"need it have no result or bounds, in which the unseen part has 0 cd/m2 up to the "
            f"luminance of the brightest hundredth of the seen part"
        )
    bad = int((~np.isfinite(pixels)).sum())
    if bad:
        raise InputError(
            path,
            f"{bad} pixels that are no numbers",
            "cd/m2 everywhere",
            "merge or render it again",
        )
    dark = int((pixels < 0).sum())
    if dark:
        said.append(f"{dark} pixels below 0 cd/m2 count as 0")
    return np.maximum(pixels, 0.0), said


def _seen(panorama: Panorama) -> np.ndarray | None:
    """Pixels that a lens saw, [H, W]; None where all were."""
    if panorama.flags is None:
        return None
    outside = (panorama.flags & Flag.OUTSIDE_LENS) > 0
    return ~outside if outside.any() else None


def _warnings(picture: Picture) -> list[str]:
    said = []
    share = picture.covered_sr / (2.0 * np.pi)
    if share < 0.98:
        said.append(f"covers {100 * share:.0f} % of the view: Ev and DGP are lower bounds")
    if not picture.directed:
        said.append(
            "its VIEW has no -vd: glare holds, but whether it looks to azimuth 0 is not known"
        )
    flags = picture.panorama.flags
    clipped = 0 if flags is None else int((flags & Flag.CLIPPED_HIGH > 0).sum())
    if clipped:
        said.append(
            f"{clipped} pixels clipped in every frame: luminance there, and DGP, are lower bounds"
        )
    return said


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
