"""What each trouble of a campaign costs, alone and together, and what the tool reported.

    python bench/hard_campaign.py FOLDER [--site office.toml] [--troubles hard.toml] [--seeds 1]

Simulates nine days of a room (the shipped office) with each trouble of the file alone, with all and
with none, trains light transport on the pictures, and scores it on hours of the year that were
rendered without troubles. Prints a table.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum import plan, simulate
from fieldlum.bench import markdown
from fieldlum.glare import glare_directions, view_azimuths_deg
from fieldlum.models import fit
from fieldlum.models.data import Dataset, load_pairs
from fieldlum.models.disc_in_view import stated_disc_lx
from fieldlum.models.scores import evaluate, summary, truth
from fieldlum.profiles import shipped
from fieldlum.session import create_session, open_session
from fieldlum.simulate import Troubles, load_troubles
from fieldlum.site_toml import load_site
from fieldlum.train.consistency_warnings import doubts, hard_captures
from fieldlum.train.room_changes import without_changes
from fieldlum.train.setting import settle

HARD = shipped("capture_plans") / "troubles" / "hard.toml"
COLUMNS = {
    "trouble": "trouble",
    "seed": "seed",
    "log10_mse_weighted": "log10 MSE",
    "times_clean": "x clean",
    "bias_log10": "bias log10",
    "dgp_mse_own_disc": "DGP MSE, disc of the room",
    "hours_over": "hours above 0.40, predicted / true",
    "expected_log10_mse": "expected log10 MSE",
    "trusted_share": "trusted",
    "in_90_band": "in 90 %",
    "reported": "reported",
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--site", type=Path, default=shipped("capture_plans") / "seattle-office.toml"
    )
    parser.add_argument("--troubles", type=Path, default=HARD)
    parser.add_argument("--height", type=int, default=29)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--hours", type=int, default=80)
    parser.add_argument("--names", default="", help="some troubles alone, with commas")
    asked = parser.parse_args()
    wrong = load_troubles(asked.troubles)
    test = _campaign(asked, asked.folder / "test", None, asked.hours)
    names = asked.names.split(",") if asked.names else wrong.names
    rows: list[dict[str, Any]] = []
    for seed in range(asked.seeds):
        some = wrong.seeded(100 * seed)
        cases = {"none": None, **{n: some.only(n) for n in names}, "all": some}
        for name, troubles in cases.items():
            if name == "none" and seed:
                continue
            out = asked.folder / f"{name}-{seed}"
            data = _campaign(asked, out, troubles)
            rows.append({"trouble": name, "seed": seed} | _row(data, test))
            rows[-1]["times_clean"] = rows[-1]["log10_mse_weighted"] / rows[0]["log10_mse_weighted"]
            print(markdown(rows[-1:], COLUMNS).splitlines()[-1], flush=True)
    print(markdown(rows, COLUMNS))


def _campaign(
    asked: argparse.Namespace, out: Path, troubles: Troubles | None, hours: int = 0
) -> Dataset:
    """Return nine days of the room, or `hours` hours of the year, as training data."""
    setup = load_site(asked.site)
    weather = simulate.weather_for(setup)
    request = plan.Request("9-day", today=date(2027, 1, 1), year=2027)
    slots = plan.make_plan(setup, request).slots
    if hours:
        known = [slot.t_utc for slot in slots]
        slots = simulate.sample_slots(setup, weather, hours, 1, known)
    made = (out / "session.toml").is_file()
    session = open_session(out) if made else create_session(out, setup, slots, {"set": "hard"})
    simulate.run(
        session,
        weather,
        height=asked.height,
        quality="draft",
        troubles=troubles,
        cache=asked.folder,
        workers=1,
    )
    return load_pairs(session)


def _row(data: Dataset, test: Dataset) -> dict[str, Any]:
    data, changes = without_changes(data, with_patch=True)
    fitted = fit("transport", data, patch="absolute", seed=0)
    fitted, setting = settle(fitted, data, "absolute")
    said = [*changes, *doubts(fitted, data), *hard_captures(fitted, data), *setting]
    found = summary(evaluate(fitted, truth(test)))
    predicted = fitted.predict(test.light, test.patch_cdm2).luminance_cdm2
    own = stated_disc_lx(test.setup, test.light)
    over = [
        _over(test, maps, disc) for maps, disc in ((predicted, own), (test.luminance_cdm2, None))
    ]
    reported = "; ".join(text.removeprefix("WARNING: ").split(":")[0][:70] for text in said)
    return found | {"hours_over": f"{over[0]} / {over[1]}", "reported": reported or "nothing"}


def _over(test: Dataset, maps: np.ndarray, disc_lx: np.ndarray | None) -> int:
    """Hours times directions with DGP above 0.40."""
    azimuths = view_azimuths_deg(test.heading_deg)
    disc = test.disc_lx if disc_lx is None else disc_lx
    light = replace(test.light)
    found = glare_directions(maps, test.heading_deg, azimuths, light.shown_sun_direction, disc)
    return int((found["dgp"] > 0.40).sum())


if __name__ == "__main__":
    main()
