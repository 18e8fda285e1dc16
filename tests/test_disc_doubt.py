"""Whether the sun's disc is seen decides glare: scores use the disc that a user gets, intervals
hold what the uncertainty of the room leaves open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldlum.core.records import Room, SiteFile
from fieldlum.learn.models import Prediction
from fieldlum.learn.models.scores import evaluate, summary, truth
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.profiles import shipped
from fieldlum.room.scene import build, disc_visibility
from fieldlum.session.site_toml import load_site
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.visible_disc import disc_lx, disc_source, drawn_discs_lx
from fieldlum.weather import shipped_seattle
from fieldlum.year.glare.metrics import dgp, glare_directions, sun_per_lx, with_disc
from fieldlum.year.glare.sources import panorama_views

SETUP = load_site(shipped("capture_plans") / "seattle-office.toml")
HEADING_DEG, HEIGHT = SETUP.camera.heading_deg, 16
WEATHER = shipped_seattle(SETUP.site).daylight()
HOURS = slice(100, 4300, 7)


def _light() -> Light:
    return light_at(
        WEATHER.t_utc[HOURS], SETUP.site, WEATHER.dni_wm2[HOURS], WEATHER.dhi_wm2[HOURS]
    )


LIGHT = _light()


def _room() -> Room:
    assert SETUP.room is not None
    return SETUP.room


def _turned(degrees: float) -> SiteFile:
    room = replace(_room(), wall_azimuth_deg=_room().wall_azimuth_deg + degrees)
    return replace(SETUP, room=room)


@pytest.mark.analytic
def test_analytic_another_disc_changes_dgp_as_glare_directions_does() -> None:
    maps = np.full((3, HEIGHT, 2 * HEIGHT), 800.0, np.float32)
    suns = LIGHT.apparent_sun_direction[[10, 200, 400]]
    azimuths = np.array([0.0, 90.0, 200.0])
    views = panorama_views(HEIGHT, 2 * HEIGHT, HEADING_DEG, azimuths)
    first, second = np.array([0.0, 3e4, 500.0]), np.array([2e4, 0.0, 800.0])
    found = glare_directions(maps, views, suns, first)
    wanted = glare_directions(maps, views, suns, second)
    np.testing.assert_allclose(
        dgp(*with_disc(found, (sun_per_lx(suns, views), second))), wanted["dgp"], rtol=1e-6
    )


class _Perfect:
    """A model whose maps are the truth."""

    name = "perfect"

    def __init__(self, data: Dataset) -> None:
        self.of = {t: k for k, t in enumerate(data.light.t_utc)}
        self.data = data

    def predict(self, light: Light, patch_cdm2: object = None) -> Prediction:
        rows = [self.of[t] for t in light.t_utc]
        maps = 1.1 * self.data.luminance_cdm2[rows]
        return Prediction(maps, None, np.full(len(rows), 0.004), np.ones(len(rows), bool))


def _data(setup: SiteFile) -> Dataset:
    """Even maps of the hours in which the room's disc may be seen; the disc is the true room's."""
    scene = build(_room())
    visible, through = disc_visibility(scene, scene.to_room(LIGHT.apparent_sun_direction))
    rows = np.flatnonzero((visible > 0) & (LIGHT.dni_wm2 > 100))[::2]
    light = LIGHT[rows]
    maps = np.full((len(rows), HEIGHT, 2 * HEIGHT), 500.0, np.float32)
    return Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=None,
        disc_lx=(visible * through)[rows] * light.direct_lx,
        heading_deg=HEADING_DEG,
        days=np.array([np.datetime64(t.date()) for t in light.t_utc]),
        slots=tuple(str(k) for k in rows),
        setup=setup,
        seen=np.ones((HEIGHT, 2 * HEIGHT), bool),
        steadiness=np.zeros(len(rows)),
    )


@pytest.mark.slow
@pytest.mark.property
def test_a_wrong_north_scores_worse_with_the_disc_of_the_room() -> None:
    """The review's missing test 2: the true disc in the prediction hides a wrong north."""
    rows = {}
    for name, setup in (
        ("right", SETUP),
        ("off", _turned(1.0)),
        ("none", replace(SETUP, room=None)),
    ):
        data = _data(setup)
        rows[name] = summary(evaluate(_Perfect(data), truth(data)))  # type: ignore[arg-type]
    assert rows["off"]["dgp_mse"] == pytest.approx(rows["right"]["dgp_mse"])
    assert rows["right"]["dgp_mse_own_disc"] == pytest.approx(rows["right"]["dgp_mse"], rel=1e-3)
    assert rows["off"]["dgp_mse_own_disc"] > 2.0 * rows["right"]["dgp_mse_own_disc"]
    assert rows["none"]["dgp_mse_own_disc"] is not None
    assert rows["right"]["bias_log10"] == pytest.approx(np.log10(1.1), rel=0.02)
    assert rows["right"]["expected_log10_mse"] == pytest.approx(0.004)
    assert rows["right"]["trusted_share"] == 1.0


@pytest.mark.slow
@pytest.mark.property
def test_without_a_sky_view_the_stated_room_decides_with_the_doubt_of_its_edges() -> None:
    """Draws of the fallback hold the room itself, doubt its edges, and are open without a room."""
    room = disc_lx(None, SETUP, LIGHT)
    drawn = drawn_discs_lx(None, SETUP, LIGHT, np.random.default_rng(1))
    inside = (room >= drawn.min(axis=0) - 1.0) & (room <= drawn.max(axis=0) + 1.0)
    assert inside.mean() > 0.95
    assert (np.ptp(drawn, axis=0) > 0.5 * room)[room > 0].mean() > 0.1
    bare = replace(SETUP, room=None)
    assert (disc_lx(None, bare, LIGHT) == 0.0).all()
    anything = drawn_discs_lx(None, bare, LIGHT, np.random.default_rng(1))
    beam = LIGHT.direct_lx > 0
    assert (anything.max(axis=0)[beam] > 0.8 * LIGHT.direct_lx[beam]).all()
    assert "stated room" in disc_source(None, SETUP) and "unknown" in disc_source(None, bare)
