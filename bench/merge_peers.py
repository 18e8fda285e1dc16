"""Compare fieldlum with OpenCV MergeDebevec, HDRutils and colour-hdri on simulated raw frames.

    python bench/merge_peers.py --venv FOLDER [--size 1536x1024]

Makes a virtual environment of its own in FOLDER (once) and installs the peers from the package
index. The scene is a grey gradient of 16 stops; 8 frames 2 EV apart with dial times in EXIF, gain 4
e-/DN, read noise 6 e-, saturation below the tag. Bias and noise are of the green pixels, after one
scale factor for each tool, over bands of luminance.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

PEERS = (
    "hdrutils==1.2",
    "colour-hdri==0.2.6",
    "opencv-python-headless",
    "numpy<2.3",
    "imageio<2.36",
    "rawpy",
)
BLACK, FULL, WHITE, GAIN, READ_E = 512.0, 15000.0, 16383.0, 4.0, 6.0
DIAL_S = (4.0, 1.0, 1 / 4, 1 / 15, 1 / 60, 1 / 250, 1 / 1000, 1 / 4000)
TRUE_S = (4.0, 1.0, 1 / 4, 1 / 16, 1 / 64, 1 / 256, 1 / 1024, 1 / 4096)
F_NUMBER, ISO = 5.6, 100.0

# What each peer runs in its own environment: argv is frames..., out.npy; prints seconds and peak
# memory.
COMMON = """
import sys, json, time, resource
import numpy as np, rawpy
files, out = sys.argv[1:-1], sys.argv[-1]
times = [float(x) for x in %(times)r]
def mosaics():
    return [rawpy.imread(f).raw_image_visible.astype(np.float32) for f in files]
def done(green):
    np.save(out, np.asarray(green, np.float32))
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps({"cpu_s": time.process_time() - t0, "peak_gb": used.ru_maxrss / 1e6}))
"""
SCRIPTS = {
    "OpenCV MergeDebevec": """
import cv2
t0 = time.process_time()
stack = [np.clip((m - %(black)f) / (%(full)f - %(black)f), 0, 1) for m in mosaics()]
codes = [np.repeat(np.round(255 * s).astype(np.uint8)[..., None], 3, axis=2) for s in stack]
response = np.repeat(np.arange(1, 257, dtype=np.float32)[:, None, None] / 256, 3, axis=2)
hdr = cv2.createMergeDebevec().process(codes, np.float32(times), response)
done(hdr[..., 1])
""",
    "HDRutils, on the mosaic": """
import HDRutils
t0 = time.process_time()
gains = [1.0] * len(files)
hdr = HDRutils.merge(files, demosaic_first=False, exp=times, gain=gains, aperture=%(n)f)[0]
done(hdr[..., 1])
""",
    "HDRutils, as it comes": """
import HDRutils
t0 = time.process_time()
hdr = HDRutils.merge(files, exp=times, gain=[1.0] * len(files), aperture=%(n)f)[0]
done(hdr[..., 1])
""",
    "colour-hdri": """
import colour_hdri
from colour_hdri import Image, ImageStack, Metadata, image_stack_to_HDRI
t0 = time.process_time()
stack = ImageStack()
for m, t in zip(mosaics(), times):
    z = np.clip((m - %(black)f) / (%(full)f - %(black)f), 0, 1)
    image = Image("frame", np.repeat(z[..., None], 3, axis=2), Metadata(%(n)f, t, %(iso)f))
    stack.append(image)
done(image_stack_to_HDRI(stack)[..., 1])
""",
}
OWN = "fieldlum"


def make_frames(folder: Path, width: int, height: int) -> tuple[list[Path], np.ndarray]:
    from fieldlum.core.records import Exposure
    from fieldlum.optics.exposure import z_per_cdm2
    from fieldlum.optics.raw.writing import write_dng

    rng = np.random.default_rng(1)
    light = np.repeat(
        np.exp(np.linspace(np.log(0.1), np.log(6500.0), width))[None, :], height, axis=0
    )
    paths = []
    for number, (dial, true) in enumerate(zip(DIAL_S, TRUE_S, strict=True)):
        mean = light * z_per_cdm2(true, F_NUMBER, ISO) * (WHITE - BLACK)
        electrons = rng.poisson(np.minimum(mean * GAIN, 1e7)) + rng.normal(0, READ_E, light.shape)
        counts = np.clip(np.round(electrons / GAIN + BLACK), 0, FULL).astype(np.uint16)
        path = folder / f"frame{number}.dng"
        exposure = Exposure(dial, F_NUMBER, ISO)
        write_dng(
            path, counts, exposure, black_dn=(BLACK,) * 4, white_dn=WHITE, colour_matrix=np.eye(3)
        )
        paths.append(path)
    return paths, light


def own(files: list[Path], width: int, height: int) -> tuple[np.ndarray, float]:
    from fieldlum.merge import merge_sensor
    from fieldlum.merge.shots import shots_of_files, sorted_shots
    from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor

    lens = Lens((width / 2, height / 2), float(width), 180.0)
    profile = CameraProfile(
        CameraBody("bench", "raw", width, height),
        (lens,),
        Bracket(F_NUMBER, ISO, DIAL_S),
        Sensor("RGGB", (BLACK,) * 4, (FULL,) * 4, WHITE, GAIN, READ_E, ISO),
    )
    started = time.process_time()
    merged = merge_sensor(sorted_shots(shots_of_files(files), profile), profile)[0].merged
    return merged.value_cdm2.reshape(height, width), time.process_time() - started


def environment(folder: Path) -> Path:
    """Python of the peers' environment, made when it is not there."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", *PEERS], check=True)
    return python


def peer(python: Path, script: str, files: list[Path], out: Path) -> dict[str, float] | str:
    """Its seconds and memory, or the last line of its error."""
    words = {
        "times": [repr(t) for t in DIAL_S],
        "black": BLACK,
        "full": FULL,
        "n": F_NUMBER,
        "iso": ISO,
    }
    text = (COMMON + script) % words
    said = subprocess.run(
        [str(python), "-W", "ignore", "-c", text, *map(str, files), str(out)],
        capture_output=True,
        text=True,
        timeout=1800,
    )
    if said.returncode:
        return (said.stderr.strip().splitlines() or ["failed"])[-1][:90]
    return json.loads(said.stdout.strip().splitlines()[-1])


def score(picture: np.ndarray, light: np.ndarray) -> str:
    """Largest band bias and the noise in the dark, middle and bright bands, relative to the
    truth. [%]
    """
    green = np.zeros(light.shape, bool)
    green[0::2, 1::2] = green[1::2, 0::2] = True
    green[:, :8] = green[:, -8:] = green[:8] = green[-8:] = False
    ratio = np.where(light > 0, picture / light, np.nan)
    bands = np.geomspace(light.min(), light.max(), 17)
    means, noise = [], []
    for low, high in pairwise(bands):
        r = ratio[green & (light >= low) & (light < high)]
        means.append(np.nanmean(r))
        noise.append(np.nanstd(r))
    means, noise = np.array(means), np.array(noise)
    scale = np.nanmedian(means)
    bias = 100 * (means / scale - 1)
    shown = " | ".join(f"{100 * n / scale:.2f}" for n in (noise[1], noise[8], noise[14]))
    return f"{np.nanmin(bias):+.2f} to {np.nanmax(bias):+.2f} | {shown}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--venv", type=Path, required=True)
    parser.add_argument("--size", default="1536x1024")
    options = parser.parse_args()
    width, height = (int(n) for n in options.size.split("x"))
    python = environment(options.venv)
    print(
        "| tool | bias of bands % | noise, dark % | middle % | bright % | CPU s | peak memory GB |"
    )
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        files, light = make_frames(Path(scratch), width, height)
        picture, seconds = own(files, width, height)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"| {OWN} | {score(picture, light)} | {seconds:.1f} | {peak:.2f} |", flush=True)
        for name, script in SCRIPTS.items():
            out = Path(scratch) / "peer.npy"
            used = peer(python, script, files, out)
            if isinstance(used, str):
                print(f"| {name} | {used} | | | | | |", flush=True)
            else:
                result = score(np.load(out), light)
                print(
                    f"| {name} | {result} | {used['cpu_s']:.1f} | {used['peak_gb']:.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
