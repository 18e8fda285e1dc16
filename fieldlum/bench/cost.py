"""Measure how long Radiance takes to render the maps that the models predict."""

from __future__ import annotations

import os
import time

import numpy as np

from fieldlum.bench.rows import ERRORS
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import equirect_rays
from fieldlum.room.scene.geometry import build
from fieldlum.room.scene.radiance import octree, rad_text, sun_text, trace

# The options of the paper's rpict (Liu, Colburn and Inanici 2020).
PAPER_OPTIONS = ("-ab", "4", "-aa", ".1", "-ar", "512", "-ad", "2048", "-as", "1024")


def radiance_row(
    data: Dataset, hours: int, *, progress: Progress = quiet
) -> dict[str, object] | None:
    """Return a row of the score table with the seconds that rtrace needs for one map.

    The mean of `hours` bright hours of `data`, at its map size, on one core, with the paper's
    options. The room is the box of [room]. Its sky is uniform with the hour's illuminance, which
    costs as much as a Perez sky. Return None without a box room.
    """
    room = data.setup.room
    if room is None or room.kind != "box" or hours < 1:
        return None
    scene = build(room)
    height, width = data.shape
    rays = scene.to_room(equirect_rays(height, width, data.heading_deg).reshape(-1, 3))
    order = np.argsort(data.light.total_lx)[len(data) // 2 :]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, hours).round().astype(int))]
    seconds: list[float] = []
    cpu_s: list[float] = []
    for k, hour in enumerate(chosen):
        progress(k, len(chosen), "Radiance rendering")
        light = data.light[[hour]]
        level = max(float(light.diffuse_lx[0]), 1.0) / 179.0 / np.pi
        sky = (
            f"void glow skyglow\n0\n0\n4 {level:.6g} {level:.6g} {level:.6g} 0\nskyglow source "
            f"sky\n0\n0\n4 0 0 1 180\n"
        )
        sun = sun_text(scene.to_room(light.shown_sun_direction)[0], float(light.direct_lx[0]))
        with octree(rad_text(scene), sky, sun) as tree:
            start_s, busy_s = time.monotonic(), sum(os.times()[2:4])  # of children
            trace(tree, np.array(scene.camera_m), rays, PAPER_OPTIONS)
            cpu_s.append(sum(os.times()[2:4]) - busy_s)
            seconds.append(time.monotonic() - start_s)
    times = {"predict_s_per_map": seconds, "predict_cpu_s_per_map": cpu_s}
    means = {name: float(np.mean(values)) for name, values in times.items()}
    return {"name": "Radiance -ab 4", **dict.fromkeys(ERRORS), **means, "n_test": len(seconds)}
