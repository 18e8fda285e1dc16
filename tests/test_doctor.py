"""Preflight: every check's good and bad case, and the exit codes."""

import json
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldlum import doctor
from fieldlum.cli import main
from fieldlum.devices import CameraInfo, InstrumentInfo
from fieldlum.profiles import Bracket, CameraBody, CameraProfile, Lens, NeutralDensity, Scale, save_profile
from fieldlum.records import CameraSetup, Exposure, IrradianceSample, Site, SiteFile, Slot
from fieldlum.session import Journal, Session, create_session

SEATTLE = Site("Seattle", 47.6, -122.3, "America/Los_Angeles")
NOW = datetime(2027, 3, 10, 12, tzinfo=UTC)
NOON = datetime(2027, 3, 10, 20, tzinfo=UTC)


def _profile(folder: Path, **changed: object) -> str:
    path = folder / "camera.toml"
    body = CameraBody("cam", "raw", 9, 9, date="2027-01-01")
    base = {"camera": body, "lens": (Lens((4.0, 4.0), 4.0, 180.0),), "bracket": Bracket(5.6, 100.0, (0.5, 0.01))}
    save_profile(path, CameraProfile(**(base | changed)))  # type: ignore[arg-type]
    return str(path)


def _session(folder: Path, tags: tuple[str, ...] = (), megabytes: float = 50.0, **changed: object) -> Session:
    setup = SiteFile(SEATTLE, CameraSetup(profile=_profile(folder, **changed)))
    exposures = (Exposure(0.5, 5.6), Exposure(0.01, 5.6))
    slots = [Slot(NOW + timedelta(hours=7.5, days=d), 30.0, 180.0, exposures, tags) for d in range(10)]
    return create_session(folder / "s", setup, slots, {"megabytes_per_slot": megabytes})


def _verdicts(findings: list[doctor.Finding]) -> dict[str, str]:
    return {finding.what: finding.verdict for finding in findings}


def test_a_sound_session_passes(tmp_path: Path) -> None:
    found = doctor.run(_session(tmp_path), "", "", NOW)
    assert doctor.exit_code(found) == 0
    assert _verdicts(found)["plan"] == _verdicts(found)["disk"] == _verdicts(found)["writing"] == "ok"
    assert any("forward 1 h on 2027-03-14" in finding.text for finding in found)
    assert not list((tmp_path / "s").glob(".doctor*"))


def test_a_changed_plan_fails(tmp_path: Path) -> None:
    session = _session(tmp_path)
    session.plan.write_text(session.plan.read_text().replace("0.5 f/5.6", "1 f/5.6"))
    found = doctor.run(session, "", "", NOW)
    assert doctor.exit_code(found) == 3 and _verdicts(found[:1]) == {"plan": "fail"}


def test_done_slots_are_not_owed(tmp_path: Path) -> None:
    session = _session(tmp_path)
    journal = Journal(session)
    journal.append("done", NOW, slot=session.slots()[0].id)
    journal.close()
    assert len(doctor.owed_slots(session, NOW)) == 9
    assert doctor.check_plan(session, NOW + timedelta(days=40))[0].verdict == "warn"


@pytest.mark.parametrize(
    ("changed", "verdict", "said"),
    [
        ({"expires": "2027-03-01"}, "fail", "expired"),
        ({"expires": "2028-03-01"}, "ok", "calibrated"),
        ({"camera": CameraBody("cam", "raw", 9, 9, date="2020-01-01")}, "warn", "years ago"),
        ({"scale": Scale(1.0, f_numbers=(8.0,))}, "fail", "no scale for f/5.6"),
        ({"expires": "soon"}, "fail", "date 'soon'"),
    ],
)
def test_profiles(tmp_path: Path, changed: dict, verdict: str, said: str) -> None:
    found = [f for f in doctor.run(_session(tmp_path, **changed), "", "", NOW) if f.what == "profile"]
    assert any(f.verdict == verdict and said in f.text for f in found)


def test_disk_counts_what_is_owed(tmp_path: Path) -> None:
    session = _session(tmp_path, megabytes=100.0)
    assert doctor.check_disk(session, NOW, 1_301_000_000).verdict == "ok"
    assert doctor.check_disk(session, NOW, 1_299_000_000).verdict == "fail"


@pytest.mark.parametrize(
    ("info", "verdicts"),
    [
        (CameraInfo("x", clock_offset_s=1.0, frames_left=500), {"camera clock": "ok", "camera card": "ok"}),
        (CameraInfo("x", clock_offset_s=-30.0, frames_left=5), {"camera clock": "warn", "camera card": "warn"}),
        (CameraInfo("x", clock_offset_s=3600.0), {"camera clock": "fail"}),
        (CameraInfo("x"), {"camera clock": "warn"}),
    ],
)
def test_camera(info: CameraInfo, verdicts: dict[str, str]) -> None:
    assert _verdicts(doctor.judge_camera(info, "x:", 20)) == {"camera": "ok", **verdicts}


def test_pyranometer_readings() -> None:
    spn1 = InstrumentInfo("spn1", "SPN1", "A1", calibration_date="2026-06-01", gives=("ghi", "dhi"))
    good = doctor.judge_pyranometer(spn1, IrradianceSample(NOON, 500.0, 80.0), SEATTLE)
    assert [f.verdict for f in good] == ["ok"]
    night = doctor.judge_pyranometer(spn1, IrradianceSample(NOON + timedelta(hours=12), 500.0), SEATTLE)
    assert "fail" in [f.verdict for f in night]
    old = InstrumentInfo("smp", calibration_date="2022-01-01")
    said = " ".join(f.text for f in doctor.judge_pyranometer(old, IrradianceSample(NOON, 500.0, status="9"), SEATTLE))
    assert "status" in said and "global only" in said and "years ago" in said


def test_sleep_and_clock() -> None:
    assert doctor.check_sleep(None).verdict == "warn"
    held = "fieldlum 1000 me 4242 fieldlum sleep:idle capture block\n"
    assert doctor.check_sleep(held).verdict == "ok"
    assert doctor.check_sleep("NetworkManager 0 root 1 nm sleep x delay\n").verdict == "warn"
    assert [doctor.check_clock(state).verdict for state in (True, False, None)] == ["ok", "warn", "warn"]
    assert doctor.kernel_clock() in (True, False, None)


def test_a_read_only_or_cloud_folder(tmp_path: Path) -> None:
    assert doctor.check_writing(tmp_path / "absent")[0].verdict == "fail"
    cloud = tmp_path / "Dropbox"
    cloud.mkdir()
    assert doctor.check_writing(cloud)[-1].verdict == "warn"


def test_sun_in_view_without_a_filter(tmp_path: Path) -> None:
    session = _session(tmp_path, ("sun-in-view",))
    assert doctor.check_calendar(session, NOW)[-1].verdict == "warn"


def test_an_unknown_filter_is_a_bad_profile(tmp_path: Path) -> None:
    profile = CameraProfile(
        CameraBody("cam", "raw", 9, 9), (Lens((4.0, 4.0), 4.0, 180.0),), Bracket(5.6, 100.0, (0.5,)),
        nd=(NeutralDensity("nd3", (1000.0, 1000.0, 1000.0)),),
    )  # fmt: skip
    slot = Slot(NOW, 30.0, 180.0, (Exposure(0.5, 5.6, nd="nd4"), Exposure(0.5, 5.6, nd="nd3")))
    assert ["nd4" in f.text for f in doctor._fit(profile, [slot])] == [True]
    assert doctor._age(profile, date(2027, 1, 1)).verdict == "ok"


def test_contract_exit_codes(tmp_path: Path) -> None:
    session = _session(tmp_path)
    words = ["doctor", str(session.root)]
    good = CliRunner().invoke(main, [*words, "--json"])
    assert good.exit_code == 0 and json.loads(good.stdout)["ok"] is True
    bad = CliRunner().invoke(main, [*words, "--camera", "nonsense:"])
    assert bad.exit_code == 4 and "FAIL" in bad.stdout
    assert CliRunner().invoke(main, ["doctor", str(tmp_path / "absent")]).exit_code == 3
