"""Light outside a real fisheye's image circle: how large its stray light is at least.

    python bench/stray_border.py FRAME... --camera canon-5d2-8mm-f5.6

FRAMES: the JPEG bracket of one fisheye that does not fill the sensor. No light reaches the sensor
beyond the circle except stray light. Printed for each shutter time: its luminance in two rings, in
the scale of the picture, from pixels with codes that have weight.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from fieldlum.merge.shots import shots_of_files
from fieldlum.optics.camera_curves import response_table
from fieldlum.optics.profiles import load_camera_profile

RINGS = ((1.03, 1.08), (1.15, 1.3))  # distance from the centre over the circle's radius
CD_M2_OF_Z = 87.0  # L = k * 87 * N^2 / (t S) * z: see fieldlum.optics.profiles.Scale
LEAST_SHARE = 0.5  # of a ring's pixels that must have weight


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("frames", type=Path, nargs="+")
    parser.add_argument("--camera", required=True)
    given = parser.parse_args()
    profile = load_camera_profile(given.camera)
    lens, response = profile.lens[0], profile.response
    curves = (response.red, response.green, response.blue)
    z_of_code = [response_table(response.kind, curve) for curve in curves]
    print("| shutter time [s] |" + "".join(f" {a:g} to {b:g} radii [cd/m2] |" for a, b in RINGS))
    print("|---|" + "---|" * len(RINGS))
    for shot in shots_of_files(given.frames):
        codes = np.asarray(cv2.imread(str(shot.path)), np.uint8)[:, :, ::-1]  # [h, w, 3]
        height, width = codes.shape[:2]
        pixel = width / profile.camera.width_px
        y, x = np.mgrid[:height, :width] + 0.5
        centre_x, centre_y = (c * pixel for c in lens.centre_px)
        radius = np.hypot(x - centre_x, y - centre_y) / (lens.radius_px * pixel)
        weighted = ((codes >= response.low_code) & (codes <= response.high_code)).all(axis=2)
        rgb = np.stack([z_of_code[c][codes[:, :, c]] for c in range(3)], axis=2)  # [h, w, 3]
        z = rgb @ np.asarray(profile.colour.y_from_rgb)
        e = shot.exposure
        to_cdm2 = profile.scale.k * CD_M2_OF_Z * e.f_number**2 / (e.shutter_s * e.iso)
        cells = []
        for inner, outer in RINGS:
            ring = (radius > inner) & (radius < outer)
            good = ring & weighted
            enough = good.sum() > LEAST_SHARE * ring.sum()
            cells.append(f"{to_cdm2 * z[good].mean():.2f}" if enough else "-")
        print(f"| {e.shutter_s:g} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
