"""How far a session is, from its files alone."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from fieldlum.capture.state import Ledger, SlotState, fold
from fieldlum.records import Slot, utc_text
from fieldlum.session import Session, day_files, read_journal


def status(session: Session) -> dict[str, Any]:
    """Each stage with what is done and what it owes."""
    slots, ledger = session.slots(), fold(read_journal(session))
    captured = {slot.id for slot in slots if _of(ledger, slot).frames}
    merged = {path.stem for path in session.panoramas.glob("[0-9]*.exr")}
    paired, usable = _pairs(session.pairs)
    return {
        "session": str(session.root),
        "name": session.site_file().site.name,
        "plan": _plan(session, slots),
        "capture": _capture(slots, ledger),
        "irradiance": _irradiance(session),
        "merge": {"done": len(merged), "owed": len(captured - merged)},
        "pair": {"done": len(paired), "usable": usable, "owed": len(merged - paired)},
        "train": {"models": _models(session.models)},
        "predict": {"years": sorted(p.name for p in session.annual.glob("*") if p.is_dir())},
        "report": {"done": (session.report / "index.html").is_file()},
    }


def _of(ledger: Ledger, slot: Slot) -> SlotState:
    return ledger.slots.get(slot.id, SlotState())


def _plan(session: Session, slots: list[Slot]) -> dict[str, Any]:
    about = session.table().get("plan", {})
    ends = (
        {"first_utc": utc_text(slots[0].t_utc), "last_utc": utc_text(slots[-1].t_utc)}
        if slots
        else {}
    )
    return {"set": about.get("set", ""), "slots": len(slots), **ends}


def _capture(slots: list[Slot], ledger: Ledger) -> dict[str, Any]:
    outcomes = [_of(ledger, slot).outcome for slot in slots]
    owed = [
        slot for slot, outcome in zip(slots, outcomes, strict=True) if outcome in ("", "started")
    ]
    return {
        "done": outcomes.count("done"),
        "missed": outcomes.count("missed"),
        "aborted": outcomes.count("aborted"),
        "owed": len(owed),
        "frames": sum(len(_of(ledger, slot).frames) for slot in slots),
        "next": min((slot.id for slot in owed), default=None),
        "device_lost": ledger.counts.get("device-lost", 0),
        "clock_steps": ledger.counts.get("clock-step", 0),
        "suspends": ledger.counts.get("suspend", 0),
    }


def _irradiance(session: Session) -> dict[str, Any]:
    files = day_files(session)
    rows = 0
    for path in files:
        with path.open("rb") as file:
            rows += (
                sum(block.count(b"\n") for block in iter(lambda f=file: f.read(1 << 20), b"")) - 1
            )
    return {
        "days": len(files),
        "rows": max(rows, 0),
        "last": files[-1].stem if files else None,
        "cleaned": (session.irradiance / "clean.csv").is_file(),
    }


def _pairs(path: Path) -> tuple[set[str], int]:
    if not path.is_file():
        return set(), 0
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {Path(row.get("panorama") or "").stem for row in rows}, sum(
        row.get("ok") == "1" for row in rows
    )


def _models(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for config in sorted(folder.glob("*/config.json")):
        try:
            table = json.loads(config.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            table = {}
        found.append({"name": config.parent.name, "class": table.get("class", "")})
    return found
