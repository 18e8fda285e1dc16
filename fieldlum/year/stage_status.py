"""Report what each stage, from plan to report, has done and must still do in a session."""

from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.files import read_bytes
from fieldlum.core.records import JsonTable, Slot, counted, utc_text
from fieldlum.session import Session, day_files
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.sidecar import of_other_profile
from fieldlum.session.journal import damaged_lines
from fieldlum.session.slot_states import SETTLED, SlotStates, read_slot_states, slots_to_do


def stage_status(session: Session, now_utc: datetime | None = None) -> JsonTable:
    """Return what each stage of a session has done and must still do; keys of `status --json`.

    now_utc: the present time, None for the computer's. session, name: folder and site. plan: set,
    slots (number), first_utc and last_utc (starts of slots). capture: numbers of slots done, missed
    (also those whose time is over, or which are before a captured one), aborted and owed (still to
    do), and of frames; next: id of a slot or None; device_lost, clock_steps, suspends: numbers of
    events; damaged_lines: line numbers in the journal. irradiance: numbers of days and rows, last
    (date or None), cleaned (whether clean.csv exists). merge, pair: numbers of panoramas done and
    owed; pair also: of usable rows; pairs of which `PairsFile.outdated` are owed, and so are
    panoramas of another camera profile. train: models, the names, and outdated, those of other
    pairs than the present ones. predict: years, the names, and outdated, those of a model that is
    outdated or was trained again. report: done (bool), outdated (bool): older than a year.
    next_step: see `next_step`. Raises InputError for a file of the session that cannot be used,
    OSError for one that cannot be read.
    """
    slots, recorded = session.slots(), read_slot_states(session)
    states = {slot.id: recorded.state(slot.id) for slot in slots}
    captured = {slot for slot, state in states.items() if state.frames and state.outcome in SETTLED}
    merged = {path.stem for path in session.panorama_files()}
    # `merge` merges these again, if their frames are still there
    frames = {f.parent.name for f in session.raw.glob("*/*.*") if f.suffix != ".json"}
    stale = {sidecar.slot for sidecar in of_other_profile(session)} & captured & frames
    pairs = PairsFile.find(session.pairs)
    # `simulate` writes pairs of its truth, which are no pairs of merged panoramas.
    pictures = [Path(row.panorama) for row in pairs.rows]
    outdated = pairs.outdated
    paired = {p.stem for p in pictures if p.parts[:1] == (session.panoramas.name,)} - outdated
    usable = [row for row in pairs.usable if Path(row.panorama).stem not in outdated]
    # A past slot, or one before a captured one, cannot be captured, but may be on a card.
    to_do, first = slots_to_do(slots, recorded), (now_utc or datetime.now(UTC)) - session.grace
    after = [s for s in to_do if s.id > max(captured, default="")]
    running = {s.id for s in after if recorded.state(s.id).outcome == "started"}
    ahead = [s for s in after if s.t_utc > first or s.id in running]
    answer = {
        "session": str(session.root),
        "name": session.site_file().site.name,
        "plan": _plan_status(session, slots),
        "capture": _capture_status(session, slots, recorded, ahead),
        "irradiance": _irradiance_status(session),
        "merge": {"done": len(merged - stale), "owed": len(captured - (merged - stale))},
        "pair": {"done": len(paired), "usable": len(usable), "owed": len(merged - paired)},
        **_result_status(session),
    }
    step = next_step(answer)
    if to_do and not ahead:
        step += f" (or import the card of {counted(len(to_do), 'earlier slot')}, if there is one)"
    return {**answer, "next_step": step}


def next_step(answer: JsonTable) -> str:
    """Return the user's next step, mostly a command line.

    answer: the table of `stage_status`, of which "next_step" is not read.
    """
    root = answer["session"]
    capture, merge, pair = answer["capture"], answer["merge"], answer["pair"]
    train, years, report = answer["train"], answer["predict"], answer["report"]
    models = [name for name in train["models"] if name not in train["outdated"]]
    model = f"{root}/models/{models[0] if models else ''}"
    next_capture = f"fieldlum capture {root}"
    if capture["frames"] == 0:
        next_capture = f"fieldlum doctor {root}, then {next_capture}"
    nothing_captured = capture["done"] == 0 and not pair["usable"]
    why = "because no slot is left and none was captured"
    needs_irradiance = pair["owed"] and not answer["irradiance"]["rows"]
    steps = (  # in the order of the work; the first one that is due is returned
        (merge["owed"], f"fieldlum merge {root}"),
        (needs_irradiance, f"fieldlum import {root} --irradiance FILE"),
        (pair["owed"], f"fieldlum pair {root}"),
        (capture["owed"], next_capture),
        (nothing_captured, f"fieldlum plan {root} --replan, {why}"),
        (not models, f"fieldlum train {root}"),
        (not {*years["years"]} - {*years["outdated"]}, f"fieldlum predict {model} --weather FILE"),
        (not report["done"] or report["outdated"], f"fieldlum report {root}"),
    )
    return next((step for is_due, step in steps if is_due), f"open {root}/report/index.html")


def _result_status(session: Session) -> dict[str, JsonTable]:
    """Return what train, predict and report have done, and which of it is outdated.

    A model is outdated if the sky view in its folder has other inputs than that of the session,
    also after captures were added; a year by `outdated_text`, or with its model. A damaged model or
    year is not judged here.
    """
    models = [folder.name for folder in session.model_folders()]
    old = [name for name in models if _is_of_other_pairs(session, session.models / name)]
    years = [folder for folder in session.annual_folders() if _is_outdated(session, folder, old)]
    # predict.json is touched when a stored year is shown again
    hourly = [folder / "hourly.csv" for folder in session.annual_folders()]
    page_s, newest_s = (
        max((file.stat().st_mtime for file in files if file.is_file()), default=-1.0)
        for files in ([session.report / "index.html"], hourly)
    )
    done = sorted(path.name for path in session.annual.glob("*") if path.is_dir())
    return {
        "train": {"models": models, "outdated": old},
        "predict": {"years": done, "outdated": [folder.name for folder in years]},
        "report": {"done": page_s >= 0.0, "outdated": 0.0 <= page_s < newest_s},
    }


def _is_outdated(session: Session, folder: Path, models: Sequence[str]) -> bool:
    """Return whether the year in a folder is not of the present session; models: outdated ones."""
    from fieldlum.year.predict import read_annual  # slow to import
    from fieldlum.year.predict.year import outdated_text

    with suppress(InputError):
        annual = read_annual(folder)
        return annual.summary.inputs.get("model") in models or bool(outdated_text(session, annual))
    return False


def _is_of_other_pairs(session: Session, model: Path) -> bool:
    """Return whether a model's sky view has other inputs than the session's.

    It is False without one of the views, and for a view that is not from captures of the session.
    """
    from fieldlum.sky.sky_view.view import SKY_VIEW, SkyView

    with suppress(InputError):
        views = SkyView.find(session.sky_view), SkyView.find(model / SKY_VIEW)
        own, of_model = (view.inputs if view else {} for view in views)
        shared = {*own.get("captures", ())} & {*of_model.get("captures", ())}
        return bool(shared) and own != of_model
    return False


def _plan_status(session: Session, slots: list[Slot]) -> JsonTable:
    """Return the plan's set, its number of slots, and the start (UTC) of the first and the last."""
    plan = {"set": session.table().get("plan", {}).get("set", ""), "slots": len(slots)}
    if slots:
        plan["first_utc"], plan["last_utc"] = utc_text(slots[0].t_utc), utc_text(slots[-1].t_utc)
    return plan


def _capture_status(
    session: Session, slots: list[Slot], recorded: SlotStates, ahead: list[Slot]
) -> JsonTable:
    """Return the number of slots by outcome and of faults by kind, and the next slot.

    recorded: the slots' states, from the journal; ahead: slots that can still be captured.
    """
    states = [recorded.state(slot.id) for slot in slots]
    outcomes = [state.outcome for state in states]
    counts = {outcome: outcomes.count(outcome) for outcome in SETTLED}
    counts["missed"] += len(slots) - sum(counts.values()) - len(ahead)
    return {
        **counts,
        "owed": len(ahead),
        "frames": sum(len(state.frames) for state in states),
        "next": ahead[0].id if ahead else None,
        "device_lost": recorded.counts.get("device-lost", 0),
        "clock_steps": recorded.counts.get("clock-step", 0),
        "suspends": recorded.counts.get("suspend", 0),
        "damaged_lines": damaged_lines(session),
    }


def _irradiance_status(session: Session) -> JsonTable:
    """Return the logged days and rows, the last day, and whether clean.csv exists."""
    files = day_files(session)
    rows = sum(read_bytes(path).count(b"\n") - 1 for path in files)  # less the header
    return {
        "days": len(files),
        "rows": max(rows, 0),
        "last": files[-1].stem if files else None,
        "cleaned": session.clean_irradiance.is_file(),
    }
