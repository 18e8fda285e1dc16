"""A year of maps and of glare in ten directions from a model trained here: seconds and memory.

The seconds are compared with evalglare.

Usage: python bench/glare_year.py PAIRS.csv [--weather FILE] [--upsample 2] [--views 10] [--sample
20] [--every 1]

The model is light transport with sun patches from the site's [room]. --upsample repeats pixels of
the training maps (115 rows to 230), for time and memory at full size. Without --weather: the
Seattle year that ships with the tool. Everything runs in one process; OMP_NUM_THREADS sets what
BLAS may use.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.learn import models
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.room.scene import sun_patches
from fieldlum.sky.daylight import Light
from fieldlum.weather import read_weather, shipped_seattle
from fieldlum.year.glare.pictures import panorama_to_fisheye, reference_glare, reference_version
from fieldlum.year.glare.sources import view_azimuths_deg
from fieldlum.year.predict.hour_blocks import HourJudge, ModelRoom, blocks
from fieldlum.year.predict.year import light_of


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs", type=Path)
    parser.add_argument("--weather", type=Path)
    parser.add_argument("--upsample", type=int, default=1)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--sample", type=int, default=20)
    parser.add_argument(
        "--every", type=int, default=1, help="predict every Nth hour; times are scaled up"
    )
    args = parser.parse_args()
    data = load_pairs(args.pairs)
    maps = data.luminance_cdm2.repeat(args.upsample, axis=1).repeat(args.upsample, axis=2)
    seen = data.seen.repeat(args.upsample, axis=0).repeat(args.upsample, axis=1)
    height, width = maps.shape[1:]
    site, light = data.setup.room, data.light
    patch = None
    if site is not None:
        patch = sun_patches(
            site,
            light.apparent_sun_direction,
            light.direct_lx,
            height=height,
            heading_deg=data.heading_deg,
        )
    data = replace(data, luminance_cdm2=maps, patch_cdm2=patch, seen=seen)
    start = time.process_time()
    fitted = models.fit("transport", data, patch="absolute" if patch is not None else "none")
    fit_s = time.process_time() - start
    del maps
    weather = (
        read_weather(args.weather, data.setup.site)
        if args.weather
        else shipped_seattle(data.setup.site)
    )
    light = light_of(weather.daylight())
    whole, light = len(light), light[slice(None, None, args.every)]
    print(
        f"{len(light)} hours, {width} x {height}, {args.views} directions; fit {fit_s:.1f} s",
        file=sys.stderr,
    )
    room = ModelRoom(
        setup=data.setup,
        height=height,
        width=width,
        heading_deg=data.heading_deg,
        needs_patch=patch is not None,
    )
    table = year(fitted, room, light, args.views, args.sample, whole / len(light))
    print(
        f"| {whole} hours ({len(light)} computed), {width} x {height}, {args.views} directions | "
        f"|\n|---|---|"
    )
    print(f"| fit on {len(data)} captures: CPU s | {fit_s:.0f} |")
    for name, value in table.items():
        print(f"| {name} | {value} |")


def _clocks() -> np.ndarray:
    """Wall and CPU time. [s] On a busy machine the second one counts."""
    return np.array([time.monotonic(), time.process_time()])


def year(
    fitted: models.Fitted, room: ModelRoom, light: Light, views: int, sample: int, scale: float
) -> dict[str, str]:
    """Times of maps and of metrics apart, memory, and the same view-hours by evalglare from a
    sample.
    """
    azimuths = view_azimuths_deg(room.heading_deg, views)
    judge = HourJudge(room, azimuths)
    rng = np.random.default_rng(0)
    asked = set(rng.choice(len(light), sample, replace=False).tolist())
    kept, maps_s, metrics_s = [], np.zeros(2), np.zeros(2)
    begin = _clocks()
    for block in blocks(fitted, room, light):
        now = _clocks()
        maps_s += now - begin
        judge.glare(block)
        metrics_s += _clocks() - now
        here = [
            k - block.rows.start for k in sorted(asked) if block.rows.start <= k < block.rows.stop
        ]
        kept += [block.prediction.luminance_cdm2[k].copy() for k in here]
        print(f"{block.rows.stop} / {len(light)}", end="\r", file=sys.stderr)
        begin = _clocks()
    start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    for k, image in enumerate(kept):
        reference_glare(panorama_to_fisheye(image, room.heading_deg, float(azimuths[k % views])))
    each = (resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start) / max(len(kept), 1)
    maps_s, metrics_s = maps_s * scale, metrics_s * scale
    total = each * len(light) * scale * views
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    evalglare = reference_version().split(" release")[0]
    return {
        "maps with sun patches: wall, CPU s": "{:.0f}, {:.0f}".format(*maps_s),
        "metrics of all directions: wall, CPU s": "{:.0f}, {:.0f}".format(*metrics_s),
        "together: wall, CPU s": "{:.0f}, {:.0f}".format(*(maps_s + metrics_s)),
        "peak memory, GiB": f"{peak:.2f}",
        f"{evalglare}, 800 px, one view, CPU s (of {len(kept)})": f"{each:.2f}",
        "the same year through it, core-hours": f"{total / 3600:.1f}",
        "ratio to our metrics, CPU to CPU": f"{total / max(metrics_s[1], 1e-9):.0f}",
    }


if __name__ == "__main__":
    main()
