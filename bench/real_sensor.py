"""A real linear sensor under known light: linearity, bias against photons, and coverage of u.

    python bench/real_sensor.py FOLDER

FOLDER is reference set 001 of github.com/EMVA1288/datasets (Basler CCD, 12 bit, 640 x 480),
complete or a part: images/*.png, and EMVA1288_Data.txt with each frame's time [ns] and photons.
Frames are wrapped as DNG. The curve is fitted to every second time and judged on the others;
brackets are merged from single frames and compared, pixel by pixel, with the mean of the flats.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate import sensor as linearity
from fieldlum.core.records import Exposure
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.linear_frames import Crop, RawSignal, Saturation, load_raw
from fieldlum.merge.shots import Shot
from fieldlum.optics.linear_light import curve_u_rel
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor
from fieldlum.optics.raw.writing import write_dng

PLATEAU_DN, WHITE_DN = 4080.0, 4095.0
GAIN_E_PER_DN, READ_NOISE_E = 3.6, 13.0  # photon transfer of the set's own flats
CROP = Crop(0, 0, 480, 640)
NO_PLATEAU = (None, None, None, None)


@dataclass(frozen=True)
class Frame:
    kind: str  # b: light, d: dark
    seconds: float
    photons: float
    path: Path


def read_index(folder: Path) -> list[Frame]:
    frames: list[Frame] = []
    kind, seconds, photons = "", 0.0, 0.0
    for line in (folder / "EMVA1288_Data.txt").read_text(encoding="latin-1").splitlines():
        head = re.match(r"([bd]) ([\d.]+)(?: ([\d.]+))?", line)
        if head:
            kind, seconds, photons = head[1], float(head[2]) * 1e-9, float(head[3] or 0.0)
        elif line.startswith("i "):
            path = folder / "images" / Path(line[2:].replace("\\", "/")).name
            if path.is_file():
                frames.append(Frame(kind, seconds, photons, path))
    return frames


def counts_of(frame: Frame) -> NDArray[np.uint16]:
    picture = cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return np.asarray(picture, np.uint16)


def wrapped(frame: Frame, folder: Path, black: float) -> Path:
    path = folder / f"{frame.path.stem}.dng"
    exposure = Exposure(frame.seconds, 4.0, 100.0)
    write_dng(path, counts_of(frame), exposure, black_dn=(black,) * 4, white_dn=WHITE_DN)
    return path


def profile_of(black: float) -> CameraProfile:
    sensor = Sensor(
        "RGGB", (black,) * 4, (PLATEAU_DN,) * 4, WHITE_DN, GAIN_E_PER_DN, READ_NOISE_E, 100.0
    )
    lens = Lens((320.0, 240.0), 400.0, 60.0)
    body = CameraBody("EMVA1288 set 001", "raw", 640, 480)
    return CameraProfile(body, (lens,), Bracket(4.0, 100.0, (1.0,)), sensor, shutter_law="exact")


def bias_rows(
    light: list[Frame], paths: dict[Path, Path], profile: CameraProfile
) -> dict[float, tuple[float, float, float]]:
    """Of each photon count: share of the full scale, and ln(light / photons) of its frames, mean
    and spread; light is the merged luminance's numerator and denominator of that frame alone.
    """
    out: dict[float, tuple[float, float, float]] = {}
    for photons in sorted({frame.photons for frame in light}):
        ratios, shares = [], []
        for frame in (f for f in light if f.photons == photons):
            signal = signal_of(paths[frame.path], frame, profile)
            counts, full = signal.strip(0, len(signal.counts))
            good = (
                counts < signal.usable_limit
                if full is None
                else ~full & (counts < signal.usable_limit)
            )
            if good.mean() < 0.999:
                continue
            level = float(counts[good].mean())
            shares.append(level / (WHITE_DN - profile.sensor.black_dn[0]))
            ratios.append(np.log(level / float(np.mean(signal.per_cdm2)) / 1.0))
        if ratios:
            out[photons] = float(np.mean(shares)), float(np.mean(ratios)), float(np.ptp(ratios))
    return out


def signal_of(path: Path, frame: Frame, profile: CameraProfile) -> RawSignal:
    return load_raw(
        Shot(path, Exposure(frame.seconds, 4.0, 100.0)),
        profile,
        CROP,
        Saturation({100.0: NO_PLATEAU}),
    )


def coverage(
    light: list[Frame], flats: list[Frame], paths: dict[Path, Path], profile: CameraProfile
) -> tuple[float, float]:
    """Share of pixels of merged brackets whose truth is within 1.96 u, and with the random part
    alone. Truth: each pixel's mean over the flats, on the scale that all frames of the set give.
    """
    flat = merge_of(flats, paths, profile)
    times = sorted({frame.seconds for frame in light})
    hits, random_hits, parts = 0.0, 0.0, 0
    for which in (0, 1):
        bracket = [
            [f for f in light if f.seconds == seconds][which] for seconds in times[::-1][1::3]
        ]
        merged = merge_of(bracket, paths, profile)
        u_flat2 = flat.variance
        error2 = (merged.value_cdm2 - flat.value_cdm2) ** 2
        random2 = merged.variance + u_flat2
        u2 = random2 + (curve_u_rel(profile) * merged.value_cdm2) ** 2
        hits += float((error2 < 1.96**2 * u2).mean())
        random_hits += float((error2 < 1.96**2 * random2).mean())
        parts += 1
    return hits / parts, random_hits / parts


def merge_of(frames: list[Frame], paths: dict[Path, Path], profile: CameraProfile) -> Merged:
    ordered = sorted(frames, key=lambda f: -f.seconds)
    return merge_signals([signal_of(paths[f.path], f, profile) for f in ordered], (240, 2, 640))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    frames = read_index(folder)
    dark = [f for f in frames if f.kind == "d"]
    black = float(np.mean([counts_of(f).mean() for f in dark]))
    levels = [(f.seconds, float(counts_of(f).mean())) for f in dark]
    print(
        f"black {black:.2f} DN; dark frames by time differ by {np.ptp([v for _, v in levels]):.2f}"
    )
    series = [f for f in frames if f.kind == "b" and "_s_" not in f.path.name]
    flats = [f for f in frames if f.kind == "b" and "_s_" in f.path.name]
    with tempfile.TemporaryDirectory() as work:
        paths = {f.path: wrapped(f, Path(work), black) for f in (*series, *flats)}
        plain = profile_of(black)
        times = sorted({f.seconds for f in series})
        fitted = [f for f in series if f.seconds in times[::2]]
        found = linearity.fit(linearity.read_levels([paths[f.path] for f in fitted], plain))
        print(found.choice.line)
        print(
            f"coefficients {found.coefficients}, offset {1e6 * found.offset_s:.2f} +- "
            f"{1e6 * found.u_offset_s:.2f} us, u_rel {100 * found.u_rel:.3f} %\n"
        )
        sensor = replace(
            plain.sensor,
            linearity=found.coefficients,
            linearity_u_rel=found.u_rel,
            exposure_offset_s=found.offset_s,
        )
        profiles = {"as recorded": plain, "corrected": replace(plain, sensor=sensor)}
        rows = {name: bias_rows(series, paths, p) for name, p in profiles.items()}
        print("| share of full scale, % | fitted | as recorded, % | corrected, % |")
        print("|---|---|---|---|")
        used = {f.photons for f in fitted}
        level = {
            name: np.mean([v[1] for k, v in r.items() if v[0] > 0.1]) for name, r in rows.items()
        }
        for photons, (share, _, _) in rows["as recorded"].items():
            cells = [f"{100 * (rows[n][photons][1] - level[n]):+.2f}" for n in rows]
            mark = "yes" if photons in used else "no"
            print(f"| {100 * share:.1f} | {mark} | {' | '.join(cells)} |")
        print(
            "\n| profile | pixels within 1.96 u, % | by the random part alone, % |\n|---|---|---|"
        )
        for name, profile in profiles.items():
            total, random = coverage(series, flats, paths, profile)
            print(f"| {name} | {100 * total:.1f} | {100 * random:.1f} |")


if __name__ == "__main__":
    main()
