"""Define the tables of session.toml and the lines of the journal as types."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any, Required, TypedDict

from msgspec import Meta

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

    grace_s: Annotated[float, Meta(ge=0.0, le=86400.0)]


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


class ClockMark(TypedDict):
    """The boot of the computer, and the time since then [s]."""

    boot_id: str
    boottime_s: float


class EventFields(TypedDict, total=False):
    """The keys of journal events; which of them an event has depends on its kind."""

    slot: str
    why: str
    attempt: int
    frame: dict[str, Any]
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
