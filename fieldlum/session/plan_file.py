"""plan.csv: the planned slots."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from zoneinfo import ZoneInfo

from fieldlum.core.errors import input_errors
from fieldlum.core.records import Exposure, Slot, parse_utc, shutter_text, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.codec import convert, write_csv

_ANGLES = ("sun_altitude_deg", "sun_azimuth_deg")
PLAN_COLUMNS = ("slot", "t_utc", "t_local", *_ANGLES, "exposures", "tags")


def exposure_text(exposure: Exposure) -> str:
    """Return an exposure as a text: ``1/250 f/5.6 ISO100``, and `` ND=name`` for a filter.

    The shutter time is in s, with six significant digits; see `shutter_text`.
    """
    filtered = f" ND={exposure.nd}" if exposure.nd else ""
    shutter = shutter_text(exposure.shutter_s)
    return f"{shutter} f/{exposure.f_number:g} ISO{exposure.iso:g}{filtered}"


def parse_exposure(text: str) -> Exposure:
    """Return the exposure in a text such as ``1/250 f/5.6 ISO100 ND=name``.

    Its words are the shutter time in s, as a decimal or as 1/N, the f-number after f/, the ISO
    after ISO and, if a filter is used, its name after ND=. Raises ValueError for any other text,
    and for numbers that are not above 0 and finite.
    """
    words = text.split()
    # without a filter, an empty fourth word; fewer than three words raise ValueError
    shutter, f_number, iso, nd = [*words, "ND="][:4]
    marks = zip((f_number, iso, nd), ("f/", "ISO", "ND="), strict=True)
    if len(words) > 4 or not all(word.startswith(mark) for word, mark in marks):
        raise ValueError(text)
    seconds = float(shutter.removeprefix("1/"))
    if shutter.startswith("1/") and seconds:
        seconds = 1.0 / seconds
    stated = {"shutter_s": seconds, "f_number": f_number[2:], "iso": iso[3:], "nd": nd[3:]}
    return convert(stated, Exposure)


def write_plan(path: Path, slots: Iterable[Slot], timezone: str) -> None:
    """Write slots as a plan.csv, with their local times for people who read the file.

    timezone: IANA name of the zone of the local times. Raises OSError if it cannot be written.
    """
    zone = ZoneInfo(timezone)
    rows = [
        {
            "slot": slot.id,
            "t_utc": utc_text(slot.t_utc),
            "t_local": slot.t_utc.astimezone(zone).strftime("%Y-%m-%d %H:%M %Z"),
            "sun_altitude_deg": f"{slot.sun_altitude_deg:.3f}",
            "sun_azimuth_deg": f"{slot.sun_azimuth_deg:.3f}",
            "exposures": "; ".join(exposure_text(e) for e in slot.exposures),
            "tags": " ".join(slot.tags),
        }
        for slot in slots
    ]
    write_csv(path, rows, PLAN_COLUMNS)


def read_plan(path: Path) -> list[Slot]:
    """Return the slots of a plan, in its order.

    Raises InputError, with the line, for a missing file or column, a cell that cannot be read, and
    a slot whose id is not its t_utc.
    """
    expected = f"columns {', '.join(PLAN_COLUMNS)}"
    remedy = "restore the plan from a copy, or plan a new session"
    slots: list[Slot] = []
    for line, cells in read_table(path, expected, remedy, needed=PLAN_COLUMNS).dicts():
        with input_errors(f"{path}: line {line}", expected, remedy, ValueError, ArithmeticError):
            slots.append(_slot(cells))
    return slots


def _slot(cells: Mapping[str, str]) -> Slot:
    """Return the slot in a line of a plan.csv; cells: texts by column.

    Raises ValueError for a cell that cannot be read, and for a slot whose id is of another time.
    """
    altitude_deg, azimuth_deg = float(cells["sun_altitude_deg"]), float(cells["sun_azimuth_deg"])
    exposures = tuple(parse_exposure(t) for t in cells["exposures"].split(";") if t.strip())
    slot = Slot(
        t_utc=parse_utc(cells["t_utc"]),
        sun_altitude_deg=altitude_deg,
        sun_azimuth_deg=azimuth_deg,
        exposures=exposures,
        tags=tuple(cells["tags"].split()),
    )
    if slot.id != cells["slot"] or not math.isfinite(altitude_deg + azimuth_deg):
        angles = (altitude_deg, azimuth_deg)
        raise ValueError(f"slot {cells['slot']} with t_utc {cells['t_utc']}, angles {angles}")
    return slot
