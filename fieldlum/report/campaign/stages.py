"""Run one stage for every room of a campaign; report a room that fails, and continue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Literal

from fieldlum.core.errors import FieldlumError, InputError
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.core.scheduler import LOCAL, Scheduler, WorkUnit, run_units
from fieldlum.report.campaign.campaign_file import CampaignFile, CampaignRoom
from fieldlum.session import Session, open_session

Stage = Literal["plan", "status", "merge", "train", "predict"]
_LINE = 200  # characters of a room's line; chosen


@dataclass(frozen=True, slots=True)
class RoomResult:
    """What a stage did for one room: "done" or "failed", and a line with its result or error."""

    session: str
    state: Literal["done", "failed"]
    text: str


@dataclass(frozen=True, slots=True)
class _Run:
    """A campaign, and the options with which its stages run."""

    campaign: CampaignFile
    scheduler: Scheduler
    force: bool
    progress: Progress

    def session(self, room: CampaignRoom) -> Session:
        return open_session(self.campaign.session_folder(room))


@dataclass(frozen=True, slots=True)
class _TrainJob:
    model: str
    seed: int
    budget_min: float


def run_stage(
    campaign: CampaignFile,
    stage: Stage,
    *,
    scheduler: Scheduler = LOCAL,
    force: bool = False,
    progress: Progress = quiet,
) -> Iterator[RoomResult]:
    """Run `stage` for each room and yield its result; a failed room does not stop the others.

    force: predict again even if nothing changed. merge and predict run one room at a time, in
    several units of work each; train has one unit per room, and its results come as they end.
    """
    if stage == "train":
        yield from _train(campaign, scheduler, progress)
        return
    work = {"plan": _plan, "status": _status, "merge": _merge, "predict": _predict}[stage]
    run = _Run(campaign, scheduler, force, progress)
    for room in campaign.rooms:
        yield guarded(room.session, partial(work, run, room))


def guarded(name: str, work: Callable[[], str]) -> RoomResult:
    """Run the work of the room `name`; return its text as "done", or any error's as "failed"."""
    try:
        return RoomResult(name, "done", work())
    except (FieldlumError, OSError) as error:
        return RoomResult(name, "failed", _line(str(error)))
    except Exception as error:
        return RoomResult(name, "failed", _line(f"defect: {type(error).__name__}: {error}"))


def _line(text: str) -> str:
    return " ".join(text.split())[:_LINE]


# ----------------------------------------------------------------------------------------------
# stages


def _plan(run: _Run, room: CampaignRoom) -> str:
    from fieldlum import plan
    from fieldlum.session.site_toml import load_site

    folder = run.campaign.session_folder(room)
    if (folder / "session.toml").is_file():
        return f"{len(open_session(folder).slots())} slots, already planned"
    if not room.site:
        raise InputError(
            folder,
            "the room has neither a session nor a site file",
            "a planned session, or a site file to plan one",
            "add site = SITE.toml to the room in CAMPAIGN.toml",
        )
    setup = load_site(run.campaign.file(room.site))
    today = plan.today_at(setup.site, datetime.now(UTC))
    session, _ = plan.run(setup, plan.Request(room.set, today), folder)
    return f"{len(session.slots())} slots planned ({room.set})"


def _status(run: _Run, room: CampaignRoom) -> str:
    from fieldlum.capture.status import status

    stage_status = status(run.session(room))
    capture, merge, pair = stage_status["capture"], stage_status["merge"], stage_status["pair"]
    models = ", ".join(entry["name"] for entry in stage_status["train"]["models"]) or "no model"
    return (
        f"{capture['done']} captured, {capture['missed']} missed, {capture['aborted']} aborted, "
        f"{capture['owed']} to do; {merge['done']} merged; {pair['usable']} usable pairs; "
        f"{models}; {counted(len(stage_status['predict']['years']), 'predicted year')}"
    )


def _merge(run: _Run, room: CampaignRoom) -> str:
    """Merge, then clean the irradiance and pair."""
    from fieldlum import merge, pair
    from fieldlum.pair import irradiance

    session = run.session(room)
    scheduler, force, progress = run.scheduler, run.force, run.progress
    options = merge.MergeOptions(height=int(room.size.lower().partition("x")[2]))
    verdicts = merge.run(session, options, scheduler=scheduler, force=force, progress=progress)
    irradiance.run(session, force=force, progress=progress)
    pairs = pair.run(session, scheduler=scheduler, force=force, progress=progress)
    failed = [v.slot for v in verdicts if v.state == "failed"]
    bad = f", failed: {', '.join(failed[:5])}" if failed else ""
    merged_count = len(verdicts) - len(failed)
    text = f"{merged_count} of {len(verdicts)} merged{bad}; {sum(p.ok for p in pairs)} usable pairs"
    if failed:
        raise InputError(session.raw, text, remedy="run fieldlum merge for this room to see why")
    return text


def _train(
    campaign: CampaignFile, scheduler: Scheduler, progress: Progress
) -> Iterator[RoomResult]:
    units = []
    for room in campaign.rooms:
        folder = campaign.session_folder(room)
        names = ("session.toml", "pairs.csv", "scene/scene.toml")
        files = tuple(name for name in names if (folder / name).is_file())
        job = _TrainJob(room.model, room.seed, room.budget_min)
        units.append(WorkUnit(room.session, train_room, folder, job, files=files))
    for outcome in run_units(units, scheduler, progress=progress):
        yield guarded(outcome.unit.name, outcome.result)


def train_room(folder: Path, job: _TrainJob) -> str:
    """Train one room's model from the session in `folder`; return a line about the result.

    A fitted scene in the session is used, as by `fieldlum train`. job: model, seed and time limit.
    Raises NotEnoughDataError for too few hours, InputError for pairs that cannot be used.
    """
    from fieldlum.learn import train
    from fieldlum.learn.models.data import load_pairs
    from fieldlum.room.fit.stated_box import training_captures

    data, patch = training_captures(load_pairs(folder), folder, "", "absolute")
    out = train.default_folder(folder, job.model)
    answer = train.run(
        data,
        job.model,
        budget_min=job.budget_min,
        patch="none" if patch == "none" else "absolute",
        seed=job.seed,
        out=out,
    )
    chosen = next(row for row in answer["models"] if row["name"] == answer["chosen"])
    error = chosen["log10_mse_weighted"]
    figure = "" if error is None else f", log10 MSE {error:.2g} on held-out days"
    warned = sum(note.startswith("WARNING") for note in answer["notes"])
    warnings = f", {counted(warned, 'warning')}" if warned else ""
    return f"model {answer['chosen']}, trained on {len(data)} captures{figure}{warnings}"


def _predict(run: _Run, room: CampaignRoom) -> str:
    from fieldlum.year import predict

    weather = Path(room.weather)
    annual, new = predict.run(
        run.session(room).models / room.model,
        weather if room.weather == "synthetic" else run.campaign.file(room.weather),
        views=room.views,
        scheduler=run.scheduler,
        force=run.force,
        progress=run.progress,
    )
    return f"{len(annual)} hours" + ("" if new else ", already predicted")
