"""What each trouble of a campaign costs, alone and together, and what the tool reported.

    python bench/hard_campaign.py FOLDER [--site office.toml] [--troubles troubles.toml]
        [--seeds 0,1,2] [--names all,north,...]

Simulates nine days of a room (the shipped office) with each trouble of the file alone, with all and
with none, trains light transport on the pictures, and scores it on hours of the year that were
rendered without troubles. `--names without-north` has all troubles but one. Every fifth day of the
year is then predicted and compared with its truth (a wrong north is in that truth, because it
lasts): whether the DGP that 5 % of the occupied hours exceed is inside its stated 95 % interval,
and whether a class of EN 17037 is stated and right. Each row is written to FOLDER/rows.jsonl; the
table has the median and the worst of the seeds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from predicted_glare import predicted_year
from troubles import (
    Troubles,
    load_troubles,
    measured_irradiance,
    troubled_pictures,
    true_light,
)

from fieldlum import plan
from fieldlum.bench import markdown
from fieldlum.core.arrays import Floats
from fieldlum.core.records import Slot
from fieldlum.learn.models import fit
from fieldlum.learn.models.scores import evaluate, summary, truth
from fieldlum.learn.models.training_data import Dataset, load_pairs
from fieldlum.learn.train import held_out_warnings, model_notes
from fieldlum.learn.train.outliers import without_changes
from fieldlum.optics.images import write_panorama
from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate
from fieldlum.room.fit.misplaced_patches import misplacement_of, warnings_of
from fieldlum.session import Session, create_session, open_session
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.site_toml import load_site
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at
from fieldlum.sky.sky_view.visible_disc import disc_lx
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views, view_azimuths_deg

HARD = Path(__file__).with_name("troubles.toml")
YEAR_STEP = 5  # every fifth day of the year is rendered
COLUMNS = {
    "trouble": "trouble",
    "seeds": "seeds",
    "mse": "log10 MSE, median (worst)",
    "times": "x clean",
    "expected": "expected / actual",
    "dgp": "DGP MSE, disc of the room",
    "trusted": "trusted",
    "inside": "hours inside 95 %",
    "year_inside": "directions inside 95 %",
    "wrong": "classes wrong",
    "decided": "decided",
    "named": "named",
}

# Words of the notes of `train` that name a trouble. No note names the other troubles.
NAMED_BY = {
    "clouds": "the sky in the windows was",
    "north": "heading_deg and wall_azimuth_deg",
    "knock": "camera was turned",
    "lamps": "a lamp was on, but not marked",
    "blind": "a moved blind",
}


def troubles_named(notes: Iterable[str]) -> list[str]:
    """Return the names in `NAMED_BY`, in its order, whose words occur in the notes of `train`.

    These are possible causes, also of troubles that were not simulated.
    """
    texts = list(notes)
    return [name for name, words in NAMED_BY.items() if any(words in text for text in texts)]


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
    parser.add_argument("--seeds", default="0", help="with commas")
    parser.add_argument("--hours", type=int, default=80)
    parser.add_argument(
        "--names", default="", help="some troubles, all, none or without-TROUBLE, with commas"
    )
    asked = parser.parse_args()
    wrong = load_troubles(asked.troubles)
    tests = _tests(asked, wrong)
    names = asked.names.split(",") if asked.names else ["none", *wrong.names, "all"]
    rows: list[dict[str, Any]] = []
    for seed in map(int, asked.seeds.split(",")):
        some = seeded(wrong, 100 * seed)
        for name in names:
            if name == "none" and rows:  # it has no seed
                continue
            troubles = _chosen(some, name)
            data = _campaign(asked, asked.folder / f"{name}-{seed}", _nine_days(asked), troubles)
            row = {"trouble": name, "seed": seed} | _row(data, tests, troubles, asked.folder)
            with (asked.folder / "rows.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
            print(markdown(_table(rows)[-1:], COLUMNS).splitlines()[-1], flush=True)
    print(markdown(_table(rows), COLUMNS))


def seeded(troubles: Troubles, seed: int) -> Troubles:
    """Return the troubles with `seed` added to the seed of each."""
    some = ((name, getattr(troubles, name)) for name in troubles.names)
    return replace(troubles, **{name: replace(one, seed=one.seed + seed) for name, one in some})


def _chosen(every: Troubles, name: str) -> Troubles | None:
    """Return the troubles of a row: none, all, all without one, or one."""
    if name in ("none", "all"):
        return every if name == "all" else None
    if name.startswith("without-"):
        left_out = name.removeprefix("without-")
        return replace(every, **{left_out: None})
    return Troubles(**{name: getattr(every, name)})


def _table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each trouble, with the median and the worst of its seeds."""
    clean = next((r["log10_mse_weighted"] for r in rows if r["trouble"] == "none"), np.nan)
    table = []
    for name in dict.fromkeys(row["trouble"] for row in rows):
        of = [row for row in rows if row["trouble"] == name]
        errors = np.array([row["log10_mse_weighted"] for row in of])
        expected = np.array([row["expected_log10_mse"] for row in of])
        dgp = np.array([row["dgp_mse_own_disc"] for row in of])
        total = {
            key: sum(row["year"][key] for row in of)
            for key in ("year_inside", "wrong", "decided", "directions")
        }
        missing = {text for row in of for text in row["not_named"]}
        table.append(
            {
                "trouble": name,
                "seeds": ", ".join(str(row["seed"]) for row in of),
                "mse": f"{np.median(errors):.1e} ({errors.max():.1e})",
                "times": f"{np.median(errors) / clean:.1f} ({errors.max() / clean:.1f})",
                "expected": f"{np.median(expected / errors):.2f}",
                "dgp": f"{np.median(dgp):.1e} ({dgp.max():.1e})",
                "trusted": f"{np.median([row['trusted_share'] for row in of]):.2f}",
                "inside": f"{np.median([row['year']['inside'] for row in of]):.2f}",
                "year_inside": f"{total['year_inside']} of {total['directions']}",
                "wrong": total["wrong"],
                "decided": f"{total['decided']} of {total['directions']}",
                "named": "; ".join(
                    f"{t}: {sum(t in r['named'] for r in of)} of {len(of)}"
                    for t in sorted({t for r in of for t in r["named"]} | missing)
                ),
            }
        )
    return table


# ----------------------------------------------------------------------------------------------
# campaigns


@dataclass(frozen=True, slots=True)
class _Tests:
    """Clean hours of the year, and the year with the stated and with the true north."""

    hours: Dataset
    year: Dataset
    turned_year: Dataset


def _nine_days(asked: argparse.Namespace) -> list[Slot]:
    request = plan.Request("9-day", today=date(2027, 1, 1), year=2027)
    return list(plan.make_plan(load_site(asked.site), request).slots)


def _tests(asked: argparse.Namespace, wrong: Troubles) -> _Tests:
    setup = load_site(asked.site)
    weather = simulate.weather_for(setup)
    captured = [slot.t_utc for slot in _nine_days(asked)]
    hours = simulate.sample_slots(setup, weather, asked.hours, 1, captured)
    zone = setup.site.timezone
    every = [
        t
        for t in weather.daylight().t_utc
        if sun.standard_date(t, zone).timetuple().tm_yday % YEAR_STEP == 0
    ]
    at = sun.position(every, setup.site)
    year = [
        Slot(t, float(a), float(z), ())
        for t, a, z in zip(every, at.altitude_deg, at.azimuth_deg, strict=True)
    ]
    turned = Troubles(north=wrong.north) if wrong.north else None
    return _Tests(
        _campaign(asked, asked.folder / "test", hours, None),
        _campaign(asked, asked.folder / "year", year, None),
        _campaign(asked, asked.folder / "year-north", year, turned),
    )


def _campaign(
    asked: argparse.Namespace, out: Path, slots: list[Slot], troubles: Troubles | None
) -> Dataset:
    """Return the hours of `slots` as training data."""
    setup = load_site(asked.site)
    made = (out / "session.toml").is_file()
    session = open_session(out) if made else create_session(out, setup, slots, {"set": "hard"})
    if not made:  # a second rendering would write the readings without their troubles
        weather = simulate.weather_for(setup)
        simulate.run(session, weather, height=asked.height, quality="draft")
        if troubles is not None:
            _trouble(session, troubles, asked.height)
    return load_pairs(session)


def _trouble(session: Session, troubles: Troubles, height: int) -> None:
    """Render the pictures of a simulated session again, with troubles, and change its readings."""
    setup, pairs = session.site_file(), PairsFile.read(session.pairs)
    rows = pairs.usable
    times = [row.t_utc for row in rows]
    dni, dhi = np.array([(row.dni_wm2, row.dhi_wm2) for row in rows]).T
    light = light_at(times, setup.site, dni, dhi)
    room = simulate.lit_room(setup, height=height, quality="draft")
    shown = room.render(true_light(light, troubles, setup.site))
    window, planned = room.view.sky > 0, [slot.t_utc for slot in session.slots()]
    maps = troubled_pictures(
        shown.luminance_cdm2, window, times, planned, setup.site.timezone, troubles
    )
    shown = replace(shown, luminance_cdm2=maps)
    for k, row in enumerate(rows):
        write_panorama(session.root / row.panorama, room.as_panorama(shown, k))
    measured = measured_irradiance(times, dni, dhi, light.sun_altitude_deg, troubles)
    new = (
        replace(row, dni_wm2=float(a), dhi_wm2=float(b), ghi_wm2=np.nan)
        for row, a, b in zip(rows, *measured, strict=True)
    )
    PairsFile(session.pairs, tuple(new)).write()


# ----------------------------------------------------------------------------------------------
# figures


def _row(data: Dataset, tests: _Tests, troubles: Troubles | None, folder: Path) -> dict[str, Any]:
    read = data.notes
    data, changes = without_changes(data, with_patch=True)
    moved = warnings_of(misplacement_of(data, "absolute"))
    fitted = fit("transport", data, patch="absolute", seed=0)
    notes = [*read, *changes, *model_notes(fitted, data, "absolute")]
    notes += [*held_out_warnings(fitted, data), *moved]
    scores = summary(evaluate(fitted, truth(tests.hours)))
    test = tests.hours
    predicted = fitted.predict(test.light, test.patch_cdm2).luminance_cdm2
    over = [
        int((_dgp(test, maps, disc) > 0.40).sum())
        for maps, disc in (
            (predicted, disc_lx(test.sky_view, test.setup, test.light)),
            (test.luminance_cdm2, None),
        )
    ]
    present = troubles.names if troubles is not None else ()
    named = troubles_named(notes)
    turned = troubles is not None and troubles.north is not None
    hours = tests.turned_year if turned else tests.year
    true_dgp = _dgp(hours, hours.luminance_cdm2, None)
    occupied = 10 * len(np.unique(hours.days))  # 08:00 to 18:00
    year = predicted_year(fitted, data, hours, true_dgp, folder, occupied_hours=occupied)
    return dict(scores) | {
        "hours_over": over,
        "named": named,
        "not_named": [t for t in present if t not in named],
        "notes": notes,
        "year": asdict(year),
    }


def _dgp(test: Dataset, maps: NDArray[np.float32], disc_lx: Floats | None) -> Floats:
    """Return DGP in ten directions, [n, d]; disc_lx: None for the true disc."""
    disc = test.disc_lx if disc_lx is None else disc_lx
    light = replace(test.light)
    azimuths = view_azimuths_deg(test.heading_deg)
    views = panorama_views(*maps.shape[1:], test.heading_deg, azimuths)
    parts = [
        glare_directions(maps[rows], views, light.apparent_sun_direction[rows], disc[rows])["dgp"]
        for rows in (slice(k, k + 64) for k in range(0, len(maps), 64))
    ]
    return np.concatenate(parts)


if __name__ == "__main__":
    main()
