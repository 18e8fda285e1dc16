"""Melanopic EDI of a year: the ratio by sky, sun and direction, and its columns."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from learning_room import dataset, write_pairs

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama, Site
from fieldlum.learn import models
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.optics.photometry.melanopic import attribute_text
from fieldlum.session.files.hourly_csv import HOUR_COLUMNS, VIEW_COLUMNS, HourlyFile
from fieldlum.sky.light import Light, light_at
from fieldlum.year.predict.blocks import room_of
from fieldlum.year.predict.melanopic import MelanopicYear, _without_sun, fit_year, has_colour
from fieldlum.year.predict.year import measure

SITE = Site("x", 47.6, -122.3)


def light(count: int, seed: int = 1) -> Light:
    rng = np.random.default_rng(seed)
    times = [datetime(2027, 6, 1, 16, tzinfo=UTC) + timedelta(hours=7 * k) for k in range(count)]
    sunny = rng.uniform(size=count) < 0.5
    return light_at(times, SITE, np.where(sunny, 700.0, 0.0), rng.uniform(60.0, 300.0, count))


@pytest.mark.analytic
def test_the_ratio_of_sky_sun_and_direction_comes_back() -> None:
    hours = light(80)
    up = hours[hours.sun_altitude_deg > 3.0]
    shares = np.random.default_rng(2).uniform(0.0, 0.6, (len(up), 3)) * (up.dni_wm2 > 0)[:, None]
    truth = MelanopicYear(np.array([0.9, 0.4, 0.8]), np.array([1.0, 1.05, 0.95]), 0.0)
    ratio = truth.ratio(up, shares)
    days = [t.toordinal() for t in up.t_utc]
    found = fit_year(up, ratio, shares, days, 0.03)
    assert found.ratio(up, shares) == pytest.approx(ratio, rel=0.03)
    assert 0.03 < found.u_rel < 0.04
    noisy = ratio * np.exp(0.05 * np.random.default_rng(3).normal(size=ratio.shape))
    assert fit_year(up, noisy, shares, days, 0.0).u_rel == pytest.approx(0.05, rel=0.25)


@pytest.mark.analytic
def test_the_visible_sun_has_its_own_colour_and_uncertainty() -> None:
    hours = light(4)
    year = MelanopicYear(np.array([1.0, 0.0, 1.0]), np.ones(1), 0.05)
    views = {"ev_lx": np.full((4, 1), 1500.0), "sun_ev_lx": np.full((4, 1), 500.0)}
    figures = year.figures(hours, np.zeros((4, 1)), views, np.full((4, 1), 0.1))
    of_sun = figures["melanopic_edi_lx"][:, 0] - 1000.0
    assert (of_sun > 0).all() and (of_sun < 0.9 * 500.0).all()
    u = figures["u_melanopic_edi_lx"]
    assert (u > 0.1 * figures["melanopic_edi_lx"]).all()


@pytest.mark.analytic
def test_a_sky_without_its_sun_keeps_its_luminance() -> None:
    hours = light(12)
    shade, up = _without_sun(hours), np.array([[0.0, 0.5, 0.866], [0.0, 0.5, -0.866]])
    with_sun, without = hours.sky_at(up), shade.sky_at(up)
    assert without[:, 0] == pytest.approx(with_sun[:, 0], rel=1e-5)
    assert (without[:, 1] <= with_sun[:, 1] * (1 + 1e-6)).all() and not shade.direct_lx.any()


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
    assert not has_colour(pairs)
    text = attribute_text(np.array([0.2, 0.5, 0.1]), np.eye(3), 0.03)  # 0.8 of white
    for path in tmp_path.glob("m*.exr"):
        light = read_panorama(path).luminance_cdm2
        rgb = np.repeat(light[..., None], 3, axis=2) / 179.0
        white = Panorama(light, data.heading_deg, rgb=rgb, attributes={"melanopic": text})
        write_panorama(path, white)
    room = room_of(models.read_config(tmp_path / "m"), tmp_path / "m")
    found = measure(
        tmp_path / "m",
        room,
        data.light[:6],
        np.array([0.0, 180.0]),
        tmp_path / "y",
        coloured_pairs=pairs if has_colour(pairs) else None,
    )[0]
    edi, ev = found.views["melanopic_edi_lx"], found.views["ev_lx"]
    # the fit expects warmer light of a low sun than these grey pictures have
    assert edi / ev == pytest.approx(0.8, rel=0.15)
    assert np.isnan(found.views["u_melanopic_edi_lx"]).all()  # this model states no error
