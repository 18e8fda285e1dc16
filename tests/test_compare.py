"""`compare`: a simulation beside what was measured; a wrong wall is named, hours are matched."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum.cli import main
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import Caution, InputError
from fieldlum.core.records import (
    CameraSetup,
    Flag,
    Obstruction,
    Panorama,
    Room,
    SiteFile,
    Slot,
    Window,
    slot_id,
)
from fieldlum.optics.images import (
    read_panorama,
    write_panorama,
    write_radiance_hdr,
)
from fieldlum.report.compare import (
    compare,
    hours_begun,
    read_model_hours,
    surface_names,
    surface_rows,
    surface_sentences,
)
from fieldlum.report.export_and_pack import export
from fieldlum.room import simulate
from fieldlum.room.scene.radiance import octree
from fieldlum.session import Session, create_session
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.sky.daylight import light_at
from fieldlum.year.glare.picture_glare import panorama_glare, picture_glare
from fieldlum.year.glare.pictures import panorama_to_fisheye
from fieldlum.year.predict import Annual

ROOM = Room(
    width_m=4,
    depth_m=5,
    height_m=3,
    camera_x_m=2,
    camera_y_m=2,
    camera_z_m=1.4,
    wall_azimuth_deg=170.0,
    window=(Window("south", left_m=0.5, width_m=3, sill_m=0.8, height_m=1.9),),
)
SETUP = SiteFile(SEATTLE, CameraSetup(heading_deg=170.0, height_m=1.4), ROOM)
# The "east" wall, which faces E with a turn of 170 degrees, is dark in one model.
DARK = replace(ROOM, obstruction=(Obstruction(3.95, 0.0, 0.0, 0.05, 5.0, 3.0, 0.15),))
START = datetime(2027, 3, 20, 16, 30, tzinfo=UTC)
TIMES = [START + timedelta(hours=2 * k) for k in range(4)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Path, Path]:
    """Return a session with four captures, and the pictures of a right and of a wrong model."""
    root = tmp_path_factory.mktemp("compare")
    session = create_session(root / "office", SETUP, [Slot(t, 30.0, 170.0, ()) for t in TIMES], {})
    session.panoramas.mkdir(exist_ok=True)
    folders = root / "right", root / "wrong"
    for room, folder in zip((ROOM, DARK), folders, strict=True):
        folder.mkdir()
        truth = simulate.lit_room(replace(SETUP, room=room), height=24, quality="draft")
        for k, t in enumerate(TIMES):
            dni, dhi = np.array([0.0 if k == 0 else 500.0]), np.array([150.0])
            light_then = light_at([t], SETUP.site, dni, dhi)
            panorama = truth.as_panorama(truth.render(light_then), 0)
            if room is ROOM:
                write_panorama(session.panoramas / f"{slot_id(t)}.exr", panorama)
            light = panorama.luminance_cdm2
            path = folder / f"{slot_id(t)}.hdr"
            if k == 3:  # as a fisheye with a VIEW, which every Radiance program writes
                fisheye = panorama_to_fisheye(light, 170.0, 170.0)
                write_radiance_hdr(path, fisheye, view=_fisheye_view(170.0))
            else:
                write_radiance_hdr(path, light, heading_deg=170.0)
    return session, *folders


def _fisheye_view(azimuth_deg: float) -> str:
    x, y = np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))
    return f"-vta -vp 0 0 0 -vd {x:.6f} {y:.6f} 0 -vu 0 0 1 -vh 180 -vv 180"


@pytest.mark.slow
@pytest.mark.authority
def test_a_right_model_has_no_odd_surface(
    measured: tuple[Session, Path, Path], tmp_path: Path
) -> None:
    session, right, _ = measured
    result = compare(session, right, tmp_path)
    assert all(s["ratio"] == pytest.approx(1.0, abs=0.06) for s in result.surfaces), result.surfaces
    assert "No surface differs" in " ".join(result.text)


@pytest.mark.slow
@pytest.mark.authority
def test_a_wrong_wall_is_named(measured: tuple[Session, Path, Path], tmp_path: Path) -> None:
    session, _, wrong = measured
    ran = CliRunner().invoke(
        main, ["compare", str(session.root), str(wrong), "--out", str(tmp_path)]
    )
    assert ran.exit_code == 0, ran.output
    assert 'E wall ("east"): the model is' in ran.output and "too low" in ran.output, ran.output
    assert "Largest differences: 2027" in ran.output
    assert (tmp_path / "compare.png").stat().st_size > 10_000
    assert (tmp_path / "compare.csv").read_text().startswith("slot,surface,measured_cdm2")


@pytest.mark.slow
@pytest.mark.contract
def test_export_writes_what_other_programs_read(
    measured: tuple[Session, Path, Path], tmp_path: Path
) -> None:
    session = measured[0]
    ran = CliRunner().invoke(
        main, ["export", str(session.root), "--out", str(tmp_path), "--view-azimuth", "170"]
    )
    assert ran.exit_code == 0, ran.output
    maps = sorted((tmp_path / "maps").iterdir())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "room.rad").write_text("void plastic wall 0 0 5 .5 .5 .5 0 0")
    mine = ["export", str(session.root), "--out", str(tmp_path / "mine")]
    assert "room.rad: a file that export did not" in CliRunner().invoke(main, mine).output
    again = ["export", str(session.root), "--out", str(tmp_path)]
    assert CliRunner().invoke(main, again).exit_code == 0
    assert len(maps) == 4 and maps[0].name == f"{slot_id(TIMES[0])}-170.hdr"
    (view,) = picture_glare(maps[0])["views"]
    panorama = read_panorama(session.panoramas / f"{slot_id(TIMES[0])}.exr")
    (own,) = panorama_glare(panorama, [170.0])["views"]
    assert view["ev_lx"] == pytest.approx(own["ev_lx"], rel=0.02)
    with octree((tmp_path / "room.rad").read_text()) as compiled:
        assert compiled.stat().st_size > 1000


@pytest.mark.contract
def test_export_names_views_that_no_lens_saw(tmp_path: Path) -> None:
    """Half of the directions were seen, around the south; west is seen by half."""
    session = create_session(tmp_path / "office", SETUP, [], {})
    session.panoramas.mkdir()
    azimuth_deg = np.arange(1.5, 360.0, 3.0)  # the picture's centre is in the south
    unseen = np.where(np.abs(azimuth_deg - 180.0) > 90.0, np.uint16(Flag.OUTSIDE_LENS), 0)
    flags = np.broadcast_to(unseen.astype(np.uint16), (60, 120))
    panorama = Panorama(np.full((60, 120), 900.0, np.float32), 180.0, flags=flags)
    write_panorama(session.panoramas / "20270320T193000Z.exr", panorama)
    with pytest.warns(Caution, match="no maps to 0 degrees: the lens saw less"):
        files = export(session, tmp_path / "out", (0.0, 180.0, 240.0))
    maps = sorted(file.name[17:] for file in files if file.suffix == ".hdr")
    assert maps == ["180.hdr", "240.hdr"]
    for azimuth_deg, words in ((180, "seen"), (240, "partly seen")):
        path = tmp_path / "out" / "maps" / f"20270320T193000Z-{azimuth_deg}.hdr"
        (view,) = picture_glare(path)["views"]
        (own,) = panorama_glare(panorama, [azimuth_deg])["views"]
        assert view["seen"] == own["seen"] == words
        assert view["seen_share"] == pytest.approx(own["seen_share"], abs=0.02)


@pytest.mark.analytic
def test_surfaces_are_named_by_compass() -> None:
    names = surface_names(ROOM, 24, 170.0)
    assert names[-1, 0] == "floor" and names[0, 0] == "ceiling"
    assert names[12, 24] == "window"
    assert {'N wall ("north")', 'E wall ("east")', 'W wall ("west")'} <= set(names.ravel())


def _year(hours: int = 200) -> Annual:
    """A year of some daylight hours with a known DGP, facing 0 and 180 degrees."""
    start = datetime(2027, 1, 1, 8, 30, tzinfo=UTC)  # half past midnight in Seattle
    times = tuple(start + timedelta(hours=9 + k // 8 * 24 + k % 8) for k in range(hours))
    dgp: Floats = np.linspace(0.2, 0.5, 2 * hours).reshape(hours, 2)
    views: dict[str, Floats] = {"dgp": dgp, "ev_lx": dgp * 5000}
    summary = PredictFile(inputs={"weather": "seattle.epw"})
    return Annual(times, np.array([0.0, 180.0]), {}, views, Path(), summary)


@pytest.mark.contract
def test_a_table_of_hours_is_compared_with_the_predicted_year(tmp_path: Path) -> None:
    session = create_session(tmp_path / "office", SETUP, [], {})
    year = _year()
    table = tmp_path / "other.tsv"
    rows = [
        f"{1 + k // 8}\t{9 + k % 8}.5\t{value + 0.02:.4f}"
        for k, value in enumerate(year.views["dgp"][:, 1])
    ]
    days = [row.split("\t") for row in rows]
    text = ["month\tday\thour\tDGP"]
    text += [
        f"{1 if int(d) <= 31 else 2}\t{int(d) if int(d) <= 31 else int(d) - 31}\t{h}\t{v}"
        for d, h, v in days
    ]
    table.write_text("\n".join(text))
    result = compare(session, table, tmp_path / "out", [180.0], year)
    (view,) = result.directions
    assert "the weather of seattle.epw" in result.text[-1]
    assert view["hours"] == 200 and view["azimuth_deg"] == 180.0
    assert view["model"] - view["measured"] == pytest.approx(0.02, abs=1e-3)
    assert view["model_over"] > view["over"]
    near = compare(session, table, tmp_path / "out", [184.5], year)
    assert "View 184.5 deg compares with 180 deg." in near.text
    assert not any("compares with" in text for text in result.text)


@pytest.mark.contract
def test_a_table_in_another_zone_is_refused(tmp_path: Path) -> None:
    """Hours of UTC with the daylight of Seattle: the morning is the afternoon's hours."""
    session = create_session(tmp_path / "office", SETUP, [], {})
    year, table = _year(), tmp_path / "utc.csv"
    hours = np.array([k // 8 * 24 + 9 + k % 8 for k in range(len(year))])
    rows = [f"{hour + 5.5},{0.3 + 0.001 * k:.3f}" for k, hour in enumerate(hours[:-8])]
    table.write_text("hoy,dgp\n" + "\n".join(rows))
    with pytest.raises(InputError, match="light at night in 117 of 186 hours"):
        compare(session, table, tmp_path / "out", [180.0], year)
    for late, dark in ((3, 0.0), (3, 0.184), (0, 0.184)):
        complete = np.full(8760, dark)
        complete[hours + late] = 0.3
        table.write_text("dgp\n" + "\n".join(f"{value:g}" for value in complete))
        if late:
            with pytest.raises(InputError, match="light at night in 75 of 200 hours"):
                compare(session, table, tmp_path / "out", [180.0], year)
        else:
            assert compare(session, table, tmp_path / "out", [180.0], year).directions


@pytest.mark.contract
@pytest.mark.parametrize("moved", [-1, 0, 1])
def test_a_table_an_hour_off_is_told(tmp_path: Path, moved: int) -> None:
    """As on a clock in summer time: its differences were stated as the simulation's errors."""
    session = create_session(tmp_path / "office", SETUP, [], {})
    year, table = _year(), tmp_path / "other.csv"
    hours = [k // 8 * 24 + 9.5 + k % 8 + moved for k in range(len(year))]
    dgp = np.random.default_rng(3).uniform(0.2, 0.9, len(year))
    year.views["dgp"][:, 1] = dgp
    rows = [f"{hour},{value + 0.02:.4f}" for hour, value in zip(hours, dgp, strict=True)]
    table.write_text("hoy,dgp\n" + "\n".join(rows))
    text = " ".join(compare(session, table, tmp_path / "out", [180.0], year).text)
    assert (
        f"November to March the table agrees twice as well if moved by {-moved:+d} h" in text
    ) is (moved != 0) and "April" not in text


@pytest.mark.contract
@pytest.mark.parametrize(("shift", "word"), [(0, "begins"), (1, "ends")])
def test_whole_hours_are_placed_by_the_daylight_of_the_year(
    tmp_path: Path, shift: int, word: str
) -> None:
    """Rows of daylight only, from 9 to 16 or from 10 to 17, without the hour 0 or 24."""
    session = create_session(tmp_path / "office", SETUP, [], {})
    year = _year()
    table = tmp_path / "other.csv"
    dgp = year.views["dgp"][:, 1]
    rows = [f"{k // 8 * 24 + 9 + k % 8 + shift},{value + 0.1:.4f}" for k, value in enumerate(dgp)]
    table.write_text("hoy,dgp\n" + "\n".join(rows))
    result = compare(session, table, tmp_path / "out", [180.0], year)
    (view,) = result.directions
    assert view["hours"] == 200 and view["mean_abs"] == pytest.approx(0.1, abs=1e-4)
    assert f"each {word} then" in " ".join(result.text)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("hours", "begun"),
    [("0 1 2", [0, 1, 2]), ("22 23 24", [21, 22, 23]), ("9.5 10.5 11.5", [9, 10, 11])],
)
def test_hour_0_or_24_or_a_fraction_states_the_hour(
    tmp_path: Path, hours: str, begun: list[int]
) -> None:
    table = tmp_path / "other.csv"
    table.write_text("month,day,hour,dgp\n" + "".join(f"1,1,{h},0.3\n" for h in hours.split()))
    times = read_model_hours(table, [180.0]).index.to_numpy(float)
    found, note = hours_begun(table, times, np.zeros(8760, bool))
    assert found.tolist() == begun and not note


@pytest.mark.contract
def test_a_folder_of_honeybee_is_read(tmp_path: Path) -> None:
    (tmp_path / "sun-up-hours.txt").write_text("8.5\n9.5\n10.5\n")
    (tmp_path / "desk.dgp").write_text("0.2 0.3 0.4\n0.25 0.35 0.45\n")
    hours = read_model_hours(tmp_path, [90.0, 180.0])
    assert hours.index.tolist() == [8.5, 9.5, 10.5]
    assert hours["dgp", 180.0].tolist() == [0.25, 0.35, 0.45]
    with pytest.raises(InputError, match="views and hours"):
        read_model_hours(tmp_path, [90.0])


@pytest.mark.contract
def test_grids_of_honeybee_are_read_as_they_are_written(tmp_path: Path) -> None:
    results = tmp_path / "results"
    (results / "dgp").mkdir(parents=True)
    (results / "sun-up-hours.txt").write_text("8.5\n9.5\n")
    (results / "dgp" / "desk.dgp").write_text("0.2\t0.3\n")  # hours are in the folder above
    for folder in (results, results / "dgp"):
        assert read_model_hours(folder, [90.0])["dgp", 90.0].tolist() == [0.2, 0.3]
    (tmp_path / "sun-up-hours.txt").write_text("8.5\n9.5\n")
    np.save(tmp_path / "desk.npy", np.array([[900.0, 1000.0]], np.float32))
    assert read_model_hours(tmp_path, [90.0])["ev_lx", 90.0].tolist() == [900.0, 1000.0]


@pytest.mark.contract
def test_8760_rows_without_a_time_are_the_hours_of_a_year(tmp_path: Path) -> None:
    table = tmp_path / "one.csv"
    table.write_text("DGP\n" + "0.3\n" * 8760)
    assert read_model_hours(table, [180.0]).index[[0, -1]].tolist() == [0.5, 8759.5]
    table.write_text("DGP\n" + "0.3\n" * 8784)
    with pytest.raises(InputError, match="8784 rows of columns DGP; expected month"):
        read_model_hours(table, [180.0])


@pytest.mark.analytic
def test_a_wall_is_named_but_not_a_reveal_whose_pixels_are_edges() -> None:
    def text(**ratios: float) -> str:
        names = {"all": 1.0, "floor": 0.98, "ceiling": 1.02, "W wall": 1.0} | ratios
        means = {k: {"measured_cdm2": 100.0, "model_cdm2": 100.0 * v} for k, v in names.items()}
        rows = ({"name": k, "ratio": v, "pictures": 4} | means[k] for k, v in names.items())
        return " ".join(surface_sentences(list(rows)))

    assert "No surface differs" in text(reveal=1.3, frame=0.7)
    assert "E wall: the model is 70 % too dark" in text(**{"E wall": 0.3, "reveal": 1.3})


@pytest.mark.analytic
def test_the_ratio_of_a_surface_is_that_of_its_median_pixel() -> None:
    names, light = np.full((4, 10), "N wall", object), np.full((4, 10), 50.0)
    model = 0.8 * light
    model[:, 7:] = 400.0  # light that leaks along the window
    whole, wall = surface_rows("slot", names, light, model, np.full((4, 10), 0.1))
    assert wall["ratio"] == pytest.approx(0.8) and wall["model_cdm2"] == pytest.approx(148.0)
    assert whole["ratio"] == pytest.approx(148.0 / 50.0)


@pytest.mark.contract
def test_pictures_of_other_slots_are_refused(tmp_path: Path) -> None:
    session = create_session(tmp_path / "office", SETUP, [], {})
    (tmp_path / "model").mkdir()
    write_radiance_hdr(tmp_path / "model" / "noon.hdr", np.ones((8, 16)), heading_deg=0.0)
    with pytest.raises(InputError, match="none named as a capture"):
        compare(session, tmp_path / "model", tmp_path / "out")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("month,day,hour,dgp\n1,1,25,0.3", "hour 25; expected"),
        ("month,day,hour,dgp\n1,1,0,0.3\n1,1,24,0.3", "hours 0 and 24"),
        ("month,day,hour,dgp\n1,1,11,0.3\n1,1,12,0.3", "add 0.5 to hours at which each begins"),
        ("month,day,hour,dgp\n2,29,12,0.3", "line 2: month 2, day 29"),
        ("month,day,hour,dgp\n13,1,12,0.3", "month 13"),
        ("month,day,hour,dgp\n0,1,12,0.3", "month 0"),
        ("month,day,hour,dgp\n,1,12,0.3", "month nan"),
        ("hoy,dgp\n8761,0.3", "hour of the year 8761"),
        ("hoy,dgp\n,0.3", "hour of the year nan"),
        ("hoy,dgp\n-1,0.3", "hour of the year -1"),
        ("hoy,dgp\n12,0.3\n12.5,0.4", "2 values in hour 12"),
        ("hoy,dgp\n12,30\n13,45", "divide percent by 100"),
        ("hoy,dgp\n1,0\n2,0\n3,0\n12,30\n13,45", "divide percent by 100"),
        ("t,dgp\n" + 8760 * "2027-07-01 00:30,0.3\n", "rows from 2027-07-01 00:30"),
        ("hoy,dgp\n12,-999", "DGP of -999"),
        ("hoy,dgp@south\n12,0.3", "a view such as dgp@180"),
        ("hoy,dgp@nan\n12,0.3", "a view such as dgp@180"),
        ("hoy,dgp@180,dgp@540\n12,0.3,0.4", "two columns of dgp"),
        ("hoy,dgp\n12.5,", "no value in daylight hours"),
        ("hoy,dgp,DGP\n12.5,0.3,0.4", "2 columns named dgp"),
        ("hoy,Ev [klx]\n12.5,0.3", "the column ev [klx]; expected Ev in lx"),
        ("hoy,illum (fc)\n12.5,300", "the column illum (fc); expected Ev in lx"),
        ("hoy,dgp\n12.5,0_3", "numbers in dgp"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused(tmp_path: Path, text: str, found: str) -> None:
    session = create_session(tmp_path / "office", SETUP, [], {})
    table = tmp_path / "other.csv"
    table.write_text(text)
    with pytest.raises(InputError) as error:
        compare(session, table, tmp_path / "out", [180.0], _year())
    assert found in str(error.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.contract
def test_dgp_above_1_counts_as_1_as_in_the_predicted_year(tmp_path: Path) -> None:
    table = tmp_path / "other.csv"
    table.write_text("hoy,dgp\n12,0.3\n13,0.4\n14,1.7\n")
    assert read_model_hours(table, [180.0])["dgp", 180.0].tolist() == [0.3, 0.4, 1.0]
    for name in ("DGP [-]", "dgp"):
        table.write_text(f"hoy\t{name}\tEv (lx)\n12\t0.3\t900\n")
        hours = read_model_hours(table, [180.0])
        assert (hours["dgp", 180.0].tolist(), hours["ev_lx", 180.0].tolist()) == ([0.3], [900.0])


@pytest.mark.contract
@pytest.mark.parametrize("command", ["compare", "export"])
def test_a_view_that_is_no_number_is_a_usage_error(tmp_path: Path, command: str) -> None:
    more = [str(tmp_path)] if command == "compare" else []
    ran = CliRunner().invoke(main, [command, str(tmp_path), *more, "--view-azimuth", "nan"])
    assert ran.exit_code == 2 and "not a finite number" in ran.output, ran.output


@pytest.mark.contract
def test_a_turned_picture_blames_no_wall_and_a_slot_has_one_picture(tmp_path: Path) -> None:
    session = create_session(tmp_path / "office", replace(SETUP, room=None), [], {})
    session.panoramas.mkdir(exist_ok=True)
    light = np.geomspace(10.0, 3000.0, 48) * np.ones((24, 1))
    capture = Panorama(light.astype(np.float32), 180.0)
    write_panorama(session.panoramas / f"{slot_id(START)}.exr", capture)
    model = tmp_path / "model"
    model.mkdir()
    write_radiance_hdr(model / f"{slot_id(START)}.hdr", light, heading_deg=90.0)
    text = " ".join(compare(session, model, tmp_path / "out").text)
    assert "check VIEW, north" in text and "reflectance" not in text, text
    write_panorama(model / f"{slot_id(START)}.exr", capture)
    with pytest.raises(InputError, match="a second picture"):
        compare(session, model, tmp_path / "out")
