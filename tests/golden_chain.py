"""Run every stage of the quick demo on twelve small brackets and summarise what each one wrote.

`tests/test_golden.py` compares the summary with the stored one, `tests/golden/chain.json`. After an
intended change of results, renew the stored summary and state the figures before and after in
CHANGELOG.md:

    python tests/golden_chain.py
"""

from __future__ import annotations

import csv
import json
import math
import tempfile
from datetime import date
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from fieldlum import demo, merge, pair, plan
from fieldlum.learn import models, train
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.profiles import shipped
from fieldlum.pair import irradiance
from fieldlum.room import simulate
from fieldlum.session import Session, create_session
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.session.site_toml import load_site
from fieldlum.year import predict

STORED = Path(__file__).parent / "golden" / "chain.json"
HEIGHT = 23  # rows of the panoramas
BLOCK_ROWS, BLOCK_COLUMNS = 6, 12  # a panorama is compared by its geometric means over blocks
TOLERANCE = 0.003  # relative: floating point of another CPU moves a camera's raw value by one step
LEARNT_TOLERANCE = 0.02  # relative, of scores and predicted hours, which small maps amplify
SCORE_KEYS = (
    "log10_mse_weighted",
    "median",
    "worst",
    "dgp_mse",
    "rammg_mse",
    "expected_log10_mse",
    "in_90_band",
    "trusted_share",
)
PAIR_KEYS = (
    "t_utc",
    "panorama",
    "dni_wm2",
    "dhi_wm2",
    "ghi_wm2",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "steadiness",
    "sunpatch",
    "ok",
)
YEAR_KEYS = ("hours", "height", "width", "azimuths_deg", "disc_from")


def run_chain(root: Path) -> Session:
    """Capture, merge, pair, train and predict in `root`, as `fieldlum demo` does, with transport
    alone.
    """
    setup = load_site(shipped("capture_plans") / "seattle-office.toml")
    request = plan.Request("9-day", today=date(demo.YEAR, 1, 1), year=demo.YEAR)
    slots = plan.make_plan(setup, request).slots[:36:3]  # three March days, every third hour
    session = create_session(root / "session", setup, slots, {"set": "golden"})
    weather = shipped("capture_plans") / demo.WEATHER
    year = simulate.weather_for(session.site_file(), weather)
    simulate.run(session, year, height=HEIGHT, quality="draft")
    demo.capture(session)
    merge.run(session, merge.MergeOptions(height=HEIGHT))
    irradiance.run(session)
    pair.run(session)
    model = session.models / "transport"
    # Without a clock: a busy machine would leave out held-out days, and change the scores.
    with patch.object(train, "monotonic", lambda: 0.0):
        train.run(load_pairs(session), "transport", seed=1, out=model)
    predict.run(model, week_of(weather, root / "week.csv"))
    return session


def week_of(weather: Path, short: Path) -> Path:
    """Write the four days around the March equinox of a weather file to `short`."""
    lines = weather.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("month")) + 1
    days = [line for line in lines[start:] if line.split(",")[:2] in MARCH_DAYS]
    short.write_text("\n".join([*lines[:start], *days]) + "\n", encoding="utf-8")
    return short


MARCH_DAYS = (["3", "19"], ["3", "20"], ["3", "21"], ["3", "22"])


def summarise(session: Session) -> dict[str, Any]:
    """Return what the stages wrote, rounded to what another CPU reproduces."""
    model = session.models / "transport"
    year = session.root / "annual" / "transport"
    scores = json.loads((model / "scores.json").read_text(encoding="utf-8"))
    about = json.loads((year / "predict.json").read_text(encoding="utf-8"))
    return {
        "panoramas": {p.stem: _panorama(p) for p in sorted(session.panoramas.glob("*.exr"))},
        "sunpatches": {p.stem: _panorama(p) for p in sorted(session.sunpatches.glob("*.exr"))},
        "pairs": [{k: _value(row[k]) for k in PAIR_KEYS} for row in _rows(session.pairs)],
        "scores": {
            row["name"]: {key: _digits(row[key]) for key in SCORE_KEYS} for row in scores["models"]
        },
        "chosen": scores["chosen"],
        "model": models.read_config(model).model,
        "year": {key: about[key] for key in YEAR_KEYS},
        "classes": [[row["azimuth_deg"], row["class"]] for row in about["protection"]],
        "hourly": [
            {key: _value(text) for key, text in row.items()} for row in _rows(year / "hourly.csv")
        ][::6],
    }


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _panorama(path: Path) -> dict[str, Any]:
    """Geometric mean over blocks and the brightest pixel [cd/m2], the sun's illuminance [lx]."""
    panorama = read_panorama_with_sun(path)
    logs = np.log10(np.maximum(np.nan_to_num(panorama.luminance_cdm2), 0.1))  # [H, W]
    blocks = [
        np.array_split(rows, BLOCK_COLUMNS, axis=1) for rows in np.array_split(logs, BLOCK_ROWS)
    ]
    sun = panorama.sun
    return {
        "blocks_cdm2": [[_digits(float(10.0 ** block.mean())) for block in row] for row in blocks],
        "max_cdm2": _digits(float(np.nanmax(panorama.luminance_cdm2))),
        "sun_lx": None if sun is None else _digits(sun.normal_illuminance_lx),
        "flagged": None if panorama.flags is None else int((panorama.flags != 0).sum()),
    }


def _value(text: str) -> float | str:
    try:
        return _digits(float(text))
    except ValueError:
        return text


def _digits(value: float | None) -> Any:
    """Four significant digits."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.4g}")


def differences(
    stored: Any, current: Any, where: str = "", tolerance: float = TOLERANCE
) -> list[str]:
    """Return one line for each value that differs: numbers by over `tolerance` (relative, or 0.002
    absolute), all else at all. Keys that were added are no difference.
    """
    tolerance = LEARNT_TOLERANCE if where in (".scores", ".hourly") else tolerance
    if isinstance(stored, dict) and isinstance(current, dict):
        pairs = [(f"{where}.{key}", value, current.get(key)) for key, value in stored.items()]
    elif isinstance(stored, list) and isinstance(current, list) and len(stored) == len(current):
        pairs = [
            (f"{where}[{k}]", a, b) for k, (a, b) in enumerate(zip(stored, current, strict=True))
        ]
    elif isinstance(stored, float | int) and isinstance(current, float | int):
        equal = abs(stored - current) <= max(tolerance * abs(stored), 0.002)
        return [] if equal else [f"{where}: {stored} -> {current}"]
    else:
        return [] if stored == current else [f"{where}: {stored} -> {current}"]
    return [line for at, a, b in pairs for line in differences(a, b, at, tolerance)]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        current = summarise(run_chain(Path(folder)))
    if STORED.is_file():
        stored = json.loads(STORED.read_text(encoding="utf-8"))
        print("\n".join(differences(stored, current)) or "no difference")
    STORED.parent.mkdir(exist_ok=True)
    text = json.dumps(current, indent=None, separators=(",", ":"), ensure_ascii=False)
    text = text.replace('},"', '},\n"').replace("],[", "],\n[").replace("},{", "},\n{")
    STORED.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
