"""Mutated inputs, and sessions with a mutated file: each must give a result or a one-line error.

The readers run in a worker process, so that a crash of a C library or a hang is seen and counted.

Nothing of a session may start a program or touch a file outside its folder (fuzz_sessions.py).

    python bench/fuzz_inputs.py [--cases 2400] [--seed 1] [--kinds files|sessions|all]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import fuzz_sessions
import numpy as np

from fieldlum.core.errors import FieldlumError
from fieldlum.core.records import Exposure, Panorama
from fieldlum.merge import MergeOptions, merge_shots, shots_of_files
from fieldlum.optics.images import (
    read_panorama,
    read_radiance_hdr,
    write_panorama,
    write_radiance_hdr,
)
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    load_camera_profile,
    save_profile,
    shipped,
)
from fieldlum.optics.raw import read_exif, read_jpeg, read_mosaic
from fieldlum.optics.raw.writing import write_dng, write_jpeg
from fieldlum.session.site_toml import load_site

HANG_S = 60.0
TIMES_S = (0.1, 0.01, 0.001)
FILE_KINDS = ("raw", "jpeg", "exr", "hdr", "profile", "site", "exif", "merge")
KINDS = {
    "files": FILE_KINDS,
    "sessions": fuzz_sessions.KINDS,
    "all": (*FILE_KINDS, *fuzz_sessions.KINDS),
}


def camera() -> CameraProfile:
    return CameraProfile(
        CameraBody("fuzz", "raw", 128, 64),
        (Lens((64.0, 32.0), 31.0, 180.0),),
        Bracket(4.0, 100.0, TIMES_S),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )


def make_originals(folder: Path) -> dict[str, list[Path]]:
    """Small sound files of each kind."""
    rng = np.random.default_rng(0)
    raws = []
    for t in TIMES_S:
        path = folder / f"{t:g}.dng"
        counts = np.clip(256 + rng.gamma(2.0, 20000.0 * t, (64, 128)), 0, 4000).astype(np.uint16)
        write_dng(path, counts, Exposure(t, 4.0), black_dn=(256,) * 4, white_dn=4095)
        raws.append(path)
    jpeg = folder / "frame.jpg"
    write_jpeg(jpeg, rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), Exposure(0.01, 5.6))
    light = rng.gamma(1.0, 100.0, (16, 32)).astype(np.float32)
    exr, hdr = folder / "panorama.exr", folder / "panorama.hdr"
    write_panorama(exr, Panorama(light, 180.0, light * 0.02, np.zeros(light.shape, np.uint16)))
    write_radiance_hdr(hdr, light, heading_deg=180.0)
    profile, site = folder / "camera.toml", folder / "site.toml"
    save_profile(profile, camera())
    plans = sorted(shipped("capture_plans").glob("*.toml"))
    fallback = (
        '[site]\nname = "here"\nlatitude_deg = 47.6\nlongitude_deg = -122.3\ntimezone = "UTC"\n'
    )
    site.write_text(plans[0].read_text(encoding="utf-8") if plans else fallback, encoding="utf-8")
    return {
        "raw": raws[:1],
        "jpeg": [jpeg],
        "exr": [exr],
        "hdr": [hdr],
        "profile": [profile, *raws],
        "site": [site],
        "exif": [jpeg, raws[0]],
        "merge": raws,
        **fuzz_sessions.make_originals(folder, profile),
    }


NASTY = (
    b"nan",
    b"inf",
    b"-1.0",
    b"0",
    b"1e999",
    b"-0.0",
    b"1e-30",
    b"99999999999999999999",
    b'"x"',
    b"[]",
    b"true",
)


def reword(data: bytes, rng: np.random.Generator) -> bytes:
    """A text file with one or two of its numbers replaced by what nobody expects."""
    numbers = list(re.finditer(rb"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", data))
    for number in sorted(
        rng.choice(len(numbers), min(2, len(numbers)), replace=False), reverse=True
    ):
        at = numbers[int(number)]
        data = data[: at.start()] + NASTY[int(rng.integers(len(NASTY)))] + data[at.end() :]
    return data


def mutate(data: bytes, head: int, rng: np.random.Generator) -> bytes:
    """Cut, flip, zero, insert, overwrite or remove; half of the time within the first `head`
    bytes.
    """
    body = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if not body:
            break
        reach = min(head, len(body)) if rng.random() < 0.5 else len(body)
        at, length = int(rng.integers(reach)), int(rng.integers(1, 64))
        kind = rng.integers(7)
        if kind == 0:
            del body[at:]
        elif kind == 1:
            body[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            body[at : at + length] = bytes(len(body[at : at + length]))
        elif kind == 3:
            body[at:at] = rng.bytes(length)
        elif kind == 4:
            body[at : at + length] = rng.bytes(len(body[at : at + length]))
        elif kind == 5:
            del body[at : at + length]
        else:
            body[at] = int(rng.choice([0, 1, 127, 128, 255]))
    return bytes(body)


def read(kind: str, path: Path, originals: list[Path]) -> None:
    """What a user's command would do with the file. Raises whatever the tool raises."""
    if kind in fuzz_sessions.KINDS:
        fuzz_sessions.read(kind, path, *originals[1:])
        return
    if kind == "merge":
        result = merge_shots(
            shots_of_files([path, *originals[1:]]),
            camera(),
            MergeOptions(height=8),
            heading_deg=0.0,
        )
        light, u = result.panorama.luminance_cdm2, result.panorama.u_cdm2
        if not (np.isfinite(light).all() and u is not None and np.isfinite(u).all()):
            raise AssertionError("a luminance that is no number, without a word")
        return
    if kind == "profile":  # a profile that loads must also merge, or say why not
        merge_shots(
            shots_of_files(originals[1:]),
            load_camera_profile(path),
            MergeOptions(height=8),
            heading_deg=0.0,
        )
        return
    readers: dict[str, Callable[[Path], object]] = {
        "raw": read_mosaic,
        "jpeg": read_jpeg,
        "exr": read_panorama,
        "hdr": read_radiance_hdr,
        "site": load_site,
        "exif": read_exif,
    }
    readers[kind](path)


def outcome(kind: str, path: Path, originals: list[Path]) -> str:
    try:
        read(kind, path, originals)
        return "result"
    except FieldlumError as error:
        return "one-line error" if "\n" not in str(error) else f"error of several lines: {error!r}"
    except Exception as error:
        return f"DEFECT {type(error).__name__}: {str(error)[:120]}"


def serve(pipe: Connection, originals: dict[str, list[Path]]) -> None:
    """The worker: what C libraries print is not wanted here."""
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    pipe.send("ready")
    while True:
        kind, path = pipe.recv()
        pipe.send(outcome(kind, path, originals[kind]))


class Worker:
    """A process that is started again when it dies or hangs."""

    def __init__(self, originals: dict[str, list[Path]]) -> None:
        self._originals = originals
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other, self._originals), daemon=True)
        self._process.start()
        other.close()
        self._pipe.recv()

    def ask(self, kind: str, path: Path) -> str:
        self._pipe.send((kind, path))
        try:
            if self._pipe.poll(HANG_S * (5 if kind in ("merge", "profile") else 1)):
                return self._pipe.recv()
            said = "HANG"
        except EOFError:
            said = "CRASH"
        self._process.kill()
        self._process.join()
        self._start()
        return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=2400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", choices=sorted(KINDS), default="all")
    parser.add_argument("--keep", type=Path, help="keep the inputs that fail here")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    kinds = KINDS[options.kinds]
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    slowest_s = dict.fromkeys(kinds, 0.0)
    bad = 0
    with tempfile.TemporaryDirectory() as scratch:
        originals = make_originals(Path(scratch))
        worker = Worker(originals)
        for case in range(options.cases):
            kind = kinds[case % len(kinds)]
            source = (
                originals[kind][int(rng.integers(len(originals[kind])))]
                if kind == "exif"
                else originals[kind][0]
            )
            path = Path(scratch) / f"case{source.suffix}"
            head = 1200 if source.suffix in (".dng", ".jpg", ".exr") else 400
            text = kind in ("profile", "site") and rng.random() < 0.7
            data = source.read_bytes()
            if kind in fuzz_sessions.KINDS and rng.random() < 0.8:
                path.write_bytes(fuzz_sessions.mutated(kind, data, originals[kind][2], rng))
            else:
                path.write_bytes(reword(data, rng) if text else mutate(data, head, rng))
            asked_s = time.monotonic()
            said = worker.ask(kind, path)
            slowest_s[kind] = max(slowest_s[kind], time.monotonic() - asked_s)
            counts[kind][said] += 1
            if said not in ("result", "one-line error"):
                bad += 1
                print(f"case {case} ({kind}): {said}", file=sys.stderr, flush=True)
                if options.keep:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    (options.keep / f"{case:05d}-{kind}{source.suffix}").write_bytes(
                        path.read_bytes()
                    )
    print(
        "| input | cases | result | one-line error | defect, crash or hang | slowest s "
        "|\n|---|---|---|---|---|---|"
    )
    for kind in kinds:
        c = counts[kind]
        good, error = c["result"], c["one-line error"]
        print(
            f"| {kind} | {c.total()} | {good} | {error} | {c.total() - good - error} | "
            f"{slowest_s[kind]:.1f} |"
        )
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
