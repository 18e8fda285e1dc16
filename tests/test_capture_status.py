"""Capture: status, the live display, and the commands' exit codes."""

from __future__ import annotations

import json
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from click.testing import CliRunner
from tiny_field import Field

from fieldlum.cli import main, terminal
from fieldlum.core.records import utc_text
from fieldlum.optics.profiles import find_camera_profile
from fieldlum.report.assessor import _instruments
from fieldlum.session import Journal, day_files, marks, read_day, sha256
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.year.stage_status import stage_status

BEFORE = datetime(2027, 3, 1, tzinfo=UTC)  # the slots are on 20 March


@pytest.mark.contract
def test_status_counts_from_files_alone(rig: Field) -> None:
    before = stage_status(rig.session, BEFORE)
    assert before["capture"]["owed"] == 3 and before["capture"]["next"] == "20270320T153000Z"
    rig.run()
    after = stage_status(rig.session)
    assert (after["capture"]["done"], after["capture"]["frames"], after["merge"]["owed"]) == (
        3,
        9,
        3,
    )
    assert after["irradiance"]["rows"] == sum(len(read_day(p)[0]) for p in day_files(rig.session))


@pytest.mark.contract
def test_a_slot_before_a_captured_one_is_missed(rig: Field) -> None:
    """Lost slots of a past campaign were "to do", and one of them the next."""
    rig.run()
    slots = rig.session.slots()
    lines = rig.session.journal.read_text().splitlines(keepends=True)
    rest = [line for line in lines if slots[1].id not in line]
    rig.session.journal.write_text("".join(rest))
    capture = stage_status(rig.session, BEFORE)["capture"]
    assert (capture["done"], capture["missed"], capture["owed"]) == (2, 1, 0)
    assert capture["next"] is None
    rig.session.journal.write_text("")
    late = slots[1].t_utc + rig.session.grace + timedelta(seconds=1)
    capture = stage_status(rig.session, late)["capture"]
    assert (capture["missed"], capture["owed"], capture["next"]) == (2, 1, slots[2].id)


@pytest.mark.contract
def test_a_bracket_that_is_being_taken_is_not_to_be_merged(rig: Field) -> None:
    def stop(count: int) -> None:
        if count == 2:
            raise KeyboardInterrupt

    rig.camera_fault = stop
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    answer = stage_status(rig.session)
    assert (answer["capture"]["frames"], answer["merge"]["owed"]) == (1, 0)
    assert answer["next_step"] == f"fieldlum capture {rig.session.root}"


@pytest.mark.contract
def test_pairs_of_a_simulated_truth_are_no_pairs_of_panoramas(rig: Field) -> None:
    """Otherwise a merged slot would count as paired, and status would not ask for `pair`."""
    slot = rig.session.slots()[0].id
    row = f"2027-03-20T15:30:00Z,truth/{slot}.exr,500,100"
    rig.session.pairs.write_text(f"t_utc,panorama,dni_wm2,dhi_wm2\n{row}\n", encoding="utf-8")
    rig.session.panoramas.mkdir(exist_ok=True)
    rig.session.panorama(slot).write_bytes(b"")
    answer = stage_status(rig.session)["pair"]
    assert answer == {"done": 0, "usable": 1, "owed": 1}


@pytest.mark.contract
def test_panoramas_of_another_profile_are_to_be_merged_and_named(rig: Field) -> None:
    """`merge` writes them again, and the assessor's page shows the profile as it is now."""
    rig.run()
    session = rig.session
    now = sha256(find_camera_profile(session.site_file().camera.profile))
    slots = [slot.id for slot in session.slots()]
    session.panoramas.mkdir()
    for slot, of_profile in zip(slots, (now, "0" * 64, ""), strict=True):  # "": not recorded
        session.panorama(slot).write_bytes(b"")
        profile = {"name": "early", "sha256": of_profile} if of_profile else {}
        Sidecar(slot, profile=profile).write(session.sidecar(slot))
    answer = stage_status(session)
    assert answer["merge"] == {"done": 2, "owed": 1}
    assert answer["next_step"] == f"fieldlum merge {session.root}"
    rows = dict(_instruments(session, session.site_file()).rows)
    told = f"1 panorama of profile early, sha256 {'0' * 64}, so the profile above is not that of"
    assert rows["profile, sha256"] == now and rows["results"].startswith(told)
    Sidecar(slots[1], profile={"name": "now", "sha256": now}).write(session.sidecar(slots[1]))
    assert stage_status(session)["merge"] == {"done": 3, "owed": 0}
    assert "results" not in dict(_instruments(session, session.site_file()).rows)


@pytest.mark.contract
def test_commands_exit_as_documented(rig: Field, tmp_path: Path) -> None:
    from click.testing import CliRunner

    from fieldlum.cli import main

    def code(*words: str) -> int:
        return CliRunner().invoke(main, [*words]).exit_code

    folder = str(rig.session.root)
    assert code("capture", folder) == 2, "no camera named, and none remembered"
    assert code("capture", folder, "--camera", "sim:nowhere", "--clock", "fast") == 4
    assert code("capture", str(tmp_path), "--camera", "sim:office") == 3
    assert code("capture", folder, "--camera", "gphoto:", "--clock", "fast") == 2, (
        "made-up times for real pictures"
    )
    assert (
        code(
            "capture", folder, "--camera", "sim:office", "--meter", "cl200a:COM3", "--clock", "fast"
        )
        == 2
    )
    assert code("log", folder, "--pyranometer", "serial:/dev/no-such-port?kind=spn1") == 4
    assert code("status", str(tmp_path)) == 3
    assert code("pair", folder) == 5, "nothing was logged"
    told = CliRunner().invoke(main, ["status", folder, "--json"])
    assert told.exit_code == 0 and json.loads(told.stdout)["capture"]["owed"] == 3
    shown = CliRunner().invoke(main, ["status", folder]).stdout
    assert "0 done, 0 missed, 0 aborted, 3 to do" in shown


@pytest.mark.contract
def test_live_display(rig: Field, tmp_path: Path) -> None:
    from rich.console import Console

    from fieldlum.cli.capture_command import panel

    rig.run()
    console = Console(record=True, width=66, file=__import__("io").StringIO())
    console.print(panel(rig.shown[0], rig.session.site_file().site))
    text = console.export_text()
    assert "1 done" in text and "2 left" in text and "W/m²" in text and "PDT" in text


@pytest.mark.contract
def test_simulated_time_has_an_estimate_of_the_real_time(
    rig: Field, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from fieldlum.cli.capture_command import simulated

    rig.run()
    now = iter([0.0, 60.0, 121.0])
    monkeypatch.setattr(terminal.time, "monotonic", now.__next__)
    with simulated() as show:
        for live in rig.shown[:2]:
            show(live)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "capture: 1 of 3 (1 done, 0 missed, 0 aborted, 2 left)",
        "capture: 2 of 3, about 1.0 min left",
    ]


@pytest.mark.contract
def test_a_slot_before_a_captured_one_is_no_next_step(rig: Field) -> None:
    """A card without the bracket of one slot: nobody can capture it any more."""
    rig.run()
    slots = rig.session.slots()
    rig.session.panoramas.mkdir(exist_ok=True)
    for slot in slots:
        rig.session.panorama(slot.id).write_bytes(b"")
    rows = [f"{utc_text(s.t_utc)},panoramas/{s.id}.exr,500,100" for s in slots]
    rig.session.pairs.write_text("\n".join(["t_utc,panorama,dni_wm2,dhi_wm2", *rows]), "utf-8")
    for withdrawn, step in ((slots[0], "train"), (slots[-1], "capture")):
        with closing(Journal(rig.session)) as journal:
            journal.append("withdrawn", withdrawn.t_utc, slot=withdrawn.id)
        assert stage_status(rig.session)["next_step"].startswith(
            f"fieldlum {step} {rig.session.root}"
        )


@pytest.mark.contract
def test_a_date_marks_all_captured_slots_of_the_local_day(rig: Field) -> None:
    rig.run()
    slots, zone = rig.session.slots(), ZoneInfo(rig.session.site_file().site.timezone)
    dates = {slot.id: str(slot.t_utc.astimezone(zone).date()) for slot in slots}
    day = dates[slots[0].id]
    same = {slot for slot, date in dates.items() if date == day}
    arguments = ["status", str(rig.session.root), "--mark"]
    shown = CliRunner().invoke(main, [*arguments, day, "blind=down"])
    assert shown.exit_code == 0, shown.output
    assert marks(rig.session) == dict.fromkeys(same, "blind=down")
    refused = CliRunner().invoke(main, [*arguments, "2027-01-01", "blind=down"])
    assert refused.exit_code == 3 and "or the date of captured slots" in refused.output
