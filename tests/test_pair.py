"""Pair: statistics over a bracket's own interval, refusal of stale data, the sun's strength,
pairs.csv.
"""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum import pair
from fieldlum.capture.import_logger import add_samples, remove_rows
from fieldlum.cli import main
from fieldlum.core.errors import Caution, ChangedFileWarning, InputError, NotEnoughDataError
from fieldlum.core.records import (
    CLIPPED_SUN,
    CameraSetup,
    Exposure,
    Flag,
    IrradianceSample,
    Panorama,
    Room,
    SiteFile,
    Slot,
    SunSource,
    Window,
    parse_utc,
    slot_id,
    utc_text,
)
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.pair import irradiance
from fieldlum.pair.bracket_irradiance import irradiance_during
from fieldlum.pair.sun_strength import completed_sun, measured_sun
from fieldlum.report.sections import warnings_of
from fieldlum.session import DayFiles, Session, create_session, mark_slot
from fieldlum.session.files.capture_json import CaptureFile, Frame, frame_fields
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import (
    PAIR_COLUMNS,
    PairRow,
    PairsFile,
    light_digests,
    write_simulated_pairs,
)
from fieldlum.session.files.sidecar import Sidecar, warn_if_picture_changed
from fieldlum.session.panorama_sun import SunRow, read_panorama_with_sun
from fieldlum.sky import sun
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sun_disc import add_source
from fieldlum.year.glare.picture_glare import picture_glare
from fieldlum.year.stage_status import stage_status

NOON = datetime(2027, 12, 21, 20, 0, tzinfo=UTC)
SOUTH = SunSource(18.9, 178.0, 5000.0, 1.0, "clipped")
ROOM = Room(window=(Window("south", 0.5, 5.0, 1.0, 2.5),))


def log(seconds: np.ndarray, ghi: np.ndarray, every: float = 5.0) -> CleanIrradiance:
    t = NOON.timestamp() + seconds * every
    n = len(t)
    return CleanIrradiance(
        t_unix_s=t,
        ghi_wm2=ghi,
        dhi_wm2=0.2 * ghi,
        dni_wm2=0.9 * ghi,
        source=np.array(["measured"] * n, object),
        flags=np.array([""] * n, object),
    )


@pytest.mark.analytic
def test_statistics_come_from_the_interval_alone() -> None:
    k = np.arange(-60.0, 60.0)
    ghi = np.where((k >= 0) & (k <= 6), 500.0 + 5 * k, 100.0)
    light = irradiance_during(log(k, ghi), NOON, NOON + timedelta(seconds=30))
    assert (light.ghi_wm2, light.dhi_wm2, light.rows, light.why) == (515.0, 103.0, 7, "")
    assert light.steadiness == pytest.approx(30.0 / 515.0)


@pytest.mark.analytic
def test_a_short_bracket_takes_a_row_on_either_side() -> None:
    light = irradiance_during(
        log(np.arange(-9.0, 9.0), np.full(18, 400.0)),
        NOON + timedelta(seconds=1),
        NOON + timedelta(seconds=3),
    )
    assert light.rows == 2 and light.why == ""


@pytest.mark.contract
@pytest.mark.parametrize("missing", [(-1, 7), (2, 6), (-20, 20)])
def test_stale_data_are_refused(missing: tuple[int, int]) -> None:
    k = np.arange(-20.0, 20.0)
    kept = k[(k < missing[0]) | (k > missing[1])]
    light = irradiance_during(
        log(kept, np.full(len(kept), 400.0)), NOON, NOON + timedelta(seconds=30)
    )
    assert light.why.startswith("no irradiance") and np.isnan(light.ghi_wm2)


@pytest.mark.analytic
def test_blank_figures_are_no_data_and_say_why() -> None:
    known = log(np.arange(-20.0, 20.0), np.full(40, 400.0))
    blank = replace(
        known,
        ghi_wm2=np.full(40, np.nan),
        dni_wm2=np.full(40, np.nan),
        flags=np.array(["status"] * 40, object),
    )
    assert (
        irradiance_during(blank, NOON, NOON + timedelta(seconds=30)).why
        == "irradiance unusable: status"
    )


@pytest.mark.contract
def test_coarse_rows_are_refused() -> None:
    light = irradiance_during(
        log(np.arange(-5.0, 5.0), np.full(10, 400.0), every=3600.0),
        NOON,
        NOON + timedelta(seconds=30),
    )
    assert light.why == "irradiance was logged only every 3600 s"


@pytest.mark.contract
def test_unsteady_light_is_cautioned_then_refused() -> None:
    """With one text each: a percentage of its own hid rarer cautions behind the five commonest."""
    k = np.arange(-9.0, 9.0)
    cautioned, refused = (
        "light changed by over 10 %",
        "light changed by over 50 % during the bracket",
    )
    for rise, text in ((0.2, cautioned), (0.3, cautioned), (0.9, refused), (1.5, refused)):
        light = irradiance_during(
            log(k, np.where(k < 3, 400.0, 400.0 * (1 + rise))), NOON, NOON + timedelta(seconds=30)
        )
        assert (light.why or light.caution) == text and bool(light.why) is (text == refused)
        assert light.doubtful


def at_noon() -> pair.BracketInterval:
    """A bracket of one moment."""
    capture = CaptureFile(slot="x", frames=(), t_open_utc=NOON, t_close_utc=NOON)
    return pair.BracketInterval("x", Path("x.exr"), capture)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("flag", "doubtful"),
    [("", False), ("low-sun", False), ("spike", True), ("k-index", True), ("horizon", True)],
)
def test_marks_make_light_doubtful_but_a_low_sun_does_not(flag: str, doubtful: bool) -> None:
    steady = log(np.arange(-20.0, 20.0), np.full(40, 400.0))
    marked = replace(steady, flags=np.array([flag] * 40, object))
    light = irradiance_during(marked, NOON, NOON + timedelta(seconds=30))
    row = pair.judge(at_noon(), light, 30.0, 178.0)
    assert (light.doubtful, row.ok, row.doubtful) == (doubtful, True, doubtful)


@pytest.mark.contract
def test_a_map_of_which_most_is_clipped_is_not_used() -> None:
    """As of a bracket that a full disk ended after its longest frame."""
    light = irradiance_during(
        log(np.arange(-20.0, 20.0), np.full(40, 400.0)), NOON, NOON + timedelta(seconds=30)
    )
    window = replace(at_noon(), clipped_percent=12.0)
    for bracket, used in ((window, True), (replace(window, clipped_percent=100.0), False)):
        row = pair.judge(bracket, light, 30.0, 178.0)
        assert row.ok is used and ("clipped in every frame" in row.why) is not used


@pytest.mark.contract
def test_each_bracket_goes_by_the_logger_of_its_own_time() -> None:
    """Days of a minute logger before weeks of a fast one are not refused as stale."""
    slow, fast = np.arange(-3000.0, 3000.0, 60.0), np.arange(86400.0, 96400.0, 5.0)
    t = np.r_[slow, fast]
    both = log(t, np.full(len(t), 400.0), every=1.0)
    for moment, rows in ((NOON, 4), (NOON + timedelta(days=1, hours=1), 13)):
        light = irradiance_during(both, moment, moment + timedelta(seconds=60))
        assert (light.why, light.rows) == ("", rows)


@pytest.mark.contract
def test_exchanged_components_are_refused() -> None:
    """Global and diffuse in each other's column would be hours without any sun."""
    known = log(np.arange(-20.0, 20.0), np.full(40, 400.0))
    exchanged = replace(known, ghi_wm2=known.dhi_wm2, dhi_wm2=known.ghi_wm2, dni_wm2=np.zeros(40))
    assert "exchanged" in irradiance_during(exchanged, NOON, NOON + timedelta(seconds=30)).why


@pytest.mark.contract
def test_a_dead_instrument_and_kilowatts_are_refused_by_day_alone() -> None:
    top = 1400.0
    assert sun.too_weak([0.4, 3.0, 20.0], 20.0, top).tolist() == [True, False, False]
    assert not sun.too_weak([0.0, 0.0], [5.0, -20.0], top).any()
    light = irradiance_during(
        log(np.arange(-20.0, 20.0), np.full(40, 0.4)), NOON, NOON + timedelta(seconds=30)
    )
    assert "kW/m2" in pair.judge(at_noon(), light, 19.0, 178.0).why


@pytest.mark.contract
@pytest.mark.parametrize("shift_h", [-1, 0, 1])
def test_a_loggers_clock_in_daylight_saving_shows_as_light_at_night(shift_h: int) -> None:
    """Cloudless days, one reading a minute around the clock; an hour off, dusk or dawn
    is lit by no sun.
    """
    t = np.arange(NOON.timestamp(), NOON.timestamp() + 2 * 86400.0, 60.0)
    clear = sun.clearsky([datetime.fromtimestamp(s, UTC) for s in t], SEATTLE)
    texts = np.array([""] * len(t), object)
    logged = CleanIrradiance(
        t_unix_s=t + 3600.0 * shift_h,
        ghi_wm2=clear.ghi_wm2,
        dhi_wm2=clear.dhi_wm2,
        dni_wm2=clear.dni_wm2,
        source=texts,
        flags=texts,
    )
    if shift_h == 0:
        pair.check_night(Path("clean.csv"), logged, SEATTLE)
        return
    with pytest.raises(
        InputError, match=r"clean.csv: irradiance was logged in .* minutes .* clock"
    ):
        pair.check_night(Path("clean.csv"), logged, SEATTLE)


def picture(sun: SunSource | None, level: float = 100.0) -> Panorama:
    return Panorama(np.full((8, 16), level, np.float32), 180.0, t_utc=NOON, sun=sun)


@pytest.mark.analytic
def test_a_measured_sun_is_kept_and_a_hidden_one_never_added() -> None:
    own = replace(SOUTH, origin="nd-frames")
    assert measured_sun(picture(own), 90_000.0, None) == (own, "")
    strong = replace(own, normal_illuminance_lx=60_000.0)
    assert "brighter than DNI" in measured_sun(picture(strong), 1_000.0, None)[1]
    assert measured_sun(picture(None), 90_000.0, None) == (None, "")


@pytest.mark.analytic
def test_a_clipped_sun_comes_from_dni_and_the_sky_view() -> None:
    assert measured_sun(picture(SOUTH), 90_000.0, None) == (SOUTH, "")
    source, caution = completed_sun(SOUTH, 90_000.0, 0.4, "sky-view")
    assert caution == "" and source.origin == "sky-view"
    assert source.normal_illuminance_lx == pytest.approx(36_000)
    source, caution = completed_sun(SOUTH, 90_000.0, np.nan, "dni")
    assert source.normal_illuminance_lx == pytest.approx(90_000) and source.origin == "dni"
    assert "without the glazing" in caution
    kept, caution = completed_sun(SOUTH, 2_000.0, 0.8, "dni")
    assert kept == SOUTH and "weaker sun" in caution, "a lower bound is kept"


@pytest.mark.analytic
def test_a_meter_beside_the_lens_comes_first() -> None:  # uniform 100 cd/m2 gives pi 100 lx
    cosine = np.cos(np.radians(18.9)) * np.cos(np.radians(2.0))
    source, _ = measured_sun(picture(SOUTH), 90_000.0, 100 * np.pi + 60_000.0 * cosine)
    assert source is not None and source.origin == "meter"
    assert source.normal_illuminance_lx == pytest.approx(60_000.0, rel=2e-3)
    narrow = picture(SOUTH)
    flags = np.where(np.abs(np.arange(16) - 7.5) > 3.0, Flag.OUTSIDE_LENS, 0) * np.ones((8, 1), int)
    source, _ = measured_sun(replace(narrow, flags=flags), 90_000.0, 60_000.0)
    assert source == SOUTH, "what the lens did not see is no part of the sun"


def make_session(folder: Path, room: Room | None, hours: int = 2) -> Session:
    slots = [Slot(NOON + timedelta(hours=i), 18.0, 180.0, ()) for i in range(hours)]
    session = create_session(folder, SiteFile(SEATTLE, CameraSetup(), room), slots, {})
    days = DayFiles(session, flush=False)
    for slot in slots:
        for i in range(-12, 24):
            days.append(
                IrradianceSample(
                    slot.t_utc + timedelta(seconds=5 * i), ghi_wm2=280.0 + i % 3, dhi_wm2=60.0
                )
            )
        _bracket(session, slot.t_utc)
    days.close()
    irradiance.run(session)
    return session


def _bracket(session: Session, t_utc: datetime) -> None:
    name = slot_id(t_utc)
    folder = session.raw / name
    folder.mkdir(parents=True)
    note = {
        "t_open_utc": utc_text(t_utc),
        "t_close_utc": utc_text(t_utc + timedelta(seconds=20)),
        "complete": True,
    }
    (folder / "capture.json").write_text(json.dumps(note))
    session.panoramas.mkdir(exist_ok=True)
    write_panorama(session.panoramas / f"{name}.exr", picture(SOUTH, 50.0))
    side = {
        "slot": name,
        "verdict": "good",
        "size_bytes": (session.panoramas / f"{name}.exr").stat().st_size,
    }
    (session.panoramas / f"{name}.json").write_text(json.dumps(side))


@pytest.mark.contract
def test_a_slow_log_is_compared_beyond_its_neighbours(tmp_path: Path) -> None:
    """Rows 15 minutes apart: another value before the bracket counts, later rows do not."""
    session = make_session(tmp_path / "s", None)
    shutil.rmtree(session.irradiance)
    times = [NOON + timedelta(minutes=15 * k) for k in range(-4, 2)]
    rows = [IrradianceSample(t, ghi_wm2=300.0, raw=f"{t}") for t in times]
    add_samples(session, rows)
    of = {"slot": NOON + timedelta(minutes=5)}
    before = light_digests(session, of)
    add_samples(session, [IrradianceSample(NOON + timedelta(minutes=30), ghi_wm2=310.0)])
    assert light_digests(session, of, before) == before != light_digests(session, of)
    remove_rows(session, rows[2:3])
    add_samples(session, [replace(rows[2], ghi_wm2=390.0)])
    assert light_digests(session, of, before) != before


@pytest.mark.contract
def test_pairs_of_earlier_irradiance_or_marks_are_to_do_again(tmp_path: Path) -> None:
    """A logger's clock that is corrected after `pair`, and a later mark, are in no stage's result.

    Rows that a log adds later at other times change no pair.
    """
    session = make_session(tmp_path / "s", None)
    pair.run(session)
    slots = [slot.id for slot in session.slots()]

    def state() -> tuple[int, int, int]:
        of_pair = stage_status(session)["pair"]
        return of_pair["done"], of_pair["usable"], of_pair["owed"]

    later = IrradianceSample(NOON + timedelta(minutes=4), ghi_wm2=281.0, dhi_wm2=60.0)
    add_samples(session, [later, replace(later, t_utc=NOON + timedelta(days=1))])
    assert state() == (2, 2, 0) and not PairsFile.read(session.pairs).pair_again
    mark_slot(session, slots[1], "lamp=on")
    assert state() == (1, 1, 1) and PairsFile.read(session.pairs).outdated == {slots[1]}
    pair.run(session)
    assert state() == (2, 2, 0)
    session.sidecar(slots[0]).write_text("{}")  # merged again, with another calibration
    assert PairsFile.read(session.pairs).outdated == {slots[0]}
    session.sidecar(slots[0]).unlink()
    file = tmp_path / "dni.csv"
    times = [NOON + timedelta(seconds=5 * k) for k in range(5)]
    file.write_text("t_utc,dni_wm2\n" + "".join(f"{utc_text(t)},700\n" for t in times))
    done = CliRunner().invoke(main, ["import", str(session.root), "--irradiance", str(file)])
    told = (
        "WARNING: 1 pair: picture, irradiance or mark changed after pair: run fieldlum pair again"
    )
    assert done.exit_code == 0 and told in done.stderr, done.output
    assert state() == (1, 1, 1) and stage_status(session)["next_step"].startswith("fieldlum pair")
    assert told in load_pairs(session).notes
    assert told in [text.rstrip(".") for text in warnings_of(session, None)]
    text = session.pairs.read_text()
    for row in PairsFile.read(session.pairs).rows:  # as version 0.2 wrote it: nothing is known
        text = text.replace(row.inputs, "")
    session.pairs.write_text(text)
    session.pairs.with_name("pairs.csv.sha256").unlink()
    assert state() == (2, 2, 0)


def fields_of(sha256: str) -> dict[str, object]:
    exposure = Exposure(0.01, 5.6)
    return frame_fields(Frame(0, f"{sha256}.dng", exposure, None, NOON, 0.1, sha256))


def rows_of(session: Session) -> list[dict[str, str]]:
    with session.pairs.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.contract
@pytest.mark.parametrize("room", [None, ROOM])
def test_stage_writes_rows_suns_and_patches(tmp_path: Path, room: Room | None) -> None:
    session = make_session(tmp_path / "s", room)
    pairs = pair.run(session)
    rows = rows_of(session)
    assert (
        tuple(rows[0]) == PAIR_COLUMNS
        and [r["ok"] for r in rows] == ["1", "1"]
        and all(p.ok for p in pairs)
    )
    assert (
        float(rows[0]["ghi_wm2"]) == pytest.approx(281.0, abs=0.5)
        and rows[0]["source"] == "measured"
    )
    beam = float(rows[0]["dni_wm2"]) * np.sin(np.radians(float(rows[0]["sun_altitude_deg"])))
    assert beam + float(rows[0]["dhi_wm2"]) == pytest.approx(float(rows[0]["ghi_wm2"]), rel=2e-3)
    found = read_panorama(session.root / rows[0]["panorama"])
    assert found.sun == SOUTH, "pair rewrites no panorama"
    joined = read_panorama_with_sun(session.root / rows[0]["panorama"])
    assert joined.sun is not None and "note" not in joined.attributes
    assert (joined.sun.origin, joined.sun.normal_illuminance_lx > 5000.0) == ("dni", True)
    assert bool(rows[0]["sunpatch"]) is (room is not None)
    if room is not None:
        patch = read_panorama(session.root / rows[0]["sunpatch"])
        assert patch.luminance_cdm2.shape == found.luminance_cdm2.shape
        stamp = (session.root / rows[0]["sunpatch"]).stat().st_mtime_ns
        pair.run(session)
        assert (session.root / rows[0]["sunpatch"]).stat().st_mtime_ns == stamp, (
            "made once from the same inputs"
        )
        shutil.copy(session.panorama_files()[0], session.root / rows[0]["sunpatch"])
        with pytest.warns(ChangedFileWarning, match="changed after pair wrote it.*fieldlum pair"):
            warn_if_picture_changed(session.root / rows[0]["sunpatch"], "pair")
        pair.run(session)
        warn_if_picture_changed(session.root / rows[0]["sunpatch"], "pair")
        sidecar = (session.root / rows[0]["sunpatch"]).with_suffix(".json")
        note = json.loads(sidecar.read_text())
        del note["sha256"]  # of an earlier version, or of somebody else
        sidecar.write_text(json.dumps(note))
        shutil.copy(session.panorama_files()[0], session.root / rows[0]["sunpatch"])
        pair.run(session)
        again = read_panorama(session.root / rows[0]["sunpatch"])
        np.testing.assert_array_equal(again.luminance_cdm2, patch.luminance_cdm2)


@pytest.mark.contract
@pytest.mark.parametrize("turn_deg", [0.0, 90.0])
def test_a_heading_that_is_90_degrees_off_is_named_with_the_true_one(
    tmp_path: Path, turn_deg: float
) -> None:
    """Merge takes out the sun at its place alone: one elsewhere stays in the panorama."""
    session = make_session(tmp_path / "s", None, hours=4)
    for file in session.panorama_files():
        t_utc = parse_utc(file.stem)
        at = sun.position([t_utc], SEATTLE)
        place = at.altitude_deg, at.azimuth_deg + turn_deg
        shown = add_source(np.full((1, 90, 180), 50.0, np.float32), place, np.array([6e4]), 180.0)
        write_panorama(file, Panorama(shown[0], 180.0, t_utc=t_utc))
        side = session.sidecar(file.stem)
        note = json.loads(side.read_text()) | {"size_bytes": file.stat().st_size}
        side.write_text(json.dumps(note))
    pair.run(session)
    notes = " ".join(SkyView.read(session.sky_view).notes)
    assert ("turned by 90 degrees: set heading_deg = 90" in notes) == (turn_deg != 0.0)


@pytest.mark.contract
def test_a_clipped_sun_without_its_row_is_a_lower_bound(tmp_path: Path) -> None:
    """Before `pair`, and after a merge whose sun differs from the one that `pair` completed."""
    session = make_session(tmp_path / "s", None)
    path = session.panorama_files()[0]
    assert "lower bound" in picture_glare(path)["warnings"][0]
    pair.run(session)
    assert not picture_glare(path)["warnings"]
    again = replace(SOUTH, normal_illuminance_lx=6000.0)
    write_panorama(path, picture(again, 50.0))
    stale = read_panorama_with_sun(path)
    assert stale.sun == again and "run fieldlum pair" in stale.attributes["note"]
    row = SunRow(f"panoramas/{path.name}", 30.0, 180.0, 6000.0, 1.0, CLIPPED_SUN, 6000.0)
    paired = read_panorama_with_sun(path, {row.panorama: row})
    assert "pair found no stronger sun" in paired.attributes["note"]
    notes = load_pairs(session).notes
    assert any("the sun is clipped in 1 map:" in note for note in notes)


@pytest.mark.contract
def test_a_sun_that_an_earlier_pair_wrote_into_its_panorama_counts_once(tmp_path: Path) -> None:
    """Version 0.1.0 rewrote panoramas; its sessions open with and without suns.csv."""
    session = make_session(tmp_path / "s", None)
    path = session.panorama_files()[0]
    write_panorama(path, picture(replace(SOUTH, origin="dni", normal_illuminance_lx=8e4), 50.0))
    before = read_panorama_with_sun(path)
    assert before.sun is not None and before.sun.normal_illuminance_lx == 8e4
    assert "note" not in before.attributes
    pair.run(session)
    after, other = (read_panorama_with_sun(p).sun for p in session.panorama_files())
    assert after is not None and other is not None and after.origin == "dni"
    assert after.normal_illuminance_lx == pytest.approx(other.normal_illuminance_lx, rel=0.3)


@pytest.mark.contract
def test_pair_keeps_the_pairs_of_a_simulated_session(tmp_path: Path) -> None:
    """Simulating again keeps pair's."""
    session = make_session(tmp_path / "s", None)
    session.truth.mkdir()
    rows = (PairRow(NOON, "truth/a.exr", 500.0, 50.0, sunpatch="sunpatches/a.exr"),)
    write_simulated_pairs(session, rows)
    pair.run(session)
    truth = PairsFile.read(session.truth_pairs).rows
    assert [(row.panorama, row.sunpatch) for row in truth] == [("a.exr", "../sunpatches/a.exr")]
    merged = session.pairs.read_bytes()
    write_simulated_pairs(session, rows)
    assert session.pairs.read_bytes() == merged and b"panoramas/" in merged


@pytest.mark.contract
def test_a_refused_row_stays_in_the_table(tmp_path: Path) -> None:
    """Whatever merge says of a panorama that it wrote is a caution, never a refusal."""
    session = make_session(tmp_path / "s", None)
    _bracket(session, NOON + timedelta(hours=5))
    (session.panoramas / f"{slot_id(NOON)}.json").write_text(
        json.dumps({"verdict": "neighbouring frames disagree by 7.1 %"})
    )
    pair.run(session)
    rows = rows_of(session)
    assert [row["ok"] for row in rows] == ["1", "1", "0"]
    assert rows[2]["why"].startswith("no irradiance") and rows[2]["dni_wm2"] == ""


@pytest.mark.contract
def test_a_sun_of_few_pixels_is_said(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", None)
    note = session.panoramas / f"{slot_id(NOON)}.json"
    note.write_text(json.dumps({**json.loads(note.read_text()), "sun": {"u_mosaic_percent": 20.0}}))
    pair.run(session)
    assert (
        "the sun covers few pixels: its illuminance is uncertain by 20 %"
        in rows_of(session)[0]["why"]
        and rows_of(session)[0]["ok"] == "1"
    )


@pytest.mark.contract
def test_a_map_that_did_without_a_frame_is_incomplete(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", None)
    note = session.panoramas / f"{slot_id(NOON)}.json"
    note.write_text(json.dumps({**json.loads(note.read_text()), "quality": {"lost": ["03.dng"]}}))
    pair.run(session)
    assert ["incomplete" in row["why"] for row in rows_of(session)] == [True, False]


@pytest.mark.contract
def test_a_card_imported_with_two_offsets_is_refused(tmp_path: Path) -> None:
    """The same frames in two slots: one of the two is hours away from its light."""
    session = make_session(tmp_path / "s", None, hours=3)
    for hour, frames in enumerate(("ab", "cd", "ab")):
        note = session.raw / slot_id(NOON + timedelta(hours=hour)) / "capture.json"
        table = {**json.loads(note.read_text()), "frames": [fields_of(frame) for frame in frames]}
        note.write_text(json.dumps(table))
    pair.run(session)
    first, second, third = rows_of(session)
    assert (
        first["why"]
        == f"the same frames as slot {slot_id(NOON + timedelta(hours=2))}: a card was imported "
        "with two clock offsets; import it again with the right --utc-offset, which removes the "
        "wrong one, then merge and pair again"
    )
    assert third["ok"] == "0" and slot_id(NOON) in third["why"] and second["ok"] == "1"


@pytest.mark.contract
def test_bad_inputs_are_named(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s", None)
    clean = session.irradiance / "clean.csv"
    clean.write_text(clean.read_text().replace(",281,", ",hello,", 1))
    clean.with_name("clean.csv.sha256").unlink()
    with pytest.raises(InputError, match=r"clean\.csv"):
        pair.run(session)
    clean.unlink()
    with pytest.raises(InputError, match=r"clean\.csv: No such file"):
        CleanIrradiance.read(clean)
    empty = create_session(tmp_path / "e", SiteFile(SEATTLE), [Slot(NOON, 18.0, 180.0, ())], {})
    with pytest.raises(NotEnoughDataError, match="no panorama"):
        pair.run(empty)


@pytest.mark.analytic
def test_pairing_recovers_the_simulated_light_within_the_instruments_noise(tmp_path: Path) -> None:
    # The simulator's truth, read through the SPN1 on its pty (noise 1 W/m2) over a bracket of 40 s.
    from fieldlum.devices import open_pyranometer
    from fieldlum.devices.clock import FastClock
    from fieldlum.devices.simulated.world import open_world
    from fieldlum.sky.sun import position

    session = create_session(tmp_path / "s", SiteFile(SEATTLE), [Slot(NOON, 18.0, 180.0, ())], {})
    clock, days = FastClock(NOON - timedelta(seconds=60)), DayFiles(session, flush=False)
    instrument = open_pyranometer("sim:office?seed=3&noise=1", clock=clock, session=session)
    try:
        for _ in range(30):
            days.append(instrument.read())
            clock.sleep(5.0)
    finally:
        instrument.close()
        days.close()
    irradiance.run(session)
    light = irradiance_during(
        CleanIrradiance.read(session.irradiance / "clean.csv"), NOON, NOON + timedelta(seconds=40)
    )
    truth = open_world(session, 3).irradiance(NOON + timedelta(seconds=20))
    noise = 1.0 / np.sqrt(light.rows)
    sine = np.sin(np.radians(position([NOON + timedelta(seconds=20)], SEATTLE).altitude_deg[0]))
    assert light.rows == 9 and light.source == "measured"
    assert abs(light.ghi_wm2 - truth.ghi_wm2) < 4 * noise
    assert abs(light.dhi_wm2 - truth.dhi_wm2) < 4 * noise
    assert abs(light.dni_wm2 - truth.dni_wm2) < 4 * noise * np.sqrt(2) / sine


@pytest.mark.contract
def test_panoramas_of_another_profile_are_named(tmp_path: Path) -> None:
    """As after a new calibration, or where merge was ended between two panoramas."""
    session = make_session(tmp_path / "s", None)
    slot = session.slots()[0].id
    Sidecar(slot, profile={"name": "early", "sha256": "0" * 64}).write(session.sidecar(slot))
    (session.raw / slot).mkdir(parents=True, exist_ok=True)
    (session.raw / slot / "00_1s.dng").touch()
    told = "1 panorama of another camera profile than the present one: run fieldlum merge and pair"
    with pytest.warns(Caution, match=told):
        pair.run(session)
    assert any(told in note for note in load_pairs(session).notes)
    (session.raw / slot / "00_1s.dng").unlink()
    assert not any(told in note for note in load_pairs(session).notes), "cannot be merged again"
