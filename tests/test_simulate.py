"""Ground truth: against plain Radiance, against energy balance, and as a session that can be
resumed.
"""

import csv
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from learning_room import scaled
from places import SEATTLE

from fieldlum import weather
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.images import RADIANCE_Y, read_panorama
from fieldlum.optics.melanopic import sky_xyz
from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate
from fieldlum.room.scene import box_room, radiance, radiosity, view
from fieldlum.session import open_session
from fieldlum.session.site_toml import load_site, site_table
from fieldlum.sky.daylight import Light, light_at

OFFICE = load_site(shipped("capture_plans") / "seattle-office.toml")
SMALL = SiteFile(
    SEATTLE,
    CameraSetup(heading_deg=180.0, height_m=1.4),
    Room(
        width_m=4,
        depth_m=5,
        height_m=3,
        camera_x_m=2,
        camera_y_m=2,
        camera_z_m=1.4,
        window=(
            Window("south", left_m=0.5, width_m=3, sill_m=0.8, height_m=1.9, frame_m=0.05, panes=2),
        ),
    ),
)
NOON = datetime(2027, 3, 20, 20, 10, tzinfo=UTC)


@pytest.fixture(scope="module")
def truth() -> simulate.LitRoom:
    return simulate.lit_room(SMALL, height=20, quality="draft")


def _plain_rtrace(setup: SiteFile, light: Light, height: int, pixels: np.ndarray) -> np.ndarray:
    """The same hour by rtrace -ab 5 with gendaylit's sky, without the disc: one ray in each of
    `pixels`. [cd/m2]
    """
    import pyradiance

    assert setup.room is not None
    built = box_room.build(setup.room)
    sky, toward = light.sky, built.to_room(light.apparent_sun_direction[0])
    numbers = [sky.norm_cdm2[0] / 179, sky.ground_cdm2[0] / 179, *sky.shape[0], *toward]
    text = "void brightfunc skyfunc\n2 skybright perezlum.cal\n0\n10 " + " ".join(
        f"{x:.8g}" for x in numbers
    )
    for name, side in (("sky", 1), ("ground", -1)):
        text += (
            f"\nskyfunc glow {name}glow\n0\n0\n4 1 1 1 0\n{name}glow source {name}\n0\n0\n4 0 "
            f"0 {side} 180"
        )
    _, rays = view.pixel_rays(height, setup.camera.heading_deg, 1)
    rays = built.to_room(rays[pixels])
    stream = np.concatenate(
        (np.broadcast_to(np.array(built.camera_m), rays.shape), rays), axis=1
    ).astype("<f4")
    options = ["-ab", "5", "-ad", "512", "-as", "128", "-aa", ".2", "-lw", "1e-3", "-dv-", "-w-"]
    with radiance.octree(
        radiance.rad_text(built), text, radiance.sun_text(toward, light.direct_lx[0])
    ) as octree:
        answer = pyradiance.rtrace(
            stream.tobytes(), octree, header=False, inform="f", outform="f", params=options
        )
    return np.frombuffer(answer, "<f4").reshape(-1, 3)[:, 0] * 179


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize(("dni", "dhi"), [(0.0, 200.0), (700.0, 100.0)], ids=["overcast", "clear"])
def test_plain_rtrace(truth: simulate.LitRoom, dni: float, dhi: float) -> None:
    """Radiance rendering the hour in one piece. Draft pieces and pixels of 9 degrees with one
    ray each; rtrace itself moves by 10 % here between -aa .2 and -aa 0, and stands on either
    side of us.
    """
    light = light_at([NOON], SMALL.site, np.array([dni]), np.array([dhi]))
    made = truth.render(light).luminance_cdm2[0].ravel()
    pixels = np.random.default_rng(1).permutation(len(made))[:80]
    ratio = made[pixels] / _plain_rtrace(SMALL, light, 20, pixels)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.08)
    assert np.mean(np.abs(ratio - 1) < 0.2) > 0.75


@pytest.mark.slow
@pytest.mark.analytic
def test_gathered_light_is_complete(truth: simulate.LitRoom) -> None:
    """Under a luminance of 1 everywhere every point receives pi (glass takes its part
    near the window).
    """
    total = np.asarray(truth.point_coefficients.sum(axis=1)).ravel()
    assert total.max() < 1.02 * np.pi
    assert np.median(total) > 0.97 * np.pi


@pytest.mark.slow
@pytest.mark.property
def test_the_same_room_comes_out_the_same() -> None:
    """Fits of one room would otherwise differ from run to run."""
    first, second = (simulate.lit_room(SMALL, height=8, quality="draft") for _ in range(2))
    assert (first.point_coefficients != second.point_coefficients).nnz == 0
    assert (first.bounce_coefficients != second.bounce_coefficients).nnz == 0


@pytest.mark.slow
@pytest.mark.property
def test_linear_in_light(truth: simulate.LitRoom) -> None:
    """Twice the sky and the sun, twice the picture, the patch and the disc."""
    light = light_at([NOON], SMALL.site, np.array([600.0]), np.array([100.0]))
    one, two = truth.render(light), truth.render(scaled(light, 2.0))
    assert two.luminance_cdm2 == pytest.approx(2 * one.luminance_cdm2, rel=1e-4)
    assert two.disc_lx == pytest.approx(2 * one.disc_lx)


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_an_hour_does_not_depend_on_its_company(truth: simulate.LitRoom) -> None:
    """A resumed run renders an hour with other hours, and its file must be the same."""
    times = [datetime(2027, 3 + k % 7, 3 + k, 15 + k % 9, 30, tzinfo=UTC) for k in range(17)]
    rng = np.random.default_rng(3)
    light = light_at(times, SMALL.site, rng.uniform(0, 800, 17), rng.uniform(20, 300, 17))
    together = truth.render(light)
    for rows in ([0], [16], [5, 4], list(range(16, 0, -1))):
        part = truth.render(light[rows])
        assert np.array_equal(part.luminance_cdm2, together.luminance_cdm2[rows])
        assert np.array_equal(part.patch_cdm2, together.patch_cdm2[rows])
        assert np.array_equal(part.disc_lx, together.disc_lx[rows])


@pytest.mark.analytic
def test_colours_are_those_of_the_light_and_leave_the_luminance(
    truth: simulate.LitRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = light_at([NOON, NOON], SMALL.site, np.array([0.0, 700.0]), np.array([150.0, 100.0]))
    grey, made = truth.render(light), truth.render(light, coloured=True)
    assert grey.colour is None and made.colour is not None
    np.testing.assert_array_equal(made.luminance_cdm2, grey.luminance_cdm2)
    assert made.colour @ np.array(RADIANCE_Y) == pytest.approx(1.0, abs=1e-5)
    floor, ceiling = made.colour[0, -1, 20], made.colour[0, 0, 20]
    assert floor[0] / floor[2] > 1.5 * ceiling[0] / ceiling[2], "the floor is of wood"
    panorama = truth.as_panorama(made, 1)
    assert panorama.rgb is not None and "melanopic" in panorama.attributes
    shown = 179.0 * panorama.rgb @ np.array(RADIANCE_Y)
    assert shown == pytest.approx(panorama.luminance_cdm2, rel=1e-4)
    monkeypatch.setattr(radiosity, "_COLOURS", {})
    monkeypatch.delitem(truth.__dict__, "_tints")
    white = truth.render(light, coloured=True).colour
    assert white is not None
    sky = sky_xyz(np.array([5000.0]), np.ones(1)) @ np.linalg.inv(radiosity._TO_XYZ).T
    assert white[0] == pytest.approx(np.broadcast_to(sky, white[0].shape), rel=1e-3)
    monkeypatch.delitem(truth.__dict__, "_tints")


@pytest.mark.slow
@pytest.mark.property
def test_no_disc_in_the_map_and_the_sun_beside_it(truth: simulate.LitRoom) -> None:
    """The winter sun stands in the window: the map stays under any sunlit surface, its energy is
    in the source.
    """
    t = datetime(2027, 12, 20, 20, 40, tzinfo=UTC)
    light = light_at([t, t], SMALL.site, np.array([600.0, 0.0]), np.array([60.0, 60.0]))
    made = truth.render(light)
    panorama = truth.as_panorama(made, 0)
    assert panorama.sun is not None and panorama.sun.origin == "rendering"
    assert 20e3 < panorama.sun.normal_illuminance_lx < 60e3
    assert panorama.luminance_cdm2.max() < 60e3
    assert truth.as_panorama(made, 1).sun is None


@pytest.mark.contract
def test_a_room_is_needed_before_a_session_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="box room"):
        simulate.lit_room(replace(SMALL, room=None))
    site = tmp_path / "site.toml"
    site.write_text(
        '[site]\nname = "A"\nlatitude_deg = 47.6\nlongitude_deg = -122.3\n'
        'timezone = "America/Los_Angeles"\n'
    )
    ran = CliRunner().invoke(main, ["simulate", str(site), "--out", str(tmp_path / "out")])
    assert ran.exit_code == 3 and "no box room" in ran.output, ran.output
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.contract
def test_weather_follows_the_place() -> None:
    assert "seattle" in simulate.weather_for(OFFICE).name
    sydney = replace(OFFICE, site=Site("Sydney", -33.9, 151.2, "Australia/Sydney"))
    assert simulate.weather_for(sydney).synthetic


@pytest.mark.slow
@pytest.mark.property
def test_sampled_slots_are_daylight_and_disjoint() -> None:
    year = weather.shipped_seattle()
    first = simulate.sample_slots(OFFICE, year, 30, seed=1)
    second = simulate.sample_slots(OFFICE, year, 30, seed=2, without=[s.t_utc for s in first])
    assert not {s.t_utc for s in first} & {s.t_utc for s in second}
    assert all(s.sun_altitude_deg > 0 for s in first)
    assert [s.t_utc for s in first] == sorted(s.t_utc for s in first)


def _toml(path: Path) -> Path:
    import tomli_w

    path.write_text(tomli_w.dumps(site_table(SMALL)))
    return path


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_command_makes_a_session_and_resumes(tmp_path: Path) -> None:
    out = tmp_path / "session"
    command = ["simulate", str(_toml(tmp_path / "site.toml")), "--out", str(out), "--size", "16x8"]
    command += ["--quality", "draft", "--count", "12", "--json"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["rendered"] == 12 and answer["dark"] == 0
    assert len(load_pairs(out / "truth" / "pairs.csv").slots) == 12
    with (out / "pairs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and all(row["sun_in_map"] == "0" and row["ok"] == "1" for row in rows)
    panorama = read_panorama(out / rows[3]["panorama"])
    patch = read_panorama(out / rows[3]["sunpatch"])
    assert panorama.luminance_cdm2.shape == patch.luminance_cdm2.shape == (8, 16)
    assert (panorama.luminance_cdm2 >= patch.luminance_cdm2 - 1e-3).all()
    # A lost picture is made again, the others are kept, and every file is as it was.
    lost = out / rows[3]["panorama"]
    before = lost.read_bytes()
    lost.unlink()
    again = json.loads(
        CliRunner().invoke(main, ["simulate", str(out), *command[4:8], "--json"]).stdout
    )
    assert (again["rendered"], again["kept"]) == (1, 11)
    assert lost.read_bytes() == before
    # Another size: nothing of the old one stays.
    command[5] = "20x10"
    other = json.loads(
        CliRunner().invoke(main, ["simulate", str(out), *command[4:8], "--json"]).stdout
    )
    assert (other["rendered"], other["kept"]) == (12, 0)
    assert read_panorama(lost).luminance_cdm2.shape == (10, 20)


@pytest.mark.slow
@pytest.mark.property
def test_truth_irradiance_is_steady_within_the_hour(tmp_path: Path) -> None:
    year = weather.shipped_seattle()
    session = simulate.make_session(
        tmp_path / "s", SMALL, simulate.sample_slots(SMALL, year, 2, 1), {"set": "test"}
    )
    simulate.run(session, year, height=8, quality="draft")
    with (session.truth / "irradiance.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 48 and rows[0]["ghi_wm2"] == rows[1]["ghi_wm2"]
    assert open_session(session.root).table()["simulation"]["weather"] == year.name


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--size", "100x60"], 2),
        (["--size", "big"], 2),
        ([], 2),
        (["--out", "x", "--weather", "nowhere.epw"], 3),
    ],
)
def test_exit_codes(tmp_path: Path, arguments: list[str], code: int) -> None:
    result = CliRunner().invoke(main, ["simulate", str(_toml(tmp_path / "site.toml")), *arguments])
    assert result.exit_code == code
