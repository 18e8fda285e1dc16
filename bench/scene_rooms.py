"""Rooms that are no boxes of ours, rendered by plain Radiance, and users who measured them badly.

    python bench/scene_rooms.py render OUT [NAME ...] [--height 57] [--tests 60]
    python bench/scene_rooms.py judge OUT [NAME ...] [--draws 1]

`render` writes OUT/NAME.npz: nine days and random test hours of a synthetic year by `rtrace -ab 2`
with the Perez sky and the sun, and the sun patches by `rtrace -ab 0`. `judge` fits the transport
model with no patch, with the patches of a stated box (lengths 1.5 %, edges 4 cm, camera 5 cm, north
1 degree, each a standard deviation; clock 5 minutes), and with the exact patches, and prints the
error on the test hours beside what `fieldlum.scene_fit.verdict` chose and expected.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import plan, simulate, sun
from fieldlum.light import Light, light_at
from fieldlum.models.data import Dataset
from fieldlum.models.transport import fit
from fieldlum.projection import equirect_solid_angles
from fieldlum.records import CameraSetup, Room, Site, SiteFile, Window, slot_id
from fieldlum.scene.geometry import transmissivity
from fieldlum.scene.radiance import octree, trace
from fieldlum.scene.view import pixel_rays
from fieldlum.scene_fit.apply import scene_of, with_patches, with_scene
from fieldlum.scene_fit.fit import SceneFit, fit_scene
from fieldlum.scene_fit.stage import judge_fit
from fieldlum.scene_fit.sun_path import sun_earlier
from fieldlum.sun import SUN_SOLID_ANGLE_SR

Array = NDArray[Any]
YEAR = 2027
SITE = Site("room", 47.6, -122.3, "America/Los_Angeles")
GLASS = 0.88
INDIRECT = (
    *("-ab", "2", "-ad", "96", "-as", "24", "-aa", ".3", "-ar", "16", "-lw", "2e-3"),
    *("-dj", "0", "-dt", "0", "-dc", "1", "-lr", "3", "-w-", "-u-"),
)
DIRECT_SUB = 2


# ----------------------------------------------------------------------------------------------
# the rooms: a tape-measure box that a user would state, and what is really there


def material(name: str, reflectance: float) -> str:
    return f"void plastic {name} 0 0 5 {reflectance} {reflectance} {reflectance} 0 0\n"


def quad(mat: str, corners: Sequence[Sequence[float]]) -> str:
    quad.count += 1  # type: ignore[attr-defined]
    numbers = " ".join(f"{v:.5f}" for corner in corners for v in corner)
    return f"{mat} polygon q{quad.count} 0 0 {3 * len(corners)} {numbers}\n"  # type: ignore[attr-defined]


quad.count = 0  # type: ignore[attr-defined]


def block(mat: str, low: Sequence[float], high: Sequence[float]) -> str:
    (x0, y0, z0), (x1, y1, z1) = low, high
    ends = [
        [(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
    ]
    return "".join(quad(mat, corners) for corners in ends)


def disc(mat: str, centre: tuple[float, float, float], radius: float) -> str:
    angles = np.linspace(0, 2 * np.pi, 33)[:-1]
    x, y, z = centre
    return quad(mat, [(x + radius * np.cos(a), y + radius * np.sin(a), z) for a in angles])


def shell(room: Room) -> str:
    """Walls with their window's hole, reveals, floor, ceiling, glass in mid-wall."""
    t, wide, deep, tall = room.wall_thickness_m, room.width_m, room.depth_m, room.height_m
    w = room.window[0]
    u0, u1 = wide - w.left_m - w.width_m, wide - w.left_m
    z0, z1 = w.sill_m, w.sill_m + w.height_m
    text = material("wall", room.reflectance_walls) + material("floor", room.reflectance_floor)
    text += material("ceiling", room.reflectance_ceiling) + material("wood", 0.35)
    text += material("frame", room.reflectance_frame) + material("ground", 0.2)
    text += material("facade", 0.5)
    n = transmissivity(GLASS)
    text += f"void glass pane 0 0 3 {n:.5f} {n:.5f} {n:.5f}\n"
    text += block("floor", (-t, -t, -0.1), (wide + t, deep + t, 0.0))
    text += block("ceiling", (-t, -t, tall), (wide + t, deep + t, tall + 0.3))
    text += block("wall", (-t, -t, 0.0), (0.0, deep + t, tall))
    text += block("wall", (wide, -t, 0.0), (wide + t, deep + t, tall))
    text += block("wall", (0.0, deep, 0.0), (wide, deep + t, tall))
    text += block("wall", (0.0, -t, 0.0), (u0, 0.0, tall)) + block(
        "wall", (u1, -t, 0.0), (wide, 0.0, tall)
    )
    text += block("wall", (u0, -t, 0.0), (u1, 0.0, z0)) + block(
        "wall", (u0, -t, z1), (u1, 0.0, tall)
    )
    y = -t / 2
    return text + quad("pane", [(u0, y, z0), (u1, y, z0), (u1, y, z1), (u0, y, z1)])


def ground(z: float) -> str:
    return quad("ground", [(-60, -60, z), (60, -60, z), (60, 60, z), (-60, 60, z)])


def bars(room: Room, places: Sequence[tuple[float, float]], levels: Sequence[float]) -> str:
    """Mullions (middle, width) and transoms of 6 cm, around the glass."""
    t, w = room.wall_thickness_m, room.window[0]
    u0, u1 = room.width_m - w.left_m - w.width_m, room.width_m - w.left_m
    z0, z1 = w.sill_m, w.sill_m + w.height_m
    near, far = -t / 2 - 0.04, -t / 2 + 0.05
    text = "".join(block("frame", (u - b / 2, near, z0), (u + b / 2, far, z1)) for u, b in places)
    return text + "".join(block("frame", (u0, near, z - 0.03), (u1, far, z + 0.03)) for z in levels)


def _room(azimuth: float, window: Window, **more: Any) -> Room:
    return replace(Room(wall_azimuth_deg=azimuth, window=(window,)), **more)


def round_table() -> tuple[Room, str]:
    """Round table, odd mullions, wall azimuth 203."""
    room = _room(
        203.0,
        Window("south", 0.6, 3.2, 0.85, 1.9, GLASS, 1, 0.0),
        width_m=4.6, depth_m=6.2, height_m=3.0, camera_x_m=2.4, camera_y_m=3.4, camera_z_m=1.4,
        wall_thickness_m=0.3, reflectance_floor=0.3,
    )  # fmt: skip
    things = disc("wood", (1.7, 1.9, 0.74), 0.65) + disc("wood", (1.7, 1.9, 0.70), 0.65)
    things += block("wood", (1.62, 1.82, 0.0), (1.78, 1.98, 0.7))
    things += block("wood", (3.9, 0.6, 0.0), (4.5, 2.2, 1.1))
    text = shell(room) + things + ground(-0.1)
    return room, text + bars(room, [(1.35, 0.07), (2.1, 0.12), (3.5, 0.07)], [2.1])


def canopy() -> tuple[Room, str]:
    """Deep reveals and a canopy, wall azimuth 156."""
    room = _room(
        156.0,
        Window("south", 0.9, 2.4, 0.5, 2.0, GLASS, 1, 0.0),
        width_m=4.2, depth_m=5.4, height_m=2.9, camera_x_m=2.0, camera_y_m=2.9, camera_z_m=1.5,
        wall_thickness_m=0.5, reflectance_floor=0.35, reflectance_walls=0.6,
    )  # fmt: skip
    things = block("facade", (0.2, -1.5, 2.62), (4.0, -0.5, 2.75))
    things += block("wood", (0.4, 1.2, 0.0), (1.2, 2.6, 0.75)) + block(
        "wood", (3.3, 3.6, 0.0), (4.2, 5.2, 1.9)
    )
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.1, 0.08)], [])


def upstairs() -> tuple[Room, str]:
    """Second floor with a neighbour across the street, wall azimuth 187."""
    room = _room(
        187.0,
        Window("south", 0.5, 4.0, 0.8, 1.8, GLASS, 1, 0.0),
        width_m=5.0, depth_m=7.0, height_m=2.8, camera_x_m=2.6, camera_y_m=2.6, camera_z_m=1.5,
        wall_thickness_m=0.3,
    )  # fmt: skip
    things = block("facade", (-14.0, -22.0, -7.0), (20.0, -14.0, 3.4))
    things += block("wood", (0.5, 1.2, 0.68), (2.0, 2.0, 0.74)) + block(
        "wall", (3.6, 1.6, 0.0), (3.9, 1.9, 2.8)
    )
    return room, shell(room) + things + ground(-7.0) + bars(room, [(1.8, 0.06), (3.2, 0.06)], [1.2])


def blind() -> tuple[Room, str]:
    """Venetian blind half down, wall azimuth 171. The room that is looked at last."""
    room = _room(
        171.0,
        Window("south", 0.4, 2.8, 0.9, 1.7, GLASS, 1, 0.0),
        width_m=3.8, depth_m=5.0, height_m=2.8, camera_x_m=1.9, camera_y_m=2.7, camera_z_m=1.4,
        wall_thickness_m=0.25, reflectance_floor=0.25,
    )  # fmt: skip
    slats = ""
    for z in np.arange(1.8, 2.59, 0.07):
        slats += quad(
            "frame",
            [(0.6, -0.05, z), (3.4, -0.05, z), (3.4, -0.01, z + 0.03), (0.6, -0.01, z + 0.03)],
        )
    things = block("wood", (0.3, 0.9, 0.0), (1.5, 1.7, 0.74)) + slats
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.0, 0.06)], [])


ROOMS = {"round-table": round_table, "canopy": canopy, "upstairs": upstairs, "blind": blind}


# ----------------------------------------------------------------------------------------------
# rendering, in room axes


def hours_of(setup: SiteFile, tests: int) -> tuple[Light, Array]:
    """Light of the nine days, then of the test hours, and which are tests."""
    weather = simulate.weather_for(setup, seed=5)
    start = date(YEAR, 1, 1)
    nine = plan.make_plan(setup, plan.Request("9-day", start, None, YEAR), weather).slots
    other = simulate.sample_slots(setup, weather, tests, seed=7, without=[s.t_utc for s in nine])
    by_time = {t: k for k, t in enumerate(weather.t_utc)}
    slots = [s for s in (*nine, *other) if s.t_utc in by_time]
    rows = [by_time[s.t_utc] for s in slots]
    light = light_at([s.t_utc for s in slots], SITE, weather.dni_wm2[rows], weather.dhi_wm2[rows])
    usable = light.dni_wm2 + light.dhi_wm2 > 0
    test = np.array([s in other for s in slots])
    return light[np.flatnonzero(usable)], test[usable]


def sky_text(light: Light, k: int, toward: Array) -> str:
    sky = light.sky
    numbers = [sky.norm_cdm2[k] / 179.0, sky.ground_cdm2[k] / 179.0, *sky.shape[k], *toward]
    text = "void brightfunc skyfunc\n2 skybright perezlum.cal\n0\n10 "
    text += " ".join(f"{v:.7g}" for v in numbers)
    text += "\nskyfunc glow skyglow 0 0 4 1 1 1 0\nskyglow source sky 0 0 4 0 0 1 180\n"
    return text + "skyglow source below 0 0 4 0 0 -1 180\n"


def sun_text(light: Light, k: int, toward: Array) -> str:
    radiance = light.direct_lx[k] / 179.0 / SUN_SOLID_ANGLE_SR
    x, y, z = toward
    text = f"void light solar 0 0 3 {radiance:.6g} {radiance:.6g} {radiance:.6g}\n"
    return text + f"solar source sun 0 0 4 {x:.7f} {y:.7f} {z:.7f} .533\n"


def in_room(world: Array, azimuth_deg: float) -> Array:
    a = np.radians(azimuth_deg)
    turn = np.array([(-np.cos(a), np.sin(a), 0.0), (-np.sin(a), -np.cos(a), 0.0), (0.0, 0.0, 1.0)])
    return world @ turn.T


def render(name: str, out: Path, height: int, tests: int, workers: int) -> None:
    room, text = ROOMS[name]()
    heading = room.wall_azimuth_deg
    setup = SiteFile(SITE, CameraSetup(heading_deg=heading), room)
    light, test = hours_of(setup, tests)
    eye = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    pixel, world = pixel_rays(height, heading, DIRECT_SUB)
    rays = in_room(world, heading)
    suns = in_room(light.sun_direction, heading)
    count = 2 * height**2
    maps, patches = np.zeros((2, len(light), count), np.float32)
    disc_lx = np.zeros(len(light))

    def one(k: int) -> None:
        shines = light.direct_lx[k] > 50.0 and suns[k, 2] > 0
        sun = sun_text(light, k, suns[k]) if shines else ""
        with octree(text, sky_text(light, k, suns[k]), sun) as lit:
            seen = 179.0 * trace(lit, eye, rays, [*INDIRECT, "-dv-"])
        maps[k] = np.bincount(pixel, seen, count) / DIRECT_SUB**2
        if shines:
            with octree(text, sun) as lit:
                seen = 179.0 * trace(lit, eye, rays, ["-ab", "0", "-dv-"])
                disc_lx[k] = 179.0 * SUN_SOLID_ANGLE_SR * trace(lit, eye, suns[k : k + 1])[0]
            patches[k] = np.bincount(pixel, seen, count) / DIRECT_SUB**2

    begin = time.perf_counter()
    with ThreadPoolExecutor(workers) as pool:
        for k, _ in enumerate(pool.map(one, range(len(light)))):
            if k % 20 == 0:
                print(f"{name}: {k}/{len(light)}, {time.perf_counter() - begin:.0f} s", flush=True)
    size = (len(light), height, 2 * height)
    np.savez_compressed(
        out / f"{name}.npz",
        maps=maps.reshape(size),
        patches=patches.reshape(size),
        disc_lx=disc_lx,
        test=test,
        t_s=np.array([t.timestamp() for t in light.t_utc]),
        dni=light.dni_wm2,
        dhi=light.dhi_wm2,
    )


# ----------------------------------------------------------------------------------------------
# judging


def measured(room: Room, rng: np.random.Generator) -> Room:
    """The box as a user states it: no bars, no furniture, every length a little off."""

    def off(sd: float) -> float:
        return float(sd * rng.standard_normal())

    w = room.window[0]
    return replace(
        room,
        width_m=room.width_m * (1.0 + off(0.015)),
        depth_m=room.depth_m * (1.0 + off(0.015)),
        camera_x_m=room.camera_x_m + off(0.05),
        camera_y_m=room.camera_y_m + off(0.05),
        wall_thickness_m=room.wall_thickness_m + off(0.03),
        window=(
            replace(
                w,
                left_m=w.left_m + off(0.04),
                width_m=w.width_m + off(0.04),
                sill_m=w.sill_m + off(0.04),
                height_m=w.height_m + off(0.04),
            ),
        ),
    )


def load(path: Path, room: Room, north_deg: float, clock_min: float) -> tuple[Dataset, Dataset]:
    """Captures as the user has them (heading and clock off), and test hours with true times."""
    with np.load(path) as stored:
        z = {name: stored[name] for name in stored.files}
    times = [datetime.fromtimestamp(float(t), UTC) for t in z["t_s"]]
    light = light_at(times, SITE, z["dni"], z["dhi"])
    heading = room.wall_azimuth_deg - north_deg
    stated = replace(room, wall_azimuth_deg=heading)
    setup = SiteFile(SITE, CameraSetup(heading_deg=heading), stated)
    maps = z["maps"]
    n = len(times)
    days = np.array([sun.standard_date(t, SITE.timezone) for t in times], "datetime64[D]")
    data = Dataset(
        light, maps, z["patches"], np.zeros(n), heading, days, tuple(map(slot_id, times)), setup,
        np.ones(maps.shape[1:], bool), np.zeros(n), path.stem,
    )  # fmt: skip
    train, test = data.take(~z["test"]), data.take(z["test"])
    return replace(train, light=late(train.light, clock_min)), test


def late(light: Light, minutes: float) -> Light:
    """The light with times and sun `minutes` later, as a late clock states them."""
    suns = sun_earlier(light.sun_direction, -minutes, SITE.latitude_deg)
    altitude = np.degrees(np.arcsin(suns[:, 2]))
    azimuth = np.degrees(np.arctan2(suns[:, 0], suns[:, 1])) % 360.0
    times = tuple(t + timedelta(minutes=minutes) for t in light.t_utc)
    return Light(times, light.dni_wm2, light.dhi_wm2, altitude, azimuth, light.perez)


def with_box(data: Dataset, room: Room | None) -> Dataset:
    if room is None:
        return replace(data, patch_cdm2=None)
    return with_patches(replace(data, setup=replace(data.setup, room=room)))


def fitted(data: Dataset, found: SceneFit, *, captures: bool) -> Dataset:
    """Captures, or test hours whose times are true, as the fitted scene explains them."""
    scene = scene_of(found, "fitted", "")
    return with_scene(data, scene if captures else replace(scene, clock_min=0.0))


def error_of(data: Dataset, test: Dataset, seen: Array) -> tuple[float, float]:
    """Actual and own expected log10 MSE on the test hours."""
    mode = "none" if data.patch_cdm2 is None else "absolute"
    model = fit(replace(data, seen=seen), patch=mode)
    made = model.predict(test.light, test.patch_cdm2)
    error = np.log10(np.maximum(made.luminance_cdm2, 1.0) / np.maximum(test.luminance_cdm2, 1.0))
    return float((error[:, seen] ** 2).mean()), float(made.expected_mse.mean())


def judge_room(path: Path, draw: int, north_deg: float, clock_min: float) -> None:
    rng = np.random.default_rng(draw)
    room, _ = ROOMS[path.stem]()
    train, test = load(path, room, north_deg, clock_min)
    stated = replace(measured(room, rng), wall_azimuth_deg=train.heading_deg)
    train = replace(train, setup=replace(train.setup, room=stated))
    test = replace(test, setup=train.setup)
    begin = time.process_time()
    found = fit_scene(replace(train, patch_cdm2=None), stated)
    cpu = time.process_time() - begin
    pairs = {
        "none": (with_box(train, None), with_box(test, None)),
        "stated": (with_box(train, stated), with_box(test, stated)),
        "fitted": (fitted(train, found, captures=True), fitted(test, found, captures=False)),
    }
    seen = draw_pixels(train, np.random.default_rng(9))
    begin = time.process_time()
    verdict = judge_fit(replace(train, patch_cdm2=None), found)
    judged = time.process_time() - begin
    pairs["exact patches"] = (train, test)
    print(
        f"{path.stem} draw {draw}: north {found.guess.north_deg:+.2f} (u {found.u['north_deg']:.2f}"
        f", true {north_deg:+.1f}), clock {found.guess.clock_min:+.1f} (u "
        f"{found.u['clock_min']:.1f}, true {clock_min:+.1f}); bars {len(found.guess.bars)}, solids "
        f"{len(found.guess.solids)}; fit {cpu:.0f} CPU s, verdict {judged:.0f} CPU s"
    )
    by_name = {s.name: s for s in verdict.scores}
    for name, pair in pairs.items():
        actual, own = error_of(*pair, seen)
        score = by_name.get(name)
        rest = f"{score.expected_log10_mse:.2e} | {score.misfit:.4f}" if score else "- | -"
        mark = " (chosen)" if name == verdict.chosen else ""
        print(f"| {path.stem} | {draw} | {name}{mark} | {actual:.2e} | {rest} | {own:.2e} |")
    print(f"trusted {verdict.trusted}: {verdict.reason}", flush=True)


def draw_pixels(data: Dataset, rng: np.random.Generator, count: int = 1500) -> Array:
    omega = equirect_solid_angles(*data.shape).ravel()
    seen = np.zeros(omega.size, bool)
    seen[rng.choice(omega.size, count, replace=False, p=omega / omega.sum())] = True
    return seen.reshape(data.shape)


def judge_rooms(out: Path, names: Sequence[str], draws: int) -> None:
    print("| room | draw | geometry | log10 MSE | expected by verdict | misfit | model expects |")
    print("|---|---|---|---|---|---|---|")
    for name in names:
        for draw in range(1, draws + 1):
            judge_room(out / f"{name}.npz", draw, 1.0, 5.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("render", "judge"))
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--height", type=int, default=57)
    parser.add_argument("--tests", type=int, default=60)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--workers", type=int, default=min(os.cpu_count() or 1, 4))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.names or ROOMS:
        if asked.what == "render":
            render(name, asked.out, asked.height, asked.tests, asked.workers)
    if asked.what == "judge":
        judge_rooms(asked.out, asked.names or list(ROOMS), asked.draws)


if __name__ == "__main__":
    main()
