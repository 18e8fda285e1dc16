"""Add slots to a plan: make-ups on a later day with the same path of the sun, and chosen days."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.files import read_bytes
from fieldlum.core.records import JsonTable, Site, SiteFile, Slot, listed, parse_utc, slot_id
from fieldlum.plan import make_slots
from fieldlum.plan.capture_days import daylight_hours, hours_of, span, sun_band_percent
from fieldlum.session import Session, sha256, update_session, write_file, write_plan
from fieldlum.session.folder import PlanTable
from fieldlum.session.plan_file import read_plan
from fieldlum.session.slot_states import MAKEUP, captured_ids, makeups_by_slot
from fieldlum.sky import sun

# Declinations that count as equal: half of a day's change at the equinoxes, so that each of the two
# days of a year with about the same declination is found.
SAME_DECLINATION_DEG = 0.2
# Largest angle between the suns of a missed and a make-up slot. The equation of time differs by up
# to half an hour between the two days: 7.5 deg of hour angle. Chosen with a margin.
MAX_OFF_DEG = 12.0
_ADDED = "added"  # tag of the slots of an added day, which is not missed if nothing is captured


def make_up(
    missed: Sequence[Slot], planned: Sequence[Slot], setup: SiteFile, now_utc: datetime
) -> tuple[list[Slot], list[JsonTable], list[str]]:
    """Return make-up slots for missed ones, their pairs, and the ids of missed slots without one.

    missed: slots to repeat; planned: all slots of the plan; now_utc: decides which day is tomorrow.
    A pair has the keys missed and slot (ids), and sun_off_deg, the angle between the two suns.
    Nothing is written.

    A make-up is at the same hour of standard time, on the earliest of the 370 days from tomorrow
    that has the missed day's declination within 0.2 deg (also on the other side of the solstice),
    the sun up and within 12 deg of the missed one, and no planned slot at that time. A make-up slot
    has the exposures and tags of the missed slot, and the tag ``makeup:ID`` with the id of that
    slot.
    """
    site, occupied = setup.site, {slot.id for slot in planned}
    days = span(sun.standard_date(now_utc, site.timezone) + timedelta(days=1), 370)
    noon = timedelta(hours=12)
    midnights = [sun.standard_midnight(day, site.timezone) for day in days]
    declinations_deg = sun.declination_deg([midnight + noon for midnight in midnights])
    added: list[Slot] = []
    pairs: list[JsonTable] = []
    lost: list[str] = []
    for slot in missed:
        day = sun.standard_date(slot.t_utc, site.timezone)
        midnight = sun.standard_midnight(day, site.timezone)
        difference_deg = np.abs(declinations_deg - sun.declination_deg([midnight + noon])[0])
        same = np.flatnonzero(difference_deg <= SAME_DECLINATION_DEG).tolist()
        times = [midnights[i] + (slot.t_utc - midnight) for i in same]
        first_free = _first_free(slot, times, occupied, site)
        if first_free is None:
            lost.append(slot.id)
            continue
        makeup, off_deg = first_free
        occupied.add(makeup.id)
        added.append(makeup)
        pairs.append({"missed": slot.id, "slot": makeup.id, "sun_off_deg": round(off_deg, 1)})
    return added, pairs, lost


def _first_free(
    missed: Slot, times: Sequence[datetime], occupied: set[str], site: Site
) -> tuple[Slot, float] | None:
    """Return the make-up slot for a missed one, and the angle between their suns [deg].

    The make-up slot is at the first of `times` (UTC) that has no slot and the sun within 12 deg of
    the missed one; None if there is none. occupied: ids of the slots of the plan.
    """
    at = sun.position(times, site)
    missed_sun = sun.direction(missed.sun_altitude_deg, missed.sun_azimuth_deg)
    cosine = sun.direction(at.altitude_deg, at.azimuth_deg) @ missed_sun
    off_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    for i in np.flatnonzero((at.altitude_deg > 0) & (off_deg <= MAX_OFF_DEG)).tolist():
        if slot_id(times[i]) not in occupied:
            others = [tag for tag in missed.tags if not tag.startswith(MAKEUP)]
            altitude_deg, azimuth_deg = float(at.altitude_deg[i]), float(at.azimuth_deg[i])
            angles = {"sun_altitude_deg": altitude_deg, "sun_azimuth_deg": azimuth_deg}
            makeup = replace(missed, t_utc=times[i], **angles, tags=(*others, MAKEUP + missed.id))
            return makeup, float(off_deg[i])
    return None


def run(session: Session, now_utc: datetime) -> JsonTable:
    """Add make-up slots for missed ones to plan.csv; return what was missed and what was added.

    If a make-up was missed, the original slot gets another one. No slot is removed. If slots are
    added, the earlier plan is stored as plan.N.csv, with N its revision (0 for the first), and the
    table [plan] of session.toml is updated. now_utc: a slot is missed if its bracket has not begun
    a grace, the session's, before this time. Raises InputError for a damaged plan.csv or
    session.toml.

    The keys are those of `--json`. missed: number of slots before now_utc that were captured
    neither themselves nor by a make-up; made_up: make-ups added now, each with the ids missed and
    slot, and sun_off_deg, the angle between the two suns; lost: ids of missed slots that no hour of
    the coming year can repeat; already: number with a make-up that is still to come; recovered:
    number whose make-up was captured; sun_band_percent: covered part of the sun band, "planned",
    "without" the missed slots, and "with" the make-ups; revision: of the plan, 0 for the first.
    """
    now_utc = now_utc.astimezone(UTC)
    about = _complete_interrupted_replan(session)
    setup, slots, captured = session.site_file(), session.slots(), captured_ids(session)
    grace, makeups = session.grace, makeups_by_slot(slots)
    others = captured.union(makeup.id for several in makeups.values() for makeup in several)
    # original slots that are past and not captured; of these, without a captured make-up; of
    # these, without a make-up that is still to come
    waiting = [s for s in slots if s.id not in others and _ADDED not in s.tags]
    past = [s for s in waiting if s.t_utc + grace < now_utc]
    missed = [s for s in past if not any(m.id in captured for m in makeups.get(s.id, ()))]
    due = [s for s in missed if all(m.t_utc + grace < now_utc for m in makeups.get(s.id, ()))]
    added, pairs, lost = make_up(due, slots, setup, now_utc)
    about = _with_more(session, about, added)
    remaining = [slot for slot in slots if slot.id in captured or slot.t_utc + grace >= now_utc]
    versions = {"planned": slots, "without": remaining, "with": [*remaining, *added]}
    bands = {name: sun_band_percent(hours_of(some), setup.site) for name, some in versions.items()}
    return {
        "missed": len(missed),
        "made_up": pairs,
        "lost": lost,
        "already": len(missed) - len(due),
        "recovered": len(past) - len(missed),
        "sun_band_percent": {name: round(band, 1) for name, band in bands.items()},
        "revision": about.get("revision", 0),
    }


def add_days(session: Session, days: Sequence[date]) -> JsonTable:
    """Add the daylight hours of some days to plan.csv, with the exposures of its first slot.

    The days can be past, for brackets that were captured without a plan; hours that have a slot are
    not added. The earlier plan is stored as `run` does. Returns the keys of `--json`: added, ids of
    the slots, and revision. Raises InputError for a damaged plan.csv or session.toml.
    """
    about = _complete_interrupted_replan(session)
    setup, slots = session.site_file(), session.slots()
    known = {slot.id for slot in slots}
    made = make_slots(daylight_hours(days, setup.site), setup, slots[0].exposures)
    added = [replace(s, tags=(*s.tags, _ADDED)) for s in made if s.id not in known]
    about = _with_more(session, about, added)
    return {"added": [slot.id for slot in added], "revision": about.get("revision", 0)}


def _with_more(session: Session, about: PlanTable, added: Sequence[Slot]) -> PlanTable:
    """Add slots, if any, to plan.csv and store the earlier plan; return the new table [plan].

    about: the table [plan] of session.toml, which is written too.
    """
    if not added:
        return about
    ordered = sorted([*session.slots(), *added], key=lambda slot: slot.t_utc)
    write_file(_older_plan(session, about), read_bytes(session.plan))
    write_plan(session.plan, ordered, session.site_file().site.timezone)
    return _record_plan(session, about)


def _older_plan(session: Session, about: PlanTable) -> Path:
    """Return the path to which the present plan is copied; about: its table [plan]."""
    return session.root / f"plan.{about.get('revision', 0)}.csv"


def _record_plan(session: Session, about: PlanTable) -> PlanTable:
    """Write the table [plan] of a plan.csv that was changed into session.toml, and return it.

    about: the table of the plan before. The new one has the next revision, and the SHA-256 of the
    new plan and of all earlier ones.
    """
    new: PlanTable = {
        **about,
        "revision": about.get("revision", 0) + 1,
        "slots": len(read_plan(session.plan)),
        "sha256": sha256(session.plan),
        "older_sha256": [*about.get("older_sha256", []), about.get("sha256", "")],
    }
    update_session(session, {"plan": new})
    return new


def _complete_interrupted_replan(session: Session) -> PlanTable:
    """Return the table [plan] of session.toml; first complete a make-up plan that was interrupted.

    A make-up plan was interrupted if plan.csv is already new and session.toml still old.
    """
    about = session.table().get("plan", {})
    if _older_plan(session, about).exists() and sha256(session.plan) != about.get("sha256"):
        return _record_plan(session, about)
    return about


def sentences(answer: JsonTable, timezone: str) -> list[str]:
    """Return sentences to print on make-up slots; answer: the result of `run`.

    timezone: IANA name, for the local standard dates.
    """
    recovered, made_up, lost = answer["recovered"], answer["made_up"], answer["lost"]
    again = f"; {recovered} missed slots have been made up for" if recovered else ""
    if not answer["missed"]:
        return [f"no slot is missing; the plan is unchanged{again}"]
    missed = f"{answer['missed']} slots missed, {answer['already']} of them already have"
    texts = [f"{missed} a make-up slot{again}"]
    if made_up:
        slots = [parse_utc(pair["slot"]) for pair in made_up]
        days = sorted({str(sun.standard_date(t, timezone)) for t in slots})
        off_deg = max(pair["sun_off_deg"] for pair in made_up)
        added = f"{len(made_up)} make-up slots added on {len(days)} days: {listed(days)}"
        near = f"the sun is within {off_deg:g} deg of its position in the missed slot"
        texts.append(f"{added}; in each of them {near}")
    if lost:
        text = f"{len(lost)} missed slots have no make-up within a year"
        texts.append(f"{text}: {listed(lost, 4)}")
    band = answer["sun_band_percent"]
    texts.append(
        f"share of the year's sun band covered: {band['planned']:.0f} % as planned, "
        f"{band['without']:.0f} % without the missed slots, {band['with']:.0f} % with make-up slots"
    )
    return texts
