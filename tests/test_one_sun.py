"""Captured, simulated and predicted sun patches have one sun: the one that a picture shows."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from learning_room import dataset, write_pairs

from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, Slot, slot_id
from fieldlum.core.scheduler import LOCAL
from fieldlum.learn.models import Prediction
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.optics.profiles import shipped
from fieldlum.pair import BracketInterval, write_patches
from fieldlum.room import simulate
from fieldlum.session import Session, create_session
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.site_toml import load_site
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.year.predict.hour_blocks import HourBlock, HourJudge, ModelRoom, blocks

OFFICE = load_site(shipped("capture_plans") / "seattle-office.toml")
LOW = datetime(2027, 12, 21, 23, 40, tzinfo=UTC)  # 40 minutes before sunset in Seattle
HEIGHT = 46


class _KeepsPatch:
    """A model that keeps the sun patches that it is given."""

    patch: np.ndarray

    def predict(self, light: Light, patch: np.ndarray) -> Any:
        self.patch = patch
        trusted = np.ones(len(patch), bool)
        return Prediction(np.ones_like(patch), None, np.zeros(len(patch)), trusted)


def predicted_patch(light: Light) -> np.ndarray:
    model = _KeepsPatch()
    room = ModelRoom(
        setup=OFFICE,
        height=HEIGHT,
        width=2 * HEIGHT,
        heading_deg=OFFICE.camera.heading_deg,
        needs_patch=True,
    )
    list(blocks(cast("Any", model), room, light))
    return model.patch[0]


@pytest.mark.analytic
def test_a_turned_camera_sees_the_sun_where_its_pictures_show_it() -> None:
    """In a uniform picture a heading 10 degrees too low is a view direction 10 degrees higher."""
    room = ModelRoom(
        setup=OFFICE,
        height=HEIGHT,
        width=2 * HEIGHT,
        heading_deg=OFFICE.camera.heading_deg,
        needs_patch=False,
    )
    turned = replace(room, pose=CameraPose(heading_deg=10.0, covariance=4 * ((0.0,) * 4,)))
    shown = np.full((1, HEIGHT, 2 * HEIGHT), 2000.0, np.float32)
    known = np.zeros((1, HEIGHT, 2 * HEIGHT), np.float32)
    error = np.full(1, 0.01)
    map_ = Prediction(shown, log10_sd=known, expected_mse=error, trusted=np.ones(1, bool))
    block = HourBlock(slice(0, 1), low_light(), map_, np.array([20_000.0]))
    drawn = np.full((8, 1), 20_000.0)
    stated, true = (HourJudge(turned, np.array([220.0])), HourJudge(room, np.array([230.0])))
    found, expected = (judge.figures(block, drawn).views for judge in (stated, true))
    for name in ("dgp", "ev_lx", "dgp_low", "dgp_high"):
        assert found[name] == pytest.approx(expected[name], rel=2e-3), name
    straight = HourJudge(room, np.array([220.0])).figures(block, drawn).views
    assert abs(straight["ev_lx"] - expected["ev_lx"]) > 100.0


def low_light() -> Light:
    return light_at([LOW], OFFICE.site, np.array([300.0]), np.array([40.0]))


def paired_patch(folder: Path) -> Path:
    """The patch that `pair` computes for a picture of the low sun; it is kept if it is the same."""
    session = Session(folder / "s")
    if not session.toml.exists():
        create_session(session.root, OFFICE, [Slot(LOW, 4.0, 230.0, ())], {})
    picture = folder / "p.exr"
    blank = np.ones((HEIGHT, 2 * HEIGHT), np.float32)
    write_panorama(picture, Panorama(blank, OFFICE.camera.heading_deg, t_utc=LOW))
    capture = CaptureFile(slot=slot_id(LOW), frames=(), t_open_utc=LOW, t_close_utc=LOW)
    brackets = [BracketInterval(capture.slot, picture, capture)]
    write_patches(session, OFFICE, brackets, low_light(), False, LOCAL)
    return session.sunpatch(slot_id(LOW))


@pytest.mark.contract
def test_patches_of_an_earlier_version_with_other_rays_are_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = paired_patch(tmp_path).stat().st_ino
    assert paired_patch(tmp_path).stat().st_ino == written
    monkeypatch.setattr("fieldlum.pair.patch_rays", lambda _: 3)
    assert paired_patch(tmp_path).stat().st_ino != written


@pytest.mark.property
def test_captured_and_predicted_patch_agree_to_the_pixel_at_a_low_sun(tmp_path: Path) -> None:
    light = low_light()
    assert 3.0 < light.sun_altitude_deg[0] < 5.0
    captured = read_panorama(paired_patch(tmp_path)).luminance_cdm2
    predicted = predicted_patch(light)
    assert (predicted > 0.0).sum() > 20
    np.testing.assert_allclose(captured, predicted, rtol=1e-3, atol=0.1)
    true = predicted_patch(replace(light, refraction=False))
    assert np.abs(true - predicted).max() > 0.1 * predicted.max()  # what refraction moves


@pytest.mark.slow
@pytest.mark.property
def test_a_simulated_room_has_the_sun_of_its_prediction() -> None:
    light = low_light()
    truth = simulate.lit_room(OFFICE, height=HEIGHT, quality="draft")
    made = truth.render(light)
    np.testing.assert_allclose(made.patch_cdm2[0], predicted_patch(light), rtol=1e-3, atol=0.1)
    source = truth.as_panorama(made, 0).sun
    if source is not None:
        assert source.altitude_deg == light.apparent_altitude_deg[0]


@pytest.mark.authority
def test_the_apparent_altitude_is_that_of_spa() -> None:
    """pvlib's SPA at sea level and 12 C; below the visible horizon nothing is raised."""
    times = [LOW.replace(hour=h % 24, day=20 + h // 24) for h in range(14, 28)]
    at = sun.position(times, replace(OFFICE.site, altitude_m=0.0))
    np.testing.assert_allclose(
        sun.apparent_altitude_deg(at.altitude_deg), at.apparent_altitude_deg, atol=1e-3
    )


@pytest.mark.contract
def test_a_csv_states_renderings_without_refraction(tmp_path: Path) -> None:
    path = write_pairs(tmp_path, dataset(("2027-12-20",), height=8))
    lines = path.read_text().splitlines()
    assert load_pairs(path).light.refraction
    path.write_text("\n".join([lines[0] + ",refraction", *(s + ",0" for s in lines[1:])]) + "\n")
    light = load_pairs(path).light
    assert not light.refraction and not light[[0, 1]].refraction
    np.testing.assert_array_equal(light.apparent_sun_direction, light.sun_direction)
    mixed = [lines[0] + ",refraction", lines[1] + ",", *(s + ",0" for s in lines[2:])]
    path.write_text("\n".join(mixed) + "\n")
    with pytest.raises(InputError, match="refraction"):
        load_pairs(path)
