"""The room from its own captures: renderer, evidence, search, files and the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from scene_captures import DAYS, room_captures
from scene_captures import ROOM as ONE_PANE

from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Obstruction, Room, Site
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import apply_scene, with_scene
from fieldlum.room.fit.evidence import SceneEvidence, levelled, scene_evidence
from fieldlum.room.fit.fit import fit_scene
from fieldlum.room.fit.guess import Bar, Solid, WindowRect, guess_of, room_of
from fieldlum.room.fit.parameters import all_parameters, room_parameters, stated_albedo
from fieldlum.room.fit.renderer import surfaces, unit_patches
from fieldlum.room.fit.scene_file import read_scene, write_scene
from fieldlum.room.fit.search import SceneCost, prior_unit, search
from fieldlum.room.scene import build, sun_patches
from fieldlum.room.scene.box_room import room_axes
from fieldlum.sky import sun

HEIGHT = 64
SITE = Site("test room", 47.6, -122.3, "America/Los_Angeles")
TWO_PANES = replace(ONE_PANE.window[0], panes=2)
ROOM = replace(ONE_PANE, window=(TWO_PANES,))


def captures(room: Room, days: tuple[str, ...] = DAYS, height: int = HEIGHT) -> Dataset:
    """Clear hours of a linear room: skylight that falls off with depth, and its sun patches."""
    shade = 1.0 + np.cos(np.linspace(0, 2 * np.pi, 2 * height))[None, :] * 0.3
    shade = shade * np.ones((1, height, 1))
    return room_captures(
        SITE, room, height, lambda light: light.total_lx[:, None, None] * 0.004 * shade, days
    )


@pytest.fixture(scope="module")
def data() -> Dataset:
    return captures(ROOM)


@pytest.fixture(scope="module")
def evidence(data: Dataset) -> SceneEvidence:
    return scene_evidence(data, ROOM, pixels=3000)


@pytest.mark.authority
@pytest.mark.parametrize("wall", ["south", "west", "north", "east"])
def test_the_renderer_agrees_with_the_exact_one(wall: str) -> None:
    """authority: fieldlum.room.scene, which is compared with rtrace in test_scene.py."""
    furnished = replace(
        ROOM,
        window=(
            replace(ROOM.window[0], wall=wall, width_m=3.0, panes=2, frame_m=0.06, transom_m=2.0),
        ),
        camera_tilt_deg=3.0,
        camera_roll_deg=-2.0,
        obstruction=(Obstruction(1.0, 1.2, 0.0, 1.0, 0.6, 0.7), Obstruction(-3, -4, 0, 2, 1, 3)),
    )
    azimuth = {"south": 180.0, "west": 270.0, "north": 0.0, "east": 90.0}[wall]
    suns = sun.direction(np.array([35.0, 20.0, 50.0]), azimuth + np.array([0.0, 25.0, -30.0]))
    exact = sun_patches(furnished, suns, 1e5, height=HEIGHT, heading_deg=180.0, sub=1)
    guess = guess_of(furnished)
    from fieldlum.room.scene.view import pixel_rays

    pixel, rays = pixel_rays(HEIGHT, 180.0, 1)
    ends = surfaces(guess, rays.astype(np.float32))
    unit = unit_patches(
        guess,
        ends,
        (suns @ room_axes(guess.wall_azimuth_deg).T).astype(np.float32),
        pixel,
        1,
        np.ones(len(pixel)),
    )
    lit, want = unit > 0.05, exact.reshape(3, -1) > 300.0
    inside = ends.surface >= 0
    assert (lit & inside).sum() > 60
    assert (lit != want)[:, inside].sum() < 0.04 * want[:, inside].sum()


@pytest.mark.analytic
def test_an_edge_takes_its_share_of_the_light_between_two_rays(evidence: SceneEvidence) -> None:
    """Seventeen millimetres are less than rays are apart: the light follows each of them."""
    guess = guess_of(replace(ROOM, window=(ONE_PANE.window[0],)))
    rect, every = guess.windows[0], np.ones(len(evidence.pixel))

    def light(by: float, spread: float) -> np.ndarray:
        moved = replace(guess, windows=(replace(rect, u_m=(rect.u_m[0] + by, rect.u_m[1])),))
        ends, suns = surfaces(guess, evidence.rays, spread), evidence.suns_room(guess)
        unit = unit_patches(moved, ends, suns, evidence.pixel, evidence.sub, every)
        return unit.sum(axis=1)

    soft = np.array([light(0.001 * k, evidence.spread) for k in range(18)])
    hard = light(0.0, 0.0)
    assert np.diff(soft.sum(axis=1)).max() < 0.0
    assert soft[0].sum() == pytest.approx(hard.sum(), rel=0.03)


@pytest.mark.analytic
def test_a_guess_and_its_room_are_inverse() -> None:
    room = replace(ROOM, window=(replace(ROOM.window[0], wall="east"),))
    again = room_of(guess_of(room), room)
    assert again.window[0].left_m == pytest.approx(room.window[0].left_m)
    assert again.window[0].sill_m == pytest.approx(room.window[0].sill_m)
    assert again.camera_x_m == room.camera_x_m


@pytest.mark.contract
def test_a_window_without_width_is_left_out() -> None:
    u_m = (1.0, 3.0), (0.0, 1e-20)
    rects = tuple(WindowRect("south", u, (1.0, 2.0), 0.8) for u in u_m)
    assert len(room_of(replace(guess_of(ROOM), windows=rects), ROOM).window) == 1


@pytest.mark.property
@given(data=st.data())
def test_fitted_windows_always_form_a_room(data: st.DataObject) -> None:
    """A glazed wall, a ribbon of windows: fitted edges pass walls and each other by centimetres."""
    guess = guess_of(ROOM)
    width, _, height = guess.size_m

    def edges(extent: float) -> tuple[float, float]:
        low = data.draw(st.floats(-0.1, extent - 0.4))
        return low, data.draw(st.floats(low + 0.3, extent + 0.1))

    rects = [
        WindowRect("south", edges(width), edges(height), 0.8)
        for _ in range(data.draw(st.integers(1, 3)))
    ]
    room = room_of(replace(guess, windows=tuple(rects)), ROOM)
    openings = build(room).openings  # raises InputError for an impossible room
    assert 1 <= len(openings) <= len(rects)
    area = sum((o.u_m[1] - o.u_m[0]) * (o.z_m[1] - o.z_m[0]) for o in openings)
    first = _area(rects[0], width, height)
    assert first - 1e-9 <= area <= sum(_area(r, width, height) for r in rects) + 1e-9


def _area(rect: WindowRect, width: float, height: float) -> float:
    """Area inside the wall [m2]."""
    (u0, u1), (z0, z1) = rect.u_m, rect.z_m
    return (min(u1, width) - max(u0, 0.0)) * (min(z1, height) - max(z0, 0.0))


@pytest.mark.slow
@pytest.mark.analytic
def test_north_and_edges_are_found(data: Dataset, evidence: SceneEvidence) -> None:
    wrong = replace(
        ROOM, camera_x_m=2.45, window=(replace(ROOM.window[0], left_m=0.65, height_m=1.86),)
    )
    start = replace(guess_of(wrong), north_deg=0.0)
    turned = replace(evidence, clock=evidence.clock + np.array([0.0, 1.0]))  # stated north: 1 off
    # With pixels of 2.8 degrees these cannot be told from north.
    known = ("clock_min", "wall_azimuth_deg", "tilt_deg", "roll_deg")
    parameters = [p for p in room_parameters(start) if p.name not in known]
    albedo = turned.albedos(start, stated_albedo(wrong))
    objective = SceneCost(turned, start, parameters, albedo, prior_unit(turned, start, albedo))
    found, cost = search(objective, start, parameters)
    assert cost <= 1.02 * objective(replace(guess_of(ROOM), north_deg=1.0))
    values = {p.name: p.measured(found) for p in parameters}
    assert found.north_deg == pytest.approx(1.0, abs=0.45)  # a sixth of a pixel
    assert values["window 1 u1"] == pytest.approx(0.6, abs=0.04)
    assert values["camera_x_m"] == pytest.approx(2.4, abs=0.04)


@pytest.mark.slow
@pytest.mark.property
def test_the_light_below_hardly_knows_the_patches(data: Dataset, evidence: SceneEvidence) -> None:
    true = guess_of(ROOM)
    patch = evidence.patches(true, stated_albedo(ROOM))
    light = np.maximum(np.exp(evidence.log_seen) - patch, 1.0)
    dark = patch == 0.0
    assert np.median(np.abs(np.log(evidence.below / light))[dark]) < 0.05
    sunny = patch > light
    assert np.median(evidence.below[sunny] / light[sunny]) < 1.5


@pytest.mark.analytic
def test_an_hour_of_another_level_is_levelled() -> None:
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((1500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    true = 100.0 * np.exp(0.3 + 0.2 * directions[:, 0] - 0.1 * directions[:, 2] ** 2)[None]
    below = np.full_like(true, 100.0)
    patch = np.where(directions[:, 2] < -0.8, 800.0, 0.0)[None]  # a tenth of the pixels
    seen = (true + patch) * np.exp(0.02 * rng.standard_normal(true.shape))
    for known in (np.zeros_like(patch), patch):
        level = levelled(below, seen, known, directions)
        dark = patch == 0.0
        assert np.abs(np.log(level / true))[dark].max() < 0.08
        assert np.abs(np.log(level / true)).max() < 0.3  # carried on below the patch


@pytest.mark.slow
@pytest.mark.analytic
def test_a_scene_is_written_read_and_applied(data: Dataset, tmp_path: Path) -> None:
    few = data.take(np.arange(0, len(data), 2))
    scene = fit_scene(few, ROOM, pixels=250)
    assert scene.misfit["fitted"] < scene.misfit["none"]
    write_scene(tmp_path, scene)
    again = read_scene(tmp_path)
    assert again.room == scene.room and again.u == pytest.approx(scene.u)
    put = with_scene(few, again)
    assert (
        put.patch_cdm2 is not None
        and cast("dict[str, str]", put.about()["scene"])["chosen"] == "fitted"
    )
    assert put.setup.camera.heading_deg == pytest.approx((180.0 + scene.north_deg) % 360.0)
    assert with_scene(few, replace(again, chosen="none")).patch_cdm2 is None
    # A site that was corrected after the fit must not be corrected a second time.
    with pytest.raises(InputError, match="heading 181 degrees"):
        with_scene(replace(few, heading_deg=181.0), again)
    corrected = replace(few.setup, room=again.room)
    with pytest.raises(InputError, match=r"another \[room\]"):
        with_scene(replace(few, setup=corrected), again)
    (tmp_path / "scene.toml").write_text("format = 7\n")
    with pytest.raises(InputError, match="format 7"):
        read_scene(tmp_path)


@pytest.mark.contract
def test_what_cannot_be_fitted_is_refused_in_one_line(data: Dataset, tmp_path: Path) -> None:
    blind = replace(ROOM, window=())
    with pytest.raises(InputError, match="window"):
        scene_evidence(data, blind)
    dull = data.light.dni_wm2 == 0.0
    with pytest.raises(NotEnoughDataError, match="captures have direct sun"):
        scene_evidence(data.take(dull), ROOM)
    with pytest.raises(InputError, match=r"scene\.toml"):
        apply_scene(data, tmp_path / "pairs.csv", str(tmp_path), "absolute")
    unchanged, patch = apply_scene(data, tmp_path / "pairs.csv", "none", "none")
    assert unchanged is data and patch == "none"
    ran = CliRunner().invoke(main, ["scene", "fit", "--help"])
    assert ran.exit_code == 0 and "Example" in ran.output


@pytest.mark.analytic
def test_every_parameter_changes_its_own_number() -> None:
    """The residuals are those of the cost; faces of solids and of bars have names of their own."""
    shade = Solid((-3.0, -4.0, 0.0), (2.0, -3.0, 3.0), 0.4)
    table = Solid((1.0, 1.0, 0.7), (2.0, 2.0, 0.75), 0.4)
    bar = Bar(0, True, (2.0, 2.1), (0.1, 0.2))
    guess = replace(guess_of(ROOM), solids=(shade, table), bars=(bar,))
    parameters = all_parameters(guess, room_parameters(guess))
    assert len({p.name for p in parameters}) == len(parameters)
    for p in parameters:
        moved = p.change(guess, 0.01)
        assert moved != guess and p.read(moved) == pytest.approx(p.read(guess) + 0.01)
        assert all(p.read(moved) == q.read(moved) for q in parameters if q.name == p.name)
    near = next(p for p in parameters if p.name == "solid 1 hy")
    assert near.read(near.change(guess, 9.0)) == 0.0  # a shade outside does not come in


@pytest.mark.analytic
def test_no_solid_is_searched_to_the_place_of_the_camera(evidence: SceneEvidence) -> None:
    """No room has it: the scene that such a search wrote could not be read."""
    x, y, z = guess_of(ROOM).camera_m
    around = Solid((x - 0.3, y - 0.3, 0.0), (x + 0.3, y + 0.3, z + 0.1), 0.5)
    below = replace(around, high_m=(x + 0.3, y + 0.3, z - 0.1))
    inside, free = (replace(guess_of(ROOM), solids=(solid,)) for solid in (around, below))
    albedo = np.append(stated_albedo(ROOM), 0.5)
    objective = SceneCost(evidence, free, room_parameters(free), albedo, 0.0)
    assert objective(inside) == np.inf > objective(free)
    with pytest.raises(InputError, match="camera is inside"):
        sun_patches(room_of(inside, ROOM), [[0.0, -1.0, 0.5]], [1.0], height=8, heading_deg=0)


@pytest.mark.analytic
def test_the_albedo_of_a_solid_is_the_searched_one(evidence: SceneEvidence) -> None:
    light, dark = (Solid((1.0, 1.0, 0.0), (2.4, 2.0, 0.7), albedo) for albedo in (0.7, 0.2))
    guess = replace(guess_of(ROOM), solids=(light,))
    objective = SceneCost(evidence, guess, room_parameters(guess), stated_albedo(ROOM), 0.0)
    cost = objective(guess)
    assert cost != pytest.approx(objective(replace(guess, solids=(dark,))), rel=1e-3)


@pytest.mark.analytic
def test_a_wall_without_light_where_patches_are_expected_is_not_black(
    evidence: SceneEvidence,
) -> None:
    guess = guess_of(ROOM)
    ends = surfaces(guess, evidence.rays, evidence.spread)
    wall = int(np.argmax([(ends.surface == k).sum() for k in range(4)]))
    on_wall = np.zeros(len(evidence.pixels), bool)
    on_wall[evidence.pixel[ends.surface == wall]] = True
    dark = np.where(on_wall, np.log(evidence.below), evidence.log_seen)
    albedo = replace(evidence, log_seen=dark).albedos(guess, stated_albedo(ROOM))
    assert albedo[wall] == pytest.approx(0.5 * np.median(albedo[:4]))
