"""How well neighbouring frames of a JPEG bracket agree after `calibrate response`, pair by pair.

    python bench/bracket_steps.py FOLDER [--longest-s 8 --shortest-s 0.0167]

FOLDER holds one bracket of a still scene, such as data/101 of github.com/MercuryYen/HDR-Imaging
(a phone, 16 frames). "places" are flat 3 x 3 blocks that both frames hold; the error is the median
over them of the light ratio against the ratio of the times, with its standard error.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fieldlum.calibrate import response
from fieldlum.optics.camera_curves import response_table
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens
from fieldlum.optics.raw import read_jpeg

FEWEST = 20  # places in a pair


def profile_of(path: Path) -> tuple[CameraProfile, float]:
    """A profile that takes the complete picture, and the frame's time."""
    frame = read_jpeg(path)
    height, width = frame.codes.shape[:2]
    exposure = frame.exposure
    lens = Lens((width / 2, height / 2), float(np.hypot(width, height)) / 2, 100.0)
    body = CameraBody("bracket", "jpeg", width, height, model=frame.model)
    return CameraProfile(body, (lens,), Bracket(exposure.f_number, exposure.iso, (1.0,))), (
        exposure.shutter_s
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--longest-s", type=float, default=8.0)
    parser.add_argument("--shortest-s", type=float, default=1 / 60)
    options = parser.parse_args()
    frames = sorted(p for p in options.folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
    timed = {path: profile_of(path) for path in frames}
    low, high = 0.97 * options.shortest_s, 1.03 * options.longest_s
    used = [path for path, (_, seconds) in timed.items() if low <= seconds <= high]
    places = response.sample([used], timed[used[0]][0], np.random.default_rng(1))
    found = response.fit(places)
    print(f"{places.law}\n{found.choice.line}\n")
    print("| step, s | places | red, % | green, % | blue, % |\n|---|---|---|---|---|")
    curves = found.response.red, found.response.green, found.response.blue
    tables = [response_table(found.response.kind, curve) for curve in curves]
    iso = timed[used[0]][0].bracket.iso
    for k, step in enumerate(np.diff(places.log_exposure)):
        cells, counts = [], []
        for colour, table in enumerate(tables):
            a, b = places.codes[:, k, colour], places.codes[:, k + 1, colour]
            held = (a >= found.response.low_code) & (b >= a) & (b <= found.response.high_code)
            counts.append(int(held.sum()))
            if counts[-1] < FEWEST:
                cells.append("-")
                continue
            off = 100.0 * (np.log(table[b[held]] / table[a[held]]) - step)
            cells.append(f"{np.median(off):+.1f} ± {off.std() / np.sqrt(len(off)):.1f}")
        times = np.exp(places.log_exposure[k : k + 2]) / iso
        print(f"| {times[0]:.4g} to {times[1]:.4g} | {min(counts)} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
