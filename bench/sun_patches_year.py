"""Time a year of sun patches: python bench/sun_patches_year.py [SITE.toml] [--height 230] [--every
1] [--rtrace 3]

Prints wall and CPU seconds and peak memory of the own tracer, and of rtrace -ab 0 on a few hours
for comparison.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from fieldlum.optics.profiles import shipped
from fieldlum.room import scene
from fieldlum.room.scene import radiance, view
from fieldlum.room.simulate import weather_for
from fieldlum.session.site_toml import load_site
from fieldlum.sky import perez as sky
from fieldlum.sky import sun


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "site", nargs="?", type=Path, default=shipped("capture_plans") / "seattle-office.toml"
    )
    parser.add_argument("--height", type=int, default=230)
    parser.add_argument(
        "--every", type=int, default=1, help="take every n-th hour and multiply the time"
    )
    parser.add_argument("--rtrace", type=int, default=0, help="hours to trace by rtrace as well")
    asked = parser.parse_args()
    setup = load_site(asked.site)
    assert setup.room is not None
    year = weather_for(setup).daylight()[:: asked.every]
    at = sun.position(year.t_utc, setup.site)
    toward = sun.direction(at.altitude_deg, at.azimuth_deg)
    normal = sky.perez_coefficients(
        year.dni_wm2, year.dhi_wm2, at.altitude_deg, year.t_utc
    ).direct_lx
    prepare = _cpu()
    sub = view.patch_rays(asked.height)
    scene.traced_view(setup.room, asked.height, setup.camera.heading_deg, sub)
    prepare = _cpu() - prepare
    wall, cpu = time.perf_counter(), _cpu()
    total = 0.0
    heading, height = setup.camera.heading_deg, asked.height
    for start in range(0, len(normal), 64):
        some = slice(start, start + 64)
        part = scene.sun_patches(
            setup.room, toward[some], normal[some], heading_deg=heading, height=height
        )
        total += float(part.sum(dtype=np.float64))
    wall, cpu = time.perf_counter() - wall, _cpu() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{setup.site.name}, {2 * asked.height}x{asked.height}, {len(year)} hours, "
        f"{(normal > 0).sum()} with sun"
    )
    print(f"own tracer: {wall:.1f} s wall, {cpu:.1f} s CPU, peak {peak:.2f} GB")
    print(f"pixels once {prepare:.1f} CPU s, then a year of hours {cpu * asked.every:.0f} CPU s")
    built = scene.build(setup.room)
    text, (_, rays) = (
        radiance.rad_text(built),
        view.pixel_rays(asked.height, setup.camera.heading_deg, sub),
    )
    rays = built.to_room(rays)
    for k in np.argsort(-normal)[: asked.rtrace]:
        cpu = _cpu()
        with radiance.octree(text, radiance.sun_text(built.to_room(toward[k]))) as octree:
            radiance.trace(octree, np.array(built.camera_m), rays, ["-dv-"])
        print(f"rtrace -ab 0: {_cpu() - cpu:.1f} CPU s for one hour, {len(rays)} rays")


if __name__ == "__main__":
    main()
