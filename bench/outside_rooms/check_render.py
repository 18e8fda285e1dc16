"""Compare our paths with Mitsuba's own path tracer: python bench/outside_rooms/check_render.py NAME

One sunny and one overcast hour, without glass and without surfaces that transmit. Prints the median
and the 5 % and 95 % quantiles of the ratio of luminances at 116x58 pixels.
"""

from __future__ import annotations

import sys

import mitsuba as mi
import numpy as np
from light import COARSE, Renderer, coarse_mean, to_world, view_of
from render import chosen_hours, fine_rays
from rooms import room
from skies import directions, sky_cdm2
from tracer import mitsuba_scene

_SKY = (256, 512)  # of Mitsuba's picture of the sky


def mitsuba_picture(renderer: Renderer, hour_index: int, spp: int) -> np.ndarray:
    """Return luminance at 116x58 pixels by Mitsuba's path tracer."""
    place, hour = renderer.place, renderer.hours[hour_index]
    scene, _ = mitsuba_scene(place.groups)
    i, j = np.meshgrid(np.arange(_SKY[0]) + 0.5, np.arange(_SKY[1]) + 0.5, indexing="ij")
    altitude, azimuth = 90 - i / _SKY[0] * 180, j / _SKY[1] * 360
    # Rows from +y; column u has the room's direction (sin, cos) of 2 pi u, see Mitsuba's envmap.
    rays = directions(altitude, azimuth).reshape(-1, 3)
    sky = sky_cdm2(hour, to_world(rays, place)).reshape(_SKY).astype(np.float32)
    # Mitsuba's map is about +y: x sin(2 pi u), y up, -z cos(2 pi u).
    turn = mi.ScalarTransform4f(np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    scene["sky"] = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.repeat(sky[:, :, None], 3, 2)),
        "to_world": turn,
    }
    if hour.normal_lx > 0:
        scene["sun"] = {
            "type": "directional",
            "direction": (-renderer.cells.suns[hour_index]).tolist(),
            "irradiance": {"type": "uniform", "value": hour.normal_lx},
        }
    world = mi.load_dict(scene, optimize=False)
    integrator = mi.load_dict({"type": "path", "max_depth": 12, "rr_depth": 12})
    total = np.zeros(2 * COARSE * COARSE)
    count = np.zeros_like(total)
    for k in range(spp):
        view = view_of(place, np.random.default_rng(7000 + k))
        n = len(view.rays)
        origin = mi.Point3f(*[mi.Float(np.full(n, c, np.float32)) for c in place.camera])
        ray = mi.RayDifferential3f(
            o=origin, d=mi.Vector3f(*[np.ascontiguousarray(c, np.float32) for c in view.rays.T])
        )
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(k, n)
        value = np.array(integrator.sample(world, sampler, ray)[0]).reshape(-1)
        total += np.bincount(view.coarse, value, len(total))
        count += np.bincount(view.coarse, minlength=len(total))
    return (total / count).reshape(COARSE, 2 * COARSE)


def main() -> None:
    place = room(sys.argv[1])
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 2
    hours, _, _ = chosen_hours(place, sys.argv[1])
    for group in place.groups.values():
        group.transmittance = 0.0
    chosen = [max(hours, key=lambda h: h.normal_lx), min(hours, key=lambda h: h.dni_wm2)]
    renderer = Renderer(place, chosen, rounds, rounds, smoothing=0.0)
    renderer.world.panes = [(pane, np.ones_like(table)) for pane, table in renderer.world.panes]
    first = renderer.first()
    keys = renderer.records(first)
    spread, light = renderer.spread(first, keys, smooth=False), renderer.light(keys)
    suns = renderer.sun_on_surfaces()
    for k, hour in enumerate(chosen):
        ours = spread @ light[:, k] + first.sky * sky_cdm2(hour, fine_rays(place)) + suns[k]
        ratio = coarse_mean(ours) / np.maximum(mitsuba_picture(renderer, k, rounds), 1e-6)
        low, middle, high = np.quantile(ratio, [0.05, 0.5, 0.95])
        print(
            f"{sys.argv[1]} {hour.t_utc:%m-%d %H:%M} DNI {hour.dni_wm2:.0f}: ours over Mitsuba's"
            f" median {middle:.4f}, 5 % {low:.3f}, 95 % {high:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
