"""`fieldlum bench`: compare the models' speed and accuracy on any pairs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli.estimates import bench_s, estimate_text
from fieldlum.cli.options import (
    PATH,
    budget_option,
    json_option,
    out_option,
    pairs_argument,
    scene_option,
    scheduler_of,
    scheduler_option,
    seeds_option,
    site_option,
    sky_view_option,
)
from fieldlum.cli.terminal import emit_json, progress, say, say_if
from fieldlum.learn.model_registry import MODELS

if TYPE_CHECKING:
    from fieldlum.bench.pieces import BenchData


@click.command()
@pairs_argument
@click.option("--test", type=PATH, help="Pairs to test on. [default: held-out days]")
@click.option(
    "--pool",
    type=PATH,
    help="Pairs of other seasons, of which --stress takes captures to train on.",
)
@site_option
@click.option(
    "--models",
    default=",".join(MODELS),
    show_default=True,
    help="Models to compare, separated by commas: names, NAME:none or NAME:gain (use of sun "
    "patches), or folders of trained models.",
)
@seeds_option
@budget_option(5.0, "Minutes of training for the dense network.")
@click.option(
    "--curve", is_flag=True, help="Also draw the error by the number of captures: the longest part."
)
@click.option("--stress", is_flag=True, help="Also test conditions in which methods fail.")
@click.option(
    "--render",
    default=1,
    show_default=True,
    type=click.IntRange(min=0),
    help="Number of hours to render with Radiance, to compare the cost; needs a [room].",
)
@scene_option
@sky_view_option
@scheduler_option
@out_option("Folder of tables and charts", required=True)
@json_option
def command(
    pairs: Path,
    test: Path | None,
    pool: Path | None,
    site: Path | None,
    models: str,
    seeds: int,
    budget: float,
    curve: bool,
    stress: bool,
    render: int,
    scene: str,
    sky_view: Path | None,
    scheduler_text: str,
    out: Path,
    as_json: bool,
) -> None:
    """Chart speed against accuracy of the models.

    Writes bench.md, scores.csv and scores.png; with a year of data also periods; with --curve
    learning_curve, with --stress stress. The fitted scene of PAIRS is used for --test and --pool
    too. Without a scene, sun patches that a csv lacks are computed from the [room]; with few clear
    hours, PAIRS decide first whether the [room] is used, as in train.

    \b
    Example:
      fieldlum bench 9d.csv --test test.csv --models transport,transport:none,dense --out bench-9d
      fieldlum bench my-session --stress --scheduler processes:2 --out bench
    """
    from fieldlum.bench import run
    from fieldlum.bench.pieces import bench_files, load

    scheduler = scheduler_of(scheduler_text)
    files = bench_files(
        pairs,
        models.split(","),
        test=test,
        pool=pool,
        site=site,
        scene=scene,
        sky_view=sky_view,
    )
    with progress("reading pictures") as show:
        loaded = load(files, show)
    for note in loaded.data.notes:
        say(note)
    needed_s = _needed_s(loaded, files.models, seeds, budget, render, curve, stress)
    say_if(estimate_text(needed_s, scheduler.processes))
    with progress("benchmark") as show:
        answer = run(
            loaded,
            files.models,
            seeds=seeds,
            budget_min=budget,
            with_curve=curve,
            with_stress=stress,
            render_hours=render,
            out=out,
            scheduler=scheduler,
            files=files,
            progress=show,
        )
    if as_json:
        emit_json(answer)
    else:
        click.echo((out / "bench.md").read_text(encoding="utf-8"))
    say(f"tables and charts in {out}")


def _needed_s(
    loaded: BenchData,
    models: tuple[str, ...],
    seeds: int,
    budget_min: float,
    render_hours: int,
    with_curve: bool,
    with_stress: bool,
) -> float:
    """Return how long the benchmark may take on one core [s]."""
    from fieldlum.bench import pieces, year
    from fieldlum.learn.train.folds import day_folds

    data = loaded.data
    specs = [spec for spec in map(loaded.spec, models) if spec.folder is None]
    chosen = pieces.curve_data(loaded)
    curve = 0 if chosen is None or not with_curve else 2 * sum(year.curve_counts(len(chosen[0])))
    room = data.setup.room
    return bench_s(
        sum(spec.name == "transport" for spec in specs),
        sum(MODELS[spec.name].slow for spec in specs) * seeds,
        len(data),
        data.shape[0] * data.shape[1],
        folds=len(day_folds(data)) if loaded.test is None else 1,
        curve_captures=curve,
        budget_min=budget_min,
        render_hours=render_hours if room is not None and room.kind == "box" else 0,
        with_stress=with_stress,
    )
