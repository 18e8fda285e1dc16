"""Time and memory of merging 9 frames of 24 megapixels: accumulated luminance, a 1024 x 512
panorama, two workers.

python bench/merge_speed.py [--frames 9] [--jpeg] [--workers] [--folder DIR]
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.records import Exposure
from fieldlum.merge import MergeOptions, merge_sensor, merge_shots
from fieldlum.merge.shots import shots_of_files, sorted_shots
from fieldlum.optics.camera_curves import response_table
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Colour,
    Lens,
    Response,
    Sensor,
)
from fieldlum.optics.raw.writing import write_dng, write_jpeg

WIDTH, HEIGHT = 6000, 4000
BLACK, FULL, WHITE, GAIN, READ_E = 512.0, 15000.0, 16383.0, 4.0, 6.0


def profile(frames: int, whole_sensor: bool) -> CameraProfile:
    """A dual fisheye of 24 MP; whole_sensor: one circle around the sensor, so that every pixel
    is merged.
    """
    if whole_sensor:
        lenses = (Lens((WIDTH / 2, HEIGHT / 2), 3610.0, 186.0),)
    else:
        lenses = tuple(
            Lens((1500.0 + 3000 * i, 2000.0), 1490.0, 190.0, azimuth_deg=180.0 * i)
            for i in range(2)
        )
    times = tuple(2.0 ** (2 - 2 * k) for k in range(frames))
    return CameraProfile(
        CameraBody("bench", "raw", WIDTH, HEIGHT),
        lenses,
        Bracket(5.6, 100.0, times),
        Sensor("RGGB", (BLACK,) * 4, (FULL,) * 4, WHITE, GAIN, READ_E, 100.0),
        colour=Colour((0.25, 0.7, 0.05)),
    )


def scene() -> np.ndarray:
    """14 stops, [h, w]."""
    x, y = np.meshgrid(
        np.linspace(0, 1, WIDTH, dtype=np.float32), np.linspace(0, 1, HEIGHT, dtype=np.float32)
    )
    return np.exp(9.5 * (x + 0.3 * np.sin(9 * y)) - 1.5)


def make_jpegs(folder: Path, times: tuple[float, ...]) -> list[Path]:
    """The same scene as a camera's own pictures: grey, with a code of noise."""
    rng, light, paths = np.random.default_rng(2), scene(), []
    for number, t in enumerate(times):
        codes = np.interp(
            light * np.float32(2.0 * t / (WHITE - BLACK)), response_table("srgb"), np.arange(256.0)
        )
        noisy = (
            np.rint(codes + rng.standard_normal(light.shape, dtype=np.float32))
            .clip(0, 255)
            .astype(np.uint8)
        )
        paths.append(folder / f"frame{number}.jpg")
        write_jpeg(paths[-1], np.repeat(noisy[..., None], 3, axis=2), Exposure(t, 5.6, 100.0))
    return paths


def make_frames(folder: Path, times: tuple[float, ...]) -> list[Path]:
    """The scene with shot and read noise (approximated by normal deviates, for speed)."""
    rng, light, paths = np.random.default_rng(1), scene(), []
    for number, t in enumerate(times):
        signal = light * np.float32(2.0 * t)
        noise = rng.standard_normal(signal.shape, dtype=np.float32) * np.sqrt(
            signal / GAIN + (READ_E / GAIN) ** 2
        )
        counts = np.clip(np.round(signal + noise + BLACK), 0, FULL).astype(np.uint16)
        path = folder / f"frame{number}.dng"
        write_dng(path, counts, Exposure(t, 5.6, 100.0), black_dn=(BLACK,) * 4, white_dn=WHITE)
        paths.append(path)
    return paths


def accumulate(files: list[Path], p: CameraProfile) -> float:
    started = time.process_time()
    merge_sensor(sorted_shots(shots_of_files(files), p), p)
    return time.process_time() - started


def panorama(files: list[Path], p: CameraProfile) -> float:
    started = time.process_time()
    merge_shots(shots_of_files(files), p, MergeOptions(height=512), heading_deg=0.0)
    return time.process_time() - started


def _child(files: list[Path], p: CameraProfile, kind: str) -> tuple[list[float], float]:
    """CPU seconds of three runs (the first builds the matrices) and the peak memory of a fresh
    process. [GB]
    """
    work = accumulate if kind == "accumulate" else panorama
    seconds = [work(files, p) for _ in range(3)]
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _fresh(files: list[Path], p: CameraProfile, kind: str) -> tuple[list[float], float]:
    import multiprocessing

    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_child, files, p, kind).result()


def _scaling(
    files: list[Path], p: CameraProfile, brackets: int = 6, rounds: int = 4
) -> list[tuple[float, float]]:
    """Wall seconds of several brackets by one and by two workers, a pair for each round. [s]

    Matrices are built before. The two take turns, because a machine's speed drifts over minutes by
    more than the difference that is asked about.
    """
    import multiprocessing

    import cv2

    context = multiprocessing.get_context("spawn")
    once, twice = (
        ProcessPoolExecutor(
            workers, mp_context=context, initializer=cv2.setNumThreads, initargs=(1,)
        )
        for workers in (1, 2)
    )
    walls: list[tuple[float, float]] = []
    with once, twice:
        for pool in (once, twice, twice):
            list(pool.map(panorama, [files] * 2, [p] * 2))
        for _ in range(rounds):
            pair = []
            for pool in (once, twice):
                started = time.perf_counter()
                list(pool.map(panorama, [files] * brackets, [p] * brackets))
                pair.append(time.perf_counter() - started)
            walls.append((pair[0], pair[1]))
    return walls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument(
        "--workers", action="store_true", help="also measure two workers (needs two free cores)"
    )
    parser.add_argument("--folder", type=Path, help="keep the frames here")
    parser.add_argument("--jpeg", action="store_true", help="also nine JPEG of the same size")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        dual = profile(options.frames, whole_sensor=False)
        files = sorted(folder.glob("frame*.dng")) or make_frames(folder, dual.bracket.shutter_s)
        print("| job | CPU s (first run) | CPU s (later) | peak memory GB |\n|---|---|---|---|")
        jobs = [
            (
                "every pixel of the sensor, to accumulated luminance",
                files,
                profile(options.frames, True),
                "accumulate",
            ),
            ("two lenses of 190 degrees, to accumulated luminance", files, dual, "accumulate"),
            ("two lenses, to a 1024 x 512 panorama", files, dual, "panorama"),
        ]
        if options.jpeg:
            pictures = sorted(folder.glob("frame*.jpg")) or make_jpegs(
                folder, dual.bracket.shutter_s
            )
            body = replace(dual.camera, kind="jpeg")
            curve = tuple(float(z) for z in response_table("srgb"))
            response = Response("table", curve, curve, curve)
            other = replace(dual, camera=body, response=response)
            jobs.append(("two lenses, JPEG, to a 1024 x 512 panorama", pictures, other, "panorama"))
        for label, given, p, kind in jobs:
            seconds, peak = _fresh(given, p, kind)
            print(
                f"| {label} | {seconds[0]:.1f} | {min(seconds[1:]):.1f} | {peak:.2f} |", flush=True
            )
        if options.workers:
            print("\n| six brackets: one worker s | two workers s | times as fast |\n|---|---|---|")
            ratios = []
            for one, two in _scaling(files, dual):
                ratios.append(one / two)
                print(f"| {one:.1f} | {two:.1f} | {ratios[-1]:.2f} |")
            print(f"\nmedian of {len(ratios)} rounds: {np.median(ratios):.2f} times as fast")


if __name__ == "__main__":
    main()
