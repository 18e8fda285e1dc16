"""`calibrate lens`: mapping, centre and pose from directions and from chessboards."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import PROFILE

from fieldlum.calibrate import lens
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.optics.profiles import Lens
from fieldlum.optics.projection import LensGeometry, direction, lens_pixels


def _targets(
    geometry: LensGeometry, count: int, noise_px: float, widest: float = 88.0
) -> lens.Targets:
    rng = np.random.default_rng(7)
    angle, turn = np.radians(widest * np.sqrt(rng.random(count))), 2 * np.pi * rng.random(count)
    local = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1
    )
    rays = local @ geometry.axes()
    x, y, _ = lens_pixels(geometry, rays)
    return lens.Targets(
        x + noise_px * rng.normal(size=count), y + noise_px * rng.normal(size=count), rays
    )


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize(
    ("mapping", "coefficients"),
    [("equisolid", ()), ("equidistant", ()), ("polynomial", (1.12, 0.0, -0.12))],
)
def test_lens_from_known_directions(mapping: str, coefficients: tuple[float, ...]) -> None:
    """0.3 px of noise on 60 targets: rays within 0.1 deg everywhere, and the mapping named."""
    truth = LensGeometry((1010.0, 985.0), 900.0, 186.0, mapping, coefficients, 2.0, -1.5, 0.8)  # type: ignore[arg-type]
    found = lens.fit(_targets(truth, 60, 0.3), Lens((1000.0, 1000.0), 890.0, 186.0))
    assert found.lens.mapping == mapping
    check = _targets(truth, 200, 0.0)
    fitted = LensGeometry(
        found.lens.centre_px,
        found.lens.radius_px,
        186.0,
        found.lens.mapping,
        found.lens.coefficients,
        found.lens.azimuth_deg,
        found.lens.tilt_deg,
        found.lens.roll_deg,
    )
    x, y, _ = lens_pixels(fitted, check.rays)
    assert np.degrees(np.hypot(x - check.x_px, y - check.y_px).max() / 900.0 * np.radians(93)) < 0.1
    assert found.choice.rms < 0.8


def _with_directions(
    targets: lens.Targets, azimuth_deg: np.ndarray, altitude_deg: np.ndarray
) -> lens.Targets:
    return replace(targets, rays=direction(altitude_deg, azimuth_deg))


@pytest.mark.slow
@pytest.mark.contract
def test_lens_names_slips_and_refuses_mirrored_directions() -> None:
    """A mirrored table was fitted before by a polynomial that folds back, to half a pixel."""
    truth = LensGeometry((408.3, 345.2), 330.0, 184.0, "equidistant")
    start = Lens((400.0, 350.0), 320.0, 184.0)
    good = _targets(truth, 30, 0.3)
    azimuth = np.degrees(np.arctan2(good.rays[:, 0], good.rays[:, 1]))
    altitude = np.degrees(np.arcsin(good.rays[:, 2]))
    for wrong in (
        _with_directions(good, -azimuth, altitude),
        _with_directions(good, azimuth, -altitude),
    ):
        with pytest.raises(InputError, match="only as a mirror image"):
            lens.fit(wrong, start)
    with pytest.raises(InputError):
        lens.fit(replace(good, x_px=good.y_px, y_px=good.x_px), start)
    slipped = azimuth.copy()
    slipped[[3, 7]] += 40.0
    found = lens.fit(_with_directions(good, slipped, altitude), start)
    assert found.warnings[0].startswith("left out") and found.warnings[0].count("off by") == 2
    assert (
        found.lens.centre_px == pytest.approx(truth.centre_px, abs=0.4) and found.choice.rms < 0.6
    )


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize(("azimuth", "roll"), [(180.0, 0.0), (0.0, 90.0), (-25.0, -90.0)])
def test_lens_of_a_camera_that_stands_otherwise(azimuth: float, roll: float) -> None:
    truth = LensGeometry((408.3, 345.2), 330.0, 184.0, "equisolid", (), azimuth, 0.0, roll)
    found = lens.fit(_targets(truth, 30, 0.3), Lens((400.0, 350.0), 320.0, 184.0))
    assert found.lens.roll_deg == pytest.approx(roll, abs=0.3)
    assert abs((found.lens.azimuth_deg - azimuth + 180) % 360 - 180) < 0.3
    assert any("is turned by" in doubt for doubt in found.warnings)


@pytest.mark.slow
@pytest.mark.analytic
def test_lens_from_chessboards() -> None:
    """Boards seen by an equisolid fisheye: OpenCV's model turned into ours misses by under a
    tenth of a degree.
    """
    rng, columns, rows = np.random.default_rng(8), 9, 6
    truth = LensGeometry((640.0, 480.0), 450.0, 180.0, "equisolid")
    corners = []
    for _ in range(10):
        board = np.mgrid[:columns, :rows].T.reshape(-1, 2) - [(columns - 1) / 2, (rows - 1) / 2]
        turn, lean = 2 * np.pi * rng.random(), np.radians(55 * np.sqrt(rng.random()))
        forward = np.array([np.sin(lean) * np.cos(turn), np.cos(lean), np.sin(lean) * np.sin(turn)])
        facing = forward + 0.4 * rng.normal(size=3)
        right = np.cross(
            facing / np.linalg.norm(facing), [0.1 * rng.normal(), 0.1 * rng.normal(), 1.0]
        )
        right /= np.linalg.norm(right)
        up = np.cross(right, facing / np.linalg.norm(facing))
        points = 8.0 * forward + board[:, :1] * right - board[:, 1:] * up
        x, y, _ = lens_pixels(truth, points / np.linalg.norm(points, axis=1, keepdims=True))
        corners.append(np.stack([x, y], axis=1) + 0.05 * rng.normal(size=(len(x), 2)))
    for azimuth in (0.0, 180.0):  # a lens that looks back too: boards' tilt is not a lens's pose
        start = Lens((630.0, 490.0), 440.0, 180.0, azimuth_deg=azimuth)
        found, _ = lens.fit_boards(corners, columns, rows, start)
        assert found.choice.rms == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
        assert found.lens.centre_px == pytest.approx(truth.centre_px, abs=0.1)
        assert found.lens.azimuth_deg == azimuth
        assert "uncertainty of the centre 0.0" in found.choice.line
        level = replace(found.lens, azimuth_deg=0.0)
        rays = direction(0.0, np.linspace(-60.0, 60.0, 25))
        x, _, _ = lens_pixels(truth, rays)
        assert np.abs(lens_pixels(level, rays)[0] - x).max() < 450.0 / 90 * 0.05
    with pytest.raises(NotEnoughDataError):
        lens.fit_boards(corners[:3], columns, rows, start)


@pytest.mark.analytic
def test_chessboard_corners_in_sensor_coordinates(tmp_path: Path) -> None:
    import cv2

    board = np.full((480, 640), 200, np.uint8)
    for row, column in np.ndindex(7, 10):
        if (row + column) % 2:
            board[60 + row * 50 : 110 + row * 50, 70 + column * 50 : 120 + column * 50] = 20
    corners = lens.chessboard_corners(board, 9, 6)
    assert corners is not None and corners[0] == pytest.approx([120, 110], abs=0.1)
    assert corners[9] == pytest.approx([120, 160], abs=0.1)  # row by row
    assert lens.chessboard_corners(np.full((200, 300), 120, np.uint8), 9, 6) is None
    cv2.imwrite(str(tmp_path / "board.png"), board)
    with pytest.raises(InputError, match=r"board.png: a frame of 640 x 480 pixels; expected 240 x"):
        lens.frame_picture(tmp_path / "board.png", PROFILE)


@pytest.mark.contract
@pytest.mark.parametrize("place", ["241,20", "20,241", "-1,20", "3245,-2762"])
def test_targets_off_the_sensor_are_refused(tmp_path: Path, place: str) -> None:
    table = tmp_path / "targets.csv"
    names = "x_px,y_px,azimuth_deg,altitude_deg\n"
    table.write_text(names + f"0,240,1,2\n{place},3,4\n")
    x, y = place.split(",")
    finding = f"targets.csv: a target at x_px {x}, y_px {y}; expected one inside 240 x 240 pixels"
    with pytest.raises(InputError, match=finding):
        lens.from_table(table, PROFILE)
    table.write_text(names + "0,240,1,2\n")
    assert lens.from_table(table, PROFILE).x_px == [0.0]


@pytest.mark.contract
def test_targets_of_a_preview_are_cautioned() -> None:
    """Pixels of half the size gave half the circle without a word."""
    start = Lens((245.0, 238.0), 233.0, 190.0)
    good = _targets(start, 24, 0.0)
    for scale, percent in ((0.5, 73), (2.0, 147), (1.0, 0)):
        found = lens.fit(replace(good, x_px=scale * good.x_px, y_px=scale * good.y_px), start)
        text = f"differs by {percent} % of the radius from the profile's (245, 238 px, radius 233"
        assert [text in warning for warning in found.warnings] == ([True] if percent else [])


@pytest.mark.contract
@pytest.mark.filterwarnings("error")
def test_targets_on_one_ray_are_refused_without_a_warning_of_scipy() -> None:
    good = _targets(Lens((245.0, 238.0), 233.0, 190.0), 24, 0.0)
    off = replace(good, x_px=good.x_px + 3000.0, y_px=good.y_px - 3000.0)
    assert lens.fit(off, Lens((242.0, 242.0), 236.0, 190.0)).warnings
    one = replace(good, rays=np.repeat(good.rays[:1], 24, axis=0))
    with pytest.raises(NotEnoughDataError, match="targets in different directions: 1; expected"):
        lens.fit(one, Lens((242.0, 242.0), 236.0, 190.0))


@pytest.mark.slow
@pytest.mark.analytic
def test_circle() -> None:
    rng = np.random.default_rng(9)
    y, x = np.mgrid[:600, :800] + 0.5
    texture = 120 + 40 * np.sin(x / 17) * np.cos(y / 23)
    edge = np.clip(231.4 - np.hypot(x - 410.7, y - 296.2) + 0.5, 0, 1)
    picture = np.clip(texture * edge + 3 + 2 * rng.normal(size=x.shape), 0, 255).astype(np.uint8)
    found = lens.circle(picture, Lens((400.0, 310.0), 240.0, 186.0))
    assert found.centre_px == pytest.approx((410.7, 296.2), abs=0.3)
    assert found.radius_px == pytest.approx(231.4, abs=0.5)
    assert 1.0 <= found.u_px < 1.5  # a softer edge than this one is not known to a tenth
    with pytest.raises(InputError):
        lens.circle(np.full((200, 300), 90, np.uint8), Lens((150.0, 100.0), 90.0, 186.0))


@pytest.mark.slow
@pytest.mark.property
def test_a_picture_of_a_room_gives_no_circle() -> None:
    """Windows and lamps in a dark room leave parts of the circle's edge, and edges of their own."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:400, :600] + 0.5
    room = np.full(x.shape, 12.0)
    for _ in range(25):
        top, left = rng.integers(0, 360), rng.integers(80, 500)
        room[top : top + 60, left : left + 70] = rng.uniform(20, 250)
    room[np.hypot(x - 300, y - 200) > 190] = 2.0
    for start in (Lens((300.0, 200.0), 190.0, 186.0), Lens((310.0, 190.0), 180.0, 186.0)):
        for guessed in (False, True):
            with pytest.raises(InputError, match=r"an evenly lit circle.*white paper"):
                lens.circle(room.astype(np.uint8), start, "room.jpg", guessed=guessed)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(("x_px", "radius_px"), [(300.0, 230.0), (380.0, 190.0)])
def test_a_circle_that_contradicts_the_profile_is_refused(x_px: float, radius_px: float) -> None:
    y, x = np.mgrid[:400, :600] + 0.5
    picture = np.where(np.hypot(x - 300, y - 200) < 190, 150, 2).astype(np.uint8)
    near = Lens((292.0, 206.0), 180.0, 186.0)
    assert lens.circle(picture, near).radius_px == pytest.approx(190.0, abs=0.5)
    wrong = Lens((x_px, 200.0), radius_px, 186.0)
    with pytest.raises(InputError, match=r"the profile's circle at .*, 200 px.*white paper"):
        lens.circle(picture, wrong, "IMG_6955.JPG")
    # A profile that was never measured may be of a sensor of another size.
    other = lens.circle(picture, Lens((300.0, 200.0), 290.0, 186.0), guessed=True)
    assert other.radius_px == pytest.approx(190.0, abs=0.5)
    assert other.centre_px == pytest.approx((300.0, 200.0), abs=0.3)
