"""A year through a model: hourly figures, standards with confidence, occupancy, maps, and bad
input.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_room import dataset

import fieldlum
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Room as Room3d
from fieldlum.core.records import Site
from fieldlum.learn import models
from fieldlum.session import create_session
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.sky.sky_view.picture import SkyGrid
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.weather import read_weather
from fieldlum.year.glare import standards
from fieldlum.year.predict import Annual, read_annual, read_pictures, run
from fieldlum.year.predict.annual import rounded
from fieldlum.year.predict.hour_blocks import ModelRoom, blocks
from fieldlum.year.predict.occupancy import default_occupancy, occupied_hours, read_occupancy
from fieldlum.year.predict.year import are_full_years, light_of

DATA = dataset(("2027-03-20", "2027-06-21"), height=16)
SITE = DATA.setup.site
GREENWICH = Site("Greenwich", 51.5, 0.0)
UTC_YEAR = [datetime(2027, 1, 1, 0, 30, tzinfo=UTC) + timedelta(hours=h) for h in range(8760)]
YEAR = [t + timedelta(hours=8) for t in UTC_YEAR]  # of Pacific standard time


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("m") / "nearest"
    models.save(folder, models.fit("nearest", DATA, patch="none"), DATA)
    return folder


@pytest.fixture(scope="module")
def weather(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("w") / "w.csv"
    rng = np.random.default_rng(0)
    lines = ["month,day,hour,dni_wm2,dhi_wm2"]
    for month in (3, 6):
        for day in (20, 21, 22):
            for hour in range(24):
                sunny = 6 <= hour < 18
                dni, dhi = (rng.uniform(0, 800), rng.uniform(60, 250)) if sunny else (0.0, 0.0)
                lines.append(f"{month},{day},{hour + 0.5},{dni:.0f},{dhi:.0f}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def year(model: Path, weather: Path, tmp_path_factory: pytest.TempPathFactory) -> Annual:
    out = tmp_path_factory.mktemp("y")
    return run(model, weather, out=out, maps=True)[0]


# ---------------------------------------------------------------------------------------------- the
# year


@pytest.mark.slow
@pytest.mark.contract
def test_a_year_has_every_daylight_hour_and_reads_back(year: Annual, weather: Path) -> None:
    hours = read_weather(weather, DATA.setup.site).daylight()
    assert year.t_utc == hours.t_utc
    again = read_annual(year.folder)
    for name, values in year.views.items():
        np.testing.assert_allclose(again.views[name], values, rtol=1e-2, atol=0.051, equal_nan=True)
    np.testing.assert_allclose(again.views["dgp"], year.views["dgp"], atol=5.1e-5)
    assert again.about["protection"] == json.loads(json.dumps(year.about["protection"]))
    assert (year.views["dgp"] >= 0.159).all()
    assert year.occupied.any()


@pytest.mark.slow
@pytest.mark.contract
def test_python_gives_what_the_command_gives(model: Path, weather: Path, year: Annual) -> None:
    """Maps, disc, trust and glare of the hours of a year, as xarray with units."""
    loaded = fieldlum.load_model(model)
    assert "nearest of" in repr(loaded) and "32 x 16 px" in repr(loaded)
    light = light_of(read_weather(weather, DATA.setup.site).daylight())
    maps, glare = loaded.predict(light), loaded.glare(light)
    store = xr.open_zarr(year.folder / "maps.zarr", consolidated=False)
    for name in ("luminance_cdm2", "disc_lx", "trusted"):
        np.testing.assert_allclose(maps[name], store[name], rtol=3e-4)
    assert maps.luminance_cdm2.attrs["units"] == "cd m-2" and (maps.y == store.y).all()
    assert "luminance_cdm2" in maps._repr_html_()
    whole = year.to_xarray()
    assert whole.ev_lx.attrs == {"units": "lx"} and (whole.azimuth == glare.azimuth).all()
    for name in ("dgp", "ev_lx", "uniformity", "disc_lx", "dgp_low", "dgp_high", "u_dgp"):
        np.testing.assert_allclose(glare[name], whole[name], rtol=1e-6)
    maps.luminance_cdm2.isel(time=0).plot()  # type: ignore[call-arg]


@pytest.mark.contract
def test_damaged_pictures_are_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "pictures.npz").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(InputError, match="run fieldlum predict again"):
        read_pictures(tmp_path)


@pytest.mark.slow
@pytest.mark.property
def test_blocks_do_not_change_the_answer(year: Annual, model: Path, weather: Path) -> None:
    """Predicting hours one by one gives what blocks gave."""
    config = models.read_config(model)
    room = ModelRoom(
        setup=DATA.setup,
        height=config.height,
        width=config.width,
        heading_deg=config.heading_deg or 0.0,
        needs_patch=False,
    )
    light = light_of(read_weather(weather, DATA.setup.site).daylight())
    found = list(blocks(models.load(model), room, light[[3]]))
    import xarray as xr

    store = xr.open_zarr(year.folder / "maps.zarr", consolidated=False)
    assert store.luminance_cdm2.dims == ("time", "y", "x")
    assert store.luminance_cdm2.attrs["units"] == "cd m-2"
    assert len(store.time) == len(year)
    np.testing.assert_allclose(
        store.luminance_cdm2[3], found[0].prediction.luminance_cdm2[0], rtol=3e-4
    )
    assert np.datetime64(year.t_utc[3].replace(tzinfo=None)) == store.time[3].values


@pytest.mark.slow
@pytest.mark.contract
def test_a_sky_view_from_elsewhere_decides_the_disc(
    year: Annual, model: Path, weather: Path, tmp_path: Path
) -> None:
    """Half of the beam arrives from everywhere; workers predict with the same disc and pose."""
    grid = SkyGrid(
        first_altitude_deg=90.0,
        first_azimuth_deg=-180.0,
        step_deg=5.0,
        heading_deg=0.0,
        height=18,
        width=72,
    )
    full = np.ones((18, 72), np.float32)
    view = SkyView(grid, full, 0 * full, 9 * full, 0.5 * full, 0.4 * full, 0.6 * full, 9)
    view = replace(view, pose=CameraPose(heading_deg=30.0))
    view.write(tmp_path / "hall.exr")
    asked = {"out": tmp_path / "y", "sky_view": tmp_path / "hall.exr"}
    other, new = run(model, weather, **asked)
    assert new and not run(model, weather, **asked)[1]
    assert other.summary.disc_from == "the sky view in hall.exr"
    assert year.summary.disc_from != other.summary.disc_from
    light = light_of(read_weather(weather, DATA.setup.site).daylight())
    np.testing.assert_allclose(other.hours["disc_lx"], 0.5 * light.direct_lx, rtol=1e-3, atol=1.0)
    own = shutil.copytree(model, tmp_path / "own")
    view.write(own / "sky_view.exr")
    expected = run(own, weather, out=tmp_path / "o")[0].views
    for name in ("dgp", "u_dgp"):
        np.testing.assert_array_equal(other.views[name], expected[name], name)


@pytest.mark.slow
@pytest.mark.contract
def test_pictures_are_of_telling_hours(year: Annual) -> None:
    pictures = read_pictures(year.folder)
    worst = next(k for k, kind in enumerate(pictures.kinds) if kind.startswith("highest of worst"))
    azimuth = float(pictures.kinds[worst].split()[-1])
    column = int(np.argmin(np.abs(year.azimuths_deg - azimuth)))
    used = np.flatnonzero(year.occupied)
    assert year.views["dgp"][pictures.rows[worst], column] == pytest.approx(
        year.views["dgp"][used, column].max()
    )
    assert pictures.luminance_cdm2.shape[1:] == DATA.shape


@pytest.mark.slow
@pytest.mark.contract
def test_the_same_inputs_are_not_predicted_twice(
    model: Path, weather: Path, tmp_path: Path
) -> None:
    first, new = run(model, weather, out=tmp_path, views=4)
    assert new and first.views["dgp"].shape[1] == 4
    stamp = (tmp_path / "hourly.csv").stat().st_mtime_ns
    again, new = run(model, weather, out=tmp_path, views=4)
    assert not new and len(again) == len(first)
    assert (tmp_path / "hourly.csv").stat().st_mtime_ns == stamp
    assert run(model, weather, out=tmp_path, views=5)[1]
    assert run(model, weather, out=tmp_path, views=5, force=True)[1]
    never = tmp_path / "never.csv"
    never.write_text("occupied\n" + "0\n" * 8760)
    with pytest.raises(NotEnoughDataError, match="correct --occupancy"):
        run(model, weather, out=tmp_path, occupancy_path=never)
    assert (tmp_path / "predict.json").is_file()  # the earlier year is still there


@pytest.mark.slow
@pytest.mark.contract
def test_a_year_cut_off_by_a_kill_is_no_year(
    model: Path, weather: Path, tmp_path: Path, monkeypatch
) -> None:
    """Figures of a new weather never stand beside classes and maps of an older one."""
    run(model, weather, out=tmp_path, maps=True)
    assert not run(model, weather, out=tmp_path)[1], "maps that were asked for before do no harm"
    assert (tmp_path / "maps.zarr").is_dir()
    other = tmp_path / "other.csv"
    other.write_text(weather.read_text().replace("\n6,22,", "\n6,23,"))

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("fieldlum.year.predict.year.write_pictures", killed)
        with pytest.raises(KeyboardInterrupt):
            run(model, other, out=tmp_path)
    assert not (tmp_path / "maps.zarr").exists()
    with pytest.raises(InputError, match=r"predict.json: No such file"):
        read_annual(tmp_path)
    assert run(model, weather, out=tmp_path)[1]


@pytest.mark.contract
def test_a_folder_in_a_bucket_is_refused(model: Path, weather: Path) -> None:
    words = ["predict", str(model), "--weather", str(weather), "--out", "s3://bucket/year"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2 and "is a URL" in done.stderr
    assert not Path("s3:").exists()


@pytest.mark.slow
@pytest.mark.contract
def test_half_a_table_is_refused(model: Path, weather: Path, tmp_path: Path) -> None:
    run(model, weather, out=tmp_path)
    lines = (tmp_path / "hourly.csv").read_text().splitlines()
    (tmp_path / "hourly.csv.sha256").unlink()  # else a changed file is a warning
    for kept in (lines[:10], []):
        (tmp_path / "hourly.csv").write_text("\n".join(kept))
        with pytest.raises(InputError, match="fieldlum predict"):
            read_annual(tmp_path)


@pytest.mark.contract
def test_it_says_that_hourly_means_are_not_instants(year: Annual) -> None:
    assert any("one value of the weather" in note for note in year.about["notes"])


@pytest.mark.property
@settings(deadline=None)
@given(value=st.floats(2.0**-10, 2.0**30, width=32))
def test_rounding_keeps_a_hundredth_of_a_percent(value: float) -> None:
    assert rounded(np.array([value], np.float32))[0] == pytest.approx(value, rel=2.5e-4)


# ---------------------------------------------------------------------------------------------- EN
# 17037


def _doubt(dgp: np.ndarray, u: float) -> standards.DgpUncertainty:
    words, u_maps = ("seen",) * dgp.shape[1], np.full(dgp.shape, u)
    return standards.DgpUncertainty(words, dgp, dgp, dgp[None], u_maps)


@pytest.mark.authority
def test_classes_at_their_limits() -> None:
    """EN 17037:2018 table A.7, DGP not above 0.35 / 0.40 / 0.45 in more than 5 % of
    the time.
    """
    for over, hours, expected in (
        (0.36, 5, "high"),
        (0.36, 6, "medium"),
        (0.44, 6, "minimum"),
        (0.46, 6, "none"),
    ):
        dgp = np.full((100, 1), 0.2)
        dgp[:hours] = over
        rng = np.random.default_rng(0)
        (found,) = standards.protection(dgp, _doubt(dgp, np.nan), 100, np.array([180.0]), rng)
        assert found.glare_class == expected and found.low is None
        assert not found.certain and found.sentence.startswith("cannot tell yet: ")


@pytest.mark.analytic
def test_dark_occupied_hours_count_as_without_glare() -> None:
    dgp = np.full((6, 1), 0.6)
    assert standards.exceeded_in_share(dgp, 100)[0] == 0.6
    assert standards.exceeded_in_share(dgp, 120)[0] == 0.0


@pytest.mark.analytic
def test_an_interval_across_a_limit_cannot_tell_yet() -> None:
    rng = np.random.default_rng(1)
    dgp = rng.normal(0.30, 0.03, (1000, 2)) + np.array([0.0, 0.0])
    dgp[:, 1] -= 0.1
    found = standards.protection(dgp, _doubt(dgp, 0.01), 1000, np.array([180.0, 0.0]), rng)
    assert not found[0].certain and found[1].certain
    assert "cannot tell yet" in found[0].sentence and "class high" in found[1].sentence


@pytest.mark.slow
@pytest.mark.property
def test_intervals_cover_the_truth() -> None:
    """property by simulation: with errors as assumed, 95 % intervals hold the true value in at
    least 90 % of rooms.
    """
    inside = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        predicted = rng.normal(0.3, 0.05, (300, 1))
        u = np.full(predicted.shape, 0.02)
        truth = predicted + u * np.sqrt(0.5) * (
            rng.standard_normal() + rng.standard_normal(predicted.shape)
        )
        (found,) = standards.protection(predicted, _doubt(predicted, 0.02), 300, np.zeros(1), rng)
        assert found.low is not None and found.high is not None
        inside += found.low <= standards.exceeded_in_share(truth, 300)[0] <= found.high
    assert inside >= 54


@pytest.mark.analytic
def test_uncertainty_of_dgp_is_its_slope() -> None:
    """Against finite differences, Ev and sources moved apart."""
    from fieldlum.year.glare.metrics import dgp

    ev, contrast = np.array([[1500.0]]), np.array([[4e6]])
    found = standards.dgp_uncertainty(ev, contrast, np.full((1, 1), 0.01), np.zeros((1, 1)))
    # Ev's two terms pull in opposite directions; they are added as if they did not.
    parts = [
        (dgp(ev * 1.01, contrast * 1.01**1.87) - dgp(ev, contrast)).item(),
        (dgp(ev, contrast) - dgp(ev, contrast / 1.01**1.87)).item(),
    ]
    assert found[0, 0] == pytest.approx(sum(parts), rel=0.02)
    only = standards.dgp_uncertainty(ev, contrast, np.zeros((1, 1)), np.full((1, 1), 0.01))
    assert only[0, 0] == pytest.approx(
        (dgp(ev, contrast * 1.01**2) - dgp(ev, contrast)).item(), rel=0.02
    )


@pytest.mark.analytic
def test_the_disc_has_its_own_uncertainty(year: Annual) -> None:
    """A map known exactly leaves only the disc's share."""
    from fieldlum.learn.models import Prediction
    from fieldlum.year.glare.sources import panorama_views
    from fieldlum.year.predict.hour_blocks import U_DISC, HourBlock, relative_uncertainty

    light = DATA.light[[3]]
    maps = np.full((1, *DATA.shape), 50.0, np.float32)
    block = HourBlock(
        slice(0, 1),
        light,
        Prediction(maps, np.zeros_like(maps), np.zeros(1), np.ones(1, bool)),
        np.ones(1),
    )
    views = panorama_views(*DATA.shape, 180.0, [180.0])
    one = np.ones((1, 1))
    found = {"ev_lx": 4 * one, "sun_ev_lx": one, "contrast": 10 * one, "sun_contrast": 10 * one}
    _, ev, source = relative_uncertainty(block, views, found)
    assert (ev.item(), source.item()) == pytest.approx((U_DISC / 4, U_DISC))


# ----------------------------------------------------------------------------------------------
# occupancy


@pytest.mark.authority
def test_default_occupancy_is_3650_hours() -> None:
    assert occupied_hours(default_occupancy(), YEAR, SITE) == (3650, 365)
    assert occupied_hours(default_occupancy(), YEAR[:24], SITE) == (10, 1)


@pytest.mark.slow
@pytest.mark.contract
def test_daylight_hours_without_weather_are_not_hours_without_glare() -> None:
    """A file that lacks noon must not make the room look darker than it is; the night
    may be left out.
    """
    noon = [t for t in YEAR if (t - timedelta(hours=8)).hour != 12]
    assert occupied_hours(default_occupancy(), noon, SITE) == (3650 - 365, 365)
    night = [t for t in YEAR if 3 <= (t - timedelta(hours=8)).hour < 21]
    assert occupied_hours(default_occupancy(), night, SITE) == (3650, 365)


@pytest.mark.slow
@pytest.mark.contract
def test_occupancy_files(tmp_path: Path) -> None:
    weekly = tmp_path / "o.csv"
    weekly.write_text("days,start,end\nmon-fri,08:00,12:00\nsat,10:00,12:00\n")
    assert (
        occupied_hours(read_occupancy(weekly), UTC_YEAR, GREENWICH)[0] == 261 * 4 + 52 * 2
    )  # 2027 has 261 weekdays
    hourly = tmp_path / "h.csv"
    hourly.write_text(
        "occupied\n" + "\n".join("1" if h % 24 == 9 else "0" for h in range(8760)) + "\n"
    )
    occupancy = read_occupancy(hourly)
    assert occupied_hours(occupancy, UTC_YEAR, GREENWICH)[0] == 365
    assert occupancy.at([datetime(2028, 2, 29, 9, 30, tzinfo=UTC)], "UTC")[0]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("a,b\n1,2\n", "columns a, b"),
        ("days,start,end\nmonday-frog,08:00,12:00\n", "line 2"),
        ("days,start,end\nmon,12:00,08:00\n", "not before"),
        ("days,start,end\nmon,8,12\n", "line 2"),
        ("days,start,end\nmon,08:00\n", "2 cells"),
        ("days,start,end\n\n\nmon,8,12\n", "line 4"),
        ("occupied\n1\n0\n", "2 rows"),
        ("occupied\n" + "1\n" * 8759 + "x\n", "line 8761"),
    ],
)
def test_bad_occupancy_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "o.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_occupancy(path)


# ---------------------------------------------------------------------------------------------- bad
# input


def _changed(model: Path, tmp_path: Path, **more: object) -> Path:
    folder = tmp_path / "m"
    shutil.copytree(model, folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, **more}))
    (folder / "config.json.sha256").unlink(missing_ok=True)
    return folder


@pytest.mark.contract
def test_weather_of_another_place_is_refused(model: Path, tmp_path: Path) -> None:
    path = tmp_path / "far.csv"
    path.write_text(
        "# place: Nice, 43.7, 7.3, UTC+1\nmonth,day,hour,dni_wm2,dhi_wm2\n6,21,12.5,800,100\n"
    )
    with pytest.raises(InputError, match="km from the site"):
        run(model, path, out=tmp_path / "y")


@pytest.mark.analytic
def test_a_summer_twice_is_no_year() -> None:
    """The 18 months of a station's record were taken as a year, its summer counted twice."""
    full = [are_full_years(days) for days in (4, 182, 355, 360, 366, 367, 550, 725, 731)]
    assert full == [False, False, False, True, True, True, False, True, True]


@pytest.mark.contract
def test_a_repaired_weather_file_is_labelled(model: Path, tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    rows = [
        "2,29,12.5,100,100",
        "6,21,10.5,500,100",
        "6,21,11.5,-4,90",
        "6,21,12.5,,",
        "6,21,13.5,400,120",
    ]
    path.write_text("month,day,hour,dni_wm2,dhi_wm2\n" + "\n".join(rows) + "\n")
    done = CliRunner().invoke(
        main, ["predict", str(model), "--weather", str(path), "--out", str(tmp_path / "y")]
    )
    assert done.exit_code == 0, done.output
    assert "not a year" in done.stderr
    for said in ("29 February", "negative irradiance", "interpolated", "states no place"):
        assert said in done.stderr
    repairs = " ".join(read_annual(tmp_path / "y").about["weather"]["repairs"])
    assert "29 February" in repairs


@pytest.mark.contract
def test_a_model_of_pairs_with_other_irradiance_now_asks_to_pair_again(
    model: Path, tmp_path: Path
) -> None:
    tmp_path = create_session(tmp_path / "s", DATA.setup, [], {}).root
    shutil.copytree(model, tmp_path / "models" / "auto")
    path = tmp_path / "w.csv"
    path.write_text("month,day,hour,dni_wm2,dhi_wm2\n6,21,12.5,500,100\n6,21,13.5,400,120\n")
    words = ["predict", str(tmp_path / "models" / "auto"), "--weather", str(path), "--views", "1"]
    told = (
        "WARNING: 1 pair: picture, irradiance or mark changed after pair: run fieldlum pair again"
    )
    row = PairRow(datetime(2027, 6, 21, 20, tzinfo=UTC), "panoramas/a.exr", 1.0, 2.0)
    for inputs in ("", "0123456789ab", "0123456789ab"):  # the last one has nothing to do
        PairsFile(tmp_path / "pairs.csv", (replace(row, inputs=inputs),)).write()
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0 and (told in done.stderr) is bool(inputs), done.output
    assert "nothing to do" in done.stderr


@pytest.mark.contract
@pytest.mark.parametrize("cell", ["-50", "1e9", "x"])
def test_impossible_irradiance_is_refused(model: Path, tmp_path: Path, cell: str) -> None:
    path = tmp_path / "w.csv"
    path.write_text(f"month,day,hour,dni_wm2,dhi_wm2\n6,21,12.5,{cell},100\n")
    with pytest.raises(InputError, match="line 2"):
        run(model, path, out=tmp_path / "y")


@pytest.mark.contract
def test_a_wrong_time_zone_is_refused(model: Path, tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    rows = [
        f"6,{day},{hour + 0.5},{500 if hour < 9 else 0},{100 if hour < 9 else 0}"
        for day in (20, 21, 22)
        for hour in range(24)
    ]
    path.write_text("month,day,hour,dni_wm2,dhi_wm2\n" + "\n".join(rows) + "\n")
    with pytest.raises(InputError):
        run(model, path, out=tmp_path / "y")


@pytest.mark.contract
def test_weather_without_daylight_is_too_little(model: Path, tmp_path: Path) -> None:
    path = tmp_path / "night.csv"
    path.write_text("month,day,hour,dni_wm2,dhi_wm2\n6,21,0.5,0,0\n6,21,1.5,0,0\n")
    with pytest.raises(NotEnoughDataError):
        run(model, path, out=tmp_path / "y")


@pytest.mark.contract
def test_a_model_of_another_picture_size_is_refused(
    model: Path, weather: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="maps of 32 x 16"):
        run(_changed(model, tmp_path, height=20, width=40), weather, out=tmp_path / "y")


@pytest.mark.contract
def test_a_model_of_earlier_pictures_is_refused_and_the_report_warns(
    model: Path, weather: Path, tmp_path: Path
) -> None:
    """As of another room with the same plan, or of a session that was merged and paired again."""

    from fieldlum.report.sections import warnings_of
    from fieldlum.sky.sky_view.view import CHANNELS
    from fieldlum.year.predict import read_annual
    from fieldlum.year.stage_status import stage_status

    def outdated() -> tuple[list[str], list[str]]:
        """Return the outdated models and years, as status states them."""
        answer = stage_status(session)
        return answer["train"]["outdated"], answer["predict"]["outdated"]

    session = create_session(tmp_path / "s", DATA.setup, [], {})
    own = session.models / "nearest"
    shutil.copytree(model, own)
    grid = SkyGrid(
        first_altitude_deg=60.0,
        first_azimuth_deg=-60.0,
        step_deg=2.0,
        heading_deg=180.0,
        height=30,
        width=60,
    )
    arrays = {name: np.full((30, 60), 0.5, np.float32) for name in CHANNELS}
    slots = list(models.read_config(own).training.slots)
    view = SkyView(grid, **arrays, inputs={"captures": slots, "pictures": "", "others": "a"})
    view.write(own / "sky_view.exr")
    view.write(session.sky_view)
    year = run(own, weather)[0]
    earlier = "Year nearest is of another model"
    assert earlier not in " ".join(warnings_of(session, year))
    assert outdated() == ([], [])
    more = view.inputs | {"captures": [*slots, "2027-06-21/1200"], "others": "c"}
    replace(view, inputs=more).write(session.sky_view)
    assert earlier not in " ".join(warnings_of(session, year))  # more captures since
    replace(view, inputs=view.inputs | {"others": "b"}).write(session.sky_view)
    assert outdated() == (["nearest"], ["nearest"])
    with pytest.raises(InputError, match="of other pictures, irradiance or times"):
        run(own, weather)
    assert earlier in " ".join(warnings_of(session, read_annual(year.folder)))
    replace(view, inputs=view.inputs | {"captures": []}).write(own / "sky_view.exr")
    run(own, weather)  # train --sky-view FILE of other captures proves nothing
    assert outdated() == ([], [])
    (own / "config.json").write_text((own / "config.json").read_text() + "\n")  # trained again
    (own / "config.json.sha256").unlink()
    assert outdated() == ([], ["nearest"])
    page = session.report / "index.html"
    page.parent.mkdir()
    page.write_text("")
    assert stage_status(session)["report"] == {"done": True, "outdated": False}
    os.utime(page, (0, 0))  # before the year was predicted
    assert stage_status(session)["report"] == {"done": True, "outdated": True}
    os.utime(page)
    (year.folder / "predict.json").touch()  # shown again
    assert stage_status(session)["report"] == {"done": True, "outdated": False}
    os.utime(page, (0, 0))
    assert stage_status(session)["report"] == {"done": True, "outdated": True}


@pytest.mark.contract
def test_a_model_with_patches_needs_a_room(model: Path, weather: Path, tmp_path: Path) -> None:

    from fieldlum.session.site_toml import site_table

    bare = site_table(replace(DATA.setup, room=None))
    with pytest.raises(InputError, match=r"has no \[room\]"):
        run(_changed(model, tmp_path, with_patch=True, setup=bare), weather, out=tmp_path / "y")


@pytest.mark.contract
def test_a_model_of_another_site_or_camera_is_refused(
    model: Path, weather: Path, tmp_path: Path
) -> None:

    from fieldlum.core.records import Panorama
    from fieldlum.optics.images import write_panorama

    setup = replace(
        DATA.setup, site=replace(DATA.setup.site, latitude_deg=DATA.setup.site.latitude_deg + 1.0)
    )
    other = create_session(tmp_path / "other", setup, [], {})
    zone = replace(DATA.setup, site=replace(DATA.setup.site, timezone="America/Denver"))
    moved = create_session(tmp_path / "moved", zone, [], {})
    shutil.copytree(model, moved.models / "nearest")
    with pytest.raises(InputError, match="of the time zone"):
        run(moved.models / "nearest", weather)
    shutil.copytree(model, other.models / "nearest")
    with pytest.raises(InputError, match="a model of"):
        run(other.models / "nearest", weather)
    turned = replace(DATA.setup, room=Room3d(wall_azimuth_deg=170.0))
    mended = create_session(tmp_path / "mended", turned, [], {})
    shutil.copytree(model, mended.models / "nearest")
    with pytest.raises(InputError, match=r"\[room\] .*merge, pair and train again"):
        run(mended.models / "nearest", weather)
    same = create_session(tmp_path / "same", DATA.setup, [], {})
    shutil.copytree(model, same.models / "nearest")
    same.panoramas.mkdir()
    write_panorama(
        same.panoramas / "20270320T203000Z.exr", Panorama(np.ones((24, 48), np.float32), 180.0)
    )
    with pytest.raises(InputError, match="48 x 24 pixels, as in this session"):
        run(same.models / "nearest", weather)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command(model: Path, weather: Path, tmp_path: Path) -> None:
    words = [
        "predict",
        str(model),
        "--weather",
        str(weather),
        "--out",
        str(tmp_path),
        "--views",
        "2",
    ]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert "daylight hours" in done.stdout
    again = CliRunner().invoke(main, [*words, "--json"])
    assert json.loads(again.stdout)["new"] is False
    broken = tmp_path / "b.csv"
    broken.write_text("month,day,hour,dni_wm2,dhi_wm2\n6,21,12.5,much,100\n")
    failed = CliRunner().invoke(main, ["predict", str(model), "--weather", str(broken)])
    assert failed.exit_code == 3
    (line,) = failed.stderr.splitlines()
    assert "b.csv: line 2: dni_wm2 is 'much'" in line
    assert (
        CliRunner().invoke(main, ["predict", str(tmp_path), "--weather", str(weather)]).exit_code
        == 3
    )
