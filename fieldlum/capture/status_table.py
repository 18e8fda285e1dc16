"""Define the tables that `fieldlum status --json` prints; their keys are a contract."""

from __future__ import annotations

from typing import NotRequired, TypedDict


class PlanStatus(TypedDict):
    """Size and period of the plan; first and last slot are absent if it is empty."""

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
    """Logged irradiance; `last` is the newest day."""

    days: int
    rows: int
    last: str | None
    cleaned: bool


class MergeStatus(TypedDict):
    """Numbers of brackets that are merged and still to be merged."""

    done: int
    owed: int


class PairStatus(MergeStatus):
    """Numbers of panoramas that are paired, still to be paired, and usable."""

    usable: int


ModelStatus = TypedDict("ModelStatus", {"name": str, "class": str})


class TrainStatus(TypedDict):
    """The trained models."""

    models: list[ModelStatus]


class PredictStatus(TypedDict):
    """Names of the predicted years."""

    years: list[str]


class ReportStatus(TypedDict):
    """Whether the report exists."""

    done: bool


class SessionStatus(TypedDict):
    """What each stage has done, and what is still to do."""

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
