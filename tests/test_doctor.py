"""Preflight: every check's good and bad case, and the exit codes."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum.capture import doctor
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.devices import CameraInfo, InstrumentInfo
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    NeutralDensity,
    Scale,
    load_camera_profile,
    save_profile,
)
from fieldlum.session import Journal, Session, create_session, write_plan

NOW = datetime(2027, 3, 10, 12, tzinfo=UTC)
NOON = datetime(2027, 3, 10, 20, tzinfo=UTC)


def _profile(folder: Path, **changed: object) -> str:
    path = folder / "camera.toml"
    body = CameraBody("cam", "raw", 9, 9, date="2027-01-01")
    base = {
        "camera": body,
        "lens": (Lens((4.0, 4.0), 4.0, 180.0),),
        "bracket": Bracket(5.6, 100.0, (0.5, 0.01)),
    }
    save_profile(path, CameraProfile(**(base | changed)))  # type: ignore[arg-type]
    return str(path)


def _session(
    folder: Path, tags: tuple[str, ...] = (), megabytes: float = 50.0, **changed: object
) -> Session:
    setup = SiteFile(SEATTLE, CameraSetup(profile=_profile(folder, **changed)))
    exposures = (Exposure(0.5, 5.6), Exposure(0.01, 5.6))
    slots = [
        Slot(NOW + timedelta(hours=7.5, days=d), 30.0, 180.0, exposures, tags) for d in range(10)
    ]
    return create_session(folder / "s", setup, slots, {"megabytes_per_slot": megabytes})


def every(check: Callable[..., Iterable[doctor.Finding]], *asked: Any) -> list[doctor.Finding]:
    return list(check(*asked))


def _verdicts(findings: list[doctor.Finding]) -> dict[str, str]:
    return {finding.what: finding.verdict for finding in findings}


@pytest.mark.slow
@pytest.mark.contract
def test_a_sound_session_passes(tmp_path: Path) -> None:
    found = doctor.run(_session(tmp_path), "", "", NOW)
    assert doctor.exit_code(found) == 0
    assert (
        _verdicts(found)["plan"] == _verdicts(found)["disk"] == _verdicts(found)["writing"] == "ok"
    )
    assert not list((tmp_path / "s").glob(".doctor*"))


@pytest.mark.contract
@pytest.mark.filterwarnings("ignore::fieldlum.core.errors.ChangedFileWarning")
def test_a_changed_plan_fails(tmp_path: Path) -> None:
    session = _session(tmp_path)
    session.plan.write_text(session.plan.read_text().replace("0.5 f/5.6", "1 f/5.6"))
    found = doctor.run(session, "", "", NOW)
    assert doctor.exit_code(found) == 3 and _verdicts(found[:1]) == {"plan": "fail"}


@pytest.mark.contract
def test_done_slots_are_not_owed(tmp_path: Path) -> None:
    session = _session(tmp_path)
    journal = Journal(session)
    journal.append("done", NOW, slot=session.slots()[0].id)
    journal.close()
    assert len(doctor.slots_ahead(session, NOW)) == 9
    assert every(doctor.check_plan, session, NOW + timedelta(days=40))[0].verdict == "warn"


@pytest.mark.contract
@pytest.mark.filterwarnings("ignore::fieldlum.core.errors.ChangedFileWarning")
def test_make_up_slots_are_advised_only_for_what_was_not_captured(tmp_path: Path) -> None:
    session = _session(tmp_path)
    slots = session.slots()
    instead = replace(slots[1], t_utc=NOW + timedelta(days=30), tags=(f"makeup:{slots[1].id}",))
    write_plan(session.plan, [*slots, instead], SEATTLE.timezone)
    journal = Journal(session)
    for slot in slots[2:]:
        journal.append("done", NOW, slot=slot.id)
    missed = every(doctor.check_plan, session, NOW + timedelta(days=40))[-1]
    assert "2 of 10 were not captured" in missed.text and "--replan" in missed.text
    for slot in (slots[0], instead):
        journal.append("done", NOW, slot=slot.id)
    journal.close()
    complete = every(doctor.check_plan, session, NOW + timedelta(days=40))[-1]
    assert complete.verdict == "warn" and "--replan" not in complete.text


@pytest.mark.contract
@pytest.mark.parametrize(
    ("changed", "verdict", "said"),
    [
        ({"expires": "2027-03-01"}, "fail", "expired"),
        ({"expires": "2028-03-01"}, "ok", "calibrated"),
        ({"camera": CameraBody("cam", "raw", 9, 9, date="2020-01-01")}, "warn", "years ago"),
        ({"scale": Scale(1.0, f_numbers=(8.0,))}, "fail", "no scale k for f/5.6"),
        ({"expires": "soon"}, "fail", "date 'soon'"),
    ],
)
def test_profiles(tmp_path: Path, changed: dict, verdict: str, said: str) -> None:
    found = [
        f for f in doctor.run(_session(tmp_path, **changed), "", "", NOW) if f.what == "profile"
    ]
    assert any(f.verdict == verdict and said in f.text for f in found)


@pytest.mark.contract
def test_disk_counts_what_is_owed(tmp_path: Path) -> None:
    session = _session(tmp_path, megabytes=100.0)
    assert doctor.check_disk(session, NOW, 1_301_000_000).verdict == "ok"
    assert doctor.check_disk(session, NOW, 1_299_000_000).verdict == "fail"


@pytest.mark.contract
@pytest.mark.parametrize(
    ("info", "verdicts"),
    [
        (
            CameraInfo("x", clock_offset_s=1.0, frames_left=500),
            {"camera clock": "ok", "camera card": "ok"},
        ),
        (
            CameraInfo("x", clock_offset_s=-30.0, frames_left=5),
            {"camera clock": "warn", "camera card": "warn"},
        ),
        (CameraInfo("x", clock_offset_s=3600.0), {"camera clock": "fail"}),
        (CameraInfo("x"), {"camera clock": "warn"}),
    ],
)
def test_camera(info: CameraInfo, verdicts: dict[str, str]) -> None:
    findings = every(doctor.judge_camera, info, "x:", 20)
    assert _verdicts(findings) == {"camera": "ok", **verdicts}
    assert all("larger card" not in f.text for f in findings if f.verdict == "ok")


@pytest.mark.contract
def test_what_the_camera_does_not_offer_is_told_before_anybody_leaves() -> None:
    found = every(
        doctor.judge_exposures, [f"camera shutter: {i} s is not offered" for i in range(5)], 10
    )
    assert [f.verdict for f in found] == ["fail"] and found[0].text.startswith(
        "the camera cannot set some of the 10 planned exposures"
    )
    assert "plan a new session (fieldlum plan SITE.toml --out NEW)" in found[0].text
    assert "camera shutter: 2 s is not offered" in found[0].text and not every(
        doctor.judge_exposures, [], 10
    )


@pytest.mark.contract
def test_another_camera_than_the_profiles_is_told() -> None:
    profile = load_camera_profile("sim-dual-fisheye")
    told = every(doctor.judge_model, CameraInfo("gphoto", model="D750"), profile)
    assert [f.verdict for f in told] == ["warn"] and "D750 is not the camera of profile" in told[
        0
    ].text
    for info in (
        CameraInfo("sim", model="D750"),
        CameraInfo("gphoto"),
        CameraInfo("gphoto", model=profile.camera.model),
    ):
        assert not every(doctor.judge_model, info, profile)


@pytest.mark.contract
def test_disk_goes_by_what_the_camera_really_writes(tmp_path: Path) -> None:
    session = _session(tmp_path, megabytes=0.001)
    assert doctor.check_disk(session, NOW, 2_000_000).verdict == "ok"
    folder = session.raw / "20270301T120000Z"
    folder.mkdir(parents=True)
    (folder / "00_1s.nef").write_bytes(b"\0" * 1_000_000)
    assert doctor.check_disk(session, NOW, 2_000_000).verdict == "ok"  # not a whole bracket yet
    (folder / "capture.json").write_text("{}")
    assert doctor.check_disk(session, NOW, 2_000_000).verdict == "fail"


@pytest.mark.contract
def test_pyranometer_readings() -> None:
    spn1 = InstrumentInfo("spn1", "SPN1", "A1", calibration_date="2026-06-01", gives=("ghi", "dhi"))
    good = every(
        doctor.judge_pyranometer, spn1, IrradianceSample(NOON, ghi_wm2=500.0, dhi_wm2=80.0), SEATTLE
    )
    assert [f.verdict for f in good] == ["ok"]
    night = every(
        doctor.judge_pyranometer,
        spn1,
        IrradianceSample(NOON + timedelta(hours=12), ghi_wm2=500.0),
        SEATTLE,
    )
    assert "fail" in [f.verdict for f in night]
    wrong = InstrumentInfo("ascii", "rig", calibration_date="2022")
    with pytest.raises(InputError, match="profile of the pyranometer rig: date '2022'"):
        every(doctor.judge_pyranometer, wrong, IrradianceSample(NOON, ghi_wm2=500.0), SEATTLE)
    old = InstrumentInfo("smp", calibration_date="2022-01-01")
    said = " ".join(
        f.text
        for f in every(
            doctor.judge_pyranometer,
            old,
            IrradianceSample(NOON, ghi_wm2=500.0, status="9"),
            SEATTLE,
        )
    )
    assert "reports a fault" in said and "only global" in said and "years ago" in said
    rig = InstrumentInfo("ascii", gives=("ghi", "dhi"), is_checked=False)
    told = every(
        doctor.judge_pyranometer, rig, IrradianceSample(NOON, ghi_wm2=500.0, dhi_wm2=80.0), SEATTLE
    )
    assert [f.verdict for f in told] == [
        "ok",
        "warn",
    ] and "let the instrument's program print a CRC-16" in told[1].text


@pytest.mark.contract
def test_what_does_not_keep_a_computer_awake() -> None:
    assert doctor.check_sleep("sleep:idle").verdict == "ok"
    assert doctor.check_sleep("sleep:idle:handle-lid-switch", lid=True).verdict == "ok"
    shut = doctor.check_sleep("sleep:idle", lid=True)
    assert shut.verdict == "warn" and "a closed lid" in shut.text
    assert doctor.check_sleep("").verdict == doctor.check_sleep("idle").verdict == "warn"


@pytest.mark.contract
def test_this_computer_answers_or_is_not_asked() -> None:
    assert [doctor.check_clock(state).verdict for state in (True, False, None)] == [
        "ok",
        "warn",
        "warn",
    ]
    assert doctor.synchronised() in (True, False, None)


@pytest.mark.contract
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="Not a directory"):
        every(doctor.check_writing, tmp_path / "file")
    for name, verdicts in (("Dropbox", ["ok", "warn"]), ("month", ["ok"])):
        (tmp_path / name).mkdir()
        found = every(doctor.check_writing, tmp_path / name)
        assert [finding.verdict for finding in found] == verdicts


@pytest.mark.contract
def test_sun_in_view_without_a_filter(tmp_path: Path) -> None:
    """Also with a planned filter it is a warning: a person must move the filter."""
    session = _session(tmp_path, ("sun-in-view",))
    finding = every(doctor.check_sun, session, NOW)[-1]
    assert finding.verdict == "warn" and "computed from DNI" in finding.text


@pytest.mark.contract
def test_a_plan_of_an_earlier_version_with_filter_frames_is_asked_for_them(tmp_path: Path) -> None:
    """plan.csv states the filter; session.toml of that version does not."""
    exposures = (Exposure(0.5, 5.6), Exposure(0.01, 5.6, nd="nd3"))
    slot = Slot(NOW + timedelta(hours=7.5), 30.0, 180.0, exposures)
    setup = SiteFile(SEATTLE, CameraSetup(profile=_profile(tmp_path)))
    session = create_session(tmp_path / "s", setup, [slot], {})
    assert session.slots()[0].exposures == exposures and not session.site_file().camera.filter
    finding = every(doctor.check_sun, session, NOW)[-1]
    assert "through the filter nd3: a person must put it on" in finding.text


@pytest.mark.contract
@pytest.mark.parametrize(("kind", "count"), [("sim", 0), ("gphoto", 1)])
def test_several_headings_name_who_turns_the_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, count: int
) -> None:
    """No driver turns a camera: with one that refuses, all brackets would abort."""
    slot = Slot(NOW + timedelta(hours=7.5), 30.0, 180.0, (Exposure(0.5, 5.6),), ())
    camera = CameraSetup(profile=_profile(tmp_path), headings=(0.0, 180.0))
    session = create_session(tmp_path / "s", SiteFile(SEATTLE, camera), [slot], {})
    findings = every(doctor.check_profile, session, NOW.date())
    (turning,) = [finding for finding in findings if finding.what == "headings"]
    assert turning.verdict == "warn"
    assert "headings 0, 180 deg" in turning.text and "a person turns it" in turning.text

    device = Mock(info=CameraInfo(kind))
    monkeypatch.setattr("fieldlum.devices.open_camera", lambda *_, **__: device)
    verdicts = [f for f in every(doctor.check_camera, session, "x:", NOW) if f.verdict == "fail"]
    assert ["each bracket would abort" in f.text for f in verdicts] == [True] * count


@pytest.mark.contract
def test_an_unknown_filter_is_a_bad_profile(tmp_path: Path) -> None:
    profile = CameraProfile(
        CameraBody("cam", "raw", 9, 9, date="2026-06-01"),
        (Lens((4.0, 4.0), 4.0, 180.0),),
        Bracket(5.6, 100.0, (0.5,)),
        nd=(NeutralDensity("nd3", (1000.0, 1000.0, 1000.0)),),
    )
    slot = Slot(NOW, 30.0, 180.0, (Exposure(0.5, 5.6, nd="nd4"), Exposure(0.5, 5.6, nd="nd3")))
    assert ["nd4" in f.text for f in every(doctor.judge_calibration, profile, [slot])] == [True]
    assert doctor.judge_age(profile, date(2027, 1, 1)).verdict == "ok"
    never = replace(profile, camera=replace(profile.camera, date=""))
    assert doctor.judge_age(never, date(2027, 1, 1)).verdict == "warn"


@pytest.mark.contract
def test_a_meter_is_asked_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    class Meter:
        info = InstrumentInfo("cl200a", "CL-200A", "10001")

        def read(self) -> float:
            return 1234.0

        def close(self) -> None: ...

    monkeypatch.setattr("fieldlum.devices.open_meter", lambda uri, clock: Meter())
    found = every(doctor.check_meter, "cl200a:/dev/ttyUSB1")
    assert [(f.verdict, f.text) for f in found] == [("ok", "CL-200A 10001 answers: 1234 lx")]
    assert every(doctor.check_meter, "") == []


@pytest.mark.slow
@pytest.mark.contract
def test_exit_codes(tmp_path: Path) -> None:
    session = _session(tmp_path)
    words = ["doctor", str(session.root)]
    good = CliRunner().invoke(main, [*words, "--json"])
    assert good.exit_code == 0 and json.loads(good.stdout)["ok"] is True
    bad = CliRunner().invoke(main, [*words, "--camera", "nonsense:"])
    assert bad.exit_code == 4 and "\nFAIL  camera " in bad.stdout
    coloured = CliRunner().invoke(main, [*words, "--camera", "nonsense:"], color=True)
    assert "\n\x1b[31mFAIL\x1b[0m  camera " in coloured.stdout
    assert CliRunner().invoke(main, ["doctor", str(tmp_path / "absent")]).exit_code == 3
