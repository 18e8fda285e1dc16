"""How far off a small sun comes out because each colour of a mosaic is on some pixels only.

A disc of some pixels, softened by the optics as a Gaussian, falls anywhere between the pixels of
an RGGB mosaic. Each colour's own pixels are summed, each with the area it represents, as the
projection does. Without noise.

    python bench/sun_on_mosaic.py [--places 200]
"""

from __future__ import annotations

import argparse

import numpy as np

from fieldlum.merge.sun_and_sky import mosaic_u_rel

SHARES = np.array([0.405, 0.543, 0.052])  # of R, G, B in the luminance
FINE = 16  # points along a pixel
WIDE_PX, SPREAD_PX = (0.7, 1.3, 2.0, 3.0, 5.0, 8.0, 16.0), (0.0, 0.5, 0.8, 1.2)


def luminances(
    wide_px: float, spread_px: float, places: int, rng: np.random.Generator
) -> np.ndarray:
    """Of a disc of luminance 1 at some places."""
    import cv2

    size = 2 * int(wide_px / 2 + 4 * spread_px + 4)
    at = (np.arange(size * FINE) + 0.5) / FINE
    found = np.empty(places)
    for i in range(places):
        x, y = size / 2 + rng.uniform(-1, 1, 2)
        disc = (np.hypot(at - x, at[:, None] - y) <= wide_px / 2).astype(np.float32)
        seen = cv2.GaussianBlur(disc, (0, 0), spread_px * FINE) if spread_px else disc
        pixels = seen.reshape(size, FINE, size, FINE).sum(axis=(1, 3)) / disc.sum()
        red, blue = pixels[::2, ::2].sum(), pixels[1::2, 1::2].sum()
        green = pixels[::2, 1::2].sum() + pixels[1::2, ::2].sum()
        found[i] = SHARES @ (4 * red, 2 * green, 4 * blue)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=200)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    print("| disc, px | " + " | ".join(f"sigma {s:g} px" for s in SPREAD_PX) + " | stated |")
    print("|---" * (len(SPREAD_PX) + 2) + "|")
    for wide in WIDE_PX:
        off = [luminances(wide, spread, options.places, rng) - 1 for spread in SPREAD_PX]
        cells = [
            f"{100 * np.sqrt(np.mean(e**2)):.1f} ({100 * e.mean():+.1f}, "
            f"{100 * np.abs(e).max():.1f})"
            for e in off
        ]
        print(
            f"| {wide:g} | " + " | ".join(cells) + f" | {100 * mosaic_u_rel(wide):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
