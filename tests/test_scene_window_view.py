"""The picture of the windows: edges and what the panes let through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, SEATTLE, room_captures, window_captures
from test_scene_search import captures

from fieldlum.core.records import Room, Window
from fieldlum.room.fit.elements import SHADES
from fieldlum.room.fit.evidence import scene_evidence
from fieldlum.room.fit.guess import WindowRect, guess_of
from fieldlum.room.fit.parameters import glass_parameters, room_parameters, stated_albedo
from fieldlum.room.fit.search import SceneCost, search
from fieldlum.room.fit.window_view import window_view
from fieldlum.room.scene.view import traced_view
from fieldlum.sky.daylight import Light

EDGES = ("window 1 u0", "window 1 u1", "window 1 z0", "window 1 z1")


def _skylight(room: Room, light: Light) -> np.ndarray:
    glass = traced_view(room, 46, 180.0, 8).sky
    return light.diffuse_lx[:, None, None] * (0.004 + 0.3 * glass)


@pytest.mark.analytic
@pytest.mark.parametrize("by", [(0.06, -0.05), (-0.06, 0.05)])
def test_edges_in_the_picture_are_those_of_the_window(by: tuple[float, float]) -> None:
    """A pixel of 3.9 degrees has 20 cm of this wall: its mean has the edge to a tenth of that."""
    low = replace(ROOM, camera_z_m=0.7)  # all panes show the sky
    data = room_captures(SEATTLE, low, 46, lambda light: _skylight(low, light))
    true = guess_of(low)
    rect = true.windows[0]
    (u0, u1), (z0, z1) = rect.u_m, rect.z_m
    tape = replace(rect, u_m=(u0 + by[0], u1 + by[0]), z_m=(z0 + by[1], z1 + by[1]))
    start = replace(true, windows=(tape,))
    view, evidence = window_view(data, start), scene_evidence(data, low, pixels=50)
    parameters = [p for p in room_parameters(start) if p.name in EDGES]
    unseen = replace(evidence, direct_lx=0.0 * evidence.direct_lx)
    cost = SceneCost(unseen, start, parameters, stated_albedo(ROOM), 0.0, None, view)
    found = search(cost, start, parameters)[0].windows[0]
    off = np.subtract((*found.u_m, *found.z_m), (*rect.u_m, *rect.z_m))
    assert np.abs(off).max() < 0.025


@pytest.mark.analytic
def test_the_share_of_pane_grows_steadily_as_an_edge_moves() -> None:
    data, true = window_captures(SEATTLE, 46), guess_of(ROOM)
    view, rect = window_view(data, true), true.windows[0]

    def misfit(right_m: float) -> float:
        moved = replace(rect, u_m=(rect.u_m[0], rect.u_m[1] + right_m))
        return float((view.residuals(replace(true, windows=(moved,))) ** 2).sum())

    wider = np.diff([misfit(0.04 + 0.01 * k) for k in range(12)])
    assert (wider > 0.0).all()  # a search sees each centimetre


@pytest.mark.analytic
def test_a_wall_that_moves_with_its_windows_costs_only_its_own_length() -> None:
    """Windows of the south wall are measured from its east end."""
    data, start = window_captures(SEATTLE, 46), guess_of(ROOM)
    parameters = room_parameters(start)
    cost = SceneCost(
        scene_evidence(data, ROOM, pixels=50), start, parameters, stated_albedo(ROOM), 1.0
    )
    rect = start.windows[0]
    moved = replace(rect, u_m=(rect.u_m[0] + 0.1, rect.u_m[1] + 0.1))
    wider = replace(start, size_m=(5.1, *start.size_m[1:]), windows=(moved,))
    off = cost.prior(wider)
    assert {p.name for p, o in zip(parameters, off, strict=True) if abs(o) > 1e-9} == {"width_m"}


@pytest.mark.analytic
def test_half_a_blind_is_among_the_shades() -> None:
    """It lets the suns through that half of the window does."""
    data, bare = window_captures(SEATTLE, 46), guess_of(ROOM)
    evidence, albedo = scene_evidence(data, ROOM, pixels=300), stated_albedo(ROOM)
    rect = bare.windows[0]
    half = replace(rect, z_m=(rect.z_m[0], float(np.mean(rect.z_m))))
    want = evidence.patches(replace(bare, windows=(half,)), albedo)
    off = [np.abs(evidence.patches(s, albedo) - want).sum() for s in SHADES.propose(bare)]
    assert min(off) < 0.1 * want.sum()  # it hangs within the wall: edges are softer


@pytest.mark.slow
@pytest.mark.analytic
def test_a_tinted_window_beside_a_clear_one_is_found() -> None:
    panes = Window("south", 0.4, 1.8, 0.8, 1.9, 0.85, 1, 0.0), Window("west", 1.0, 1.8, 0.8, 1.9)
    room = replace(ROOM, window=tuple(replace(w, frame_m=0.0) for w in panes))
    tinted = replace(room, window=(replace(room.window[0], transmittance=0.4), room.window[1]))
    data = captures(tinted)
    start = guess_of(room)
    evidence, parameters = scene_evidence(data, room, pixels=1500), glass_parameters(start)
    cost = SceneCost(evidence, start, parameters, stated_albedo(room), 0.0)
    found, clear = search(cost, start, parameters)[0].windows
    assert isinstance(found, WindowRect)
    assert found.transmittance / clear.transmittance == pytest.approx(0.4 / 0.88, rel=0.1)
