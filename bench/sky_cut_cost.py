"""Cost of panoramas/SLOT.sky.npz in `merge`: CPU time, peak memory and megabytes a capture.

    python bench/sky_cut_cost.py OUT [theta dslr pi]

simulates one bracket of each camera before a window with bars, merges it twice in a fresh process
without and with the cut, and prints one row: the first merge has to compute the matrices, the
second is what each further capture costs.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import DetailedPanorama, SimulatedLight
from fieldlum.merge import MergeOptions, Shot, merge_shots
from fieldlum.optics.linear_light import sensor_pitch_deg
from fieldlum.optics.profiles import CameraProfile, load_camera_profile
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture, write_sky_picture

SHUTTER_S = (0.25, 0.015625, 0.001)  # a short bracket; each further frame costs the merge alone
LATITUDE_DEG = 47.6


def camera(name: str) -> CameraProfile:
    """Return the profile: a Theta Z1's raw size, a DSLR with a circular fisheye, a Raspberry Pi."""
    if name == "dslr":
        return load_camera_profile("canon-5d2-8mm-f5.6")
    if name == "pi":
        return load_camera_profile("rpi-hq-fisheye-uncalibrated")
    small = load_camera_profile("sim-dual-fisheye")
    factor = 3648 / small.camera.height_px
    body = replace(small.camera, width_px=7296, height_px=3648)
    lenses = tuple(
        replace(
            lens,
            centre_px=(lens.centre_px[0] * factor, lens.centre_px[1] * factor),
            radius_px=lens.radius_px * factor,
        )
        for lens in small.lens
    )
    return replace(small, camera=body, lens=lenses)


class Window:
    """A world: a dark room with a window of 70 x 45 degrees, with bars every 2 degrees."""

    def __init__(self) -> None:
        rows, columns = np.mgrid[:900, :1400]
        bars = ((rows // 10) % 4 == 0) | ((columns // 10) % 20 == 0)
        noise = np.random.default_rng(0).normal(1.0, 0.01, bars.shape)
        light = (np.where(bars, 60.0, 3000.0) * noise).astype(np.float32)
        grid = SkyGrid(
            first_altitude_deg=45.0,
            first_azimuth_deg=-35.0,
            step_deg=0.05,
            heading_deg=180.0,
            height=light.shape[0],
            width=light.shape[1],
        )
        room = np.full((115, 230), 40.0, np.float32)
        detail = SkyPicture(light, np.zeros(light.shape, bool), grid)
        self.panorama = DetailedPanorama(room, 180.0, detail=detail)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama of any time."""
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return no irradiance."""
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


def exposures(profile: CameraProfile) -> list[Exposure]:
    """Return the bracket of a camera."""
    bracket = profile.bracket
    return [Exposure(t, bracket.f_number, bracket.iso) for t in SHUTTER_S]


def capture(name: str, folder: Path) -> None:
    """Write the frames of one bracket, unless they exist."""
    if len(list(folder.glob("*.dng"))) == len(SHUTTER_S):
        return
    profile = camera(name)
    clock = FastClock(datetime(2027, 3, 20, 20, 0, tzinfo=UTC))
    taken = SimulatedCamera(Window(), profile, clock, heading_deg=180.0)
    folder.mkdir(parents=True, exist_ok=True)
    for k, exposure in enumerate(exposures(profile)):
        taken.expose(exposure, folder / f"{k}")


def merge(name: str, folder: Path, cut: bool) -> None:
    """Merge the bracket twice and print times, peak memory and the size of the cut."""
    profile = camera(name)
    files = sorted(p for p in folder.iterdir() if p.suffix in (".dng", ".jpg"))
    shots = [Shot(f, e, None) for f, e in zip(files, exposures(profile), strict=True)]
    seconds = []
    for _ in range(2):
        start = time.process_time()
        made = merge_shots(
            shots, profile, MergeOptions(), latitude_deg=LATITUDE_DEG if cut else None
        )
        seconds.append(time.process_time() - start)
    size = 0
    if made.sky is not None:
        write_sky_picture(folder / "cut.npz", made.sky)
        size = (folder / "cut.npz").stat().st_size
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(json.dumps([*seconds, peak, size / 1e6, made.sky.grid.step_deg if made.sky else 0.0]))


def main() -> None:
    """Print a row for each camera, or do one part in this process."""
    out, names = Path(sys.argv[1]), sys.argv[2:]
    if names and names[0] in ("with", "without"):
        merge(names[1], out / names[1], names[0] == "with")
        return
    print("camera, sensor deg, cut deg, first s without, with, next s without, with, GB, GB, MB")
    for name in names or ["pi", "dslr", "theta"]:
        capture(name, out / name)
        rows = []
        for part in ("without", "with"):
            command = [sys.executable, __file__, str(out), part, name]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append(json.loads(done.stdout.splitlines()[-1]))
        (a, b, gb, _, _), (first, later, more, size, step) = rows
        print(
            f"{name}, {sensor_pitch_deg(camera(name)):.3f}, {step:.3f}, {a:.1f}, {first:.1f}, "
            f"{b:.1f}, {later:.1f}, {gb:.2f}, {more:.2f}, {size:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
