"""plan.csv: the planned slots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Exposure, Slot, shutter_text, slot_id, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.codec import read_row, write_rows

_DIGITS = {"sun_altitude_deg": ".3f", "sun_azimuth_deg": ".3f"}


@dataclass(frozen=True, slots=True)
class _PlanRow:
    """One line of plan.csv; t_local only serves people who read the file."""

    slot: str
    t_utc: datetime
    t_local: str
    sun_altitude_deg: float
    sun_azimuth_deg: float
    exposures: str = ""
    tags: str = ""

    def planned(self) -> Slot:
        """Return the slot. Raises ValueError if its name is not that of its time."""
        if slot_id(self.t_utc) != self.slot:
            raise ValueError(f"slot {self.slot} does not match t_utc {utc_text(self.t_utc)}")
        exposures = (parse_exposure(text) for text in self.exposures.split(";") if text.strip())
        angles = self.sun_altitude_deg, self.sun_azimuth_deg
        return Slot(self.t_utc, *angles, tuple(exposures), tuple(self.tags.split()))


PLAN_COLUMNS = tuple(field.name for field in fields(_PlanRow))


def exposure_text(exposure: Exposure) -> str:
    """Return ``1/250 f/5.6 ISO100`` with an optional `` ND=name``; see `parse_exposure`."""
    shown = shutter_text(exposure.shutter_s)
    return f"{shown} f/{exposure.f_number:g} ISO{exposure.iso:g}" + (
        f" ND={exposure.nd}" if exposure.nd else ""
    )


def parse_exposure(text: str) -> Exposure:
    """Return the exposure in a text such as ``1/250 f/5.6 ISO100 ND=name``; ND= is optional.

    Raises ValueError for any other text, and for numbers that are not above 0 and finite.
    """
    shutter, f_number, iso, *nd = text.split()
    if not f_number.startswith("f/") or not iso.startswith("ISO"):
        raise ValueError(text)
    time, aperture, speed = (
        float(word) for word in (shutter.removeprefix("1/"), f_number[2:], iso[3:])
    )
    if not all(0.0 < value < math.inf for value in (time, aperture, speed)):
        raise ValueError(
            f"exposure {text}: shutter time, f-number and ISO must be finite and above 0"
        )
    seconds = 1.0 / time if shutter.startswith("1/") else time
    return Exposure(seconds, aperture, speed, nd[0].removeprefix("ND=") if nd else "")


def write_plan(path: Path, slots: Iterable[Slot], timezone: str) -> None:
    """Write the slots as plan.csv; the column of local times only serves readers of the file.

    timezone: IANA name of the zone of the local times.
    """
    zone = ZoneInfo(timezone)
    rows = (
        _PlanRow(
            slot.id,
            slot.t_utc,
            slot.t_utc.astimezone(zone).strftime("%Y-%m-%d %H:%M %Z"),
            slot.sun_altitude_deg,
            slot.sun_azimuth_deg,
            "; ".join(exposure_text(e) for e in slot.exposures),
            " ".join(slot.tags),
        )
        for slot in slots
    )
    write_rows(path, PLAN_COLUMNS, rows, _DIGITS, end="\r\n")


def read_plan(path: Path) -> list[Slot]:
    """Return the slots of a plan, in its order.

    Raises InputError for a missing file or other content.
    """
    if not path.is_file():
        raise InputError(
            path,
            "no such file",
            "the plan of a session",
            "restore it, or plan a new session: fieldlum plan SITE.toml --set 9-day --out FOLDER",
        )
    expected, remedy = f"columns {', '.join(PLAN_COLUMNS)}", "restore the plan from a copy"
    slots: list[Slot] = []
    for line, cells in read_table(path, expected, remedy, needed=PLAN_COLUMNS).dicts():
        row = read_row(_PlanRow, path, line, cells, remedy)
        with input_errors(f"{path}: line {line}", expected, remedy, ValueError, ArithmeticError):
            slots.append(row.planned())
    return slots
