"""Sun at the window: analytic cases of a facade, a reveal, a neighbour, and the camera's own
view.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.records import Obstruction, Room, Window
from fieldlum.plan import sun_enters, sun_in_view

SOUTH = Window("south", left_m=1.0, width_m=4.0, sill_m=1.0, height_m=2.0)


def _at(room: Room, *suns: tuple[float, float]) -> list[bool]:
    altitude, azimuth = np.array(suns, float).T
    return sun_enters(room, altitude, azimuth).tolist()


@pytest.mark.analytic
def test_facade() -> None:
    room = Room(window=(SOUTH,))
    assert _at(room, (30, 180), (30, 95), (30, 85), (30, 0), (-5, 180)) == [
        True,
        True,
        False,
        False,
        False,
    ]


@pytest.mark.analytic
def test_turned_facade() -> None:
    room = Room(wall_azimuth_deg=270.0, window=(SOUTH,))
    assert _at(room, (30, 270), (30, 190), (30, 170), (30, 90)) == [True, True, False, False]


@pytest.mark.analytic
def test_walls_by_name() -> None:
    for wall, azimuth in (("south", 180), ("west", 270), ("north", 0), ("east", 90)):
        room = Room(window=(Window(wall, 1.0, 2.0, 1.0, 2.0),))  # type: ignore[arg-type]
        assert _at(room, (20, azimuth), (20, azimuth + 180)) == [True, False]


@pytest.mark.analytic
def test_reveal_stops_a_high_sun() -> None:
    """Thickness .25 m, height .3 m: the sun is stopped from a profile angle of about
    atan(.3/.25) = 50 deg up.
    """
    room = Room(window=(Window("south", 1.0, 4.0, 1.0, 0.3),))
    assert _at(room, (40, 180), (55, 180)) == [True, False]


@pytest.mark.analytic
def test_neighbour_shades_a_low_sun() -> None:
    """A wall 10 m away and 12 m high hides the sun up to 50 deg at window height."""
    room = Room(window=(SOUTH,), obstruction=(Obstruction(-50, -11, 0, 100, 1, 12),))
    assert _at(room, (20, 180), (40, 180), (55, 180)) == [False, False, True]


@pytest.mark.analytic
def test_left_is_seen_from_inside() -> None:
    """A window at the left end of the south wall lies in the east: a western box outside does
    not shade it.
    """
    room = Room(
        window=(Window("south", 0.0, 1.0, 1.0, 2.0),), obstruction=(Obstruction(0, -2, 0, 3, 1, 4),)
    )
    assert _at(room, (5, 180)) == [True]
    room = Room(
        window=(Window("south", 5.0, 1.0, 1.0, 2.0),), obstruction=(Obstruction(0, -2, 0, 3, 1, 4),)
    )
    assert _at(room, (5, 180)) == [False]


@pytest.mark.analytic
def test_camera_sees_the_sun_in_line_with_the_window() -> None:
    room = Room(
        window=(SOUTH,)
    )  # camera 3 m in, 1.6 m high, in the middle; the window's head is 3 m high
    altitude, azimuth = np.array([20.0, 40.0, 20.0]), np.array([180.0, 180.0, 100.0])
    assert sun_in_view(room, altitude, azimuth).tolist() == [True, False, False]


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@given(st.floats(1, 89), st.floats(0, 360))
def test_a_sun_in_view_enters(altitude: float, azimuth: float) -> None:
    room = Room(window=(SOUTH, Window("west", 2.0, 6.0, 0.5, 3.0)))
    at = (np.array([altitude]), np.array([azimuth]))
    wide = Room(window=room.window, wall_thickness_m=0.001)
    assert not sun_in_view(wide, *at)[0] or sun_enters(wide, *at)[0]
