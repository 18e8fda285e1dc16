"""Fit the stray light of a lens, as a kernel of the angle, to readings of dark places.

A black trap (a deep dark box with a small hole) has no light of its own: what a picture shows there
is stray light. The same is true for any dark place in a dark room with one lamp. Readings with the
trap or the lamp at many angles give the kernel of `photometry.stray_light` by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldlum.calibrate.frames import Place
from fieldlum.calibrate.model_selection import OrderSelection, fit_and_choose
from fieldlum.calibrate.panorama_places import (
    disc_radius_rad,
    is_flagged,
    pixels_within,
    read_panoramas,
)
from fieldlum.calibrate.readings_csv import read_table
from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.photometry.stray_light import kernel_per_sr
from fieldlum.optics.profiles import CameraProfile, StrayLight
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles

# Angles of the tried kernels, in degrees; octaves, because haze falls roughly with a power. Chosen;
# held-out readings select a set.
NODE_SETS: tuple[tuple[float, ...], ...] = (
    (1.5,),
    (1.5, 96.0),
    (1.5, 12.0, 96.0),
    (1.5, 6.0, 24.0, 96.0),
    (1.5, 3.0, 6.0, 12.0, 24.0, 48.0, 96.0),
)
MIN_READINGS = 8  # twice the nodes of the fourth kernel; chosen, not measured
TRAP_RADIUS_DEG = 0.5  # radius of the place that is averaged, unless the csv states another; chosen
# of the stray light: interpolation on a grid of 3 degrees is not better; not measured
MIN_U_REL = 0.1
# of a source's light; with more, the lens is fogged or the place was not black; chosen
MAX_SHARE = 0.3


@dataclass(frozen=True, slots=True)
class StrayReading:
    """The stray light at one dark place, and the light that may cause it.

    label : name of the place, for messages; picture : its file. stray_cdm2 : recorded minus true
    luminance of the place. angle_rad [n] : angle from the place to each lit pixel of the same
    lens's field, and to the sun disc if the field contains it; flux [n] : luminance of that pixel
    times its solid angle, or the disc's illuminance on a plane normal to it [lx]. place : in its
    panorama.
    """

    label: str
    picture: Path
    stray_cdm2: float
    angle_rad: Floats
    flux: Floats
    place: Place | None = None


@dataclass(frozen=True, slots=True)
class StrayFit:
    """A fitted kernel of stray light.

    kernel: the table [stray] for a profile; predicted_cdm2: stray light that it predicts for each
    reading [n]; total_share: share (0 to 1) of a source's light that the kernel spreads; choice:
    which of several kernels, and why.
    """

    kernel: StrayLight
    predicted_cdm2: Floats
    total_share: float
    choice: OrderSelection


def from_table(path: Path, profile: CameraProfile) -> list[StrayReading]:
    """Read a csv of places that are dark in reality: panorama, azimuth_deg, altitude_deg.

    Optional columns: luminance_cdm2, the true luminance of the place (default 0), and radius_deg of
    the averaged disc (default 0.5). Azimuth is clockwise from north. Raises InputError for an
    invalid line, for a place that `reading` rejects, and for a picture that was merged with another
    calibration or with a stray-light kernel.
    """
    optional = {"luminance_cdm2": 0.0, "radius_deg": TRAP_RADIUS_DEG}
    rows = read_table(path, ("panorama", "azimuth_deg", "altitude_deg"), optional)
    plain = replace(profile, stray=StrayLight())
    pictures = read_panoramas(rows, plain, ", after removing [stray] from the profile")
    return [
        reading(
            row["panorama"],
            pictures[row["panorama"]],
            profile,
            (row["azimuth_deg"], row["altitude_deg"]),
            row["luminance_cdm2"],
            row["radius_deg"],
        )
        for row in rows
    ]


def reading(
    file: Path,
    picture: Panorama,
    profile: CameraProfile,
    at_deg: tuple[float, float],
    true_cdm2: float = 0.0,
    radius_deg: float = TRAP_RADIUS_DEG,
) -> StrayReading:
    """Return the stray light at a dark place of a picture, and the light that may cause it.

    file : for the label and errors. at_deg : azimuth (clockwise from north) and altitude of the
    place; true_cdm2 : its true luminance; radius_deg : radius of the averaged disc. Only the field
    of the lens whose axis is nearest to the place counts. Raises InputError for a place that is
    clipped, that no lens sees, or that is not brighter in the picture than true_cdm2.
    """
    height, width = picture.luminance_cdm2.shape
    light = np.nan_to_num(np.asarray(picture.luminance_cdm2, float)).ravel()
    rays = equirect_rays(height, width, picture.heading_deg).reshape(-1, 3)
    solid = equirect_solid_angles(height, width).ravel()
    toward = direction(at_deg[1], at_deg[0])
    angle = np.arccos(np.clip(rays @ toward, -1.0, 1.0))
    label = f"{file.stem} {at_deg[0]:g}/{at_deg[1]:g} deg"

    disc = pixels_within(picture, *at_deg, disc_radius_rad(picture, radius_deg))
    inside = disc.ravel()
    remedy = "check azimuth_deg and altitude_deg in its row of the csv, or use another place"
    for flag, what in (
        (Flag.OUTSIDE_LENS, "outside the lens's field"),
        (Flag.CLIPPED_HIGH, "clipped (too bright)"),
    ):
        if is_flagged(picture, disc, flag):
            finding = f"the dark place {label} is {what}"
            raise InputError(file, finding, "an unclipped place inside the field", remedy)
    in_view = _field_of_nearest_lens(rays, toward, profile, picture.heading_deg)
    use = in_view & ~inside & (light > 0)
    flux, away = (light * solid)[use], angle[use]
    if picture.sun is not None:
        source = direction(picture.sun.altitude_deg, picture.sun.azimuth_deg)
        if _field_of_nearest_lens(source[None], toward, profile, picture.heading_deg)[0]:
            flux = np.append(flux, picture.sun.normal_illuminance_lx)
            away = np.append(away, np.arccos(np.clip(source @ toward, -1.0, 1.0)))
    stray = float(light[inside].mean()) - true_cdm2
    if stray <= 0:
        raise InputError(
            file,
            f"{light[inside].mean():.3g} cd/m2 at {label}, not more than its true {true_cdm2:g} "
            "cd/m2",
            "a higher luminance in the picture, because of stray light",
            "remove this place from the csv of dark places",
        )
    return StrayReading(label, file, stray, away, flux, Place(file, *at_deg))


def _field_of_nearest_lens(
    rays: Floats, toward: Floats, profile: CameraProfile, heading_deg: float
) -> Mask:
    """Return a mask [n] of the rays [n, 3] that one lens sees.

    It is the lens whose axis is nearest to the direction `toward` [3].
    """
    axes = [direction(lens.tilt_deg, heading_deg + lens.azimuth_deg) for lens in profile.lens]
    nearest = int(np.argmax([axis @ toward for axis in axes]))
    return rays @ axes[nearest] >= np.cos(np.radians(profile.lens[nearest].full_angle_deg / 2))


def fit(readings: Sequence[StrayReading], source: Path | str = "stray") -> StrayFit:
    """Fit a kernel K >= 0 that falls with the angle from a source.

    Held-out readings choose the number of angles at which K is fitted. source : the csv, for
    errors. Raises NotEnoughDataError for fewer than eight readings, InputError for a kernel that
    spreads over 30 % of a source's light.
    """
    if len(readings) < MIN_READINGS:
        raise NotEnoughDataError(
            f"{source}: readings of dark places: {len(readings)}; expected at least "
            f"{MIN_READINGS}; add dark places at other angles from the light"
        )
    stray = np.array([r.stray_cdm2 for r in readings])
    groups = np.unique([str(r.picture) for r in readings], return_inverse=True)[1]
    if groups.max() < 3:  # with fewer pictures each reading is its own group
        groups = np.arange(len(readings))
    designs = {nodes: _design(readings, nodes) for nodes in NODE_SETS}
    nodes, values, choice = fit_and_choose(
        "stray light",
        [(f"{len(nodes)} angles", len(nodes), nodes) for nodes in NODE_SETS],
        groups,
        lambda nodes, rows: _falling(designs[nodes][rows], stray[rows]),
        lambda nodes, k, held: (designs[nodes][held] @ k / stray[held] - 1.0) ** 2,
        unit="% of it",
    )
    share = total_share(nodes, values)
    if share > MAX_SHARE:
        raise InputError(
            source,
            f"the fitted stray light is {100 * share:.0f} % of the light in the lens",
            f"at most {100 * MAX_SHARE:.0f} %",
            "check that places in rows without luminance_cdm2 are really black, and that "
            "luminance_cdm2 in the other rows is right",
        )
    u_rel = max(choice.rms, MIN_U_REL)
    kernel = StrayLight(nodes, tuple(float(f"{v:.4g}") for v in values), min(round(u_rel, 3), 0.99))
    return StrayFit(kernel, designs[nodes] @ values, share, choice)


def _design(readings: Sequence[StrayReading], nodes: tuple[float, ...]) -> Floats:
    """Return the stray light of each reading for each node alone, [readings, nodes].

    The kernel is then 1 at that node and 0 at the others.
    """
    at, unit = np.asarray(nodes), np.eye(len(nodes))
    columns = [
        [float((kernel_per_sr(r.angle_rad, at, hat) * r.flux).sum()) for hat in unit]
        for r in readings
    ]
    return np.array(columns)


def _falling(design: Floats, stray: Floats) -> Floats:
    """Return K at the nodes by relative least squares, with K >= 0 and falling with the angle."""
    from scipy.optimize import nnls

    steps = np.triu(np.ones((design.shape[1],) * 2))  # K_i is the sum of all steps from i on
    drop, _ = nnls(design @ steps / stray[:, None], np.ones(len(stray)))
    return steps @ drop


def total_share(nodes_deg: Sequence[float], values_per_sr: Floats) -> float:
    """Return the share of a source's light that the kernel K spreads over the sphere.

    nodes_deg, values_per_sr : [n], ascending angles above 0 [deg] and K there [1/sr], interpolated
    as by `kernel_per_sr`. The share is 0 to 1 for a physical kernel; it is not clipped.
    """
    angle = (np.arange(3600) + 0.5) / 3600 * np.pi
    kernel = kernel_per_sr(angle, np.asarray(nodes_deg), np.asarray(values_per_sr))
    return float((kernel * 2 * np.pi * np.sin(angle)).sum() * np.pi / 3600)
