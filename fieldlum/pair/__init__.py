"""Pair every panorama with its irradiance, its sun and its sun patch (`fieldlum pair`).

`interval` computes the irradiance during the bracket, `sun_strength` the sun's illuminance at the
lens, `sky_view` where the camera sees the sky, `patches` the sun patches; this file runs the stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.errors import FieldlumError, InputError, NotEnoughDataError, input_errors
from fieldlum.core.records import Flag, Progress, Site, SiteFile, parse_utc, quiet, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler
from fieldlum.optics.images import read_panorama
from fieldlum.pair.interval import Outside, outside
from fieldlum.pair.patches import write_patches
from fieldlum.pair.sky_view import Shown, shares_of_beam, write_sky_view
from fieldlum.pair.sun_strength import DNI, SKY_VIEW, completed_sun, is_measured, measured_sun
from fieldlum.session import Session, marks, remove_scraps
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import Sidecar, warn_if_changed
from fieldlum.session.panorama_sun import SunRow, write_suns
from fieldlum.sky import sun
from fieldlum.sky.light import Light
from fieldlum.sky.light_clock import lit_at_night

POOR_SUN_PERCENT = 5.0  # larger uncertainty of the sun's illuminance is reported; not measured
NIGHT_MINUTES = 5  # minutes of light with the sun well down that a lamp may cause; not measured


@dataclass(frozen=True, slots=True)
class BracketInterval:
    """One merged bracket: its panorama, its times, and what merge recorded about it.

    slot: its id. t_open_utc, t_close_utc: start of the first and end of the last frame.
    meter_lx: reading of an illuminance meter, None without one. complete: whether no frame is
    missing or unreadable. frames: sha256 of each frame. double_of: id of another slot with the same
    frames, or "". sun_u_percent: uncertainty of the sun's illuminance because few pixels on the
    disc are usable.
    """

    slot: str
    panorama: Path
    t_open_utc: datetime
    t_close_utc: datetime
    meter_lx: float | None = None
    complete: bool = True
    frames: frozenset[str] = frozenset()
    double_of: str = ""
    sun_u_percent: float = 0.0

    @property
    def t_utc(self) -> datetime:
        """Middle of the bracket."""
        return self.t_open_utc + (self.t_close_utc - self.t_open_utc) / 2


@dataclass(frozen=True, slots=True)
class Pair:
    """One row of pairs.csv: a bracket with its light, sun and sun patch.

    why: the reason that it must not be used, "" if it may be. caution: a doubt, or "". taken:
    the bracket; light: irradiance during it. sun_altitude_deg: true altitude, without
    refraction; sun_azimuth_deg: clockwise from north. sunpatch: file of the sun patch,
    in the session's folder, or "".
    """

    taken: BracketInterval
    light: Outside
    sun_altitude_deg: float
    sun_azimuth_deg: float
    sunpatch: str = ""
    why: str = ""
    caution: str = ""

    @property
    def ok(self) -> bool:
        """Whether the row may be used."""
        return not self.why


def taken_brackets(session: Session) -> list[BracketInterval]:
    """Return every panorama in order of time, with the interval of its capture.json.

    Without a capture.json the interval is half a minute. Brackets that share frames are marked: a
    card was imported twice with two clock offsets, and at least one of the two slots is wrong.
    """
    brackets = [_taken(session, path) for path in session.panorama_files()]
    slots_of: dict[str, list[str]] = {}
    for taken in brackets:
        for frame in taken.frames:
            slots_of.setdefault(frame, []).append(taken.slot)
    others = [next((s for f in t.frames for s in slots_of[f] if s != t.slot), "") for t in brackets]
    return [replace(taken, double_of=other) for taken, other in zip(brackets, others, strict=True)]


def _taken(session: Session, path: Path) -> BracketInterval:
    slot = path.stem
    capture = CaptureFile.find(session.capture_file(slot))
    sidecar = Sidecar.find(session.sidecar(slot))
    sun_u_percent = sidecar.sun.u_mosaic_percent if sidecar and sidecar.sun else 0.0
    lost = bool(sidecar and sidecar.report.lost)
    if capture is None:
        middle = (sidecar.t_utc if sidecar is not None else None) or _slot_time(path)
        opened, closed = middle - timedelta(seconds=15), middle + timedelta(seconds=15)
        return BracketInterval(
            slot, path, opened, closed, complete=not lost, sun_u_percent=sun_u_percent
        )
    return BracketInterval(
        slot,
        path,
        capture.t_open_utc,
        capture.t_close_utc,
        capture.illuminance_lx,
        capture.complete and not lost,
        frozenset(f.sha256 for f in capture.frames if f.sha256),
        sun_u_percent=sun_u_percent,
    )


def _slot_time(path: Path) -> datetime:
    expected = "a name such as 20270320T153000Z"
    remedy = "merge the bracket again, or move the panorama out of panoramas/"
    with input_errors(path, expected, remedy, ValueError):
        return parse_utc(path.stem)


def judge(taken: BracketInterval, light: Outside, altitude_deg: float, azimuth_deg: float) -> Pair:
    """Return the row of pairs.csv for a bracket, with the first reason not to use it, if any."""
    why = light.why
    top_wm2 = sun.extraterrestrial_wm2([taken.t_utc])[0]
    if taken.double_of:
        why = (
            f"the same frames as slot {taken.double_of}: a card was imported with two clock "
            "offsets; import it again with the right --utc-offset, which removes the wrong one, "
            "then merge and pair again"
        )
    elif not why and altitude_deg < 0.0:
        why = "the sun is below the horizon"
    elif not why and sun.too_weak(light.ghi_wm2, altitude_deg, top_wm2):
        why = "less light than the darkest overcast sky: a covered instrument, or values in kW/m2"
    u_percent = taken.sun_u_percent
    caution = _joined(
        "" if taken.complete else "bracket incomplete",
        f"the sun covers few pixels: its illuminance is uncertain by {u_percent:.0f} %"
        if u_percent >= POOR_SUN_PERCENT
        else "",
        light.caution,
    )
    return Pair(taken, light, altitude_deg, azimuth_deg, why=why, caution=caution)


def _joined(*texts: str) -> str:
    return "; ".join(text for text in texts if text)


def check_night(path: Path, log: CleanIrradiance, site: Site) -> None:
    """Raise InputError for over 5 minutes of light with the sun well down: wrong clock or place."""
    lit = lit_at_night(log.t_unix_s, log.ghi_wm2, site)
    if len(lit) > NIGHT_MINUTES:
        finding = (
            f"irradiance was logged in {len(lit)} minutes with the sun well below the horizon, "
            f"first at {utc_text(lit[0])}"
        )
        remedy = (
            "check the logger's clock (fieldlum import --utc-offset) and the sign of the site's "
            "longitude"
        )
        raise InputError(path, finding, "no light at night", remedy)


def run(
    session: Session,
    *,
    force: bool = False,
    scheduler: Scheduler = LOCAL,
    progress: Progress = quiet,
) -> list[Pair]:
    """Write pairs.csv, suns.csv and, with a room, sunpatches/; return the pairs.

    The panoramas do not change. A simulated session's own pairs remain in truth/pairs.csv. Raises
    NotEnoughDataError if nothing is merged, InputError without irradiance/clean.csv or for light at
    night.
    """
    brackets = taken_brackets(session)
    if not brackets:
        raise NotEnoughDataError(
            f"{session.panoramas}: no panorama to pair; run fieldlum merge {session.root}"
        )
    for folder in (session.root, session.panoramas, session.sunpatches):
        remove_scraps(folder)
    setup, log = session.site_file(), CleanIrradiance.read(session.clean_irradiance)
    check_night(session.clean_irradiance, log, setup.site)
    places = sun.position([b.t_utc for b in brackets], setup.site)
    angles = np.stack([places.altitude_deg, places.azimuth_deg], axis=1).tolist()
    pairs = [
        judge(b, outside(log, b.t_open_utc, b.t_close_utc), *at)
        for b, at in zip(brackets, angles, strict=True)
    ]
    pairs = _with_suns(session, setup, pairs, force, scheduler, progress)
    PairsFile(session.pairs, tuple(_row(session, pair) for pair in pairs)).write()
    return pairs


def _with_suns(
    session: Session,
    setup: SiteFile,
    pairs: Sequence[Pair],
    force: bool,
    scheduler: Scheduler,
    progress: Progress,
) -> list[Pair]:
    """Write sky_view.exr and suns.csv, and with a room the patches, of the usable rows."""
    usable = [p for p in pairs if p.ok]
    light = _light(session, usable)
    shown = [_shown(p.taken, float(lx)) for p, lx in zip(usable, light.direct_lx, strict=True)]
    view = write_sky_view(session, shown, light, setup.site, force=force, progress=progress)
    shares, by_view = shares_of_beam(view, setup.room, light)
    patches = write_patches(
        session,
        setup,
        [(p.taken.slot, p.taken.panorama, p.taken.t_utc) for p in usable],
        light.direct_lx,
        force=force,
        scheduler=scheduler,
        progress=progress,
    )
    completed: dict[str, Pair] = {}
    suns: list[SunRow] = []
    for k, (pair, picture, patch) in enumerate(zip(usable, shown, patches, strict=True)):
        source, caution = picture.sun, picture.caution
        if source is not None and not is_measured(source):
            origin = SKY_VIEW if by_view[k] else DNI
            share, beam_lx = float(shares[k]), float(light.direct_lx[k])
            source, more = completed_sun(source, beam_lx, share, origin)
            caution = _joined(caution, more)
        if source is not None:
            at = source.altitude_deg, source.azimuth_deg, source.normal_illuminance_lx
            own = source.visible_fraction, source.origin, picture.recorded_lx
            suns.append(SunRow(_name(session, pair), *at, *own))
        caution = _joined(pair.caution, caution)
        completed[pair.taken.slot] = replace(pair, sunpatch=patch, caution=caution)
    write_suns(session.suns, suns)
    return [completed.get(p.taken.slot, p) for p in pairs]


def _name(session: Session, pair: Pair) -> str:
    """Return the path of a pair's panorama in the session."""
    return pair.taken.panorama.relative_to(session.root).as_posix()


def _light(session: Session, pairs: Sequence[Pair]) -> Light:
    """Return the light outside of usable pairs, with the room's states by their marks."""
    marked = marks(session)
    states = tuple(marked.get(p.taken.slot, "") for p in pairs)
    numbers = [
        (p.light.dni_wm2, p.light.dhi_wm2, p.sun_altitude_deg, p.sun_azimuth_deg) for p in pairs
    ]
    dni, dhi, altitude, azimuth = np.array(numbers).reshape(-1, 4).T
    times = tuple(p.taken.t_utc for p in pairs)
    return Light(times, dni, dhi, altitude, azimuth, states=states if any(states) else None)


def _shown(taken: BracketInterval, full_normal_lx: float) -> Shown:
    """Return what the panorama of a bracket shows; only a caution if it cannot be read."""
    warn_if_changed(taken.panorama)
    try:
        panorama = read_panorama(taken.panorama)
    except FieldlumError as error:
        return Shown(taken.slot, caution=str(error))
    sun, caution = measured_sun(panorama, full_normal_lx, taken.meter_lx)
    seen = np.isfinite(panorama.luminance_cdm2)
    if panorama.flags is not None:
        seen &= (panorama.flags & Flag.OUTSIDE_LENS) == 0
    recorded_lx = panorama.sun.normal_illuminance_lx if panorama.sun else 0.0
    return Shown(taken.slot, sun, recorded_lx, caution, seen, panorama.heading_deg)


def _row(session: Session, pair: Pair) -> PairRow:
    """Return the row of pairs.csv; an unknown figure is an empty cell."""
    light = pair.light
    return PairRow(
        pair.taken.t_utc,
        _name(session, pair),
        light.dni_wm2,
        light.dhi_wm2,
        light.ghi_wm2,
        light.source,
        pair.sun_altitude_deg,
        pair.sun_azimuth_deg,
        light.steadiness,
        pair.sunpatch,
        ok=pair.ok,
        why=pair.why or pair.caution,
    )
