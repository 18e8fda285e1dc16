"""What each command prints with --json on small inputs, as a list of keys.

`tests/test_json_keys.py` compares it with the kept list, tests/fixtures/json_keys.json: keys
may be added, never lost. After an addition: python tests/json_answers.py
"""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from fieldlum.cli import main, scene_command
from fieldlum.core.records import Exposure
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor, save_profile
from fieldlum.optics.raw.writing import write_dng
from fieldlum.room.fit.scene_file import read_scene

KEPT = Path(__file__).parent / "fixtures" / "json_keys.json"
SESSION = Path(__file__).parent / "fixtures" / "session-0.1.0"
SCENE = Path(__file__).parent / "fixtures" / "scene"  # written by `scene fit`
EXIT_CODES = {"doctor": (0, 3, 4)}  # depends on the computer
DARK_SITE = """[site]
name = "x"
latitude_deg = 47.6
longitude_deg = -122.3

[camera]
profile = "{profile}"
"""
SITE = """[site]
name = "x"
latitude_deg = 47.6
longitude_deg = -122.3

[room]
width_m = 3.0
depth_m = 4.0
height_m = 2.8
camera_x_m = 1.5
camera_y_m = 2.0
camera_z_m = 1.2

[[room.window]]
wall = "south"
left_m = 0.5
width_m = 2.0
sill_m = 0.9
height_m = 1.5
"""
CAMPAIGN = 'name = "x"\n[[room]]\nsession = "session"\nmodel = "nearest"\n'
WEATHER = "month,day,hour,dni_wm2,dhi_wm2\n" + "".join(
    f"{month},20,{hour}.5,{600 * (9 < hour < 15)},{100 * (9 < hour < 15)}\n"
    for month in (3, 12)
    for hour in range(24)
)


def answers(root: Path) -> dict[str, list[str]]:
    """Run each command in `root` and return the keys of its answer. A list's items are joined."""
    session = root / "session"
    shutil.copytree(SESSION, session)
    (root / "weather.csv").write_text(WEATHER, encoding="ascii")
    frames, profile = _frames(root)
    (root / "site.toml").write_text(SITE, encoding="utf-8")
    (root / "dark.toml").write_text(DARK_SITE.format(profile=profile), encoding="utf-8")
    (root / "CAMPAIGN.toml").write_text(CAMPAIGN, encoding="utf-8")
    model, picture = session / "models" / "nearest", session / "panoramas"
    picture /= "20271221T193000Z.exr"
    readings = [f"out.exr,{azimuth},0,{200 + azimuth % 7}" for azimuth in range(120, 250, 10)]
    head = "panorama,azimuth_deg,altitude_deg,luminance_cdm2"
    (root / "readings.csv").write_text("\n".join([head, *readings]), encoding="ascii")
    commands: dict[str, list[str | Path]] = {
        "plan": ["plan", root / "site.toml", "--set", "4-day", "--out", root / "planned"],
        "status": ["status", session],
        "doctor": ["doctor", root / "planned", "--camera", "sim:"],
        "simulate": [
            *("simulate", root / "site.toml", "--out", root / "simulated", "--count", "12"),
            *("--size", "16x8", "--quality", "draft"),
        ],
        "merge": ["merge", _captured(root, frames), "--size", "32x16"],
        "merge --frames": [
            *("merge", "--frames", *frames, "--camera", profile),
            *("--out", root / "out.exr", "--size", "32x16"),
        ],
        "calibrate scale": [
            *("calibrate", "scale", root / "readings.csv", "--camera", profile),
            *("--out", root / "scaled.toml"),
        ],
        "train": ["train", session, "--model", "nearest"],
        "predict": ["predict", model, "--weather", root / "weather.csv"],
        "campaign report": ["campaign", "report", root / "CAMPAIGN.toml"],
        "glare": ["glare", picture],
        "info panorama": ["info", picture],
        "info frame": ["info", frames[0]],
    }
    found = {name: keys_of(_answer(arguments)) for name, arguments in commands.items()}
    return {**found, "scene fit": keys_of(scene_command.answer_of(read_scene(SCENE)))}


def _answer(arguments: list[str | Path]) -> Any:
    result = CliRunner().invoke(main, [*map(str, arguments), "--json"])
    assert result.exit_code in EXIT_CODES.get(str(arguments[0]), (0,)), result.output
    return json.loads(result.stdout)


def _captured(root: Path, frames: list[Path]) -> Path:
    """Return a session with one bracket."""
    words = ["plan", root / "dark.toml", "--set", "month", "--start", "2027-03-20", "--days", "1"]
    words += ["--out", root / "captured"]
    result = CliRunner().invoke(main, list(map(str, words)))
    assert result.exit_code == 0, result.output
    folder = root / "captured" / "raw" / "20270320T193000Z"
    folder.mkdir(parents=True)
    for frame in frames:
        shutil.copy(frame, folder)
    return root / "captured"


def keys_of(value: Any) -> list[str]:
    """Return ``a.b[].c`` for each key of nested objects and lists, sorted."""
    if isinstance(value, dict):
        keys = set(value)
        for key, item in value.items():
            joint = "" if isinstance(item, list) else "."
            keys |= {f"{key}{joint}{rest}" for rest in keys_of(item)}
        return sorted(keys)
    if isinstance(value, list):
        inner = {key for item in value for key in keys_of(item)}
        return sorted(f"[].{key}" for key in inner)
    return []


def _frames(root: Path) -> tuple[list[Path], Path]:
    """Three frames of a uniform room of 200 cd/m2, and their camera's profile."""
    times_s = (0.5, 1 / 16, 1 / 128)
    camera = CameraProfile(
        CameraBody("small", "raw", 128, 64),
        (Lens((64.0, 32.0), 31.0, 180.0),),
        Bracket(4.0, 100.0, times_s),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )
    save_profile(root / "small.toml", camera)
    rng, frames = np.random.default_rng(1), []
    for i, time_s in enumerate(times_s):
        mean = 200.0 * z_per_cdm2(time_s, 4.0, 100.0) * (4095 - 256)
        noise = np.sqrt(mean / 2 + (5 / 2) ** 2)
        counts = np.clip(256 + mean + noise * rng.standard_normal((64, 128)), 0, 4000)
        frames.append(root / f"{i}.dng")
        write_dng(
            frames[-1],
            np.round(counts).astype(np.uint16),
            Exposure(time_s, 4.0),
            black_dn=(256,) * 4,
            white_dn=4095,
        )
    return frames, root / "small.toml"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        found = answers(Path(folder))
    KEPT.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
