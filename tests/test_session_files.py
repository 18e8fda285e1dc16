"""Files that cross from stage to stage: round trips, strict reading, grace and model class."""

from __future__ import annotations

import io
import json
import math
import zipfile
from contextlib import closing
from dataclasses import fields, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import SEATTLE

from fieldlum.capture import doctor, prepare
from fieldlum.core.errors import InputError
from fieldlum.core.files import cut_torn_tail
from fieldlum.core.records import Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.plan import makeup
from fieldlum.session import (
    DAY_COLUMNS,
    DayFiles,
    Session,
    create_session,
    sha256,
    update_session,
)
from fieldlum.session.codec import NPZ_ERRORS, open_arrays, read_arrays
from fieldlum.session.files.capture_json import CaptureFile, Frame
from fieldlum.session.files.hourly_csv import HOUR_COLUMNS, VIEW_COLUMNS, HourlyFile
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.model_files import MAX_MAPS, HeldOutMaps, ModelConfig, ScoresFile
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import MergeReport, Sidecar
from fieldlum.session.folder import store_grace
from fieldlum.session.panorama_sun import SunRow, read_suns, write_suns
from fieldlum.year.stage_status import stage_status

NOON = datetime(2027, 12, 21, 20, 0, tzinfo=UTC)
SLOT = Slot(NOON, 18.0, 180.0, (Exposure(0.01, 5.6),))


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return create_session(tmp_path / "s", SiteFile(SEATTLE), [SLOT], {"set": "test"})


@pytest.mark.contract
def test_status_names_each_model_whatever_its_config(session: Session) -> None:
    for name, text in (("a", '{"model": "transport"}'), ("b", "{}"), ("c", "nothing")):
        (session.models / name).mkdir(parents=True)
        (session.models / name / "config.json").write_text(text)
    assert stage_status(session)["train"]["models"] == ["a", "b", "c"]


@pytest.mark.contract
def test_the_grace_of_a_capture_is_known_to_doctor_and_replanning(session: Session) -> None:
    late = NOON + timedelta(minutes=8)
    assert doctor.slots_ahead(session, late) == []
    assert makeup.run(session, late)["missed"] == 1
    session.plan.write_bytes((session.root / "plan.0.csv").read_bytes())
    update_session(session, {"plan": {**session.table()["plan"], "sha256": sha256(session.plan)}})
    store_grace(session, 900.0)
    assert [slot.id for slot in doctor.slots_ahead(session, late)] == [SLOT.id]
    assert prepare(session, fast=False)[1].grace_s == 900.0
    assert session.table()["plan"], "the other tables stay"


@pytest.mark.contract
def test_capture_json_comes_back_equal(tmp_path: Path) -> None:
    frames = tuple(
        Frame(k, f"{k}.dng", Exposure(0.1 / 2**k, 5.6, 100.0, "nd3"), None, NOON, 0.5, "ab")
        for k in range(2)
    )
    closed = NOON + timedelta(seconds=21)
    capture = CaptureFile(SLOT.id, frames, NOON, closed, False, "sim", 180.0, {"kind": "sim"}, 9.0)
    capture.write(tmp_path / "capture.json")
    assert CaptureFile.read(tmp_path / "capture.json") == capture
    assert capture.t_mid_utc == NOON + timedelta(seconds=10.5)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[]", "JSON of type list"),
        ('{"format": 9}', "format 9; expected format 1 to 1"),
        ('{"frames": []}', "no frames and no t_open_utc"),
        ('{"frames": [{"file": "a"}]}', "no entry 'exposure'"),
    ],
)
def test_another_capture_json_is_refused(tmp_path: Path, text: str, found: str) -> None:
    path = tmp_path / "capture.json"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        CaptureFile.read(path)
    assert found.split(";")[0] in str(refused.value)


@pytest.mark.contract
def test_pairs_come_back_equal(tmp_path: Path) -> None:
    rows = (
        PairRow(
            t_utc=NOON,
            panorama="panoramas/a.exr",
            dni_wm2=500.0,
            dhi_wm2=60.0,
            ghi_wm2=281.0,
            source="measured",
            sun_altitude_deg=18.0,
            sun_azimuth_deg=180.0,
            steadiness=0.01,
            sunpatch="p.exr",
            doubtful=True,
        ),
        PairRow(NOON, "panoramas/b.exr", math.nan, math.nan, ok=False, why="no irradiance"),
    )
    PairsFile(tmp_path / "pairs.csv", rows).write()
    read = PairsFile.read(tmp_path / "pairs.csv")
    assert replace(read.usable[0], line=0) == rows[0]
    assert (read.refused[0].why, read.refused[0].line) == ("no irradiance", 3)


@pytest.mark.contract
def test_doubts_of_earlier_versions_are_read_from_their_words(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    whys = ["light changed by 20 %", "a; diffuse above global", "sun under 5 degrees: DNI", ""]
    lines = [f"2027-12-21T20:00:00Z,a.exr,1,2,{why}\n" for why in whys]
    path.write_text("t_utc,panorama,dni_wm2,dhi_wm2,why\n" + "".join(lines))
    assert [row.doubtful for row in PairsFile.read(path).rows] == [True, True, False, False]


@pytest.mark.contract
@pytest.mark.parametrize(("cell", "ok"), [("", True), ("yes", True), ("1.0", True), ("no", False)])
def test_ok_has_one_meaning(tmp_path: Path, cell: str, ok: bool) -> None:
    path = tmp_path / "pairs.csv"
    head = "t_utc,panorama,dni_wm2,dhi_wm2,ok,operator\n"
    path.write_text(f"{head}2027-12-21T20:00:00Z,a.exr,1,2,{cell},me\n")
    pairs = PairsFile.read(path)
    assert [row.ok for row in pairs.rows] == [ok]
    assert pairs.warnings == ("pairs.csv: unknown column operator is ignored",)


@pytest.mark.contract
def test_sidecar_reads_exposures_as_text_and_as_numbers(tmp_path: Path) -> None:
    frame = {"file": "a", "exposure": "1/250 f/5.6 ISO100", "correction": 1.0, "u_percent": 0.1}
    numbers = {"shutter_s": 0.00400001, "f_number": 5.6, "iso": 100.0, "nd": ""}
    for row, shutter_s in ((frame, 0.004), ({**frame, **numbers}, 0.00400001)):
        sidecar = Sidecar("x", NOON, "good", MergeReport.from_table({"frames": [row]}))
        sidecar.write(tmp_path / "x.json")
        read = Sidecar.read(tmp_path / "x.json")
        known = read.report.frames[0]
        assert (known.shutter_s, known.f_number, known.iso, known.nd) == (shutter_s, 5.6, 100.0, "")
        assert (read.t_utc, read.verdict) == (NOON, "good")


@pytest.mark.contract
def test_model_config_is_strict_about_what_it_knows(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"model": "transport", "height": "many"}))
    with pytest.raises(InputError, match=r"config\.json: height = 'many', not an integer"):
        ModelConfig.read(tmp_path)
    path.write_text(json.dumps({"model": "transport", "training": {"slots": ["a"]}, "more": 1}))
    config = ModelConfig.read(tmp_path)
    assert (config.training.slots, config.state["more"]) == (("a",), 1)


@pytest.mark.contract
def test_scores_come_back_equal(tmp_path: Path) -> None:
    scores = ScoresFile(({"name": "mean"},), "mean", "only one", 5, 0.1, notes=("note",))
    scores.write(tmp_path)
    assert ScoresFile.read(tmp_path) == scores and scores.judged_row is None


@pytest.mark.contract
def test_files_of_a_predicted_year_carry_their_version(tmp_path: Path) -> None:
    """A file without a version is of 0.1.0; a newer one is refused."""
    n, d = 2, 1
    hours = {name: np.ones(n) for name in HOUR_COLUMNS}
    views = {name: np.full((n, d), 0.5) for name in VIEW_COLUMNS}
    year = HourlyFile((NOON, NOON + timedelta(hours=1)), np.array([180.0]), hours, views)
    year.write(tmp_path, "UTC")
    PredictFile(hours=n, azimuths_deg=(180.0,)).write(tmp_path)
    about = PredictFile.read(tmp_path)
    assert json.loads((tmp_path / "predict.json").read_text())["format"] == 1
    again = HourlyFile.read(tmp_path, np.array(about.azimuths_deg), about.hours)
    assert again.t_utc == year.t_utc and (again.views["dgp"] == 0.5).all()
    path = tmp_path / "hourly.csv"
    for name in ("hourly.csv", "predict.json"):
        (tmp_path / f"{name}.sha256").unlink()  # version 0.1.0 wrote none
    text = path.read_text()
    path.write_text(text.replace(",format\n", "\n").replace(",1\n", "\n"))
    assert len(HourlyFile.read(tmp_path, np.array([180.0]), n).t_utc) == n
    path.write_text(text.replace(",1\n", ",2\n"))
    with pytest.raises(InputError, match="newer fieldlum"):
        HourlyFile.read(tmp_path, np.array([180.0]), n)
    (tmp_path / "predict.json").write_text('{"format": 2, "hours": 2, "azimuths_deg": [180]}')
    with pytest.raises(InputError, match="newer fieldlum"):
        PredictFile.read(tmp_path)
    (tmp_path / "predict.json").write_text('{"format": 0, "hours": 2, "azimuths_deg": [180]}')
    with pytest.raises(InputError, match="format 0; expected format 1 to 1; restore the file"):
        PredictFile.read(tmp_path)


@pytest.mark.contract
@pytest.mark.parametrize("count", [3, 150, 151, 299, 400])
def test_held_out_maps_are_kept_from_the_best_to_the_worst(tmp_path: Path, count: int) -> None:
    error = np.random.default_rng(count).permutation(count).astype(float)
    arrays: dict[str, Any] = {f.name: error + 0.5 for f in fields(HeldOutMaps)}
    arrays |= {"slots": np.array([f"{k:03}" for k in range(count)]), "log10_mse": error}
    HeldOutMaps(**arrays).write(tmp_path)
    kept = HeldOutMaps.find(tmp_path)
    assert kept is not None and len(kept) == len(set(kept.slots)) == min(count, MAX_MAPS)
    assert {kept.log10_mse.min(), kept.log10_mse.max()} == {0.0, count - 1.0}
    rows = kept.slots.astype(int)
    assert (np.diff(rows) > 0).all() and (kept.measured_log10 == error[rows] + 0.5).all()


@pytest.mark.contract
def test_simulated_irradiance_is_in_order_of_time(tmp_path: Path) -> None:
    path, head = tmp_path / "irradiance.csv", "t_utc,ghi_wm2,dhi_wm2,dni_wm2"
    first, second = (f"2027-12-21T20:0{minute}:00Z,3,1,2" for minute in range(2))
    path.write_text("\n".join((head, first, second)))
    assert (CleanIrradiance.read_truth(path).dni_wm2 == 2.0).all()
    for rows in ((first,), (first, first), (second, first), (first, second.replace(",2", ","))):
        path.write_text("\n".join((head, *rows)))
        with pytest.raises(InputError, match="expected two or more rows in order of time"):
            CleanIrradiance.read_truth(path)


@pytest.mark.contract
@pytest.mark.parametrize("shape", [(10**13,), (1_250_000_000,), (2**32, 2**32), (-5,), None])
def test_an_npz_with_an_impossible_array_is_refused(
    tmp_path: Path, shape: tuple[int, ...] | None
) -> None:
    head = io.BytesIO()
    if shape is not None:
        about = {"shape": shape, "fortran_order": False, "descr": "<f8"}
        np.lib.format.write_array_header_1_0(head, about)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", head.getvalue() + b"eight by")
    with pytest.raises(NPZ_ERRORS):
        read_arrays(tmp_path / "a.npz")


@pytest.mark.contract
def test_suns_of_a_newer_version_are_refused(tmp_path: Path) -> None:
    row = SunRow("panoramas/a.exr", 30.0, 180.0, 231.0, 1.0, "dni", 0.0)
    write_suns(tmp_path / "suns.csv", [row])
    assert read_suns(tmp_path / "suns.csv") == {row.panorama: row}
    write_suns(tmp_path / "suns.csv", [row, replace(row, format=99)])
    with pytest.raises(InputError, match="newer fieldlum"):
        read_suns(tmp_path / "suns.csv")


@pytest.mark.contract
def test_arrays_may_expand_by_16_mib(tmp_path: Path) -> None:
    """0.1.0 compressed the mask of seen pixels of its models."""
    for size, is_read in ((15 * 2**20, True), (17 * 2**20, False)):
        np.savez_compressed(tmp_path / "a.npz", seen=np.zeros(size, bool))
        if is_read:
            assert len(read_arrays(tmp_path / "a.npz")["seen"]) == size
        else:
            with pytest.raises(ValueError, match="it is compressed"):
                read_arrays(tmp_path / "a.npz")


@pytest.mark.contract
def test_a_day_file_begins_with_its_columns_also_after_foreign_lines(session: Session) -> None:
    header, day = ",".join(DAY_COLUMNS), session.irradiance / f"{NOON:%Y-%m-%d}.csv"
    for before in ("", "saved;by\na;spreadsheet\n1;2\n"):
        session.irradiance.mkdir(exist_ok=True)
        day.write_text(before)
        with closing(DayFiles(session, flush=False)) as files:
            files.append(IrradianceSample(NOON, 500.0))
        lines = day.read_text().removeprefix(before).strip().splitlines()
        assert lines[0] == header and len(lines) == 2


@pytest.mark.contract
def test_two_lines_without_a_checksum_are_torn_and_three_are_another_file(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    path.write_bytes(b"torn\n" * 2)
    assert cut_torn_tail(path, lambda line: False) == 10 and not path.read_bytes()
    path.write_bytes(b"other\n" * 3)
    with pytest.raises(InputError, match="no valid line"):
        cut_torn_tail(path, lambda line: False)
    assert path.read_bytes() == b"other\n" * 3


@pytest.mark.contract
def test_stored_pictures_may_expand_by_one_gib(tmp_path: Path) -> None:
    """The archive states what it expands to; nothing is expanded."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", b"eight by")
        archive.infolist()[0].file_size = 2**30 + 2**20
    with (
        pytest.raises(InputError, match="it is compressed"),
        open_arrays(tmp_path / "a.npz", "", ""),
    ):
        pass
