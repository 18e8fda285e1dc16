"""Damaged frames of a session: how many does `merge` refuse, and what do the hashes cost?

    python bench/frame_damage.py [--damages 200] [--seed 1] [--rounds 3]

Each damage changes one frame of one bracket of a small session; then the session is merged, and the
frame is restored. First table: by kind of damage, how many brackets were refused by the frame's
name, and how many were merged. Exits with 1 if a bracket with a damaged frame was merged or a
bracket without one was refused. Second table: CPU seconds of merging 9 raw frames of 24 megapixels
to 1024 x 512, with the hashes and without, in turns.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import median

import numpy as np
from merge_speed import make_frames
from merge_speed import profile as large_profile

from fieldlum import merge
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot, slot_id, utc_text
from fieldlum.merge import stage
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor, save_profile
from fieldlum.optics.raw.writing import write_dng
from fieldlum.session import Session, create_session, sha256

TIMES_S, BRACKETS = (0.5, 1 / 16, 1 / 128), 4
START = datetime(2027, 3, 20, 6, 30, tzinfo=UTC)
Random = np.random.Generator


def small_profile() -> CameraProfile:
    return CameraProfile(
        CameraBody("small", "raw", 512, 256),
        (Lens((256.0, 128.0), 127.0, 180.0),),
        Bracket(4.0, 100.0, TIMES_S),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )


def session_of(folder: Path, profile: CameraProfile) -> Session:
    save_profile(folder / "camera.toml", profile)
    setup = SiteFile(Site("bench", 51.5, 0.0), CameraSetup(str(folder / "camera.toml"), 180.0))
    slot = Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))
    return create_session(folder / "session", setup, [slot], {})


def record(folder: Path, t_utc: datetime, frames: list[tuple[str, Exposure]]) -> None:
    """Write the slot's capture.json, with the sha256 of each frame, as `capture` does."""
    rows = [
        {
            "file": name,
            "exposure": {"shutter_s": e.shutter_s, "f_number": e.f_number, "iso": e.iso, "nd": ""},
            "heading_deg": None,
            "t_utc": utc_text(t_utc + timedelta(seconds=number)),
            "sha256": sha256(folder / name),
        }
        for number, (name, e) in enumerate(frames)
    ]
    (folder / "capture.json").write_text(json.dumps({"frames": rows}), encoding="utf-8")


def take(session: Session, number: int) -> None:
    t_utc = START + timedelta(hours=number)
    folder, rng = session.raw / slot_id(t_utc), np.random.default_rng(number)
    folder.mkdir(parents=True)
    exposures = [Exposure(t, 4.0) for t in TIMES_S]
    for i, exposure in enumerate(exposures):
        counts = np.clip(256 + rng.poisson(6000 * exposure.shutter_s, (256, 512)), 0, 4000)
        write_dng(
            folder / f"{i}.dng",
            counts.astype(np.uint16),
            exposure,
            black_dn=(256,) * 4,
            white_dn=4095,
        )
    record(folder, t_utc, [(f"{i}.dng", e) for i, e in enumerate(exposures)])


# ----------------------------------------------------------------------------------------------
# damages: each changes the content of one frame


def one_bit(frame: Path, rng: Random) -> None:
    data = bytearray(frame.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    frame.write_bytes(data)


def bytes_zeroed(frame: Path, rng: Random) -> None:
    """Zero a block of 512 bytes to 64 KiB, as a card does."""
    data = bytearray(frame.read_bytes())
    size = 512 << int(rng.integers(8))
    at = int(rng.integers(max(len(data) - size, 1)))
    if not any(data[at : at + size]):
        at = 0
    data[at : at + size] = bytes(min(size, len(data) - at))
    frame.write_bytes(data)


def bytes_random(frame: Path, rng: Random) -> None:
    data = bytearray(frame.read_bytes())
    size = int(2 ** rng.uniform(0, 16))
    at = int(rng.integers(max(len(data) - size, 1)))
    data[at : at + size] = bytes(b ^ int(rng.integers(1, 256)) for b in data[at : at + size])
    frame.write_bytes(data)


def truncated(frame: Path, rng: Random) -> None:
    data = frame.read_bytes()
    frame.write_bytes(data[: int(rng.integers(len(data)))])


def of_another_bracket(frame: Path, rng: Random) -> None:
    others = [p for p in frame.parent.parent.glob(f"*/{frame.name}") if p != frame]
    shutil.copyfile(others[rng.integers(len(others))], frame)


def exchanged(frame: Path, rng: Random) -> None:
    """Exchange the frame with another one of its bracket."""
    others = [p for p in frame.parent.glob("*.dng") if p != frame]
    other = others[rng.integers(len(others))]
    content = frame.read_bytes()
    shutil.copyfile(other, frame)
    other.write_bytes(content)


DAMAGES: tuple[Callable[[Path, Random], None], ...] = (
    one_bit,
    bytes_zeroed,
    bytes_random,
    truncated,
    of_another_bracket,
    exchanged,
)


def damaged(count: int, seed: int) -> bool:
    """Print the first table; return whether each damaged bracket, and no other, was refused."""
    rng, answers, good = np.random.default_rng(seed), Counter[tuple[str, str]](), True
    with tempfile.TemporaryDirectory() as name:
        session = session_of(Path(name), small_profile())
        for number in range(BRACKETS):
            take(session, number)
        for number in range(count):
            damage = DAMAGES[number % len(DAMAGES)]
            folder = session.raw / slot_id(START + timedelta(hours=int(rng.integers(BRACKETS))))
            copy = shutil.copytree(folder, Path(name) / "copy")
            frame = folder / f"{rng.integers(len(TIMES_S))}.dng"
            damage(frame, rng)
            verdicts = merge.run(session, merge.MergeOptions(height=16), force=number % 2 == 0)
            states = {v.slot: (v.state, v.text) for v in verdicts}
            state, text = states.pop(folder.name)
            refused = state == "failed" and frame.name in text
            answers[damage.__name__, "refused" if refused else "merged"] += 1
            good &= refused and all(other != "failed" for other, _ in states.values())
            shutil.rmtree(folder)
            copy.rename(folder)
    print("| damage | tried | refused by name | merged |\n|---|---|---|---|")
    for damage in DAMAGES:
        kind = damage.__name__
        refused, merged = answers[kind, "refused"], answers[kind, "merged"]
        print(f"| {kind.replace('_', ' ')} | {refused + merged} | {refused} | {merged} |")
    return good


def speed(rounds: int) -> None:
    """Print the second table."""
    profile = large_profile(9, True)
    with tempfile.TemporaryDirectory() as name:
        session = session_of(Path(name), profile)
        folder = session.raw / slot_id(START)
        folder.mkdir(parents=True)
        frames = make_frames(folder, profile.bracket.shutter_s)
        exposures = [Exposure(t, 5.6, 100.0) for t in profile.bracket.shutter_s]
        record(folder, START, [(p.name, e) for p, e in zip(frames, exposures, strict=True)])
        seconds: dict[bool, list[float]] = {True: [], False: []}
        verified = stage.verified
        for number in range(2 * rounds + 1):  # the first one builds the matrices
            hashes = number % 2 == 0
            stage.verified = verified if hashes else list  # type: ignore[assignment]
            started = time.process_time()
            verdict = merge.run(session, merge.MergeOptions(height=512), force=True)[0]
            assert verdict.state == "merged", verdict.text
            if number:
                seconds[hashes].append(time.process_time() - started)
        stage.verified = verified
        size_mb = sum(p.stat().st_size for p in frames) / 1e6
        started = time.process_time()
        for path in frames:
            sha256(path)
        hash_s = time.process_time() - started
    print(f"\n| 9 frames, {size_mb:.0f} MB | CPU seconds: median | all |\n|---|---|---|")
    for hashes, values in seconds.items():
        label = "with hashes" if hashes else "without"
        print(f"| {label} | {median(values):.2f} | {', '.join(f'{s:.2f}' for s in values)} |")
    print(f"| the hashes alone | {hash_s:.2f} | |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--damages", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    good = damaged(asked.damages, asked.seed)
    if asked.rounds:
        speed(asked.rounds)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
