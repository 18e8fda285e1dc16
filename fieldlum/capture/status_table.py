"""The tables that `fieldlum status --json` prints; their keys are a contract."""

from __future__ import annotations

from typing import NotRequired, TypedDict


class PlanStatus(TypedDict):
    """The plan; first and last slot are absent from an empty one."""

    set: str
    slots: int
    first_utc: NotRequired[str]
    last_utc: NotRequired[str]


class CaptureStatus(TypedDict):
    """Counts of slots, frames and troubles, and the next slot."""

    done: int
    missed: int
    aborted: int
    owed: int
    frames: int
    next: str | None
    device_lost: int
    clock_steps: int
    suspends: int


class LogStatus(TypedDict):
    """Logged irradiance; last is the newest day."""

    days: int
    rows: int
    last: str | None
    cleaned: bool


class MergeStatus(TypedDict):
    """Counts of brackets."""

    done: int
    owed: int


class PairStatus(MergeStatus):
    """Counts of panoramas."""

    usable: int


ModelStatus = TypedDict("ModelStatus", {"name": str, "class": str})


class TrainStatus(TypedDict):
    """The trained models."""

    models: list[ModelStatus]


class PredictStatus(TypedDict):
    """Names of the predicted years."""

    years: list[str]


class ReportStatus(TypedDict):
    """Whether there is a report."""

    done: bool


class SessionStatus(TypedDict):
    """What each stage has done and has still to do."""

    session: str
    name: str
    plan: PlanStatus
    capture: CaptureStatus
    irradiance: LogStatus
    merge: MergeStatus
    pair: PairStatus
    train: TrainStatus
    predict: PredictStatus
    report: ReportStatus
    next_step: str
