"""`fieldlum train`: fit the room's light transport and score it on held-out days."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from fieldlum.cli.command_parameters import PATH, Named
from fieldlum.cli.options import Above0, Seed, command_of
from fieldlum.cli.terminal import print_answer, progress, say, table_lines
from fieldlum.learn.model_kinds import MODELS

_JUDGED = ("judged_dgp_error", "judged_ev_error", "judged_log10_mse", "n_judged")
_COLUMNS = ("name", *_JUDGED, "dgp_mae", "log10_mse_weighted", "worst", "fit_s", "n_test")


@command_of("train")
def command(
    pairs: Annotated[Path, "SESSION|PAIRS.csv", PATH],
    site: Path | None = None,
    model: Annotated[str, Named(["auto", *MODELS])] = "auto",
    patch: Literal["absolute", "gain", "none"] = "absolute",
    budget: Above0 = 10.0,
    seed: Seed = 0,
    scene: str = "",
    sky_view: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Learn the room from pairs; score it on held-out days.

    PAIRS is a session or a pairs.csv. If captures, options and fieldlum's version have not changed,
    the model is trained again only with --force.

    \b
    Example:
      fieldlum train my-session --budget 10
      fieldlum train renderings/pairs.csv --site office.toml --model transport --out models/office

    Options:
      --model: auto tries all models and chooses one.
      --patch: Use sun patches in cd/m2, up to an unknown factor, or not at all.
      --budget: Wall time of the dense network's training, in minutes; half of it is for
          held-out days. Reading and the other models take their own time.
      --seed: Seed of all random numbers in training.
      --out: Model folder to write. [default: models/MODEL in the folder of the pairs]
    """
    from fieldlum.learn.models.training_data import load_pairs, with_sky_view
    from fieldlum.learn.train import run
    from fieldlum.room.fit.apply_scene import apply_scene

    folder = out or (pairs if pairs.is_dir() else pairs.parent) / "models" / model
    mode: Any  # "absolute", "gain" or "none", as the captures allow
    with progress("reading pictures"):
        data = with_sky_view(load_pairs(pairs, site), sky_view)
        data, mode = apply_scene(data, pairs, scene, patch)
    with progress("training"):
        answer = run(data, model, budget_min=budget, patch=mode, seed=seed, out=folder, force=force)
    print_answer(as_json, answer, _lines(answer))
    for note in () if as_json else answer["notes"]:
        say(note)
    kept = "captures and options have not changed, so nothing was trained (--force trains again)"
    say(f"{folder}: {kept}" if answer.get("kept") else f"model written to {folder}")


def _lines(answer: dict[str, Any]) -> list[str]:
    """Return the lines that the terminal shows: scores of the models, and the choice."""
    lines = [
        *table_lines(answer["models"], _COLUMNS),
        "judged: over judged hours, without the 5 % with the largest errors",
        f"chosen: {answer['chosen']}: {answer['reason']}",
        f"parameters: {answer['parameters']:,}",
    ]
    if year := answer.get("year"):
        trusted = f"{100 * year['trusted_share']:.0f} % of the hours trusted"
        lines.append(f"a year: expected log10 MSE {year['expected_log10_mse']:.2e}, {trusted}")
    return lines
