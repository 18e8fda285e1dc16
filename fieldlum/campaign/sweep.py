"""Compare models and seeds in every room of a campaign; a model with a seed is a unit of work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fieldlum.bench import TABLE, markdown, patient, write_csv
from fieldlum.bench.pieces import bench_files, score_pieces, unit_of
from fieldlum.bench.rows import BenchRow, over_seeds, parse_specs
from fieldlum.campaign.campaign_file import CampaignFile
from fieldlum.campaign.stages import RoomResult, guarded, without_pairs
from fieldlum.errors import InputError
from fieldlum.records import Progress, quiet
from fieldlum.scheduler import LOCAL, Scheduler, WorkUnit, run_units
from fieldlum.session import replacing


def run_sweep(
    campaign: CampaignFile,
    models: Sequence[str],
    out: Path,
    *,
    seeds: int = 1,
    budget_min: float = 5.0,
    scheduler: Scheduler = LOCAL,
    progress: Progress = quiet,
) -> tuple[list[RoomResult], str]:
    """Score models with seeds on held-out days of every room.

    Write sweep.csv and sweep.md to `out`; return what failed (a fit of a model, room and seed, or a
    room without pairs.csv), and the Markdown table of means over seeds. seeds: number of them,
    for each model and room, of which models without randomness use one; budget_min: time for
    the fits of one room, model and seed together [min], in which a quick model always runs two
    held-out folds. Raises InputError for a text that is no model's name, such as the folder of
    a trained model.
    """
    units, failed = _units(campaign, models, seeds, budget_min)
    rows: dict[str, list[BenchRow]] = {room.session: [] for room in campaign.rooms}
    outcomes = run_units(
        [unit for _, unit in units], patient(scheduler, budget_min), progress=progress
    )
    ended = {outcome.unit.name: outcome for outcome in outcomes}
    for room, unit in units:

        def scored(room: str = room, name: str = unit.name) -> str:
            row, _ = ended[name].result()
            rows[room].append(row)
            return name

        result = guarded(room, scored)
        if result.state == "failed":
            failed.append(replace(result, text=f"{unit.name}: {result.text}"))
    table = markdown(_with_rooms(rows, mean=True), {"room": "room", **TABLE})
    write_csv(out / "sweep.csv", _with_rooms(rows, mean=False))
    with replacing(out / "sweep.md", "w", encoding="utf-8") as file:
        file.write(table)
    return failed, table


def _units(
    campaign: CampaignFile, models: Sequence[str], seeds: int, budget_min: float
) -> tuple[list[tuple[str, WorkUnit]], list[RoomResult]]:
    """Return units with their rooms, and the rooms that have no pairs."""
    if any(spec.folder is not None for spec in parse_specs(models)):
        raise InputError(
            "--models",
            "the folder of a trained model",
            "names of models, to be trained in each room",
            "write names, or test the trained model with fieldlum bench",
        )
    units, failed = [], []
    for room in campaign.rooms:
        folder = campaign.session_folder(room)
        if (missing := without_pairs(room, folder)) is not None:
            failed.append(missing)
            continue
        files = bench_files(folder, models)
        for piece in score_pieces(models, seeds, 60.0 * budget_min):
            unit = unit_of(piece, files)
            units.append((room.session, replace(unit, name=f"{room.session} {unit.name}")))
    return units, failed


def _with_rooms(rows: Mapping[str, list[BenchRow]], *, mean: bool) -> list[dict[str, object]]:
    return [
        {"room": room, **row}
        for room, room_rows in rows.items()
        for row in (over_seeds(room_rows) if mean else room_rows)
    ]
