"""The sky view of a session: written by `pair`, valid until a merge, and used for clipped suns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_sky_view import GRID, LIGHT, SITE, SKY, _at

from fieldlum.core.records import Flag, Panorama, Room, SunSource, Window, slot_id
from fieldlum.optics.images import write_panorama
from fieldlum.optics.projection import altitude_azimuth_deg
from fieldlum.pair.camera_sky_view import (
    Shown,
    in_patches,
    is_outdated,
    shares_of_beam,
    write_sky_view,
)
from fieldlum.session import Session
from fieldlum.sky.perez import reinhart_patches
from fieldlum.sky.sky_view.picture import SkyPicture, write_sky_picture
from fieldlum.sky.sky_view.view import SkyView

ROWS = range(0, len(LIGHT), 3)
SUN = SunSource(30.0, 180.0, 40_000.0, 1.0, "nd-frames")


def session_of(folder: Path) -> tuple[Session, list[Shown]]:
    """Captures of a window of 0.8 in a dark wall, with merge's sky pictures and no disc in view."""
    session = Session(folder)
    session.panoramas.mkdir()
    openness = np.zeros((32, 32))
    openness[4:28, 6:26] = 1.0
    shown = []
    for k in ROWS:
        slot = slot_id(LIGHT.t_utc[k])
        values = 0.8 * openness * SKY[k] + (1.0 - openness) * 0.02 * LIGHT.diffuse_lx[k] / np.pi
        picture = SkyPicture(values.astype(np.float32), np.zeros((32, 32), bool), GRID)
        write_sky_picture(session.sky_picture(slot), picture)
        write_panorama(session.panorama(slot), Panorama(np.full((18, 36), 50.0, np.float32), 180.0))
        shown.append(Shown(slot, seen=np.ones((18, 36), bool), heading_deg=180.0))
    return session, shown


def write(session: Session, shown: list[Shown], *, force: bool = False) -> SkyView | None:
    light = LIGHT[list(ROWS)]
    return write_sky_view(session, shown, light, SITE, force=force)


@pytest.mark.contract
def test_a_view_is_written_once_and_again_after_a_merge(tmp_path: Path) -> None:
    session, shown = session_of(tmp_path)
    view = write(session, shown)
    assert view is not None and view.captures == len(shown)
    assert np.median(view.openness[5:27, 7:25]) > 0.9 and view.openness[:3].max() == 0.0
    with Image.open(session.sky_view.with_suffix(".png")) as picture:
        assert picture.size[0] > 600
    stamp = session.sky_view.stat().st_mtime_ns
    assert write(session, shown) is not None and not is_outdated(session, view)
    assert session.sky_view.stat().st_mtime_ns == stamp
    slot = shown[0].slot
    session.sky_picture(slot).write_bytes(session.sky_picture(shown[1].slot).read_bytes())
    assert is_outdated(session, view)
    again = write(session, shown)
    assert again is not None and not is_outdated(session, again)
    assert session.sky_view.stat().st_mtime_ns > stamp
    assert not is_outdated(session, replace(view, inputs={})), "a view from elsewhere"


@pytest.mark.contract
def test_a_damaged_view_is_written_again_and_none_remains_without_captures(tmp_path: Path) -> None:
    session, shown = session_of(tmp_path)
    session.sky_view.write_bytes(b"no exr")
    assert write(session, shown) is not None
    assert write(session, [replace(capture, seen=None) for capture in shown]) is None
    assert not session.sky_view.exists()


@pytest.mark.analytic
def test_only_a_decided_share_completes_a_sun(tmp_path: Path) -> None:
    """0.8 of the beam arrives through the window; where the view is shut, the room decides."""
    session, shown = session_of(tmp_path)
    view = write(session, shown)
    assert view is not None
    room = Room(window=(Window("south", 0.5, 5.0, 0.5, 2.5, 0.7),))
    for row, column, by_view, by_room in ((14.5, 15.5, 0.8, 0.7), (29.5, 15.5, np.nan, 0.7)):
        light = _at(view, row, column)
        share, decided = shares_of_beam(view, None, light)
        assert share == pytest.approx(by_view, rel=0.1, nan_ok=True)
        assert decided == (not np.isnan(by_view))
        share, decided = shares_of_beam(view, room, light)
        assert share == pytest.approx(by_view if decided else by_room, rel=0.1)
        assert np.isnan(shares_of_beam(None, None, light)[0]).all()


@pytest.mark.analytic
def test_sky_that_merge_did_not_store_is_read_in_the_panorama() -> None:
    """Each pixel has its altitude; the right half, which begins at the heading, is not seen."""
    altitude = 90.0 - np.arange(0.5, 180.0)[:, None] + np.zeros(360)
    flags = np.zeros((180, 360), np.uint16)
    flags[:, 180:] = Flag.OUTSIDE_LENS
    panorama = Panorama((altitude + 90.0).astype(np.float32), 200.0, flags=flags)
    patches = reinhart_patches().directions
    shown = in_patches(panorama)
    true_deg, azimuth_deg = altitude_azimuth_deg(patches)
    right = (azimuth_deg - 200.0) % 360.0 < 180.0
    assert np.isnan(shown[right]).all() and np.abs(shown - 90.0 - true_deg)[~right].max() < 0.51


@pytest.mark.analytic
def test_a_lower_bound_is_no_measured_disc() -> None:
    assert Shown("a", SUN).measured_lx == 40_000.0 and Shown("a").measured_lx == 0.0
    assert np.isnan(Shown("a", replace(SUN, origin="clipped")).measured_lx)
