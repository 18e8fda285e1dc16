"""Project merged sensors onto one map: resampling, vignetting, colour, blending, uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask, UInts8
from fieldlum.core.progress import progress
from fieldlum.core.records import U_PERCENT, VEILING_GLARE, Flag, Panorama
from fieldlum.merge.sensor_frames import SensorImage
from fieldlum.optics import camera_curves, images, linear_light, melanopic, stray_light
from fieldlum.optics.profiles import CameraProfile, Lens
from fieldlum.optics.projection import Equirect, LensGeometry, Target, lens_pixels, wrapped


class Resampler(NamedTuple):
    """How the pixels of a target grid are weighted means of the pixels of a sensor.

    matrices: by colour, scipy.sparse.csr_array of float32 [target pixels, sensor pixels]; a row
    sums to 1, or to 0 where the sensor sees nothing. coverage [target pixels]: share of a pixel's
    solid angle that is on the sensor inside the lens. angle_rad [target pixels]: mean angle from
    the optical axis of that part.
    """

    matrices: dict[str, Any]
    coverage: Floats32
    angle_rad: Floats32


# Row and column of the origin, of a step right and of a step down. The pixels of a colour are at
# origin + p right + q down, with integers p and q.
_Lattice = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]


def _lattice(cfa: str, colour: str) -> _Lattice:
    """Return the lattice of the sensor pixels of a colour ("R", "G" or "B").

    cfa: colours of the mosaic's 2 x 2 cell, row by row; "" for a sensor with all colours at every
    pixel.
    """
    places = [divmod(i, 2) for i, letter in enumerate(cfa) if letter == colour] or [(0, 0)]
    if len(places) == 2:  # green: at 45 degrees
        return places[0], (1, 1), (-1, 1)
    step = 2 if cfa else 1
    return places[0], (0, step), (step, 0)


class _Samples(NamedTuple):
    """Directions within some target pixels that the sensor sees inside the lens, [n] each.

    pixel: number of the target pixel, from the first of these rows; x, y: place on the sensor [px];
    share: of the solid angle of that pixel's samples. coverage [pixels]: share of the solid angle
    of each target pixel that is on the sensor inside the lens; angle_rad [pixels]: mean angle of
    that part from the optical axis.
    """

    pixel: Indices
    x: Floats
    y: Floats
    share: Floats
    coverage: Floats
    angle_rad: Floats


def _samples(
    target: Target,
    lens: LensGeometry,
    sensor_shape: tuple[int, int],
    rows: tuple[int, int],
    sub: int,
    margin_px: float,
) -> _Samples:
    """Return the points in the pixels of some target rows that the sensor sees, with their weights.

    A target pixel becomes the weighted mean of the sensor at its n points, which are on a grid of
    `sub` rows in each pixel. sensor_shape: rows and columns of the sensor; rows: the first one of
    the target, and the one after the last; sub: samples down a pixel (near the poles meridians
    converge, and fewer across suffice). margin_px: distance from the circle and from the sensor's
    edge that keeps all four neighbours of a sample inside.
    """
    (first, last), width, across = rows, target.shape[1], sub
    # Samples along an edge are a multiple of the edge's cells, which are at most half a degree
    # (0.009 rad) wide, so that large pixels have enough samples.
    cells = max(1, int(np.ceil(target.pixel_rad / 0.009)))
    if isinstance(target, Equirect):
        # zenith angles of these rows' upper and lower edge; a pixel is widest at the horizon
        top, bottom = (np.array(rows, float) + target.corner[0]) / target.height * np.pi
        widest = np.sin(np.clip(np.pi / 2.0, top, bottom))
        across = max(3, int(np.ceil(sub * widest)))
    sub, across = (-(-count // cells) * cells for count in (sub, across))  # rounded up
    down = first + (np.arange((last - first) * sub) + 0.5) / sub  # places in rows of the target
    along = (np.arange(width * across) + 0.5) / across  # places in columns
    x, y, angle = lens_pixels(lens, target.rays(down, along))  # [down, along] each
    weight = target.weight(down, along)
    reach = np.hypot(x - lens.centre_px[0], y - lens.centre_px[1])
    # Some polynomials fall again beyond the edge: the angle leaves their mirror image out.
    seen = (weight > 0) & (reach <= lens.radius_px - margin_px) & (angle <= lens.half_angle_rad)
    seen &= (x >= margin_px) & (x < sensor_shape[1] - margin_px)
    seen &= (y >= margin_px) & (y < sensor_shape[0] - margin_px)
    at = np.flatnonzero(seen)
    row, column = np.divmod(at, width * across)
    pixel, pixels = np.asarray(row // sub * width + column // across), (last - first) * width
    seen_weight = weight.ravel()[at]
    total = np.bincount(pixel, seen_weight, pixels)  # what is seen of each target pixel
    full = weight.reshape(last - first, sub, width, across).sum(axis=(1, 3)).ravel()
    share = seen_weight / total[pixel]
    return _Samples(
        pixel,
        x=x.ravel()[at],
        y=y.ravel()[at],
        share=share,
        coverage=total / np.maximum(full, 1e-30),
        angle_rad=np.asarray(np.bincount(pixel, share * angle.ravel()[at], pixels), float),
    )


def _matrix(samples: _Samples, lattice: _Lattice, sensor_shape: tuple[int, int]) -> Any:
    """Return the matrix of one colour, which distributes each sample bilinearly over four pixels.

    lattice: of the colour's pixels; sensor_shape: rows and columns. The matrix is CSR [target
    pixels, sensor pixels]. A sample is p steps right and q steps down from the lattice's origin.
    """
    origin, right, down = lattice
    x, y = samples.x - (origin[1] + 0.5), samples.y - (origin[0] + 0.5)
    if right[0]:
        p, q = (x + y) / 2.0, (x - y) / 2.0
    else:
        p, q = x / right[1], y / down[0]
    first_p, first_q = np.floor(p).astype(np.int32), np.floor(q).astype(np.int32)
    share_p, share_q = p - first_p, q - first_q
    values, columns = [], []
    for at_p, weight_p in ((first_p, 1.0 - share_p), (first_p + 1, share_p)):
        for at_q, weight_q in ((first_q, 1.0 - share_q), (first_q + 1, share_q)):
            row = origin[0] + at_p * right[0] + at_q * down[0]
            column = origin[1] + at_p * right[1] + at_q * down[1]
            values.append((samples.share * weight_p * weight_q).astype(np.float32))
            columns.append(row * sensor_shape[1] + column)
    shape = (len(samples.coverage), sensor_shape[0] * sensor_shape[1])
    places = (np.tile(samples.pixel.astype(np.int32), 4), np.concatenate(columns))
    return sparse.coo_array((np.concatenate(values), places), shape).tocsr()


def _samples_per_pixel(target: Target, lens: LensGeometry, spacing_px: float) -> int:
    """Return how many samples along one edge of a target pixel are needed, 3 to 24.

    spacing_px: distance of sensor pixels of one colour. Unless more than 24 were needed, none of
    these pixels is between two samples, and energy is preserved within 0.35 % (docs/validation.md).
    """
    half = lens.half_angle_rad
    most_px_per_rad = lens.radius_px * max(1.0 / np.sin(min(half, np.pi / 2)), 1.0 / half)
    needed = np.ceil(most_px_per_rad * target.pixel_rad / (1.1 * spacing_px))
    return int(np.clip(needed, 3, 24))


# A raw camera needs 1 MB for each block of 36 square degrees of its sky cut. Chosen for 200 blocks.
@lru_cache(maxsize=224)
def resampler(
    target: Target, lens: LensGeometry, sensor_shape: tuple[int, int], cfa: str = ""
) -> Resampler:
    """Return the matrices from the pixels of a sensor behind `lens` to those of `target`.

    sensor_shape: its rows and columns; cfa: colours of the mosaic's 2 x 2 cell, row by row, or ""
    for a sensor with all colours at every pixel, which has one matrix with the name "". The result
    is cached, because all brackets of a camera use it.
    """
    sub = _samples_per_pixel(target, lens, 2.0**0.5 if cfa else 1.0)  # green pixels are densest
    height, width = target.shape
    # samples that fit the cache of a core; decides speed only
    step = max(1, 250_000 // (width * sub * sub))
    blocks: dict[str, list[Any]] = {colour: [] for colour in sorted(set(cfa)) or [""]}
    of_pixels = []
    for first in range(0, height, step):
        progress(first, height, "projecting rows")
        rows = (first, min(first + step, height))
        samples = _samples(target, lens, sensor_shape, rows, sub, 1.5 if cfa else 0.75)
        of_pixels.append((samples.coverage, samples.angle_rad))
        for colour, matrices in blocks.items():
            matrices.append(_matrix(samples, _lattice(cfa, colour), sensor_shape))
    matrices = {colour: sparse.vstack(parts, format="csr") for colour, parts in blocks.items()}
    coverage, angle_rad = np.concatenate(of_pixels, axis=1).astype(np.float32)
    return Resampler(matrices, coverage, angle_rad)


# Share of a target pixel's weight that must have a flag before the target pixel gets the flag. For
# clipping nearly any share suffices, because the pixel is then a lower bound. The other shares are
# chosen, not measured.
_SHARE = {Flag.CLIPPED_HIGH: 1e-3, Flag.BLOOM: 0.05, Flag.MOTION: 0.25, Flag.ND: 0.25}
_SPOILT = Flag.CLIPPED_HIGH | Flag.BLOOM | Flag.MOTION
# Most light that leaks over an edge, in sensor pixels: mean half-width of a pixel's square and of
# bilinear resampling. Resampling reaches two pixels where each colour has its own pixels, one pixel
# where every pixel sees all colours.
_LEAK_PX = {"raw": 0.35, "jpeg": 0.20}


@dataclass(frozen=True, slots=True)
class ProjectedImage:
    """What the lenses see of the target; arrays [n] over its pixels, row by row.

    luminance [cd/m2]; rgb [n, 3]: luminance by each colour of the camera. variance: of the
    luminance's random error [(cd/m2)^2]. coverage: share (0 to 1) of the pixel that a lens sees.
    u_vignetting, u_ratio: relative standard uncertainties of the luminance due to vignetting and to
    the exposures. flags: `Flag` bits. u_stray: standard uncertainty of the stray light that was
    subtracted [cd/m2].
    """

    luminance: Floats
    variance: Floats
    coverage: Floats
    u_vignetting: Floats
    u_ratio: Floats
    flags: UInts8
    rgb: Floats
    u_stray: Floats


@dataclass(frozen=True, slots=True)
class LensView(ProjectedImage):
    """What one lens sees of the target.

    edge [n]: factor on its weight near its edge, 0.01 at the edge, 1 from 0.06 rad inside it.
    sensor: merged frames of one heading; lens: the lens of the sensor's profile. stray [n]: stray
    light that was subtracted [cd/m2]; None if the profile has none.
    """

    edge: Floats
    lens: Lens
    sensor: SensorImage
    stray: Floats | None = None


def _project(sensor: SensorImage, resampling: Resampler) -> tuple[Floats, Floats, UInts8]:
    """Return camera RGB [n, 3], its random variance [n, 3] and the flags [n] of one lens.

    resampling: of the lens, with a matrix for each colour of a mosaic, or one with the name "" for
    a JPEG. Only the sensor pixels of the matrices are read, so that a small target costs little.
    """
    merged, colours = sensor.merged, 3 if "" in resampling.matrices else 1  # of a sensor pixel
    value, variance = (a.reshape(-1, colours) for a in (merged.value_cdm2, merged.variance))
    of_sensor = merged.flags.reshape(-1, colours)
    rgb, rgb_variance, pixels = [], [], len(resampling.coverage)
    flags = np.zeros(pixels, np.uint8)  # those of bad pixels may count, which is harmless
    for name in "RGB" if colours == 1 else ("",):
        matrix = resampling.matrices[name]
        weights, share = sparse.csr_array(matrix), np.float32(1.0)
        row = np.repeat(np.arange(pixels), np.diff(matrix.indptr))  # of each entry of the matrix
        if sensor.good is not None:  # scale the weights of each row without its bad pixels to 1
            good = sensor.good.ravel()[matrix.indices]
            lost = _row_sums(matrix.data, row, ~good, pixels)
            share = np.maximum(1.0 - lost, 1e-6).astype(np.float32)[:, None]
            # a pixel without a good sensor pixel of some colour has no value
            flags[(share[:, 0] < 0.05) & (resampling.coverage > 0)] |= np.uint8(Flag.FILLED)
            weights.data = matrix.data * good
        rgb.append(weights @ value / share)
        weights.data = weights.data**2
        rgb_variance.append(weights @ variance / share**2)
        raised = np.asarray(of_sensor[:, 0][matrix.indices], np.uint8)
        for colour in range(1, colours):
            raised |= of_sensor[matrix.indices, colour]
        present = int(np.bitwise_or.reduce(raised, initial=0))
        for flag, minimum in _SHARE.items():
            if present & flag:
                marked = _row_sums(matrix.data, row, raised & np.uint8(flag), pixels)
                flags[marked > minimum] |= np.uint8(flag)
    return np.hstack(rgb).astype(np.float64), np.hstack(rgb_variance).astype(np.float64), flags


def _row_sums(data: Floats32, row: Indices, chosen: Array, rows: int) -> Floats:
    """Return the sum of the chosen entries in each row of a sparse matrix, [rows].

    data, row, chosen [entries]: value, row number and choice of each entry; rows: their number.
    """
    at = np.flatnonzero(chosen)
    return np.asarray(np.bincount(row[at], data[at], rows), np.float64)


def view_through(
    sensor: SensorImage, lens: Lens, target: Target, stray: Floats | None = None
) -> LensView:
    """Return what one lens sees of the target grid, corrected for vignetting and stray light.

    sensor: merged frames of one heading; lens: one of the sensor's profile. stray: stray light of
    each target pixel [n]; None to compute it from what the target shows, which must be the lens's
    complete field. Pixels that the lens does not see have coverage 0. Raises InputError if the lens
    has no vignetting curve for the frames' aperture.
    """
    profile, geometry = sensor.profile, sensor.geometry(lens)
    cfa = profile.sensor.cfa if profile.camera.kind == "raw" else ""
    resampling = resampler(target, geometry, (sensor.crop.height, sensor.crop.width), cfa)
    rgb, variance, flags = _project(sensor, resampling)
    weights = np.asarray(profile.colour.y_from_rgb)
    parts = np.maximum(rgb * weights, 0.0) + 1e-30  # of the colours in the luminance, [n, 3]
    u_ratio = (parts * sensor.u_curve(rgb)).sum(axis=1) / parts.sum(axis=1)
    coefficients, u_at_edge = linear_light.vignetting_of(lens, sensor.f_number)
    angle = resampling.angle_rad.astype(np.float64)
    vignetting = camera_curves.vignetting_at(coefficients, angle / geometry.half_angle_rad)
    loss_at_edge = max(1.0 - float(camera_curves.vignetting_at(coefficients, 1.0)), 1e-9)
    u_vignetting = u_at_edge * np.clip((1.0 - vignetting) / loss_at_edge, 0.0, 1.0)
    rgb, variance = rgb / vignetting[:, None], variance / vignetting[:, None] ** 2
    # a lens fades out in a rim of 0.06 rad if another lens sees the same directions
    edge = np.clip((geometry.half_angle_rad - angle) / 0.06, 0.01, 1.0)
    coverage = resampling.coverage.astype(np.float64)
    light = rgb @ weights
    if stray is None and profile.stray.angle_deg:
        stray = _stray_of_lens(light, coverage > 0, profile, target)
    remaining, u_stray = light, np.zeros(len(rgb))
    if stray is not None:
        remaining, u_stray = np.maximum(light - stray, 0.0), profile.stray.u_rel * stray
        rgb = rgb * (remaining / np.maximum(light, 1e-12))[:, None]
    return LensView(
        luminance=remaining,
        variance=variance @ weights**2,
        coverage=coverage,
        edge=edge,
        u_vignetting=u_vignetting,
        u_ratio=u_ratio,
        flags=flags,
        rgb=rgb,
        u_stray=u_stray,
        lens=lens,
        sensor=sensor,
        stray=stray,
    )


def _stray_of_lens(
    light: Floats, seen_mask: Mask, profile: CameraProfile, target: Target
) -> Floats:
    """Return the stray light [n] in cd/m2 that the light within a lens's field causes.

    light [n]: recorded luminance [cd/m2] of the target's pixels, row by row; seen_mask [n]: True
    for those that the lens sees.
    """
    rays = target.rays(*(np.arange(count) + 0.5 for count in target.shape)).reshape(-1, 3)
    kernel = (np.asarray(profile.stray.angle_deg), np.asarray(profile.stray.per_sr))
    seen = np.where(seen_mask, light, 0.0)
    return stray_light.stray_cdm2(seen, target.solid_angles().ravel(), rays, *kernel)


def blend(views: Sequence[LensView]) -> ProjectedImage:
    """Return for each pixel the inverse-variance mean over the views that see it.

    views: of one lens at one heading each, on the same target. The vignetting's share of a variance
    uses the mean luminance of all views, because each view's own would favour the darker view. A
    view fades out towards the edge of its lens. A view's pixel with the flag CLIPPED_HIGH, BLOOM or
    MOTION has little weight. Pixels that no view sees get only the flag OUTSIDE_LENS.
    """
    names = ("coverage", "luminance", "variance", "edge", "u_vignetting", "u_ratio", "u_stray")
    coverage, luminance, variance, edge, u_vignetting, u_ratio, u_stray = (
        np.stack([getattr(view, name) for view in views]) for name in names
    )
    flags = np.stack([view.flags for view in views])
    seen = coverage.sum(0)
    common = np.divide(
        (coverage * luminance).sum(0), seen, out=np.zeros(len(seen)), where=(coverage > 0).any(0)
    )
    # 1e-4 of the luminance limits the weight of a view that has hardly any noise
    total_variance = variance + (u_vignetting * common) ** 2 + (1e-4 * common) ** 2 + 1e-12
    weight = np.where(coverage > 0, coverage * edge / total_variance, 0.0)
    weight = np.where((flags & _SPOILT) > 0, weight * 1e-6, weight)
    total = weight.sum(0)
    share = np.divide(weight, total, out=np.zeros_like(weight), where=total > 0)
    blended = np.bitwise_or.reduce(np.where(share > 0.05, flags, 0).astype(np.uint8), axis=0)
    blended[seen < 1e-3] = Flag.OUTSIDE_LENS
    by_lens: dict[Lens, Floats] = {}  # one curve for all headings of a lens
    for view, of_lens in zip(views, share * u_vignetting, strict=True):
        by_lens[view.lens] = by_lens.get(view.lens, 0.0) + of_lens
    return ProjectedImage(
        luminance=(share * luminance).sum(0),
        variance=(share**2 * variance).sum(0),
        coverage=coverage.max(0),
        u_vignetting=np.sqrt(sum(u**2 for u in by_lens.values())),
        u_ratio=(share * u_ratio).sum(0),  # linearly, because all lenses share one shutter
        flags=blended,
        rgb=(share[..., None] * np.stack([view.rgb for view in views])).sum(0),
        u_stray=(share * u_stray).sum(0),  # linearly, because all lenses share one kernel
    )


def finished_map(
    view: ProjectedImage,
    profile: CameraProfile,
    target: Target,
    *,
    heading_deg: float = 180.0,
    t_utc: datetime | None = None,
) -> Panorama:
    """Return the finished map with its flags and its uncertainty (GUM).

    view: result of `blend`. heading_deg: azimuth of the map's centre, clockwise from true north.
    t_utc: time of the picture, None if unknown. With the luminance L and relative uncertainties in
    brackets after L^2, the uncertainty u is u^2 = random^2 + L^2 (exposure^2 + response^2 +
    vignetting^2 + colour^2 + k^2) + (glare floor)^2 + (stray light)^2 + edges^2. The uncertainty of
    a filter is part of the exposure's. The glare floor is a share of the mean luminance that is
    seen. A clipped pixel is a lower bound with an uncertainty of 100 % or more.
    bench/merge_budget.py compares u with simulated cameras; bench/merge_scene.py compares the part
    for edges with a scene.
    """
    light, colour = view.luminance, profile.colour
    in_lens = (view.flags & Flag.OUTSIDE_LENS) == 0
    relative2 = view.u_ratio**2 + linear_light.curve_u_rel(profile) ** 2 + view.u_vignetting**2
    relative2 = relative2 + colour.u_rel**2 + profile.scale.u_rel**2
    solid_sr = target.solid_angles().ravel() * in_lens
    mean_cdm2 = float((light * solid_sr).sum() / max(solid_sr.sum(), 1e-12))
    floor = profile.glare_floor_rel * mean_cdm2
    shape = target.shape
    edges = u_of_edges(light.reshape(shape), in_lens.reshape(shape), target, profile).ravel()
    u = np.sqrt(view.variance + light**2 * relative2 + floor**2 + view.u_stray**2 + edges**2)
    u = np.where(view.flags & Flag.CLIPPED_HIGH, np.maximum(u, np.abs(light)), u)
    flags = view.flags.astype(np.uint16)
    quiet = (view.flags & Flag.MOTION) == 0  # the variance of disagreeing frames is not noise
    flags[in_lens & quiet & (light < np.sqrt(view.variance))] |= np.uint16(Flag.BELOW_NOISE)
    attributes, rgb = images.calibration_mark(profile), None
    attributes[U_PERCENT] = _shared_percents(view, np.maximum(light, 0.0) * solid_sr, profile)
    if colour.rgb_to_radiance:
        matrix = np.reshape(colour.rgb_to_radiance, (3, 3))
        rgb = _radiance_rgb(view.rgb @ matrix.T, light).reshape(*shape, 3)
        if colour.melanopic_from_rgb:
            weights = np.array(colour.melanopic_from_rgb)
            text = melanopic.attribute_text(weights, matrix, colour.melanopic_u_rel)
            attributes[melanopic.ATTRIBUTE] = text
    return Panorama(
        luminance_cdm2=light.reshape(shape).astype(np.float32),
        heading_deg=heading_deg,
        u_cdm2=u.reshape(shape).astype(np.float32),
        flags=flags.reshape(shape),
        t_utc=t_utc,
        rgb=rgb,
        attributes=attributes,
    )


def _shared_percents(view: ProjectedImage, weight: Floats, profile: CameraProfile) -> str:
    """Return the map's mean uncertainties by cause, in % of the luminance, as "scale=2 colour=1".

    Only causes that all pixels have in common are listed. weight [n]: luminance times solid angle.
    """

    def mean(u_rel: Floats) -> float:
        """Return the mean of relative uncertainties [n], weighted by the light."""
        return float((weight * u_rel).sum() / max(weight.sum(), 1e-12))

    shared = {
        "scale": profile.scale.u_rel,
        "colour": profile.colour.u_rel,
        "response": linear_light.curve_u_rel(profile),
        "exposures": mean(view.u_ratio),
        "vignetting": mean(view.u_vignetting),
        VEILING_GLARE: profile.glare_floor_rel,
    }
    return " ".join(f"{name}={100 * u_rel:.4g}" for name, u_rel in shared.items())


def footprint_px(lens: LensGeometry, target: Target) -> float:
    """Return how many sensor pixels wide a target pixel is, averaged over the field, at least 1."""
    return max(1.0, lens.radius_px / lens.half_angle_rad * target.pixel_rad)


def u_of_edges(light: Floats, seen_mask: Mask, target: Target, profile: CameraProfile) -> Floats:
    """Return the uncertainty of a pixel due to light leaking from its neighbours, [H, W] cd/m2.

    light: luminance [H, W]; seen_mask [H, W]: True where a lens sees the pixel. Sensor pixels are
    not small. An edge on the border of two target pixels leaks at most a share of the luminance
    difference: 0.35 (raw) or 0.2 (JPEG) sensor pixels over the target pixel's width. An edge
    elsewhere leaks less. This is a rectangular distribution (GUM 4.3.7). On a uniform slope gains
    and losses cancel, so the second difference is used. Next to pixels that no lens sees the leak
    is unknown and counts as zero.
    """
    width_px = min(footprint_px(lens, target) for lens in profile.lens)
    share = min(_LEAK_PX[profile.camera.kind] / width_px, 0.5) / np.sqrt(3.0)
    down = _second_difference(light, seen_mask)
    if not isinstance(target, Equirect):
        return share * np.hypot(down, _second_difference(light.T, seen_mask.T).T)
    rows = (np.arange(target.height) + 0.5) / target.height * np.pi
    # target pixels narrow towards the zenith
    narrow = np.minimum(share / np.sin(rows), 0.5 / np.sqrt(3.0))[:, None]
    around = _second_difference(wrapped(light).T, wrapped(seen_mask).T).T[:, 1:-1]
    return np.hypot(share * down, narrow * around)


def _second_difference(light: Floats, seen_mask: Mask) -> Floats:
    """Return the second difference of the luminance along the columns, [H, W].

    A step to or from a pixel that no lens sees counts as zero.
    """
    step = np.pad(np.diff(light, axis=0) * (seen_mask[1:] & seen_mask[:-1]), ((1, 1), (0, 0)))
    return np.diff(step, axis=0)


def _radiance_rgb(colour: Floats, light: Floats) -> Floats32:
    """Return radiance RGB [n, 3] in W/sr/m2, scaled for each pixel to give the luminance.

    colour [n, 3]: RGB of Radiance in any unit; light [n]: luminance [cd/m2]. Radiance computes it
    as 179 (.265 R + .670 G + .065 B). Pixels whose colour makes this impossible are grey.
    """
    positive = np.maximum(colour, 0.0)
    own_y = (positive @ np.asarray(images.RADIANCE_Y))[:, None]
    scale = np.divide(light[:, None], own_y, out=np.ones_like(own_y), where=own_y > 1e-12)
    rgb = np.where(own_y > 1e-12, positive * scale, light[:, None]) / images.RADIANCE_LM_PER_W
    return rgb.astype(np.float32)
