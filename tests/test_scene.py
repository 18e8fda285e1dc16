"""Sun patches against hand geometry and against Radiance; the window's share of each pixel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.records import Obstruction, Room, Window
from fieldlum.optics.images import RADIANCE_LM_PER_W
from fieldlum.optics.profiles import shipped
from fieldlum.optics.projection import equirect_pixel
from fieldlum.room import scene
from fieldlum.room.scene import box_room, radiance, view
from fieldlum.session.site_toml import load_site
from fieldlum.sky import sun

OFFICE = load_site(shipped("capture_plans") / "seattle-office.toml")
BARE = Room(
    width_m=4,
    depth_m=5,
    height_m=3,
    camera_x_m=2,
    camera_y_m=2.5,
    camera_z_m=1.5,
    window=(
        Window(
            "south", left_m=1, width_m=2, sill_m=1, height_m=1.5, transmittance=0.88, frame_m=0.0
        ),
    ),
)
CORNER = Room(
    width_m=5,
    depth_m=6,
    height_m=3,
    camera_x_m=2,
    camera_y_m=3,
    camera_z_m=1.2,
    wall_azimuth_deg=150,
    wall_thickness_m=0.3,
    window=(
        Window(
            "south",
            left_m=0.4,
            width_m=4,
            sill_m=0.8,
            height_m=1.9,
            panes=3,
            frame_m=0.06,
            transom_m=2.0,
        ),
        Window("west", left_m=1, width_m=2.5, sill_m=0.5, height_m=2.2, panes=2, transmittance=0.7),
    ),
    obstruction=(
        Obstruction(0.5, 0.8, 0.7, 1.8, 0.9, 0.05, 0.4),
        Obstruction(-4, -14, -0.05, 12, 5, 9, 0.6),  # a building across the street
        Obstruction(0.4, -0.9, 2.5, 4.3, 0.6, 0.05, 0.5),  # a light shelf
    ),
)


def _heading(room: Room) -> float:
    return room.wall_azimuth_deg


def disc_of(room: Room, suns: Floats) -> tuple[Floats, Floats]:
    """The visible share of each sun's disc, and its glass's transmittance."""
    built = box_room.build(room)
    return scene.disc_visibility(built, built.to_room(suns))


@pytest.mark.contract
@pytest.mark.parametrize(
    "path", sorted(shipped("capture_plans").glob("*.toml")), ids=lambda path: path.stem
)
def test_shipped_rooms_can_be(path: Path) -> None:
    room = load_site(path).room
    assert room is not None and box_room.build(room).openings


@pytest.mark.slow
@pytest.mark.analytic
def test_patch_on_the_floor_by_hand() -> None:
    """Sun from due south at 45 degrees; window z 1 to 2.5, x 1 to 3, wall .25 m thick.

    The outer sill shades: on the floor the light runs from y = 1 (inner sill) to y = 2.5 - .25
    (outer lintel).
    """
    made = scene.sun_patches(
        BARE, sun.direction(45.0, 180.0)[None], [10000.0], height=180, heading_deg=180.0
    )
    through, _ = box_room.glass_optics(0.88, np.cos(np.radians(45.0)))
    expected = 10000.0 * float(through) * np.sin(np.radians(45.0)) * 0.2 / np.pi
    eye = np.array([2.0, 2.5, 1.5])
    for x, y, lit in (
        (2, 1.05, True),
        (2, 0.95, False),
        (2, 2.2, True),
        (2, 2.3, False),
        (1.05, 1.5, True),
        (0.95, 1.5, False),
        (2.95, 1.5, True),
    ):
        ray = np.array([x, y, 0.0]) - eye
        altitude = np.degrees(np.arcsin(ray[2] / np.linalg.norm(ray)))
        azimuth = np.degrees(np.arctan2(ray[0], ray[1]))
        row, column = equirect_pixel(altitude, azimuth, 180, 360, 180.0)
        found = made[0, int(row), int(column)]
        assert found == pytest.approx(expected if lit else 0.0, rel=1e-5), (x, y)


@pytest.mark.analytic
def test_normal_glass_passes_what_it_says() -> None:
    """.88 at normal incidence gives transmissivity .96, as Radiance's manual has it;
    grazing gives none.
    """
    through, back = box_room.glass_optics(0.88, [1.0, 0.5, 1e-6])
    assert through[0] == pytest.approx(0.88, abs=1e-4)
    assert box_room.transmissivity(0.88) == pytest.approx(0.96, abs=2e-3)
    assert through[2] < 1e-3 and back[2] > 0.99
    assert (through + back <= 1).all()


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("room", [OFFICE.room, CORNER], ids=["office", "corner"])
def test_patches_authority_rtrace(room: Room) -> None:
    """Radiance's rtrace -ab 0 on the same boxes, panes and rays: equal but for rays that graze
    an edge.
    """
    assert room is not None
    height, heading = 40, _heading(room)
    built = box_room.build(room)
    text = radiance.rad_text(built)
    pixel, rays = view.pixel_rays(height, heading, view.patch_rays(height))
    for altitude, turn in ((45.0, 0.0), (20.0, 35.0), (35.0, 90.0), (15.0, -120.0)):
        toward = sun.direction(altitude, heading + turn)
        made = scene.sun_patches(room, toward[None], [179.0], height=height, heading_deg=heading)
        with radiance.octree(text, radiance.sun_text(built.to_room(toward))) as octree:
            seen = radiance.trace(octree, np.array(built.camera_m), built.to_room(rays), ["-dv-"])
        truth = radiance._pixel_mean(pixel, seen, height) * RADIANCE_LM_PER_W
        off = np.abs(made[0] - truth) > 0.02 * max(truth.max(), 1e-6)
        assert off.mean() < 4e-3
        assert made[0].sum() == pytest.approx(truth.sum(), rel=3e-3, abs=1e-3)


@pytest.mark.authority
@pytest.mark.parametrize("room", [OFFICE.room, CORNER], ids=["office", "corner"])
def test_window_fraction_authority_rtrace(room: Room) -> None:
    """The room under a sky of one, nothing else, by rtrace."""
    assert room is not None
    height, heading = 40, _heading(room)
    built = box_room.build(room)
    pixel, rays = view.pixel_rays(height, heading, 3)
    with radiance.octree(radiance.rad_text(built), radiance.SKY_TEXT) as octree:
        seen = radiance.trace(octree, np.array(built.camera_m), built.to_room(rays))
    truth = radiance._pixel_mean(pixel, seen, height)
    found = scene.traced_view(room, height, heading).sky
    assert found.max() > 0.6
    assert np.abs(found - truth).max() < 0.12 and np.abs(found - truth).mean() < 2e-4


@pytest.mark.analytic
def test_disc_is_seen_through_glass_and_hidden_by_frames() -> None:
    """The office sees the sun at 20 degrees, 10 beside south; due south the middle bar
    hides it.
    """
    assert OFFICE.room is not None
    suns = sun.direction([20.0, 20.0, 60.0, 20.0, -5.0], [190.0, 180.0, 180.0, 0.0, 190.0])
    visible, glass = disc_of(OFFICE.room, suns)
    assert visible.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    through = float(box_room.glass_optics(0.88, np.cos(np.radians(20)) * np.cos(np.radians(10)))[0])
    assert glass[0] == pytest.approx(through, rel=1e-6)


@pytest.mark.analytic
def test_a_bar_narrower_than_the_disc_hides_part_of_it() -> None:
    thin = replace(BARE, window=(replace(BARE.window[0], panes=2, frame_m=0.01),))
    visible, _ = disc_of(thin, sun.direction([15.0], [180.0]))
    assert 0.1 < visible[0] < 0.9  # 1 cm against 2.4 cm of disc at 2.6 m


@pytest.mark.property
@settings(deadline=None, max_examples=12)
@given(st.floats(3, 70), st.floats(-80, 80), st.floats(0, 360))
def test_turning_the_world_turns_nothing(altitude: float, turn: float, north: float) -> None:
    """A room, its camera and the sun turned together give the same picture."""
    base = scene.sun_patches(
        BARE, sun.direction(altitude, 180 + turn)[None], 1e4, height=16, heading_deg=180
    )
    turned = replace(BARE, wall_azimuth_deg=(180 + north) % 360)
    other = scene.sun_patches(
        turned,
        sun.direction(altitude, 180 + turn + north)[None],
        1e4,
        height=16,
        heading_deg=180 + north,
    )
    differ = np.abs(base - other) > 0.12 * max(base.max(), 1)
    assert differ.mean() < 0.01
    shares = [
        disc_of(room, sun.direction([altitude], [180 + turn + to]))[0]
        for room, to in ((BARE, 0.0), (turned, north))
    ]
    assert shares[0] == pytest.approx(shares[1], abs=0.05)


@pytest.mark.property
def test_mirror_symmetry() -> None:
    """A symmetric room, the sun mirrored east-west, gives the mirrored picture."""
    suns = sun.direction([30.0, 30.0], [150.0, 210.0])
    made = scene.sun_patches(BARE, suns, 1e4, height=30, heading_deg=180.0)
    assert made[0] == pytest.approx(made[1][:, ::-1], abs=0.15 * float(made.max()))
    assert made[0].sum() == pytest.approx(made[1].sum(), rel=5e-3)


@pytest.mark.property
@pytest.mark.numeric
def test_one_hour_equals_that_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    suns = sun.direction(np.linspace(5, 60, 7), np.linspace(120, 240, 7))
    lx = np.linspace(0, 6e4, 7)
    whole = scene.sun_patches(CORNER, suns, lx, height=12, heading_deg=150.0)
    monkeypatch.setitem(scene.sun_patches.__globals__, "_HOURS", 3)  # of its module
    parts = scene.sun_patches(CORNER, suns, lx, height=12, heading_deg=150.0)
    assert np.array_equal(parts, whole) and whole[0].max() == 0 < whole[1:].max()
    for k in range(7):  # pair computes the slots that lack a patch, whichever they are
        alone = scene.sun_patches(CORNER, suns[k], lx[k], height=12, heading_deg=150.0)
        assert np.array_equal(alone[0], whole[k])


@pytest.mark.analytic
def test_a_pixel_at_a_patchs_edge_has_its_lit_share() -> None:
    """The floor is lit up to y = 2.25 m, as in the test by hand: a pixel that this line crosses has
    the share of its solid angle above it.
    """
    height, eye_m = 60, np.array([2.0, 2.5, 1.5])
    suns, lx = sun.direction(45.0, 180.0)[None], [10000.0]
    made = scene.sun_patches(BARE, suns, lx, height=height, heading_deg=180.0)
    edge = np.arctan2(eye_m[2], eye_m[1] - 2.25) / np.pi + 0.5  # of the picture's height
    row, column = int(edge * height), height
    z = np.cos(np.pi * np.array((row, edge * height, row + 1)) / height)
    lit = (z[0] - z[1]) / (z[0] - z[2])  # above the line is farther south, in the sun
    share = made[0, row, column] / made[0, row - 2, column]
    assert share == pytest.approx(lit, abs=1.0 / view.patch_rays(height))


@pytest.mark.analytic
@pytest.mark.parametrize(("height", "rays"), [(20, 8), (60, 8), (115, 6), (230, 3), (460, 3)])
def test_rays_of_a_patch_by_rows(height: int, rays: int) -> None:
    assert view.patch_rays(height) == rays


@pytest.mark.analytic
def test_default_rays_give_the_area_in_the_sun() -> None:
    """Against 24 x 24 rays: a sixth of the error of 3 x 3 or less."""
    suns, lx = sun.direction([40.0, 25.0, 55.0], [190.0, 160.0, 205.0]), [1e4, 1e4, 1e4]

    def patches(sub: int | None) -> Floats32:
        made = scene.sun_patches(BARE, suns, lx, height=30, heading_deg=180.0, sub=sub)
        return np.log10(10.0 + made)

    exact = patches(24)
    default, coarse = (float(((patches(sub) - exact) ** 2).mean()) for sub in (None, 3))
    assert default < coarse / 6.0


@pytest.mark.authority
def test_a_room_from_a_file_agrees_with_the_box(tmp_path: Path) -> None:
    """The same room written as .rad (kind "radiance") gives the same patches through
    rtrace.
    """
    built = box_room.build(BARE)
    path = tmp_path / "room.rad"
    path.write_text(radiance.rad_text(built))
    room = Room(kind="radiance", file=str(path), viewpoint_m=built.camera_m)
    suns = sun.direction([40.0, 12.0], [200.0, 183.0])
    a = scene.sun_patches(BARE, suns, [1e4, 2e4], height=20, heading_deg=180.0)
    b = scene.sun_patches(room, suns, [1e4, 2e4], height=20, heading_deg=180.0)
    assert b.sum() == pytest.approx(a.sum(), rel=5e-3)
    off = np.abs(b - a) > 0.02 * a.max()
    assert off.mean() < 1e-3  # edges are traced as finely in both


@pytest.mark.contract
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"window": (Window("south", 3.0, 2.0, 1.0, 1.0),)}, "inside the S wall"),
        ({"window": (Window("south", 1.0, 2.0, 1.0, 2.5),)}, "inside the S wall"),
        ({"window": (Window("west", 1, 2, 1, 1), Window("west", 2, 2, 1.5, 1))}, "windows 1 and 2"),
        ({"camera_y_m": 6.0}, "camera at"),
        ({"reflectance_walls": 1.2}, "reflectance_walls"),
        ({"window": (Window("south", 1, 2, 1, 1, transmittance=0.99),)}, "transmittance"),
        ({"obstruction": (Obstruction(1, 2, 1, 2, 2, 2),)}, "camera is inside"),
        ({"obstruction": (Obstruction(1, 2, 1, 2, 0, 2),)}, "size of zero"),
        ({"kind": "radiance", "file": "nowhere.rad", "viewpoint_m": (1, 1, 1)}, "no such file"),
        ({"kind": "radiance", "file": "nowhere.rad"}, "viewpoint_m"),
    ],
)
def test_impossible_rooms_are_named(change: dict, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        scene.sun_patches(
            replace(BARE, **change), [[0, -0.7, 0.7]], 1.0, height=8, heading_deg=180.0
        )


@pytest.mark.property
def test_windows_that_fill_a_wall_exactly_are_possible() -> None:
    """1.1 + 2.2 is more than 3.3 in binary numbers."""
    halves = (Window("south", 0.0, 1.1, 0.1, 2.6), Window("south", 1.1, 2.2, 0.1, 2.6))
    room = replace(BARE, width_m=3.3, height_m=2.7, camera_x_m=1.0, camera_z_m=1.2, window=halves)
    ends = [opening.u_m for opening in box_room.build(room).openings]
    assert min(end[0] for end in ends) == 0.0 and max(end[1] for end in ends) <= 3.3


@pytest.mark.contract
def test_a_broken_radiance_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.rad"
    path.write_text("void plastic oops\n0\n0\n5 .5 .5\nnothing polygon\n")
    room = Room(kind="radiance", file=str(path), viewpoint_m=(1.0, 1.0, 1.0))
    with pytest.raises(InputError, match=r"bad\.rad"):
        scene.sun_patches(room, [[0, -0.7, 0.7]], 1.0, height=8, heading_deg=180.0)
