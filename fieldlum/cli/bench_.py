"""`fieldlum bench`: compare the models' speed and accuracy on any pairs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli.options import (
    PATH,
    json_option,
    out_option,
    pairs_argument,
    scene_option,
    site_option,
)
from fieldlum.cli.terminal import emit_json, progress, say
from fieldlum.model_registry import MODELS

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset


@click.command()
@pairs_argument
@click.option("--test", type=PATH, help="Pairs to test on. [default: held-out days]")
@click.option("--pool", type=PATH, help="Pairs of other seasons, for --stress.")
@site_option
@click.option(
    "--models",
    default=",".join(MODELS),
    show_default=True,
    help="Names, NAME:none or NAME:gain, or folders of trained models, separated by commas.",
)
@click.option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(min=1),
    help="Trainings of each random model, with seeds 0, 1, 2 ...",
)
@click.option(
    "--budget",
    default=5.0,
    show_default=True,
    type=click.FloatRange(min=0, min_open=True),
    help="Minutes of training for the dense network.",
)
@click.option("--stress", is_flag=True, help="Also test the regimes where methods fail.")
@click.option(
    "--render",
    default=1,
    show_default=True,
    type=click.IntRange(min=0),
    help="Hours to render with Radiance for the cost row; needs a [room].",
)
@scene_option
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
    stress: bool,
    render: int,
    scene: str,
    out: Path,
    as_json: bool,
) -> None:
    """Chart speed against accuracy of the models.

    Writes bench.md, scores.csv and .png, and where the data allow learning_curve, periods and
    stress. A fitted scene, or a [room] where the csv has no sun patches, also applies to --test
    and --pool.

    \b
    Example:
      fieldlum bench 9d.csv --test test.csv --models transport,transport:none,dense --out bench-9d
      fieldlum bench my-session --stress --out bench
    """
    from fieldlum.bench import run
    from fieldlum.models.data import load_pairs
    from fieldlum.scene_fit.apply import in_scene

    with progress("reading pictures") as show:

        def read(where: Path) -> Dataset:
            captures = load_pairs(where, site, progress=show)
            return in_scene(captures, pairs, scene, "absolute", progress=show)[0]

        data = read(pairs)
        asked = read(test) if test else None
        pool_data = read(pool) if pool else None
    with progress("benchmark") as show:
        answer = run(
            data,
            test=asked,
            pool=pool_data,
            models=models.split(","),
            seeds=seeds,
            budget_min=budget,
            with_stress=stress,
            render_hours=render,
            out=out,
            progress=show,
        )
    if as_json:
        emit_json(answer)
    else:
        click.echo((out / "bench.md").read_text(encoding="utf-8"))
    say(f"tables and charts in {out}")
