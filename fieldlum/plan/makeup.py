"""Plan make-up slots: repeat a missed hour on a later day with the same path of the sun."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.files import read_bytes
from fieldlum.core.records import JsonTable, Site, SiteFile, Slot, listed, parse_utc, slot_id
from fieldlum.plan.capture_days import hours_of, span, sun_band_percent
from fieldlum.session import Session, sha256, update_session, write_file, write_plan
from fieldlum.session.folder import PlanTable
from fieldlum.session.plan_file import read_plan
from fieldlum.session.slot_states import MAKEUP, makeups_by_slot, read_slot_states
from fieldlum.sky import sun

# Half of a day's change at the equinoxes, so that every passage of a declination has such a day.
# Chosen as that half.
SAME_DECLINATION_DEG = 0.2
# The equation of time differs by up to half an hour between the two passages: 7.5 deg of hour
# angle. Chosen with a margin.
MAX_OFF_DEG = 12.0


def captured_ids(session: Session) -> set[str]:
    """Return the ids of the slots whose bracket was captured completely, by the capture records."""
    states = read_slot_states(session).slots
    return {slot for slot, state in states.items() if state.outcome == "done"}


def make_up(
    missed: Sequence[Slot], planned: Sequence[Slot], setup: SiteFile, now_utc: datetime
) -> tuple[list[Slot], list[JsonTable], list[str]]:
    """Return make-up slots, their pairs, and the ids of missed slots without one.

    A pair has the keys missed and slot (ids), and sun_off_deg, the angle between the two suns.

    A make-up is at the same hour of standard time, on the earliest of the 370 days from tomorrow
    that has the missed day's declination within 0.2 deg (also on the other side of the solstice),
    the sun up and within 12 deg of the missed one, and no planned slot at that time.
    """
    site, occupied = setup.site, {slot.id for slot in planned}
    days = span(sun.standard_date(now_utc, site.timezone) + timedelta(days=1), 370)
    noon = timedelta(hours=12)
    midnights = [sun.standard_midnight(day, site.timezone) for day in days]
    declination = sun.declination_deg([midnight + noon for midnight in midnights])
    added: list[Slot] = []
    pairs: list[JsonTable] = []
    lost: list[str] = []
    for slot in missed:
        day = sun.standard_date(slot.t_utc, site.timezone)
        midnight = sun.standard_midnight(day, site.timezone)
        off = np.abs(declination - sun.declination_deg([midnight + noon])[0])
        same = np.flatnonzero(off <= SAME_DECLINATION_DEG).tolist()
        times = [midnights[i] + (slot.t_utc - midnight) for i in same]
        free = _first_free(slot, times, occupied, site)
        if free is None:
            lost.append(slot.id)
            continue
        new, off_deg = free
        occupied.add(new.id)
        added.append(new)
        pairs.append({"missed": slot.id, "slot": new.id, "sun_off_deg": round(off_deg, 1)})
    return added, pairs, lost


def _first_free(
    slot: Slot, times: Sequence[datetime], occupied: set[str], site: Site
) -> tuple[Slot, float] | None:
    """Return the first free slot with the sun near that of a missed slot, and the angle [deg].

    slot: the missed one; times: candidates in UTC, in order; occupied: ids of the slots of the
    plan. None if no free time has such a sun.
    """
    at = sun.position(times, site)
    old = sun.direction(slot.sun_altitude_deg, slot.sun_azimuth_deg)
    cosine = sun.direction(at.altitude_deg, at.azimuth_deg) @ old
    off = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    for i in np.flatnonzero((at.altitude_deg > 0) & (off <= MAX_OFF_DEG)).tolist():
        if slot_id(times[i]) not in occupied:
            others = [tag for tag in slot.tags if not tag.startswith(MAKEUP)]
            tags = (*others, MAKEUP + slot.id)
            altitude, azimuth = float(at.altitude_deg[i]), float(at.azimuth_deg[i])
            angles = {"sun_altitude_deg": altitude, "sun_azimuth_deg": azimuth}
            return replace(slot, t_utc=times[i], **angles, tags=tags), float(off[i])
    return None


def run(session: Session, now_utc: datetime) -> JsonTable:
    """Add make-up slots for missed ones to plan.csv; return what was missed and what was added.

    If a make-up was missed, the original slot gets another one. No slot is removed. If slots are
    added, the earlier plan is stored as plan.N.csv, with N its revision (0 for the first).

    The keys are those of `--json`. missed: number of past slots captured neither themselves nor by
    a make-up; made_up: pairs added now; lost: ids of missed slots that no hour of the coming year
    can repeat; already: number with a make-up that is still to come; recovered: number whose
    make-up was captured; now_utc decides what is past; sun_band_percent: covered part of the sun
    band, "planned", "without" the missed slots, and "with" the make-ups; revision: of the plan, 0
    for the first.
    """
    now_utc = now_utc.astimezone(UTC)
    about = _complete_interrupted_replan(session)
    setup, slots, captured = session.site_file(), session.slots(), captured_ids(session)
    grace, makeups = session.grace, makeups_by_slot(slots)
    others = captured.union(makeup.id for several in makeups.values() for makeup in several)
    past = [s for s in slots if s.id not in others and s.t_utc + grace < now_utc]
    missed = [s for s in past if not any(m.id in captured for m in makeups.get(s.id, ()))]
    due = [s for s in missed if all(m.t_utc + grace < now_utc for m in makeups.get(s.id, ()))]
    added, pairs, lost = make_up(due, slots, setup, now_utc)
    if added:
        write_file(_older_plan(session, about), read_bytes(session.plan))
        ordered = sorted([*slots, *added], key=lambda slot: slot.t_utc)
        write_plan(session.plan, ordered, setup.site.timezone)
        about = _record_plan(session, about)
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


def _older_plan(session: Session, about: PlanTable) -> Path:
    return session.root / f"plan.{about.get('revision', 0)}.csv"


def _record_plan(session: Session, about: PlanTable) -> PlanTable:
    """Write the new plan's sha256 and length into session.toml; those of older plans remain."""
    older = [*about.get("older_sha256", []), about.get("sha256", "")]
    new: PlanTable = {
        **about,
        "revision": about.get("revision", 0) + 1,
        "slots": len(read_plan(session.plan)),
        "sha256": sha256(session.plan),
        "older_sha256": older,
    }
    update_session(session, {"plan": new})
    return new


def _complete_interrupted_replan(session: Session) -> PlanTable:
    """Return the table [plan] of session.toml; first complete a re-plan that was interrupted."""
    about = session.table().get("plan", {})
    if _older_plan(session, about).exists() and sha256(session.plan) != about.get("sha256"):
        return _record_plan(session, about)
    return about


def sentences(answer: JsonTable) -> list[str]:
    """Return the make-up plan as lines to print: missed, added and lost slots, and the coverage."""
    recovered, made_up, lost = answer["recovered"], answer["made_up"], answer["lost"]
    again = f"; {recovered} missed slots have been made up for" if recovered else ""
    if not answer["missed"]:
        return [f"no slot is missing; the plan is unchanged{again}"]
    texts = [
        f"{answer['missed']} slots missed, {answer['already']} of them already have a make-up slot"
        + again
    ]
    if made_up:
        days = sorted({f"{parse_utc(pair['slot']):%Y-%m-%d}" for pair in made_up})
        texts.append(
            f"{len(made_up)} make-up slots added on {len(days)} days: {listed(days)}; in each of "
            f"them the sun is within {max(pair['sun_off_deg'] for pair in made_up):g} deg of its "
            "position in the missed slot"
        )
    if lost:
        text = f"{len(lost)} missed slots have no make-up within a year"
        texts.append(f"{text}: {listed(lost, 4)}")
    band = answer["sun_band_percent"]
    texts.append(
        f"share of the year's sun band covered: {band['planned']:.0f} % as planned, "
        f"{band['without']:.0f} % without the missed slots, {band['with']:.0f} % with make-up slots"
    )
    return texts
