"""Rooms that are no boxes of ours, and users who measured them badly.

    python bench/scene_rooms.py render OUT [NAME ...] [--height 76] [--tests 150]
    python bench/scene_rooms.py judge OUT [NAME ...] [--draws 1] [--few 30,15,8,4,two-days]

`render` writes OUT/NAME.npz: nine days and random test hours of a synthetic year, by rays of
Radiance and the radiosity of `scene_truth.py`, with the Perez sky and the sun; the sun patches by
shadow rays alone. `judge` gives a user's errors to each room (standard deviations: lengths 1.5 %,
edges 4 cm, camera 5 cm; north 1 degree and clock 5 minutes off, either way; level 0.3 degrees),
fits the scene, and prints the error on the test hours of the transport model with no patch, with
the stated box, the fitted scene, the true room's boxes by our own renderer, and the exact patches.
Times in CPU s are of fit and verdict together.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scene_generators import GLASS, ROOMS, exact_guess
from scene_truth import build_truth, cast, pictures

from fieldlum import plan, simulate, sun
from fieldlum.errors import FieldlumError
from fieldlum.light import Light, light_at
from fieldlum.models.data import Dataset
from fieldlum.models.transport import fit
from fieldlum.projection import equirect_solid_angles, rotation
from fieldlum.records import CameraSetup, Room, Site, SiteFile, slot_id
from fieldlum.scene.geometry import glass_optics
from fieldlum.scene.radiance import octree
from fieldlum.scene.view import pixel_rays
from fieldlum.scene_fit.apply import earlier, scene_of, with_patches, with_scene
from fieldlum.scene_fit.fit import SceneFit, fit_scene
from fieldlum.scene_fit.guess import guess_of, room_of
from fieldlum.scene_fit.parameters import room_parameters
from fieldlum.scene_fit.scene_file import Scene
from fieldlum.scene_fit.stage import judged_scene
from fieldlum.scene_fit.sun_path import sun_earlier
from fieldlum.scene_fit.verdict import sunny_hours

Array = NDArray[Any]
YEAR = 2027
SITE = Site("room", 47.6, -122.3, "America/Los_Angeles")
LEVEL_SD_DEG = 0.3  # of a camera that a person levels
PIXEL_SUB = 3  # rays of a pixel, each way
NOISY = ("canopy", "mullions")  # rooms that a simulated camera sees


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


def in_room(world: Array, azimuth_deg: float) -> Array:
    a = np.radians(azimuth_deg)
    turn = np.array([(-np.cos(a), np.sin(a), 0.0), (-np.sin(a), -np.cos(a), 0.0), (0.0, 0.0, 1.0)])
    return world @ turn.T


def without_glass(text: str) -> str:
    """The room's surfaces alone: `scene_truth` computes the glass."""
    lines = text.splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith(("pane ", "void glass")))


def render(name: str, out: Path, height: int, tests: int) -> None:
    begin = time.process_time(), sum(os.times()[2:4])
    room, text = ROOMS[name]()
    heading = room.wall_azimuth_deg
    setup = SiteFile(SITE, CameraSetup(heading_deg=heading), room)
    light, test = hours_of(setup, tests)
    eye = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    pixel, world = pixel_rays(height, heading, PIXEL_SUB)
    order = np.argsort(pixel, kind="stable")
    tilt_deg, roll_deg = LEVEL_SD_DEG * np.random.default_rng(
        list(ROOMS).index(name)
    ).standard_normal(2)
    level = rotation(0.0, tilt_deg, roll_deg, heading)
    rays = in_room(world @ level.T, heading)[order]
    suns = in_room(light.sun_direction, heading)
    gap = 0.02
    low = np.array([-gap, -room.wall_thickness_m / 2.0, -gap])
    high = np.array([room.width_m + gap, room.depth_m + gap, room.height_m + gap])
    disc_lx = np.zeros(len(light))
    with octree(without_glass(text)) as tree:
        truth = build_truth(tree, eye, rays, low, high, GLASS)
        maps, patches = pictures(truth, light, suns, rays, pixel[order], 2 * height**2)
        shines = np.flatnonzero((light.direct_lx > 50.0) & (suns[:, 2] > 0.0))
        free = ~cast(tree, eye, suns[shines]).any
        disc_lx[shines] = light.direct_lx[shines] * free * glass_optics(GLASS, suns[shines, 1])[0]
    if name in NOISY:
        maps = photographed(maps, height, np.random.default_rng(11))
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
        level_deg=np.array([tilt_deg, roll_deg]),
    )
    spent = time.process_time() - begin[0] + sum(os.times()[2:4]) - begin[1]
    print(
        f"{name}: {len(light)} hours, {len(truth.cell_albedo)} cells, {spent:.0f} CPU s", flush=True
    )


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


@dataclass(frozen=True)
class Judged:
    """What one room with one draw of a user's errors gave; errors are log10 MSE by geometry."""

    name: str
    draw: int
    errors: dict[str, float]
    scene: Scene
    off: dict[str, tuple[float, float]]  # fitted less true, and the stated uncertainty
    cpu_s: float

    @property
    def row(self) -> str:
        """One line of the table."""
        chosen = self.scene.chosen
        expected = self.scene.expected_log10_mse
        ratio = "-" if expected is None else f"{expected / self.errors[chosen]:.1f}"
        shown = [f"{self.errors[g]:.1e}" if g in self.errors else "-" for g in GEOMETRIES]
        angles = [f"{off:+.2f} ({u:.2f})" for off, u in (self.off[n] for n in SHOWN)]
        trusted = "yes" if self.scene.trusted else "no"
        cells = [self.name, str(self.draw), *shown, chosen, ratio, trusted, *angles]
        return "| " + " | ".join([*cells, f"{self.cpu_s:.0f}"]) + " |"


GEOMETRIES = ("none", "stated", "fitted", "exact geometry", "exact patches")
SHOWN = ("north_deg", "clock_min", "tilt_deg", "roll_deg")
COVER = 1.96  # standard uncertainties: 95 % of a normal distribution


def user_of(
    path: Path, draw: int
) -> tuple[Dataset, Dataset, tuple[Dataset, Dataset], float, float]:
    """Captures and test hours of a user with errors of this draw, the same with exact geometry and
    patches, and by how much north [degrees] and clock [min] are off.
    """
    rng = np.random.default_rng(100 + draw)
    room, _ = ROOMS[path.stem]()
    north, clock = float(rng.choice([-1.0, 1.0])), 5.0 * float(rng.choice([-1.0, 1.0]))
    train, test = load(path, room, north, clock)
    stated = replace(measured(room, rng), wall_azimuth_deg=train.heading_deg)
    setup = replace(train.setup, room=stated)
    user = replace(train, setup=setup, patch_cdm2=None)
    return user, replace(test, setup=setup, patch_cdm2=None), (train, test), north, clock


def exact_pair(
    path: Path, train: Dataset, test: Dataset, clock_min: float
) -> tuple[Dataset, Dataset]:
    """Captures and test hours with the patches of the true room's boxes by our own renderer."""
    room, text = ROOMS[path.stem]()
    with np.load(path) as stored:
        tilt, roll = map(float, stored["level_deg"])
    true = replace(exact_guess(room, text), tilt_deg=tilt, roll_deg=roll)
    setup = replace(train.setup, room=room_of(true, room))
    on_time = replace(train, light=earlier(train.light, clock_min, train))
    heading = room.wall_azimuth_deg
    return (
        with_patches(replace(on_time, setup=setup, heading_deg=heading)),
        with_patches(replace(test, setup=setup, heading_deg=heading)),
    )


def judge_room(
    path: Path, draw: int, scored: int, hours: Array | None = None, pixels: int = 4000
) -> Judged:
    """Fit and judge one room; hours: rows of the captures to use."""
    user, test, exact, north, clock = user_of(path, draw)
    if hours is not None:
        user, exact = user.take(hours), (exact[0].take(hours), exact[1])
    stated = user.setup.room
    assert stated is not None
    begin = time.process_time()
    found = fit_scene(user, stated, pixels=pixels)
    scene = judged_scene(user, found)
    cpu = time.process_time() - begin
    pairs = {
        "none": (with_box(user, None), with_box(test, None)),
        "stated": (with_box(user, stated), with_box(test, stated)),
        "fitted": (fitted(user, found, captures=True), fitted(test, found, captures=False)),
        "exact geometry": exact_pair(path, *exact, clock),
        "exact patches": exact,
    }
    seen = draw_pixels(user, np.random.default_rng(9), scored)
    errors = {name: error_of(*pair, seen)[0] for name, pair in pairs.items()}
    return Judged(path.stem, draw, errors, scene, offsets(path, found, stated, north, clock), cpu)


def offsets(
    path: Path, found: SceneFit, stated: Room, north: float, clock: float
) -> dict[str, tuple[float, float]]:
    """Fitted less true and stated uncertainty, by parameter."""
    room, _ = ROOMS[path.stem]()
    with np.load(path) as stored:
        tilt, roll = map(float, stored["level_deg"])
    azimuth = stated.wall_azimuth_deg
    true = guess_of(replace(room, wall_azimuth_deg=azimuth), azimuth)
    true = replace(true, north_deg=north, clock_min=clock, tilt_deg=tilt, roll_deg=roll)
    return {
        p.name: (found.after[p.name] - p.read(true), found.u[p.name]) for p in room_parameters(true)
    }


def summary(rows: Sequence[Judged]) -> str:
    """Return what the rows have in common, one statement a line."""
    ratios = [r.errors["fitted"] / r.errors["exact geometry"] for r in rows]
    z = [abs(off) / u for r in rows for off, u in r.off.values()]
    within = 100.0 * np.mean(np.array(z) < COVER)
    worse = []
    for r in rows:
        loss = r.errors[r.scene.chosen] / min(r.errors["none"], r.errors["stated"])
        if loss > 1.1:
            worse.append(f"{r.name} {r.draw} ({loss:.2f})")
    promised = [
        r.scene.expected_log10_mse / r.errors[r.scene.chosen]
        for r in rows
        if r.scene.expected_log10_mse is not None
    ]
    good = sum(0.5 <= p <= 2.0 for p in promised)
    return "\n".join(
        (
            f"fitted over exact geometry: median {np.median(ratios):.2f}",
            f"truth within 1.96 u: {within:.0f} % of {len(z)} numbers",
            f"chosen worse than the better of none and stated by over 10 %: {worse or 'never'}",
            f"expected within a factor of two of the error: {good} of {len(promised)}",
            f"trusted: {sum(r.scene.trusted for r in rows)} of {len(rows)}",
        )
    )


def draw_pixels(data: Dataset, rng: np.random.Generator, count: int = 1500) -> Array:
    omega = equirect_solid_angles(*data.shape).ravel()
    seen = np.zeros(omega.size, bool)
    seen[rng.choice(omega.size, count, replace=False, p=omega / omega.sum())] = True
    return seen.reshape(data.shape)


def few_hours(path: Path, draw: int, count: int) -> Array:
    """Rows of all captures but for clear hours, of which `count` drawn ones stay."""
    user = user_of(path, draw)[0]
    clear = np.flatnonzero(sunny_hours(user, user.setup.room))
    rng = np.random.default_rng(4)
    stay = rng.choice(clear, min(count, len(clear)), replace=False)
    return np.sort(np.concatenate([np.setdiff1d(np.arange(len(user)), clear), stay]))


def two_days(path: Path, draw: int) -> Array:
    """Rows of the clearest day and of the day with the least direct sun."""
    user = user_of(path, draw)[0]
    days = np.unique(user.days)
    direct = [float(user.light.direct_lx[user.days == day].sum()) for day in days]
    return np.flatnonzero(np.isin(user.days, days[[np.argmax(direct), np.argmin(direct)]]))


def judge_rooms(
    out: Path, names: Sequence[str], draws: int, scored: int, few: str, pixels: int
) -> None:
    head = ["room", "draw", *GEOMETRIES, "chosen", "expected / error", "trusted"]
    head += [f"{n.rpartition('_')[0]} off (u)" for n in SHOWN] + ["CPU s"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|", flush=True)
    rows = []
    for name in names:
        for draw in range(1, draws + 1):
            path = out / f"{name}.npz"
            for number in few.split(",") if few else [""]:
                hours = None
                if number == "two-days":
                    hours = two_days(path, draw)
                elif number:
                    hours = few_hours(path, draw, int(number))
                try:
                    rows.append(judge_room(path, draw, scored, hours, pixels))
                except FieldlumError as error:
                    print(f"| {name} | {draw} | refused: {error} |", flush=True)
                    continue
                row = rows[-1]
                label = f"{name}, {number} clear hours" if number.isdigit() else name
                label = f"{name}, two days" if number == "two-days" else label
                print(replace(row, name=label).row, flush=True)
                if few:
                    print(f"   {row.scene.verdict}; {'; '.join(row.scene.notes)}", flush=True)
    print("\n" + summary(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("render", "judge"))
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--height", type=int, default=76)
    parser.add_argument("--tests", type=int, default=150)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--scored", type=int, default=1500, help="pixels that errors are taken at")
    parser.add_argument("--pixels", type=int, default=4000, help="pixels of the fit's evidence")
    parser.add_argument("--few", default="", help="numbers of clear hours that stay, or two-days")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.names or ROOMS:
        if asked.what == "render":
            render(name, asked.out, asked.height, asked.tests)
    if asked.what == "judge":
        names = asked.names or list(ROOMS)
        judge_rooms(asked.out, names, asked.draws, asked.scored, asked.few, asked.pixels)


if __name__ == "__main__":
    main()
