"""Light transport on the 1 378 rendered hours of the paper's office: weighted log10 MSE on its 500
test hours.

    python bench/transport_office.py office_seattle.npz [--sets k200,9d,12d,4d,mar] [--modes
    absolute,gain,none,tape]
        [--noise 0.05] [--seed 0] [--coverage]

The archive is described with it; it is not part of the project. Maps are compared with the
sun's disc put back. Mode "tape": the patches are not the rendering's but made from a box with one
clear window and no furniture.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window, slot_id
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import Transport, fit
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.scene import sun_patches
from fieldlum.sky.daylight import Light
from fieldlum.sky.perez import PerezSky
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import add_disc, find_disc, without_disc

HEADING_DEG = 180.0
ROOM = Room(window=(Window("south", 0.5, 5.0, 0.9, 3.1, 0.88, 4, 0.08, 2.9),))
SETUP = SiteFile(
    Site("office", 47.6, -122.3, "America/Los_Angeles"), CameraSetup(heading_deg=HEADING_DEG), ROOM
)
TAPE = replace(ROOM, window=(replace(ROOM.window[0], panes=1, frame_m=0.0, transom_m=0.0),))
UNKNOWN_GAIN = 3.7  # factor that the "gain" mode has to find


def split_disc(
    luminance_cdm2: np.ndarray, heading_deg: float, near_deg: tuple[float, float], dni_wm2: float
) -> tuple[np.ndarray, float]:
    """Return a map [H, W] without the disc, and the disc's normal illuminance in lx (0 without)."""
    disc = find_disc(luminance_cdm2, heading_deg, near_deg=near_deg, dni_wm2=dni_wm2)
    if disc is None:
        return luminance_cdm2, 0.0
    return without_disc(luminance_cdm2, disc), disc.normal_lx


def decode(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    return (10.0 ** (codes.astype(np.float64) / 65535.0 * 9.0 - 0.5)).astype(np.float32)


def read(archive: dict[str, NDArray], rows: NDArray) -> tuple[Dataset, NDArray[np.float32]]:
    """Captures of some rows with the disc taken out, and the maps as they are. Sky and sun are
    the rendering's own.
    """
    c = archive["conditions"][rows]
    towards = c[:, 15:18] / np.linalg.norm(c[:, 15:18], axis=1, keepdims=True)
    altitude = np.degrees(np.arcsin(towards[:, 2]))
    azimuth = np.degrees(np.arctan2(towards[:, 0], towards[:, 1])) % 360.0
    months, dates, hours = c[:, :3].T
    times = tuple(
        datetime(2027, int(m), int(d), tzinfo=UTC) + timedelta(hours=float(h) + 8.0)
        for m, d, h in zip(months, dates, hours, strict=True)
    )
    unknown = np.full(len(rows), np.nan)
    direct_lx = 179.0 * c[:, 7] * SUN_SOLID_ANGLE_SR
    perez = PerezSky(179.0 * c[:, 8], 179.0 * c[:, 9], c[:, 10:15], unknown, direct_lx, unknown)
    whole = decode(archive["lum"][rows])
    codes = archive["sunpatch"][rows]
    patch = np.where(codes > 0, decode(codes), np.float32(0.0))
    maps, disc = whole.copy(), np.zeros(len(rows))
    for k in range(len(rows)):
        at = HEADING_DEG, (float(altitude[k]), float(azimuth[k])), float(c[k, 3])
        maps[k] = split_disc(whole[k], *at)[0]
        patch[k], disc[k] = split_disc(patch[k], *at)
    days = np.array(
        [f"2027-{int(m):02d}-{int(d):02d}" for m, d in zip(months, dates, strict=True)],
        "datetime64[D]",
    )
    light = Light(
        t_utc=times,
        dni_wm2=c[:, 3],
        dhi_wm2=c[:, 4],
        sun_altitude_deg=altitude,
        sun_azimuth_deg=azimuth,
        perez=perez,
        refraction=False,
    )
    seen, steady = np.ones(maps.shape[1:], bool), np.zeros(len(rows))
    slots = tuple(slot_id(t) for t in times)
    return Dataset(light, maps, patch, disc, HEADING_DEG, days, slots, SETUP, seen, steady), whole


def told(data: Dataset, mode: str) -> Dataset:
    """The captures as a mode knows them: the rendering's patches, those off by a factor, or a
    tape measure's.
    """
    if mode == "tape":
        light = data.light
        made = sun_patches(
            TAPE,
            light.apparent_sun_direction,
            light.direct_lx,
            height=data.shape[0],
            heading_deg=HEADING_DEG,
        )
        return replace(data, patch_cdm2=made, setup=replace(SETUP, room=TAPE))
    assert data.patch_cdm2 is not None
    factor = np.float32(UNKNOWN_GAIN if mode == "gain" else 1.0)
    return replace(data, patch_cdm2=data.patch_cdm2 / factor)


def draw(shape: tuple[int, int], pixels: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mask [H, W] of some pixels, drawn by solid angle."""
    omega = equirect_solid_angles(*shape).ravel()
    seen = np.zeros(omega.size, bool)
    seen[rng.choice(omega.size, pixels, replace=False, p=omega / omega.sum())] = True
    return seen.reshape(shape)


def errors(
    truth: NDArray, predicted: NDArray, light: Light, disc_lx: NDArray
) -> NDArray[np.float64]:
    """log10 errors of recomposed maps above 1 cd/m2, [n, H, W]."""
    whole = add_disc(predicted, light, disc_lx, HEADING_DEG)
    return np.log10(np.maximum(whole, 1.0)) - np.log10(np.maximum(truth, 1.0))


def coverage(model: Transport, test: Dataset, truth: NDArray, patch: NDArray | None) -> str:
    """Share of test pixels within the 90 % interval, by the sun's share of the light; and what
    the flag finds.
    """
    found = model.predict(test.light, patch)
    assert found.log10_sd is not None
    e = errors(truth, found.luminance_cdm2, test.light, test.disc_lx)
    inside = np.abs(e) <= 1.645 * found.log10_sd
    w = equirect_solid_angles(*test.shape)
    w = w / w.sum()
    share = (inside * w).sum(axis=(1, 2))
    beam = test.light.direct_lx / test.light.total_lx
    kinds = {
        "overcast": beam < 0.05,
        "intermediate": (beam >= 0.05) & (beam < 0.5),
        "clear": beam >= 0.5,
    }
    actual = (e**2 * w).sum(axis=(1, 2))
    worst = np.argsort(actual)[-len(actual) // 10 :]
    flagged = np.argsort(found.expected_mse)[-len(actual) // 10 :]
    hit = len(np.intersect1d(worst, flagged)) / len(worst)
    caught = actual[flagged].sum() / actual.sum()
    parts = [f"{name} {share[rows].mean():.3f}" for name, rows in kinds.items()]
    return (
        f"    90 % intervals hold {', '.join(parts)}; flagged tenth: {hit:.0%} of the worst "
        f"tenth, {caught:.0%} of all "
        f"error; guess / actual {found.expected_mse.mean() / actual.mean():.2f}; trusted "
        f"{found.trusted.mean():.0%} "
        f"(their MSE {actual[found.trusted].mean() if found.trusted.any() else np.nan:.2e})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("--sets", default="k200,9d,12d,4d,mar")
    parser.add_argument("--modes", default="absolute,gain,none")
    parser.add_argument(
        "--noise", type=float, default=0.0, help="relative pixel noise of the training maps"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coverage", action="store_true")
    options = parser.parse_args()
    with np.load(options.archive, allow_pickle=False) as stored:
        archive = {name: stored[name] for name in stored.files}
    test, truth = read(archive, archive["set_test"])
    w = equirect_solid_angles(*test.shape)
    w = w / w.mean()
    print(
        "set   patch     noise  weighted  unweighted RER     median   p90      worst    fit s  "
        "predict s  recipe"
    )
    for name in options.sets.split(","):
        train, _ = read(archive, archive[f"set_{name}"])
        rng = np.random.default_rng(options.seed)
        noisy = train.luminance_cdm2 * (
            1.0 + options.noise * rng.standard_normal(train.luminance_cdm2.shape)
        )
        train = replace(train, luminance_cdm2=np.maximum(noisy, 1e-3).astype(np.float32))
        for mode in options.modes.split(","):
            known, asked = told(train, mode), told(test, mode)
            start = time.process_time()
            model = fit(known, patch="absolute" if mode == "tape" else mode, seed=options.seed)
            fitted = time.process_time()
            patch = None if mode == "none" else asked.patch_cdm2
            maps = model.predict(test.light, patch).luminance_cdm2
            done = time.process_time()
            e = errors(truth, maps, test.light, test.disc_lx)
            each = (e**2 * w).mean(axis=(1, 2))
            rer = np.sqrt((e**2 * w).sum() / (np.log10(np.maximum(truth, 1.0)) ** 2 * w).sum())
            figures = " ".join(
                f"{v:.2e}" for v in (np.median(each), np.percentile(each, 90), each.max())
            )
            print(
                f"{name:5s} {mode:9s} {options.noise:5.2f}  {each.mean():.2e}  "
                f"{(e**2).mean():.2e}   {rer:.4f}  "
                f"{figures} {fitted - start:5.1f} {done - fitted:8.1f}    noise "
                f"{model.noise:g} scale {model.patch_scale or 1.0:.2f}",
                flush=True,
            )
            if options.coverage:
                print(coverage(model, test, truth, patch), flush=True)


if __name__ == "__main__":
    main()
