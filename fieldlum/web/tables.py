"""The JSON that the page of `fieldlum watch` fetches: its keys are read by static/watch.js."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict


class SlotRow(TypedDict):
    """One slot; the last two keys only where a page shows pictures and verdicts."""

    slot: str
    t_utc: str
    local: str
    day: str
    state: str
    sun_altitude_deg: float
    sun_azimuth_deg: float
    picture: NotRequired[bool]
    verdict: NotRequired[str]


class LatestPicture(TypedDict):
    """The newest panorama; low and high of its scale in cd/m2."""

    slot: str
    low: float
    high: float
    stamp: str
    verdict: str
    local: NotRequired[str]
    date: NotRequired[str]


class DevicesShown(TypedDict):
    """What camera and pyranometer state; away: since when each lost device is away."""

    camera: str
    camera_battery: str
    camera_clock_offset_s: float | None
    pyranometer: str
    away: dict[str, str]


class GhiShown(TypedDict):
    """The last global irradiance."""

    t_utc: str
    ghi_wm2: float | None


class DiskShown(TypedDict):
    """Free space; days: of captures that fit."""

    free_bytes: int
    days: float | None


class PowerShown(TypedDict):
    """The computer's battery; mains: whether it is plugged in, if that is known."""

    percent: int
    mains: NotRequired[bool]


class EventShown(TypedDict):
    """A run of equal journal events."""

    level: str
    text: str
    local: str
    times: int


class WatchState(TypedDict):
    """What changes from minute to minute."""

    name: str
    folder: str
    timezone: str
    now_utc: str
    now_local: str
    rehearsal: bool
    running: bool | None
    paused_until: str | None
    counts: dict[str, int]
    slots: int
    next: SlotRow | None
    latest: LatestPicture | None
    devices: DevicesShown
    irradiance: GhiShown | None
    disk: DiskShown
    computer: PowerShown | None
    events: list[EventShown]
    findings: list[dict[str, str | int]]
    version: str
    today: str


class CalendarDay(TypedDict):
    """The slots of a local day."""

    date: str
    slots: list[SlotRow]


class CalendarTable(TypedDict):
    """All days, and the share of the sun band that plan and captures cover [%]."""

    days: list[CalendarDay]
    coverage: dict[str, float]


class ScaleShown(TypedDict):
    """One scale for several pictures, in cd/m2."""

    low: float
    high: float
    stamp: str


class DayCurve(TypedDict):
    """The irradiance of a local day in bins, W/m2; minutes since the day's start."""

    ghi: list[float | None]
    dni: list[float | None]
    dhi: list[float | None]
    minutes: list[float]
    clear_ghi: list[float | None]
    flagged: list[bool]
    flagged_bins: int
    impossible_bins: int
    status: dict[str, int]
    first_local: str


class DayTable(CalendarDay):
    """The slots of a local day with their pictures, and its irradiance."""

    scale: ScaleShown
    irradiance: DayCurve


class AnswerRow(TypedDict):
    """One answer: the glare classes after some captures; protection: rows of predict.json."""

    t_utc: str
    captures: int
    weather: str
    synthetic: bool
    warnings: list[str]
    protection: list[dict[str, Any]]
    capture_next: list[dict[str, str | float]]
    useful: list[dict[str, Any]]


class AnswerStep(TypedDict):
    """DGP of each direction after some captures, with its interval."""

    t_utc: str
    captures: int
    dgp: list[float | None]
    low: list[float | None]
    high: list[float | None]


class AnswerTable(TypedDict):
    """The last answer, how it moved, and what is being computed."""

    last: AnswerRow | None
    history: list[AnswerStep]
    computes: bool
    step: str
    problem: str
    least_captures: int
