"""Damaged lines within a day of irradiance: what ends as a number that nobody flagged, layer by
layer.

    python bench/damaged_series.py [--hours 160] [--turns 20] [--seed 1] [--only NAME]

First table: readings of undamaged series that the spike guard flags, by sky and step. Second table:
lines of undamaged readings are damaged one in a hundred, each once; how many then read as another
number by the profile alone, how many the driver lets through, and how many of those quality control
leaves without a flag. The driver asks the SPN1 again. Of what talks by itself it knows the form of
sixty lines before, and of a line a second it takes the median of the newest three since the last
reading; right is then what is between the three undamaged ones. Of these further answers and
lines one in ten is damaged too. Skies are made of clouds whose
lengths follow a power law (exponent -1.66, as clouds' chords do), blown over the place at 5 to 20
m/s, their shadows' edges blurred by the sun's disc and their own softness.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from datetime import UTC, datetime
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np
from fuzz_parsers import FIXED, nmea, with_crc16
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from fieldlum.core.errors import FieldlumError
from fieldlum.devices import ascii_lines, spn1
from fieldlum.devices.ascii_lines import LineForm
from fieldlum.pair import irradiance

Array = NDArray[np.float64]
ALTITUDE_DEG, TOP_WM2 = 50.0, 1361.0
NOON = datetime(2027, 6, 21, 20, tzinfo=UTC)
# Share of sky under clouds, shortest and longest cloud [m].
SKIES = {
    "clear": (0.0, 1.0, 2.0),
    "small clouds": (0.05, 20.0, 300.0),
    "broken": (0.5, 30.0, 5000.0),
    "fast broken": (0.5, 20.0, 500.0),
    "overcast": (1.0, 1.0, 2.0),
}
FEW_WM2 = (3.0, 20.0)  # the SPN1's own noise; more than a steady sky does


def sky(kind: str, seconds: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Global and diffuse [seconds] W/m2, each second."""
    cover, shortest, longest = SKIES[kind]
    wind = 20.0 if kind == "fast broken" else rng.uniform(5.0, 20.0)
    metres = int(wind * seconds) + 2
    beam_through = np.full(metres, 1.0 if cover < 1.0 else 0.0)
    at = 0.0
    while 0.0 < cover < 1.0 and at < metres:
        cloud, gap = _chord(shortest, longest, rng), _chord(shortest, longest, rng)
        at += gap * (1.0 - cover) / cover
        beam_through[int(at) : int(at + cloud)] = rng.choice([0.0, 0.0, rng.uniform(0.0, 0.6)])
        at += cloud
    edge_m = (
        np.hypot(9.0, 15.0) / 2.0
    )  # a kilometre up the sun's disc is 9 m wide; a cloud's own edge is soft
    beam = gaussian_filter1d(beam_through, edge_m)
    clouds = gaussian_filter1d(1.0 - beam_through, 200.0)
    where = (wind * np.arange(seconds)).astype(int)
    diffuse = 110.0 + 250.0 * clouds[where] * (1.0 - 0.5 * clouds[where])
    total = 620.0 * beam[where] + diffuse
    noise = rng.normal(0.0, 1.0, (2, seconds))
    return np.maximum(total + noise[0], 0.0), np.maximum(diffuse + noise[1], 0.0)


def _chord(shortest: float, longest: float, rng: np.random.Generator) -> float:
    """A length whose frequency falls with its power -1.66."""
    low, high, u = shortest**-0.66, longest**-0.66, rng.random()
    return float((low + u * (high - low)) ** (-1.0 / 0.66))


def checked(t: Array, ghi: Array, dhi: Array | None) -> NDArray[np.int64]:
    """Marks [n] of quality control at a fixed sun."""
    blank = np.full(len(t), np.nan)
    series = irradiance.Series(
        t, ghi, blank if dhi is None else dhi, blank, np.zeros(len(t), np.int64)
    )
    return irradiance.check(series, np.full(len(t), ALTITUDE_DEG), np.full(len(t), TOP_WM2)).marks


# ----------------------------------------------------------------------------------------------
# lines


Reading = tuple[float, float | None]
"""Global and diffuse."""


class Protocol(NamedTuple):
    name: str
    line: Callable[[float, float], bytes]
    read: Callable[[bytes], Reading]  # by the profile alone
    accept: Callable[
        ..., tuple[Reading, list[Reading]]
    ]  # what the driver makes of it; the lines it used, undamaged
    heard: int = 1  # lines between two readings, a second apart


def _values(profile: ascii_lines.AsciiProfile) -> Callable[[bytes], Reading]:
    def read(line: bytes) -> Reading:
        found = ascii_lines.parse_line(profile, line)
        return found["ghi_wm2"], found.get("dhi_wm2")

    return read


def protocols() -> list[Protocol]:
    keys, js, crc = (
        ascii_lines.load_ascii_profile(n) for n in ("arduino-keys", "arduino-json", "arduino-crc")
    )

    def spn1_read(line: bytes) -> Reading:
        return spn1.parse_reading(line)

    def body(g: float, d: float) -> str:
        return f"$G={g:.1f} D={d:.1f} T=24.1"

    def streams(
        name: str,
        line: Callable[[float, float], bytes],
        profile: ascii_lines.AsciiProfile,
        heard: int,
    ) -> Protocol:
        read = _values(profile)
        often = f"{name}, 1 line/s" if heard > 1 else name
        return Protocol(
            often, line, read, partial(_heard, read, partial(ascii_lines.body_of, profile)), heard
        )

    def json_line(g: float, d: float) -> bytes:
        return json.dumps({"G": round(g, 1), "T": 24.1}).encode() + b"\n"

    return [
        Protocol(
            "SPN1",
            lambda g, d: b"S%6.1f,%6.1f,1\r" % (g, d),
            spn1_read,
            partial(_asked_again, spn1_read),
        ),
        streams("ASCII, CRC-16", lambda g, d: with_crc16(body(g, d)), crc, 1),
        *(streams("ASCII, XOR", lambda g, d: nmea(body(g, d)), keys, heard) for heard in (1, 5)),
        *(streams("ASCII JSON, nothing stated", json_line, js, heard) for heard in (1, 5)),
        *(
            streams("ASCII key=value, all stated", lambda g, d: b"G=%06.1f T=024.1\n" % g, FIXED, n)
            for n in (1, 5)
        ),
    ]


def _asked_again(
    read: Callable[[bytes], Reading],
    came: bytes,
    whole: Sequence[bytes],
    before: bytes,
    form: LineForm,
    rng: np.random.Generator,
) -> tuple[Reading, list[Reading]]:
    """An SPN1, whose first answer is damaged, is asked twice more. Raises FieldlumError, as the
    others do.
    """
    left = [came, *(maybe_damaged(whole[-1], before, rng) for _ in range(2))]
    sample = spn1.agreed_sample(NOON, lambda: left.pop(0))
    return (sample.ghi_wm2 or 0.0, sample.dhi_wm2 or 0.0), [read(whole[-1])]


def _heard(
    read: Callable[[bytes], Reading],
    body_of: Callable[[bytes], str],
    came: bytes,
    whole: Sequence[bytes],
    before: bytes,
    form: LineForm,
    rng: np.random.Generator,
) -> tuple[Reading, list[Reading]]:
    """As `LineInstrument` does with the lines since the last reading, the newest damaged."""
    sound: list[tuple[Reading, Reading]] = []
    lines = [*(maybe_damaged(line, before, rng) for line in whole[:-1]), came]
    for line, true in zip(lines, whole, strict=True):
        with suppress(FieldlumError):
            value = read(line)
            if not deepcopy(form).difference(body_of(line)):
                sound.append((value, read(true)))
    if not sound:
        raise FieldlumError("no sound line")
    used = sound[-3:] if len(sound) >= 3 else sound[-1:]
    return voted([got for got, _ in used]), [true for _, true in used]


def voted(readings: Sequence[Reading]) -> Reading:
    diffuse = [d for _, d in readings if d is not None]
    return median(g for g, _ in readings), median(diffuse) if diffuse else None


def maybe_damaged(line: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """One in ten is."""
    return damage(line, other, rng) if rng.random() < 0.1 else line


def damage(line: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """As bench/fuzz_parsers.py: cut, lost, added, changed, joined, noise; never one of the two
    lines.
    """
    while True:
        at, size = int(rng.integers(len(line))), int(rng.integers(1, 4))
        kind = rng.choice(["cut", "lost", "added", "changed", "joined", "noise"])
        came = {
            "cut": line[:at],
            "lost": line[:at] + line[at + size :],
            "added": line[:at] + rng.bytes(size) + line[at:],
            "changed": line[:at] + rng.bytes(1) + line[at + 1 :],
            "joined": line[: max(at, 1)] + other[int(rng.integers(1, len(line))) :],
            "noise": rng.bytes(int(rng.integers(60))),
        }[str(kind)]
        if came not in (line, other):
            return came


class Tally:
    def __init__(self) -> None:
        self.damaged = self.by_form = self.form_far = self.accepted = self.unflagged = 0
        self.far = [0, 0]


def learned(protocol: Protocol, ghi: Array, dhi: Array) -> LineForm:
    """The form of sixty undamaged lines of the day."""
    form = LineForm()
    for i in np.linspace(0, len(ghi) - 1, 60).astype(int):
        text = protocol.line(float(ghi[i]), float(dhi[i])).decode("ascii").strip()
        if said := form.difference(text.rpartition("*")[0] or text):
            raise AssertionError(f"an undamaged line was refused: {said}")
    return form


def one_series(
    protocol: Protocol, every: int, ghi: Array, dhi: Array, rng: np.random.Generator, tally: Tally
) -> None:
    """ghi, dhi [seconds] W/m2 of a day, read each `every` seconds."""
    ghi, dhi = ghi.round(1), dhi.round(1)
    form = learned(protocol, ghi, dhi)
    rows = np.arange(every, len(ghi), every)
    t = 1.8e9 + rows.astype(float)
    votes = [rows - back for back in range(3 if protocol.heard >= 3 else 1)]
    seen_ghi, seen_dhi = (np.median([value[row] for row in votes], axis=0) for value in (ghi, dhi))
    has_dhi = protocol.read(protocol.line(800.0, 100.0))[1] is not None
    wrong: list[int] = []
    off = np.zeros(len(rows))
    for i in np.flatnonzero(rng.random(len(rows)) < 0.01).tolist():
        now = int(rows[i])
        whole = [
            protocol.line(float(ghi[j]), float(dhi[j]))
            for j in range(now - protocol.heard + 1, now + 1)
        ]
        before = protocol.line(float(ghi[now - every]), float(dhi[now - every]))
        came = damage(whole[-1], before, rng)
        tally.damaged += 1
        value = protocol.read(whole[-1])
        with suppress(FieldlumError):
            first = protocol.read(came)
            tally.by_form += first != value
            tally.form_far += _apart(first, value) > FEW_WM2[0]
        try:
            got, true = protocol.accept(came, whole, before, form, rng)
        except FieldlumError:
            seen_ghi[i] = seen_dhi[i] = np.nan  # no row
            continue
        seen_ghi[i], seen_dhi[i] = got[0], got[1] if got[1] is not None else np.nan
        off[i] = _outside(got, true)
        if off[i] > 0:
            wrong.append(i)
    there = np.isfinite(seen_ghi)
    marks = np.zeros(len(t), np.int64)
    marks[there] = checked(t[there], seen_ghi[there], seen_dhi[there] if has_dhi else None)
    bad = np.array(wrong, int)
    unflagged = bad[(marks[bad] & ~int(irradiance.Mark.GAP)) == 0]
    tally.accepted += len(bad)
    tally.unflagged += len(unflagged)
    tally.far = [
        n + int((off[unflagged] > few).sum()) for n, few in zip(tally.far, FEW_WM2, strict=True)
    ]


def _apart(a: Reading, b: Reading) -> float:
    return max(abs((x or 0.0) - (y or 0.0)) for x, y in zip(a, b, strict=True))


def _outside(reading: Reading, true: Sequence[Reading]) -> float:
    """By how much a reading is outside of the range of the true ones."""
    ranges = [[value or 0.0 for value in values] for values in zip(*true, strict=True)]
    return max(
        max(min(r) - (x or 0.0), (x or 0.0) - max(r), 0.0)
        for x, r in zip(reading, ranges, strict=True)
    )


def main() -> None:
    asked = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    asked.add_argument("--hours", type=int, default=160, help="of each sky")
    asked.add_argument(
        "--turns", type=int, default=20, help="days with damaged lines, of each sky at 5 s"
    )
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", default="", help="protocols whose name holds this text")
    options = asked.parse_args()
    start = time.monotonic()
    rng = np.random.default_rng(options.seed)
    days = {kind: [sky(kind, 8 * 3600, rng) for _ in range(options.hours // 8)] for kind in SKIES}
    print("| sky | step | rows | flagged as spikes | share |\n|---|---|---|---|---|")
    for kind in SKIES:
        for every in (5, 60):
            rows = flagged = 0
            for day in days[kind]:
                ghi, dhi = (value[::every] for value in day)
                marks = checked(1.8e9 + every * np.arange(len(ghi), dtype=float), ghi, dhi)
                rows, flagged = (
                    rows + len(ghi),
                    flagged + int(((marks & irradiance.Mark.SPIKE) != 0).sum()),
                )
            print(
                f"| {kind} | {every} s | {rows} | {flagged} | {100 * flagged / rows:.3f} % |",
                flush=True,
            )
    head = [
        "protocol",
        "step",
        "sky",
        "damaged",
        "another number by the profile",
        f"by over {FEW_WM2[0]:g} W/m2",
        "accepted",
        "unflagged",
    ]
    head += [f"of them off by over {few:g} W/m2" for few in FEW_WM2]
    print(f"\n| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for protocol in (p for p in protocols() if options.only in p.name):
        for every in (5, 60):
            for kinds in (("clear", "overcast"), ("broken", "fast broken", "small clouds")):
                rng, tally = np.random.default_rng([options.seed, every, 7]), Tally()
                for kind in kinds:
                    for turn in range(options.turns * every // 5):
                        one_series(protocol, every, *days[kind][turn % len(days[kind])], rng, tally)
                share = [
                    f"{n} ({100 * n / tally.damaged:.2f} %)"
                    for n in (
                        tally.by_form,
                        tally.form_far,
                        tally.accepted,
                        tally.unflagged,
                        *tally.far,
                    )
                ]
                name = "steady" if kinds[0] == "clear" else "changing"
                print(
                    f"| {protocol.name} | {every} s | {name} | {tally.damaged} | "
                    f"{' | '.join(share)} |",
                    flush=True,
                )
    print(f"\nseed {options.seed}, {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
