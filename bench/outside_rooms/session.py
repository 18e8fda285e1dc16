"""Judge a whole session in a room of another renderer: from raw frames to DGP.

    python bench/outside_rooms/session.py FIELDLUM OUT NAME [NAME ...] [--camera PROFILE]

OUT/NAME/ and OUT/NAME.toml are by `render.py --fine`. The simulated camera and pyranometer capture
the rendered nine days in OUT/NAME/session, whose site is that of the tape measure; then merge,
pair, scene fit and train run as a user runs them. `judge.py` reads pictures that lack nothing;
here merge decides what was seen, where the sun is, and how well. The test hours are the renderer's.
Prints a line of JSON a room: errors without patches (none), with the tape's room (box), with the
fitted scene (scene), and the model that train chose.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import tomllib
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from judge import discs, figures, run
from make_case import write_case
from numpy.typing import NDArray

from fieldlum import demo
from fieldlum.core.records import Panorama, Slot, SunSource
from fieldlum.optics.images import read_radiance_hdr, write_panorama
from fieldlum.optics.profiles import bracket_exposures, load_camera_profile
from fieldlum.room.simulate import make_session
from fieldlum.session import Session
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.folder import PlanTable
from fieldlum.session.site_toml import load_site
from fieldlum.sky.daylight import light_at
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sky_view.visible_disc import disc_of_hours, drawn_shares

Array = NDArray[Any]
Row = dict[str, str]
STAGES = (
    ["merge", "--size", "116x58"],
    ["pair"],
    ["scene", "fit"],
    ["train", "--model", "transport"],
)
_HALF_HOUR = timedelta(minutes=30)  # weather is of an hour around its time


def without_disc(luminance_cdm2: Array, altitude_deg: float, right_deg: float) -> Array:
    """Return a picture [h, 2 h] whose sun's disc is filled by the median of a ring around it.

    right_deg: azimuth of the sun from the picture's centre, clockwise.
    """
    h = len(luminance_cdm2)
    up = np.radians(90.0 - (np.arange(h) + 0.5) / h * 180.0)[:, None]
    across = np.radians(((np.arange(2 * h) + 0.5) / (2 * h) - 0.5) * 360.0 - right_deg)
    sun = np.radians(altitude_deg)
    cosine = np.sin(up) * np.sin(sun) + np.cos(up) * np.cos(sun) * np.cos(across)
    off_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    filled = luminance_cdm2.copy()
    filled[off_deg < 0.9] = np.median(luminance_cdm2[(off_deg > 1.0) & (off_deg < 1.8)])
    return filled


def rows(path: Path, part: str) -> list[Row]:
    """Return the rows of truth.csv that are captures (9d) or test hours (test)."""
    with path.open() as file:
        return [row for row in csv.DictReader(file) if row["set"] == part]


def make(out: Path, name: str, camera: str) -> Session:
    """Write a session whose truth/ is what the other program rendered, and return it."""
    fine, room = out / name, tomllib.loads((out / f"{name}.toml").read_text())
    site = fine / "tape.toml"
    site.write_text(room["tape"].replace("[camera]\n", f'[camera]\nprofile = "{camera}"\n'))
    setup = load_site(site)
    profile = load_camera_profile(camera)
    turned_deg = setup.camera.heading_deg - room["heading_deg"]  # tape's error of north
    with (fine / "9d.csv").open() as file:
        measured = {row["t_utc"]: row for row in csv.DictReader(file)}
    times, suns, slots = [], [], []
    for row in rows(fine / "truth.csv", "9d"):
        t_utc = datetime.fromisoformat(row["t_utc"])
        lux = float(row["normal_lx"])
        pair = measured[row["t_utc"]]
        times.append((t_utc, *(float(pair[f"{key}_wm2"]) for key in ("ghi", "dhi", "dni"))))
        apparent = float(row["apparent_altitude_deg"])
        azimuth = float(row["azimuth_deg"])
        sun = SunSource(apparent, (azimuth + turned_deg) % 360.0, lux, float(row["share"]))
        suns.append(sun if lux > 0 else None)
        exposures = tuple(bracket_exposures(profile.bracket, "nd5"))
        altitude = float(pair["sun_altitude_deg"])
        slots.append(Slot(t_utc, altitude, azimuth, exposures))
    shutil.rmtree(fine / "session", ignore_errors=True)
    first, last = slots[0].t_utc.date(), slots[-1].t_utc.date()
    about: PlanTable = {"set": "9-day", "revision": 0, "start": first, "first": first, "last": last}
    about |= {"seconds_per_slot": 60.0, "megabytes_per_slot": 10.0}
    session = make_session(fine / "session", setup, slots, about)
    session.truth.mkdir()
    for slot, sun in zip(slots, suns, strict=True):
        picture, _ = read_radiance_hdr(fine / "panoramas" / f"{slot.id}.hdr")
        values = picture.luminance_cdm2
        if sun is not None:
            right_deg = sun.azimuth_deg - setup.camera.heading_deg
            values = without_disc(values, sun.altitude_deg, right_deg)
        made = Panorama(values, setup.camera.heading_deg, t_utc=slot.t_utc, sun=sun)
        write_panorama(session.truth_panorama(slot.id), made)
    second = timedelta(seconds=1)
    edges = [(t - _HALF_HOUR, *v) for t, *v in times] + [
        (t + _HALF_HOUR - second, *v) for t, *v in times
    ]
    t, ghi, dhi, dni = zip(*sorted(edges), strict=True)
    seconds = np.array([some.timestamp() for some in t])
    light = {"ghi_wm2": np.array(ghi), "dhi_wm2": np.array(dhi), "dni_wm2": np.array(dni)}
    CleanIrradiance(t_unix_s=seconds, **light).write(session.truth_irradiance)
    return session


def disc_figures(folder: Path, session: Session) -> dict[str, Any]:
    """Return how the session's sky view shows the disc of the test hours, by the renderer's truth.

    holds: share of the sunny hours whose true share of the beam is inside the 95 % interval;
    cannot_tell: hours whose interval has both no disc and a disc.
    """
    truth = rows(folder / "truth.csv", "test")
    with (folder / "test.csv").open() as file:
        dhi = {row["t_utc"]: float(row["dhi_wm2"]) for row in csv.DictReader(file)}
    times = [datetime.fromisoformat(row["t_utc"]) for row in truth]
    dni = np.array([float(row["dni_wm2"]) for row in truth])
    site = session.site_file().site
    light = light_at(times, site, dni, np.array([dhi[row["t_utc"]] for row in truth]))
    sunny = light.direct_lx > 1000.0
    true = np.array([float(row["share"]) * float(row["glass"]) for row in truth])[sunny]
    view = SkyView.read(session.sky_view)
    own = np.nan_to_num(disc_of_hours(view, light).best_lx[sunny]) / light.direct_lx[sunny]
    drawn = np.nan_to_num(drawn_shares(view, light[sunny], np.random.default_rng(0)))
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
    there, shown = true > 0.02, own > 0.02
    holds = (true >= low - 0.02) & (true <= high + 0.02)
    return {
        "hours": int(there.sum()),
        "shown": int((there & shown).sum()),
        "absent": int((~there).sum()),
        "phantom": int((~there & shown).sum()),
        "share_rms": float(np.sqrt(((own - true)[there] ** 2).mean())) if there.any() else None,
        "holds": float(holds.mean()),
        "holds_with_disc": float(holds[there].mean()) if there.any() else None,
        "cannot_tell": int(((low <= 0.02) & (high > 0.02)).sum()),
    }


def judge(fieldlum: str, out: Path, name: str, camera: str) -> dict[str, Any]:
    """Return the figures of one room."""
    if (out / name / "session" / "pairs.csv").is_file():
        session = Session(out / name / "session")
    else:
        session = make(out, name, camera)
        demo.capture(session)
    row: dict[str, Any] = {"room": name}
    for stage in STAGES:
        command = [fieldlum, *stage, str(session.root)]
        done = subprocess.run(command, capture_output=True, text=True)
        (out / name / f"{stage[0]}.txt").write_text(done.stdout + done.stderr)
        if done.returncode:
            row[stage[0]] = (done.stderr.strip().splitlines() or ["no message"])[-1]
    row["disc"] = disc_figures(out / name, session)
    write_case(tomllib.loads((out / f"{name}.toml").read_text()), out / f"{name}.npz", out / name)
    site, test = (str(out / name / "tape" / file) for file in ("site.toml", "test.csv"))
    scene = str(session.root / "scene")
    for kind, model, patches in (
        ("none", "transport:none", "none"),
        ("box", "transport", "none"),
        ("scene", "transport", scene),
    ):
        command = [fieldlum, "bench", str(session.root), "--test", test, "--site", site]
        command += ["--scene", patches, "--models", model, "--render", "0", "--json"]
        answer, why, _ = run([*command, "--out", str(out / name / f"o_{kind}")])
        row[kind] = figures(answer) if answer else why
        if answer:
            row[kind] |= discs(fieldlum, [str(session.root), test, site], patches, model)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("fieldlum")
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--camera", default="sim-dual-fisheye")
    wanted = parser.parse_args()
    for name in wanted.names:
        print(json.dumps(judge(wanted.fieldlum, wanted.out, name, wanted.camera)), flush=True)


if __name__ == "__main__":
    main()
