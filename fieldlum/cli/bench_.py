"""`fieldlum bench`: compare the models' speed and accuracy on any pairs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from fieldlum.cli.estimates import bench_s, estimate_text
from fieldlum.cli.options import Above0, command_of
from fieldlum.cli.terminal import emit_json, progress, say, say_if
from fieldlum.learn.model_registry import MODELS

if TYPE_CHECKING:
    from fieldlum.bench.rows import BenchData


@command_of("bench")
def command(
    pairs: Path,
    out: Path,
    test: Path | None = None,
    pool: Path | None = None,
    site: Path | None = None,
    models: str = ",".join(MODELS),
    budget: Above0 = 5.0,
    stress: bool = False,
    render: Annotated[int, click.IntRange(min=0)] = 1,
    scene: str = "",
    sky_view: Path | None = None,
    as_json: bool = False,
) -> None:
    """Chart speed against accuracy of the models.

    Writes bench.md, scores.csv and scores.png; with --stress also stress. The fitted scene of PAIRS
    is used for --test and --pool too. Without a scene, sun patches that a csv lacks are computed
    from the [room]; with few clear hours, PAIRS decide first whether the [room] is used, as in
    train.

    \b
    Example:
      fieldlum bench 9d.csv --test test.csv --models transport,transport:none,dense --out bench-9d
      fieldlum bench my-session --stress --out bench

    Options:
      --test: Pairs to test on. [default: held-out days]
      --pool: Pairs of other seasons, of which --stress takes captures to train on.
      --models: Models to compare, separated by commas: names, NAME:none or NAME:gain (use
          of sun patches), or folders of trained models.
      --budget: Minutes of training for the dense network.
      --stress: Also test conditions in which methods fail.
      --render: Number of hours to render with Radiance, to compare the cost; needs a
          [room].
      --out: Folder of tables and charts to write.
    """
    from fieldlum.bench import run
    from fieldlum.bench.rows import load

    with progress("reading pictures") as show:
        loaded = load(
            pairs,
            models.split(","),
            test=test,
            pool=pool,
            site=site,
            scene=scene,
            sky_view=sky_view,
            progress=show,
        )
    for note in loaded.data.notes:
        say(note)
    say_if(estimate_text(_needed_s(loaded, budget, render, stress)))
    with progress("benchmark") as show:
        answer = run(
            loaded,
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


def _needed_s(loaded: BenchData, budget_min: float, render_hours: int, with_stress: bool) -> float:
    """Return how long the benchmark may take [s]."""
    from fieldlum.learn.train.trials import day_folds

    data, room = loaded.data, loaded.data.setup.room
    specs = [spec for spec in loaded.specs if spec.folder is None]
    return bench_s(
        sum(spec.name == "transport" for spec in specs),
        len(data),
        data.shape[0] * data.shape[1],
        folds=len(day_folds(data)) if loaded.test is None else 1,
        dense_min=budget_min * sum(MODELS[spec.name].slow for spec in specs),
        render_hours=render_hours if room is not None and room.kind == "box" else 0,
        with_stress=with_stress,
    )
