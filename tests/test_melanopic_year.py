"""Melanopic EDI of a year: the ratio by sky, sun and direction, and its columns."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from learning_room import dataset, write_pairs

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama, Site
from fieldlum.learn import models
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.optics.melanopic import LAMP_RATIO, U_SUN_RATIO, attribute_text, ratio_u_rel
from fieldlum.session.files.hourly_csv import HOUR_COLUMNS, VIEW_COLUMNS, HourlyFile
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.light_similarity import facades_of
from fieldlum.year.glare.standards import year_errors
from fieldlum.year.predict.hour_blocks import predict_figures, room_of
from fieldlum.year.predict.melanopic import (
    ENOUGH_HOURS,
    MelanopicYear,
    YearHours,
    _parts,
    _without_sun,
    digests,
    edi_budget,
    fit_year,
    year_of_captures,
)

SITE = Site("x", 47.6, -122.3)


def light(count: int, seed: int = 1) -> Light:
    rng = np.random.default_rng(seed)
    times = [datetime(2027, 6, 1, 16, tzinfo=UTC) + timedelta(hours=7 * k) for k in range(count)]
    sunny = rng.uniform(size=count) < 0.5
    return light_at(times, SITE, np.where(sunny, 700.0, 0.0), rng.uniform(60.0, 300.0, count))


def eye(hours: Light) -> tuple[Floats, Floats]:
    """Light at the eye in two directions, of sky and of sun, [n, 2]: one has the sun in front."""
    sky, sun = hours.diffuse_lx[:, None], hours.direct_lx[:, None]
    ahead = np.maximum(hours.sun_direction @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]).T, 0.0)
    return sky * np.array([0.05, 0.02]), sun * (0.004 + 0.01 * ahead)


def mixture(hours: Light, weights: Floats, factors: Floats, lamp_lx: Floats) -> tuple[Floats, ...]:
    """Light at the eye, its ratio, and the shares of sun and lamps, [n, 2] each."""
    sky, sun = eye(hours)
    whole = sky + sun + lamp_lx[:, None]
    shares = sun / whole, lamp_lx[:, None] / whole
    return whole, np.einsum("ndk,k,d->nd", _parts(hours, *shares), weights, factors), *shares


def coloured(
    hours: Light, weights: Floats, factors: Floats, seed: int = 0, lamp_lx: float = 0.0
) -> MelanopicYear:
    """A fit to captures whose sky and sun have known colours; with noise if there is a seed."""
    on = np.array([text == "lamp=on" for text in hours.states or ("",) * len(hours)])
    whole, ratio, *_ = mixture(hours, weights, factors, lamp_lx * on)
    if seed:
        ratio = ratio * np.exp(0.05 * np.random.default_rng(seed).normal(size=ratio.shape))
    u_camera = {"scale": 0.0 if seed else 0.03}
    return fit_year(hours, whole, whole * ratio, u_camera, facades_of(None))


@pytest.mark.analytic
def test_the_ratio_of_sky_sun_and_direction_comes_back() -> None:
    hours = light(80)
    up = hours[hours.sun_altitude_deg > 3.0]
    weights, factors = np.array([0.9, 0.4, 0.8, 0.6]), np.array([1.0, 1.05])
    found = coloured(up, weights, factors)
    _, ratio, sun, _ = mixture(up, weights, factors, np.zeros(len(up)))
    np.testing.assert_allclose(found.shares(up)[0], sun, atol=0.05)
    assert not found.shares(up)[1].any()
    assert np.std(found.ratio(up) / ratio - 1.0) < 0.02
    assert 0.03 < found.u_rel < 0.04
    assert coloured(up, weights, factors, seed=3).u_rel == pytest.approx(0.05, rel=0.25)


@pytest.mark.analytic
def test_lamps_have_their_own_ratio_and_uncertainty() -> None:
    hours = light(160)
    up = hours[hours.sun_altitude_deg > 3.0]
    up = replace(up, states=tuple(("lamp=on", "")[k % 2] for k in range(len(up))))
    weights, factors = np.array([1.0, 0.2, 0.9, 0.5]), np.array([1.0, 1.05])
    found = coloured(up, weights, factors, lamp_lx=500.0)
    lit = np.arange(len(up)) % 2 == 0
    whole, ratio, _, lamp = mixture(up, weights, factors, 500.0 * lit)
    assert np.abs(found.shares(up)[1] - lamp).mean() < 0.03
    assert np.std(found.ratio(up) / ratio - 1.0) < 0.04
    views, none = {"ev_lx": whole, "sun_ev_lx": 0.0 * whole}, 0.0 * whole
    stated = replace(up, states=tuple(("lamp=on", "lamp=off")[k % 2] for k in range(len(up))))
    figures = found.figures(stated, views, none, whole[None], none)
    factor = figures["melanopic_edi_lx"] / whole / found.ratio(up)
    assert factor == pytest.approx(np.where(lit, LAMP_RATIO, 1.0)[:, None] + none)  # as `glare`
    u_lamp = figures["edi_by_lamps_lx"] / figures["edi_of_map_lx"]
    assert u_lamp[lit] == pytest.approx(ratio_u_rel(found.ratio(up), 0.0)[lit])  # counted once
    assert not u_lamp[~lit].any()
    of_all = [*found.u_camera_rel.values(), found.u_fit_rel]
    u = figures["u_melanopic_edi_lx"] / figures["edi_of_map_lx"]
    assert u == pytest.approx(np.sqrt(u_lamp**2 + np.sum(np.square(of_all))))
    unmarked = found.figures(up, views, none, whole[None], none)
    assert (unmarked["edi_by_lamps_lx"] >= figures["edi_by_lamps_lx"]).all()  # a lamp may be on


@pytest.mark.analytic
def test_the_visible_sun_has_its_own_colour_and_uncertainty() -> None:
    hours = replace(light(4), states=("lamp=off",) * 4)
    year = coloured(hours, np.array([1.0, 0.0, 1.0, 0.6]), np.ones(2))
    views = {"ev_lx": np.full((4, 2), 1500.0), "sun_ev_lx": np.full((4, 2), 500.0)}
    ev, none = views["ev_lx"], np.zeros((4, 2))
    figures = year.figures(hours, views, np.full((4, 2), 0.1), ev[None], none)
    of_sun = figures["melanopic_edi_lx"] - 1000.0 * year.ratio(hours)
    assert (of_sun > 0).all() and (of_sun < 0.9 * 500.0).all()
    u = figures["u_melanopic_edi_lx"]
    assert (u > 0.1 * 1000.0 * year.ratio(hours)).all()
    hidden = year.figures(hours, views, none, np.stack([ev, ev - 500.0]), none)
    assert (hidden["u_melanopic_edi_lx"] > 0.7 * of_sun).all()  # the disc is seen or not
    half_seen = year.figures(hours, views, none, ev[None], ev)
    assert (half_seen["u_melanopic_edi_lx"] > 0.5 * 1500.0 * year.ratio(hours)).all()


@pytest.mark.analytic
def test_a_sky_without_its_sun_keeps_its_luminance() -> None:
    hours = light(12)
    shade, up = _without_sun(hours), np.array([[0.0, 0.5, 0.866], [0.0, 0.5, -0.866]])
    with_sun, without = hours.sky_at(up), shade.sky_at(up)
    assert without[:, 0] == pytest.approx(with_sun[:, 0], rel=1e-5)
    assert (without[:, 1] <= with_sun[:, 1] * (1 + 1e-6)).all() and not shade.direct_lx.any()


@pytest.mark.analytic
def test_a_share_of_no_day_is_unknown() -> None:
    """Weather of afternoons alone: the shares of days from 09:00 to 13:00 were 0 %."""
    summary = PredictFile(known=(2082, 0))
    hours = YearHours.of([datetime(2027, 1, 1, 21, 30, tzinfo=UTC)], "UTC", summary)
    shares = hours.shares(np.full((1, 1), 500.0))
    assert [name for name, share in shares.items() if np.isfinite(share[0])] == [ENOUGH_HOURS]


@pytest.mark.analytic
def test_the_budget_of_the_year_sums_to_monte_carlo_through_the_chain() -> None:
    """Errors drawn in maps, ratio, camera and disc, through EDI to shares of hours and days."""
    rng = np.random.default_rng(5)
    start = datetime(2027, 1, 1, 0, 30, tzinfo=UTC)
    times = [start + timedelta(hours=k) for k in range(8760)]
    dni = np.where(rng.uniform(size=8760) < 0.4, 600.0, 0.0)
    every = light_at(times, SITE, dni, rng.uniform(20.0, 300.0, 8760))
    hours = every[every.sun_altitude_deg > 0.0]
    day = YearHours.of(hours.t_utc, "America/Los_Angeles", PredictFile(days=365))
    captures = light(80)
    captures = captures[captures.sun_altitude_deg > 3.0]
    year = coloured(captures, np.array([1.0, 0.2, 0.9, 0.6]), np.ones(2))
    year = replace(year, u_fit_rel=0.06, u_camera_rel={"scale": 0.04, "melanopic weight": 0.025})
    sky, sun = eye(hours)
    sky, disc = 0.6 * sky, sun * (rng.uniform(size=sun.shape) < 0.3)
    views = {"ev_lx": sky + disc, "sun_ev_lx": disc}
    u_map, seen = np.full(sky.shape, 0.12), rng.uniform(size=64) < 0.7
    drawn = np.array([sky + disc * on for on in seen])
    figures = year.figures(hours, views, u_map, drawn, np.zeros(sky.shape))
    budgets = edi_budget(year, figures, day, np.array([0.0, 90.0]))
    assert len(budgets) == 2 * 5 and all(len(b.sources) == 9 for b in budgets)
    of_map = figures["edi_of_map_lx"]
    of_sun, shares = figures["melanopic_edi_lx"] - of_map, []
    for k in range(600):
        model, fit = (year_errors(sky.shape, rng) for _ in range(2))
        scale, weight, lx, air = rng.standard_normal(4) * (0.04, 0.025, 0.05, U_SUN_RATIO)
        edi = of_map * (1 + 0.12 * model) * (1 + 0.06 * fit) * (1 + scale) * (1 + weight)
        edi += figures["edi_by_lamps_lx"] * rng.standard_normal()
        shares.append(day.shares(edi + of_sun * (1 + lx) * (1 + air) * seen[k % 64]))
    for budget in budgets:
        values = np.array([s[budget.figure][int(budget.azimuth_deg // 90)] for s in shares])
        off = values - budget.estimate
        assert budget.u == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.1), budget
        assert (np.abs(off) <= 1.96 * budget.u).mean() > 0.92, budget


@pytest.mark.contract
def test_columns_of_colour_are_written_only_if_measured(tmp_path: Path) -> None:
    def rows(edi: float) -> HourlyFile:
        views = {name: np.full((1, 1), 1.0) for name in VIEW_COLUMNS}
        views |= {name: np.full((1, 1), edi) for name in ("melanopic_edi_lx", "u_melanopic_edi_lx")}
        hours: dict[str, Floats] = {name: np.ones(1) for name in HOUR_COLUMNS}
        return HourlyFile((datetime(2027, 6, 1, tzinfo=UTC),), np.array([180.0]), hours, views)

    for edi, named in ((np.nan, False), (250.0, True)):
        rows(edi).write(tmp_path, "UTC")
        text = (tmp_path / "hourly.csv").read_text()
        assert (",melanopic_edi_lx@180" in text) == named
        found = HourlyFile.read(tmp_path, np.array([180.0]), 1).views["melanopic_edi_lx"]
        assert found[0, 0] == pytest.approx(edi, nan_ok=True)


@pytest.mark.slow
@pytest.mark.analytic
def test_the_captures_colour_reaches_the_year(tmp_path: Path) -> None:
    data = dataset(("2027-03-20", "2027-06-21"), height=12)
    models.save(tmp_path / "m", models.fit("nearest", data, patch="none"), data)
    pairs = write_pairs(tmp_path, data)
    assert not digests(pairs)
    text = attribute_text(np.array([0.2, 0.5, 0.1]), np.eye(3), 0.03)  # 0.8 of white
    for path in tmp_path.glob("m*.exr"):
        light = read_panorama(path).luminance_cdm2
        rgb = np.repeat(light[..., None], 3, axis=2) / 179.0
        white = Panorama(light, data.heading_deg, rgb=rgb, attributes={"melanopic": text})
        write_panorama(path, white)
    room = room_of(models.read_config(tmp_path / "m"), tmp_path / "m")
    azimuths = np.array([0.0, 180.0])
    colours = year_of_captures(pairs, room, azimuths, {})
    of_scale = year_of_captures(pairs, room, azimuths, {"scale": 0.05})
    assert of_scale.u_rel == pytest.approx(np.hypot(colours.u_rel, 0.05))
    found = predict_figures(tmp_path / "m", room, data.light[:6], azimuths, melanopic=colours)
    edi, ev = found.views["melanopic_edi_lx"], found.views["ev_lx"]
    # the fit expects warmer light of a low sun than these grey pictures have
    assert edi / ev == pytest.approx(0.8, rel=0.15)
    assert np.isnan(found.views["u_melanopic_edi_lx"]).all()  # this model states no error
