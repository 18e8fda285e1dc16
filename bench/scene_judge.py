"""Scenes fitted to the rooms of `scene_rooms.py`, and what they are worth.

    python bench/scene_judge.py OUT [NAME ...] [--draws 1] [--few 30,15,8,4,four-days,two-days]

gives a user's errors to each room (standard deviations: lengths 1.5 %, edges 4 cm, camera 5 cm;
north 1 degree and clock 5 minutes off, either way; level 0.3 degrees), fits the scene, and prints
the error on the test hours of the transport model with no patch, with the stated box, the fitted
scene, the true room's boxes by our own renderer, and the exact patches. Times in CPU s are of fit
and verdict together.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scene_generators import ROOMS, exact_guess
from scene_rooms import load, measured, with_box

from fieldlum.core.errors import FieldlumError
from fieldlum.core.records import Room
from fieldlum.learn.models import trusted_hours
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import fit
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.apply_scene import earlier, with_patches, with_scene
from fieldlum.room.fit.draw_scene import draw as draw_scene
from fieldlum.room.fit.evidence import PIXELS, scene_evidence
from fieldlum.room.fit.fit import fit_scene
from fieldlum.room.fit.guess import guess_of, room_of
from fieldlum.room.fit.parameters import room_parameters
from fieldlum.room.fit.scene_file import Scene
from fieldlum.room.fit.stage import judged_scene
from fieldlum.room.fit.sunny_hours import sunny_hours

Array = NDArray[Any]


def fitted(data: Dataset, scene: Scene, *, captures: bool) -> Dataset:
    """Captures, or test hours whose times are true, as the fitted scene explains them."""
    return with_scene(data, scene if captures else replace(scene, clock_min=0.0))


@dataclass(frozen=True)
class Scored:
    """Actual and own expected log10 MSE on the test hours, and both of the trusted hours."""

    error: float
    expected: float
    trusted_share: float
    trusted_error: float
    trusted_expected: float


def score_of(data: Dataset, test: Dataset, seen: Array) -> Scored:
    """Score a model of the captures on the test hours."""
    mode = "none" if data.patch_cdm2 is None else "absolute"
    model = fit(replace(data, seen=seen), patch=mode)
    made = model.predict(test.light, test.patch_cdm2)
    log = np.log10(np.maximum(made.luminance_cdm2, 1.0) / np.maximum(test.luminance_cdm2, 1.0))
    error, expected, trusted = (
        (log[:, seen] ** 2).mean(axis=1),
        made.expected_mse,
        trusted_hours(made),
    )
    of_trusted = [float(x[trusted].mean()) if trusted.any() else np.nan for x in (error, expected)]
    return Scored(float(error.mean()), float(expected.mean()), float(trusted.mean()), *of_trusted)


@dataclass(frozen=True)
class Judged:
    """What one room with one draw of a user's errors gave; errors are log10 MSE by geometry."""

    name: str
    draw: int
    errors: dict[str, float]
    scene: Scene
    off: dict[str, tuple[float, float]]  # fitted less true, and the stated uncertainty
    cpu_s: float
    hours: Scored | None = None  # of the chosen geometry, if its errors were taken

    @property
    def row(self) -> str:
        """One line of the table."""
        chosen = self.scene.chosen
        expected = self.scene.expected_log10_mse
        ratio = "-" if expected is None else f"{expected / self.errors[chosen]:.1f}"
        shown = [f"{self.errors[g]:.1e}" if g in self.errors else "-" for g in GEOMETRIES]
        angles = [f"{off:+.2f} ({u:.2f})" for off, u in (self.off[n] for n in SHOWN)]
        trusted = "yes" if self.scene.trusted else "no"
        hours = ["-", "-"]
        if self.hours is not None:
            factor = self.hours.trusted_error / self.hours.trusted_expected
            hours = [f"{100.0 * self.hours.trusted_share:.0f} %", f"{factor:.1f}"]
        cells = [self.name, str(self.draw), *shown, chosen, ratio, trusted, *hours, *angles]
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


def judge_room(path: Path, draw: int, hours: Array | None, wanted: argparse.Namespace) -> Judged:
    """Fit and judge one room; hours: rows of the captures to use, None for all."""
    user, test, exact, north, clock = user_of(path, draw)
    if hours is not None:
        user, exact = user.take(hours), (exact[0].take(hours), exact[1])
    stated = user.setup.room
    assert stated is not None
    begin = time.process_time()
    found = fit_scene(user, stated, pixels=wanted.pixels)
    scene = judged_scene(user, found)
    cpu = time.process_time() - begin
    if wanted.pictures:
        draw_scene(wanted.pictures / path.stem, user, found, scene_evidence(user, stated))
    pairs = {
        "none": (with_box(user, None), with_box(test, None)),
        "stated": (with_box(user, stated), with_box(test, stated)),
        "fitted": (
            fitted(user, found, captures=True),
            fitted(test, found, captures=False),
        ),
        "exact geometry": exact_pair(path, *exact, clock),
        "exact patches": exact,
    }
    pairs = {name: pairs[name] for name in wanted.geometries.split(",")}
    seen = draw_pixels(user, np.random.default_rng(9), wanted.scored)
    scores = {name: score_of(*pair, seen) for name, pair in pairs.items()}
    errors = {name: score.error for name, score in scores.items()}
    off = offsets(path, found, stated, north, clock)
    return Judged(path.stem, draw, errors, scene, off, cpu, scores.get(scene.chosen))


def offsets(
    path: Path, scene: Scene, stated: Room, north: float, clock: float
) -> dict[str, tuple[float, float]]:
    """Fitted less true and stated uncertainty, by parameter."""
    room, _ = ROOMS[path.stem]()
    with np.load(path) as stored:
        tilt, roll = map(float, stored["level_deg"])
    azimuth = stated.wall_azimuth_deg
    true = guess_of(replace(room, wall_azimuth_deg=azimuth), azimuth)
    true = replace(true, north_deg=north, clock_min=clock, tilt_deg=tilt, roll_deg=roll)
    return {
        p.name: (scene.after[p.name] - p.read(true), scene.u[p.name]) for p in room_parameters(true)
    }


def summary(rows: Sequence[Judged]) -> str:
    """Return what the rows have in common, one statement a line."""
    both = [r.errors for r in rows if {"fitted", "exact geometry"} <= r.errors.keys()]
    ratios = [errors["fitted"] / errors["exact geometry"] for errors in both] or [np.nan]
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


def four_days(path: Path, draw: int) -> Array:
    """Rows of four days spread evenly over the captured days."""
    user = user_of(path, draw)[0]
    days = np.unique(user.days)
    kept = days[np.linspace(0, len(days) - 1, 4).round().astype(int)]
    return np.flatnonzero(np.isin(user.days, kept))


DAYS = {"two-days": two_days, "four-days": four_days}


def judge_rooms(wanted: argparse.Namespace) -> None:
    """Print a line of the table for each room, draw and number of clear hours; then a summary."""
    head = ["room", "draw", *GEOMETRIES, "chosen", "expected / error", "trusted"]
    head += ["hours trusted", "their error / expected"]
    head += [f"{n.rpartition('_')[0]} off (u)" for n in SHOWN] + ["CPU s"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|", flush=True)
    rows = []
    few = wanted.few.split(",")
    for name in wanted.names or ROOMS:
        for draw in range(1, wanted.draws + 1):
            path = wanted.out / f"{name}.npz"
            for number in few:
                hours = None
                if number in DAYS:
                    hours = DAYS[number](path, draw)
                elif number:
                    hours = few_hours(path, draw, int(number))
                try:
                    rows.append(judge_room(path, draw, hours, wanted))
                except FieldlumError as error:
                    print(f"| {name} | {draw} | refused: {error} |", flush=True)
                    continue
                row = rows[-1]
                label = f"{name}, {number} clear hours" if number.isdigit() else name
                label = f"{name}, {number}" if number in DAYS else label
                print(replace(row, name=label).row, flush=True)
                if number or wanted.verdicts:
                    print(f"   {row.scene.verdict}; {'; '.join(row.scene.notes)}", flush=True)
    print("\n" + summary(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--scored", type=int, default=1500, help="pixels that errors are taken at")
    parser.add_argument("--pixels", type=int, default=PIXELS, help="pixels of the fit's evidence")
    every = ",".join(GEOMETRIES)
    parser.add_argument("--geometries", default=every, help="of which errors are taken")
    parser.add_argument("--pictures", type=Path, help="folder for overlays, windows and plans")
    parser.add_argument("--verdicts", action="store_true", help="print the verdicts' reasons")
    parser.add_argument("--few", default="", help="numbers of clear hours that stay, or days")
    judge_rooms(parser.parse_args())


if __name__ == "__main__":
    main()
