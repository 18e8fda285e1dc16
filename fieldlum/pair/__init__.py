"""Pair every panorama with the irradiance of its own seconds, its sun and its sun patch: pairs.csv.

`interval` is about the light outside, `source` about the sun's strength at the lens, `patches`
about the room; this file is the stage.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from fieldlum import sun
from fieldlum.errors import FieldlumError, InputError, NotEnoughDataError
from fieldlum.images import read_panorama, write_panorama
from fieldlum.light_clock import lit_at_night
from fieldlum.pair.interval import Log, Outside, outside, read_clean
from fieldlum.pair.patches import seen_and_patches
from fieldlum.pair.sun_strength import Seen, complete_sun
from fieldlum.records import (
    Panorama,
    Progress,
    Site,
    SiteFile,
    SunSource,
    parse_utc,
    quiet,
    utc_text,
)
from fieldlum.session import Session, replacing, replacing_path
from fieldlum.sky import direct_normal_illuminance_lx

COLUMNS = (
    "t_utc",
    "panorama",
    "dni_wm2",
    "dhi_wm2",
    "ghi_wm2",
    "source",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "steadiness",
    "sunpatch",
    "sun_in_map",
    "ok",
    "why",
)
POOR_SUN_PERCENT = 5.0  # of a sun's illuminance in the picture, from which its pair says so
NIGHT_MINUTES = 5  # of light with the sun well down, that a lamp may make
_REJECTED = ("reject", "rejected", "failed")


@dataclass(frozen=True, slots=True)
class Taken:
    """One merged bracket: where its picture is, when it was taken, what the merge said of it."""

    slot: str
    panorama: Path
    t_open_utc: datetime
    t_close_utc: datetime
    verdict: str = ""
    meter_lx: float | None = None
    complete: bool = True
    frames: frozenset[str] = frozenset()  # sha256 of each
    double_of: str = ""  # another slot that has the same frames
    sun_u_percent: float = 0.0  # what too few pixels under the sun's disc may cost its illuminance

    @property
    def t_utc(self) -> datetime:
        return self.t_open_utc + (self.t_close_utc - self.t_open_utc) / 2


@dataclass(frozen=True, slots=True)
class Pair:
    """One row of pairs.csv."""

    taken: Taken
    light: Outside
    sun_altitude_deg: float  # true
    sun_azimuth_deg: float
    sunpatch: str = ""
    why: str = ""
    caution: str = ""

    @property
    def ok(self) -> bool:
        return not self.why


def _json(path: Path) -> dict[str, Any]:
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(path, f"{error}", "JSON as fieldlum writes it", "make it again") from None
    return table if isinstance(table, dict) else {}


def taken_brackets(session: Session) -> list[Taken]:
    """Every panorama, in order of time; over its capture.json's interval, else half a minute."""
    found = []
    for path in sorted(session.panoramas.glob("*.exr")):
        if path.name.startswith("."):
            continue
        note, capture = (
            _json(path.with_suffix(".json")),
            _json(session.raw / path.stem / "capture.json"),
        )
        try:
            if "t_open_utc" in capture:
                opened, closed = parse_utc(capture["t_open_utc"]), parse_utc(capture["t_close_utc"])
            else:
                middle = parse_utc(note["t_utc"]) if note.get("t_utc") else parse_utc(path.stem)
                opened, closed = middle - timedelta(seconds=15), middle + timedelta(seconds=15)
        except (KeyError, ValueError) as error:
            raise InputError(
                path.with_suffix(".json"), f"{error}", "times in UTC", "merge it again"
            ) from None
        meter = capture.get("illuminance_lx")
        found.append(
            Taken(
                path.stem,
                path,
                opened,
                closed,
                str(note.get("verdict", "")),
                None if meter is None else float(meter),
                bool(capture.get("complete", True)) and not (note.get("quality") or {}).get("lost"),
                frozenset(
                    str(frame["sha256"]) for frame in capture.get("frames", ()) if "sha256" in frame
                ),
                sun_u_percent=float((note.get("sun") or {}).get("u_mosaic_percent", 0.0)),
            )
        )
    return _doubles_named(found)


def _doubles_named(brackets: list[Taken]) -> list[Taken]:
    """A card that was imported twice, with two clock offsets, stands in two slots: one of them
    is wrong, or both.
    """
    at: dict[str, list[str]] = {}
    for taken in brackets:
        for frame in taken.frames:
            at.setdefault(frame, []).append(taken.slot)
    others = [next((s for f in t.frames for s in at[f] if s != t.slot), "") for t in brackets]
    return [replace(taken, double_of=other) for taken, other in zip(brackets, others, strict=True)]


def judge(taken: Taken, light: Outside, altitude_deg: float, azimuth_deg: float) -> Pair:
    """A row, with the first reason why it may not be used."""
    why = light.why
    if taken.verdict.lower().split(":")[0].strip() in _REJECTED:
        why = f"merge: {taken.verdict}"
    elif taken.double_of:
        why = f"the same frames as {taken.double_of}: imported with two clock offsets"
    elif not why and altitude_deg < 0.0:
        why = "the sun is down"
    elif not why and sun.too_weak(
        light.ghi_wm2, altitude_deg, sun.extraterrestrial_wm2([taken.t_utc])[0]
    ):
        why = "less light than any sky lets through: instrument covered or dead, or kW/m2"
    whole = "" if taken.complete else "bracket incomplete"
    poor = f"sun measured on few pixels, to {taken.sun_u_percent:.0f} %"
    poor = poor if taken.sun_u_percent >= POOR_SUN_PERCENT else ""
    return Pair(
        taken,
        light,
        altitude_deg,
        azimuth_deg,
        why=why,
        caution=_joined(whole, poor, light.caution),
    )


def _joined(*texts: str) -> str:
    return "; ".join(text for text in texts if text)


def check_night(path: Path, log: Log, site: Site) -> None:
    """Raises InputError for light with the sun well down, which is a clock's fault or a place's."""
    lit = lit_at_night(log.t_unix_s, log.ghi_wm2, site)
    if len(lit) > NIGHT_MINUTES:
        raise InputError(
            path,
            f"light in {len(lit)} minutes with the sun well down, first {utc_text(lit[0])}",
            "darkness",
            "check the logger's clock (fieldlum import --utc-offset) and the sign of the site's "
            "longitude",
        )


def run(session: Session, *, force: bool = False, progress: Progress = quiet) -> list[Pair]:
    """Write pairs.csv (and sunpatches/, and complete the sun of each panorama). Needs
    irradiance/clean.csv.

    Raises NotEnoughDataError when nothing is merged, InputError for irradiance that is light at
    night.
    """
    brackets = taken_brackets(session)
    if not brackets:
        raise NotEnoughDataError(
            f"{session.panoramas}: no panorama yet, run: fieldlum merge {session.root}"
        )
    setup, log = session.site_file(), read_clean(session.irradiance / "clean.csv")
    check_night(session.irradiance / "clean.csv", log, setup.site)
    places = sun.position([b.t_utc for b in brackets], setup.site)
    pairs = [
        judge(b, outside(log, b.t_open_utc, b.t_close_utc), float(altitude), float(azimuth))
        for b, altitude, azimuth in zip(
            brackets, places.altitude_deg, places.azimuth_deg, strict=True
        )
    ]
    pairs = _with_suns(session, setup, pairs, force, progress)
    write_pairs(session.pairs, pairs)
    return pairs


def _with_suns(
    session: Session, setup: SiteFile, pairs: Sequence[Pair], force: bool, progress: Progress
) -> list[Pair]:
    """Complete the sources, and write the patches of the usable rows where a room is given."""
    usable = [p for p in pairs if p.ok]
    full_lx = direct_normal_illuminance_lx(
        [p.light.dni_wm2 for p in usable],
        [p.light.dhi_wm2 for p in usable],
        [p.sun_altitude_deg for p in usable],
        [p.taken.t_utc for p in usable],
    )
    seen = seen_and_patches(
        session,
        setup,
        [(p.taken.slot, p.taken.panorama, p.taken.t_utc) for p in usable],
        full_lx,
        force=force,
        progress=progress,
    )
    done: dict[str, Pair] = {}
    for pair, normal_lx, (glimpse, patch) in zip(usable, full_lx, seen, strict=True):
        done[pair.taken.slot] = replace(
            pair,
            sunpatch=patch,
            caution=_joined(pair.caution, _complete(pair.taken, float(normal_lx), glimpse)),
        )
    return [done.get(p.taken.slot, p) for p in pairs]


def _complete(taken: Taken, full_normal_lx: float, glimpse: Seen) -> str:
    """Put the completed sun into the panorama and its sidecar; returns a caution."""
    try:
        panorama = read_panorama(taken.panorama)
        source, caution = complete_sun(panorama, full_normal_lx, glimpse, taken.meter_lx)
        if source is not None and not _same(source, panorama.sun):
            _rewrite(taken, replace(panorama, sun=source))
    except FieldlumError as error:
        return str(error)
    return caution


def _same(a: SunSource, b: SunSource | None) -> bool:
    """Equal to the digits that the EXR's attribute keeps."""
    if b is None or a.origin != b.origin:
        return False
    off = abs(a.normal_illuminance_lx - b.normal_illuminance_lx)
    return (
        off <= 1e-4 * a.normal_illuminance_lx
        and abs(a.visible_fraction - b.visible_fraction) < 1e-3
    )


def _rewrite(taken: Taken, panorama: Panorama) -> None:
    """The picture first, then its sidecar: a kill in between only makes `merge` and `pair` do it
    again.
    """
    with replacing_path(taken.panorama) as path:
        write_panorama(path, panorama)
    note = taken.panorama.with_suffix(".json")
    table = _json(note)
    if not table:
        return
    sun_table = dict(table.get("sun") or {})
    if panorama.sun is not None:
        s = panorama.sun
        sun_table |= {
            "altitude_deg": s.altitude_deg,
            "azimuth_deg": s.azimuth_deg,
            "origin": s.origin,
            "lower_bound": False,
            "normal_illuminance_lx": s.normal_illuminance_lx,
            "visible_fraction": s.visible_fraction,
        }
    table |= {"sun": sun_table, "size_bytes": taken.panorama.stat().st_size}
    with replacing(note, "w", encoding="utf-8") as file:
        json.dump(table, file, indent=1)


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    """pairs.csv, whole or not at all; a figure that is not known stays empty."""
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for p in pairs:
            light = p.light
            writer.writerow(
                (
                    utc_text(p.taken.t_utc),
                    p.taken.panorama.relative_to(path.parent).as_posix(),
                    _figure(light.dni_wm2),
                    _figure(light.dhi_wm2),
                    _figure(light.ghi_wm2),
                    light.source,
                    f"{p.sun_altitude_deg:.4f}",
                    f"{p.sun_azimuth_deg:.4f}",
                    f"{light.steadiness:.4f}",
                    p.sunpatch,
                    0,
                    int(p.ok),
                    p.why or p.caution,
                )
            )


def _figure(value: float) -> str:
    return "" if value != value else f"{value:.2f}"
