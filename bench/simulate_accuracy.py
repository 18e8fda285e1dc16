"""Simulated truth against rendering the hour in one piece: python bench/simulate_accuracy.py
[SITE.toml] [--pixels 600]

Three hours (clear noon, overcast, low sun): the truth over plain `rtrace -ab N` with gendaylit's
sky and sun, pixel by pixel (one central ray in rtrace, 3 x 3 in the truth, so edges differ). Prints
a Markdown table.
"""

from __future__ import annotations

import argparse
import resource
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyradiance

from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate
from fieldlum.room.scene import radiance, view
from fieldlum.session.site_toml import load_site
from fieldlum.sky.daylight import Light, light_at

HOURS = (
    ("clear noon", datetime(2027, 3, 20, 20, 10, tzinfo=UTC), 750.0, 90.0),
    ("overcast", datetime(2027, 3, 20, 20, 10, tzinfo=UTC), 0.0, 200.0),
    ("low sun", datetime(2027, 12, 20, 23, 0, tzinfo=UTC), 450.0, 50.0),
)


def plain(truth: simulate.LitRoom, light: Light, pixels: np.ndarray, bounces: int) -> np.ndarray:
    """rtrace of the complete hour, [pixels] cd/m2, without the sun's disc."""
    built, sky = truth.view.scene, light.sky
    toward = built.to_room(light.apparent_sun_direction[0])
    numbers = [sky.norm_cdm2[0] / 179, sky.ground_cdm2[0] / 179, *sky.shape[0], *toward]
    text = "void brightfunc skyfunc\n2 skybright perezlum.cal\n0\n10 " + " ".join(
        f"{x:.8g}" for x in numbers
    )
    for name, side in (("sky", 1), ("ground", -1)):
        text += (
            f"\nskyfunc glow {name}glow\n0\n0\n4 1 1 1 0\n{name}glow source {name}\n0\n0\n4 0 "
            f"0 {side} 180"
        )
    lamp = radiance.sun_text(toward, float(light.direct_lx[0])) if light.direct_lx[0] > 0 else ""
    _, rays = view.pixel_rays(truth.view.height, truth.view.heading_deg, 1)
    rays = built.to_room(rays[pixels])
    stream = np.concatenate(
        (np.broadcast_to(np.array(built.camera_m), rays.shape), rays), axis=1
    ).astype("<f4")
    options = [
        "-ab",
        str(bounces),
        "-ad",
        "2048",
        "-as",
        "512",
        "-aa",
        ".1",
        "-ar",
        "128",
        "-lw",
        "1e-5",
        "-dv-",
        "-w-",
    ]
    with radiance.octree(radiance.rad_text(built), text, lamp) as octree:
        answer = pyradiance.rtrace(
            stream.tobytes(), octree, header=False, inform="f", outform="f", params=options
        )
    return np.frombuffer(answer, "<f4").reshape(-1, 3)[:, 0] * 179


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "site", nargs="?", type=Path, default=shipped("capture_plans") / "seattle-office.toml"
    )
    parser.add_argument("--height", type=int, default=115)
    parser.add_argument("--quality", default="quick")
    parser.add_argument("--pixels", type=int, default=600)
    parser.add_argument("--bounces", type=int, default=4)
    asked = parser.parse_args()
    setup = load_site(asked.site)
    truth = simulate.lit_room(setup, height=asked.height, quality=asked.quality)
    count = 2 * asked.height**2
    area = np.repeat(
        np.cos((np.arange(asked.height) + 0.5) / asked.height * np.pi - np.pi / 2), 2 * asked.height
    )
    pixels = np.random.default_rng(1).choice(
        count, asked.pixels, replace=False, p=area / area.sum()
    )
    print(
        f"| hour | median | 5 % | 95 % | sum | rtrace -ab {asked.bounces}, CPU s "
        f"|\n|---|---|---|---|---|---|"
    )
    for name, t_utc, dni, dhi in HOURS:
        light = light_at([t_utc], setup.site, np.array([dni]), np.array([dhi]))
        made = truth.render(light).luminance_cdm2[0].ravel()[pixels]
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        found = plain(truth, light, pixels, asked.bounces)
        cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        low, middle, high = np.quantile(made / found, [0.05, 0.5, 0.95])
        total = made.sum() / found.sum()
        print(
            f"| {name} | {middle:.3f} | {low:.3f} | {high:.3f} | {total:.3f} | {cpu:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
