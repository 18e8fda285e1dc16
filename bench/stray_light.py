"""Stray light of simulated lenses with known haze and ghosts: what `calibrate stray` removes.

    python bench/stray_light.py SESSION [--out docs/validation.md]

SESSION: one with truth/ (`fieldlum simulate` or `fieldlum demo`). A lens of 186 degrees looks at
its panoramas along four headings. Its pictures are the truth plus haze (a power of the angle, not
one of the fitted kernels) plus a ghost (an image 8 degrees wide of the field's light, mirrored
at the axis, which no kernel of the angle explains). Three pictures have black traps at twelve
directions; they give the kernel. The other pictures judge it: Ev and DGP along the axis, and the
darkest tenth of the pixels.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.api import evaluate_glare
from fieldlum.calibrate import stray
from fieldlum.core.records import Panorama
from fieldlum.optics.images import read_panorama
from fieldlum.optics.profiles import CameraProfile, StrayLight, load_camera_profile
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.optics.stray_light import stray_cdm2
from fieldlum.session import open_session

Array = NDArray[np.float64]
LENSES = ((0.01, 0.0), (0.03, 0.0), (0.10, 0.0), (0.03, 0.002), (0.03, 0.01))  # haze, ghost
TURNS_DEG = (0.0, 90.0, 180.0, 270.0)
TRAINING = 3
STEP = 2  # pixels averaged on a side: the direct sum of the haze is quadratic in the pixels
TRAP_DEG = 5.0  # radius of a trap: `stray.reading` averages 1.2 pixels, 3.8 degrees here
DIM_DGP = 0.25  # views below it: those that stray light changes most


@dataclass(frozen=True)
class SimulatedLens:
    """Haze: the share of light that is spread over the sphere, as angle^-1.5; ghost: the share that
    is spread around the direction mirrored at the axis.
    """

    haze: float
    ghost: float

    def recorded(self, light: Array, solid: Array, rays: Array, axis: Array) -> Array:
        """Return what the lens records of light [n], 0 where it does not see."""
        flux = (light * solid).astype(np.float32)
        seen = np.flatnonzero(light > 0)
        source, haze = rays[seen].astype(np.float32), self.haze / _power_total()
        mirrored = (2.0 * (source @ axis)[:, None] * axis - source).astype(np.float32)
        ghost_sr = 2 * np.pi * (1 - np.cos(np.radians(4.0)))
        out = light.copy()
        for rows in np.array_split(seen, 40):
            angle = np.arccos(np.clip(rays[rows].astype(np.float32) @ source.T, -1.0, 1.0))
            out[rows] += haze * (_power(angle) @ flux[seen])
            if self.ghost:
                near = rays[rows].astype(np.float32) @ mirrored.T > np.cos(np.radians(4.0))
                out[rows] += self.ghost / ghost_sr * (near @ flux[seen])
        return out


def _power(angle_rad: Array) -> Array:
    return np.maximum(angle_rad, np.radians(1.0)) ** -1.5


def _power_total() -> float:
    angle = (np.arange(18000) + 0.5) / 18000 * np.pi
    return float((_power(angle) * 2 * np.pi * np.sin(angle)).sum() * np.pi / 18000)


@dataclass(frozen=True)
class View:
    """One picture along an axis: the true map, cut to the lens's field, and its rays."""

    true: Panorama
    rays: Array
    solid: Array
    axis: Array
    field: NDArray[np.bool_]


def view_of(picture: Panorama, profile: CameraProfile, turn_deg: float) -> View:
    rows, columns = (count // STEP for count in picture.luminance_cdm2.shape)
    cut = np.asarray(picture.luminance_cdm2, float)[: rows * STEP, : columns * STEP]
    light = cut.reshape(rows, STEP, columns, STEP).mean(axis=(1, 3))
    height, width = rows, 2 * rows
    heading = picture.heading_deg + turn_deg
    light = np.roll(light[:, :width], -round(turn_deg / 360.0 * width), axis=1)
    rays = equirect_rays(height, width, heading).reshape(-1, 3)
    axis = direction(0.0, heading)
    field = rays @ axis > np.cos(np.radians(profile.lens[0].full_angle_deg / 2))
    light = np.where(field.reshape(height, width), np.maximum(light, 1e-3), 0.0)
    solid = equirect_solid_angles(height, width).ravel()
    return View(Panorama(light, heading), rays, solid, axis, field)


def photographed(view: View, lens: SimulatedLens, dark: NDArray[np.bool_] | None = None) -> Array:
    light = view.true.luminance_cdm2.ravel().astype(float)
    if dark is not None:
        light = np.where(dark & view.field, 1e-6, light)
    return lens.recorded(light, view.solid, view.rays, view.axis)


def trap_readings(
    views: list[View], lens: SimulatedLens, profile: CameraProfile, rng: np.random.Generator
) -> list[stray.StrayReading]:
    """Twelve traps a picture, as wide as a small map can resolve."""
    out = []
    for number, view in enumerate(views):
        heading = view.true.heading_deg
        places = [(heading + rng.uniform(-75, 75), rng.uniform(-60, 60)) for _ in range(12)]
        toward = [direction(altitude, azimuth) for azimuth, altitude in places]
        dark = (view.rays @ np.array(toward).T > np.cos(np.radians(TRAP_DEG))).any(axis=1)
        shape = view.true.luminance_cdm2.shape
        picture = Panorama(photographed(view, lens, dark).reshape(shape), heading)
        name = Path(f"picture{number}.exr")
        for azimuth_deg, altitude_deg in places:
            row = {"panorama": name, "azimuth_deg": azimuth_deg, "altitude_deg": altitude_deg}
            row |= {"luminance_cdm2": 0.0, "radius_deg": 1.0}
            out.append(stray.reading(picture, profile, row))
    return out


def figures(light: Array, view: View) -> tuple[float, float]:
    """Ev and DGP along the axis."""
    shape = view.true.luminance_cdm2.shape
    panorama = Panorama(light.reshape(shape), view.true.heading_deg)
    answer = evaluate_glare(panorama, [view.true.heading_deg])["views"][0]
    return float(answer["ev_lx"] or 0.0), float(answer["dgp"] or 0.0)


def row(lens: SimulatedLens, pictures: list[Panorama], profile: CameraProfile) -> str:
    rng = np.random.default_rng(5)
    kernel_views = [view_of(p, profile, TURNS_DEG[k]) for k, p in enumerate(pictures[:TRAINING])]
    found = stray.fit(trap_readings(kernel_views, lens, profile, rng)).kernel
    nodes, values = np.asarray(found.angle_deg), np.asarray(found.per_sr)
    ev: list[tuple[float, float]] = []
    dgp: list[tuple[float, float]] = []
    dim: list[tuple[float, float]] = []
    dark: list[tuple[float, float]] = []
    inside: list[float] = []
    for picture in pictures[TRAINING:]:
        for turn in TURNS_DEG:
            view = view_of(picture, profile, turn)
            true = view.true.luminance_cdm2.ravel().astype(float)
            raw = photographed(view, lens)
            haze = np.where(view.field, stray_cdm2(raw, view.solid, view.rays, nodes, values), 0.0)
            clean = np.maximum(raw - haze, 0.0)
            reference = figures(true, view)
            both = [figures(light, view) for light in (raw, clean)]
            ev.append((both[0][0] / reference[0] - 1, both[1][0] / reference[0] - 1))
            dgp.append((both[0][1] - reference[1], both[1][1] - reference[1]))
            if reference[1] < DIM_DGP:
                dim.append(dgp[-1])
            some = view.field & (true < np.quantile(true[view.field], 0.1)) & (true > 1e-3)
            off = [float(np.median(light[some] / true[some] - 1)) for light in (raw, clean)]
            dark.append((off[0], off[1]))
            u = np.hypot(found.u_rel * haze, 0.02 * true)
            inside.append(float((np.abs(clean - true) < 2 * u)[view.field].mean()))

    def rms(pairs: list[tuple[float, float]], scale: float = 1.0) -> str:
        before, after = np.sqrt((np.array(pairs) ** 2).mean(axis=0)) * scale
        return f"{before:.3g}, {after:.2g}"

    return (
        f"| {100 * lens.haze:g} % | {100 * lens.ghost:g} % | {len(nodes)}, {found.u_rel:.2f} | "
        f"{rms(ev, 100)} | {rms(dgp)} | {rms(dim) if dim else '-'} | {rms(dark, 100)} | "
        f"{100 * np.mean(inside):.0f} % |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pictures", type=int, default=12)
    given = parser.parse_args()
    camera = load_camera_profile("canon-5d2-8mm-f5.6")
    profile = replace(
        camera, lens=(replace(camera.lens[0], full_angle_deg=186.0),), stray=StrayLight()
    )
    files = sorted(open_session(given.session).truth.glob("*.exr"))
    chosen = [files[k] for k in np.linspace(3, len(files) - 4, given.pictures).astype(int)]
    pictures = [read_panorama(file) for file in chosen]
    count = (len(pictures) - TRAINING) * len(TURNS_DEG)
    lines = [
        "# Stray light",
        "",
        f"`{' '.join(['python', 'bench/stray_light.py', 'SESSION'])}`: simulated lenses with known "
        f"haze and ghost, {count} pictures that the kernel has not seen. Each cell: without, with "
        f"the kernel of `calibrate stray` (36 black traps in three pictures). A ghost is no "
        f"function of the angle: it stays, and u_rel must cover it. Within 2 u: u is u_rel "
        f"of the removed light, and 2 % of the luminance.",
        "",
        "| haze | ghost | angles, u_rel | Ev rms [%] | DGP rms | DGP rms below 0.25 | "
        "darkest tenth [%] | within 2 u |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for haze, ghost in LENSES:
        lines.append(row(SimulatedLens(haze, ghost), pictures, profile))
        print(lines[-1], flush=True)
    lines += ["", "A real lens: [outside the image circle](stray-border.md)."]
    if given.out:
        given.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
