"""The uncertainty budget of a picture and of a year, against Monte Carlo through the chain."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uncertainties
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.records import U_PERCENT, Flag, Panorama, SunSource
from fieldlum.optics.images import write_panorama
from fieldlum.optics.melanopic import attribute_text
from fieldlum.year.glare.metrics import dgp
from fieldlum.year.glare.picture_glare import glare_answer, panorama_glare
from fieldlum.year.glare.pictures import Picture
from fieldlum.year.glare.standards import DgpUncertainty, dgp_per_scale, exceeded_in_share
from fieldlum.year.glare.uncertainty_budget import (
    CAMERA,
    Budget,
    picture_budget,
    share_of,
    year_budget,
)

SCALE, COLOUR, NOISE = 0.03, 0.01, 0.05
SIZE = (32, 64)


def room(sun: SunSource | None = None) -> Panorama:
    """A grey room with a bright window to the south, with shared and independent errors."""
    light = np.full(SIZE, 150.0, np.float32)
    light[10:16, 26:38] = 6000.0
    u = light * np.float32(np.sqrt(SCALE**2 + COLOUR**2 + NOISE**2))
    text = f"scale={100 * SCALE:g} colour={100 * COLOUR:g}"
    return Panorama(light, 180.0, u, None, None, sun, None, {U_PERCENT: text})


def budget(panorama: Panorama, figure: str, u_heading_deg: float = 1.0) -> Budget:
    budgets = picture_budget(Picture(panorama, None), Path("room"), [180.0], u_heading_deg)
    return next(b for b in budgets if b.figure == figure)


@pytest.mark.analytic
def test_shared_errors_of_a_sum_add_up_and_independent_ones_average() -> None:
    ev = budget(room(), "Ev")
    parts = {source.name: source.contribution / ev.estimate for source in ev.sources}
    assert parts["scale"] == pytest.approx(SCALE, rel=1e-3)
    assert parts["colour"] == pytest.approx(COLOUR, rel=1e-3)
    assert parts["noise, edges and other parts of single pixels"] < NOISE / 4
    assert ev.u == pytest.approx(np.hypot(SCALE, COLOUR) * ev.estimate, rel=0.1)


@pytest.mark.analytic
def test_what_no_lens_saw_is_a_source() -> None:
    """Half of a uniform room unseen: the true Ev was 12 stated u above the estimate."""
    flags = np.zeros(SIZE, np.uint16)
    flags[:, :16] = flags[:, 48:] = Flag.OUTSIDE_LENS
    light = np.where(flags == 0, np.float32(200.0), np.float32(0.0))
    one = Panorama(light, 180.0, 0.03 * light, flags, attributes={U_PERCENT: "scale=3"})
    budgets = picture_budget(Picture(one, None), Path("room"), [240.0, 180.0], 1.0)
    beside, ahead = (b for b in budgets if b.figure == "Ev")
    assert abs(beside.estimate - 200 * np.pi) < 3.5 * beside.u
    unseen = [s for s in beside.sources if s.name == "part of the view that no lens saw"]
    # rectangular from black to the brightest luminance seen, over a quarter of the plane's light
    assert unseen[0].contribution == pytest.approx(50 * np.pi / np.sqrt(12), rel=0.02)
    assert ahead.u < 0.1 * ahead.estimate


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("figure", ["DGP", "Ev"])
def test_the_budget_sums_to_what_monte_carlo_gives(figure: str) -> None:
    sun = SunSource(35.0, 190.0, 300.0, 1.0, "merge")
    scene = room(sun)
    stated = budget(scene, figure)
    assert stated.figure != "DGP" or 0.3 < stated.estimate < 0.9
    rng = np.random.default_rng(3)
    key = {"DGP": "dgp", "Ev": "ev_lx"}[figure]
    drawn = []
    for _ in range(400):
        common = 1 + SCALE * rng.standard_normal() + COLOUR * rng.standard_normal()
        own = 1 + NOISE * rng.standard_normal(SIZE)
        lx = sun.normal_illuminance_lx * common * (1 + 0.05 * rng.standard_normal())
        light = (scene.luminance_cdm2 * common * own).astype(np.float32)
        changed = replace(scene, luminance_cdm2=light, sun=replace(sun, normal_illuminance_lx=lx))
        views = panorama_glare(changed, [180.0 + rng.standard_normal()])["views"]
        drawn.append(views[0][key])
    assert stated.u == pytest.approx(np.std(drawn), rel=0.1)


@pytest.mark.authority
def test_a_peer_of_the_gum_combines_the_same_sources() -> None:
    ev = budget(room(), "Ev", u_heading_deg=0.0)
    peer: Any = ev.estimate
    for source in ev.sources:
        error: Any = uncertainties.ufloat(0.0, max(source.u, 1e-12))
        peer += source.contribution / max(source.u, 1e-12) * error
    assert ev.u == pytest.approx(peer.std_dev, rel=1e-9)


@pytest.mark.analytic
def test_the_budget_of_melanopic_light_with_a_sun_has_the_u_that_glare_states() -> None:
    sun = SunSource(35.0, 190.0, 20_000.0, 1.0, "irradiance")
    scene = room(sun)
    light = np.asarray(scene.luminance_cdm2)
    text = attribute_text(np.array([0.25, 0.6, 0.15]), np.eye(3), 0.03)
    scene = replace(
        scene,
        u_cdm2=light * np.float32(np.hypot(SCALE, COLOUR)),  # no errors of single pixels
        rgb=np.repeat(light[..., None], 3, axis=2),
        attributes={**scene.attributes, "melanopic": text},
    )
    (view,) = panorama_glare(scene, [180.0])["views"]
    edi = budget(scene, "melanopic EDI", u_heading_deg=0.0)
    assert edi.estimate == pytest.approx(view["melanopic_edi_lx"], rel=1e-4)
    assert edi.u == pytest.approx(view["u_melanopic_edi_lx"], rel=0.02)
    answer, _ = glare_answer(Picture(scene, None, lamps=True), Path("room"), [180.0])
    (lit,) = answer["views"]
    edi = picture_budget(Picture(scene, None, lamps=True), Path("room"), [180.0], 0.0)[2]
    assert edi.estimate == pytest.approx(lit["melanopic_edi_lx"], rel=1e-4)
    assert edi.u == pytest.approx(lit["u_melanopic_edi_lx"], rel=0.02)


@pytest.mark.analytic
def test_the_slope_of_dgp_with_the_scale_is_its_derivative() -> None:
    ev, contrast = np.array([300.0, 2000.0, 6000.0]), np.array([1e3, 1e6, 3e7])
    step = 1e-4
    up, down = (dgp(ev * (1 + e), contrast * (1 + e) ** 2) for e in (step, -step))
    slope = dgp_per_scale(dgp(ev, contrast), ev)
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-3)


@pytest.mark.analytic
def test_the_budget_of_a_year_sums_to_monte_carlo() -> None:
    rng = np.random.default_rng(1)
    ev = rng.uniform(200, 6000, (1500, 1))
    values = dgp(ev, ev**2 * 20)
    u_maps = np.full_like(values, 0.02)
    doubt = DgpUncertainty(("seen",), values, values, values[None], u_maps)
    (row,) = year_budget(values, ev, doubt, 3000, np.array([180.0]), {"scale": 0.04})
    slope, drawn = dgp_per_scale(values, ev), []
    for _ in range(800):
        common, own = rng.standard_normal(), rng.standard_normal((1500, 1))
        error = 0.02 * np.sqrt(0.5) * (common + own) + 0.04 * rng.standard_normal() * slope
        drawn.append(exceeded_in_share(np.clip(values + error, 0, 1), 3000)[0])
    assert row.u == pytest.approx(np.std(drawn), rel=0.1)
    assert share_of(CAMERA, [row]) == pytest.approx(row.sources[1].contribution ** 2 / row.u**2)


@pytest.mark.contract
def test_glare_writes_the_budget_as_csv(tmp_path: Path) -> None:
    path, out = tmp_path / "room.exr", tmp_path / "budget.csv"
    write_panorama(path, room())
    arguments = ["glare", str(path), "--view-azimuth", "180", "--budget", str(out)]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    combined = {r["figure"]: float(r["contribution"]) for r in rows if r["source"] == "combined"}
    assert set(combined) == {"DGP", "Ev", "luminance ahead"}
    for figure, u in combined.items():
        parts = [r for r in rows if r["figure"] == figure and r["source"] != "combined"]
        assert sum(float(r["contribution"]) ** 2 for r in parts) == pytest.approx(u**2, rel=2e-3)
        assert sum(float(r["share_percent"]) for r in parts) == pytest.approx(100, rel=1e-2)


@pytest.mark.contract
def test_a_budget_without_uncertain_pixels_is_refused_and_the_others_are_written(
    tmp_path: Path,
) -> None:
    plain, path, out = tmp_path / "plain.exr", tmp_path / "room.exr", tmp_path / "budget.csv"
    write_panorama(plain, replace(room(), u_cdm2=None, attributes={}))
    write_panorama(path, room())
    arguments = ["glare", str(plain), str(path), "--view-azimuth", "180", "--budget", str(out)]
    ran = CliRunner().invoke(main, arguments)
    assert ran.exit_code == 3 and "no uncertainty of its pixels" in ran.output, ran.output
    files = {row["file"] for row in csv.DictReader(out.read_text().splitlines())}
    assert files == {str(path)}
    assert CliRunner().invoke(main, [*arguments, "--calibrate-ev", "900"]).exit_code == 2


@pytest.mark.contract
@pytest.mark.parametrize(
    ("command", "option"),
    [("glare", "--budget"), ("glare", "--csv"), ("view --region cone:180,0,9", "--csv")],
)
def test_no_existing_file_is_replaced_without_force(
    tmp_path: Path, command: str, option: str
) -> None:
    path, out = tmp_path / "room.exr", tmp_path / "pairs.csv"
    write_panorama(path, room())
    out.write_text("t_utc,panorama\n")
    arguments = [*command.split(), str(path), option, str(out)]
    ran = CliRunner().invoke(main, arguments)
    assert ran.exit_code == 3 and "pairs.csv: the file exists already" in ran.output, ran.output
    assert out.read_text() == "t_utc,panorama\n"
    ran = CliRunner().invoke(main, [*arguments, "--force"])
    assert ran.exit_code == 0 and out.read_text() != "t_utc,panorama\n", ran.output


@pytest.mark.analytic
def test_a_sun_in_the_pixels_is_judged_as_glare_judges_it() -> None:
    light = np.kron(room().luminance_cdm2, np.ones((4, 4), np.float32))
    u = 0.05 * light
    light[32, 127:129] = 2e7
    scene = replace(room(), luminance_cdm2=light, u_cdm2=u)
    (view,) = panorama_glare(scene, [180.0])["views"]
    assert budget(scene, "DGP").estimate == pytest.approx(view["dgp"], abs=1e-6)
    assert "illuminance of the sun's disc" in {s.name for s in budget(scene, "Ev").sources}
