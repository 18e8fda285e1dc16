"""`fieldlum bench`: compare the models' speed and accuracy on any pairs."""

from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli.options import Above0, command_of
from fieldlum.cli.terminal import print_answer, progress, say
from fieldlum.learn.model_kinds import MODELS


@command_of("bench")
def command(
    pairs: Path,
    out: Path,
    test: Path | None = None,
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

    Writes bench.md, scores.csv and scores.png; with --stress also stress.csv. The fitted scene of
    PAIRS is used for --test too. Without a scene, sun patches that a csv lacks are computed from
    the [room]; with few clear hours, PAIRS decide first whether the [room] is used, as in train.

    \b
    Example:
      fieldlum bench 9d.csv --test test.csv --models transport,transport:none,dense --out bench-9d
      fieldlum bench my-session --stress --out bench

    Options:
      --test: Pairs to test on. [default: held-out days]
      --models: Models to compare, separated by commas: names, NAME:none or NAME:gain (use
          of sun patches), or folders of trained models.
      --budget: Minutes of training for the dense network.
      --stress: Also test conditions in which methods fail.
      --render: Number of hours to render with Radiance, to compare the cost; needs a
          [room].
      --out: Folder of tables and charts to write.
    """
    from fieldlum.bench import run
    from fieldlum.bench.score_rows import load

    with progress("reading pictures"):
        names = models.split(",")
        loaded = load(pairs, names, test=test, site=site, scene=scene, sky_view=sky_view)
    for note in loaded.data.notes:
        say(note)
    with progress("benchmark"):
        answer = run(loaded, out=out, budget_min=budget, with_stress=stress, render_hours=render)
    print_answer(as_json, answer, [(out / "bench.md").read_text(encoding="utf-8")])
    say(f"tables and charts in {out}")
