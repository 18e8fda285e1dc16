"""Define the tables of session.toml and the lines of the journal as types."""

from __future__ import annotations

import math
from datetime import date
from types import UnionType
from typing import Any, Required, TypedDict, get_args, get_origin, get_type_hints, is_typeddict

DeviceTable = dict[str, str | int | float | bool]
"What a device reports about itself."


class PlanTable(TypedDict, total=False):
    """[plan] of session.toml: the request, and time [s] and disk space [MB] of each slot.

    seed: of a sample of the year; first, last: dates of the slots; revision: number of this
    version of the plan;  sha256: of plan.csv, older_sha256: of the earlier ones.
    """

    set: str
    start: date
    year: int
    count: int
    seed: int
    revision: int
    slots: int
    first: date
    last: date
    seconds_per_slot: float
    megabytes_per_slot: float
    sun_band_percent: float
    sha256: str
    older_sha256: list[str]


class DevicesTable(TypedDict, total=False):
    """[devices] of session.toml: URIs by device, and what each device reports about itself."""

    uris: dict[str, str]
    camera: DeviceTable
    pyranometer: DeviceTable
    meter: DeviceTable


class GraceTable(TypedDict, total=False):
    """[capture] of session.toml; grace_s: how late a bracket may start [s]."""

    grace_s: float


class LoggerFileTable(TypedDict, total=False):
    """How a logger's file was read.

    file: its name without the folder, because the file may have grown and come from another card;
    utc_offset_s: the logger's clock minus UTC [s]; columns: names of the columns by quantity;
    sensitivities: of pyranometers whose column is a voltage [uV per W/m2].
    """

    file: Required[str]
    utc_offset_s: float
    columns: dict[str, str]
    sensitivities: dict[str, float]


class SessionTable(TypedDict, total=False):
    """The content of session.toml, table by table; setup: SITE.toml.

    imported: the frames that were imported, by card folder, with the offset of the camera's clock;
    logger_files: how each file was read.
    """

    setup: dict[str, Any]
    plan: PlanTable
    devices: DevicesTable
    capture: GraceTable
    imported: dict[str, list[dict[str, str | float]]]
    logger_files: list[LoggerFileTable]
    simulation: dict[str, Any]
    software: dict[str, str]


class ExposureTable(TypedDict, total=False):
    """The exposure of a frame."""

    shutter_s: Required[float]
    f_number: Required[float]
    iso: Required[float]
    nd: str


class FrameTable(TypedDict, total=False):
    """A frame in the journal and in capture.json: the fields of `Frame`, times as text."""

    index: int
    file: Required[str]
    exposure: Required[ExposureTable]
    heading_deg: float | None
    t_utc: Required[str]
    seconds: float
    sha256: str
    doubt: str
    instead_of: str


class ClockMark(TypedDict):
    """The boot of the computer, and the time since then [s]."""

    boot_id: str
    boottime_s: float


class EventFields(TypedDict, total=False):
    """The keys of journal events; which of them an event has depends on its kind."""

    slot: str
    why: str
    attempt: int
    frame: FrameTable
    frames: int
    illuminance_lx: float
    by_s: float
    source: str
    state: str
    text: str
    until_utc: str
    device: str
    after_s: float
    seconds: float
    followed: bool
    bytes_free: int
    command: str
    pid: int
    fieldlum: str
    boot_id: str
    boottime_s: float
    cut_bytes: int


class JournalEvent(EventFields, total=False):
    """One line of journal.jsonl; event: its kind, such as done; t_utc: ISO time."""

    event: Required[str]
    t_utc: Required[str]


def misfit(hint: Any, value: object, name: str = "") -> str:
    """Return which value of a table does not have the type that its `TypedDict` states, or "".

    hint: the type; name: of the value, for the text. Absent and unknown keys are no misfit, and an
    integer is a number too.
    """
    if isinstance(hint, UnionType):
        fits = any(not misfit(kind, value) for kind in get_args(hint))
    elif get_origin(hint) is list and isinstance(value, list):
        return next((text for v in value if (text := misfit(get_args(hint)[0], v, name))), "")
    elif (is_typeddict(hint) or get_origin(hint) is dict) and isinstance(value, dict):
        return _misfit_below(hint, value, name)
    else:
        fits = _fits(hint, value)
    return "" if fits else f"{name or 'the value'} = {str(value)[:60]!r}"


def _misfit_below(hint: Any, table: dict[Any, Any], name: str) -> str:
    hints = get_type_hints(hint) if is_typeddict(hint) else dict.fromkeys(table, get_args(hint)[-1])
    for key, value in table.items():
        if key in hints and (text := misfit(hints[key], value, f"{name}.{key}".strip("."))):
            return text
    return ""


def _fits(hint: Any, value: object) -> bool:
    if hint is Any:
        return True
    if isinstance(value, bool):  # Python counts it as an integer
        return hint is bool
    if hint is float:
        return isinstance(value, int | float) and math.isfinite(value)
    is_class = isinstance(hint, type) and not is_typeddict(hint)
    return is_class and isinstance(value, hint)
