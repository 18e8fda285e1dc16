"""A room from clicks: simulated rooms with click noise, files with wrong rows, the page."""

from __future__ import annotations

import csv
import http.client
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import CHROMIUM, chromium
from click.testing import CliRunner
from places import SEATTLE

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import (
    CameraSetup,
    Exposure,
    Obstruction,
    Panorama,
    Room,
    SiteFile,
    Slot,
    Window,
)
from fieldlum.optics.images import write_panorama
from fieldlum.optics.projection import direction
from fieldlum.room.scene import sun_patches
from fieldlum.room.scene.box_room import build
from fieldlum.room.scene.clicked import (
    Click,
    ClickedRoom,
    ClickGrid,
    clicks_from_rows,
    read_clicks,
    room_from_clicks,
)
from fieldlum.room.scene.drawing import outline_pixels
from fieldlum.session import Session, create_session, update_session
from fieldlum.session.site_toml import load_site, site_table

LENGTHS = ("width_m", "depth_m", "height_m", "camera_x_m", "camera_y_m")
WINDOW_LENGTHS = ("left_m", "width_m", "sill_m", "height_m")


def _room(rng: np.random.Generator) -> Room:
    """A room of 3.5 to 9 m with a window in "south" and one in another wall."""
    width, depth = rng.uniform(3.5, 7.0), rng.uniform(3.5, 9.0)
    height = rng.uniform(2.5, 4.0)
    windows = [Window("south", 0.1 * width, 0.6 * width, 0.9, height - 1.3, 0.8, 2)]
    side = rng.choice(["west", "east", "north"])
    length = width if side == "north" else depth
    windows.append(Window(side, 0.3 * length, 0.3 * length, 0.8, height - 1.4))
    return Room(
        width_m=width,
        depth_m=depth,
        height_m=height,
        camera_x_m=width * rng.uniform(0.3, 0.7),
        camera_y_m=depth * rng.uniform(0.3, 0.6),
        camera_z_m=1.4,
        wall_azimuth_deg=rng.uniform(0.0, 360.0),
        window=tuple(windows),
    )


def _clicks(room: Room, grid: ClickGrid, noise_px: float, rng: np.random.Generator) -> list[Click]:
    """All corners, where they truly are in the picture, plus noise."""
    scene = build(room)
    points: list[tuple[str, int, tuple[float, float, float]]] = []
    for x in (0.0, room.width_m):
        for y in (0.0, room.depth_m):
            points += [("floor", 0, (x, y, 0.0)), ("ceiling", 0, (x, y, room.height_m))]
    for number, opening in enumerate(scene.openings, start=1):
        for along in opening.u_m:
            for z in opening.z_m:
                at = (opening.inner_m, along) if opening.axis == 0 else (along, opening.inner_m)
                points.append(("window", number, (*at, z)))
    camera = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    rays = (np.array([p[2] for p in points]) - camera) @ scene.turn
    xy = grid.pixels(rays) + rng.normal(0.0, noise_px, (len(points), 2))
    xy[:, 0] %= grid.width_px
    return [
        Click(kind, window, float(x), float(y), k)  # type: ignore[arg-type]
        for k, ((kind, window, _), (x, y)) in enumerate(zip(points, xy, strict=True), start=1)
    ]


@pytest.mark.slow
@pytest.mark.analytic
def test_clicks_without_noise_give_the_room_itself() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        room, grid = _room(rng), ClickGrid(920, 1840, float(rng.uniform(0, 360)))
        found = room_from_clicks(_clicks(room, grid, 0.0, rng), grid, room.camera_z_m)
        for name in LENGTHS:
            assert getattr(found.room, name) == pytest.approx(getattr(room, name), abs=2e-3)
        turn = (found.room.wall_azimuth_deg - room.wall_azimuth_deg + 180) % 360 - 180
        assert abs(turn) < 0.01
        for mine, true in zip(found.room.window, room.window, strict=True):
            assert mine.wall == true.wall
            for name in WINDOW_LENGTHS:
                assert getattr(mine, name) == pytest.approx(getattr(true, name), abs=2e-3)
        assert found.misfit_px < 0.01 and not found.notes


@pytest.mark.analytic
def test_uncertainties_are_of_their_window_whatever_is_clicked_first() -> None:
    """With window 2 clicked before window 1, their uncertainties were exchanged."""
    rng = np.random.default_rng(3)
    room, grid = _room(rng), ClickGrid(920, 1840, 0.0)
    clicks = _clicks(room, grid, 0.0, rng)
    in_order = room_from_clicks(clicks, grid, room.camera_z_m)
    turned = room_from_clicks(clicks[::-1], grid, room.camera_z_m)
    assert in_order.u["window.0.left_m"] != pytest.approx(in_order.u["window.1.left_m"], rel=0.1)
    assert turned.u == pytest.approx(in_order.u, rel=1e-3)


# Seeds of rooms and the height of the panorama that is clicked on.
ROOMS = {"60": (range(1000, 1060), 920)}
ROOMS["30 of them, twice the size"] = range(1000, 1030), 1840


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("which", ROOMS)
def test_lengths_of_noisy_clicks_are_within_one_percent_and_u_states_it(which: str) -> None:
    """0.5 px of noise: room lengths rms within 1 %, and the stated u is the spread: normalised
    errors have rms 1 within their sampling (about 100 values: +- 0.15; clicks of one room share
    errors, so the limits are twice that). u is the Cramer-Rao bound of the clicks, so no other
    unbiased estimator has a smaller error.
    """
    relative, normalised = [], []
    seeds, height = ROOMS[which]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        room, grid = _room(rng), ClickGrid(height, 2 * height, float(rng.uniform(0, 360)))
        found = room_from_clicks(_clicks(room, grid, 0.5, rng), grid, room.camera_z_m)
        for name in LENGTHS:
            error = getattr(found.room, name) - getattr(room, name)
            relative.append(error / getattr(room, name))
            normalised.append(error / found.u[name])
    rms = float(np.sqrt(np.mean(np.square(relative))))
    over = int((np.abs(relative) > 0.01).sum())
    print(
        f"{which}: rms {100 * rms:.2f} %, largest {100 * np.abs(relative).max():.2f} %, "
        f"{over} of {len(relative)} over 1 %, over u {np.sqrt(np.mean(np.square(normalised))):.2f}"
    )
    assert rms < 0.01
    assert 0.7 < float(np.sqrt(np.mean(np.square(normalised)))) < 1.3


@pytest.mark.contract
def test_a_wrong_click_is_named_and_does_not_bend_the_room() -> None:
    rng = np.random.default_rng(3)
    room, grid = _room(rng), ClickGrid(920, 1840, 180.0)
    clicks = _clicks(room, grid, 0.3, rng)
    clicks[1] = Click("ceiling", 0, clicks[1].x_px + 25.0, clicks[1].y_px, 2)
    found = room_from_clicks(clicks, grid, room.camera_z_m)
    assert any("ceiling click 2 is" in note for note in found.notes)
    assert found.room.width_m == pytest.approx(room.width_m, rel=0.03)


def _plain_room(**changed: object) -> Room:
    """6 x 8 x 3 m, camera at 2.5, 3, 1.4 m, and a window of 4 x 2 m in "south"."""
    window = Window("south", 1.0, 4.0, 0.8, 2.0)
    room = Room(width_m=6.0, depth_m=8.0, height_m=3.0, camera_x_m=2.5, camera_z_m=1.4)
    return replace(room, **{"window": (window,), **changed})  # type: ignore[arg-type]


GRID = ClickGrid(920, 1840, 180.0)


def _with_bars(*bars: tuple[str, float, float, float]) -> ClickedRoom:
    """The plain room from its corners, and clicks on bars or transoms at x, y, z [m]."""
    clicks = _clicks(_plain_room(), GRID, 0.0, np.random.default_rng(0))
    for line, (kind, *point) in enumerate(bars, start=31):
        x, y = GRID.pixels((np.array(point) - (2.5, 3.0, 1.4))[None]).tolist()[0]
        clicks.append(Click(kind, 1, x % 1840.0, y, line))  # type: ignore[arg-type]
    return room_from_clicks(clicks, GRID, 1.4)


# x of the window's south wall runs to the left, from 5 at the window's left end to 1
@pytest.mark.analytic
@pytest.mark.parametrize(
    ("bars", "panes", "transom_m"),
    [
        ((), 1, 0.0),
        ([("bar", 3.0, 0.0, 1.8)], 2, 0.0),
        ([("bar", 3.0, 0.0, 2.8), ("bar", 3.02, 0.0, 0.8)], 2, 0.0),
        ([("bar", 3.67, 0.0, 2.0), ("bar", 2.33, 0.0, 1.0), ("bar", 2.34, 0.0, 2.0)], 3, 0.0),
        ([("bar", x, 0.0, 1.5) for x in (2.0, 3.0, 4.0, 4.01)], 4, 0.0),
        ([("transom", 4.9, 0.0, 2.2), ("bar", 3.0, 0.0, 2.7), ("transom", 1.0, 0.0, 2.2)], 2, 2.2),
    ],
)
def test_bars_and_transoms(bars: list, panes: int, transom_m: float) -> None:
    found = _with_bars(*bars)
    window = found.room.window[0]
    assert window.panes == panes and window.transom_m == pytest.approx(transom_m, abs=0.01)
    assert found.notes == () and found.misfit_px < 0.01


@pytest.mark.contract
@pytest.mark.parametrize(
    ("bars", "panes", "transom_m", "named"),
    [
        ([("transom", 3.0, 0.0, 1.2), ("transom", 3.0, 0.0, 2.4)], 1, 1.2, [32]),
        ([("transom", 3.0, 0.0, 2.95)], 1, 0.0, [31]),
        ([("transom", 3.0, 8.0, 1.8)], 1, 0.0, [31]),
        ([("bar", 3.0, 8.0, 1.8)], 1, 0.0, [31]),
        ([("bar", 5.8, 0.0, 1.8)], 1, 0.0, [31]),
        ([("bar", 3.0, 0.0, 2.95)], 1, 0.0, [31]),
        ([("bar", 6.0, 2.0, 1.8)], 1, 0.0, [31]),
        ([("bar", 1.5, 0.0, 1.8)], 2, 0.0, [31]),
        ([("bar", 1.5, 0.0, 1.8), ("bar", 4.5, 0.0, 1.8)], 3, 0.0, [31, 32]),
    ],
)
def test_bars_that_the_box_has_not_are_named(
    bars: list, panes: int, transom_m: float, named: list[int]
) -> None:
    """Two transoms, unequal panes, and bars outside of the window were taken without a word."""
    found = _with_bars(*bars)
    window = found.room.window[0]
    assert window.panes == panes and window.transom_m == pytest.approx(transom_m, abs=0.01)
    assert [f"click {line} is" in note for line, note in zip(named, found.notes, strict=True)]
    assert all("equal panes and at most one transom" in note for note in found.notes)
    assert found.misfit_px < 0.01


def _clicked(true: Room, earlier: Room) -> ClickedRoom:
    clicks = _clicks(true, GRID, 0.0, np.random.default_rng(0))
    return room_from_clicks(clicks, GRID, true.camera_z_m, earlier)


@pytest.mark.contract
def test_a_window_keeps_the_glass_of_the_earlier_one() -> None:
    """They became 0.88 and 0.05, and one pane."""
    true = _plain_room()
    told = replace(true.window[0], transmittance=0.45, frame_m=0.12, panes=3, transom_m=2.0)
    earlier = replace(true, width_m=6.2, reflectance_walls=0.3, window=(told,))
    found = _clicked(true, earlier)
    assert found.notes == () and found.room.reflectance_walls == 0.3
    assert found.room.width_m == pytest.approx(6.0, abs=1e-3)
    window = found.room.window[0]
    assert replace(window, left_m=1.0, width_m=4.0, sill_m=0.8, height_m=2.0) == told
    above = replace(told, transom_m=2.9)
    assert _clicked(true, replace(earlier, window=(above,))).room.window[0].transom_m == 0.0
    assert _clicked(true, replace(earlier, window=())).room.window[0].transmittance == 0.88
    radiance = Room(kind="radiance", file="room.rad")
    assert _clicked(true, radiance) == _clicked(true, _plain_room())


@pytest.mark.contract
def test_windows_take_the_glass_of_the_one_that_is_seen_there() -> None:
    """The clicked window 1 was the earlier window 2, in a wall with another name."""
    east = Window("east", 2.0, 2.0, 0.8, 2.0, transmittance=0.3, frame_m=0.1)
    dark = replace(_plain_room().window[0], transmittance=0.45)
    earlier = _plain_room(window=(dark, east))
    clicks = _clicks(earlier, GRID, 0.0, np.random.default_rng(0))
    swapped = [replace(c, window=3 - c.window) if c.window else c for c in clicks]
    found = room_from_clicks(swapped, GRID, 1.4, earlier)
    assert found.room.wall_azimuth_deg == pytest.approx(90.0, abs=0.01)
    assert [(w.wall, w.transmittance) for w in found.room.window] == [
        ("south", 0.3),
        ("west", 0.45),
    ]
    assert found.notes == ()
    halves = [
        replace(dark, left_m=x, width_m=1.9, transmittance=t) for x, t in ((1, 0.4), (3, 0.5))
    ]
    halves = [replace(half, panes=3) for half in halves]
    doubtful = _clicked(_plain_room(), replace(earlier, window=tuple(halves)))
    assert doubtful.room.window[0].panes == 1
    note = "window 1: check transmittance and frame_m, of window"
    assert doubtful.notes[0].startswith(note) and doubtful.notes[0].endswith("before")


@pytest.mark.analytic
@pytest.mark.parametrize("quarter", [0.0, 90.0, 180.0, 270.0])
def test_obstructions_stay_where_the_camera_sees_them(quarter: float) -> None:
    """They had kept the numbers of the old axes: furniture stood elsewhere."""
    told = _plain_room(obstruction=(Obstruction(1.0, 4.0, 0.0, 1.2, 0.6, 0.75, 0.6),))
    # the same room from the wall that is `quarter` further clockwise
    x, y = {0.0: (2.5, 3.0), 90.0: (5.0, 2.5), 180.0: (3.5, 5.0), 270.0: (3.0, 3.5)}[quarter]
    width, depth = (6.0, 8.0) if quarter % 180 == 0 else (8.0, 6.0)
    azimuth = (180.0 + quarter) % 360.0
    new = _plain_room(
        width_m=width, depth_m=depth, camera_x_m=x, camera_y_m=y, wall_azimuth_deg=azimuth
    )
    found = _clicked(new, replace(told, wall_azimuth_deg=182.0))
    corners = []
    for scene in (build(found.room), build(told)):
        kind = scene.of_kind("obstruction")[0]
        ends = np.array([scene.low[kind], scene.high[kind]])
        world = (ends - scene.camera_m) @ scene.turn
        corners.append(np.concatenate([world.min(axis=0), world.max(axis=0)]))
    assert corners[0] == pytest.approx(corners[1], abs=0.01)
    assert found.room.obstruction[0].reflectance == 0.6


@pytest.mark.contract
def test_obstructions_of_walls_that_turned_are_named() -> None:
    desk, house = Obstruction(1, 4, 0, 1.2, 0.6, 0.75), Obstruction(-20, -30, 0, 40, 8, 12)
    told = _plain_room(obstruction=(desk, house), wall_azimuth_deg=150.0)
    found = _clicked(_plain_room(), told)
    assert found.room.obstruction == ()
    assert [note.split(" m is left out")[0] for note in found.notes if "obstruction" in note] == [
        "obstruction 1 at 1, 4",
        "obstruction 2 at -20, -30",
    ]


@pytest.mark.property
def test_the_outline_passes_through_the_corners() -> None:
    rng = np.random.default_rng(5)
    room, grid = _room(rng), ClickGrid(460, 920, 30.0)
    clicks = _clicks(room, grid, 0.0, rng)
    lines = outline_pixels(room, grid)
    drawn = np.concatenate([np.reshape(line, (-1, 2)) for part in lines.values() for line in part])
    for click in clicks:
        gap = np.hypot(drawn[:, 0] - click.x_px, drawn[:, 1] - click.y_px).min()
        assert gap < 0.1


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("kind,window,x,y\n", "exactly the columns kind,window,x_px,y_px in this order"),
        ("kind,window,x_px,y_px\nwall,,1,2\n", ":2: kind = 'wall'"),
        ("kind,window,x_px,y_px\nfloor,,1,2\nfloor,,one,2\n", ":3: "),
        ("kind,window,x_px,y_px\nfloor,1,1,2\n", ":2: kind floor with window number 1"),
        ("kind,window,x_px,y_px\nwindow,,1,2\n", ":2: kind window with window number 0"),
        ("kind,window,x_px,y_px\nfloor,,1\n", "line 2: 3 cells"),
        ("", "an empty file"),
    ],
)
def test_wrong_rows_are_refused_by_line(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "clicks.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=line):
        read_clicks(path)


@pytest.mark.contract
def test_clicks_that_are_no_box_are_refused() -> None:
    grid = ClickGrid(460, 920, 180.0)
    few = [Click("floor", 0, 100.0, 400.0, 1)] * 2
    rng = np.random.default_rng(1)
    good = _clicks(_room(rng), grid, 0.0, rng)
    for clicks, text in (
        (few, "2 floor and 0 ceiling"),
        ([*good, Click("floor", 0, 100.0, 20.0, 99)], "clicks:99: a floor corner"),
        ([*good, Click("floor", 0, 100.0, 900.0, 99)], "within 920 x 460"),
        ([*good, Click("floor", 0, float("nan"), 400.0, 99)], "clicks:99: a click at x nan"),
        ([*good, Click("window", 7, 100.0, 200.0, 99)], "window 7 has 1 corners"),
        (
            [Click("floor", 0, 10.0 + k, 400.0, k) for k in range(4)]
            + [Click("ceiling", 0, 10.0, 20.0, 5)],
            "one side of the camera",
        ),
    ):
        with pytest.raises(InputError, match=text):
            room_from_clicks(clicks, grid, 1.4)
    with pytest.raises(InputError, match="camera height"):
        room_from_clicks(good, grid, 0.0)
    with pytest.raises(InputError, match="no list"):
        clicks_from_rows({"kind": "floor"})


@pytest.mark.slow
@pytest.mark.analytic
def test_the_sun_patch_of_a_clicked_room_is_the_true_one() -> None:
    """IoU of patches (230 x 115, 1 m2 of floor is some 200 px) for 3 of the rooms, clicks of
    0.5 px on 1840 x 920.
    """
    shares = []
    for seed in range(3):
        rng = np.random.default_rng(200 + seed)
        room, grid = _room(rng), ClickGrid(920, 1840, 180.0)
        found = room_from_clicks(_clicks(room, grid, 0.5, rng), grid, room.camera_z_m).room
        toward = direction(35.0, room.wall_azimuth_deg + 15.0)[None]
        maps = [
            sun_patches(r, toward, 1e5, height=115, heading_deg=180.0)[0] > 100.0
            for r in (room, replace(found, window=found.window))
        ]
        shares.append((maps[0] & maps[1]).sum() / (maps[0] | maps[1]).sum())
    print(f"IoU median {np.median(shares):.3f}, least {min(shares):.3f}")
    assert np.median(shares) > 0.9 and min(shares) > 0.8


# ----------------------------------------------------------------------------------------------
# the command and the page


@pytest.fixture
def session(tmp_path: Path) -> tuple[Session, list[Click]]:
    """A session with one panorama and without a room; the clicks of its corners."""
    rng = np.random.default_rng(7)
    room, grid = _room(rng), ClickGrid(200, 400, 180.0)
    t_utc = datetime(2027, 3, 20, 19, 30, tzinfo=UTC)
    slot = Slot(t_utc, 40.0, 170.0, (Exposure(0.01, 5.6),))
    setup = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0, height_m=1.4))
    made = create_session(tmp_path / "s", setup, [slot], {"set": "test"})
    made.panoramas.mkdir()
    pixels = np.full((200, 400), 100.0, np.float32)
    write_panorama(made.panorama(slot.id), Panorama(pixels, 180.0))
    return made, _clicks(room, grid, 0.0, rng)


@pytest.mark.contract
def test_the_csv_writes_a_site_and_the_sessions_room_once(
    session: tuple[Session, list[Click]], tmp_path: Path
) -> None:
    made, clicks = session
    path = tmp_path / "c.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("kind", "window", "x_px", "y_px"))
        writer.writerows((c.kind, c.window or "", c.x_px, c.y_px) for c in clicks)
    call = ["scene", "click", str(made.root), "--csv", str(path)]
    done = CliRunner().invoke(main, call)
    assert done.exit_code == 0, done.output
    assert "window.0.left_m" in done.output and "has this room now" in done.stderr
    room = load_site(made.root / "scene" / "clicked.toml").room
    assert room == made.site_file().room and room is not None and len(room.window) == 2
    done = CliRunner().invoke(main, [*call, "--camera-height", "1.5"])
    assert "still has its earlier room" in done.stderr and made.site_file().room == room
    done = CliRunner().invoke(main, [*call, "--camera-height", "1.5", "--force"])
    after = made.site_file().room
    assert after is not None and after.camera_z_m == 1.5
    assert after.width_m == pytest.approx(room.width_m * 1.5 / 1.4, rel=1e-3)
    grey = replace(after.window[1], transmittance=0.45, frame_m=0.12)
    told = replace(after, window=(replace(grey, wall="south"), grey), reflectance_floor=0.3)
    update_session(made, {"setup": site_table(replace(made.site_file(), room=told))})
    done = CliRunner().invoke(main, [*call, "--force"])
    kept = made.site_file().room
    assert kept is not None and kept.reflectance_floor == 0.3
    assert [(w.transmittance, w.frame_m) for w in kept.window] == [(0.45, 0.12)] * 2
    path.write_text("kind,window,x_px,y_px\nfloor,,1,2\nroof,,1,2\n", encoding="utf-8")
    done = CliRunner().invoke(main, call)
    assert done.exit_code == 3 and "c.csv:3: kind = 'roof'" in done.stderr


def _page(made: Session) -> Iterator[str]:
    code = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
    command = [sys.executable, "-c", code, "scene", "click", str(made.root), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.communicate(timeout=20)


@pytest.mark.slow
@pytest.mark.contract
def test_another_site_or_a_form_changes_nothing(session: tuple[Session, list[Click]]) -> None:
    made = session[0]
    before = made.toml.read_bytes()
    for address in _page(made):
        place = urlsplit(address)

        def ask(
            body: bytes | None, cookie: str, path: str = "/save.json", place=place, **more: str
        ) -> tuple[int, str]:
            own = {"Origin": f"http://{place.netloc}", "Content-Type": "application/json"}
            named = {name.replace("_", "-"): value for name, value in more.items()}
            headers = {k: v for k, v in (own | {"Cookie": cookie} | named).items() if v}
            connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=20)
            connection.request("POST" if body is not None else "GET", path, body, headers)
            answer = connection.getresponse()
            connection.close()
            return answer.status, answer.headers.get("set-cookie", "")

        cookie = ask(None, "", f"/?{place.query}")[1].split(";")[0]
        for status, more in (
            (403, {"Origin": ""}),
            (403, {"Origin": "https://evil.example"}),
            (403, {"Origin": "null"}),
            (403, {"Sec_Fetch_Site": "cross-site"}),
            (421, {"Host": "evil.example"}),
            (415, {"Content_Type": "text/plain"}),
            (415, {"Content_Type": "application/x-www-form-urlencoded"}),
        ):
            assert ask(b"{}", cookie, **more)[0] == status, more
        assert ask(b"{}", "")[0] == ask(b"{}", cookie + "x")[0] == 401
        for body in (b"", b"[]", b"{", b"[" * 8000, b"\xff"):
            assert ask(body, cookie)[0] == 400
        assert ask(b" " * 300_000, cookie)[0] == 413
        assert ask(None, cookie)[0] == 405
    assert made.toml.read_bytes() == before


@pytest.mark.contract
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_the_page_by_mouse_and_keyboard(
    session: tuple[Session, list[Click]], tmp_path: Path
) -> None:
    made, clicks = session
    count = "document.querySelectorAll('.point').length"
    for address in _page(made):
        with chromium(tmp_path / "profile") as page:
            page.size(1200, 1000)
            page.open(address)
            page.until("document.body.dataset.ready === '1'")
            page.until("document.getElementById('picture').naturalWidth > 0")
            left, top, scale = 0.0, 0.0, 1.0  # of the picture on the page, px
            for click in clicks:
                page.run(
                    f"byId('kind').value = {click.kind!r};"
                    f"byId('window').value = {max(click.window, 1)}; 1"
                )
                page.run("byId('frame').scrollIntoView(); 1")
                left, top, width = page.run(
                    "(() => {const b = page.svg.getBoundingClientRect();"
                    "return [b.x, b.y, b.width];})()"
                )
                scale = width / 400
                before = page.run(count)
                page.click(left + click.x_px * scale, top + click.y_px * scale)
                page.until(f"{count} === {before + 1}")
            page.until("document.querySelectorAll('.pane').length > 0")
            page.until("byId('line').textContent.includes('fit within')")
            assert page.run("document.querySelectorAll('.box').length") >= 12
            # drag the first point away, undo, redo, and undo by the keyboard
            x, y = (left + clicks[0].x_px * scale, top + clicks[0].y_px * scale)
            page.mouse("mouseMoved", x, y)
            page.mouse("mousePressed", x, y)
            page.mouse("mouseMoved", x + 30, y + 5)
            page.mouse("mouseReleased", x + 30, y + 5)
            moved = "Math.round(page.clicks[0].x_px)"
            assert page.run(moved) == round(clicks[0].x_px + 30 / scale)
            page.click_on("#undo")
            assert page.run(moved) == round(clicks[0].x_px)
            page.click_on("#redo")
            assert page.run(moved) != round(clicks[0].x_px)
            page.run("document.activeElement.blur(); 1")
            page.key("z", 90, modifiers=2)
            assert page.run(moved) == round(clicks[0].x_px)
            # the keyboard alone: a point is nudged, removed and brought back
            page.run("document.querySelector('.point').focus(); 1")
            page.key("ArrowRight", 39, modifiers=8)
            assert page.run("page.clicks[0].x_px") == pytest.approx(
                page.run("JSON.parse(page.past.at(-1))[0].x_px") + 5.0
            )
            page.key("Delete", 46)
            assert page.run(count) == len(clicks) - 1
            page.click_on("#undo")
            page.click_on("#undo")
            assert page.run(count) == len(clicks)
            page.key("+", 187)
            assert page.run("page.zoom") == 1.5
            page.until("byId('line').textContent.includes('fit within')")
            assert ("button", "floor, point 1") in page.named_parts()
            page.click_on("#save")
            page.until("byId('saved').textContent.includes('has this room now')")
            assert page.complaints() == []
            room = made.site_file().room
            assert room is not None and len(room.window) == 2
            answer = page.run(
                "ask('/solve.json', {clicks: 3}).then(a => a.error || 'none', e => e.message)"
            )
            assert "no list" in answer
