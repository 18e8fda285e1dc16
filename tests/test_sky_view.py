"""The sky view: what follows the sky is open, with its share; what does not is shut or doubtful."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Room, Site, SiteFile, Window
from fieldlum.optics.projection import rotation
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.perez import reinhart_patches
from fieldlum.sky.sky_view.estimate_from_captures import Captured, estimate, sky_view_of
from fieldlum.sky.sky_view.measured_discs import NO_DISCS
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.sky.sky_view.view import CHANNELS, SkyView
from fieldlum.sky.sky_view.visible_disc import disc_lx, disc_of_hours, disc_source, drawn_shares

SITE = Site("place", 45.0, 8.0)
GRID = SkyGrid(
    first_altitude_deg=32.0,
    first_azimuth_deg=-16.0,
    step_deg=1.0,
    heading_deg=180.0,
    height=32,
    width=32,
)  # 32 x 32 degrees around the south


def _light(days: int = 9) -> Light:
    """Nine days, each hour from 6 to 18; overcast, broken and clear."""
    start = datetime(2027, 1, 10, tzinfo=UTC)
    times = [
        start + timedelta(days=40 * d, hours=h, minutes=30)
        for d in range(days)
        for h in range(6, 18)
    ]
    light = light_at(times, SITE, np.zeros(len(times)), np.full(len(times), 100.0))
    up = np.flatnonzero(light.sun_altitude_deg > 4.0)
    dni = np.array([(0.0, 300.0, 750.0)[(k // 12 + k // 5) % 3] for k in up])
    dhi = np.where(dni > 0, 110.0, 180.0) * (0.3 + np.sin(np.radians(light.sun_altitude_deg[up])))
    return light_at([times[k] for k in up], SITE, dni, dhi)


LIGHT = _light()
RAYS = GRID.rays()
SKY = LIGHT.sky_at(RAYS.reshape(-1, 3)).reshape(-1, 32, 32)


def _clouds(seed: int = 0) -> Floats:
    """Real skies over Perez's: 25 % in each hour, the same in all of the window, and 3 % noise."""
    rng = np.random.default_rng(seed)
    common = rng.lognormal(0.0, 0.25, (len(LIGHT), 1, 1))
    return common * rng.lognormal(0.0, 0.03, SKY.shape)


def _shade() -> Floats:
    return LIGHT.diffuse_lx[:, None, None] / np.pi


def _view(
    pictures: Floats,
    disc_share: Floats | None = None,
    rows: Indices | None = None,
    latitude_deg: float | None = None,
    elsewhere: Floats32 | None = None,
) -> SkyView:
    shares = np.full(len(LIGHT), np.nan) if disc_share is None else disc_share
    clipped = np.zeros((32, 32), bool)

    def read(k: int) -> SkyPicture:
        return SkyPicture(pictures[k].astype(np.float32), clipped, GRID)

    captured = Captured(LIGHT, read, shares, elsewhere)
    taken = captured if rows is None else captured.take(rows.tolist())
    return estimate(taken, latitude_deg=latitude_deg)


def _shown_on(pictures: Floats32, grid: SkyGrid, k: int) -> SkyPicture:
    return SkyPicture(pictures[k], np.zeros((32, 32), bool), grid)


def _pictures(openness: Floats, tau: float | Floats = 0.8, foreground: Floats | None = None):
    front = 0.08 * _shade() if foreground is None else foreground
    return openness * tau * SKY * _clouds() + (1.0 - openness) * front


@pytest.mark.analytic
def test_a_uniform_sky_through_tinted_and_clear_glass() -> None:
    """Open sky has the openness 1 behind either pane, and the pane's own transmittance."""
    openness, tau = np.zeros((32, 32)), np.full((32, 32), 0.8)
    openness[4:28, 2:14] = openness[4:28, 18:30] = 1.0
    tau[:, 16:] = 0.15
    view = _view(_pictures(openness, tau))
    assert (view.openness[openness == 0] == 0.0).all()
    assert np.median(view.openness[openness == 1]) > 0.95
    for columns, true in ((slice(2, 14), 0.8), (slice(18, 30), 0.15)):
        assert np.median(view.transmittance[4:28, columns]) == pytest.approx(true, rel=0.12)
        inside = (view.low <= true) & (view.high >= true)
        assert inside[4:28, columns].mean() > 0.95


@pytest.mark.analytic
def test_dark_glass_is_no_sky_until_a_capture_shows_the_disc() -> None:
    """A facade that fills the view follows the sky at a tenth of it, too (a room by Mitsuba)."""
    pictures = _pictures(np.ones((32, 32)), 0.1)
    suns = np.array(GRID.pixels(LIGHT.apparent_sun_direction))
    inside = (np.abs(suns - 16.0) < 12.0).all(axis=0) & (LIGHT.direct_lx > 10_000.0)
    unknown = _view(pictures)
    known = _view(pictures, np.where(inside, 0.1, np.nan))
    for view, best, low in ((unknown, 0.0, 0.0), (known, 0.1, 0.05)):
        disc = disc_of_hours(view, LIGHT[inside])
        share = [np.median(lx / LIGHT.direct_lx[inside]) for lx in (disc.best_lx, disc.low_lx)]
        assert share[0] == pytest.approx(best, rel=0.15)
        assert share[1] >= low and (share[1] == 0.0) == (low == 0.0)
        assert (disc.high_lx > 0.1 * LIGHT.direct_lx[inside]).mean() > 0.9
    assert unknown.pose == CameraPose(axis_deg=GRID.heading_deg)
    assert "no disc is certain: mark a tint" in " ".join(unknown.notes)
    assert "no disc is certain" not in " ".join(known.notes)


@pytest.mark.analytic
def test_sky_that_the_sun_never_reaches_shows_that_a_facade_is_none() -> None:
    """A facade, or tinted glass, fills the sun's path; above it the panoramas show clear sky."""
    facade_level = np.random.default_rng(1).lognormal(0.0, 0.25, (len(LIGHT), 1, 1))
    facade = 0.08 * SKY * facade_level
    patches = reinhart_patches().directions
    sky = 0.7 * LIGHT.sky_at(patches) * _clouds()[:, 0, :1]
    elsewhere = np.where(patches[:, 2] > 0.8, sky, np.nan).astype(np.float32)
    alone, view = _view(facade), _view(facade, elsewhere=elsewhere)
    assert alone.high.min() > 0.08 and "no disc is certain" in " ".join(alone.notes)
    assert view.high.max() == 0.0 and "sees no sky" in " ".join(view.notes)
    glass = _view(_pictures(np.ones((32, 32)), 0.15), elsewhere=elsewhere)
    assert np.median(glass.low) > 0.05 and "no disc is certain" not in " ".join(glass.notes)


@pytest.mark.analytic
def test_a_marked_tint_has_a_heading_by_its_sky() -> None:
    """Four degrees off; its darkness is known, so that it is no facade."""
    openness = np.zeros((32, 32))
    openness[4:28, 4:28] = 1.0
    rays = GRID.rays().reshape(-1, 3) @ rotation(4.0, 0.0, 0.0, 180.0).T
    sky = LIGHT.sky_at(rays).reshape(-1, 32, 32) * _clouds()
    pictures = openness * 0.2 * sky + (1.0 - openness) * 0.01 * _shade()
    light = replace(LIGHT, states=("tint=full",) * len(LIGHT))
    clipped, shares = np.zeros((32, 32), bool), np.full(len(LIGHT), np.nan)
    captured = Captured(
        light, lambda k: SkyPicture(pictures[k].astype(np.float32), clipped, GRID), shares
    )
    view = sky_view_of(captured, NO_DISCS, SITE, 180.0)
    assert view.pose.heading_sd_deg < 1.0 and np.median(view.low[8:24, 8:24]) > 0.1
    assert abs(view.pose.values[0] - 4.0) < 3.0 * view.pose.heading_sd_deg


@pytest.mark.analytic
def test_a_strip_of_two_half_open_pixels_has_the_glass_of_wider_panes() -> None:
    """No pixel of it is all open: its own brightness does not tell the glass from the openness."""
    openness = np.zeros((32, 32))
    openness[2:14, 4:28], openness[20:22, 4:28] = 1.0, 0.4
    view = _view(_pictures(openness))
    assert view.openness[20:22, 5:27] == pytest.approx(0.4, abs=0.06)
    assert view.transmittance[20:22, 5:27] == pytest.approx(0.8, rel=0.12)


@pytest.mark.analytic
def test_captured_discs_correct_the_glass_as_far_as_they_are_surer_than_the_sky() -> None:
    """One disc moves it a part of the way; of two the larger counts, as an edge hides a part.

    One with a sixth of the light was between slats, and does not darken the glass.
    """
    pictures = _pictures(np.ones((32, 32)), 0.6)
    suns = np.array(GRID.pixels(LIGHT.apparent_sun_direction))
    inside = (np.abs(suns - 16.0) < 12.0).all(axis=0) & (LIGHT.direct_lx > 10_000.0)
    first, second = np.flatnonzero(inside)[:2]

    def glass(shares: dict[int, float]) -> float:
        given = np.full(len(LIGHT), np.nan)
        given[list(shares)] = list(shares.values())
        return float(np.median(_view(pictures, given).transmittance[8:24, 8:24]))

    without, one = glass({}), glass({first: 0.8})
    assert without + 0.3 * (0.8 - without) < one < 0.8
    assert one - 0.01 < glass({first: 0.8, second: 0.5}) < 0.8
    assert glass({first: 0.1}) == pytest.approx(without)


@pytest.mark.analytic
def test_a_low_disc_corrects_the_discs_at_its_altitude() -> None:
    """A beam's luminous efficacy is unsure for a low sun, alike for all suns at that altitude."""
    grid, altitude_deg = replace(GRID, heading_deg=230.0), LIGHT.apparent_altitude_deg
    sky = LIGHT.sky_at(grid.rays().reshape(-1, 3)).reshape(-1, 32, 32)
    pictures = (0.6 * sky * _clouds()).astype(np.float32)
    inside, row, column = grid.indices(LIGHT.apparent_sun_direction)
    inside &= (column > 4) & (column < 28) & (LIGHT.direct_lx > 2000.0)
    low = int(np.flatnonzero(inside)[np.argmin(altitude_deg[inside])])

    def glass(share: float) -> Floats:
        shares = np.where(np.arange(len(LIGHT)) == low, share, np.nan)
        read = partial(_shown_on, pictures, grid)
        return estimate(Captured(LIGHT, read, shares)).transmittance

    gain = np.median(glass(0.8) / glass(np.nan), axis=1)
    assert altitude_deg[low] < 10.0 and gain[row[low]] > 1.2
    assert 1.0 < gain[2] < 1.0 + 0.5 * (gain[row[low]] - 1.0)


@pytest.mark.analytic
def test_one_open_pixel_of_a_lens_between_mixed_ones_may_hide_a_disc() -> None:
    """The lens's blur leaves open which part of a gap between slats is open."""
    grid = replace(GRID, step_deg=0.5)
    openness = np.zeros((32, 32))
    openness[2:12, 4:28] = openness[17, 4:28] = 1.0
    openness[[16, 18], 4:28] = 0.5
    sky = LIGHT.sky_at(grid.rays().reshape(-1, 3)).reshape(SKY.shape)
    pictures = _clouds() * 0.8 * openness * sky + (1.0 - openness) * 0.08 * _shade()

    def read(k: int) -> SkyPicture:
        return SkyPicture(pictures[k].astype(np.float32), np.zeros((32, 32), bool), grid)

    view = estimate(Captured(LIGHT, read, np.full(len(LIGHT), np.nan)))
    assert (view.openness[17, 5:27] > 0.9).all()
    assert (view.low[17, 5:27] == 0.0).all()
    assert (view.low[4:10, 6:26] > 0.3).all()


@pytest.mark.analytic
def test_slats_have_their_share_although_they_are_not_black() -> None:
    """Mixed pixels are separated into sky and foreground."""
    openness = np.zeros((32, 32))
    openness[2:12, 4:28], openness[12:28, 4:28] = 1.0, 0.3
    upwards = np.maximum(LIGHT.apparent_sun_direction[:, 2], 0.0)
    lit = 0.1 * (LIGHT.direct_lx * upwards / np.pi)[:, None, None]
    front = np.broadcast_to(0.1 * _shade() + lit, SKY.shape)
    view = _view(_pictures(openness, foreground=front))
    slats = view.openness[13:27, 5:27]
    assert slats.mean() == pytest.approx(0.3, abs=0.05)
    assert (view.low[13:27, 5:27] <= 0.24).mean() > 0.95
    assert (view.high[13:27, 5:27] >= 0.24).mean() > 0.95


@pytest.mark.analytic
def test_a_disc_in_a_mixed_pixel_does_not_open_it() -> None:
    """The sun's own light in a picture is no light of the sky behind an edge."""
    openness = np.zeros((32, 32))
    openness[9:28, 4:28], openness[8, 4:28] = 1.0, 0.3
    pictures = _pictures(openness)
    sunny = LIGHT.direct_lx > 1000.0
    near = np.einsum("ijk,nk->nij", RAYS, LIGHT.apparent_sun_direction[sunny]) > 0.9994  # 2 degrees
    assert near[:, 8, 5:27].any(axis=0).sum() >= 8
    pictures[sunny] += 1e6 * near
    assert _view(pictures).openness[8, 5:27] == pytest.approx(0.3, abs=0.07)


@pytest.mark.analytic
def test_a_white_facade_brighter_than_the_sky_gives_no_disc() -> None:
    """It faces the camera and shines in the sun, but it does not follow the sky behind it."""
    openness = np.zeros((32, 32))
    openness[2:14, 4:28] = 1.0
    facing = np.maximum(LIGHT.apparent_sun_direction @ np.array([0.94, 0.34, 0.0]), 0.0)
    beam = (LIGHT.direct_lx * facing / np.pi)[:, None, None]
    facade = 0.8 * (0.8 * (0.5 * _shade() + beam))
    view = _view(_pictures(openness, foreground=np.broadcast_to(facade, SKY.shape)))
    assert np.median((facade / SKY)[LIGHT.direct_lx > 3e4].max(axis=0)) > 1.0
    assert (view.openness[15:] == 0.0).mean() > 0.98
    assert (view.openness[3:13, 5:27] > 0.9).mean() > 0.95


@pytest.mark.analytic
def test_a_curtain_has_bounds_until_captures_show_its_disc() -> None:
    """Its luminance does not show the direct disc: low is 0; captures without a disc decide."""
    openness = np.zeros((32, 32))
    openness[2:30, 2:12] = 1.0
    through = np.maximum(LIGHT.apparent_sun_direction @ np.array([0.0, -1.0, 0.0]), 0.0)
    glow = 0.25 * (0.5 * _shade() + (LIGHT.direct_lx * through / np.pi)[:, None, None])
    front = np.broadcast_to(glow, SKY.shape)
    view = _view(_pictures(openness, foreground=front))
    cloth = (slice(4, 28), slice(16, 30))
    assert (view.low[cloth] == 0.0).all()
    assert np.median(view.high[cloth]) > 0.1
    row, column = GRID.pixels(LIGHT.apparent_sun_direction)
    behind = (row > 0) & (row < 32) & (column >= 14) & (column < 32) & (LIGHT.direct_lx > 1e3)
    assert behind.sum() >= 3
    settled = _view(_pictures(openness, foreground=front), np.where(behind, 0.0, np.nan))
    assert np.median(settled.high[cloth]) == 0.0
    assert "glazing may scatter" in view.notes[0] and "glazing" not in str(settled.notes)
    # south of the tropic the sun passes north: what glows in the south is a sunlit ceiling
    far = _view(_pictures(openness, foreground=front), latitude_deg=-60.0)
    assert (far.high[cloth] == 0.0).all() and "glazing" not in str(far.notes)


@pytest.mark.property
def test_the_sky_is_symmetric_about_the_sun_and_shows_the_heading() -> None:
    """A heading that is 4 degrees wrong is found from the gradation of the sky, without a disc."""
    openness, rays = np.zeros((32, 32)), RAYS.reshape(-1, 3)
    openness[2:30, 4:28] = 1.0
    turned = LIGHT.sky_at(rays @ rotation(4.0, 0.0, 0.0, 180.0).T).reshape(SKY.shape)
    view = _view(_pictures(openness) * turned / SKY)
    assert view.pose.heading_deg == pytest.approx(4.0, abs=2.0 * view.pose.heading_sd_deg)
    assert view.pose.heading_sd_deg < 0.7 and "brightness about the sun" in str(view.notes)
    same = _view(_pictures(openness))
    assert abs(same.pose.heading_deg) < 2.0 * same.pose.heading_sd_deg < 1.4


@pytest.mark.analytic
def test_edges_and_bars_of_coarse_pictures_are_where_openness_puts_them() -> None:
    """In pixels of 3 degrees: an edge at 0.4 of a pixel, and a bar of 1 degree between two."""
    openness = np.ones((12, 12), np.float32)
    openness[:, :2], openness[:, 2] = 0.0, 0.6  # open from column 2.4
    openness[:, 6], openness[:, 7] = 0.75, 0.92  # a bar from column 6.75 to 7.08
    full, grid = (
        np.full_like(openness, 0.8),
        SkyGrid(
            first_altitude_deg=36.0,
            first_azimuth_deg=-18.0,
            step_deg=3.0,
            heading_deg=180.0,
            height=12,
            width=12,
        ),
    )
    through = openness * full
    view = SkyView(grid, openness, 0 * full, full, full, 0 * full, full)
    fine = SkyGrid(
        first_altitude_deg=36.0,
        first_azimuth_deg=-18.0,
        step_deg=0.125,
        heading_deg=180.0,
        height=288,
        width=288,
    )
    mean = view.beam_shares(fine.rays())[0].reshape(12, 24, 12, 24).mean(axis=(1, 3))
    assert mean[1:-1, :] == pytest.approx(through[1:-1, :], abs=0.04)
    for column, share in ((2.2, 0.0), (2.6, 0.8), (5.9, 0.8), (6.5, 0.8), (6.9, 0.0), (7.4, 0.8)):
        light = _at(view, 6.5, column)
        got = disc_of_hours(view, light)
        assert got.best_lx / light.direct_lx == pytest.approx(share, abs=0.1), column
        assert got.low_lx <= got.best_lx <= got.high_lx
    # a tree's crown, thinner towards the open sky: without an open pixel beside it there is no edge
    crown = np.ones((12, 12), np.float32)
    crown[:, :3] = 0.0, 0.06, 0.3
    leaves = SkyView(grid, crown, 0 * full, full, full, 0 * full, 0.8 + 0 * full)
    for column in (1.2, 1.5, 1.8):
        light = _at(leaves, 6.5, column)
        got = disc_of_hours(leaves, light)
        assert got.best_lx / light.direct_lx == pytest.approx(0.06 * 0.8, abs=0.01)
        assert got.high_lx / light.direct_lx == pytest.approx(0.8, abs=0.01)


@pytest.mark.analytic
def test_a_bar_within_a_pixel_can_be_anywhere_in_it() -> None:
    """In pixels of 3 degrees: a bar of 0.7 degrees in one column, and one between two columns."""
    openness = np.ones((12, 12), np.float32)
    openness[:, 3] = 0.77
    openness[:, 7], openness[:, 8] = 0.88, 0.89
    full, grid = (
        np.ones_like(openness),
        SkyGrid(
            first_altitude_deg=36.0,
            first_azimuth_deg=-18.0,
            step_deg=3.0,
            heading_deg=180.0,
            height=12,
            width=12,
        ),
    )
    mixed = openness < 1.0
    view = SkyView(grid, openness, 0 * full, full, full, np.where(mixed, 0.0, full), full)
    fine = SkyGrid(
        first_altitude_deg=36.0,
        first_azimuth_deg=-18.0,
        step_deg=0.125,
        heading_deg=180.0,
        height=288,
        width=288,
    )
    _, low, high = view.beam_shares(fine.rays())
    assert (low[24:-24, 72:96] == 0.0).all() and (high[24:-24, 72:96] == 1.0).all()
    assert (low[24:-24, 100:164] == 1.0).all() and (low[24:-24, 168:176] == 1.0).all()


@pytest.mark.analytic
def test_a_direction_that_few_captures_show_is_not_sky() -> None:
    """Merge kept a wall of one capture: a single ratio has no spread, which shows nothing."""
    openness = np.ones((32, 32))
    openness[:, 20:] = 0.0
    pictures = _pictures(openness)
    pictures[1:, :, 24:] = np.nan
    view = _view(pictures)
    assert (view.openness[:, 25:] == 0.0).all() and (view.low[:, 25:] == 0.0).all()
    assert (view.high[:, 25:] > 0.05).all()
    assert np.median(view.openness[:, :18]) > 0.9


@pytest.mark.analytic
def test_an_edge_of_sky_does_not_narrow_the_bounds_of_undecided_directions() -> None:
    """Next to open sky: to the right captures left open what is seen, to the left is a wall."""
    openness, full = np.zeros((12, 12), np.float32), np.ones((12, 12), np.float32)
    openness[:, 4:8] = 1.0
    grid = replace(GRID, step_deg=3.0, height=12, width=12)
    undecided = np.zeros((12, 12), np.float32)
    undecided[:, 8:] = 1.0
    high = np.maximum(undecided, 1.0 * (np.arange(12) >= 3)).astype(np.float32)  # 3: an edge may be
    view = SkyView(grid, openness, undecided / 12**0.5, full, full, 0 * full, high)
    for column, highest in ((3.5, 0.0), (5.5, 1.0), (8.5, 1.0), (9.5, 1.0)):
        light = _at(view, 6.5, column)
        disc = disc_of_hours(view, light)
        assert disc.high_lx / light.direct_lx == pytest.approx(highest), column
        assert (disc.best_lx > 0.0) == (column == 5.5)


@pytest.mark.analytic
def test_edges_of_sky_behind_dark_glass_are_as_sharp_as_behind_clear_glass() -> None:
    openness = np.zeros((32, 32))
    openness[4:28, 4:28], openness[4:28, 27:29] = 1.0, 0.5
    fine = replace(GRID, step_deg=0.125, height=256, width=256).rays()
    suns = np.array(GRID.pixels(LIGHT.apparent_sun_direction))
    inside = (np.abs(suns - 16.0) < 8.0).all(axis=0) & (LIGHT.direct_lx > 10_000.0)
    widths = []
    for tau in (0.6, 0.15):
        shares = np.where(inside, tau, np.nan)
        view = _view(_pictures(openness, tau, foreground=0.1 * tau * _shade()), shares)
        _, low, high = view.beam_shares(fine)
        widths.append(((high - low) / tau)[:, 208:].mean())
    assert widths[1] == pytest.approx(widths[0], rel=0.1)


@pytest.mark.analytic
def test_a_slanted_bar_narrower_than_a_pixel_is_not_broken() -> None:
    """In pixels of 3 degrees: half a pixel wide, it rises by a pixel in three."""
    row, column = (np.mgrid[:288, :288] + 0.5) / 24.0
    bar = np.abs(row - 4.0 - column / 3.0) < 0.25
    openness = 1.0 - bar.reshape(12, 24, 12, 24).mean(axis=(1, 3), dtype=np.float32)
    full, grid = (
        np.ones_like(openness),
        SkyGrid(
            first_altitude_deg=36.0,
            first_azimuth_deg=-18.0,
            step_deg=3.0,
            heading_deg=180.0,
            height=12,
            width=12,
        ),
    )
    view = SkyView(grid, openness, 0 * full, full, full, 0 * full, full)
    best = view.beam_shares(
        SkyGrid(
            first_altitude_deg=36.0,
            first_azimuth_deg=-18.0,
            step_deg=0.125,
            heading_deg=180.0,
            height=288,
            width=288,
        ).rays()
    )[0]
    assert (best == 0.0).any(axis=0)[24:-24].all()
    assert (best == ~bar).mean() > 0.95


@pytest.mark.analytic
def test_directions_that_no_lens_saw_are_nan_and_not_zero() -> None:
    pictures = _pictures(np.ones((32, 32)))
    pictures[:, :, :8] = np.nan
    view = _view(pictures)
    for channel in (view.openness, view.low, view.high):
        assert np.isnan(channel[:, :8]).all() and np.isfinite(channel[:, 8:]).all()
    light = _at(view, 10, 3)
    disc = disc_of_hours(view, light)
    assert disc.not_seen.all()
    room = Room(window=(Window("south", 0.1, 5.8, 0.1, 4.2, 0.88, 1, 0.0, 0.0),))
    filled = disc_lx(view, SiteFile(SITE, room=room), light)
    assert filled[0] > 0.5 * light.direct_lx[0]
    assert "stated room where no lens saw" in disc_source(view, SiteFile(SITE, room=room))


def _at(view: SkyView, row: float, column: float) -> Light:
    """Return a sunny hour whose sun is shown at a pixel of the view."""
    altitude = view.grid.first_altitude_deg - row * view.grid.step_deg
    azimuth = view.grid.heading_deg + view.grid.first_azimuth_deg + column * view.grid.step_deg
    one = LIGHT[[int(np.argmax(LIGHT.dni_wm2))]]
    return Light(
        t_utc=one.t_utc,
        dni_wm2=one.dni_wm2,
        dhi_wm2=one.dhi_wm2,
        sun_altitude_deg=np.array([altitude]),
        sun_azimuth_deg=np.array([azimuth]),
        refraction=False,
    )


def _edge_view(heading_sd_deg: float) -> SkyView:
    """An open right half with sharp edges at 0.1 degrees."""
    grid = SkyGrid(
        first_altitude_deg=30.0,
        first_azimuth_deg=-10.0,
        step_deg=0.1,
        heading_deg=180.0,
        height=200,
        width=200,
    )
    openness = np.zeros((200, 200), np.float32)
    openness[:, 100:] = 1.0
    full = np.full_like(openness, 0.8)
    through = openness * 0.8
    variances = np.diag([heading_sd_deg**2, 0.25**2, 0.25**2, 0.0])
    pose = CameraPose(covariance=tuple(map(tuple, variances)))
    return SkyView(grid, openness, 0 * full, full, full, through, through, 50, pose)


@pytest.mark.analytic
def test_the_disc_is_a_mean_and_the_heading_doubts_its_edge() -> None:
    """At the edge half of the disc is seen; with 1 degree of doubt it is anything there."""
    view = _edge_view(1.0)
    for column, share in ((50, 0.0), (100, 0.4), (150, 0.8)):
        light = _at(view, 100, column)
        got = disc_of_hours(view, light).best_lx / light.direct_lx
        assert got == pytest.approx(share, abs=0.06)
    near = _at(view, 100, 108)
    drawn = drawn_shares(view, near, np.random.default_rng(0))[:, 0]
    assert (drawn == 0.0).any() and (drawn > 0.79).any()
    sure = drawn_shares(_edge_view(0.0), near, np.random.default_rng(0))[:, 0]
    assert (sure > 0.75).all()
    weak = Light(
        t_utc=near.t_utc,
        dni_wm2=np.array([1.5]),
        dhi_wm2=near.dhi_wm2,
        sun_altitude_deg=near.sun_altitude_deg,
        sun_azimuth_deg=near.sun_azimuth_deg,
        refraction=False,
    )
    disc = disc_of_hours(view, weak)  # within the readings' errors: no picture shows such a disc
    assert disc.best_lx[0] == 0.0 and disc.high_lx[0] > 0.0
    turned = replace(view, pose=CameraPose(heading_deg=2.0))  # true heading is 2 degrees more
    assert disc_of_hours(turned, near).best_lx[0] == 0.0


@pytest.mark.analytic
def test_captures_that_contradict_the_view_correct_it() -> None:
    """A blind that the ratio cannot show: captures without a disc shut the sky there, by name."""
    pictures = _pictures(np.ones((32, 32)))
    row, column = GRID.pixels(LIGHT.apparent_sun_direction)
    inside = (row > 4) & (row < 28) & (column > 4) & (column < 28) & (LIGHT.direct_lx > 1e3)
    assert inside.any()
    k = int(np.flatnonzero(inside)[0])
    shares = np.full(len(LIGHT), np.nan)
    shares[k] = 0.0
    view = _view(pictures, shares)
    assert disc_of_hours(view, LIGHT[[k]]).best_lx[0] < 0.4 * LIGHT.direct_lx[k]
    assert any("contradict" in note for note in view.notes)


@pytest.mark.analytic
def test_a_blind_that_nobody_marked_does_not_shut_the_sky() -> None:
    """One capture through a lowered blind is dark where the others show the sky: it is named."""
    pictures = _pictures(np.ones((32, 32)))
    row, column = GRID.pixels(LIGHT.apparent_sun_direction)
    inside = (row > 4) & (row < 28) & (column > 4) & (column < 28) & (LIGHT.direct_lx > 1e3)
    k = int(np.flatnonzero(inside)[0])
    pictures[k] *= 0.1
    shares = np.full(len(LIGHT), np.nan)
    shares[k] = 0.0
    view = _view(pictures, shares)
    assert disc_of_hours(view, LIGHT[[k]]).best_lx[0] > 0.6 * LIGHT.direct_lx[k]
    assert any(
        "blind" in note and f"{LIGHT.t_utc[k]:%Y-%m-%d %H:%M}" in note for note in view.notes
    )
    assert not any("contradict" in note for note in view.notes)


@pytest.mark.analytic
@pytest.mark.parametrize(("share", "rows"), [(0.15, 32), (0.35, 32), (0.35, 14)])
def test_captures_through_blinds_that_nobody_marked_are_named_and_omitted(
    share: float, rows: int
) -> None:
    """Blinds darken all of the window, or its upper part, in a third of the captures."""
    openness = np.zeros((32, 32))
    openness[2:30, 3:29] = 1.0
    pictures = _pictures(openness)
    down = np.random.default_rng(0).random(len(LIGHT)) < share
    pictures[down, :rows] *= 0.1
    view = _view(pictures)
    (note,) = (note for note in view.notes if "blind" in note)
    assert abs(int(note.split()[0]) - down.sum()) <= 2
    assert (view.openness[openness == 1] > 0.9).all()
    untouched = _view(_pictures(openness))
    assert not any("blind" in note for note in untouched.notes)


def _leaves(rows: Indices) -> tuple[SkyView, Mask, dict[str, Floats]]:
    """Return the view of some captures, where a tree is, and openness with leaves and without."""
    texture = np.random.default_rng(1).random((32, 32))
    tree = np.zeros((32, 32), bool)
    tree[6:26, 4:28] = True
    openness = {
        "summer": np.where(tree & (texture < 0.85), 0.0, 1.0),
        "winter": np.where(tree & (texture < 0.15), 0.0, 1.0),
    }
    is_summer = np.array([5 <= t.month <= 10 for t in LIGHT.t_utc])[:, None, None]
    shown = np.where(is_summer, openness["summer"], openness["winter"])
    return _view(_pictures(shown), rows=rows), tree, openness


EVERY = np.arange(len(LIGHT))
DAYS = np.array([t.timetuple().tm_yday for t in LIGHT.t_utc])


@pytest.mark.analytic
def test_leaves_of_summer_give_bounds_over_the_year_and_a_view_for_each_season() -> None:
    """Captures of all seasons show that leaves come and go: the year's view has bounds there."""
    view, tree, openness = _leaves(EVERY)
    for true in openness.values():
        through = 0.8 * true[tree]
        held = (through >= view.low[tree] - 0.02) & (through <= view.high[tree] + 0.02)
        assert held.mean() > 0.95
    for day, season in ((10, "winter"), (90, "winter"), (180, "summer"), (280, "summer")):
        ((_, then),) = view.of_hours(_on(day))
        through = 0.8 * openness[season][tree]
        assert then is not view
        assert ((through >= then.low[tree] - 0.02) & (through <= then.high[tree] + 0.02)).all()
        assert ((then.through[tree] > 0.02) == (through > 0.02)).mean() > 0.97
    assert any("open in one season" in note for note in view.notes)
    winter = _pictures(np.broadcast_to(openness["winter"], (len(LIGHT), 32, 32)))
    steady = _view(winter)
    assert not any("season" in note for note in steady.notes) and not steady.others


@pytest.mark.analytic
def test_months_between_an_equinox_and_a_summer_block_are_intervals_and_named() -> None:
    view, tree, openness = _leaves(np.flatnonzero(np.isin(DAYS, (50, 90, 170, 210))))
    (note,) = (note for note in view.notes if "season" in note)
    assert note.endswith(
        "in (parts of) January, May, August, September, October, November, December"
    )
    for day in (130, 300):
        ((_, then),) = view.of_hours(_on(day))
        assert then is view
        changed = tree & (openness["summer"] != openness["winter"])
        assert (view.low[changed] == 0.0).mean() > 0.95 and (view.high[changed] > 0.5).mean() > 0.95


def _on(day: int) -> Light:
    """Return an hour on a day of the year."""
    start = datetime(2027, 1, 1, 12, tzinfo=UTC)
    return light_at([start + timedelta(days=day - 1)], SITE, np.array([500.0]), np.array([80.0]))


@pytest.mark.analytic
def test_each_marked_state_has_its_own_view(tmp_path: Path) -> None:
    """A blind is half down, or the glass is tinted, in marked hours; another has few captures."""
    openness, half = np.zeros((32, 32)), np.zeros((32, 32))
    openness[2:30, 3:29], half[16:30, 3:29] = 1.0, 1.0
    states = np.array(["", "blind=half", "tint=full", "", "lamp=on", "snow=yes"] * 20)[EVERY]
    states[:3] = "blind=down"
    of_state = {"blind=half": _pictures(half), "tint=full": _pictures(openness, 0.1)}
    pictures = np.array([of_state.get(s, _pictures(openness))[k] for k, s in enumerate(states)])
    light = replace(LIGHT, states=tuple(states.tolist()))

    def read(k: int) -> SkyPicture:
        return SkyPicture(pictures[k].astype(np.float32), np.zeros((32, 32), bool), GRID)

    captured = Captured(light, read, np.full(len(LIGHT), np.nan))
    estimated = sky_view_of(captured, NO_DISCS, SITE, 180.0)
    assert any(n.startswith("blind=half:") and "view of their own" in n for n in estimated.notes)
    assert any(n.startswith("blind=down: 3 captures, too few") for n in estimated.notes)
    estimated.write(tmp_path / "sky_view.exr")
    for view in (estimated, SkyView.read(tmp_path / "sky_view.exr")):
        high, low = _at(view, 8.5, 15.5), _at(view, 23.5, 15.5)
        for state, shares in {
            "": (0.8, 0.8),
            "lamp=on": (0.8, 0.8),
            "blind=half": (0.0, 0.8),
            "tint=full;lamp=on": (0.1, 0.1),
        }.items():
            for hour, share in zip((high, low), shares, strict=True):
                disc = disc_of_hours(view, replace(hour, states=(state,)))
                assert disc.best_lx / hour.direct_lx == pytest.approx(share, rel=0.25), state
                drawn = drawn_shares(view, replace(hour, states=(state,)), np.random.default_rng(0))
                assert drawn.min() <= share + 0.01 and drawn.max() >= share - 0.01
        unknown = disc_of_hours(view, replace(high, states=("blind=down",)))
        assert unknown.low_lx == 0.0 and unknown.high_lx > 0.7 * high.direct_lx
        turned = view.turned(5.0, 1.0)
        assert {v.grid for v in (turned, *turned.others)} == {turned.grid}


@pytest.mark.analytic
def test_without_a_usual_capture_the_most_frequent_state_stands_for_it() -> None:
    pictures = _pictures(np.ones((32, 32)), 0.1)
    light = replace(LIGHT, states=("tint=full",) * len(LIGHT))
    clipped = np.zeros((32, 32), bool)
    captured = Captured(
        light,
        lambda k: SkyPicture(pictures[k].astype(np.float32), clipped, GRID),
        np.full(len(LIGHT), np.nan),
    )
    view = sky_view_of(captured, NO_DISCS, SITE, 180.0)
    assert view.state == "tint=full" and not view.others
    hour = _at(view, 15.5, 15.5)
    for state in ("", "tint=full"):
        disc = disc_of_hours(view, replace(hour, states=(state,)))
        assert disc.best_lx / hour.direct_lx == pytest.approx(0.1, rel=0.2)


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("factor", "openness", "text"),
    [
        (1 / 179, 1.0, "WARNING: the sky in the window has"),
        (0.1, 1.0, "if the glass is clear (0.6 to 0.9), check"),
        (2.5, 1.0, "WARNING: the sky in the window has"),
        (1 / 179, 0.02, ""),
        (0.7, 1.0, ""),
    ],
)
def test_pictures_in_another_unit_are_told_by_the_sky_in_the_window(
    factor: float, openness: float, text: str
) -> None:
    """W/sr/m2 taken for cd/m2 are 179 times too dark; no glass makes the sky brighter.

    A camera that sees no window sees surfaces that follow the sky a little: there is no warning.
    Ten times too dark may be tinted glass: it is a note.
    """
    share = np.full((32, 32), 0.02)
    share[10:22, 10:22] = openness
    notes = " ".join(_view(factor * _pictures(share, foreground=0.0 * SKY)).notes)
    assert text in notes
    assert text or "luminance" not in notes


@pytest.mark.property
def test_few_captures_leave_open_what_many_decide() -> None:
    """A bright wall in light that varies by a fifth."""
    share = np.zeros((32, 32))
    share[4:28, 3:14] = 1.0
    flicker = np.random.default_rng(2).lognormal(0.0, 0.2, SKY.shape)
    wall = 0.8 * _shade() * flicker
    pictures = _pictures(share, foreground=wall)
    few = np.arange(0, len(LIGHT), len(LIGHT) // 8)[:8]
    many, little = _view(pictures), _view(pictures, rows=few)
    assert np.median(many.high[6:26, 18:30]) == 0.0
    assert np.median(little.high[6:26, 18:30]) > 0.5
    width = little.high - little.low
    assert (little.u >= 0.28 * width)[6:26, 18:30].mean() > 0.95  # as of a uniform distribution
    assert "8 captures give a first look" in " ".join(little.notes)
    assert "first look" not in " ".join(many.notes)


@pytest.mark.analytic
def test_captures_with_the_sun_behind_the_camera_do_not_tell_a_facade_from_sky() -> None:
    """Sky, and a sunlit facade; the sun is in the south, the camera looks north or south."""

    def view_of(heading_deg: float, rows: Indices) -> SkyView:
        grid = replace(GRID, heading_deg=heading_deg)
        sky = LIGHT.sky_at(grid.rays().reshape(-1, 3)).reshape(-1, 32, 32) * _clouds()
        facade = 0.25 * sky + 0.3 * LIGHT.direct_lx[:, None, None] / np.pi
        column = np.arange(32)
        pictures = np.where(column < 15, 0.8 * sky, np.where(column < 18, 0.1 * _shade(), facade))

        def read(k: int) -> SkyPicture:
            return SkyPicture(pictures[k].astype(np.float32), np.zeros((32, 32), bool), grid)

        captured = Captured(LIGHT, read, np.full(len(LIGHT), np.nan))
        return estimate(captured.take(rows.tolist()))

    clear = np.flatnonzero(LIGHT.direct_lx > 20_000.0)
    behind = view_of(0.0, clear)
    assert (behind.low == 0.0).all()
    assert np.median(behind.high[6:26, 2:13]) > 0.5 and np.median(behind.high[6:26, 20:30]) > 0.5
    note = "no clear capture has the sun in front of the window"
    assert note in " ".join(behind.notes)
    overcast = np.flatnonzero(LIGHT.direct_lx < 1.0)
    azimuth_deg = LIGHT.sun_azimuth_deg[clear] - 180.0
    in_front = clear[np.abs(azimuth_deg) < 40.0]  # no capture without the sun in front
    assert len(in_front) >= 12
    rows_of_heading = [(180.0, clear), (180.0, in_front), (0.0, overcast)]
    for view in (view_of(*heading_rows) for heading_rows in rows_of_heading):
        assert note not in " ".join(view.notes)
        assert np.median(view.low[6:26, 2:13]) > 0.2


@pytest.mark.analytic
def test_few_captures_give_bounds_and_say_what_to_capture() -> None:
    light, pictures = LIGHT[[0, 5, 9]], _pictures(np.ones((32, 32)))[[0, 5, 9]]
    clipped = np.zeros((32, 32), bool)

    def read(k: int) -> SkyPicture:
        return SkyPicture(pictures[k].astype(np.float32), clipped, GRID)

    view = estimate(Captured(light, read, np.full(3, np.nan)))
    assert (view.low == 0.0).all() and (view.high > 0.3).mean() > 0.9
    assert any("capture overcast" in note for note in view.notes)


@pytest.mark.contract
def test_a_view_is_read_as_it_was_written(tmp_path: Path) -> None:
    view = replace(_edge_view(2.0), notes=("a note",), inputs={"pairs": "abc"})
    view.write(tmp_path / "sky_view.exr")
    back = SkyView.read(tmp_path / "sky_view.exr")
    assert (back.grid, back.pose, back.notes) == (view.grid, view.pose, view.notes)
    np.testing.assert_array_equal(back.through, view.through)
    (tmp_path / "other.exr").write_bytes(b"no exr")
    with pytest.raises(InputError, match=r"other\.exr.*run fieldlum pair"):
        SkyView.read(tmp_path / "other.exr")
    assert SkyView.find(tmp_path / "none.exr") is None


@pytest.mark.analytic
def test_sixteen_captures_without_a_disc_show_the_sky() -> None:
    """As many as two or three days give; real skies differ from Perez's by a quarter."""
    rows = np.linspace(0, len(LIGHT) - 1, 16).astype(int)
    openness = np.zeros((32, 32))
    openness[4:28, 4:28] = 1.0
    view = _view(_pictures(openness), rows=rows)
    assert (view.openness[openness == 0] == 0.0).all()
    assert (view.openness[openness == 1] > 0.9).mean() > 0.99


@pytest.mark.contract
@pytest.mark.parametrize(
    ("channel", "value", "about", "found"),
    [
        ("u", 0.1, {}, ""),
        ("openness", 87.0, {}, "openness of 87, which is no share"),
        ("low", 0.9, {}, "low above high"),
        ("u", 0.1, {"frame": "camera"}, "azimuths from 'camera' instead of 'true north'"),
        ("u", 0.1, {"height": 16}, "channels that are not 32 x 16 pixels"),
        ("u", 0.1, {"step_deg": 12.0}, "a grid from -352 to 32 degrees"),
        ("u", 0.1, {"format": 2}, "format 2"),
    ],
)
def test_a_view_from_elsewhere_needs_frame_units_and_size(
    tmp_path: Path, channel: str, value: float, about: dict[str, object], found: str
) -> None:
    """Written by OpenEXR, with format and grid alone."""
    channels = {str(name): np.full((32, 32), 0.5, np.float32) for name in CHANNELS}
    channels[channel] = np.full((32, 32), value, np.float32)
    grid = asdict(GRID) | {k: v for k, v in about.items() if k in asdict(GRID)}
    text = json.dumps({"format": 1, **about, "grid": grid})
    OpenEXR.File({"fieldlum:sky_view": text}, channels).write(str(tmp_path / "v.exr"))
    if found:
        with pytest.raises(InputError, match=f"{found}.*docs/sky-view.md"):
            SkyView.read(tmp_path / "v.exr")
    else:
        view = SkyView.read(tmp_path / "v.exr")
        assert view.captures == 0 and (view.through == 0.25).all()
        assert disc_source(view, SiteFile(SITE), "v.exr") == "the sky view in v.exr"


@pytest.mark.property
def test_bright_directions_that_follow_no_sky_are_not_decided() -> None:
    """As bright as sky, but nothing shows that it is sky."""
    flicker = np.random.default_rng(1).lognormal(0.0, 0.8, SKY.shape)
    view = _view(0.6 * SKY * flicker)
    assert not view.openness.any() and (view.low == 0.0).all()
    assert (view.high > 0.5).all() and "not known" in view.notes[0]
