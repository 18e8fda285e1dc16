"""Define the tables of session.toml and the lines of the journal as types."""

from __future__ import annotations

from datetime import date
from typing import Any, Required, TypedDict

DeviceTable = dict[str, str | int | float | bool]
"What a device reports about itself."


class PlanTable(TypedDict, total=False):
    """[plan] of session.toml: the request, and the time [s] and disk space that each slot needs."""

    set: str
    start: date
    year: int
    count: int
    seed: int  # of a sample of the year
    revision: int
    slots: int
    first: date
    last: date
    seconds_per_slot: float
    megabytes_per_slot: float
    sun_band_percent: float
    sha256: str  # of plan.csv
    older_sha256: list[str]


class DevicesTable(TypedDict, total=False):
    """[devices] of session.toml: URIs by device, and what each device reports about itself."""

    uris: dict[str, str]
    camera: DeviceTable
    pyranometer: DeviceTable
    meter: DeviceTable


class GraceTable(TypedDict, total=False):
    """[capture] of session.toml: how late a bracket may start."""

    grace_s: float


class LoggerFileTable(TypedDict, total=False):
    """How a logger's file was read."""

    # the name without its folder, because the file may have grown and come from another card
    file: Required[str]
    utc_offset_s: float
    columns: dict[str, str]


class SessionTable(TypedDict, total=False):
    """The content of session.toml."""

    setup: dict[str, Any]  # SITE.toml
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
    """A frame, in the journal and in capture.json."""

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
    """One line of journal.jsonl."""

    event: Required[str]
    t_utc: Required[str]
