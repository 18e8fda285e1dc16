"""Render rooms with Mitsuba: python bench/outside_rooms/render.py OUT NAME ... [--fine]

writes OUT/NAME.npz and OUT/NAME.toml: nine days (19 to 21 March, June and December, every hour) and
60 hours of the year at 116x58 pixels, for `make_case.py` and `judge.py`. --fine adds OUT/NAME/ with
pictures of 928x464 pixels, csvs of captures and test hours, and the truth about sky and sun disc,
also in all sunny hours of the year (truth_year.csv, which --year writes alone).
Needs `pip install mitsuba` and an LLVM newer than 15 (DRJIT_LIBLLVM_PATH, e.g. libLLVM-19.so).
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from coding import coded, write_hdr
from light import COARSE, FINE, Renderer, coarse_mean, suns_of, to_room
from make_case import HEAD
from numpy.typing import NDArray
from rooms import Place, Window, room
from skies import Hour, directions, sky_cdm2, year_of_hours

Array = NDArray[Any]

TEST_HOURS = 60
DISC_DNI_WM2 = 60.0  # less does not count as a sun
_GAIN_SD, _NOISE_SD = 0.01, 0.005  # of a capture's level, and of its pixels
TRUTH = [
    *("t_utc", "set", "dni_wm2", "dhi_wm2", "apparent_altitude_deg", "azimuth_deg"),
    *("share", "glass", "normal_lx"),
]
ROWS = COARSE * FINE


def chosen_hours(place: Place, name: str) -> tuple[list[Hour], Array, Array]:
    """Return the hours to render, and which of them are captures and test hours.

    Half of the test hours are random, half are random among those with the disc in view.
    """
    rng = np.random.default_rng(place.seed)
    year = year_of_hours(place.latitude, place.longitude, place.hours_east, place.seed)
    nine = [h for h in year if h.month in (3, 6, 12) and h.day in (19, 20, 21)]
    rest = [h for h in year if h not in nine and h.altitude_deg > 5]
    sunny = [h for h in rest if h.dni_wm2 > DISC_DNI_WM2]
    probe = Renderer(place, sunny[:1], 1, 1)
    eye = np.broadcast_to(np.asarray(place.camera), (len(sunny), 3))
    share = np.zeros(len(sunny))
    for k in range(8):
        angle = np.radians(0.2 * np.array([np.cos(k), np.sin(k)]) * (k > 0))
        rays = directions(
            np.array([h.apparent_deg for h in sunny]) + np.degrees(angle[0]),
            np.array([h.azimuth_deg for h in sunny]) + np.degrees(angle[1]),
        )
        share += probe.world.clear(eye, to_room(rays, place)) / 8
    view = [h for h, s in zip(sunny, share, strict=True) if s > 0.05]
    picked = rng.choice(len(view), min(TEST_HOURS // 2, len(view)), replace=False)
    test = [view[k] for k in picked]
    left = [h for h in rest if h not in test]
    test += [left[k] for k in rng.choice(len(left), TEST_HOURS - len(test), replace=False)]
    test.sort(key=lambda h: h.t_utc)
    print(f"{name}: the disc is in view in {len(view)} of {len(sunny)} sunny hours", flush=True)
    n = len(nine)
    return nine + test, np.arange(n), np.arange(n, n + len(test))


def render(name: str, out: Path, *, fine: bool, rounds: int, paths: int) -> None:
    """Render one room and write its files."""
    start = time.monotonic()
    place = room(name)
    hours, captures, test = chosen_hours(place, name)
    renderer = Renderer(place, hours, rounds, paths)
    first = renderer.first()
    keys = renderer.records(first)
    spread = renderer.spread(first, keys, smooth=fine)
    print(f"{name}: {len(hours)} hours, {len(keys)} records, {_s(start)}", flush=True)
    light = renderer.light(keys)
    print(f"{name}: {len(renderer.cells.keys)} cells, paths done, {_s(start)}", flush=True)
    suns = renderer.sun_on_surfaces()
    print(f"{name}: direct sun done, {_s(start)}", flush=True)
    folder = out / name
    if fine:
        (folder / "panoramas").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(place.seed + 1)
    lum, patch, truth = [], [], []
    open_to_sky = np.flatnonzero(first.sky)
    rays = fine_rays(place)[open_to_sky]
    for k, (hour, sun) in enumerate(zip(hours, suns_of(place, hours), strict=True)):
        picture = spread @ light[:, k]
        picture[open_to_sky] += first.sky[open_to_sky] * sky_cdm2(hour, rays)
        share, glass, disc = renderer.disc(hour, sun)
        direct = suns[k] + disc
        gain = np.exp(rng.normal(0, _GAIN_SD * (k in captures)))
        noise = np.exp(rng.normal(0, _NOISE_SD, len(picture))) * gain
        full = ((picture + direct) * noise).reshape(ROWS, 2 * ROWS)
        lum.append(coded(coarse_mean(full)))
        patch.append(coded(coarse_mean(direct)))
        truth.append((share, glass))
        if fine:
            write_hdr(folder / "panoramas" / f"{stamp(hour)}.hdr", full)
    write_room(name, place, out, hours, captures, test, lum, patch, np.array(truth))
    if fine:
        write_fine(name, place, folder, hours, captures, test, first, np.array(truth))
    print(f"{name}: {sum(s > 0 for s, _ in truth)} hours with a disc, {_s(start)}", flush=True)


def _s(start: float) -> str:
    return f"{time.monotonic() - start:.0f} s"


def stamp(hour: Hour) -> str:
    return hour.t_utc.strftime("%Y%m%dT%H%M%SZ")


def fine_rays(place: Place) -> Array:
    """Return the world's direction of every fine pixel's centre."""
    i, j = np.meshgrid(np.arange(ROWS) + 0.5, np.arange(2 * ROWS) + 0.5, indexing="ij")
    azimuth = place.heading_deg + (j / (2 * ROWS) - 0.5) * 360
    return directions(90 - i / ROWS * 180, azimuth).reshape(-1, 3)


def write_room(
    name: str,
    place: Place,
    out: Path,
    hours: Sequence[Hour],
    captures: Array,
    test: Array,
    lum: list[Array],
    patch: list[Array],
    truth: Array,
) -> None:
    """Write OUT/NAME.npz and OUT/NAME.toml."""
    conditions = np.array(
        [
            (h.month, h.day, h.hour, h.dni_wm2, h.dhi_wm2, h.altitude_deg, h.azimuth_deg - 180)
            for h in hours
        ]
    )
    np.savez_compressed(
        out / f"{name}.npz",
        lum=np.array(lum),
        sunpatch=np.array(patch),
        conditions=conditions,
        set_9d=captures,
        set_test=test,
        disc=truth.astype(np.float32),
    )
    site = site_toml(place, place.heading_deg)
    rng = np.random.default_rng(place.seed + 2)
    tape = site_toml(
        place, round(place.heading_deg + rng.choice([-1, 1]) * place.north_error_deg, 1)
    )
    text = [
        f"# {place.about} Rendered by Mitsuba 3; CIE skies with clouds.",
        f'npz = "{name}.npz"',
        f"heading_deg = {place.heading_deg}  # true azimuth of the pictures' centre column",
        f"hours_east = {place.hours_east}  # clock of `conditions` minus UTC",
        "own_sun = false  # whether `conditions` hold the sun as rendered",
        f'tape = """\n{tape}{tape_room(place, rng)}"""',
        f'exact = """\n{site}height_m = {place.camera[2]}\n"""',
    ]
    (out / f"{name}.toml").write_text("\n".join(text) + "\n")


def site_toml(place: Place, heading_deg: float) -> str:
    """Return the site without a room."""
    return (
        f'[site]\nname = "room"\nlatitude_deg = {place.latitude}\n'
        f"longitude_deg = {place.longitude}\naltitude_m = {place.altitude_m}\n"
        f'timezone = "{place.timezone}"\n[camera]\nheading_deg = {heading_deg}\n'
    )


def tape_room(place: Place, rng: np.random.Generator) -> str:
    """Return [room] as a tape measure gives it.

    Lengths are 1.5 % (sd) off, edges 3.5 cm, the camera 4 cm, the walls' azimuth 0.7 degrees.
    """
    width, depth, height = (
        np.asarray(place.size) * (1 + 0.015 * rng.normal(size=3)) * (1, 1, 1)
    ).round(2)
    x, y, z = (np.asarray(place.camera) + 0.04 * rng.normal(size=3)).round(2)
    lines = [
        "[room]",
        'kind = "box"',
        *(f"{key}_m = {v:.2f}" for key, v in (("width", width), ("depth", depth))),
        f"height_m = {height:.2f}",
        *(f"camera_{key}_m = {v:.2f}" for key, v in (("x", x), ("y", y), ("z", z))),
        f"wall_azimuth_deg = {place.wall_azimuth_deg + 0.7 * rng.normal():.1f}",
        f"wall_thickness_m = {place.thickness + 0.02 * rng.normal():.2f}",
    ]
    for window in place.windows:
        lines += _tape_window(window, place, (width, depth, height), rng)
    return "\n".join(lines) + "\n"


def _tape_window(
    window: Window, place: Place, size: tuple[float, float, float], rng: np.random.Generator
) -> list[str]:
    length = place.size[0] if window.wall in ("south", "north") else place.size[1]
    low, high = window.start_m, window.start_m + window.width_m
    left = low if window.wall in ("west", "north") else length - high
    edges = np.array([left, left + window.width_m, window.sill_m, window.sill_m + window.height_m])
    edges += 0.035 * rng.normal(size=4)
    limit = size[0] if window.wall in ("south", "north") else size[1]
    edges = np.clip(edges, 0.02, [limit - 0.02] * 2 + [size[2] - 0.02] * 2)
    left, right, sill, top = edges.round(2)
    return [
        "[[room.window]]",
        f'wall = "{window.wall}"',
        f"left_m = {left:.2f}",
        f"width_m = {right - left:.2f}",
        f"sill_m = {sill:.2f}",
        f"height_m = {top - sill:.2f}",
    ]


def write_fine(
    name: str,
    place: Place,
    folder: Path,
    hours: Sequence[Hour],
    captures: Array,
    test: Array,
    first: Any,
    truth: Array,
) -> None:
    """Write csvs, site, and the truth of a room with fine pictures."""
    for part, rows in (("9d", captures), ("test", test)):
        with (folder / f"{part}.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(HEAD)
            for k in rows:
                h = hours[k]
                ghi = round(h.dhi_wm2 + h.dni_wm2 * np.sin(np.radians(h.altitude_deg)), 1)
                sun = (round(h.altitude_deg, 4), round(h.azimuth_deg, 4))
                picture = f"panoramas/{stamp(h)}.hdr"
                light = (h.dni_wm2, h.dhi_wm2, ghi, "measured")
                table.writerow([_iso(h), picture, *light, *sun, 0, "", 1, 1, ""])
    (folder / "site.toml").write_text(
        site_toml(place, place.heading_deg) + f"height_m = {place.camera[2]}\n"
    )
    parts = ["9d" if k in captures else "test" for k in range(len(hours))]
    write_truth(folder / "truth.csv", hours, parts, truth)
    write_year(place, folder)
    np.savez_compressed(
        folder / "sky_view.npz",
        openness=first.openness.reshape(ROWS, 2 * ROWS).astype(np.float16),
        sky=first.sky.reshape(ROWS, 2 * ROWS).astype(np.float16),
        heading_deg=place.heading_deg,
    )


def write_truth(path: Path, hours: Sequence[Hour], parts: Sequence[str], truth: Array) -> None:
    """Write which share of the disc hours show, and the glass before it, [hours, 2]."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(TRUTH)
        for h, part, (share, glass) in zip(hours, parts, truth, strict=True):
            sun = (round(h.apparent_deg, 4), round(h.azimuth_deg, 4))
            lux = round(h.normal_lx * share * glass, 1)
            light = (h.dni_wm2, h.dhi_wm2)
            table.writerow([_iso(h), part, *light, *sun, round(share, 4), round(glass, 4), lux])


def write_year(place: Place, folder: Path) -> None:
    """Write truth_year.csv: the disc in all hours of the year with direct sun."""
    year = year_of_hours(place.latitude, place.longitude, place.hours_east, place.seed)
    hours = [h for h in year if h.dni_wm2 > DISC_DNI_WM2 and h.apparent_deg > 0.0]
    probe = Renderer(place, hours[:1], 1, 1)
    discs = [probe.disc(h, sun)[:2] for h, sun in zip(hours, suns_of(place, hours), strict=True)]
    write_truth(folder / "truth_year.csv", hours, ["year"] * len(hours), np.array(discs))


def _iso(hour: Hour) -> str:
    return hour.t_utc.strftime("%Y-%m-%dT%H:%M:%SZ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="+", help="of rooms.py, or lot-N")
    parser.add_argument("--fine", action="store_true")
    parser.add_argument("--year", action="store_true", help="only truth_year.csv of fine rooms")
    parser.add_argument("--rounds", type=int, default=4, help="of 4 camera rays a fine pixel")
    parser.add_argument("--paths", type=int, default=4, help="times 256 paths a coarse pixel")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names:
        if args.year:
            write_year(room(name), args.out / name)
            continue
        render(name, args.out, fine=args.fine, rounds=args.rounds, paths=args.paths)


if __name__ == "__main__":
    main()
