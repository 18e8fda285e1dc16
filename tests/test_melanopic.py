"""Melanopic EDI from camera colour: weights, pictures, calibration and white balance."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import PROFILE, SIZE, raw_frame
from click.testing import CliRunner
from places import SEATTLE

from fieldlum.calibrate import colour
from fieldlum.calibrate.fit_charts import Place
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, Panorama, SiteFile, Slot, SunSource
from fieldlum.merge.bracket import floating_white_balance
from fieldlum.merge.shots import Shot
from fieldlum.optics.images import RADIANCE_CHROMATICITIES, rgb_to_xyz, write_panorama
from fieldlum.optics.melanopic import (
    BY_CHART,
    BY_MATRIX,
    LAMP_RATIO,
    MELANOPIC_FROM_XYZ,
    U_GLASS,
    attribute_text,
    daylight_xy,
    melanopic_edi,
    melanopic_ratio,
    ratio_u_rel,
    sky_xyz,
    sun_melanopic_ratio,
    sun_xyz,
)
from fieldlum.optics.profiles import Colour, check_profile
from fieldlum.optics.projection import direction
from fieldlum.optics.raw.writing import write_jpeg
from fieldlum.report.view import read_measured_picture
from fieldlum.room.scene.radiance import octree
from fieldlum.session import create_session, mark_slot
from fieldlum.sky.daylight import light_at
from fieldlum.year.glare.picture_glare import picture_glare
from fieldlum.year.glare.uncertainty_budget import budget_of_file

# X, Y, Z of D65 and of illuminant A (CIE 015:2018, table 7), and their ratios by CIE S 026.
D65, A = np.array([0.9504, 1.0, 1.0888]), np.array([1.0985, 1.0, 0.3558])
CAMERA = np.array([[0.55, 0.25, 0.10], [0.30, 0.62, 0.08], [0.02, 0.12, 1.10]])  # to X, Y, Z


def coloured(xyz: np.ndarray, u_cdm2: float = 3.0) -> Panorama:
    """A uniform panorama of 100 cd/m2 of one colour."""
    rgb = np.linalg.inv(rgb_to_xyz(RADIANCE_CHROMATICITIES)) @ xyz
    text = attribute_text(MELANOPIC_FROM_XYZ @ rgb_to_xyz(RADIANCE_CHROMATICITIES), np.eye(3), 0.03)
    shape = (8, 16)
    return Panorama(
        np.full(shape, 100.0, np.float32),
        180.0,
        u_cdm2=np.full(shape, u_cdm2, np.float32),
        rgb=np.broadcast_to(rgb, (*shape, 3)).astype(np.float32),
        attributes={"melanopic": text},
    )


@pytest.mark.authority
def test_ratios_are_those_of_cie_s_026() -> None:
    for xyz, ratio, tolerance in ((D65, 1.0, 0.005), (A, 0.496, 0.03)):
        found, u_rel = melanopic_ratio(coloured(xyz)) or (np.zeros(1), 0.0)
        assert found == pytest.approx(ratio, abs=tolerance) and u_rel == 0.03
    assert melanopic_ratio(replace(coloured(D65), attributes={})) is None


@pytest.mark.authority
def test_direct_sunlight_is_that_of_spectrl2() -> None:
    # pvlib's spectrl2 at an aerosol depth of 0.1: zenith 0, 60, 75 and 80 degrees
    for altitude, ratio in ((90.0, 0.893), (30.0, 0.840), (15.0, 0.752), (10.0, 0.676)):
        assert sun_melanopic_ratio(altitude) == pytest.approx(ratio, rel=0.02)


@pytest.mark.authority
def test_the_suns_colour_has_the_melanopic_light_of_spectrl2() -> None:
    altitude = np.array([90.0, 30.0, 10.0, 5.0])
    # pvlib's spectrl2 at an aerosol depth of 0.1, by the observer of CIE 1931: X / Y, Z / Y
    expected = np.array([[0.966, 0.919], [0.967, 0.819], [0.992, 0.541], [1.058, 0.312]])
    assert sun_xyz(altitude)[:, [0, 2]] == pytest.approx(expected, rel=0.02)
    assert sun_xyz(altitude) @ MELANOPIC_FROM_XYZ == pytest.approx(
        sun_melanopic_ratio(altitude), rel=0.06
    )


@pytest.mark.authority
@pytest.mark.parametrize(("dni", "dhi"), [(800.0, 80.0), (0.0, 150.0)])
def test_the_skys_colour_is_that_of_radiances_perezlum_c(dni: float, dhi: float) -> None:
    pyradiance = pytest.importorskip("pyradiance")
    light = light_at([datetime(2027, 3, 20, 20, tzinfo=UTC)], SEATTLE, np.array([dni]), dhi)
    sky, sun = light.sky, light.sun_direction[0]
    locus = "-4.6070e9 2.9678e6 99.11 0.244063 -2.0064e9 1.9018e6 247.48 0.237040 -3 2.87 -0.275"
    numbers = [sky.norm_cdm2[0], sky.ground_cdm2[0], *sky.shape[0], *sun, sky.clearness[0]]
    text = (
        "void colorfunc skyfunc\n4 skybright_r skybright_g skybright_b perezlum_c.cal\n0\n22 "
        f"{' '.join(str(float(x)) for x in numbers)} {locus}\n"
        "skyfunc glow skyglow\n0\n0\n4 1 1 1 0\nskyglow source dome\n0\n0\n4 0 0 1 180\n"
    )
    altitude, azimuth = np.meshgrid([15.0, 40.0, 70.0], [20.0, 110.0, 250.0, 330.0])
    toward = direction(altitude.ravel(), azimuth.ravel())
    rays = np.concatenate((np.zeros_like(toward), toward), axis=1).astype("<f4").tobytes()
    with octree(text) as scene:
        answer = pyradiance.rtrace(rays, scene, header=False, inform="f", outform="f")
    theirs = np.frombuffer(answer, "<f4").reshape(-1, 3)
    luminance = light.sky_at(toward)[0]
    to_rgb = np.array([[2.5693, -1.1668, -0.3984], [-1.0221, 1.9783, 0.0438]])  # of the file
    to_rgb = np.vstack((to_rgb, [-0.0747, -0.2519, 1.1772]))
    xyz = sky_xyz(luminance, sky.clearness) * luminance[:, None]
    assert xyz @ to_rgb.T == pytest.approx(theirs, rel=0.01)


@pytest.mark.analytic
def test_edi_of_a_uniform_room_with_a_sun() -> None:
    picture, weights = coloured(D65), np.full((128, 1), np.pi / 128)
    sun = SunSource(30.0, 180.0, 5000.0)
    of_map = picture, np.full(128, 100.0), weights
    edi, u = melanopic_edi(*of_map, sun, np.array([1000.0]), lamps=False)
    expected = 100.0 * np.pi + 1000.0 * sun_melanopic_ratio(30.0)
    assert edi == pytest.approx(expected, rel=0.005)
    u_map = 100.0 * np.pi * np.hypot(0.03, 0.03)
    assert u[0] == pytest.approx(np.hypot(u_map, 0.07 * 1000 * sun_melanopic_ratio(30.0)), rel=0.02)
    lit, _ = melanopic_edi(*of_map, None, np.zeros(1), lamps=True)
    assert lit == pytest.approx(LAMP_RATIO * 100.0 * np.pi, rel=0.005)  # of 208 LED, in the mean
    plain = replace(picture, attributes={})
    edi, u = melanopic_edi(plain, np.full(128, 100.0), weights, None, np.zeros(1))
    assert edi == pytest.approx(100.0 * np.pi) and np.isnan(u).all()


@pytest.mark.contract
def test_a_lamp_that_is_marked_counts_in_glare_and_view(tmp_path: Path) -> None:
    when = datetime(2027, 3, 20, 17, tzinfo=UTC)
    slots = [Slot(when, 30.0, 170.0, ())]
    session = create_session(tmp_path / "s", SiteFile(SEATTLE), slots, {})
    session.panoramas.mkdir()
    path = session.panorama(slots[0].id)
    write_panorama(path, coloured(D65))
    (lit,), (unlit,), (unknown,) = (
        picture_glare(path, [180.0], lamps=lamps)["views"] for lamps in (True, False, None)
    )
    assert lit["melanopic_edi_lx"] < unknown["melanopic_edi_lx"]
    mark_slot(session, slots[0].id, "lamp=on")
    assert picture_glare(path, [180.0])["views"] == [lit]
    assert picture_glare(path, [180.0], lamps=False)["views"] == [unlit]
    assert f"m-EDI {lit['melanopic_edi_lx']:.0f} " in read_measured_picture(path).figures
    (stated,), (marked,) = (
        [row.u for row in budget_of_file(path, [180.0], lamps) if row.figure == "melanopic EDI"]
        for lamps in (True, None)
    )
    assert marked == stated


@pytest.mark.property
def test_light_that_may_be_a_lamps_is_less_certain() -> None:
    ratio = np.array([1.4, 1.05, 0.85, 0.65, 0.45])
    for lamps in (None, True):
        u = ratio_u_rel(ratio, 0.025, lamps=lamps)
        assert (np.diff(u) >= 0).all() and u[0] == 0.025
        assert u[-1] == pytest.approx(np.hypot(0.025, 0.21))
    assert ratio_u_rel(ratio, 0.025, lamps=False) == pytest.approx(0.025)


@pytest.mark.analytic
def test_a_chart_under_daylight_gives_the_cameras_matrix() -> None:
    for cct_k in (4500.0, 8000.0):
        table = np.loadtxt(colour._CHART_XYZ, delimiter=",").reshape(24, 3, 3)
        xyz = colour.daylight_parts(cct_k) @ table
        rgb = xyz @ np.linalg.inv(CAMERA).T * np.linspace(0.5, 2.0, 24)[:, None]  # uneven light
        found = colour.xyz_from_chart(rgb, CAMERA[1], cct_k)
        assert found == pytest.approx(CAMERA, abs=1e-6)
    white = colour.daylight_parts(6504.0) @ table[18] / table[18, 0, 1]
    assert white / white[1] == pytest.approx(D65, rel=0.05)  # white paint is slightly yellow
    with pytest.raises(ValueError, match="4000 to 25 000 K"):
        colour.daylight_parts(3000.0)


@pytest.mark.analytic
def test_weights_follow_the_matrix_and_readings_of_a_spectrometer() -> None:
    rng = np.random.default_rng(2)
    rgb = rng.uniform(10.0, 100.0, (12, 3))
    truth = np.array([-0.1, 0.7, 0.5])
    places = tuple(Place(Path("x"), i, 0) for i in range(12))
    matrix = np.linalg.inv(CAMERA)
    colours = colour.Colours(rgb, rgb @ CAMERA[1], np.full(12, 0.01), places, matrix)
    own = Colour(tuple(CAMERA[1].tolist()))
    table, line = colour.with_melanopic(own, colours, PROFILE, 1.0, None)
    assert table.melanopic_from_rgb == pytest.approx(BY_MATRIX[0] @ CAMERA, abs=1e-5)
    assert "colour matrix; glass not stated" in line
    assert table.melanopic_u_rel == pytest.approx(np.hypot(BY_MATRIX[1], U_GLASS), abs=1e-4)
    table, line = colour.with_melanopic(own, colours, PROFILE, 1.0, None, clear_glass=True)
    assert "glass" not in line and table.melanopic_u_rel == BY_MATRIX[1]
    read = replace(colours, melanopic=rgb @ truth)
    table, line = colour.with_melanopic(own, read, PROFILE, 1.0, None)
    assert table.melanopic_from_rgb == pytest.approx(truth, abs=0.02)
    assert "12 readings" in line and table.melanopic_u_rel == pytest.approx(0.0283, abs=1e-4)
    patches = replace(colours, rgb=rng.uniform(1, 9, (24, 3)), of_chart=True)
    chart, line = colour.with_melanopic(own, patches, PROFILE, 1.0, 5500.0, clear_glass=True)
    assert chart.melanopic_u_rel == BY_CHART[1] and "5500 K" in line
    none, line = colour.with_melanopic(own, replace(colours, matrix=None), PROFILE, 1.0, None)
    assert none.melanopic_from_rgb == () and "--cct" in line
    with pytest.raises(InputError, match="no colour matrix in the frame"):
        colour.with_melanopic(own, replace(colours, matrix=None), PROFILE, 1.0, 5500.0)


@pytest.mark.analytic
def test_a_grey_surface_in_daylight_gives_the_matrix_its_cameras_gains() -> None:
    gains, y_from_rgb = np.array([1.2, 1.0, 0.85]), CAMERA[1]  # of this camera over its model
    mine = CAMERA / gains
    x, y = daylight_xy(5500.0)
    grey = 40.0 * np.linalg.inv(mine) @ np.array([x, y, 1.0 - x - y])
    found = colour.xyz_from_matrix(np.linalg.inv(CAMERA), y_from_rgb / gains, grey, 5500.0)
    assert found == pytest.approx(mine, rel=1e-9)
    with pytest.raises(ValueError, match="should be grey"):
        colour.xyz_from_matrix(np.linalg.inv(CAMERA), y_from_rgb, grey * [2.0, 1.0, 1.0], 5500.0)


@pytest.mark.property
@pytest.mark.parametrize("seed", range(6))
def test_readings_of_one_colour_do_not_move_the_weights_of_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    grey = np.linalg.inv(CAMERA) @ D65 * np.array([[9.0], [20.0], [40.0], [60.0]])
    rgb = grey * (1.0 + 0.01 * rng.normal(size=(4, 3)))
    places = tuple(Place(Path("x"), i, 0) for i in range(4))
    y = grey @ CAMERA[1] * (1.0 + 0.02 * rng.normal(size=4))
    found = colour.fit(colour.Colours(rgb, y, np.full(4, 0.02), places), PROFILE)
    assert found.y_from_rgb == pytest.approx(PROFILE.colour.y_from_rgb, abs=0.05)


@pytest.mark.contract
def test_a_profile_with_a_melanopic_weight_has_colours() -> None:
    weight = replace(PROFILE.colour, melanopic_from_rgb=(0.1, 0.5, 0.4), melanopic_u_rel=0.03)
    with pytest.raises(InputError, match="melanopic_from_rgb has 3 values"):
        check_profile(replace(PROFILE, colour=weight), "x.toml")
    check_profile(replace(PROFILE, colour=replace(weight, rgb_to_radiance=(1.0,) * 9)), "x.toml")


@pytest.mark.contract
def test_a_jpeg_without_fixed_white_balance_has_no_melanopic_colour(tmp_path: Path) -> None:
    from PIL import Image

    exposure = Exposure(0.01, 5.6)
    write_jpeg(tmp_path / "a.jpg", np.zeros((8, 8, 3), np.uint8), exposure)
    Image.new("RGB", (8, 8)).save(tmp_path / "b.jpg")
    body = replace(PROFILE.camera, kind="jpeg")
    weight = replace(PROFILE.colour, melanopic_from_rgb=(0.1, 0.5, 0.4))
    profile = replace(PROFILE, camera=body, colour=weight)
    fixed, unknown = (Shot(tmp_path / name, exposure) for name in ("a.jpg", "b.jpg"))
    assert floating_white_balance([fixed], profile) == ""
    assert floating_white_balance([fixed, unknown], profile) == "b.jpg"
    assert floating_white_balance([unknown], replace(profile, colour=PROFILE.colour)) == ""


@pytest.mark.contract
def test_glare_states_melanopic_edi_with_its_uncertainty(tmp_path: Path) -> None:
    write_panorama(tmp_path / "a.exr", coloured(D65))
    write_panorama(tmp_path / "b.exr", replace(coloured(D65), attributes={}))
    run = CliRunner().invoke(
        main, ["glare", str(tmp_path / "a.exr"), str(tmp_path / "b.exr"), "--no-lamps", "--json"]
    )
    measured, estimate = (json.loads(line) for line in run.stdout.splitlines())
    assert measured["melanopic_der"] == "colour" and estimate["melanopic_der"] == "D65, assumed"
    view = measured["views"][0]
    assert view["melanopic_edi_lx"] == pytest.approx(view["ev_lx"], rel=0.005)
    assert view["u_melanopic_edi_lx"] == pytest.approx(0.0424 * view["ev_lx"], rel=0.02)
    assert estimate["views"][0]["u_melanopic_edi_lx"] is None
    text = CliRunner().invoke(main, ["glare", str(tmp_path / "a.exr"), "--lamps"])
    assert "by the camera's colour" in text.output


def _jeti(path: Path, spectrum: np.ndarray) -> Path:
    """A file as JETI's programs export it, with two equal lines."""
    values = "; ".join(f"{value:.6E}" for value in spectrum)
    line = f"Date and Time:; 3/20/2027; 09:00:00am; ; Spectral Values (380 nm - 1000 nm); {values}"
    path.write_text(f"{line}\n{line}\n", encoding="latin-1")
    return path


@pytest.mark.authority
def test_a_spectrometers_file_gives_luminance_and_melanopic_light(tmp_path: Path) -> None:
    """Melanopic daylight efficacy ratios of illuminants A and E by the toolbox of CIE S 026."""
    nm = np.arange(380.0, 1001.0)
    planck = 1.0 / (nm**5 * np.expm1(1.435e7 / (2848.0 * nm)))  # CIE 015: illuminant A
    for spectrum, ratio in ((planck, 0.496), (np.full(len(nm), 1e-3), 0.906)):
        y, melanopic = colour.read_spectrum(_jeti(tmp_path / "s.cap", spectrum))
        assert melanopic / y == pytest.approx(ratio, abs=0.001)
    assert y == pytest.approx(683.002 * 1e-3 * 106.857, rel=1e-3)  # the sum of V in steps of 1 nm
    (tmp_path / "no.csv").write_text("wavelength;value\n380;1\n")
    with pytest.raises(InputError, match=r"no spectrum; expected lines with .*; export it again"):
        colour.read_spectrum(tmp_path / "no.csv")
    text = (tmp_path / "s.cap").read_text()
    (tmp_path / "s.cap").write_bytes(text.replace("\n", "\r").encode("utf-16"))
    assert colour.read_spectrum(tmp_path / "s.cap") == pytest.approx((y, melanopic))
    one = "; 1.000000E-03; 1"
    lines = (text.replace(one, f"; {other}; 1", 1) for other in ("x1", "inf", "nan", "1_0"))
    for damaged in (text[: len(text) * 3 // 4], *lines):
        (tmp_path / "cut.cap").write_text(damaged)  # neither stretched nor left out of the mean
        with pytest.raises(InputError, match="for each 1 or 5 nm; export it again"):
            colour.read_spectrum(tmp_path / "cut.cap")


@pytest.mark.contract
def test_spots_with_spectra_are_a_reference_of_melanopic_light(tmp_path: Path) -> None:
    nm = np.arange(380.0, 1001.0)
    picture = np.full((SIZE, SIZE, 3), 200.0)
    raw_frame(tmp_path / "a.dng", picture, Exposure(1 / 60, 5.6), np.random.default_rng(1))
    _jeti(tmp_path / "s.cap", np.full(len(nm), 1e-3))
    table = tmp_path / "spots.csv"
    table.write_text(f"file,x_px,y_px,spectrum\na.dng,{SIZE / 2},{SIZE / 2},s.cap\n")
    read = colour.from_table(table, PROFILE)
    assert read.melanopic is not None
    assert read.melanopic[0] / read.y[0] == pytest.approx(0.906, abs=0.001)
