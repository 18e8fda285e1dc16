"""Import: a card's frames become the brackets of the plan, whatever the camera's clock says."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import example, given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum.capture import import_card
from fieldlum.capture.bracket import frame_requests
from fieldlum.capture.import_logger import add_samples, import_rows
from fieldlum.capture.match_card import (
    CardFrame,
    Group,
    Offset,
    clock_offset,
    find_offset,
    group_frames,
    match_groups,
    planned_indices,
    refine_offset,
    split_at_gaps,
)
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import CameraSetup, Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.optics.raw.writing import write_jpeg
from fieldlum.pair.irradiance import Mark, series_of
from fieldlum.session import Session, create_session, day_files, read_day, read_journal, sha256
from fieldlum.session.slot_states import apply_events

DAWN = datetime(2027, 3, 20, 14, 30, tzinfo=UTC)
LADDER = tuple(Exposure(t, 5.6) for t in (2.0, 1 / 2, 1 / 8, 1 / 30, 1 / 125))
PLAN = [Slot(DAWN + timedelta(hours=i), 10.0, 120.0, LADDER) for i in range(12)]
PDT_S = -7 * 3600.0


def frames_at(
    start: datetime, ladder: tuple[Exposure, ...] = LADDER, step: float = 1.0
) -> list[CardFrame]:
    """As a camera's EXIF has them: whole seconds of its own clock."""
    found, t = [], start
    for i, exposure in enumerate(ladder):
        found.append(
            CardFrame(Path(f"{start:%d%H%M%S}_{i}.dng"), exposure, t.replace(microsecond=0))
        )
        t += timedelta(seconds=exposure.shutter_s + step)
    return found


def card(
    plan: list[Slot], clock_s: float, late_s: float = 0.0, step: float = 1.0
) -> list[CardFrame]:
    shift = timedelta(seconds=clock_s + late_s)
    return [frame for slot in plan for frame in frames_at(slot.t_utc + shift, step=step)]


@pytest.mark.slow
@pytest.mark.property
@given(
    step=st.floats(0.2, 12.0),
    clock_h=st.integers(-47, 56),
    drift=st.integers(-90, 90),
    seed=st.integers(0, 99),
)
@example(step=1.0, clock_h=-27, drift=60, seed=0)
@example(step=1.0, clock_h=-29, drift=0, seed=0)
@settings(deadline=None, max_examples=40)
def test_any_camera_clock_is_found_from_a_whole_day(
    step: float, clock_h: int, drift: int, seed: int
) -> None:
    clock_s = 900.0 * clock_h
    frames = card(PLAN, clock_s + drift, step=step)
    random.Random(seed).shuffle(frames)
    groups = group_frames(frames, LADDER)
    assert [len(g.frames) for g in groups] == [5] * 12
    offset = find_offset(groups, PLAN, (PDT_S, 0.0))
    # within 20 minutes of civil time the offset is refined from there
    assert offset is not None and offset.seconds in (clock_s, PDT_S)
    refined = refine_offset(groups, PLAN, offset)
    assert refined.seconds == pytest.approx(clock_s + drift, abs=1.5)
    matches, unmatched = match_groups([(groups, refined)], PLAN)
    assert [m.slot for m in matches] == PLAN and not unmatched


@pytest.mark.contract
def test_part_of_a_day_is_taken_for_civil_time_and_says_so() -> None:
    groups = group_frames(card(PLAN[3:6], PDT_S), LADDER)
    found = find_offset(groups, PLAN, (PDT_S, 0.0))
    assert found is not None and found.seconds == PDT_S and "other offsets would fit" in found.how
    assert "civil time" in found.how
    assert find_offset(groups, PLAN, ()) is None
    utc = find_offset(group_frames(card(PLAN[3:6], 0.0), LADDER), PLAN, (0.0,))
    assert utc is not None and utc.how.startswith("assumed to be UTC; other offsets")


@pytest.mark.contract
def test_a_person_with_a_release_is_not_a_clock_error() -> None:
    rng = np.random.default_rng(1)
    frames = [
        f
        for s in PLAN
        for f in frames_at(s.t_utc + timedelta(seconds=60 + float(rng.uniform(0, 200))))
    ]
    groups = group_frames(frames, LADDER)
    assert refine_offset(groups, PLAN, Offset(0.0, "told")).seconds == 0.0


@pytest.mark.contract
def test_brackets_back_to_back_and_snapshots_are_told_apart() -> None:
    twice = frames_at(DAWN) + frames_at(DAWN + timedelta(seconds=14))
    snapshot = [
        CardFrame(Path("snap.dng"), Exposure(1 / 60, 2.8, 800), DAWN + timedelta(minutes=20))
    ]
    stray = frames_at(DAWN + timedelta(hours=20))
    groups = group_frames(twice + snapshot + stray, LADDER)
    assert [len(g.frames) for g in groups] == [5, 5, 1, 5]
    matches, unmatched = match_groups([(groups, Offset(0.0, "told"))], PLAN)
    assert [m.slot for m in matches] == PLAN[:1] and matches[0].group is groups[0]
    assert len(unmatched) == 3
    assert {why.split()[0] for _, why in unmatched} == {"another", "at", "no"}


@pytest.mark.contract
def test_an_interrupted_bracket_does_not_swallow_the_next() -> None:
    frames = (
        frames_at(DAWN, LADDER[:2])
        + frames_at(DAWN + timedelta(hours=1), LADDER[2:])
        + card(PLAN[2:], 0.0)
    )
    assert [len(g.frames) for g in group_frames(frames, LADDER)] == [2, 3] + [5] * 10


@pytest.mark.contract
def test_a_filter_and_turned_headings_repeat_exposures() -> None:
    plan = (*LADDER, Exposure(1 / 125, 5.6, nd="nd3"))
    setup = CameraSetup(headings=(0.0, 180.0))
    shot = tuple(Exposure(e.shutter_s, e.f_number) for e in (*plan, *plan))
    groups = group_frames(frames_at(DAWN, shot), plan, headings=2)
    assert [len(g.frames) for g in groups] == [12]
    slot = Slot(DAWN, 10.0, 120.0, plan)
    planned = import_card.planned_frames(groups[0], slot, setup)
    assert planned == list(frame_requests(plan, setup))
    again = Group((*groups[0].frames, groups[0].frames[-1]))  # one too many
    assert import_card.planned_frames(again, slot, setup)[-2:] == [planned[-1]] * 2


# Orders in which cameras take a bracket: as planned, the other way, and the middle one first.
ORDERS = ((0, 1, 2, 3, 4), (4, 3, 2, 1, 0), (2, 1, 3, 0, 4))


@pytest.mark.contract
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("headings", [(20.0, 200.0), (0.0, 120.0, 240.0)])
def test_a_missing_frame_moves_no_other_one_to_another_heading(
    order: tuple[int, ...], headings: tuple[float, ...]
) -> None:
    """The frame that a heading lacks was taken from the next heading's."""
    setup, slot = CameraSetup(headings=headings), Slot(DAWN, 10.0, 120.0, LADDER)
    taken: list[tuple[CardFrame, float]] = []
    for k, heading in enumerate(headings):
        shot = frames_at(DAWN + timedelta(seconds=15 * k), tuple(LADDER[i] for i in order))
        taken += [(frame, heading) for frame in shot]
    gone = [{i} for i in range(len(taken))] + [{i, j} for i in range(5) for j in range(5, i + 5)]
    for lost in gone:
        left = [pair for i, pair in enumerate(taken) if i not in lost]
        (group,) = group_frames([frame for frame, _ in left], LADDER, len(headings))
        planned = import_card.planned_frames(group, slot, setup)
        expected = [(frame.exposure, heading) for frame, heading in left]
        assert [(p.exposure, p.heading_deg) for p in planned] == expected, lost


@pytest.mark.contract
def test_frames_of_one_heading_and_exposures_beside_the_plan_keep_a_heading() -> None:
    setup, slot = CameraSetup(headings=(20.0, 200.0)), Slot(DAWN, 10.0, 120.0, LADDER)
    (one,) = group_frames(frames_at(DAWN), LADDER, 2)
    planned = import_card.planned_frames(one, slot, setup)
    assert planned == list(frame_requests(LADDER, setup))[:5]
    beside = replace(LADDER[0], iso=800.0)
    (group,) = group_frames(frames_at(DAWN, (*LADDER, *LADDER[:3], beside, *LADDER[3:])), LADDER, 2)
    planned = import_card.planned_frames(group, slot, setup)
    assert (planned[8].exposure, planned[8].heading_deg) == (beside, 200.0)


@pytest.mark.contract
def test_a_missing_frame_is_noted_with_its_heading(tmp_path: Path) -> None:
    setup = CameraSetup(headings=(20.0, 200.0))
    session = create_session(tmp_path / "s", SiteFile(SEATTLE, setup), PLAN[:1], {})
    frames = frames_at(DAWN, (*LADDER, *LADDER))
    write_card(tmp_path / "card", [*frames[:3], *frames[4:]])
    report = import_card.run(session, tmp_path / "card", utc_offset_s=0.0)
    assert "1 (1/30 f/5.6 ISO100 at heading 20)" in report.notes[0]
    note = json.loads((session.raw / PLAN[0].id / "capture.json").read_text())
    assert [f["heading_deg"] for f in note["frames"]] == [20.0] * 4 + [200.0] * 5


@pytest.mark.contract
def test_one_frame_is_not_two_exposures_with_and_without_a_filter() -> None:
    plan = [Slot(DAWN, 10.0, 120.0, (*LADDER, Exposure(1 / 125, 5.6, nd="nd3")))]
    for number, matched in ((1, 0), (2, 1)):
        group = Group(tuple(frames_at(DAWN, (LADDER[-1],) * number)))
        assert planned_indices(group, plan[0].exposures) == [4, 5][:number]
        assert len(match_groups([([group], Offset(0.0, "stated"))], plan)[0]) == matched


@pytest.mark.contract
def test_campaigns_have_clocks_of_their_own() -> None:
    june = [Slot(s.t_utc + timedelta(days=92), 10.0, 120.0, LADDER) for s in PLAN]
    parts = split_at_gaps(group_frames(card(PLAN, -8 * 3600.0) + card(june, PDT_S), LADDER))
    assert [len(p) for p in parts] == [12, 12]


# ----------------------------------------------------------------------------------------------
# files


def write_card(folder: Path, frames: list[CardFrame], zone_h: int | None = None) -> None:
    """zone_h: UTC offset that the camera writes into EXIF; none without it."""
    folder.mkdir(parents=True)
    for frame in frames:
        codes = np.full((8, 8, 3), int(frame.exposure.shutter_s * 1000) % 250, np.uint8)
        zone = None if zone_h is None else timezone(timedelta(hours=zone_h))
        shown = frame.t_camera.replace(tzinfo=zone)
        write_jpeg(
            folder / frame.path.with_suffix(".jpg").name, codes, frame.exposure, t_camera=shown
        )


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return create_session(tmp_path / "s", SiteFile(SEATTLE), PLAN, {})


@pytest.mark.slow
@pytest.mark.contract
def test_card_becomes_brackets_once(session: Session, tmp_path: Path) -> None:
    folder = tmp_path / "card" / "DCIM"
    write_card(folder, card(PLAN[:10], PDT_S, late_s=37.0))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8 no picture")
    before = {p: sha256(p) for p in folder.iterdir()}
    report = import_card.run(session, folder.parent)
    assert (report.brackets, report.frames, report.known) == (10, 50, 0)
    assert "broken.jpg" in report.left_out[0]
    assert report.offsets[0].seconds == pytest.approx(PDT_S + 37, abs=1)
    assert {p: sha256(p) for p in folder.iterdir()} == before, "the card is not touched"
    note = json.loads((session.raw / PLAN[0].id / "capture.json").read_text())
    assert note["complete"] and note["t_open_utc"].startswith("2027-03-20T14:30:0")
    assert [f["exposure"]["shutter_s"] for f in note["frames"]] == [e.shutter_s for e in LADDER]
    assert all(sha256(session.raw / PLAN[0].id / f["file"]) == f["sha256"] for f in note["frames"])
    assert [apply_events(read_journal(session)).slots[s.id].outcome for s in PLAN[:10]] == [
        "done"
    ] * 10
    again = import_card.run(session, folder.parent)
    assert (again.brackets, again.known) == (0, 10)


@pytest.mark.slow
@pytest.mark.contract
def test_a_card_told_another_clock_leaves_the_wrong_slots(session: Session, tmp_path: Path) -> None:
    """An hour off, each bracket lies in its neighbour's slot; told anew, none does,
    and nothing is lost.
    """
    write_card(tmp_path / "card", card(PLAN[2:8], PDT_S))
    wrong = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S - 3600.0)
    assert wrong.slots == tuple(slot.id for slot in PLAN[3:9])
    merged = session.panoramas / f"{PLAN[3].id}.exr"
    merged.parent.mkdir(exist_ok=True)
    merged.write_bytes(b"of the wrong hour")
    right = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S)
    assert right.moved == wrong.slots and right.slots == tuple(slot.id for slot in PLAN[2:8])
    assert sorted(p.name for p in session.raw.glob("[0-9]*Z")) == [slot.id for slot in PLAN[2:8]]
    assert len(list((session.raw / "withdrawn").iterdir())) == 6 and not merged.exists()
    states = apply_events(read_journal(session)).slots
    assert [states[slot.id].outcome for slot in PLAN[2:9]] == ["done"] * 6 + [""]
    again = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S)
    assert (again.brackets, again.known, again.moved) == (0, 6, ())


@pytest.mark.contract
def test_a_bracket_that_now_matches_no_slot_leaves_the_wrong_one(
    session: Session, tmp_path: Path
) -> None:
    """A bracket an hour before the plan lay in the first slot, and the right one was "known"."""
    early = replace(PLAN[0], t_utc=DAWN - timedelta(hours=1))
    write_card(tmp_path / "card", card([early, *PLAN[:3]], PDT_S))
    wrong = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S - 3600.0)
    assert wrong.moved == () and wrong.slots == tuple(slot.id for slot in PLAN[:4])
    right = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S)
    assert right.moved == wrong.slots and (right.brackets, right.known) == (3, 0)
    assert "no slot within 20 min (2027-03-20T13:30:00Z)" in right.left_out[0]
    for slot in PLAN[:3]:
        note = json.loads((session.raw / slot.id / "capture.json").read_text())
        assert note["frames"][0]["file"].startswith(f"{slot.t_utc + timedelta(hours=-7):%d%H%M}")
    again = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S + 30.0)
    assert (again.brackets, again.known, again.moved) == (0, 3, ()), "half a minute is no hour"


@pytest.mark.slow
@pytest.mark.contract
def test_an_offset_that_differs_from_exif_is_noted(session: Session, tmp_path: Path) -> None:
    """A stated offset applies to the clock as shown, not on top of the offset in EXIF."""
    write_card(tmp_path / "card", card(PLAN, PDT_S), zone_h=-7)
    words = ["import", str(session.root), str(tmp_path / "card")]
    hour_off = CliRunner().invoke(main, [*words, "--utc-offset", "-08:00"])
    assert hour_off.exit_code == 0
    assert (
        "note: --utc-offset -08:00 was used, but EXIF states UTC -07:00: if that is right, import "
        "without it" in hour_off.output
    )
    assert hour_off.output.count("camera clock:") == 1
    same = CliRunner().invoke(main, [*words, "--utc-offset", "-07:00"])
    assert same.exit_code == 0 and "EXIF" not in same.output
    again = CliRunner().invoke(main, words)
    assert "camera clock: UTC -07:00, stated in EXIF\n" in again.output
    assert "0 brackets with 0 frames" in again.output and "already imported: 12 brackets" in (
        again.output
    )


@pytest.mark.contract
def test_a_stated_offset_replaces_that_of_exif(session: Session, tmp_path: Path) -> None:
    write_card(tmp_path / "card", card(PLAN, PDT_S), zone_h=1)  # set in Geneva, never changed
    report = import_card.run(session, tmp_path / "card", utc_offset_s=PDT_S)
    assert report.brackets == 12 and len(report.notes) == 1
    assert "EXIF states UTC +01:00" in report.notes[0]


@pytest.mark.slow
@pytest.mark.contract
def test_one_clock_of_two_campaigns_is_printed_once(tmp_path: Path) -> None:
    june = [replace(s, t_utc=s.t_utc + timedelta(days=90)) for s in PLAN]
    session = create_session(tmp_path / "s", SiteFile(SEATTLE), [*PLAN, *june], {})
    write_card(tmp_path / "card", card([*PLAN, *june], PDT_S))
    done = CliRunner().invoke(main, ["import", str(session.root), str(tmp_path / "card")])
    assert done.exit_code == 0 and "24 brackets" in done.output
    assert done.output.count("camera clock: UTC -07:00, fitted to the plan") == 1


@pytest.mark.contract
def test_what_cannot_be_imported_is_said(session: Session, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        import_card.run(session, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no raw or JPEG"):
        import_card.run(session, tmp_path / "empty")
    write_card(tmp_path / "other", frames_at(DAWN + timedelta(days=200)))
    with pytest.raises(NotEnoughDataError, match="matches the plan"):
        import_card.run(session, tmp_path / "other", utc_offset_s=0.0)
    with pytest.raises(
        InputError,
        match=r"brackets from 2027-10-06 14:30 .* no slot of the plan.*first bracket is 2027",
    ):
        import_card.run(session, tmp_path / "other")
    write_card(tmp_path / "few", card(PLAN[3:6], 2.5 * 3600.0))  # neither UTC nor the place's
    with pytest.raises(InputError, match=r"several UTC offsets .* --utc-offset"):
        import_card.run(session, tmp_path / "few")
    assert read_journal(session) == []


@pytest.mark.contract
def test_logger_rows_are_added_once(session: Session) -> None:
    rows = [IrradianceSample(DAWN + timedelta(minutes=i), ghi_wm2=300.0 + i) for i in range(1000)]
    assert add_samples(session, rows)[0] == 1000
    earlier = IrradianceSample(DAWN - timedelta(minutes=1), ghi_wm2=1.0)
    assert add_samples(session, [*rows, earlier]) == (1, 0)
    assert sum(len(read_day(p)[0]) for p in day_files(session)) == 1001
    later = IrradianceSample(DAWN + timedelta(days=1), ghi_wm2=5.0)
    assert add_samples(session, [later, later, replace(later, ghi_wm2=6.0)])[0] == 2


@pytest.mark.contract
def test_a_toa5_file_comes_in_by_the_command(session: Session, tmp_path: Path) -> None:
    head = '"TOA5","sky","CR1000","1","OS","prog","1","Table"\n'
    head += '"TIMESTAMP","RECORD","GHI","DHI"\n"TS","RN","W/m^2","W/m^2"\n'
    rows = "".join(f'"2027-03-20 06:{30 + i}:00",{i},{300 + i}.5,60.1\n' for i in range(20))
    path = tmp_path / "sky.dat"
    path.write_text(head + '"","","Avg","Avg"\n' + rows + '"2027-03-20 06:50:00",20,"NAN')
    words = ["import", str(session.root), "--irradiance", str(path)]
    refused = CliRunner().invoke(main, words)
    assert refused.exit_code == 3 and "--logger-utc-offset +HH:MM" in refused.output
    done = CliRunner().invoke(main, [*words, "--utc-offset", "-08:00"])
    assert done.exit_code == 0 and "20 rows of irradiance" in done.output
    assert "not imported: " in done.output
    samples = read_day(day_files(session)[0])[0]
    assert samples[0].t_utc == DAWN and samples[0].ghi_wm2 == 300.5
    assert CliRunner().invoke(main, ["import", str(session.root)]).exit_code == 2
    assert CliRunner().invoke(main, [*words, "--utc-offset", "8"]).exit_code == 2
    assert CliRunner().invoke(main, ["import", str(tmp_path), str(tmp_path)]).exit_code == 3


MINUTES = [(h, m) for h in (9, 10) for m in range(60)]
TABLE = "time,Sky_W,Shade_W\n" + "".join(
    f"2027-03-20 {h:02d}:{m:02d}:00,{300 + h}.{m:02d},0\n" for h, m in MINUTES
)


def rows_of(session: Session) -> list[IrradianceSample]:
    return [sample for path in day_files(session) for sample in read_day(path)[0]]


@pytest.mark.contract
def test_a_file_told_anew_replaces_what_it_brought(session: Session, tmp_path: Path) -> None:
    """A wrong --utc-offset or column is no dead end, and takes nothing else away."""
    logged = [
        IrradianceSample(DAWN + timedelta(seconds=i), ghi_wm2=99.0, raw="S 99.0") for i in range(50)
    ]
    add_samples(session, logged)
    file = tmp_path / "sky.csv"
    file.write_text(TABLE)
    names = {"ghi_wm2": "Sky_W"}
    assert import_rows(session, file, -7 * 3600.0, names).rows == 120
    clean = session.irradiance / "clean.csv"
    clean.write_text("made of the rows before")
    again = import_rows(session, file, -8 * 3600.0, names)
    assert not clean.exists()
    assert (again.rows, again.withdrawn) == (120, 120)
    found = sorted((s.t_utc, s.ghi_wm2) for s in rows_of(session) if s.raw != "S 99.0")
    assert found[0] == (datetime(2027, 3, 20, 17, tzinfo=UTC), 309.0) and len(found) == 120
    assert [s for s in rows_of(session) if s.raw == "S 99.0"] == logged
    file.write_text(TABLE + "2027-03-20 11:00:00,400.0,0\n")
    grown = import_rows(session, file, -8 * 3600.0, {**names, "dhi_wm2": "Shade_W"})
    assert (grown.rows, grown.withdrawn) == (121, 120)
    assert len(rows_of(session)) == 171
    kept = sorted((session.irradiance / "withdrawn").iterdir())
    assert [len(read_day(path)[0]) for path in kept] == [170, 170]


@pytest.mark.analytic
def test_late_people_are_no_error_of_the_clock() -> None:
    """Brackets 8 to 18 minutes late are all near slots by civil time: UTC -06:45 is no clock's."""
    shifts = random.Random(1)
    groups = [
        Group(tuple(frames_at(slot.t_utc + timedelta(seconds=PDT_S + shifts.uniform(480, 1080)))))
        for slot in PLAN
    ]
    found = find_offset(groups, PLAN, [PDT_S, 0.0])
    assert found is not None and found.seconds == PDT_S and "UTC -06:45" in found.how
    assert refine_offset(groups, PLAN, found).seconds == PDT_S
    fast = [
        Group(
            tuple(frames_at(slot.t_utc + timedelta(seconds=PDT_S + 780 + shifts.uniform(0, 120))))
        )
        for slot in PLAN
    ]
    found = find_offset(fast, PLAN, [PDT_S, 0.0])
    assert found is not None and found.seconds == PDT_S + 900, "prompt people, a fast clock"
    slow = [Group(tuple(frames_at(slot.t_utc + timedelta(seconds=PDT_S - 900)))) for slot in PLAN]
    found = find_offset(slow, PLAN, [PDT_S, 0.0])
    assert found is not None and found.seconds == PDT_S - 900, "nobody starts early"
    timer = [Group(tuple(frames_at(slot.t_utc + timedelta(seconds=PDT_S + 900)))) for slot in PLAN]
    found = find_offset(timer, PLAN, [PDT_S, 0.0])
    assert found is not None and refine_offset(timer, PLAN, found).seconds == PDT_S + 900
    other = [Group(tuple(frames_at(slot.t_utc + timedelta(hours=2.75)))) for slot in PLAN]
    found = find_offset(other, PLAN, [PDT_S, 0.0])
    assert found is not None and found.seconds == 2.75 * 3600
    assert "no civil time of the place" in found.how


@pytest.mark.contract
@pytest.mark.parametrize(("offset_s", "is_noted"), [(-8 * 3600.0, True), (PDT_S, False)])
def test_an_offset_in_exif_that_is_no_civil_time_is_noted(offset_s: float, is_noted: bool) -> None:
    setup = SiteFile(SEATTLE)
    frames = [frame._replace(exif_offset_s=offset_s) for frame in frames_at(PLAN[0].t_utc)]
    found = clock_offset([Group(tuple(frames))], PLAN, setup, None)
    told = "stated in EXIF (civil time of the place is UTC -07:00: if the clock showed that, "
    assert found.exif_s == (offset_s,) and found.seconds == 0.0
    assert found.how.startswith(told) if is_noted else found.how == "stated in EXIF"


@pytest.mark.contract
def test_a_card_of_the_day_before_is_named(tmp_path: Path) -> None:
    plan = [replace(slot, t_utc=slot.t_utc + timedelta(days=d)) for d in (0, 1) for slot in PLAN]
    two_days = create_session(tmp_path / "two", SiteFile(SEATTLE), plan, {})
    write_card(tmp_path / "early", card(plan, PDT_S - 86400.0))
    report = import_card.run(two_days, tmp_path / "early")
    told = (
        "12 of 24 brackets are near slots; with an offset changed by -24 h it would be 24: WARNING"
    )
    assert any(told in note and 'AllDates+="0:0:1' in note for note in report.notes), report.notes


@pytest.mark.contract
def test_another_quantity_joins_the_rows_of_its_times(session: Session, tmp_path: Path) -> None:
    """Global and diffuse in two files of one logger: both count, whatever is corrected later."""

    def added(name: str, column: str, values: list[float]) -> str:
        rows = "".join(f"2027-03-20T20:{m:02d}:00Z,{v}\n" for m, v in enumerate(values))
        (tmp_path / name).write_text(f"t_utc,{column}\n{rows}")
        words = ["import", str(session.root), "--irradiance", str(tmp_path / name)]
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, done.output
        return done.output

    def joined() -> tuple[list[float], list[float], int]:
        series = series_of(rows_of(session))
        doubles = int(np.sum(series.marks & Mark.DOUBLE > 0))
        return series.ghi_wm2.tolist(), series.dhi_wm2.tolist(), doubles

    ghi, dhi = [100.0, 500.0, 520.0], [100.0, 80.0, 90.5]
    assert "3 rows of irradiance" in added("ghi.csv", "ghi_wm2", ghi)
    assert "3 rows of irradiance" in added("dhi.csv", "dhi_wm2", dhi)
    assert joined() == (ghi, dhi, 0)
    right = [130.0, 650.0, 520.0]
    refused = added("fix.csv", "ghi_wm2", right)
    assert "0 rows of irradiance" in refused and "move irradiance/DATE.csv" in refused
    assert "2 rows have times that are stored with other values" in refused
    assert joined() == (ghi, dhi, 0)
    both = [IrradianceSample(DAWN, ghi_wm2=300.0, raw="300")]
    assert add_samples(session, both) == (1, 0)
    mixed = [IrradianceSample(DAWN, ghi_wm2=390.0, dhi_wm2=60.0, raw="390,60")]
    assert add_samples(session, mixed) == (0, 1), "no global of one file with diffuse of another"
    rows = rows_of(session)
    minute = timedelta(minutes=1)  # of a wrong clock, so that only the last row has a free time
    moved = [replace(row, t_utc=row.t_utc + minute) for row in rows if row.ghi_wm2 in ghi]
    assert add_samples(session, moved)[0] == 0 and rows_of(session) == rows


@pytest.mark.contract
def test_night_rows_of_another_file_stay(session: Session, tmp_path: Path) -> None:
    dark = "time,ghi_wm2\n" + "".join(f"2027-03-20 {h:02d}:00:00,0.0\n" for h in range(10))
    (tmp_path / "roof.csv").write_text(dark)
    (tmp_path / "mast.csv").write_text(dark)
    assert import_rows(session, tmp_path / "roof.csv", 0.0).rows == 10
    other = import_rows(session, tmp_path / "mast.csv", -8 * 3600.0)
    assert (other.rows, other.withdrawn) == (8, 0)  # two hours are there already


@pytest.mark.contract
def test_unusual_columns_are_named_by_the_command(session: Session, tmp_path: Path) -> None:
    (tmp_path / "sky.csv").write_text(TABLE)
    asked = [
        "import",
        str(session.root),
        "--irradiance",
        str(tmp_path / "sky.csv"),
        "--utc-offset",
        "-08:00",
    ]
    without = CliRunner().invoke(main, asked)
    assert without.exit_code == 3 and "choose it: --column ghi_wm2=NAME" in without.stderr
    assert CliRunner().invoke(main, [*asked, "--column", "sky=Sky_W"]).exit_code == 2
    named = CliRunner().invoke(
        main, [*asked, "--column", "ghi_wm2=Sky_W", "--column", "dhi_wm2=Shade_W"]
    )
    assert named.exit_code == 0 and "120 rows" in named.output
    assert {s.dhi_wm2 for s in rows_of(session)} == {0.0}


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("ghi", "minutes", "is_refused"),
    [(12, 30, True), (12, 5, False), (0, 30, False), (-0.3, 30, False), (45, 30, False)],
)
def test_a_voltage_is_not_taken_for_irradiance(
    session: Session, tmp_path: Path, ghi: float, minutes: int, is_refused: bool
) -> None:
    """In mV, by 20 uV per W/m2: 600 W/m2 are 12 mV, less than a storm transmits (5 %: 45 W/m2).

    Zero is a dead instrument, which `pair` names.
    """
    night = "2027-03-20T08:00:00Z,65,0"  # a spike
    rows = [f"2027-03-20T20:{m:02d}:00Z,{ghi},700" for m in range(minutes)]  # the sun at 42 degrees
    (tmp_path / "a.csv").write_text("\n".join(["t_utc,ghi_wm2,dni_wm2", night, *rows, ""]))
    words = ["import", str(session.root), "--irradiance", str(tmp_path / "a.csv")]
    done = CliRunner().invoke(main, words)
    assert (done.exit_code == 3) == is_refused, done.output
    if is_refused:
        assert "ghi_wm2 is 1.29% of the sun's irradiance above the atmosphere" in done.stderr
        assert "and state --sensitivity" in done.stderr and not rows_of(session)
        renamed = (tmp_path / "a.csv").read_text().replace("ghi_wm2", "ghi_mV")
        (tmp_path / "a.csv").write_text(renamed)
        words += ["--column", "ghi_wm2=ghi_mV", "--sensitivity", "ghi_wm2=20"]
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, done.output
        assert max(s.ghi_wm2 or 0.0 for s in rows_of(session) if s.dni_wm2) == 600.0
