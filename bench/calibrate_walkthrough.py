"""Calibrate the simulated cameras from nothing but captures and readings, and compare with what
they really are.

    python bench/calibrate_walkthrough.py OUT

Photographs made-up scenes with `sim-fisheye` (raw) and `sim-dual-fisheye-jpeg`, then runs `fieldlum
calibrate` on them as a person would: lens by its circle and by known directions, vignetting by one
patch at many angles, colour by spot readings, scale by spots and vertical illuminance on a merged
bracket, response by three JPEG brackets. Writes profiles and pictures to OUT and prints a Markdown
table.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.merge import MergeOptions, merge_shots, shots_of_files
from fieldlum.optics.camera_curves import response_table, vignetting_at
from fieldlum.optics.illuminance import illuminance_lx
from fieldlum.optics.images import write_panorama
from fieldlum.optics.profiles import (
    CameraProfile,
    Colour,
    Lens,
    Provenance,
    Response,
    Scale,
    bracket_exposures,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.projection import direction, equirect_rays, lens_pixels, lens_rays

H = 480
START = datetime(2027, 3, 20, 12, tzinfo=UTC)


@dataclass
class Still:
    """A world that does not change."""

    panorama: Panorama

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


def _picture(rgb: np.ndarray) -> Panorama:
    """Radiance RGB [H, 2H, 3] in cd/m2, facing south."""
    luminance = rgb @ np.array([0.265, 0.670, 0.065])
    return Panorama(luminance.astype(np.float32), 180.0, rgb=(rgb / 179).astype(np.float32))


def _spots(
    places: list[tuple[float, float]], colours: np.ndarray, radius_deg: float, ground: float
) -> Panorama:
    """Discs of light at (azimuth, altitude) on an even ground."""
    rgb = np.full((H, 2 * H, 3), ground)
    rays = equirect_rays(H, 2 * H, 180.0)
    for (azimuth, altitude), colour in zip(places, colours, strict=True):
        rgb[rays @ direction(altitude, azimuth) > np.cos(np.radians(radius_deg))] = colour
    return _picture(rgb)


def _shoot(
    profile: CameraProfile,
    panorama: Panorama,
    exposure: Exposure,
    target: Path,
    heading: float = 180.0,
) -> Path:
    camera = SimulatedCamera(Still(panorama), profile, FastClock(START))
    return camera.expose(exposure, target, heading_deg=heading)


def _run(*words: object) -> str:
    found = CliRunner().invoke(main, ["calibrate", *map(str, words)])
    if found.exit_code:
        sys.exit(found.output)
    print(found.stdout, file=sys.stderr)
    return found.stdout


def _at(truth: CameraProfile, azimuth: float, altitude: float) -> tuple[float, float]:
    """Where a person would click: the middle of a disc on the sensor."""
    x, y, _ = lens_pixels(truth.lens[0], direction(altitude, azimuth))
    return float(x), float(y)


def _blank(truth: CameraProfile) -> CameraProfile:
    """What is known of a camera out of its box: the sensor's data sheet, nothing of lens, colour
    and scale.
    """
    middle = (truth.camera.width_px / 2, truth.camera.height_px / 2)
    plain = Lens(middle, 0.45 * truth.camera.height_px, 190.0, name="front")
    return replace(truth, lens=(plain,), colour=Colour(), scale=Scale(), provenance=Provenance())


def raw_camera(out: Path) -> list[tuple[str, str, str]]:
    truth, mine = load_camera_profile("sim-fisheye"), out / "mine.toml"
    save_profile(mine, _blank(truth))
    middle = Exposure(1 / 60, 5.6)
    rows = []
    flat = _shoot(truth, _picture(np.full((H, 2 * H, 3), 300.0)), middle, out / "flat")
    words = (
        "--circle",
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-circle.png",
    )
    _run("lens", flat, *words)
    found, lens = load_camera_profile(mine).lens[0], truth.lens[0]
    rows.append(
        (
            "circle by its edge: centre, radius [px]",
            f"{lens.centre_px} {lens.radius_px:g}",
            f"{found.centre_px} {found.radius_px:g}",
        )
    )

    rng = np.random.default_rng(1)
    places = [(float(a), float(b)) for a in range(-85, 86, 17) for b in (-60, -35, -10, 15, 40, 65)]
    targets = ["x_px,y_px,azimuth_deg,altitude_deg"]
    for azimuth, altitude in places:
        x, y = _at(truth, azimuth, altitude)
        targets.append(
            f"{x + 0.3 * rng.normal():.2f},{y + 0.3 * rng.normal():.2f},{azimuth},{altitude}"
        )
    (out / "targets.csv").write_text("\n".join(targets))
    _run(
        "lens",
        out / "targets.csv",
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-lens.png",
    )
    found = load_camera_profile(mine).lens[0]
    seen = lens_pixels(lens, equirect_rays(60, 120, 0.0).reshape(-1, 3))
    inside = seen[2] < np.radians(93)
    # the same sensor places through both lenses
    mine_rays = lens_rays(found, seen[0][inside], seen[1][inside])
    true_rays = equirect_rays(60, 120, 0.0).reshape(-1, 3)[inside]
    off = np.degrees(np.arccos(np.clip((mine_rays * true_rays).sum(axis=1), -1, 1)))
    rows.append(
        (
            "lens by 66 targets clicked to 0.3 px: mapping; worst ray",
            f"{lens.mapping}; 0 deg",
            f"{found.mapping}; {off.max():.2f} deg",
        )
    )

    patches = ["file,x_px,y_px,radius_px"]
    disc = _spots([(180.0, 0.0)], np.array([[400.0] * 3]), 3.0, 20.0)
    for i, turn in enumerate(np.linspace(-88, 88, 23)):
        _shoot(truth, disc, middle, out / f"patch{i}", heading=180.0 - turn)
        x, y = _at(truth, turn, 0.0)
        patches.append(f"patch{i}.dng,{x:.1f},{y:.1f},4")
    (out / "patches.csv").write_text("\n".join(patches))
    _run(
        "vignette",
        out / "patches.csv",
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-vignette.png",
    )
    r = np.linspace(0, 0.92, 100)
    curves = [
        vignetting_at(p.lens[0].vignetting[i].coefficients, r)
        for p, i in ((truth, 1), (load_camera_profile(mine), 0))
    ]
    rows.append(
        (
            "vignetting by one patch at 23 angles: worst difference",
            "0 %",
            f"{100 * np.abs(curves[1] / curves[0] - 1).max():.2f} %",
        )
    )

    paints = np.array(
        [[s * (c == 0), s * (c == 1), s * (c == 2)] for c in range(3) for s in (300.0,)]
    )
    paints = 60.0 + np.concatenate(
        [paints, paints[[0, 1, 2]] + paints[[1, 2, 0]], [[400.0] * 3, [90.0] * 3, [500.0, 300, 90]]]
    )
    spots = [(180.0 + a, b) for a in (-40.0, 0.0, 40.0) for b in (-25.0, 0.0, 25.0)]
    scene = _spots(spots, paints, 4.0, 40.0)
    frame = _shoot(truth, scene, Exposure(1 / 125, 5.6), out / "spots")
    readings = ["file,x_px,y_px,radius_px,luminance_cdm2"]
    for (azimuth, altitude), paint in zip(spots, paints, strict=True):
        x, y = _at(truth, azimuth - 180.0, altitude)
        luminance = float(paint @ np.array([0.265, 0.670, 0.065])) * (1 + 0.01 * rng.normal())
        readings.append(f"{frame.name},{x:.1f},{y:.1f},4,{luminance:.2f}")
    (out / "spots.csv").write_text("\n".join(readings))
    _run(
        "colour",
        out / "spots.csv",
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-colour.png",
    )
    shares = [
        np.array(p.colour.y_from_rgb) / sum(p.colour.y_from_rgb)
        for p in (truth, load_camera_profile(mine))
    ]
    rows.append(
        (
            "colour by nine spots read to 1 %: shares of R, G, B",
            *(" ".join(f"{v:.3f}" for v in s) for s in shares),
        )
    )

    bracket = [
        _shoot(truth, scene, e, out / f"b{i}")
        for i, e in enumerate(bracket_exposures(truth.bracket))
        if not e.nd
    ]
    merged = merge_shots(
        shots_of_files(bracket), load_camera_profile(mine), MergeOptions(height=230)
    )
    write_panorama(out / "merged.exr", merged.panorama)
    lines = ["panorama,azimuth_deg,altitude_deg,luminance_cdm2,illuminance_lx"]
    for (azimuth, altitude), paint in zip(spots, paints, strict=True):
        luminance = float(paint @ np.array([0.265, 0.670, 0.065])) * (1 + 0.02 * rng.normal())
        lines.append(f"merged.exr,{azimuth},{altitude},{luminance:.2f},")
    front = np.where(
        equirect_rays(H, 2 * H, 180.0) @ direction(0, 180) > 0, scene.luminance_cdm2, 0
    )
    lines.append(f"merged.exr,180,0,,{illuminance_lx(front, 180.0, 0.0, 180.0):.1f}")
    (out / "readings.csv").write_text("\n".join(lines))
    _run(
        "scale",
        out / "readings.csv",
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-scale.png",
    )
    final = load_camera_profile(mine)
    # what counts is k times the coefficients: both carry the factor
    wanted = truth.scale.k * sum(truth.colour.y_from_rgb)
    got = final.scale.k * sum(final.colour.y_from_rgb)
    rows.append(
        (
            "scale by nine spots read to 2 % and one illuminance: k (R + G + B)",
            f"{wanted:.4f}",
            f"{got:.4f} ({100 * (got / wanted - 1):+.2f} %, u {100 * final.scale.u_rel:.1f} %)",
        )
    )
    again = merge_shots(
        shots_of_files(bracket), final, MergeOptions(height=230)
    ).panorama.luminance_cdm2
    true = merge_shots(
        shots_of_files(bracket), truth, MergeOptions(height=230)
    ).panorama.luminance_cdm2
    lit = (equirect_rays(230, 460, 180.0) @ direction(0, 180)) > np.cos(np.radians(85))
    off_map = np.abs(again[lit] / true[lit] - 1)
    rows.append(
        (
            "the same bracket merged by both profiles: median, 95th percentile",
            "0 %",
            f"{100 * np.median(off_map):.2f} %, {100 * np.percentile(off_map, 95):.2f} %",
        )
    )
    return rows


def jpeg_camera(out: Path) -> list[tuple[str, str, str]]:
    truth, mine = load_camera_profile("sim-dual-fisheye-jpeg"), out / "jpeg.toml"
    save_profile(mine, replace(truth, response=Response()))
    rng = np.random.default_rng(2)
    for number in range(3):
        blocks = 10 ** rng.uniform(0.3, 3.2, (H // 20, 2 * H // 20, 1)) * rng.uniform(
            0.7, 1.3, (1, 1, 3)
        )
        scene = _picture(np.repeat(np.repeat(blocks, 20, axis=0), 20, axis=1))
        folder = out / f"bracket-{number + 1}"
        folder.mkdir(exist_ok=True)
        for i, exposure in enumerate(bracket_exposures(truth.bracket)):
            if not exposure.nd:
                _shoot(truth, scene, exposure, folder / f"f{i}")
    folders = sorted(out.glob("bracket-*"))
    _run(
        "response",
        *folders,
        "--camera",
        mine,
        "--out",
        mine,
        "--picture",
        out / "calibrate-response.png",
    )
    found, codes = load_camera_profile(mine).response, np.arange(27, 229)
    log = [np.log(response_table(r.kind, r.green)[codes]) for r in (truth.response, found)]
    off = log[1] - log[0]
    off -= off.mean()
    return [
        (
            "response by three JPEG brackets: rms, worst over codes 27 to 228",
            "0 %",
            f"{100 * off.std():.2f} %, {100 * np.abs(off).max():.2f} %",
        )
    ]


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    table = [*raw_camera(folder), *jpeg_camera(folder)]
    print("| what | the camera's own | found |\n|---|---|---|")
    for row in table:
        print("| " + " | ".join(row) + " |")
