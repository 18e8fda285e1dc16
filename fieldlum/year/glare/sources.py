"""Compute where pixels are for an observer, and group bright pixels into glare sources.

A pixel brighter than 2 000 cd/m2 belongs to a source. Pixels closer than 0.1 rad (5.7 degrees) to
each other belong to the same source, so that the panes of a window are one source. The position of
a source is its luminance-weighted centre. Pixels from 50 000 cd/m2 on are removed from their source
and form sources of their own. These are evalglare's defaults (-b 2000, -r 0.2 with its own
definition of the search angle, -Y 50000). An additive sum over pixels, which needs no grouping, is
higher for windows with bright and dark panes (docs/validation.md, "Glare").
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Floats32, Indices, Ints32, Ints64, Mask
from fieldlum.core.compiled import compiled
from fieldlum.optics import projection

MAX_POSITION_INDEX = 16.0  # as evalglare limits it (source of evalglare 3)


def view_azimuths_deg(heading_deg: float, views: int = 10) -> Floats:
    """Return the azimuths of `views` horizontal directions at equal steps, [views].

    The first is `heading_deg`; the others follow clockwise. All are in degrees clockwise from
    north, in [0, 360). Ten directions are those of Liu, Colburn and Inanici 2020.
    """
    return (heading_deg + np.arange(views) * 360.0 / views) % 360.0


def view_frame(azimuth_deg: float) -> Floats:
    """Return the unit vectors right, up and forward of a horizontal view as rows, [3, 3].

    Columns are x east, y north, z up. azimuth_deg : azimuth of the view, clockwise from north.
    """
    forward = projection.direction(0.0, azimuth_deg)
    right = projection.direction(0.0, azimuth_deg + 90.0)
    return np.stack([right, np.cross(right, forward), forward])


def angles_from_view(rays: Floats, frame: Floats) -> tuple[Floats, Floats, Floats]:
    """Return each ray's coordinates right and up [rad], and the cosine of its angle to the view.

    rays : [..., 3] unit vectors (x east, y north, z up). frame : [3, 3], by `view_frame`. The
    length of (right, up) is the angle between ray and line of sight, as in a Radiance picture with
    -vta. The cosine is negative behind the observer. Each result has the shape [...].
    """
    x, y, z = np.moveaxis(rays @ frame.T, -1, 0)
    off = np.hypot(x, y)
    angle = np.arctan2(off, z)
    stretch = np.divide(angle, off, out=np.ones_like(off), where=off > 1e-12)
    return x * stretch, y * stretch, z


def position_index(right_rad: ArrayLike, up_rad: ArrayLike) -> Floats:
    """Return the position index P [...]: 1 on the line of sight, greater off it, at most 16.

    right_rad, up_rad : coordinates by `angles_from_view` [...]. Above the line of sight it is
    Guth's (IES Lighting Handbook), below it that of Iwata and Osterhaus 2010 in CIE coordinates.
    evalglare has used these forms since version 3.02.
    """
    right, up = np.asarray(right_rad, float), np.asarray(up_rad, float)
    angle = np.hypot(right, up)
    # Guth's angles in degrees: sigma from the line of sight, tau from the vertical
    sigma = np.degrees(angle)
    tau = np.degrees(np.arctan2(np.abs(right), np.abs(up)))
    linear = (35.2 - 0.31889 * tau - 1.22 * np.exp(-2.0 * tau / 9.0)) / 1000.0
    square = (21.0 + 0.26667 * tau - 0.002963 * tau**2) / 100_000.0
    above = np.exp(linear * sigma + square * sigma**2)
    wider = np.sqrt(1.0 + 0.3225 * np.cos(np.radians(tau)) ** 2)
    slope = np.tan(np.minimum(angle, np.pi / 2 - 1e-6)) * wider
    beta = np.degrees(np.arctan(slope))
    below = np.exp(6.49e-3 * beta + 21e-5 * beta**2)
    return np.minimum(np.where(up < 0.0, below, above), MAX_POSITION_INDEX)


@dataclass(frozen=True, slots=True)
class Views:
    """The weights of each pixel of a picture of P pixels for each of d view directions.

    A panorama has any number of horizontal directions, another picture its own one. azimuths_deg :
    [d] the view directions, clockwise from north. frames : [d, 3, 3] unit vectors right, up and
    forward of each as rows (x east, y north, z up). illuminance : [P, d] solid angle times cosine
    to the view direction, sr; its product with a flat map is Ev. moments : [P, 3, d] solid angle,
    sr, and this times the pixel's coordinates right and up by `angles_from_view`, sr rad.
    illuminance and moments are 0 behind the observer and for pixels that no lens saw. ahead : [P,
    d] True for pixels with a weight whose centre is in front. hemisphere : [5, d] sums over the
    complete hemisphere in front: of illuminance, of the three moments, and of solid angle over
    squared position index. is_panorama : False for another picture.
    """

    azimuths_deg: Floats
    frames: Floats
    illuminance: Floats32
    moments: Floats32
    ahead: Mask
    hemisphere: Floats
    is_panorama: bool = True

    def rays(self, pixels: Ints64 | slice = slice(None)) -> tuple[Floats, Floats]:
        """Return unit vectors (right, up, forward) [n, 3, d] and solid angles [n, d] of n pixels.

        pixels : flat indices of the pixels, or a slice; by default all. Solid angles are in sr; a
        vector has a meaning only if its pixel's solid angle is above 0.
        """
        omega, right, up = np.moveaxis(self.moments[pixels], 1, 0)
        right, up = right / np.maximum(omega, 1e-30), up / np.maximum(omega, 1e-30)
        angle = np.hypot(right, up)
        ratio = np.sinc(angle / np.pi)  # sin(angle) / angle
        return np.stack([right * ratio, up * ratio, np.cos(angle)], axis=1), omega


def panorama_views(
    height: int, width: int, heading_deg: float, azimuths_deg: ArrayLike, seen: Mask | None = None
) -> Views:
    """Return `Views` of a panorama: its pixels' weights in d view directions, for all hours.

    height, width : size of the panorama in pixels; heading_deg : azimuth of its centre column;
    azimuths_deg : [d] view directions; azimuths are clockwise from north. seen : pixels that a lens
    saw [H, W]; None for all. The weights need 16 bytes of memory for each pixel and direction.
    """
    azimuths = np.atleast_1d(np.asarray(azimuths_deg, float))
    rays = projection.equirect_rays(height, width, heading_deg).reshape(-1, 3)
    omega = projection.equirect_solid_angles(height, width).ravel()
    is_seen = 1.0 if seen is None else seen.ravel()
    # for each pixel and direction: illuminance weight, solid angle, its moments right and up
    pixels = np.empty((len(rays), 4, len(azimuths)), np.float32)
    frames = np.stack([view_frame(azimuth) for azimuth in azimuths])
    hemisphere = np.empty((5, len(azimuths)))
    # A uniform hemisphere must give exactly pi, but the cosine in the middle of a pixel is slightly
    # larger than its mean over the pixel. The factor is that of a view to the south, minus y.
    south = -projection.equirect_rays(height, width, 180.0).reshape(-1, 3)[:, 1]
    closure = float(np.pi / (omega @ np.clip(south, 0.0, None)))
    for i, frame in enumerate(frames):
        right, up, cosine = angles_from_view(rays, frame)
        facing_sr = omega * (cosine > 0)
        weights = facing_sr * np.stack([cosine * closure, np.ones_like(up), right, up])
        hemisphere[:4, i] = weights.sum(axis=1)
        hemisphere[4, i] = (facing_sr / position_index(right, up) ** 2).sum()
        pixels[:, :, i] = (weights * is_seen).T
    return Views(azimuths, frames, pixels[:, 0], pixels[:, 1:], pixels[:, 1] > 0.0, hemisphere)


# ----------------------------------------------------------------------------------------------
# glare sources

# evalglare's defaults: -b 2000, -Y 50000, -r 0.2 (its search angle is twice this distance).
SOURCE_CDM2 = 2000.0
PEAK_CDM2 = 50_000.0
REACH_RAD = 0.1


def widen(mask: Mask, radius_rad: float) -> Mask:
    """Return a mask [H, W], True for panorama pixels within `radius_rad` of a True pixel of `mask`.

    mask : [H, W = 2H]. Distances are angles on the sphere, also across the panorama's seam.
    """
    return _widened(mask, _half_widths(len(mask), radius_rad))


@compiled
def _widened(mask: Mask, half: Indices) -> Mask:
    """Return a mask [H, W], True within the circles of `_half_widths` around True pixels of `mask`.

    half [k, H]: result of `_half_widths`.
    """
    height, width = mask.shape
    out = np.zeros_like(mask)
    for row in range(height):
        for column in range(width):
            if mask[row, column]:
                for k in range(len(half)):
                    other = row + len(half) // 2 - k
                    reach = half[k, other] if 0 <= other < height else -1
                    for step in range(-reach, reach + 1):
                        out[other, (column + step) % width] = True
    return out


@lru_cache(maxsize=8)
def _half_widths(height: int, radius_rad: float) -> Indices:
    """Return half the width of circles around pixels, in columns, by the haversine formula, [k, H].

    The last axis is the row of the centre, in a panorama of H = `height` rows. The first axis is
    the row in which the width is measured, from the highest of k rows to the lowest; the centre's
    row is the middle one. -1 where the circle does not reach, or no row exists. radius_rad: of the
    circles.
    """
    reach = max(1, round(radius_rad / np.pi * height))
    altitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    row = np.arange(height)
    other = row + np.arange(-reach, reach + 1)[:, None]
    near = np.clip(other, 0, height - 1)
    rest = np.sin(radius_rad / 2) ** 2 - np.sin((altitude[near] - altitude[row]) / 2) ** 2
    sine_squared = np.clip(rest / (np.cos(altitude[near]) * np.cos(altitude[row])), 0.0, 1.0)
    half = np.floor(np.arcsin(np.sqrt(sine_squared)) / np.pi * 2 * height).astype(np.intp)
    return np.where((rest >= 0.0) & (other == near), np.minimum(half, height), -1)


def group_pixels(mask: Mask) -> Ints32:
    """Return the number of the glare source of each pixel, from 1, [H, W]; 0 outside `mask`.

    mask : [H, W = 2H] of a panorama, True for bright pixels. Pixels closer than 0.1 rad belong to
    one source. Numbers can be missing between the first and the last.
    """
    from scipy.ndimage import label

    labels = np.zeros(mask.shape, np.int32)
    label(widen(mask, REACH_RAD / 2), structure=np.ones((3, 3)), output=labels)
    return np.where(mask, _joined_at_seam(labels), 0).astype(np.int32)


def _joined_at_seam(labels: Ints32) -> Ints32:
    """Return the labels [H, W] with one number for sources that meet at the seam or a pole.

    labels [H, W]: number of the source of each pixel, 0 for none. The seam is between the last and
    the first column of the panorama; all pixels of the first row meet at the zenith, those of the
    last row at the nadir.
    """
    if labels.max() < 2:
        return labels
    left, right = labels[:, 0], labels[:, -1]
    pairs = [(left, right), (left[1:], right[:-1]), (left[:-1], right[1:])]
    pairs += [(row, np.full_like(row, row.max())) for row in (labels[0], labels[-1])]
    number = np.arange(labels.max() + 1, dtype=np.int32)
    for pair in set(zip(*np.concatenate(pairs, axis=1).tolist(), strict=True)):
        if all(pair):
            number[np.isin(number, number[list(pair)])] = number[list(pair)].min()
    return number[labels]


class Sources(NamedTuple):
    """The s glare sources of a picture in d view directions, [s, d] each.

    mean_cdm2 : mean luminance; solid_angle_sr : the part in front of the observer; right_rad,
    up_rad : coordinates of the centre by `angles_from_view`; ev_lx : vertical illuminance from the
    source. pixels : for each source an array of the flat indices of its pixels.
    """

    mean_cdm2: Floats
    solid_angle_sr: Floats
    right_rad: Floats
    up_rad: Floats
    ev_lx: Floats
    pixels: list[Ints64]

    @property
    def contrast(self) -> Floats:
        """L^2 omega / P^2 of each source, [s, d]: what it adds to `contrast` in `metrics.dgp`."""
        index = position_index(self.right_rad, self.up_rad)
        return self.mean_cdm2**2 * self.solid_angle_sr / index**2


def glare_sources(luminance_cdm2: Floats, views: Views) -> Sources:
    """Return the glare sources of a picture [H, W] cd/m2 with the weights `views`.

    The centre of a source is the mean of its pixels' coordinates, weighted by their light.
    """
    pixels = sources_of(luminance_cdm2, None if views.is_panorama else views)
    chosen = np.concatenate([np.zeros(0, np.int64), *pixels])
    starts = np.cumsum([0, *map(len, pixels)])[:-1]
    bright = luminance_cdm2.ravel()[chosen].astype(float)[:, None]

    def total(values: Floats) -> Floats:
        """Return the sum of values over the pixels of each of the s sources, [s, d].

        values : of the n pixels of all sources, in the order of `chosen`, [n, d].
        """
        return np.add.reduceat(values, starts, axis=0, dtype=float)

    omega, right_moment, up_moment = np.moveaxis(views.moments[chosen], 1, 0)  # [n, d] each
    power, area = np.maximum(total(bright * omega), 1e-30), total(omega)
    mean_cdm2, ev_lx = power / np.maximum(area, 1e-30), total(bright * views.illuminance[chosen])
    right, up = total(bright * right_moment) / power, total(bright * up_moment) / power
    return Sources(mean_cdm2, area, right, up, ev_lx, pixels)


def sources_of(luminance_cdm2: Floats, views: Views | None = None) -> list[Ints64]:
    """Return an array of flat pixel indices for each glare source of a picture [H, W] in cd/m2.

    views : weights of a picture that is no panorama; pixels without a weight are no source. Pixels
    above 2000 cd/m2 that are closer than 0.1 rad form one source. Pixels from 50 000 cd/m2 on
    (peaks) form sources of their own, which come last. The list is empty without bright pixels.
    """
    bright, shape = luminance_cdm2 > SOURCE_CDM2, luminance_cdm2.shape
    if views is not None:
        bright &= views.moments[:, 0, 0].reshape(shape) > 0.0
    pixels = np.flatnonzero(bright)
    if len(pixels) == 0:
        return []
    cells = np.stack(np.unravel_index(pixels, shape))
    if views is not None:
        # Other pictures are grouped on a panorama of their directions with pixels of 0.25 degrees,
        # a twentieth of the distance within which they form one source. Chosen.
        shape = (720, 1440)
        rays = views.rays(pixels)[0][:, [0, 2, 1], 0]  # right, forward, up
        place = projection.altitude_azimuth_deg(rays)
        cells = np.stack(projection.equirect_pixel(*place, *shape, 0.0)).astype(int)
    row, column = np.clip(cells, 0, np.array(shape)[:, None] - 1)

    def groups(chosen: Mask) -> Ints32:
        """Return the number of the source of each bright pixel, from 1, [n].

        chosen : mask [n] of the bright pixels that form the sources; the numbers of the others have
        no meaning.
        """
        mask = np.zeros(shape, bool)
        mask[row[chosen], column[chosen]] = True
        return group_pixels(mask)[row, column]

    number = groups(np.ones(len(pixels), bool))
    peaks = luminance_cdm2.ravel()[pixels] >= PEAK_CDM2
    if peaks.any():
        number = np.where(peaks, groups(peaks) + number.max(), number)
    order = np.argsort(number, kind="stable")
    return np.split(pixels[order], np.flatnonzero(np.diff(number[order])) + 1)
