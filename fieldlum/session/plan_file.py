"""plan.csv: the planned slots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from zoneinfo import ZoneInfo

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Exposure, Slot, parse_utc, shutter_text, slot_id, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.writing import write_table

PLAN_COLUMNS = (
    "slot",
    "t_utc",
    "t_local",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "exposures",
    "tags",
)


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
        (
            slot.id,
            utc_text(slot.t_utc),
            slot.t_utc.astimezone(zone).strftime("%Y-%m-%d %H:%M %Z"),
            f"{slot.sun_altitude_deg:.3f}",
            f"{slot.sun_azimuth_deg:.3f}",
            "; ".join(exposure_text(e) for e in slot.exposures),
            " ".join(slot.tags),
        )
        for slot in slots
    )
    write_table(path, PLAN_COLUMNS, rows, end="\r\n")


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
    table = read_table(path, expected, remedy)
    if table.names != PLAN_COLUMNS:
        raise InputError(path, f"columns {', '.join(table.names)[:120]}", expected, remedy)
    for number, row in table.dicts():
        where, wrong = f"{path}:{number}", (KeyError, ValueError, TypeError, AttributeError)
        with input_errors(where, expected, remedy, *wrong):
            slots.append(_slot(row))
    return slots


def _slot(row: dict[str, str]) -> Slot:
    t_utc = parse_utc(row["t_utc"])
    if slot_id(t_utc) != row["slot"]:
        raise ValueError(f"slot {row['slot']} does not match t_utc {row['t_utc']}")
    exposures = tuple(parse_exposure(text) for text in row["exposures"].split(";") if text.strip())
    angles = float(row["sun_altitude_deg"]), float(row["sun_azimuth_deg"])
    return Slot(t_utc, *angles, exposures, tuple(row["tags"].split()))
