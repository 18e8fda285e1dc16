"""Define a finding, which is one line of the doctor's output."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Literal

from fieldlum.core.errors import InputError

Verdict = Literal["ok", "warn", "fail"]


CALIBRATION_YEARS = 2.0  # recommended interval of pyranometer makers (Kipp & Zonen, Delta-T)


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check of `doctor`: its subject, ok, warn or fail, and a sentence.

    exit_code: of the command if the check failed: 4 for devices and this computer, 3 for files.
    """

    what: str
    verdict: Verdict
    text: str
    exit_code: int = 4


def iso_date(text: str, source: str = "camera profile") -> date | None:
    """Parse an ISO date; None for an empty text. Raises InputError for any other text.

    source: what states the date, for the error.
    """
    try:
        return date.fromisoformat(text) if text else None
    except ValueError:
        raise InputError(
            source,
            f"date '{text}'",
            "a date such as 2027-03-20",
            "correct the date in the profile",
        ) from None
