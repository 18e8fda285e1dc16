"""Single pictures on their own pixels against evalglare, on fisheyes that Radiance renders.

Usage: python bench/glare_single.py [--count 200] [--size 400] [--seed 1] [--testimage FILE]

Each picture is a box room with one window, a desk and a sun at a random place; view direction and
mapping are random. Strata by the view: -vta (sun in view, low light under 300 lx, other), -vth,
-vts, and crops (-vta of 100 to 160 degrees). Both sides read the same file. --testimage:
evalglare's own test picture (NREL/Radiance, resources/evalglare/testimage.hdr), whose band of 0.4
rad is compared with the figures of its official test (`-L 400 500 .6 1.2 -B .4 -b 2500 -d`).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fieldlum.optics.images import radiance_program
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.pictures import (
    FLAGS,
    picture_centres,
    picture_rays,
    picture_views,
    read_picture,
    reference_glare_of_file,
    reference_version,
)

# Official answer of evalglare's test (src/cmake_tests/test_evalglare.cmake of NREL/Radiance
# @2fcca99): omega, mean, median, standard deviation, 75 %, 95 %, least, most.
OFFICIAL_BAND = (
    2.423399,
    2353.496003,
    1339.703125,
    2218.441248,
    3993.937463,
    5750.375098,
    68.348633,
    37142.499489,
)
ROOM = """
void plastic wall 0 0 5 {wall} {wall} {wall} 0 0
void plastic floor 0 0 5 .25 .2 .15 0 0
void glow sky 0 0 4 {sky} {sky} {sky} 0
void light sun 0 0 3 {sun} {sun} {sun}
sky source dome 0 0 4 0 0 1 180
sun source disc 0 0 4 {sx} {sy} {sz} .533
floor polygon ground 0 0 12 0 0 0 5 0 0 5 6 0 0 6 0
wall polygon ceiling 0 0 12 0 0 3 0 6 3 5 6 3 5 0 3
wall polygon left 0 0 12 0 0 0 0 6 0 0 6 3 0 0 3
wall polygon right 0 0 12 5 0 0 5 0 3 5 6 3 5 6 0
wall polygon back 0 0 12 0 6 0 5 6 0 5 6 3 0 6 3
wall polygon below 0 0 12 0 0 0 0 0 1 5 0 1 5 0 0
wall polygon above 0 0 12 0 0 2.6 0 0 3 5 0 3 5 0 2.6
wall polygon west 0 0 12 0 0 1 0 0 2.6 .8 0 2.6 .8 0 1
wall polygon east 0 0 12 4.2 0 1 4.2 0 2.6 5 0 2.6 5 0 1
"""


def radiance(*command: str, stdin: bytes = b"") -> bytes:
    from pyradiance.anci import BINPATH

    environment = {**os.environ, "RAYPATH": str(Path(BINPATH).parent / "lib")}
    return subprocess.run(
        [radiance_program(command[0]), *command[1:]],
        input=stdin,
        capture_output=True,
        check=True,
        env=environment,
    ).stdout


def render(folder: Path, rng: np.random.Generator, size: int, number: int) -> tuple[Path, str]:
    """Write one picture; return it and its stratum."""
    stratum = ("vta", "vta", "vta low", "vth", "vts", "crop")[number % 6]
    sunny = stratum != "vta low" and rng.random() < 0.7
    azimuth, altitude = rng.uniform(-0.7, 0.7), rng.uniform(0.15, 0.7)
    light = 10 ** rng.uniform(-1.5, -0.3) if stratum == "vta low" else 10 ** rng.uniform(0.5, 2.0)
    text = ROOM.format(
        wall=f"{rng.uniform(0.3, 0.8):.3f}",
        sky=f"{light:.4f}",
        sun=f"{10 ** rng.uniform(4.0, 6.7) if sunny else 1e-3:.4g}",
        sx=np.cos(altitude) * np.sin(azimuth),
        sy=-np.cos(altitude) * np.cos(azimuth),
        sz=np.sin(altitude),
    )
    (folder / "a.rad").write_text(text, encoding="ascii")
    (folder / "a.oct").write_bytes(radiance("oconv", str(folder / "a.rad")))
    turn = rng.uniform(-1.2, 1.2)
    kind = {"vth": "h", "vts": "s"}.get(stratum, "a")
    angle = rng.uniform(100, 160) if stratum == "crop" else 180.0
    view = (
        f"-vt{kind} -vp {rng.uniform(1, 4):.2f} {rng.uniform(1, 4):.2f} 1.2 "
        f"-vd {np.sin(turn):.4f} {-np.cos(turn):.4f} 0 -vu 0 0 1 -vh {angle:.1f} -vv {angle:.1f}"
    ).split()
    quality = ["-ps", "1", "-ab", "1", "-ad", "64", "-aa", ".3", "-ar", "16", "-as", "0"]
    path = folder / f"{number}.hdr"
    options = [*view, *quality, "-x", str(size), "-y", str(size), str(folder / "a.oct")]
    path.write_bytes(radiance("rpict", *options))
    return path, stratum


def band(path: Path) -> tuple[float, ...]:
    """evalglare's band: pixels within 0.4 rad of the pixel of their column in the middle row."""
    picture = read_picture(path)
    assert picture.view is not None
    pixels = picture.panorama.luminance_cdm2
    height, width = pixels.shape
    y, x = picture_centres(height, width)
    directions = picture_rays(picture.view, x, y)[0]  # [H, W, 3]
    middle = height - 1 - (height - 1) // 2  # evalglare counts rows from the bottom
    cosine = (directions * directions[middle][None]).sum(axis=-1)
    solid_angle = picture_views(picture.view, height, width).moments[:, 0].reshape(height, width)
    inside = (cosine >= np.cos(0.4)) & (directions[..., 2] >= 0.0)
    omega = np.where(inside, solid_angle, 0.0).astype(float)
    total, values = float(omega.sum(dtype=float)), pixels[inside].astype(float)
    quartiles = [float(np.percentile(values, q)) for q in (75, 95)]
    return (
        total,
        float((pixels * omega).sum()) / total,
        float(np.median(values)),
        float(values.std()),
        *quartiles,
        float(values.min()),
        float(values.max()),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--testimage", type=Path)
    options = parser.parse_args()
    if options.testimage:
        names = ("omega", "mean", "median", "sd", "75 %", "95 %", "least", "most")
        for name, ours, theirs in zip(names, band(options.testimage), OFFICIAL_BAND, strict=True):
            print(f"{name:8s} {ours:14.6f} {theirs:14.6f} {100 * (ours / theirs - 1):+8.3f} %")
    rng = np.random.default_rng(options.seed)
    rows: dict[str, list[tuple[float, ...]]] = {}
    with TemporaryDirectory() as name:
        for number in range(options.count):
            path, stratum = render(Path(name), rng, options.size, number)
            picture = read_picture(path)
            assert picture.view is not None
            pixels = picture.panorama.luminance_cdm2
            views = picture_views(picture.view, *pixels.shape)
            ours = {key: v.item() for key, v in glare_directions(pixels[None], views).items()}
            theirs = reference_glare_of_file(path)
            if stratum == "vta" and pixels.max() > 1e6:
                stratum = "vta sun"
            rows.setdefault(stratum, []).append(
                (
                    ours["ev_lx"] / theirs.ev_lx - 1.0,
                    ours["dgp"] - theirs.dgp,
                    ours["ugr"] - theirs.ugr if theirs.sources and theirs.ugr > 0 else np.nan,
                    theirs.ev_lx,
                )
            )
            path.unlink()
            print(f"\r{number + 1} of {options.count}", end="", file=sys.stderr)
    print(f"\n{reference_version()}, {' '.join(FLAGS)}, {options.size} px, seed {options.seed}")
    print("| stratum | n | Ev, lx | Ev mean, % | Ev largest, % | DGP mean | DGP largest | UGR |")
    print("|---|---|---|---|---|---|---|---|")
    for stratum, values in sorted(rows.items()):
        ev, dgp, ugr, level = np.array(values).T
        known = np.abs(ugr[np.isfinite(ugr)])
        shown = f"{known.mean():.2f}" if len(known) else "-"
        print(
            f"| {stratum} | {len(values)} | {level.min():.0f} to {level.max():.0f}"
            f" | {100 * np.abs(ev).mean():.3f} | {100 * np.abs(ev).max():.3f}"
            f" | {np.abs(dgp).mean():.4f} | {np.abs(dgp).max():.4f}"
            f" | {shown} |"
        )


if __name__ == "__main__":
    main()
