"""Single pictures: VIEW headers, contrast figures, the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from radiance_header import add_lines

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama, SunSource
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.year.glare.metrics import (
    local_contrast,
    rammg,
    region_ratios,
    region_weights,
)
from fieldlum.year.glare.picture_glare import panorama_glare, picture_glare
from fieldlum.year.glare.pictures import FISHEYE_VIEW, panorama_to_fisheye, parse_view, read_picture
from fieldlum.year.glare.sources import panorama_views

SOUTH = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"


@pytest.fixture
def maps() -> np.ndarray:
    image = np.full((90, 180), 200.0, np.float32)
    image[35:48, 80:100] = 6000.0
    return image


@pytest.fixture
def panorama(tmp_path: Path, maps: np.ndarray) -> Path:
    path = tmp_path / "p.exr"
    write_panorama(path, Panorama(maps, 180.0, sun=SunSource(30.0, 200.0, 20_000.0)))
    return path


def _fisheye(path: Path, maps: np.ndarray, view: str = SOUTH, size: int = 300) -> Path:
    write_radiance_hdr(path, panorama_to_fisheye(maps, 180.0, 180.0, size=size), view=view)
    return path


# ----------------------------------------------------------------------------------------------
# pictures


@pytest.mark.property
def test_a_fisheye_and_its_panorama_agree(tmp_path: Path, maps: np.ndarray) -> None:
    panorama = tmp_path / "p.hdr"
    write_radiance_hdr(panorama, maps, heading_deg=180.0)
    a = picture_glare(panorama, [180.0])["views"][0]
    b = picture_glare(_fisheye(tmp_path / "f.hdr", maps))["views"][0]
    assert b["azimuth_deg"] == pytest.approx(180.0)
    assert b["ev_lx"] == pytest.approx(a["ev_lx"], rel=0.005)
    assert b["dgp"] == pytest.approx(a["dgp"], abs=0.003)


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("kind", ["a", "h", "s"])
def test_a_uniform_fisheye_of_each_mapping_gives_pi_l(tmp_path: Path, kind: str) -> None:
    # analytic: whatever the mapping, a uniform hemisphere has Ev = pi L
    path = tmp_path / "f.hdr"
    write_radiance_hdr(path, np.full((240, 240), 100.0), view=SOUTH.replace("-vta", f"-vt{kind}"))
    answer = picture_glare(path)
    assert answer["covered_share"] == pytest.approx(1.0, abs=0.01)
    assert answer["views"][0]["ev_lx"] == pytest.approx(100 * np.pi, rel=0.01)


@pytest.mark.contract
def test_a_perspective_picture_says_that_it_covers_little(tmp_path: Path) -> None:
    path = tmp_path / "v.hdr"
    write_radiance_hdr(path, np.full((90, 90), 100.0), view="-vtv -vd 0 -1 0 -vh 60 -vv 60")
    answer = picture_glare(path)
    tan = np.tan(np.radians(30))
    omega = 4 * np.arcsin(np.sin(np.arctan(tan)) ** 2)  # analytic: solid angle of a square pyramid
    assert answer["covered_share"] == pytest.approx(omega / (2 * np.pi), rel=0.02)
    assert "Ev is a lower bound" in answer["warnings"][0]
    assert answer["views"][0]["seen"] == answer["views"][0]["verdict"] == "not seen"
    assert answer["disturbed_share"] is None


@pytest.mark.contract
def test_a_disc_left_in_a_rendering_becomes_the_sun(tmp_path: Path, maps: np.ndarray) -> None:
    lit = maps.copy()
    omega = equirect_solid_angles(90, 180)
    lit[30, 92] += 50_000.0 / omega[30, 92]
    path = tmp_path / "p.hdr"
    write_radiance_hdr(path, lit, heading_deg=180.0)
    sun = picture_glare(path, [180.0])["sun"]
    assert sun is not None
    assert sun["normal_illuminance_lx"] == pytest.approx(50_000, rel=0.02)
    assert (sun["altitude_deg"], sun["azimuth_deg"]) == pytest.approx((29.0, 185.0), abs=0.2)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("view", "said"),
    [
        ("", "no VIEW"),
        ("-vta -vh 180 -vv 90", "width over height"),
        ("-vtv -vh 180 -vv 180", "-vtv"),
        ("-vtl -vh 180 -vv 180", "view type -vtl"),
        ("-vh 180 -vv 180", "without a view type"),
        ("-vta -vd 0 0 1 -vu 0 0 1 -vh 180 -vv 180", "-vd and -vu are parallel"),
        ("-vta -vd 0 0 0 -vh 180 -vv 180", "not all 0"),
        ("-vta -vh nan -vv 180", "a number"),
        ("-vta -vh 180 -vv 180 -vs x", "a number"),
    ],
)
def test_a_missing_or_contradictory_view_is_refused(
    tmp_path: Path, maps: np.ndarray, view: str, said: str
) -> None:
    path = _fisheye(tmp_path / "f.hdr", maps, view)
    with pytest.raises(InputError, match=said):
        picture_glare(path)


@pytest.mark.contract
def test_two_views_and_a_panorama_with_a_view_are_refused(tmp_path: Path, maps: np.ndarray) -> None:
    path = tmp_path / "two.hdr"
    write_radiance_hdr(path, maps[:, :90], view=FISHEYE_VIEW)
    add_lines(path, "VIEW= -vtv -vh 60 -vv 60")
    with pytest.raises(InputError, match="one VIEW"):
        read_picture(path)
    write_radiance_hdr(path, maps, heading_deg=180.0, view=FISHEYE_VIEW)
    with pytest.raises(InputError, match="FIELDLUM_VIEW"):
        read_picture(path)


@pytest.mark.analytic
def test_view_directions() -> None:
    view = parse_view("-vta -vp 1 2 3 -vd 1 0 0 -vu 0 0 1 -vh 180 -vv 180 -vo 0 -va 0", Path("x"))
    assert view.azimuth_deg == pytest.approx(90.0)
    assert view.altitude_deg == pytest.approx(0.0)


@pytest.mark.contract
def test_a_merged_fisheye_faces_its_heading_and_keeps_its_sun(tmp_path: Path) -> None:
    path = tmp_path / "f.exr"
    pixels = np.full((200, 200), 100.0, np.float32)
    flags = np.zeros((200, 200), np.uint16)
    corner = np.hypot(*(np.mgrid[:200, :200] - 99.5)) > 100
    pixels[corner], flags[corner] = np.nan, Flag.OUTSIDE_LENS
    sun = SunSource(20.0, 140.0, 3e4)
    write_panorama(path, Panorama(pixels, 150.0, flags=flags, sun=sun), view="-vta -vv 186 -vh 186")
    answer = picture_glare(path)
    assert answer["views"][0]["azimuth_deg"] == pytest.approx(150.0)
    cosine = np.cos(np.radians(20)) * np.cos(np.radians(10))
    assert answer["views"][0]["ev_lx"] == pytest.approx(100 * np.pi + 3e4 * cosine, rel=0.01)


@pytest.mark.contract
def test_directions_that_no_lens_saw_are_said(tmp_path: Path, maps: np.ndarray) -> None:
    path = tmp_path / "p.exr"
    flags = np.zeros(maps.shape, np.uint16)
    flags[-9:] = Flag.OUTSIDE_LENS
    pixels = np.where(flags > 0, np.nan, maps).astype(np.float32)
    write_panorama(path, Panorama(pixels, 180.0, flags=flags))
    assert "no lens saw" in picture_glare(path)["warnings"][0]
    write_panorama(path, Panorama(pixels, 180.0))
    with pytest.raises(InputError, match="infinite or missing"):
        picture_glare(path)


# ----------------------------------------------------------------------------------------------
# contrast


@pytest.mark.analytic
def test_rammg_of_one_step() -> None:
    # analytic: an edge in the middle of the full-size level; the neighbours across it weigh 1 + 2 /
    # sqrt(2).
    image = np.zeros((20, 40))
    image[:, 20:] = 10.0
    share = (1 + np.sqrt(2)) / (4 + 2 * np.sqrt(2))
    contrast = local_contrast(image)
    assert contrast[5, 19] == pytest.approx(10 * share)
    assert contrast[0].max() == 0.0
    assert local_contrast(image).mean() == pytest.approx(10 * share * 2 * 18 / 800)


@pytest.mark.analytic
def test_rammg_of_columns_is_that_of_the_first_of_five_levels() -> None:
    # Half as many rows and columns average one bright and one dark column to the same grey.
    image = np.zeros((64, 64))
    image[:, ::2] = 10.0
    assert rammg(image) == pytest.approx(local_contrast(image).mean() / 5)


@pytest.mark.property
def test_rammg_scales_with_luminance(maps: np.ndarray) -> None:
    assert rammg(7 * maps) == pytest.approx(7 * rammg(maps))


@pytest.mark.analytic
def test_regions() -> None:
    views = panorama_views(90, 180, 180.0, [180.0, 0.0])
    flat = region_ratios(np.full((1, 90, 180), 50.0, np.float32), region_weights(views))
    assert flat["uniformity"] == pytest.approx(1.0, rel=1e-4)
    assert flat["task_cdm2"] == pytest.approx(50.0, rel=1e-4)
    assert np.isnan(flat["window_to_task"]).all()
    window = np.full((1, 90, 180), 50.0, np.float32)
    window[0, 30:40, 80:100] = 6000.0  # above the task cone
    ratio = region_ratios(window, region_weights(views))["window_to_task"][0]
    assert ratio == pytest.approx([120.0, np.nan], rel=1e-4, nan_ok=True)


# ---------------------------------------------------------------------------------------------- the
# command


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_speaks_json_lines_and_a_table(
    panorama: Path, tmp_path: Path, maps: np.ndarray
) -> None:
    fisheye = _fisheye(tmp_path / "f.hdr", maps)
    done = CliRunner().invoke(main, ["glare", str(panorama), str(fisheye), "--json"])
    assert done.exit_code == 0, done.output
    first, second = (json.loads(line) for line in done.stdout.splitlines())
    assert (len(first["views"]), len(second["views"])) == (10, 1)
    assert first["sun"]["normal_illuminance_lx"] == pytest.approx(20_000)
    shown = CliRunner().invoke(main, ["glare", str(panorama), "--view-azimuth", "180"])
    assert shown.exit_code == 0
    assert "\n        180.0  " in shown.stdout


@pytest.mark.contract
def test_bad_input_is_one_line_and_exit_3(tmp_path: Path, maps: np.ndarray) -> None:
    path = _fisheye(tmp_path / "f.hdr", maps, "")
    done = CliRunner().invoke(main, ["glare", str(path)])
    assert done.exit_code == 3
    assert done.stderr.count("\n") == 1
    assert '--view "-vta' in done.stderr
    assert CliRunner().invoke(main, ["glare", str(tmp_path / "none.hdr")]).exit_code == 3
    assert (
        CliRunner()
        .invoke(main, ["glare", str(_fisheye(path, maps)), "--view-azimuth", "90"])
        .exit_code
        == 3
    )
    assert CliRunner().invoke(main, ["glare", str(path), "--view-azimuth", "nan"]).exit_code == 2


@pytest.mark.slow
@pytest.mark.contract
def test_a_view_without_a_direction_says_that_north_is_a_guess(
    tmp_path: Path, maps: np.ndarray
) -> None:
    """A fisheye of a hand-written VIEW is right in its glare, and must not seem to
    know where it looks.
    """
    told = picture_glare(_fisheye(tmp_path / "a.hdr", maps))
    bare = picture_glare(_fisheye(tmp_path / "b.hdr", maps, "-vta -vh 180 -vv 180"))
    assert not any("-vd" in text for text in told["warnings"])
    assert any("-vd" in text for text in bare["warnings"])
    assert bare["views"][0]["dgp"] == pytest.approx(told["views"][0]["dgp"], abs=2e-3)


@pytest.mark.contract
@pytest.mark.parametrize(("level_cdm2", "count"), [(100.0, 1), (150.0, 0)])
def test_a_dark_picture_is_reported(tmp_path: Path, level_cdm2: float, count: int) -> None:
    """A uniform hemisphere of L cd/m2 gives pi L: 314 lx is below the limit, 471 lx above."""
    path = tmp_path / "f.hdr"
    write_radiance_hdr(path, np.full((60, 60), level_cdm2), view=SOUTH)
    warnings = picture_glare(path)["warnings"]
    assert sum("below 380 lx a DGP may be too low; if" in text for text in warnings) == count
    scaled = picture_glare(path, measured_ev_lx=200.0)["warnings"]
    assert any("Ev is at most 200 lx" in text for text in scaled)
    assert not any("--calibrate-ev" in text for text in scaled)  # the user just did that


@pytest.mark.contract
def test_more_light_than_the_sun_gives_is_reported(tmp_path: Path) -> None:
    """A picture whose pixels are in cd/m2 instead of W/sr/m2 is 179 times too bright."""
    for level_cdm2, count in ((4_000.0, 0), (4_000.0 * 179.0, 1)):
        path = tmp_path / "f.hdr"
        write_radiance_hdr(path, np.full((60, 60), level_cdm2), view=SOUTH)
        warnings = picture_glare(path)["warnings"]
        assert sum("more than sun and sky give" in text for text in warnings) == count


@pytest.mark.contract
def test_a_metric_of_the_registry_is_in_every_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """One entry is enough for `glare --json`, `glare --csv` and a year."""
    from fieldlum.cli.glare_command import csv_rows
    from fieldlum.year.glare import metrics

    metric = metrics.Metric(lambda view: view.ev_lx / 1000.0, in_year=True)
    monkeypatch.setitem(metrics.METRICS, "ev_klx", metric)
    panorama = Panorama(np.full((16, 32), 300.0, np.float32), 180.0)
    answer = panorama_glare(panorama, [90.0])
    view = answer["views"][0]
    assert view["ev_klx"] == pytest.approx((view["ev_lx"] or 0.0) / 1000.0)
    assert "ev_klx" in csv_rows(answer)[0]


@pytest.mark.contract
def test_the_view_option_makes_a_picture_of_another_program_a_panorama(
    tmp_path: Path, maps: np.ndarray
) -> None:
    """OpenCV writes no FIELDLUM_VIEW line."""
    path, stated, out = tmp_path / "cv.hdr", tmp_path / "p.hdr", tmp_path / "v.png"
    write_radiance_hdr(path, maps)
    write_radiance_hdr(stated, maps, heading_deg=90.0)
    with pytest.raises(InputError, match='--view "equirect heading_deg=180" for a panorama'):
        picture_glare(path)
    views = picture_glare(stated, (120.0,))["views"]
    for text in ("equirect heading_deg=90", "FIELDLUM_VIEW= equirect heading_deg=90.0"):
        assert picture_glare(path, (120.0,), view_options=text)["views"] == views
    shown = CliRunner().invoke(main, ["view", str(path), "--out", str(out), "--view", text])
    assert shown.exit_code == 0 and out.is_file(), shown.output


@pytest.mark.contract
def test_a_view_that_is_not_complete_is_not_scaled_by_its_illuminance(tmp_path: Path) -> None:
    """Measured over seen light would make all luminances a third too high."""
    path = tmp_path / "f.hdr"
    write_radiance_hdr(path, np.full((60, 60), 100.0), view=SOUTH.replace("180", "120"))
    with pytest.raises(InputError, match="16 % of the first view is not in the picture"):
        picture_glare(path, measured_ev_lx=200.0)


@pytest.mark.authority
def test_the_disc_in_a_fisheye_is_no_window(tmp_path: Path) -> None:
    """Window over task luminance and uniformity are those of the panorama without its disc."""
    light = np.full((90, 180), 300.0, np.float32)
    light[20:45, 75:105] = 4000.0
    sun = SunSource(30.0, 185.0, 60_000.0)
    write_panorama(tmp_path / "p.exr", Panorama(light, 180.0, sun=sun))
    shown = panorama_to_fisheye(light, 180.0, 180.0, size=900, sun=sun)
    write_radiance_hdr(tmp_path / "f.hdr", shown, view=SOUTH)
    whole = picture_glare(tmp_path / "p.exr", [180.0])["views"][0]
    of_fisheye = picture_glare(tmp_path / "f.hdr")["views"][0]
    for name in ("window_to_task", "uniformity"):
        assert of_fisheye[name] == pytest.approx(whole[name], rel=0.03)
