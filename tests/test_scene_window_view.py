"""The windows in the mean picture: edges, and moves that leave them where the camera sees them."""

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM

from fieldlum.core.records import CameraSetup, Site, SiteFile
from fieldlum.room.fit.bars import propose_bars, seen_picture
from fieldlum.room.fit.guess import Bar, Guess, Solid, guess_of
from fieldlum.room.fit.parameters import room_parameters
from fieldlum.room.fit.renderer import OUTSIDE, seen_in_opening, surfaces
from fieldlum.room.fit.search import aimed, pattern_search
from fieldlum.room.fit.window_view import WindowView, window_view
from fieldlum.room.scene.view import pixel_rays

HEIGHT = 48


class _Picture:
    """What `window_view` reads of captures: one bright window in a dark room."""

    heading_deg = 180.0
    shape = (HEIGHT, 2 * HEIGHT)
    seen = np.ones(shape, bool)
    setup = SiteFile(Site("r", 47.6, -122.3, "UTC"), CameraSetup(heading_deg=180.0), ROOM)

    def __init__(self, guess: Guess, panes_cdm2: float) -> None:
        pixel, rays = pixel_rays(HEIGHT, 180.0, 6)
        ends = surfaces(guess, rays.astype(np.float32))
        into = np.flatnonzero(ends.surface == OUTSIDE)
        toward = rays[into] @ guess.camera_turn.T
        kind = seen_in_opening(guess, ends.position_m[into], toward)
        shown = np.full(len(rays), 100.0)
        shown[into] = np.array([panes_cdm2, 600.0, 200.0, 300.0, 100.0])[kind]
        picture = np.bincount(pixel, shown, 2 * HEIGHT**2) / 36.0
        self.luminance_cdm2 = picture.reshape(1, *self.shape).repeat(2, axis=0)

    def __len__(self) -> int:
        return 2


def _view(guess: Guess, panes_cdm2: float = 2000.0) -> WindowView:
    return window_view(_Picture(guess, panes_cdm2), guess_of(ROOM, 180.0))  # pyright: ignore[reportArgumentType]


@pytest.mark.analytic
def test_a_window_that_was_measured_wrongly_is_found_in_the_picture() -> None:
    start = guess_of(ROOM, 180.0)
    rect = start.windows[0]
    shifted = replace(rect, u_m=(rect.u_m[0] + 0.12, rect.u_m[1] + 0.08), z_m=(0.75, 2.76))
    true = replace(start, windows=(shifted,))
    view = _view(true)
    edges = [p for p in room_parameters(start) if p.name.startswith("window")]

    class _Cost:
        pose = None

        def __call__(self, guess: Guess) -> float:
            return view.misfit(guess)

    best, _ = pattern_search(_Cost(), start, edges)
    assert best.windows[0].u_m == pytest.approx(shifted.u_m, abs=0.02)
    assert best.windows[0].z_m == pytest.approx(shifted.z_m, abs=0.02)


@pytest.mark.analytic
def test_a_bar_is_proposed_where_the_picture_is_dark() -> None:
    plain = guess_of(ROOM, 180.0)
    bar = Bar(0, True, (2.0, 2.12), (0.1, 0.2))
    picture = seen_picture(_view(replace(plain, bars=(bar,))), plain, 0)
    proposals = [b for b in propose_bars(picture, plain, 0) if b.upright]
    assert len(proposals) == 1
    assert sum(proposals[0].span_m) / 2.0 == pytest.approx(2.06, abs=0.06)


@pytest.mark.property
def test_a_room_as_bright_as_its_windows_shows_no_edges() -> None:
    start = guess_of(ROOM, 180.0)
    assert _view(start, 110.0).misfit(start) == 0.0


@pytest.mark.analytic
@pytest.mark.parametrize("name", ["wall_azimuth_deg", "camera_x_m", "camera_y_m", "tilt_deg"])
def test_aimed_moves_leave_windows_where_the_camera_sees_them(name: str) -> None:
    guess = replace(
        guess_of(ROOM, 180.0),
        bars=(Bar(0, True, (2.0, 2.1), (0.1, 0.2)),),
        solids=(Solid((1.0, 1.0, 0.0), (1.5, 1.4, 0.7), 0.3),),
    )
    parameter = next(p for p in room_parameters(guess) if p.name == name)
    view, step = _view(guess), 4.0 * parameter.first_step
    plain = view.misfit(parameter.change(guess, step))
    moved = aimed(parameter.change)(guess, step)
    assert view.misfit(moved) < 0.4 * plain
    again = aimed(parameter.change)(moved, -step)
    assert again.windows[0].u_m == pytest.approx(guess.windows[0].u_m, abs=0.003)
    assert again.bars[0].span_m == pytest.approx(guess.bars[0].span_m, abs=0.003)
    assert again.solids[0].low_m == pytest.approx(guess.solids[0].low_m, abs=0.003)
