"""Cards as people bring them: two cameras on one, a clock that was set, frames that are missing,
other formats.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum.capture import import_card
from fieldlum.capture.import_card import of_session_camera
from fieldlum.capture.match_card import CardFrame, Group, Offset, clock_parts, offset_contradiction
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Exposure, SiteFile, Slot
from fieldlum.optics.profiles import load_camera_profile, save_profile
from fieldlum.optics.raw import same_model
from fieldlum.optics.raw.writing import write_dng, write_jpeg
from fieldlum.pair import judge, merged_brackets
from fieldlum.pair.bracket_irradiance import BracketIrradiance
from fieldlum.session import Session, create_session, read_journal
from fieldlum.session.slot_states import apply_events

NOON = datetime(2027, 3, 14, 20, 30, tzinfo=UTC)  # of Seattle, on the day of its clock change
LADDER = tuple(Exposure(t, 5.6) for t in (1 / 8, 1 / 60, 1 / 250))
MONTH = [
    Slot(NOON + timedelta(days=day, hours=hour), 20.0, 180.0, LADDER)
    for day in range(-9, 22)
    for hour in range(-5, 7)
]
PST_S, PDT_S = -8 * 3600.0, -7 * 3600.0
ZONE = "America/Los_Angeles"


def make_session(folder: Path, slots: list[Slot], profile: str = "") -> Session:
    setup = SiteFile(SEATTLE, CameraSetup(profile=profile))
    return create_session(folder, setup, slots, {"set": "test"})


def write(path: Path, exposure: Exposure, t: datetime, model: str = "D850") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    naive = t.replace(tzinfo=None)
    if path.suffix == ".dng":
        counts = np.full((8, 8), 900, np.uint16)
        write_dng(
            path, counts, exposure, black_dn=(0.0,) * 4, white_dn=1e4, t_camera=naive, model=model
        )
    else:
        write_jpeg(path, np.full((8, 8, 3), 90, np.uint8), exposure, t_camera=naive, model=model)


def bracket(slot: Slot, clock_s: float) -> Group:
    start = slot.t_utc + timedelta(seconds=clock_s)
    times = (start + timedelta(seconds=2 * i) for i in range(len(slot.exposures)))
    frames = zip(slot.exposures, times, strict=True)
    return Group(
        tuple(CardFrame(Path(f"{slot.id}_{i}.dng"), e, t) for i, (e, t) in enumerate(frames))
    )


@pytest.mark.slow
@pytest.mark.property
@given(
    change=st.integers(4, 27),
    hours=st.sampled_from((-2, -1, 1, 2)),
    missing=st.sets(st.integers(0, 371)),
)
@settings(deadline=None, max_examples=8)
def test_a_clock_set_between_two_days_is_found(change: int, hours: int, missing: set[int]) -> None:
    def clock_s(i: int) -> float:
        return PST_S + (3600.0 * hours if i >= 12 * change else 0.0)

    # Only the ends of days tell one clock from the other: more than three must on either side, and
    # one in the days next to the change.
    taken = [i for i in range(len(MONTH)) if i not in missing]
    after = [i // 12 for i in taken if i >= 12 * change and not 0 <= i % 12 + hours < 12]
    before = [i // 12 for i in taken if i < 12 * change and not 0 <= i % 12 - hours < 12]
    assume(len(after) > 3 and len(before) > 3 and change in after and change - 1 in before)
    groups = [bracket(MONTH[i], clock_s(i)) for i in taken]
    parts = clock_parts(groups, MONTH, ZONE)
    assert [part[0] for part in parts] == [
        groups[0],
        next(g for i, g in _numbered(groups) if i >= 12 * change),
    ]


def _numbered(groups: list[Group]) -> list[tuple[int, Group]]:
    where = {slot.id: i for i, slot in enumerate(MONTH)}
    return [(where[group.frames[0].path.name[:16]], group) for group in groups]


@pytest.mark.slow
@pytest.mark.contract
def test_a_clock_that_was_not_set_is_left_alone() -> None:
    by_hand = np.random.default_rng(1).uniform(0, 1100, len(MONTH))
    groups = [bracket(slot, PST_S + late) for slot, late in zip(MONTH, by_hand, strict=True)]
    assert len(clock_parts(groups, MONTH, ZONE)) == 1
    afternoons = [bracket(slot, PST_S) for i, slot in enumerate(MONTH) if i % 12 > 5]
    assert len(clock_parts(afternoons, MONTH, ZONE)) == 1


@pytest.mark.slow
@pytest.mark.contract
def test_a_camera_set_to_daylight_saving_time_within_the_month(tmp_path: Path) -> None:
    """Every bracket lies in its own slot, where one clock for all would put some days an
    hour beside.
    """
    plan = [
        replace(slot, exposures=LADDER[:1]) for slot in MONTH[84:144]
    ]  # two days before, three after
    session = make_session(tmp_path / "s", plan)
    for i, slot in enumerate(plan):
        clock_s = PST_S if i < 24 else PDT_S
        write(
            tmp_path / "card" / f"DSC_{i:04d}.jpg",
            LADDER[0],
            slot.t_utc + timedelta(seconds=clock_s),
        )
    told = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S)
    assert (
        "DSC_0000.jpg on are near slots; with --utc-offset -08:00 it would be 12, " in told.notes[0]
    )
    assert "DSC_0012.jpg on" in told.notes[0] and "DSC_0024.jpg" not in told.notes[0]
    report = import_card.run(session, tmp_path / "card")
    assert [offset.seconds for offset in report.offsets] == [PST_S, PDT_S]
    assert (
        len(report.notes) == 1
        and "the plan suggests that the camera's clock was changed by +1 h before"
        in report.notes[0]
    )
    assert (
        report.slots == tuple(slot.id for slot in plan[:24])
        and report.known == 36
        and set(report.late_s) == {0.0}
    )


@pytest.mark.contract
@pytest.mark.parametrize("days_after", [0, 1])
def test_one_bracket_shows_a_clock_set_near_a_change_of_civil_time(days_after: int) -> None:
    """Wellington, two days before and after the end of daylight saving time on 4 April 2027: the
    person sets the camera on that day or a day later.
    """
    zone, hour = "Pacific/Auckland", timedelta(hours=1)
    first = datetime(2027, 4, 1, 19, 30, tzinfo=UTC)  # 2 April, 08:30 in New Zealand
    starts = [first + 24 * hour * day + hour * k for day in range(4) for k in range(10)]
    slots = [replace(MONTH[0], t_utc=start) for start in starts]
    summer = 20 + 10 * days_after
    groups = [bracket(s, 3600.0 * (13 if i < summer else 12)) for i, s in enumerate(slots)]
    assert [len(part) for part in clock_parts(groups, slots, zone)] == [summer, 40 - summer]
    assert len(clock_parts(groups, slots, "UTC")) == 1
    kept = [bracket(slot, 3600.0 * 13) for slot in slots]
    assert len(clock_parts(kept, slots, zone)) == 1


@pytest.mark.contract
def test_a_wrong_offset_is_doubted_by_the_plan() -> None:
    groups = [bracket(slot, PDT_S) for slot in MONTH[:60]]
    assert offset_contradiction(groups, MONTH, Offset(PDT_S, "--utc-offset")) == ""
    said = offset_contradiction(groups, MONTH[:60], Offset(PST_S, "--utc-offset"))
    assert said.startswith(
        "with the offset of the camera's clock (--utc-offset), 55 of 60 brackets are near slots; "
        "with --utc-offset -07:00 it would be 60"
    )
    in_exif = Offset(0.0, "stated in EXIF", (PST_S,))
    utc = [bracket(slot, 3600.0) for slot in MONTH[:60]]
    assert "with --utc-offset -07:00 it" in offset_contradiction(utc, MONTH[:60], in_exif)
    two = in_exif._replace(exif_s=(PST_S, PDT_S))
    assert "an offset changed by +1 h" in offset_contradiction(utc, MONTH[:60], two)


@pytest.mark.contract
@pytest.mark.parametrize("day", [0, 2, 4])
@pytest.mark.parametrize("change", [-3600.0, 3600.0])
def test_a_clock_of_a_single_day_is_doubted(day: int, change: float) -> None:
    """One bracket of such a day is near no slot, which is too little to split the card."""
    slots = MONTH[:60]
    clocks_s = [change if i // 12 == day else 0.0 for i in range(60)]
    groups = [bracket(slot, c) for slot, c in zip(slots, clocks_s, strict=True)]
    said = offset_contradiction(groups, slots, Offset(0.0, "fitted to the plan"))
    assert said == (
        "with the offset of the camera's clock (fitted to the plan), 11 of 12 brackets from "
        f"{slots[12 * day].id}_0.dng on are near slots; "
        f"with --utc-offset {'+' if change > 0 else '-'}01:00 it would be 12: if the clock was "
        "set, import the frames of such days alone, with that option"
    )


@pytest.mark.contract
def test_brackets_beside_the_plan_are_no_clock_of_a_day() -> None:
    """One before the first slot, one very late, one left out, and an evening of practice."""
    slots = MONTH[:60]
    practice = [replace(slots[0], t_utc=slots[0].t_utc - timedelta(hours=h)) for h in (14, 13)]
    early = replace(slots[12], t_utc=slots[12].t_utc - timedelta(hours=1))
    groups = [bracket(slot, 0.0) for slot in (*practice, *slots[:12], early, *slots[12:])]
    groups[20] = bracket(slots[18], 1500.0)
    del groups[30]
    assert offset_contradiction(groups, slots, Offset(0.0, "fitted to the plan")) == ""


@pytest.mark.slow
@pytest.mark.contract
def test_a_date_that_is_wrong_is_told_and_costs_no_other_bracket(tmp_path: Path) -> None:
    plan = [replace(slot, exposures=LADDER[:1]) for slot in MONTH[:72]]
    day_off, lost = (
        PST_S + 86400.0,
        (datetime(2015, 1, 1, tzinfo=UTC) - plan[36].t_utc).total_seconds(),
    )
    for name, clock_s in (
        ("day", lambda i: day_off),
        ("lost", lambda i: PST_S if i < 36 else lost),
    ):
        for i, slot in enumerate(plan):
            write(
                tmp_path / name / f"DSC_{i:04d}.jpg",
                LADDER[0],
                slot.t_utc + timedelta(seconds=clock_s(i)),
            )
    report = import_card.run(make_session(tmp_path / "a", plan), tmp_path / "day")
    assert (
        "60 of 72 brackets are near slots; with an offset changed by +24 h it would be 72"
        in report.notes[0]
    )
    report = import_card.run(make_session(tmp_path / "b", plan), tmp_path / "lost")
    assert report.brackets == 36 and report.slots == tuple(slot.id for slot in plan[:36])
    assert (
        "DSC_0036.jpg and 35 brackets after it: the brackets from 2015-01-01" in report.left_out[0]
    )


@pytest.mark.contract
def test_a_card_folder_that_holds_its_own_copy_makes_whole_brackets(tmp_path: Path) -> None:
    """Each exposure came twice, so every bracket fell into pieces, and the best piece was taken."""
    session = make_session(tmp_path / "s", MONTH[:12])
    for i, slot in enumerate(MONTH[:12]):
        for k, exposure in enumerate(LADDER):
            t = slot.t_utc + timedelta(seconds=PST_S + 2 * k)
            write(tmp_path / "card" / "DCIM" / f"DSC_{3 * i + k:04d}.jpg", exposure, t)
    shutil.copytree(tmp_path / "card" / "DCIM", tmp_path / "card" / "backup")
    report = import_card.run(session, tmp_path / "card")
    assert (report.brackets, report.frames, report.notes) == (12, 36, ())
    assert report.left_out == (
        f"{tmp_path / 'card' / 'backup' / 'DSC_0000.jpg'} and 35 more: a copy of another frame",
    )


@pytest.mark.contract
def test_frames_of_two_cameras_never_make_one_bracket(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", MONTH[:12])
    for i, slot in enumerate(MONTH[:12]):
        for k, exposure in enumerate(LADDER):
            t = slot.t_utc + timedelta(seconds=PST_S + 2 * k)
            write(tmp_path / "card" / f"DSC_{3 * i + k:04d}.jpg", exposure, t)
            if i:
                write(
                    tmp_path / "card" / f"IMG_{3 * i + k:04d}.jpg",
                    exposure,
                    t + timedelta(seconds=1),
                    "EOS 5D",
                )
    report = import_card.run(session, tmp_path / "card")
    assert (report.brackets, report.frames) == (12, 36)
    assert report.left_out == ("33 frames of EOS 5D: the session's camera is D850",)
    names = {
        frame.file[:3]
        for state in apply_events(read_journal(session)).slots.values()
        for frame in state.frames
    }
    assert names == {"DSC"}


@pytest.mark.contract
def test_a_camera_that_replaced_another_one_is_told(tmp_path: Path) -> None:
    """Two cards, a week apart: each is of one camera, but the profile is of one of them."""
    session = make_session(tmp_path / "session", MONTH)
    for card, days in (("D850", (0, 1)), ("D750", (7,))):
        for day in days:
            slot = MONTH[12 * day]
            for i, exposure in enumerate(slot.exposures):
                taken = slot.t_utc + timedelta(seconds=PST_S + 2 * i)
                write(tmp_path / card / f"{day}{i}.dng", exposure, taken, card)
            session.panoramas.mkdir(exist_ok=True)
            session.panorama(slot.id).touch()
        import_card.run(session, tmp_path / card, utc_offset_s=PST_S)
    brackets = merged_brackets(session)
    assert [bracket.camera for bracket in brackets] == ["", "", "D750"]
    row = judge(brackets[2], BracketIrradiance(ghi_wm2=400.0), 30.0, 178.0)
    assert row.ok and "taken by D750" in row.why


@pytest.mark.contract
def test_two_bodies_of_one_model_are_two_cameras() -> None:
    def frames(serial: str, number: int) -> list[CardFrame]:
        return [
            CardFrame(Path(f"{serial}{i}.NEF"), LADDER[0], NOON, None, "D850", serial)
            for i in range(number)
        ]

    body = load_camera_profile("").camera
    mine, said = of_session_camera([*frames("3001", 5), *frames("3002", 9)], body)
    assert {f.serial for f in mine} == {"3002"} and said == [
        "5 frames of D850 3001: the session's camera is D850 3002"
    ]


@pytest.mark.slow
@pytest.mark.contract
def test_the_profile_says_whose_frames_and_which_format(tmp_path: Path) -> None:
    ours = {"raw": "sim-dual-fisheye", "jpeg": "sim-dual-fisheye-jpeg"}
    for kind, name in ours.items():
        shipped = load_camera_profile(name)
        profile = tmp_path / f"{kind}.toml"
        save_profile(
            profile, replace(shipped, camera=replace(shipped.camera, model="Canon EOS 5D"))
        )
        session = make_session(tmp_path / kind, MONTH[:4], str(profile))
        for i, slot in enumerate(MONTH[:4]):
            for k, exposure in enumerate(LADDER):
                t = slot.t_utc + timedelta(seconds=PST_S + 2 * k)
                for file, model in (
                    (f"DSC_{3 * i + k:04d}", "D850"),
                    (f"IMG_{3 * i + k:04d}", "EOS 5D"),
                ):
                    write(tmp_path / "card" / f"{file}.jpg", exposure, t, model)
                    write(tmp_path / "card" / f"{file}.dng", exposure, t, model)
        assert import_card.run(session, tmp_path / "card", utc_offset_s=PST_S).frames == 12
        files = {
            frame.file
            for state in apply_events(read_journal(session)).slots.values()
            for frame in state.frames
        }
        assert {(name[:3], name[-4:]) for name in files} == {
            ("IMG", ".dng" if kind == "raw" else ".jpg")
        }
    assert (
        same_model("Canon EOS 5D", "eos 5d")
        and not same_model("", "D850")
        and not same_model("D850", "D750")
    )
    assert not same_model("NIKON D800", "Nikon D80"), "words, not letters"


@pytest.mark.contract
def test_a_bracket_that_is_not_whole_is_taken_over_and_told(tmp_path: Path) -> None:
    plan = [
        Slot(s.t_utc, 20.0, 180.0, (*LADDER, Exposure(1 / 250, 5.6, nd="nd5"))) for s in MONTH[:12]
    ]
    session = make_session(tmp_path / "s", plan)
    for i, slot in enumerate(plan):
        for k, exposure in enumerate(slot.exposures):
            if (i, k) not in ((3, 1), (5, 3)):
                t = slot.t_utc + timedelta(seconds=PST_S + 2 * k)
                write(tmp_path / "card" / f"DSC_{4 * i + k:04d}.jpg", exposure, t)
    report = import_card.run(session, tmp_path / "card")
    assert report.brackets == 12 and len(report.notes) == 2
    one, filtered = report.notes
    assert f"missing frames of slot {plan[3].id}: 1 (1/60 f/5.6 ISO100)" in one
    assert "1/250 f/5.6 ISO100 ND=nd5)" in filtered
    notes = [(session.raw / slot.id / "capture.json").read_text() for slot in plan]
    assert [i for i, note in enumerate(notes) if '"complete": false' in note] == [3, 5]


@pytest.mark.contract
def test_pictures_that_cannot_be_merged_are_named(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", MONTH[:12])
    folder = tmp_path / "card"
    folder.mkdir()
    for name in ("a.HEIC", "b.HEIC", "c.MPO", "d.xmp", "._DSC_0001.JPG", "e.MP4"):
        (folder / name).write_bytes(b"x")
    said = r"no raw or JPEG frames in this folder \(.heic, .mp4, .mpo, .xmp\).*record raw"
    with pytest.raises(InputError, match=said):
        import_card.run(session, folder)
