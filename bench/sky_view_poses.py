"""Wrong statements of a camera's pose, by the commands: do the intervals of DGP hold?

    python bench/sky_view_poses.py FIELDLUM OUT [NAME ...] [--only frames]

FIELDLUM is the command. Frames: an office is simulated and photographed once; then heading (1 and 5
degrees), level (1 degree) or lens scale (1 %) are stated wrongly, the [room] is removed, and merge,
pair, train and predict run, with the sun's discs in the captures and without. Curtain: pictures of
bench/outside_rooms/sky_view/curtain with a wrong heading, by train and predict. Prints for each:
the pose, hours x views whose 95 % interval holds the true DGP, hours that cannot tell (the interval
holds two classes of DGP), and hours with a wrong class among the others; then the same for views
with the sun in front of them, in which alone the disc counts.
"""

from __future__ import annotations

import argparse
import csv
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import product
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.projection import direction
from fieldlum.session import Session
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.sky import sun
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views

sys.path.insert(0, str(Path(__file__).parent / "outside_rooms"))
from make_case import write_case  # pyright: ignore[reportMissingImports]

HERE = Path(__file__).parent
CLASSES = (0.35, 0.40, 0.45)
WEATHER = HERE.parent / "capture_plans" / "seattle_dni_dhi.csv"
SITE = """
[site]
name = "poses"
latitude_deg = 47.6
longitude_deg = -122.3
timezone = "America/Los_Angeles"
[camera]
profile = "camera.toml"
filter = "nd5"
heading_deg = 180.0
height_m = 1.2
[room]
kind = "box"
width_m = 4.0
depth_m = 5.0
height_m = 3.0
camera_x_m = 2.0
camera_y_m = 2.0
wall_azimuth_deg = 180.0
[[room.window]]
wall = "south"
left_m = 0.5
width_m = 3.0
sill_m = 0.8
height_m = 1.9
frame_m = 0.06
panes = 3
transom_m = 2.1
"""


@dataclass(frozen=True)
class Wrong:
    """A statement less the truth: heading and tilt in degrees, lens scale."""

    heading_deg: float = 0.0
    tilt_deg: float = 0.0
    scale: float = 0.0


WRONG = {"true pose": Wrong(), "heading 1": Wrong(1.0), "heading 5": Wrong(5.0)}
WRONG |= {"tilt 1": Wrong(0.0, 1.0), "scale 1 %": Wrong(0.0, 0.0, 0.01)}


class Commands:
    """The command line."""

    def __init__(self, fieldlum: str) -> None:
        self.fieldlum = fieldlum

    def __call__(self, *words: str | Path) -> None:
        """Run a command; raise CalledProcessError if it fails."""
        subprocess.run([self.fieldlum, *map(str, words)], check=True, capture_output=True)


# ----------------------------------------------------------------------------------------------
# frames


def photographed(run: Commands, out: Path) -> tuple[Path, Path]:
    """Return a session with frames and true statements, and the pairs.csv of other true hours."""
    session, year, site = out / "true", out / "year", out / "site.toml"
    if not (year / "truth" / "pairs.csv").is_file():
        out.mkdir(parents=True, exist_ok=True)
        site.write_text(SITE)
        shutil.copy(HERE.parent / "calibration" / "sim-fisheye.toml", out / "camera.toml")
        small = ("--size", "116x58", "--quality", "draft", "--weather", WEATHER, "--force")
        run("simulate", site, *small, "--set", "4-day", "--out", session)
        devices = ("--camera", "sim:office", "--pyranometer", "sim:office", "--clock", "fast")
        run("capture", session, *devices)
        run("simulate", site, *small, "--count", "150", "--seed", "7", "--out", year)
    return session, year / "truth" / "pairs.csv"


def misstated(true: Path, to: Path, wrong: Wrong) -> None:
    """Copy a photographed session with a wrong pose and without its [room]."""
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(true, to, ignore=shutil.ignore_patterns("pairs.csv*", "sunpatches"))
    profile = (true.parent / "camera.toml").read_text()

    def by(match: re.Match[str]) -> str:
        value = float(match[2])
        changed = value * (1.0 + wrong.scale) if "radius" in match[1] else value + wrong.tilt_deg
        return f"{match[1]} = {changed}"

    profile = re.sub(r"^(tilt_deg|radius_px) = (\S+)", by, profile, flags=re.MULTILINE)
    (to / "camera.toml").write_text(profile)
    setup = (to / "session.toml").read_text()
    tables = re.split(r"^(?=\[)", setup, flags=re.MULTILINE)
    setup = "".join(t for t in tables if not re.match(r"\[+setup\.room", t))
    heading = f"heading_deg = {180.0 + wrong.heading_deg}"
    setup = setup.replace("heading_deg = 180.0", heading, 1)
    setup = setup.replace(str(true.parent / "camera.toml"), str((to / "camera.toml").absolute()))
    (to / "session.toml").write_text(setup)


def without_discs(session: Session) -> None:
    """Remove the captures whose picture shows the sun's disc."""
    for path in session.sidecar_files():
        if Sidecar.read(path).sun is not None:
            shutil.rmtree(session.raw / path.stem)
            for file in session.panoramas.glob(f"{path.stem}.*"):
                file.unlink()


def frames(run: Commands, out: Path, chosen: list[str]) -> None:
    """Print a row for each wrong statement, with discs and without."""
    true, pairs = photographed(run, out / "frames")
    names = [name for name in WRONG if not chosen or name in chosen]
    for discs, name in product((False, True), names):
        to = out / "frames" / f"{name.replace(' ', '-')}-{'discs' if discs else 'none'}"
        misstated(true, to, WRONG[name])
        run("merge", to, "--size", "116x58")
        if not discs:
            without_discs(Session(to))
        run("pair", to)
        model, year = to / "models" / "transport", to / "annual" / "transport"
        run("train", to, "--model", "transport")
        run("predict", model, "--weather", WEATHER)
        judge(f"frames, {name}", model, year, pairs)


# ----------------------------------------------------------------------------------------------
# curtain


def year_of(test: Path, to: Path, site: Site) -> None:
    """Write a weather year that has the test hours; other hours are overcast."""
    with test.open() as file:
        rows = {row["t_utc"]: row for row in csv.DictReader(file)}
    start = datetime(2027, 1, 1, 0, 30, tzinfo=UTC)
    times = [start + timedelta(hours=k) for k in range(8760)]
    at = sun.position(times, site)
    with to.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_utc", "dni_wm2", "dhi_wm2"])
        for t, altitude in zip(times, at.altitude_deg, strict=True):
            stamp = f"{t:%Y-%m-%dT%H:%M:%SZ}"
            overcast = 250.0 * max(float(np.sin(np.radians(altitude))), 0.0)
            row = rows.get(stamp, {"dni_wm2": 0.0, "dhi_wm2": round(overcast, 1)})
            writer.writerow([stamp, row["dni_wm2"], row["dhi_wm2"]])


def curtain(run: Commands, out: Path, chosen: list[str]) -> None:
    """Print a row for each wrong heading, with discs in the captures and without."""
    toml = HERE / "outside_rooms" / "sky_view" / "curtain.toml"
    room = tomllib.loads(toml.read_text())
    write_case(room, toml.parent / room["npz"], out / "curtain")
    case = out / "curtain" / "free"
    true = (case / "site.toml").read_text()
    captured, test = load_pairs(case / "9d.csv"), case / "test.csv"
    year_of(test, out / "curtain" / "year.csv", captured.setup.site)
    lines = (case / "9d.csv").read_text().splitlines()
    without = np.flatnonzero(captured.disc_lx <= 0.0)
    dark = [lines[0], *(lines[1 + k] for k in without)]
    names = [n for n in WRONG if ("heading" in n or "true" in n) and (not chosen or n in chosen)]
    for discs, name in product((False, True), names):
        to = out / "curtain" / f"{name.replace(' ', '-')}-{'discs' if discs else 'none'}"
        to.mkdir(exist_ok=True)
        heading = room["heading_deg"] + WRONG[name].heading_deg
        stated = re.sub(r"heading_deg = \S+", f"heading_deg = {heading}", true)
        (to / "site.toml").write_text(stated)
        (to / "9d.csv").write_text("\n".join(lines if discs else dark) + "\n")
        run("train", to / "9d.csv", "--model", "transport", "--out", to / "model")
        year = to / "year"
        run("predict", to / "model", "--weather", out / "curtain" / "year.csv", "--out", year)
        judge(f"curtain, {name}", to / "model", year, test)


# ----------------------------------------------------------------------------------------------
# figures


def judge(name: str, model: Path, year: Path, pairs: Path) -> None:
    """Print the row of a predicted year against the true DGP of other hours."""
    view = SkyView.read(model / "sky_view.exr")
    test = load_pairs(pairs)
    with (year / "hourly.csv").open() as file:
        predicted = {row["t_utc"]: row for row in csv.DictReader(file)}
    stamps = [f"{t:%Y-%m-%dT%H:%M:%SZ}" for t in test.light.t_utc]
    rows = [k for k, stamp in enumerate(stamps) if stamp in predicted]
    hours, some = [predicted[stamps[k]] for k in rows], test.take(rows)
    shown = [key[8:] for key in hours[0] if key.startswith("dgp_low@") and hours[0][key]]

    def values(column: str) -> Floats:
        return np.array([[float(hour[f"{column}@{az}"]) for az in shown] for hour in hours])

    low, high = values("dgp_low"), values("dgp_high")
    # the same part of the picture: a wrong heading names another azimuth for it
    off_deg = view.grid.heading_deg - some.heading_deg
    azimuths = np.array([float(az) for az in shown]) - off_deg
    views = panorama_views(*some.shape, some.heading_deg, azimuths)
    suns = some.light.apparent_sun_direction
    true = glare_directions(some.luminance_cdm2, views, suns, some.disc_lx)["dgp"]
    holds = (true >= low - 1e-3) & (true <= high + 1e-3)
    classes = [np.digitize(dgp, CLASSES) for dgp in (low, true, high)]
    open_ = classes[0] != classes[2]
    wrong = ~open_ & (classes[1] != classes[0])
    disc = some.disc_lx > 0.02 * np.maximum(some.light.direct_lx, 1.0)
    pose = view.pose
    front = some.light.direct_lx[:, None] > 1000.0
    front = front & (suns @ direction(0.0, azimuths).T > -0.1)
    with_disc = f"{holds[disc].mean():.3f}" if disc.any() else "no hour"
    print(
        f"{name}: {pose.discs} discs, heading {pose.heading_deg:+.2f}+-{pose.heading_sd_deg:.2f}, "
        f"tilt {pose.tilt_deg:+.2f}, scale {100 * pose.lens_scale:+.2f} %, {len(hours)} hours, "
        f"{disc.sum()} with disc, interval holds {holds.mean():.3f} (with disc {with_disc}), "
        f"cannot tell {open_.mean():.2f} (with disc {open_[disc].mean():.2f}), "
        f"wrong class {wrong.sum()}/{(~open_).sum()}; views with the sun in front: "
        f"{holds[front].mean():.3f}, {wrong[front].sum()}/{(~open_)[front].sum()}",
        flush=True,
    )


def main() -> None:
    """Print all rows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("fieldlum")
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", help="of wrong statements; default: all")
    parser.add_argument("--only", choices=("frames", "curtain"))
    asked = parser.parse_args()
    run = Commands(asked.fieldlum)
    if asked.only != "curtain":
        frames(run, asked.out, asked.names)
    if asked.only != "frames":
        curtain(run, asked.out, asked.names)


if __name__ == "__main__":
    main()
