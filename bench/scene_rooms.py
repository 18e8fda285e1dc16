"""Rooms that are no boxes of ours, and users who measured them badly.

    python bench/scene_rooms.py OUT [NAME ...] [--height 76] [--tests 150] [--set 9-day]
        [--troubles bench/troubles.toml] [--seed 0]

writes OUT/NAME.npz: nine days (or a month) and random test hours of a synthetic year, by rays of
Radiance and the radiosity of `scene_truth.py`, with the Perez sky and the sun; the sun patches by
shadow rays alone. `scene_judge.py` fits scenes to them. --troubles: of the captures; the test
hours have none. A wrong north of the file is left out, because each user of `scene_judge.py` has
one.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from hard_campaign import seeded
from numpy.typing import NDArray
from scene_generators import GLASS, ROOMS
from scene_truth import CameraRays, build_truth, cast, pictures, within
from troubles import (
    Troubles,
    load_troubles,
    measured_irradiance,
    troubled_pictures,
    true_light,
)

from fieldlum import plan
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Slot, Window, slot_id
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import rotation
from fieldlum.room import simulate
from fieldlum.room.fit.apply_scene import with_patches
from fieldlum.room.scene.geometry import glass_optics
from fieldlum.room.scene.radiance import octree
from fieldlum.room.scene.view import pixel_rays
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.measured_discs import sun_earlier

Array = NDArray[Any]
YEAR = 2027
SITE = Site("room", 47.6, -122.3, "America/Los_Angeles")
LEVEL_SD_DEG = 0.3  # of a camera that a person levels
PIXEL_SUB = 3  # rays of a pixel, each way
SUN_SUB = 9  # the same for direct sun: more than fieldlum has, so that they share no error
NOISY = ("canopy", "mullions")  # rooms that a simulated camera sees


# ----------------------------------------------------------------------------------------------
# rendering, in room axes


def hours_of(setup: SiteFile, tests: int, days: str) -> tuple[Light, Array]:
    """Light of a set of days, then of the test hours, and which are tests.

    The test hours are those of the nine days for every set.
    """
    weather = simulate.weather_for(setup, seed=5)

    def planned(name: str) -> list[Slot]:
        request = plan.Request(name, date(YEAR, 1, 1), None, YEAR)
        return list(plan.make_plan(setup, request, weather).slots)

    nine = [s.t_utc for s in planned("9-day")]
    other = simulate.sample_slots(setup, weather, tests, seed=7, without=nine)
    asked = {s.t_utc for s in other}
    captured = [s for s in planned(days) if s.t_utc not in asked]
    by_time = {t: k for k, t in enumerate(weather.t_utc)}
    slots = [s for s in (*captured, *other) if s.t_utc in by_time]
    rows = [by_time[s.t_utc] for s in slots]
    light = light_at([s.t_utc for s in slots], SITE, weather.dni_wm2[rows], weather.dhi_wm2[rows])
    usable = light.dni_wm2 + light.dhi_wm2 > 0
    test = np.array([s in other for s in slots])
    return light[np.flatnonzero(usable)], test[usable]


def in_room(world: Array, azimuth_deg: float) -> Array:
    a = np.radians(azimuth_deg)
    turn = np.array([(-np.cos(a), np.sin(a), 0.0), (-np.sin(a), -np.cos(a), 0.0), (0.0, 0.0, 1.0)])
    return world @ turn.T


def without_glass(text: str) -> str:
    """The room's surfaces alone: `scene_truth` computes the glass."""
    lines = text.splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith(("pane ", "void glass")))


def render(name: str, out: Path, height: int, tests: int, days: str, troubles: Troubles) -> None:
    begin = time.process_time(), sum(os.times()[2:4])
    room, text = ROOMS[name]()
    heading = room.wall_azimuth_deg
    setup = SiteFile(SITE, CameraSetup(heading_deg=heading), room)
    light, test = hours_of(setup, tests, days)
    eye = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    tilt_deg, roll_deg = LEVEL_SD_DEG * np.random.default_rng(
        list(ROOMS).index(name)
    ).standard_normal(2)
    level = rotation(0.0, tilt_deg, roll_deg, heading)

    def camera(sub: int) -> CameraRays:
        pixel, world = pixel_rays(height, heading, sub)
        order = np.argsort(pixel, kind="stable")
        return CameraRays(in_room(world @ level.T, heading)[order], pixel[order], height)

    coarse, fine = camera(PIXEL_SUB), camera(SUN_SUB)
    low, high = inside_of(room)
    disc_lx = np.zeros(len(light))
    captured = np.flatnonzero(~test)
    shining = true_light(light[captured], troubles, SITE)
    parts = [(captured, shining), (np.flatnonzero(test), light[np.flatnonzero(test)])]
    maps = np.zeros((len(light), 2 * height**2), np.float32)
    patches = np.zeros_like(maps)
    with octree(without_glass(text)) as tree:
        truth = build_truth(tree, eye, coarse.rays, low, high, GLASS)
        for rows, some in parts:
            some = replace(some, sun_azimuth_deg=(some.sun_azimuth_deg - heading + 180.0) % 360.0)
            suns = some.apparent_sun_direction
            maps[rows], patches[rows] = pictures(truth, some, suns, coarse, fine)
            shines = np.flatnonzero((some.direct_lx > 50.0) & (suns[:, 2] > 0.0))
            free = ~cast(tree, eye, suns[shines]).any
            passed = free * glass_optics(GLASS, suns[shines, 1])[0]
            disc_lx[rows[shines]] = some.direct_lx[shines] * passed
        seen = cast(tree, eye, coarse.rays)
    if name in NOISY:
        maps = photographed(maps, height, np.random.default_rng(11))
    size = (len(light), height, 2 * height)
    maps, patches = maps.reshape(size), patches.reshape(size)
    if troubles.names:
        out_there = ~(seen.any & within(seen.point, low, high))
        window = np.bincount(coarse.pixel, out_there, 2 * height**2).reshape(size[1:]) > 0.0
        times = [light.t_utc[k] for k in captured]
        maps[captured] = troubled_pictures(
            maps[captured], window, times, times, SITE.timezone, troubles
        )
    dni, dhi = light.dni_wm2.copy(), light.dhi_wm2.copy()
    dni[captured], dhi[captured] = measured_irradiance(
        [light.t_utc[k] for k in captured],
        dni[captured],
        dhi[captured],
        light.sun_altitude_deg[captured],
        troubles,
    )
    np.savez_compressed(
        out / f"{name}.npz",
        maps=maps,
        patches=patches,
        disc_lx=disc_lx,
        test=test,
        t_s=np.array([t.timestamp() for t in light.t_utc]),
        dni=dni,
        dhi=dhi,
        level_deg=np.array([tilt_deg, roll_deg]),
    )
    spent = time.process_time() - begin[0] + sum(os.times()[2:4]) - begin[1]
    print(
        f"{name}: {len(light)} hours, {len(truth.cell_albedo)} cells, {spent:.0f} CPU s", flush=True
    )


def inside_of(room: Room) -> tuple[Array, Array]:
    """Low and high corner of the space behind glass: to mid-wall in walls with a window."""
    gap, pane = 0.02, room.wall_thickness_m / 2.0
    walls = {w.wall for w in room.window}
    west, east = (pane if wall in walls else gap for wall in ("west", "east"))
    low = np.array([-west, -pane, -gap])
    return low, np.array([room.width_m + east, room.depth_m + gap, room.height_m + gap])


def photographed(maps: Array, height: int, rng: np.random.Generator) -> Array:
    """The maps by a simulated camera: noise of 1.5 % and vignetting that is 4 % wrong at 90 deg
    from the axis, as its correction leaves.
    """
    azimuth = ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5) * 2.0 * np.pi
    altitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    off_axis = np.arccos(np.cos(altitude)[:, None] * np.cos(azimuth))  # [H, W]
    falloff = 1.0 - 0.04 * np.minimum(off_axis / (np.pi / 2.0), 1.0) ** 2
    noise = 1.0 + 0.015 * rng.standard_normal(maps.shape)
    return (maps * falloff.ravel() * noise).astype(np.float32)


# ----------------------------------------------------------------------------------------------
# judging


def measured(room: Room, rng: np.random.Generator) -> Room:
    """The box as a user states it: no bars, no furniture, every length a little off."""

    def off(sd: float) -> float:
        return float(sd * rng.standard_normal())

    def edges_off(w: Window) -> Window:
        return replace(
            w,
            left_m=w.left_m + off(0.04),
            width_m=w.width_m + off(0.04),
            sill_m=w.sill_m + off(0.04),
            height_m=w.height_m + off(0.04),
        )

    return replace(
        room,
        width_m=room.width_m * (1.0 + off(0.015)),
        depth_m=room.depth_m * (1.0 + off(0.015)),
        camera_x_m=room.camera_x_m + off(0.05),
        camera_y_m=room.camera_y_m + off(0.05),
        wall_thickness_m=room.wall_thickness_m + off(0.03),
        window=tuple(edges_off(w) for w in room.window),
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
        light,
        maps,
        z["patches"],
        np.zeros(n),
        heading,
        days,
        tuple(map(slot_id, times)),
        setup,
        np.ones(maps.shape[1:], bool),
        np.zeros(n),
        path.stem,
    )
    train, test = data.take(~z["test"]), data.take(z["test"])
    return replace(train, light=late(train.light, clock_min)), test


def late(light: Light, minutes: float) -> Light:
    """The light with times and sun `minutes` later, as a late clock states them."""
    suns = sun_earlier(light.sun_direction, -minutes, SITE.latitude_deg)
    altitude = np.degrees(np.arcsin(suns[:, 2]))
    azimuth = np.degrees(np.arctan2(suns[:, 0], suns[:, 1])) % 360.0
    times = tuple(t + timedelta(minutes=minutes) for t in light.t_utc)
    return Light(
        t_utc=times,
        dni_wm2=light.dni_wm2,
        dhi_wm2=light.dhi_wm2,
        sun_altitude_deg=altitude,
        sun_azimuth_deg=azimuth,
        perez=light.perez,
    )


def with_box(data: Dataset, room: Room | None) -> Dataset:
    if room is None:
        return replace(data, patch_cdm2=None)
    return with_patches(replace(data, setup=replace(data.setup, room=room)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--height", type=int, default=76)
    parser.add_argument("--tests", type=int, default=150)
    parser.add_argument("--set", default="9-day", help="of capture days, as in fieldlum plan")
    parser.add_argument("--troubles", type=Path, help="TOML file, such as bench/troubles.toml")
    parser.add_argument("--seed", type=int, default=0, help="added to the seeds of the troubles")
    wanted = parser.parse_args()
    troubles = Troubles() if wanted.troubles is None else load_troubles(wanted.troubles)
    troubles = replace(seeded(troubles, 100 * wanted.seed), north=None)
    wanted.out.mkdir(parents=True, exist_ok=True)
    for name in wanted.names or ROOMS:
        render(name, wanted.out, wanted.height, wanted.tests, wanted.set, troubles)


if __name__ == "__main__":
    main()
