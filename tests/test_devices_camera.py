"""devices/simulated: the camera's counts follow from the light by its profile's own figures."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import Exposure, Panorama, SunSource
from fieldlum.devices import nearest, open_camera
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated import optics
from fieldlum.devices.simulated.camera import SimulatedCamera, camera_from_scene
from fieldlum.devices.simulated.world import SimulatedLight, TruthWorld
from fieldlum.optics import projection
from fieldlum.optics.camera_curves import vignetting_at
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.images import write_panorama
from fieldlum.optics.linear_light import lens_geometry, true_shutter_s
from fieldlum.optics.profiles import CameraProfile, load_camera_profile
from fieldlum.optics.raw import read_jpeg, read_mosaic

START = datetime(2027, 3, 20, 19, 30, tzinfo=UTC)
DIAL = Exposure(1 / 60, 5.6, 100.0)


class Still:
    """A world that never changes."""

    def __init__(self, panorama: Panorama) -> None:
        self.panorama = panorama

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


def uniform(level_cdm2: float, heading_deg: float = 180.0, height: int = 46) -> Panorama:
    return Panorama(np.full((height, 2 * height), level_cdm2, np.float32), heading_deg)


def camera(panorama: Panorama, profile: CameraProfile, **options: float) -> SimulatedCamera:
    return SimulatedCamera(Still(panorama), profile, FastClock(START), **options)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.analytic
def test_uniform_room_gives_the_counts_of_the_profile(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    mosaic = read_mosaic(camera(uniform(300.0), profile).expose(DIAL, tmp_path / "f"))
    lens = profile.lens[0]
    geometry = lens_geometry(lens, 0.0)
    rows, columns = np.mgrid[0.5:484, 0.5:484]
    r = np.hypot(columns - lens.centre_px[0], rows - lens.centre_px[1]) / lens.radius_px
    relative = optics.angle_of_radius(geometry, np.minimum(r, 1.0)) / geometry.half_angle_rad
    green = np.zeros((484, 484), bool)
    green[0::2, 1::2] = True  # G1 of RGGB, black 514
    z = (
        z_per_cdm2(1 / 64, 5.6, 100.0, profile.scale.k)
        * 300.0
        * camera_from_scene(profile).sum(axis=1)[1]
    )
    expected = z * (16383 - 514) * vignetting_at(lens.vignetting[1].coefficients, relative)
    got = mosaic.counts[green & (r < 0.98)] - 514.0
    ratio = got / expected[green & (r < 0.98)]
    assert ratio.mean() == pytest.approx(1.0, abs=5e-4)  # standard error of the mean: 1e-4
    # Shot noise of some 1000 DN at 4 e/DN, and 6 e read noise.
    assert ratio.std() == pytest.approx(
        np.sqrt(expected.max() * 4 + 36) / (expected.max() * 4), rel=0.15
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_exif_says_the_dial_and_the_shutter_does_otherwise(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    mosaic = read_mosaic(camera(uniform(10.0), profile).expose(DIAL, tmp_path / "f"))
    assert mosaic.exposure == DIAL
    assert true_shutter_s(1 / 60, profile)[0] == 1 / 64
    assert true_shutter_s(13.0, profile)[0] == pytest.approx(12.7, abs=0.01)


@pytest.mark.slow
@pytest.mark.analytic
def test_saturates_below_the_tag(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    mosaic = read_mosaic(camera(uniform(1e6), profile).expose(DIAL, tmp_path / "f"))
    assert mosaic.white_dn == 16383 and mosaic.counts.max() == 15810
    assert np.median(mosaic.counts[0::2, 0::2]) == 15790


@pytest.mark.slow
@pytest.mark.analytic
def test_a_bright_spot_lands_where_the_lens_puts_it(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-dual-fisheye")
    for altitude, azimuth in ((20.0, 200.0), (-35.0, 130.0), (10.0, 20.0)):
        panorama = uniform(0.01, height=180)
        i, j = projection.equirect_pixel(altitude, azimuth, 180, 360, 180.0)
        panorama.luminance_cdm2[int(i), int(j)] = 2000.0
        mosaic = read_mosaic(camera(panorama, profile).expose(DIAL, tmp_path / "f"))
        row, column = np.unravel_index(mosaic.counts.argmax(), mosaic.counts.shape)
        ray = projection.equirect_rays(180, 360, 180.0)[int(i), int(j)]
        lens = profile.lens[0] if np.cos(np.radians(azimuth - 180)) > 0 else profile.lens[1]
        x, y, _ = projection.lens_pixels(lens_geometry(lens, 180.0), ray)
        assert (
            np.hypot(column + 0.5 - x, row + 0.5 - y) < 4.0
        )  # a panorama pixel is 3 sensor pixels wide


@pytest.mark.slow
@pytest.mark.analytic
def test_the_sun_keeps_its_energy() -> None:
    profile = load_camera_profile("sim-fisheye")
    for altitude, azimuth in ((30.0, 190.3), (5.0, 120.0), (70.1, 250.0)):
        panorama = replace(uniform(0.0), sun=SunSource(altitude, azimuth, 80_000.0))
        geometry = lens_geometry(profile.lens[0], 0.0)
        image = optics.on_sensor(
            panorama, [optics.lens_sampling(geometry, (484, 484), (46, 92), None)], (484, 484)
        )[..., 0]
        rows, columns = np.mgrid[0.5:484, 0.5:484]
        omega = optics.pixel_solid_angle_sr(geometry, columns, rows)
        assert (image * omega).sum() == pytest.approx(80_000.0, rel=1e-5)
        assert omega.sum() == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(95.0))), rel=2e-3)


@pytest.mark.slow
@pytest.mark.analytic
def test_turning_the_head_turns_the_picture(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    panorama = uniform(1.0, height=90)
    panorama.luminance_cdm2[:, :90] = 100.0  # left half of a panorama that faces south: the east
    cam = camera(panorama, profile)
    means = {}
    for heading in (0.0, 90.0, 270.0):
        mosaic = read_mosaic(cam.expose(DIAL, tmp_path / f"{heading}", heading_deg=heading))
        means[heading] = mosaic.counts[200:284, 200:284].mean() - 512
        if heading == 0.0:  # looking north, the east is on the right
            assert mosaic.counts[240, 300] > 3 * mosaic.counts[240, 180] - 1024
    assert means[90.0] > 20 * means[270.0]


@pytest.mark.slow
@pytest.mark.analytic
def test_colours_come_back_through_the_profile(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    rgb = np.tile(np.array([1.2, 0.9, 0.5], np.float32), (46, 92, 1))
    panorama = Panorama(179 * (rgb @ np.array([0.265, 0.670, 0.065], np.float32)), 180.0, rgb=rgb)
    mosaic = read_mosaic(camera(panorama, profile).expose(DIAL, tmp_path / "f"))
    middle = mosaic.counts[222:262, 222:262].astype(float)
    per = z_per_cdm2(1 / 64, 5.6, 100.0, profile.scale.k)
    cells = zip(((0, 0), (0, 1), (1, 1)), (512, 514, 511), strict=True)
    seen = [(middle[r::2, c::2].mean() - black) / per / (16383 - black) for (r, c), black in cells]
    vignette = vignetting_at(profile.lens[0].vignetting[1].coefficients, 0.05)
    found = np.reshape(profile.colour.rgb_to_radiance, (3, 3)) @ np.array(seen) / vignette / 179
    assert found == pytest.approx([1.2, 0.9, 0.5], rel=0.01)
    assert np.dot(profile.colour.y_from_rgb, seen) / vignette == pytest.approx(
        panorama.luminance_cdm2[0, 0], rel=0.01
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_jpeg_follows_its_response(tmp_path: Path) -> None:
    from fieldlum.optics.camera_curves import response_table

    profile = load_camera_profile("sim-dual-fisheye-jpeg")
    frame = read_jpeg(camera(uniform(900.0), profile).expose(DIAL, tmp_path / "f"))
    code = frame.codes[222:262, 222:262, 1].mean()
    z = np.interp(code, np.arange(256), response_table("polynomial", profile.response.green))
    assert z == pytest.approx(
        900.0 * z_per_cdm2(1 / 64, 5.6, 100.0, profile.scale.k), rel=0.02
    )  # code steps: 1 %


@pytest.mark.slow
@pytest.mark.property
def test_same_seed_same_moment_same_frame(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-fisheye")
    frames = []
    for seed in (1, 1, 2):
        cam = camera(uniform(20.0), profile, seed=seed)
        frames.append(cam.expose(DIAL, tmp_path / f"s{len(frames)}").read_bytes())
    assert frames[0] == frames[1] != frames[2]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("exposure", "said"),
    [
        (Exposure(1 / 60, 5.0), r"no 1/60 f/5 ISO100; expected f-numbers \[4.0, 5.6, 8.0\]"),
        (Exposure(1 / 60, 5.6, 100, "nd9"), r"ND=nd9; expected .* filters \['', 'nd5'\]"),
        (Exposure(300.0, 5.6), "300 s is not offered by the camera; the nearest value is 30"),
        (Exposure(1 / 60, 5.6, 12.0), "no 1/60 f/5.6 ISO12"),
    ],
)
def test_nothing_snaps_silently(tmp_path: Path, exposure: Exposure, said: str) -> None:
    with pytest.raises(DeviceError, match=said):
        camera(uniform(1.0), load_camera_profile("sim-fisheye")).expose(exposure, tmp_path / "f")


@pytest.mark.contract
def test_nearest_takes_a_sixth_of_a_stop_and_no_more() -> None:
    assert nearest(1 / 64, [1 / 60, 1 / 50], "shutter") == 1 / 60
    with pytest.raises(DeviceError, match="not offered"):
        nearest(1 / 30, [1 / 60, 1 / 15], "shutter")


@pytest.mark.slow
@pytest.mark.contract
def test_the_built_in_office_needs_nothing_else(tmp_path: Path) -> None:
    clock = FastClock(START)
    cam = open_camera("sim:office?seed=3", clock=clock)
    path = cam.expose(DIAL, tmp_path / "01_0.0167s.x")
    assert path.name == "01_0.0167s.x.dng"
    assert (clock.now() - START).total_seconds() == pytest.approx(1.0 + 1 / 64, abs=1e-5)
    counts = read_mosaic(path).counts
    assert counts.shape == (484, 968) and 700 < np.median(counts) < 15700
    cam.close()


@pytest.mark.contract
def test_truth_folder(tmp_path: Path) -> None:
    write_panorama(tmp_path / "20270320T193000Z.exr", uniform(5.0))
    (tmp_path / "irradiance.csv").write_text(
        "t_utc,ghi_wm2,dhi_wm2,dni_wm2\n2027-03-20T19:00:00Z,100,50,200\n2027-03-20T20:00:00Z,200,70,400\n"
    )
    world = TruthWorld(tmp_path)
    assert world.scene(START).luminance_cdm2[0, 0] == 5.0
    assert world.irradiance(START) == SimulatedLight(ghi_wm2=150.0, dhi_wm2=60.0, dni_wm2=300.0)
    assert world.irradiance(datetime(2027, 3, 21, 8, tzinfo=UTC)) == SimulatedLight(
        ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0
    )
    with pytest.raises(DeviceError, match="no simulated panorama within 45 min"):
        world.scene(datetime(2027, 3, 21, 8, tzinfo=UTC))
    (tmp_path / "irradiance.csv").write_text("t_utc,ghi_wm2\n2027-03-20T19:00:00Z,many\n")
    with pytest.raises(InputError, match=r"irradiance.csv.*fieldlum simulate"):
        TruthWorld(tmp_path)
