"""Render the office of raytraverse's validation set (base1compdv) at every hour of its reference.

    python bench/annual_truth_render.py FOLDER OUT [--height 90] [--scenes 01_glz,03_shd,05_ngl]

FOLDER is `validations/base1compdv` of github.com/stephanwaz/raytraverse (MPL-2.0), with the files
RAD/, options/, POINTS/, refs/ and refrt/. OUT/SCENE_vK.npz gets, for each view, panoramas without
the sun's disc, their direct-sun part and the discs (see `View`); bench/annual_truth.py reads them.

`annual_truth_office` has the planes, the hits and the direct sun; `annual_truth_cells` the daylight
coefficients, with which interreflection is iterated to convergence here; `annual_truth_hours` the
hours. The sun's direct light is exact at every pixel and cell, with the sun's vector of each hour.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from annual_truth_cells import Cells, Patches, cells_of, coefficients, csr, follow, sky_patches
from annual_truth_hours import Hours, chosen_hours, read_hours
from annual_truth_office import Array, Scene, opened, sun_share, sun_through
from numpy.typing import NDArray

from fieldlum.room.scene.trace import disc_rays
from fieldlum.room.scene.view import pixel_rays


def render_view(
    scene: Scene,
    cells: Cells,
    patches: Patches,
    eye: Array,
    heading_deg: float,
    height: int,
    hours: Hours,
    rows: NDArray[np.intp],
    irradiance: NDArray[np.float32],
    path: Path,
) -> None:
    """Write the maps of one view; irradiance [cells, n] of all cells without the sun's direct part
    for the office's."""
    light, suns, n = hours.light[rows], hours.suns[rows], len(rows)
    pixel, rays = pixel_rays(height, heading_deg, 2)
    sub = 4.0
    seen = follow(scene, cells, np.broadcast_to(eye, rays.shape).astype(float), rays, patches)
    shape = (2 * height**2, irradiance.shape[0])
    to_pixels = csr((pixel[seen.cells[0].astype(int)], seen.cells[1], seen.cells[2] / sub), shape)
    maps = np.ascontiguousarray((to_pixels @ irradiance).T)
    at, points, weight = seen.hits
    share = sun_share(scene, points, suns)
    to_patch = csr(
        (pixel[at], np.arange(len(at)), weight * points.reflectance / np.pi / sub),
        (shape[0], len(at)),
    )
    patch = np.ascontiguousarray((to_patch @ share.T).T) * light.direct_lx[:, None].astype(
        np.float32
    )
    maps += patch
    off, escaped, through = seen.escaped
    above = escaped[:, 2] > 0
    for block in range(0, n, 50):
        part = slice(block, min(block + 50, n))
        bright = np.repeat(light[part].sky.ground_cdm2[:, None], len(off), axis=1)
        bright[:, above] = light[part].sky_at(escaped[above])
        for k, row in enumerate(bright):
            maps[block + k] += np.bincount(pixel[off], row * through / sub, shape[0])
    disc, image = np.zeros(n), np.zeros(n)
    for k in range(n):
        for out, turned in ((disc, False), (image, True)):
            if suns[k, 2] <= 0 or (turned and (not scene.mirror or suns[k, 1] >= 0)):
                continue
            ways = disc_rays(suns[k] * np.array([1.0, -1.0 if turned else 1.0, 1.0]), 2)
            origin = np.broadcast_to(eye, ways.shape).astype(float)
            out[k] = sun_through(scene, origin, ways, turned).mean() * light.direct_lx[k]
    np.savez(
        path,
        maps=maps.reshape(n, height, 2 * height).astype(np.float32),
        patch=patch.reshape(n, height, 2 * height).astype(np.float32),
        disc_lx=disc,
        image_lx=image,
        rows=rows,
    )


def render_scene(folder: Path, out: Path, name: str, height: int) -> None:
    hours, patches = read_hours(folder), sky_patches()
    sets = chosen_hours(hours)
    rows = np.unique(np.concatenate((np.arange(hours.reference), *sets.values())))
    views = np.loadtxt(folder / "POINTS" / ("sensors_n.txt" if name == "05_ngl" else "sensors.txt"))
    rng = np.random.default_rng(0)
    with opened(folder, name) as scene:
        cells = cells_of(scene, views[:, :3], rng)
        print(name, "cells", len(cells.points.position), "hours", len(rows), flush=True)
        from_sky, from_cells = coefficients(scene, cells, patches, rng)
        print(name, "coefficients", from_sky.nnz, from_cells.nnz, flush=True)
        light = hours.light[rows]
        sky = np.concatenate((light.sky_cdm2, light.sky.ground_cdm2[:, None]), axis=1).T
        by_sky = (from_sky @ sky.astype(np.float32)).astype(np.float32)
        by_sun = sun_share(scene, cells.points, hours.suns[rows]).T
        by_sun = by_sun * light.direct_lx.astype(np.float32)
        print(name, "sun on cells", flush=True)
        first = by_sky + by_sun
        total = first
        for _ in range(7):
            total = first + from_cells @ total
        indirect = total.copy()
        indirect[: cells.office] -= by_sun[: cells.office]  # exact at each pixel instead
        for k, view in enumerate(views, start=1):
            heading = float(np.degrees(np.arctan2(view[3], view[4])) % 360.0)
            path = out / f"{name}_v{k}.npz"
            render_view(
                scene, cells, patches, view[:3], heading, height, hours, rows, indirect, path
            )
            print(path, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--height", type=int, default=90)
    parser.add_argument("--scenes", default="01_glz,03_shd,05_ngl")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.scenes.split(","):
        render_scene(options.folder, options.out, name, options.height)


if __name__ == "__main__":
    main()
