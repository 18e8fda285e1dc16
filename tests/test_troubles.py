"""Troubles of a simulated campaign: strict files, each does what it says, none does nothing."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from fieldlum import plan, simulate
from fieldlum.errors import InputError
from fieldlum.images import read_panorama
from fieldlum.light import light_at
from fieldlum.profiles import load_site, shipped
from fieldlum.session import Session, create_session
from fieldlum.simulate.troubles import (
    LIMITS,
    Trouble,
    Troubles,
    load_troubles,
    measured_irradiance,
    true_light,
)

SETUP = load_site(shipped("capture_plans") / "seattle-office.toml")
HARD = load_troubles(shipped("capture_plans") / "hard.toml")
SLOTS = plan.make_plan(SETUP, plan.Request("9-day", today=date(2027, 1, 1), year=2027)).slots
WEATHER = simulate.weather_for(SETUP)
TIMES = [slot.t_utc for slot in SLOTS]


def _light():
    found = WEATHER.at(TIMES)
    return light_at(TIMES, SETUP.site, np.nan_to_num(found.dni_wm2), np.nan_to_num(found.dhi_wm2))


@pytest.mark.contract
def test_an_unknown_trouble_is_refused_and_the_known_ones_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "t.toml"
    for text, words in (
        ("[lamp]\nsize = 1\n", "did you mean 'lamps'"),
        ("[gremlins]\nsize = 1\n", "known keys"),
        ("[lamps]\nseed = 1\n", "no 'size'"),
        ("[lamps]\nsize = 1\ncolour = 2\n", "unknown key 'colour'"),
        ("[blind]\nsize = 1.5\n", r"\[blind\] size = 1.5"),
        ("[lamps]\nsize = -1\n", "0 to 1000"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=words):
            load_troubles(path)
    assert set(HARD.names) == set(LIMITS)
    assert HARD.only("lamps").names == ("lamps",) and HARD.key != HARD.seeded(1).key


@pytest.mark.analytic
def test_north_and_clock_move_the_sun_as_stated() -> None:
    light = _light()
    north = true_light(light, Troubles(north=Trouble(0.7)), SETUP.site)
    np.testing.assert_allclose(light.sun_azimuth_deg - north.sun_azimuth_deg, 0.7)
    clock = true_light(light, Troubles(clock_drift=Trouble(2.0)), SETUP.site)
    moved = np.abs(clock.sun_azimuth_deg - light.sun_azimuth_deg)
    assert moved[0] < 1e-6 and 0.0 < moved.max() < 2.0


@pytest.mark.property
def test_clouds_keep_the_diffuse_illuminance_and_pass_through_slices() -> None:
    light = _light()[np.array([5, 40, 90])]
    cloudy = true_light(light, Troubles(clouds=Trouble(0.4, 3)), SETUP.site)
    np.testing.assert_allclose(cloudy.diffuse_lx, light.diffuse_lx, rtol=1e-3)
    ratio = np.log(cloudy.sky_cdm2 / light.sky_cdm2)
    up = light.sky_cdm2 != cloudy.sky_cdm2
    assert 0.25 < ratio[up].std() < 0.55
    np.testing.assert_array_equal(cloudy[[1]].sky_cdm2[0], cloudy.sky_cdm2[1])


@pytest.mark.analytic
def test_the_instrument_drifts_is_shaded_and_is_far_away() -> None:
    light = _light()
    given = light.t_utc, light.dni_wm2, light.dhi_wm2, light.sun_altitude_deg
    dni, dhi = measured_irradiance(*given, Troubles(instrument_drift=Trouble(0.1)))
    assert dhi[0] == pytest.approx(light.dhi_wm2[0])
    assert dhi[-1] == pytest.approx(1.1 * light.dhi_wm2[-1])
    dni, _ = measured_irradiance(*given, Troubles(horizon=Trouble(5.0)))
    assert (dni[light.sun_altitude_deg < 5.0] == 0.0).all()
    dni, dhi = measured_irradiance(*given, Troubles(distant_instrument=Trouble(500.0, 2)))
    high = (light.sun_altitude_deg > 10.0) & (light.dni_wm2 > 50.0)
    rise = np.sin(np.radians(light.sun_altitude_deg))
    np.testing.assert_allclose(
        (dni * rise + dhi)[high], (light.dni_wm2 * rise + light.dhi_wm2)[high], rtol=1e-6
    )
    assert np.abs(np.log(dni[high] / light.dni_wm2[high])).mean() > 0.05


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("coefficients")


def _run(out: Path, cache: Path, troubles: Troubles | None) -> Session:
    session = create_session(out, SETUP, SLOTS[2::9], {"set": "test"})
    simulate.run(
        session, WEATHER, height=16, quality="draft", troubles=troubles, cache=cache, workers=1
    )
    return session


def _maps(session: Session) -> np.ndarray:
    with session.pairs.open(encoding="utf-8") as file:
        paths = [row["panorama"] for row in csv.DictReader(file) if row["ok"] == "1"]
    return np.stack([read_panorama(session.root / path).luminance_cdm2 for path in paths])


@pytest.mark.property
def test_every_trouble_changes_the_campaign_and_none_changes_nothing(
    tmp_path: Path, cache: Path
) -> None:
    clean = _run(tmp_path / "clean", cache, None)
    same = _run(tmp_path / "same", cache, Troubles())
    maps, pairs = _maps(clean), clean.pairs.read_text()
    np.testing.assert_array_equal(maps, _maps(same))
    loud = replace(HARD, people=Trouble(0.9, 1), lamps=Trouble(10.0, 2), clipped=Trouble(4.0, 1))
    for name in ("knock", "lamps", "people", "chair", "exposures", "clipped", "clouds", "north"):
        session = _run(tmp_path / name, cache, loud.only(name))
        assert not np.array_equal(_maps(session), maps), name
        assert session.pairs.read_text() == pairs, name
        assert session.table()["simulation"]["troubles"] == [name]
    for name in ("distant_instrument", "instrument_drift"):
        session = _run(tmp_path / name, cache, loud.only(name))
        assert session.pairs.read_text() != pairs, name
        np.testing.assert_array_equal(_maps(session), maps)
