"""Two real brackets: a daylit office through a fisheye (18 JPEG), and Memorial Church (16 PNG with
peers' maps).

    python bench/merge_real.py --office FOLDER --memorial FOLDER --out FOLDER [--pooled] [--venv
    FOLDER]

memorial: four peers' maps, two made here by OpenCV, and (--venv: an environment of its own)
colour-hdri's; slope and spread of every pair; each map and the frames. office: the laboratory's own
response, then a response pooled over the bracket with the times held fixed; neighbour residuals,
luminance of five places, vertical illuminance by the tool and by evalglare, a false-colour picture.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import tempfile
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from merge_peers import environment
from numpy.typing import NDArray

from fieldlum.calibrate.response import place_variances
from fieldlum.core.records import Flag
from fieldlum.merge import MergeOptions, files_to_picture
from fieldlum.merge.estimator import merge_signals
from fieldlum.merge.linear_frames import JpegSignal
from fieldlum.merge.shift import turns_between
from fieldlum.optics.camera_curves import dark_floor, fit_response
from fieldlum.optics.exposure import true_times_s
from fieldlum.optics.images import read_radiance_hdr
from fieldlum.optics.profiles import CameraProfile, Response, load_camera_profile
from fieldlum.optics.projection import LensGeometry
from fieldlum.optics.raw import read_jpeg

PLACES = {  # column, row of the 1000 x 1000 equidistant picture
    "ceiling": (450, 150),
    "wall over the screen": (480, 330),
    "computer screen": (500, 480),
    "desk left of the keyboard": (339, 888),
    "sky through the window": (919, 385),
}

COLOUR_HDRI = """
import sys, json
import numpy as np, cv2
from colour_hdri import Image, ImageStack, Metadata
from colour_hdri import camera_response_functions_Debevec1997, image_stack_to_HDRI
*files, out = sys.argv[1:]
stack = ImageStack()
for file, seconds in zip(files, json.load(sys.stdin)):
    codes = cv2.cvtColor(cv2.imread(file), cv2.COLOR_BGR2RGB)
    stack.append(Image(file, codes / 255.0, Metadata(8.0, seconds, 100.0)))
response = camera_response_functions_Debevec1997(stack)
np.save(out, image_stack_to_HDRI(stack, camera_response_functions=response))
"""


def sampled(
    files: list[Path], profile: CameraProfile, places: int = 40_000
) -> tuple[np.ndarray, ...]:
    """Means and spreads of 5 x 5 pixels at random places of the circle, [places, frames, 3], and
    the times.
    """
    import cv2

    rng = np.random.default_rng(0)
    lens = profile.lens[0]
    radius, turn = (
        0.94 * lens.radius_px * np.sqrt(rng.random(places)),
        2 * np.pi * rng.random(places),
    )
    x = (lens.centre_px[0] + radius * np.cos(turn)).astype(int)
    y = (lens.centre_px[1] + radius * np.sin(turn)).astype(int)
    means, spreads, times = [], [], []
    for path in files:
        frame = read_jpeg(path)
        codes = frame.codes.astype(np.float32)
        mean = cv2.blur(codes, (5, 5))
        square = cv2.blur(codes * codes, (5, 5))
        means.append(mean[y, x])
        spreads.append(np.sqrt(np.maximum(square[y, x] - means[-1] ** 2, 0)))
        times.append(true_times_s(frame.exposure.shutter_s))
    return np.stack(means, 1), np.stack(spreads, 1), np.array(times)


PLACES_A_STEP = 150


def pick_places(
    means: NDArray[np.floating],
    spreads: NDArray[np.floating],
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Choose places for `fit_response`, equally many for each step of a bracket.

    Without this, many dark places would outweigh the few bright ones. means, spreads : [places,
    frames], mean and spread of the codes of a small neighbourhood, most exposed frame first; only
    flat neighbourhoods are used.
    """
    chosen = []
    for j in range(means.shape[1] - 1):
        longer, shorter = means[:, j], means[:, j + 1]
        flat = (spreads[:, j] < 4) & (spreads[:, j + 1] < 4)
        good = np.flatnonzero(
            flat & (longer > 27) & (longer < 245) & (shorter > 12) & (shorter < 235)
        )
        count = min(PLACES_A_STEP, good.size)
        chosen.append(rng.choice(good, count, replace=False) if good.size else good)
    return np.unique(np.concatenate(chosen)) if chosen else np.empty(0, np.intp)


def pooled(files: list[Path], profile: CameraProfile) -> CameraProfile:
    """The profile with a response from this bracket itself, times fixed."""
    means, spreads, times = sampled(files, profile)
    order = np.argsort(-times)
    means, spreads, log_t = means[:, order], spreads[:, order], np.log(times[order])
    tables = []
    for c in range(3):
        at = pick_places(means[..., c], spreads[..., c], np.random.default_rng(1))
        table, rms = fit_response(np.round(means[at][..., c]).astype(np.uint8), log_t)
        print(
            f"pooled response, colour {'RGB'[c]}: {at.size} places, rms residual {100 * rms:.1f} "
            f"% of z"
        )
        tables.append(tuple(table.tolist()))
    own = profile.response
    return replace(profile, response=Response("table", *tables, own.low_code, own.high_code, 0.015))


def evalglare_ev(picture: Path) -> float:
    """Vertical illuminance by pyradiance's evalglare. [lx]"""
    import pyradiance

    program = Path(pyradiance.__file__).parent / "bin" / "evalglare"
    said = subprocess.run(
        [str(program), "-V", str(picture)], capture_output=True, text=True, check=False
    )
    numbers = re.findall(r"[-+0-9.eE]+", said.stdout)
    if not numbers:
        raise RuntimeError(f"evalglare: {said.stderr.strip()}")
    return float(numbers[0])


def office(folder: Path, out: Path, use_pooled: bool) -> None:
    files = sorted(folder.glob("IMG_*.JPG"))
    profile = load_camera_profile("canon-5d2-8mm-f5.6")
    name = "pooled" if use_pooled else "laboratory"
    if use_pooled:
        profile = pooled(files, profile)
    picture = out / f"office-{name}.hdr"
    result, facts = files_to_picture(files, profile, picture, MergeOptions(1000, "fisheye"))
    print(
        f"\noffice, {name} response: {result.verdict}\n\n| from | to | residual % | pixels "
        f"|\n|---|---|---|---|"
    )
    frames = result.quality["frames"]
    for n in result.quality["neighbours"]:
        shown = (frames[n[k]]["exposure"].split()[0] for k in ("long", "short"))
        print("| {} s | {} s |".format(*shown), f"{n['residual_percent']:+.2f} | {n['pixels']} |")
    panorama = result.panorama
    assert panorama.u_cdm2 is not None and panorama.flags is not None
    print("\n| place | cd/m2 | u (k = 1) % |\n|---|---|---|")
    for place, (x, y) in PLACES.items():
        spot = np.s_[y - 3 : y + 4, x - 3 : x + 4]
        mean = float(panorama.luminance_cdm2[spot].mean())
        print(f"| {place} | {mean:.4g} | {100 * float(panorama.u_cdm2[spot].mean()) / mean:.1f} |")
    tool, reference = facts["vertical_illuminance_lx"], evalglare_ev(picture)
    turned = [m for m in result.quality["shifts"] if m["u_px"] < 0.35]
    most = max(m["shift_px"] for m in turned)
    print(
        f"\n{len(turned)} of {len(frames) - 1} pairs tell the camera's turn to 0.35 px: at most "
        f"{most:.2f} px"
    )
    print(
        f"\nvertical illuminance: {tool:.1f} lx, evalglare {reference:.1f} lx, "
        f"{100 * (tool / reference - 1):+.2f} %"
    )
    for flag in (Flag.CLIPPED_HIGH, Flag.BLOOM, Flag.MOTION, Flag.BELOW_NOISE):
        print(
            f"{flag.name}: {100 * np.mean((panorama.flags & flag) > 0):.2f} % of the picture's "
            f"pixels"
        )
    _false_colour(
        panorama.luminance_cdm2,
        (panorama.flags & Flag.OUTSIDE_LENS) == 0,
        out / f"office-{name}.png",
    )


def _false_colour(luminance: np.ndarray, seen: np.ndarray, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    figure, axes = plt.subplots(figsize=(6.4, 5.4), layout="constrained")
    drawn = axes.imshow(np.where(seen, luminance, np.nan), norm=LogNorm(1, 1e4), cmap="turbo")
    for place, (x, y) in PLACES.items():
        axes.plot(x, y, "o", mfc="none", mec="white", ms=7)
        left = x > 700
        axes.annotate(
            place,
            (x - 14 if left else x + 14, y),
            color="white",
            fontsize=7,
            va="center",
            ha="right" if left else "left",
        )
    axes.set_axis_off()
    figure.colorbar(drawn, label="luminance in cd/m²", shrink=0.85)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def memorial(folder: Path, peers: Path | None) -> None:
    """Log-domain agreement with the peers' maps after one scale factor, and of each map with the
    frames themselves.
    """
    import cv2

    files = sorted(folder.glob("memorial*.png"))
    codes = [cv2.cvtColor(cv2.imread(str(f)), cv2.COLOR_BGR2RGB) for f in files]
    times = 2.0 ** (5 - np.arange(len(files)))
    smooth = [cv2.blur(c.astype(np.float32), (5, 5)) for c in codes]
    square = [cv2.blur(c.astype(np.float32) ** 2, (5, 5)) for c in codes]
    rough = [np.sqrt(np.maximum(s - m * m, 0)) for s, m in zip(square, smooth, strict=True)]
    inside = np.s_[40:-40, 20:-20]  # the pictures have a blue border
    stack, spread = (
        np.stack([a[inside] for a in x], axis=2).reshape(-1, len(files), 3) for x in (smooth, rough)
    )
    rng = np.random.default_rng(0)
    tables, floors = [], []
    for c in range(3):
        at = pick_places(stack[..., c], spread[..., c], rng)
        places = np.round(stack[at][..., c]).astype(np.uint8)
        table, rms = fit_response(places, np.log(times))
        blind = fit_response(places, np.log(times), low=3)[1]
        floors.append(dark_floor(places, np.log(times)))
        half = len(files) // 2
        parts = [
            fit_response(places[:, part], np.log(times[part]))[1]
            for part in (np.s_[:half], np.s_[half:])
        ]
        print(
            f"response {'RGB'[c]}: codes from {floors[-1]} on, rms {100 * rms:.1f} %; from 3 on "
            f"{100 * blind:.1f} %;",
            end="",
        )
        print(f" the long half alone {100 * parts[0]:.1f} %, the short half {100 * parts[1]:.1f} %")
        said = [f"{100 * _held_out(places, np.log(times), low):.1f} %" for low in (floors[-1], 3)]
        off = _frames_off(table, places, np.log(times))
        print(
            f"  held-out places {said[0]}, from 3 on {said[1]}; frames off by {off.min():+.1f} to "
            f"{off.max():+.1f} %"
        )
        tables.append(table)
    response = np.stack(tables, axis=1).astype(np.float32)
    signals = [
        JpegSignal(c, response, np.full(3, t, np.float32), 27, 228, i == 0, i == len(files) - 1)
        for i, (c, t) in enumerate(zip(codes, times, strict=True))
    ]
    merged = merge_signals(signals, codes[0].shape, u_ratio=0.05)
    _print_shifts(signals, times)
    maps = {"fieldlum": merged.value_cdm2}
    for name in ("debevec", "robertson"):
        maps[f"qhan1028 {name}"] = read_radiance_hdr(folder / f"peer_{name}_radiance.hdr")[0].rgb
    maps["OpenCV debevec"] = _opencv(codes, times, "Debevec")
    maps["OpenCV robertson"] = _opencv(codes, times, "Robertson")
    if peers:
        maps["colour-hdri debevec"] = _colour_hdri(peers, files, times)
    no_black = [np.maximum(c.astype(np.int16) - floors, 0).astype(np.uint8) for c in codes]
    maps["OpenCV debevec, black off"] = _opencv(no_black, times, "Debevec")
    logs = {
        name: np.log(np.maximum(light[..., 1].astype(float), 1e-9))[inside].ravel()
        for name, light in maps.items()
    }
    whole = [
        light
        for name, light in logs.items()
        if not name.startswith("colour-hdri") and "off" not in name
    ]
    middle = np.median([light - np.median(light) for light in whole], axis=0)
    middle = (middle > np.quantile(middle, 0.1)) & (middle < np.quantile(middle, 0.9))
    print(
        "\n| pair | log slope, middle 80 % | spread of the ratio there, 5 to 95 % |\n|---|---|---|"
    )
    for a, b in combinations(logs, 2):
        ratio = logs[a][middle] - logs[b][middle]
        low, high = 100 * (np.exp(np.quantile(ratio - np.median(ratio), [0.05, 0.95])) - 1)
        print(
            f"| {a} / {b} | {np.std(logs[a][middle]) / np.std(logs[b][middle]):.3f} | {low:+.1f} "
            f"to {high:+.1f} % |"
        )
    print("\n| map | rms of ln(L t) at equal code, codes 27 to 228 |\n|---|---|")
    green = np.stack([c[inside][..., 1] for c in codes]).reshape(len(codes), -1)[:, ::7].astype(int)
    for name, light in logs.items():
        print(f"| {name} | {_scatter(green, light[::7] + np.log(times)[:, None]):.3f} |")


def _held_out(places: np.ndarray, log_t: np.ndarray, low: int) -> float:
    """Rms of ln(z / exposure) about each place's mean, codes 27 to 228, of every fourth of the
    places in turn.
    """
    fold, errors = np.arange(len(places)) % 4, []
    for k in range(4):
        table, _ = fit_response(places[fold != k], log_t, low=low)
        errors.append(place_variances(table, places[fold == k], log_t))
    return float(np.sqrt(np.nanmean(np.concatenate(errors))))


def _frames_off(table: np.ndarray, places: np.ndarray, log_t: np.ndarray) -> np.ndarray:
    """Median of ln(z / exposure) against each place's mean, frame by frame with twenty places or
    more. [%]
    """
    ok = (places >= 27) & (places <= 228)
    light = np.where(ok, np.log(np.maximum(table[places], 1e-9)) - log_t, np.nan)[ok.any(axis=1)]
    apart = light - np.nanmean(light, axis=1, keepdims=True)
    enough = np.isfinite(apart).sum(axis=0) >= 20
    return 100 * np.nanmedian(apart[:, enough], axis=0)


def _opencv(codes: list[np.ndarray], times: np.ndarray, name: str) -> np.ndarray:
    """OpenCV's map with the response that it finds itself, as it comes; colours R, G, B."""
    import cv2

    frames, exposures = (
        [np.ascontiguousarray(c[..., ::-1]) for c in codes],
        times.astype(np.float32),
    )
    response = getattr(cv2, f"createCalibrate{name}")().process(frames, exposures)
    return getattr(cv2, f"createMerge{name}")().process(frames, exposures, response)[..., ::-1]


def _colour_hdri(peers: Path, files: list[Path], times: np.ndarray) -> np.ndarray:
    """colour-hdri's map with the response that it finds itself, as it comes, from its own
    environment.
    """
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "map.npy"
        command = [
            str(environment(peers)),
            "-W",
            "ignore",
            "-c",
            COLOUR_HDRI,
            *map(str, files),
            str(out),
        ]
        subprocess.run(command, input=json.dumps(times.tolist()), text=True, check=True)
        return np.load(out)


def _print_shifts(signals: list[JpegSignal], times: np.ndarray) -> None:
    """Between neighbours, as if through a lens of 60 degrees: its pixels at the axis are what is
    printed.
    """
    h, w = signals[0].codes.shape[:2]
    lens = LensGeometry((w / 2, h / 2), float(np.hypot(h, w) / 2), 60.0, "equidistant")
    for m in turns_between(
        [s.reduced_frame() for s in signals], [lens], [f"{t:g} s" for t in times]
    ):
        print(f"{m.long} to {m.short}: shifted by {m.shift_px:.2f} px, u {m.u_px:.2f}")


def _scatter(codes: np.ndarray, log_exposure: np.ndarray) -> float:
    """How far a map is from one response: a true map puts equal codes at equal exposure in every
    frame.
    """
    left = []
    for code in range(27, 229):
        values = log_exposure[codes == code]
        if values.size > 20:
            left.append((values - np.median(values)) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(left))))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--office", type=Path)
    parser.add_argument("--memorial", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--venv", type=Path, help="folder of the peers' environment: colour-hdri next to the others"
    )
    parser.add_argument(
        "--pooled", action="store_true", help="fit the response to the bracket itself"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.office:
        office(options.office, options.out, options.pooled)
    if options.memorial:
        memorial(options.memorial, options.venv)


if __name__ == "__main__":
    main()
