"""Read the pictures of a pairs.csv: maps and sun patches of one size; separate the sun's disc."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import CLIPPED_SUN, Flag, Panorama, Progress, SiteFile
from fieldlum.learn.models.hour_weights import weight_of_variance
from fieldlum.optics.images import PANORAMA_LINE, read_panorama
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.session.files.pairs_csv import PairRow
from fieldlum.session.panorama_sun import read_panorama_with_sun, suns_of
from fieldlum.sky.sun_disc import find_disc, without_disc

_MERGE_ALIKE = "render or merge all brackets at one size and heading, then run fieldlum pair again"
_PAIR_AGAIN = "run fieldlum pair again, because the sun patches belong to other pictures"
# A clipped value is a bound; a moving object has different values in each frame; a filled value is
# from the pixel's neighbours. Bloom and noise are part of u_cdm2.
TEACHES_NOTHING = Flag.CLIPPED_HIGH | Flag.MOTION | Flag.FILLED


@dataclass(frozen=True, slots=True)
class PairPictures:
    """The pictures of the n rows of a pairs.csv; later steps change the arrays in place.

    maps: captured luminance [n, H, W] cd/m2; patches: luminance of the direct sun alone [n, H, W]
    cd/m2, None without pictures of sun patches; disc_lx: illuminance by the sun's disc on a plane
    normal to it [n]; disc_deg: its altitude and azimuth in map or patch [n, 2], NaN where not
    measured; has_value: mask [n, H, W], True at measured pixels; counts: weights of the
    pixels in training, [H, W] or None for 1, one entry for each row; heading_deg: azimuth of the
    middle of all maps; bounds: number of maps whose sun is clipped, so that its illuminance is only
    a lower bound.
    """

    maps: Floats32
    patches: Floats32 | None
    disc_lx: Floats
    disc_deg: Floats
    has_value: Mask
    counts: list[NDArray[np.float16] | None]
    heading_deg: float
    bounds: int

    def take_disc_out(
        self, k: int, at: tuple[float, float], shown: tuple[float, float], dni_wm2: float
    ) -> None:
        """Remove the sun's disc from map k and patch k; store its illuminance and its place.

        at: altitude and azimuth of the sun [deg], where the patch shows it; shown: altitude and
        azimuth at which the picture of a turned camera shows it [deg]; dni_wm2: direct normal
        irradiance. With sun patches, the illuminance is that in the patch, which has no sky around
        the disc.
        """
        for pictures, place in ((self.maps, shown), (self.patches, at)):
            if pictures is None:
                continue
            disc = find_disc(pictures[k], self.heading_deg, near_deg=place, dni_wm2=dni_wm2)
            self.disc_lx[k] = 0.0 if disc is None else disc.normal_lx
            if disc is not None:
                pictures[k] = without_disc(pictures[k], disc)
                turn = float(signed_angle_deg(disc.azimuth_deg - place[1]))
                self.disc_deg[k] = at[0] + disc.altitude_deg - place[0], at[1] + turn


def read_pictures(
    path: Path, rows: list[PairRow], setup: SiteFile, progress: Progress
) -> PairPictures:
    """Read the maps and sun patches of the rows of a pairs.csv; the sun's disc remains in the maps.

    path: of the pairs.csv, to whose folder the names of pictures are relative. disc_lx is from the
    pictures' headers, 0 where they have none. Raises InputError if sizes or headings differ from
    those of the first picture, or if only some rows have a sun patch.
    """
    pictures = [path.parent / row.panorama for row in rows]
    suns = {folder: suns_of(picture) for folder, picture in {p.parent: p for p in pictures}.items()}
    first = read_panorama(pictures[0])
    shape, heading = first.luminance_cdm2.shape, _heading(first, pictures[0], setup)
    alike = shape, heading
    with_patch = sum(bool(row.sunpatch) for row in rows)
    if 0 < with_patch < len(rows):
        bare = next(row.line for row in rows if not row.sunpatch)
        raise InputError(
            path,
            f"line {bare}: the cell of column sunpatch is empty, but not in other rows",
            "a sunpatch in all rows or in none",
            "fill or empty this column in all rows",
        )
    maps = np.empty((len(rows), *shape), np.float32)
    patches = np.empty_like(maps) if with_patch else None
    disc, bounds = np.zeros(len(rows)), 0
    masks, counts = np.empty(maps.shape, bool), []
    for k, row in enumerate(rows):
        progress(k, len(rows), pictures[k].name)
        panorama = read_panorama_with_sun(pictures[k], suns[pictures[k].parent])
        panorama = _checked(panorama, pictures[k], alike, setup, _MERGE_ALIKE)
        bounds += panorama.sun is not None and panorama.sun.origin == CLIPPED_SUN
        maps[k], masks[k] = panorama.luminance_cdm2, _has_value(panorama)
        counts.append(pixel_counts(panorama))
        disc[k] = panorama.sun.normal_illuminance_lx if panorama.sun else 0.0
        if patches is not None:
            source = path.parent / row.sunpatch
            patch = _checked(read_panorama(source), source, alike, setup, _PAIR_AGAIN)
            patches[k] = np.maximum(np.nan_to_num(patch.luminance_cdm2), 0.0)
            if patch.sun and not panorama.sun and not row.sun_in_map:
                disc[k] = patch.sun.normal_illuminance_lx
    progress(len(rows), len(rows), "")
    places = np.full((len(rows), 2), np.nan)
    return PairPictures(maps, patches, disc, places, masks, counts, heading, bounds)


def _heading(panorama: Panorama, path: Path, setup: SiteFile) -> float:
    """Return the heading of the picture (.exr, or a .hdr with a heading line), else the site's."""
    if path.suffix.lower() == ".exr":
        return panorama.heading_deg
    with path.open("rb") as file:
        stated = PANORAMA_LINE.encode() in file.read(4096).partition(b"\n\n")[0]
    return panorama.heading_deg if stated else setup.camera.heading_deg


def _checked(
    panorama: Panorama,
    path: Path,
    alike: tuple[tuple[int, ...], float],
    setup: SiteFile,
    remedy: str,
) -> Panorama:
    """Return a picture if it has size and heading of the first row's, else raise InputError."""
    heading, (height, width) = _heading(panorama, path, setup), panorama.luminance_cdm2.shape
    if (height, width) != alike[0]:
        found, wanted = f"{width} x {height} pixels", f"{alike[0][1]} x {alike[0][0]} pixels"
    elif abs(signed_angle_deg(heading - alike[1])) > 0.01:
        found, wanted = f"a heading of {heading:g} deg", f"{alike[1]:g} deg"
    else:
        return panorama
    raise InputError(path, found, f"{wanted}, as the panorama of the first row", remedy)


def _has_value(panorama: Panorama) -> Mask:
    good = np.isfinite(panorama.luminance_cdm2)
    return good if panorama.flags is None else good & ((panorama.flags & Flag.OUTSIDE_LENS) == 0)


def fill_gaps(maps: Floats32, has_value: Mask) -> tuple[Mask, int]:
    """Fill missing values in `maps`, in place; return a mask of used pixels and a count.

    maps: [n, H, W]; has_value: mask [n, H, W], False where a value is missing. A missing value gets
    the pixel's median over the maps. A pixel that is missing in a fifth of the maps or more is not
    used: it is False in the mask [H, W] and 0 in all maps. Negative values become 0. count: number
    of filled values. Raises NotEnoughDataError if no pixel is used.
    """
    seen_mask = has_value.mean(axis=0) > 0.8
    if not seen_mask.any():
        raise NotEnoughDataError(
            "no pixel has a value in over 80 % of the panoramas; check that "
            "all panoramas are from one camera position"
        )
    gaps = ~has_value & seen_mask
    for i, j in np.argwhere(gaps.any(axis=0)):
        maps[gaps[:, i, j], i, j] = np.median(maps[has_value[:, i, j], i, j])
    maps[:, ~seen_mask] = 0.0
    np.maximum(maps, 0.0, out=maps)
    return seen_mask, int(gaps.sum())


def pixel_counts(panorama: Panorama) -> NDArray[np.float16] | None:
    """Return the weight of each pixel in training, 0 to 1, [H, W].

    It is 0 where `flags` mark a clipped, moving or filled pixel, else by the relative
    uncertainty (1 without uncertainties). None if the picture has neither flags nor uncertainties.
    """
    if panorama.flags is None and panorama.u_cdm2 is None:
        return None
    counts = np.ones(panorama.luminance_cdm2.shape)
    if panorama.u_cdm2 is not None:
        light = np.maximum(np.nan_to_num(panorama.luminance_cdm2), 1e-6)
        relative = np.nan_to_num(np.asarray(panorama.u_cdm2, float) / light, posinf=1e3)
        counts = weight_of_variance(relative**2)
    if panorama.flags is not None:
        counts = np.where((panorama.flags & TEACHES_NOTHING) != 0, 0.0, counts)
    return counts.astype(np.float16)


def joined_counts(
    each: Sequence[NDArray[np.float16] | None], has_value: Mask
) -> NDArray[np.float16] | None:
    """Return the weights of the pixels of all captures [n, H, W]; None if all weights are 1.

    each: result of `pixel_counts` for each capture, where None means 1; has_value: mask [n, H, W],
    False where a value is missing, whose weight is 0. The weights of each pixel are divided by
    their maximum: an uncertainty that is common to all captures (the camera's scale) does not make
    one capture better than another. A pixel without weight in most captures gets at least 0.1.
    """
    if all(counts is None for counts in each) and has_value.all():
        return None
    ones = np.ones(has_value.shape[1:], np.float16)
    counts = np.stack([ones if weights is None else weights for weights in each])
    counts[~has_value] = 0.0
    largest = counts.max(axis=0)
    counts /= np.where(largest > 0.0, largest, np.float16(1.0))
    mostly = (counts == 0.0).mean(axis=0) > 0.5  # a lamp that is always clipped
    counts[:, mostly] = np.maximum(counts[:, mostly], np.float16(0.1))
    return counts
