"""Fit the stray light of a lens, as a kernel of the angle, to readings of dark places.

A black trap (a deep dark box with a small hole) has no light of its own: what a picture shows there
is stray light. The same is true for any dark place in a dark room with one lamp. Readings with the
trap or the lamp at many angles give the kernel of `optics.stray_light` by least squares.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.profiles import CameraProfile, StrayLight
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.optics.stray_light import kernel_per_sr

# Angles of the tried kernels, in degrees; octaves, because haze falls roughly with a power. Chosen;
# held-out readings select a set.
NODE_SETS: tuple[tuple[float, ...], ...] = (
    (1.5,),
    (1.5, 96.0),
    (1.5, 12.0, 96.0),
    (1.5, 6.0, 24.0, 96.0),
    (1.5, 3.0, 6.0, 12.0, 24.0, 48.0, 96.0),
)


class StrayReading(NamedTuple):
    """The stray light at one dark place, and the light that may cause it.

    place: of the dark place in its panorama. stray_cdm2: recorded minus true luminance of the
    place. angle_rad [n]: angle from the place to each lit pixel of the same lens's field, and to
    the sun disc if the field contains it; flux [n]: luminance of each pixel times its solid angle
    [cd/m2 sr], or the disc's illuminance on a plane normal to it [lx].
    """

    place: Place
    stray_cdm2: float
    angle_rad: Floats
    flux: Floats


class StrayFit(NamedTuple):
    """A fitted kernel of stray light.

    kernel: the table [stray] for a profile; predicted_cdm2: stray light that it predicts for each
    reading [n]; total_share: share (0 to 1) of a source's light that the kernel spreads; choice:
    which of several kernels, and why.
    """

    kernel: StrayLight
    predicted_cdm2: Floats
    total_share: float
    choice: fit_steps.OrderSelection


def from_table(path: Path, profile: CameraProfile) -> list[StrayReading]:
    """Return the stray light [cd/m2] at the dark places of a csv, and the light that may cause it.

    Columns: panorama, the path of a picture, relative to the csv; azimuth_deg, clockwise from
    north, and altitude_deg of a place that is dark in reality. Optional: luminance_cdm2, the true
    luminance of the place (default 0), and radius_deg of the averaged disc (default 0.5). Raises
    InputError for an invalid line, for a place that is clipped, outside the lens or not brighter
    than in reality, and for a picture that was merged with another calibration or with a
    stray-light kernel.
    """
    optional = {"luminance_cdm2": 0.0, "radius_deg": fit_steps.SPOT_DEG}
    rows = fit_steps.read_table(path, ("panorama", "azimuth_deg", "altitude_deg"), optional)
    plain = replace(profile, stray=StrayLight())
    pictures = fit_steps.read_panoramas(rows, plain, ", after removing [stray] from the profile")
    return [reading(pictures[row["panorama"]], profile, row) for row in rows]


def reading(picture: Panorama, profile: CameraProfile, row: fit_steps.CsvRow) -> StrayReading:
    """Return the stray light at a dark place of a picture, and the light that may cause it.

    row: the line of the csv with the place, with the five columns of `from_table`. Only the field
    of the lens whose axis is nearest to the place counts. Raises InputError for a place that is
    clipped, outside the lens or not brighter than in reality.
    """
    height, width = picture.luminance_cdm2.shape
    place = Place(row["panorama"], row["azimuth_deg"], row["altitude_deg"])
    light = np.nan_to_num(np.asarray(picture.luminance_cdm2, float)).ravel()
    disc = fit_steps.pixels_within(picture, place.x, place.y, row["radius_deg"])
    true_cdm2 = row["luminance_cdm2"]
    stray = float(light[disc.ravel()].mean()) - true_cdm2
    faults = {
        "outside the lens's field": fit_steps.is_flagged(picture, disc, Flag.OUTSIDE_LENS),
        "clipped (too bright)": fit_steps.is_flagged(picture, disc, Flag.CLIPPED_HIGH),
        f"{stray + true_cdm2:.3g} cd/m2, not more than its true {true_cdm2:g} cd/m2": stray <= 0,
    }
    for fault in (text for text, is_so in faults.items() if is_so):
        finding = f"the dark place at {place.x:g}/{place.y:g} deg is {fault}"
        expected = "an unclipped place inside the field, brighter than in reality by stray light"
        raise InputError(place.path, finding, expected, "correct or remove its row of the csv")
    rays = equirect_rays(height, width, picture.heading_deg).reshape(-1, 3)
    flux = np.where(disc.ravel(), 0.0, light * equirect_solid_angles(height, width).ravel())
    if picture.sun is not None:
        source = direction(picture.sun.altitude_deg, picture.sun.azimuth_deg)
        rays = np.concatenate([rays, source[None]])
        flux = np.append(flux, picture.sun.normal_illuminance_lx)
    ray, heading_deg = direction(place.y, place.x), picture.heading_deg
    axes = [direction(lens.tilt_deg, heading_deg + lens.azimuth_deg) for lens in profile.lens]
    nearest = int(np.argmax([axis @ ray for axis in axes]))
    # pixels with light in the field of that lens
    lit = (rays @ axes[nearest] >= np.cos(profile.lens[nearest].half_angle_rad)) & (flux > 0)
    angle_rad = np.arccos(np.clip(rays[lit] @ ray, -1.0, 1.0))
    return StrayReading(place, stray, angle_rad, flux[lit])


def fit(readings: Sequence[StrayReading], source: Path | str = "stray") -> StrayFit:
    """Fit a kernel K >= 0 that falls with the angle from a source.

    Held-out readings choose the number of angles at which K is fitted. source: the csv, for errors.
    Raises NotEnoughDataError for fewer than eight readings, InputError for a kernel that spreads
    over 30 % of a source's light.
    """
    remedy = "add dark places at other angles from the light"
    fit_steps.require(len(readings), 8, f"{source}: readings of dark places", remedy)
    stray = np.array([r.stray_cdm2 for r in readings])
    groups = np.unique([str(r.place.path) for r in readings], return_inverse=True)[1]
    if groups.max() < 3:  # with fewer pictures each reading is its own group
        groups = np.arange(len(readings))
    designs = {nodes: _design(readings, nodes) for nodes in NODE_SETS}
    nodes, values, choice = fit_steps.fit_and_choose(
        "stray light",
        [(f"{len(nodes)} angles", len(nodes), nodes) for nodes in NODE_SETS],
        groups,
        lambda nodes, rows: _falling(designs[nodes][rows], stray[rows]),
        lambda nodes, k, held: (designs[nodes][held] @ k / stray[held] - 1.0) ** 2,
    )
    share = total_share(nodes, values)
    if share > 0.3:  # the lens is fogged, or the place was not black
        finding = f"the fitted stray light is {100 * share:.0f} % of the light in the lens"
        remedy = "check that places are really black, and luminance_cdm2 of the others right"
        raise InputError(source, finding, "at most 30 %", remedy)
    u_rel = max(choice.rms, 0.1)  # interpolation on a grid of 3 degrees is not better
    kernel = StrayLight(nodes, tuple(float(f"{v:.4g}") for v in values), min(round(u_rel, 3), 0.99))
    return StrayFit(kernel, designs[nodes] @ values, share, choice)


def _design(readings: Sequence[StrayReading], nodes: tuple[float, ...]) -> Floats:
    """Return the stray light of each reading by a kernel for each node, [readings, nodes].

    The kernel of a node is 1 / sr there and 0 at the other nodes; nodes: angles [deg].
    """
    at, units = np.asarray(nodes), np.eye(len(nodes))
    rows = [[kernel_per_sr(r.angle_rad, at, unit) @ r.flux for unit in units] for r in readings]
    return np.array(rows, float)


def _falling(design: Floats, stray: Floats) -> Floats:
    """Return the kernel K at the nodes, [nodes] in 1/sr, that fits the stray light of n readings.

    K is at least 0 and falls with the angle; the fit is by relative least squares. design: result
    of `_design`.
    """
    from scipy.optimize import nnls

    steps = np.triu(np.ones((design.shape[1],) * 2))  # K_i is the sum of all steps from i on
    drop, _ = nnls(design @ steps / stray[:, None], np.ones(len(stray)))
    return steps @ drop


def total_share(nodes_deg: Sequence[float], values_per_sr: Floats) -> float:
    """Return the share of a source's light that the kernel K spreads over the sphere.

    nodes_deg, values_per_sr: [n], ascending angles above 0 [deg] and K there [1/sr], interpolated
    linearly in ln(angle), constant outside. The share is 0 to 1 for a physical kernel; it is not
    clipped.
    """
    angle = (np.arange(3600) + 0.5) / 3600 * np.pi
    kernel = kernel_per_sr(angle, np.asarray(nodes_deg), np.asarray(values_per_sr))
    return float((kernel * 2 * np.pi * np.sin(angle)).sum() * np.pi / 3600)


def chart(readings: Sequence[StrayReading], fit: StrayFit) -> Chart:
    """Return a chart of the stray light of each reading, as recorded and by the kernel."""
    recorded = np.array([r.stray_cdm2 for r in readings])
    title = f"Stray light: {100 * fit.total_share:.2g} % of a source's light is spread"
    off, places = recorded / fit.predicted_cdm2 - 1.0, [r.place for r in readings]
    return Chart(title, off, places, y=("stray light [cd/m²]", recorded), fitted=fit.predicted_cdm2)
