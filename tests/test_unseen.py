"""Unseen is not dark: a direction that no lens saw has no class and no number; a partly seen one
has bounds.
"""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_room import dataset
from msgspec import structs

from fieldlum.cli import main
from fieldlum.core.arrays import Mask
from fieldlum.core.records import CameraSetup, Flag, Panorama
from fieldlum.learn import models
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.profiles import coverage_text, load_camera_profile, turning_text
from fieldlum.optics.projection import (
    LensGeometry,
    equirect_rays,
    judged_text,
    seen_by_lenses,
    seen_shares,
    seen_words,
)
from fieldlum.report import sections as annual_page
from fieldlum.year import predict
from fieldlum.year.glare.metrics import (
    brightest_cdm2,
    glare_directions,
    unseen_dgp_bounds,
    view_coverage,
)
from fieldlum.year.glare.picture_glare import picture_glare
from fieldlum.year.glare.pictures import parse_view, picture_views
from fieldlum.year.glare.sources import panorama_views, position_index
from fieldlum.year.predict.year import report_hours, unsure_hours

HEIGHT, HEADING_DEG = 16, 180.0
LENS = LensGeometry((0.0, 0.0), 100.0, 180.0, "equidistant")
SEEN = seen_by_lenses([LENS], [0.0], HEIGHT)


@pytest.mark.analytic
def test_a_half_lens_sees_what_the_cosine_says() -> None:
    seen = seen_by_lenses([LENS], [0.0], 90)
    turn = np.array([0.0, 30.0, 90.0, 150.0, 180.0])
    expected = (1.0 + np.cos(np.radians(turn))) / 2.0
    np.testing.assert_allclose(
        seen_shares(seen, HEADING_DEG, HEADING_DEG + turn), expected, atol=0.01
    )
    assert seen_words(np.array([1.0, 0.97, 0.5, 0.49])) == (
        "seen",
        "partly seen",
        "partly seen",
        "not seen",
    )


@pytest.mark.slow
@pytest.mark.contract
def test_plan_and_doctor_name_directions_before_nine_days_are_spent() -> None:
    profile = load_camera_profile("sim-fisheye")
    text = coverage_text(profile, CameraSetup(profile="sim-fisheye", heading_deg=215.0))
    assert "sees 5" in text and "SW" in text and "headings = [215, 35]" in text, text
    turned = CameraSetup(profile="sim-fisheye", heading_deg=215.0, headings=(215.0, 35.0))
    assert coverage_text(profile, turned) == "" and "a person turns it" in turning_text(turned)
    assert coverage_text(load_camera_profile("sim-dual-fisheye"), CameraSetup()) == ""
    assert judged_text(np.ones((8, 16), bool), 0.0) == ""


@pytest.mark.property
@settings(max_examples=15, deadline=None)
@given(st.floats(0.0, 2e4), st.integers(0, 9))
def test_the_bounds_hold_any_even_light_in_the_unseen_part(level: float, turn: int) -> None:
    azimuths = np.array([HEADING_DEG + 6.0 * turn])
    seen = seen_by_lenses([LENS], [0.0], 64)
    views, of_seen = (panorama_views(64, 128, HEADING_DEG, azimuths, mask) for mask in (None, seen))
    full = np.full((1, 64, 128), 300.0, np.float32)
    full[0, 24:36, 56:72] = 6000.0
    dark = np.where(seen, full, np.float32(0.0))
    filled = np.where(seen, full, np.float32(level))
    truth = glare_directions(filled, views)["dgp"]
    found = glare_directions(dark, of_seen)
    low, high = unseen_dgp_bounds(
        view_coverage(of_seen), found["ev_lx"], found["contrast"], np.array([2e4])
    )
    # The bounds sum sources pixel by pixel, the truth groups them, and levels are sampled.
    assert low[0, 0] - 0.005 <= truth[0, 0] <= high[0, 0] + 0.01


@pytest.mark.analytic
def test_unseen_sources_are_one_or_many() -> None:
    """A small spot counts pixel by pixel, a ring as one source at its centre, the line of sight."""
    rays = equirect_rays(180, 360, HEADING_DEG)
    aside = np.array([-np.sin(np.pi / 3), -np.cos(np.pi / 3), 0.0])  # west of south
    at_spot, ahead = rays @ aside > np.cos(np.radians(10.0)), -rays[..., 1]
    ring = (ahead > 0.0) & (ahead < 0.5)
    spot_sr = 2.0 * np.pi * (1.0 - np.cos(np.radians(10.0)))
    for unseen, expected in (
        (at_spot, spot_sr / float(position_index(np.radians(60.0), 0.0)) ** 2),
        (ring, np.pi),  # sr between 60 and 90 degrees
    ):
        views = panorama_views(180, 360, HEADING_DEG, np.array([HEADING_DEG]), ~unseen)
        assert view_coverage(views).unseen_sources[0] == pytest.approx(expected, rel=0.05)


@pytest.mark.analytic
def test_the_brightest_hundredth_is_of_the_seen_part() -> None:
    image = np.full((1, 64, 128), 100.0, np.float32)
    image[0, 30:36, 60:68] = 5000.0  # 0.6 % of the sphere, 1.2 % of a half
    seen = seen_by_lenses([LENS], [0.0], 64)
    around = np.arange(0.0, 360.0, 36.0)
    for mask, expected in ((seen, 5000.0), (None, 100.0)):
        views = panorama_views(64, 128, HEADING_DEG, around, mask)
        assert brightest_cdm2(image, views)[0] == pytest.approx(expected)


@pytest.mark.contract
def test_glare_of_a_panorama_gives_no_number_for_what_was_not_seen(tmp_path: Path) -> None:
    flags = np.where(SEEN, 0, int(Flag.OUTSIDE_LENS)).astype(np.uint8)
    pixels = np.where(SEEN, np.float32(500.0), np.float32(0.0))
    path = tmp_path / "half.exr"
    write_panorama(path, Panorama(pixels, HEADING_DEG, flags=flags))
    answer: Any = picture_glare(path, (180.0, 240.0, 0.0))
    front, side, back = answer["views"]
    assert front["seen"] == "seen" and front["dgp"] > 0.159
    assert side["seen"] == "partly seen" and side["dgp_low"] <= side["dgp"] <= side["dgp_high"]
    assert back["verdict"] == "not seen" and back["dgp"] is None and back["ev_lx"] is None
    shown = CliRunner().invoke(main, ["glare", str(path), "--view-azimuth", "0"])
    assert (
        shown.exit_code == 0 and "not seen" in shown.output and "imperceptible" not in shown.output
    )


@pytest.fixture(scope="module")
def year(tmp_path_factory: pytest.TempPathFactory) -> predict.Annual:
    """A few days predicted by a model of a camera that saw the southern half."""
    return predicted(tmp_path_factory.mktemp("half"), SEEN)


def predicted(root: Path, seen: Mask) -> predict.Annual:
    whole = dataset(("2027-03-20", "2027-03-21", "2027-06-21"), height=HEIGHT)
    maps = np.where(seen, whole.luminance_cdm2, np.float32(0.0))
    data = replace(whole, luminance_cdm2=maps, seen=seen)
    fitted = models.fit("transport", data, patch="none")
    models.save(root / "transport", fitted, data, patch="none")
    lines = ["month,day,hour,dni_wm2,dhi_wm2"]
    for day in (20, 21):
        lines += [
            f"3,{day},{h + 0.5},{600 * (7 <= h < 17)},{150 * (7 <= h < 17)}" for h in range(24)
        ]
    weather = root / "w.csv"
    weather.write_text("\n".join(lines) + "\n", encoding="ascii")
    return predict.run(root / "transport", weather, out=root / "year")[0]


@pytest.mark.slow
@pytest.mark.contract
def test_a_year_has_no_figure_behind_the_camera(year: predict.Annual) -> None:
    rows = {round(row["azimuth_deg"]): row for row in year.about["protection"]}
    assert rows[180]["seen"] == "seen" and rows[180]["dgp_exceeded"] > 0
    behind = rows[0]
    assert behind["class"] == "not seen" and not behind["certain"]
    assert behind["dgp_exceeded"] is None and set(behind["hours_over"].values()) == {None}
    partly = [row for row in rows.values() if row["seen"] == "partly seen"]
    assert partly and all(row["low"] <= row["dgp_exceeded"] <= row["high"] for row in partly)
    with (year.folder / "hourly.csv").open(encoding="utf-8") as file:
        cells = list(csv.DictReader(file))
    assert all(row["dgp@0"] == row["ev_lx@0"] == row["uniformity@0"] == "" for row in cells)
    assert all(
        float(r["dgp_low@180"]) <= float(r["dgp@180"]) <= float(r["dgp_high@180"]) for r in cells
    )
    assert any("have no result" in note and "0° (N)" in note for note in year.about["notes"])
    again = predict.read_annual(year.folder)
    assert not again.judged[5] and again.judged[0]
    # wide bounds of partly seen directions are no doubt about the fully seen ones
    low, high = again.views["dgp_low"], again.views["dgp_high"].copy()
    high[:, 0] = low[:, 0]  # facing 180, the only fully seen direction
    trusted = again.hours | {"trusted": np.ones(len(again))}
    sure = replace(again, hours=trusted, views=again.views | {"dgp_high": high})
    own = sure.summary.protection
    assert not unsure_hours(sure, own)[1].any()
    rows = [structs.replace(row, seen="partly seen") for row in own]
    assert unsure_hours(sure, rows)[1].any()  # none is fully seen: the others decide


@pytest.mark.slow
@pytest.mark.contract
def test_a_narrow_lens_gives_a_year_without_any_class(tmp_path: Path) -> None:
    narrow = np.zeros_like(SEEN)
    narrow[5:11, 12:20] = True
    year = predicted(tmp_path, narrow)
    assert {row.glare_class for row in year.summary.protection} == {"not seen"}
    assert predict.read_pictures(year.folder).kinds == ()
    assert "No view direction can be judged" in annual_page.best_direction(year)[0]


@pytest.mark.slow
@pytest.mark.contract
def test_the_page_recommends_no_direction_that_was_not_seen(year: predict.Annual) -> None:
    answer, why = annual_page.best_direction(year)
    ends = predict.best_and_worst(year.summary.protection)
    assert ends is not None
    best, worst = ends
    assert "not seen" not in (best.glare_class, worst.glare_class)
    assert (
        annual_page.direction_name(best.azimuth_deg) in answer and "No result for views to" in why
    )
    assert "not seen" in annual_page.polar(year).alt
    table = annual_page.directions_section(year).tables[0]
    assert any(row[1]["text"] == "not seen" and row[3] == "–" for row in table.rows)
    page = annual_page.when_section(year, "America/Los_Angeles").heatmap
    assert page is not None and any("not seen" in name for name in page["directions"])
    azimuths = {kind.split()[-1] for kind, _ in report_hours(year)}
    assert "0" not in azimuths


@pytest.mark.contract
def test_no_direction_at_all_is_said_and_not_drawn(year: predict.Annual) -> None:
    blind = tuple(structs.replace(row, glare_class="not seen") for row in year.summary.protection)
    assert predict.best_and_worst(blind) is None
    nothing = replace(year, summary=structs.replace(year.summary, protection=blind))
    assert "No view direction can be judged" in annual_page.best_direction(nothing)[0]


@pytest.mark.property
@pytest.mark.parametrize("half_deg", [75.0, 67.0])
def test_a_partly_covering_picture_has_bounds_that_hold_the_complete_one(
    half_deg: float, tmp_path: Path
) -> None:
    """A narrow fisheye is bounded as a partly seen panorama is; the 180-degree one is the truth."""
    size, truth = 240, tmp_path / "180.hdr"
    row, column = np.indices((size, size))
    radius_deg = np.hypot(row - size / 2 + 0.5, column - size / 2 + 0.5) * 180.0 / size
    scene = np.where(np.abs(column - 60) < 25, 6000.0, 200.0)
    scene = np.where(radius_deg < 90.0, scene, 0.0)
    view = "-vta -vd 0 -1 0 -vu 0 0 1 -vh {0:g} -vv {0:g}"
    write_radiance_hdr(truth, scene, view=view.format(180.0))
    margin = round(size * (90.0 - half_deg) / 180.0)
    inner = scene[margin : size - margin, margin : size - margin]
    narrow = tmp_path / "narrow.hdr"
    write_radiance_hdr(narrow, inner, view=view.format(180.0 * (size - 2 * margin) / size))
    complete: Any = picture_glare(truth)["views"][0]
    part: Any = picture_glare(narrow)["views"][0]
    assert part["seen"] == "partly seen" and "dgp_low" not in complete
    assert part["dgp_low"] <= part["dgp"] <= part["dgp_high"]
    assert part["dgp_low"] <= complete["dgp"] <= part["dgp_high"]
    table = tmp_path / "glare.csv"
    done = CliRunner().invoke(main, ["glare", str(narrow), "--csv", str(table)])
    shown = [f"{part[name]:.3f}" for name in ("dgp", "dgp_low", "dgp_high")]
    assert done.exit_code == 0 and shown == re.findall(r" (0\.\d+)", done.output)[:3], done.output
    with table.open() as file:
        cells = next(iter(csv.DictReader(file)))
    assert float(cells["dgp_high"]) == pytest.approx(part["dgp_high"])
    assert float(cells["seen_share"]) == pytest.approx(part["seen_share"])


@pytest.mark.contract
def test_a_narrow_dim_picture_has_a_grade_for_each_bound(tmp_path: Path) -> None:
    path = tmp_path / "half.hdr"
    scene = np.full((200, 200), 300.0)
    scene[60:90, 80:120] = 6000.0
    write_radiance_hdr(path, scene, view="-vta -vd 0 -1 0 -vu 0 0 1 -vh 135 -vv 135")
    view: Any = picture_glare(path)["views"][0]
    assert view["dgp"] < 0.35 < view["dgp_high"]
    assert view["verdict"].startswith("imperceptible to ")


@pytest.mark.analytic
def test_the_unseen_part_of_a_picture_completes_the_hemisphere() -> None:
    """Analytic: seen and unseen illuminance add up to pi, whatever the mapping."""
    for options in ("-vta -vh 140 -vv 140", "-vtv -vh 100 -vv 80", "-vth -vh 120 -vv 120"):
        view = parse_view(f"{options} -vd 0 -1 0 -vu 0 0 1", Path("x"))
        coverage = view_coverage(picture_views(view, 200, 200))
        share = float(coverage.seen_share[0])
        assert coverage.unseen_illuminance[0] == pytest.approx((1.0 - share) * np.pi, rel=1e-3)
    view = parse_view("-vta -vd 0 -1 0 -vh 180 -vv 180", Path("x"))
    assert view_coverage(picture_views(view, 200, 200)).words == ("seen",)
