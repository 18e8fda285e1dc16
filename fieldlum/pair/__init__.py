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

from fieldlum.core.errors import FieldlumError, InputError, NotEnoughDataError
from fieldlum.core.records import Flag, Progress, Site, SiteFile, parse_utc, quiet, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler
from fieldlum.optics.images import read_panorama
from fieldlum.pair.interval import Outside, outside
from fieldlum.pair.patches import write_patches
from fieldlum.pair.sky_view import Shown, shares_of_beam, write_sky_view
from fieldlum.pair.sun_strength import DNI, SKY_VIEW, completed_sun, is_measured, measured_sun
from fieldlum.session import Session, marks, remove_scraps
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.files.clean_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import Sidecar, warn_if_changed
from fieldlum.session.files.suns_csv import SunRow, write_suns
from fieldlum.sky import sun
from fieldlum.sky.light import Light
from fieldlum.sky.light_clock import lit_at_night

POOR_SUN_PERCENT = 5.0  # larger uncertainty of the sun's illuminance is reported; not measured
NIGHT_MINUTES = 5  # minutes of light with the sun well down that a lamp may cause; not measured


@dataclass(frozen=True, slots=True)
class Taken:
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

    taken: Taken
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


def taken_brackets(session: Session) -> list[Taken]:
    """Return every panorama in order of time, with the interval of its capture.json.

    Without a capture.json the interval is half a minute.
    """
    return _doubles_named([_taken(session, path) for path in session.panorama_files()])


def _taken(session: Session, path: Path) -> Taken:
    slot = path.stem
    capture = CaptureFile.find(session.capture_file(slot))
    sidecar = Sidecar.find(session.sidecar(slot))
    if capture is not None:
        opened, closed = capture.t_open_utc, capture.t_close_utc
    else:
        middle = sidecar.t_utc if sidecar is not None else None
        middle = middle or _slot_time(path)
        opened, closed = middle - timedelta(seconds=15), middle + timedelta(seconds=15)
    return Taken(
        slot,
        path,
        opened,
        closed,
        meter_lx=capture.illuminance_lx if capture else None,
        complete=(capture is None or capture.complete) and not (sidecar and sidecar.report.lost),
        frames=frozenset(f.sha256 for f in capture.frames if f.sha256) if capture else frozenset(),
        sun_u_percent=sidecar.sun.u_mosaic_percent if sidecar and sidecar.sun else 0.0,
    )


def _slot_time(path: Path) -> datetime:
    try:
        return parse_utc(path.stem)
    except ValueError as error:
        raise InputError(
            path,
            f"the file's name is no slot ({error})",
            "a name such as 20270320T153000Z",
            "merge the bracket again, or move the panorama out of panoramas/",
        ) from None


def _doubles_named(brackets: list[Taken]) -> list[Taken]:
    """Mark brackets that share frames, because a card was imported twice with two clock offsets.

    At least one of the two slots is wrong.
    """
    at: dict[str, list[str]] = {}
    for taken in brackets:
        for frame in taken.frames:
            at.setdefault(frame, []).append(taken.slot)
    others = [next((s for f in t.frames for s in at[f] if s != t.slot), "") for t in brackets]
    return [replace(taken, double_of=other) for taken, other in zip(brackets, others, strict=True)]


def judge(taken: Taken, light: Outside, altitude_deg: float, azimuth_deg: float) -> Pair:
    """Return the row of pairs.csv for a bracket, with the first reason not to use it, if any."""
    why = light.why
    if taken.double_of:
        why = (
            f"the same frames as slot {taken.double_of}: a card was imported with two clock "
            "offsets; import it again with the right --utc-offset, which removes the wrong one, "
            "then merge and pair again"
        )
    elif not why and altitude_deg < 0.0:
        why = "the sun is below the horizon"
    elif not why and sun.too_weak(
        light.ghi_wm2, altitude_deg, sun.extraterrestrial_wm2([taken.t_utc])[0]
    ):
        why = (
            "less light than the darkest overcast sky: the instrument was covered or "
            "faulty, or values are in kW/m2"
        )
    missing_frames = "" if taken.complete else "bracket incomplete"
    poor = f"the sun covers few pixels: its illuminance is uncertain by {taken.sun_u_percent:.0f} %"
    poor = poor if taken.sun_u_percent >= POOR_SUN_PERCENT else ""
    return Pair(
        taken,
        light,
        altitude_deg,
        azimuth_deg,
        why=why,
        caution=_joined(missing_frames, poor, light.caution),
    )


def _joined(*texts: str) -> str:
    return "; ".join(text for text in texts if text)


def check_night(path: Path, log: CleanIrradiance, site: Site) -> None:
    """Raise InputError for over 5 minutes of light with the sun well down: wrong clock or place."""
    lit = lit_at_night(log.t_unix_s, log.ghi_wm2, site)
    if len(lit) > NIGHT_MINUTES:
        raise InputError(
            path,
            f"irradiance was logged in {len(lit)} minutes with the sun well below the horizon, "
            "first at "
            f"{utc_text(lit[0])}",
            "no light at night",
            "check the logger's clock (fieldlum import --utc-offset) and the sign of the site's "
            "longitude",
        )


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
    pairs = [
        judge(b, outside(log, b.t_open_utc, b.t_close_utc), float(altitude), float(azimuth))
        for b, altitude, azimuth in zip(
            brackets, places.altitude_deg, places.azimuth_deg, strict=True
        )
    ]
    pairs = _with_suns(session, setup, pairs, force, scheduler, progress)
    write_pairs(session.pairs, pairs)
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
        if source is not None:
            if not is_measured(source):
                origin = SKY_VIEW if by_view[k] else DNI
                beam_lx, share = float(light.direct_lx[k]), float(shares[k])
                source, more = completed_sun(source, beam_lx, share, origin)
                caution = _joined(caution, more)
            name = pair.taken.panorama.relative_to(session.root).as_posix()
            suns.append(
                SunRow(
                    name,
                    source.altitude_deg,
                    source.azimuth_deg,
                    source.normal_illuminance_lx,
                    source.visible_fraction,
                    source.origin,
                    picture.recorded_lx,
                )
            )
        caution = _joined(pair.caution, caution)
        completed[pair.taken.slot] = replace(pair, sunpatch=patch, caution=caution)
    write_suns(session.suns, suns)
    return [completed.get(p.taken.slot, p) for p in pairs]


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


def _shown(taken: Taken, full_normal_lx: float) -> Shown:
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


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    """Write pairs.csv atomically; an unknown figure is an empty cell."""
    PairsFile(path, tuple(_row(path, pair) for pair in pairs)).write()


def _row(path: Path, pair: Pair) -> PairRow:
    light = pair.light
    return PairRow(
        pair.taken.t_utc,
        pair.taken.panorama.relative_to(path.parent).as_posix(),
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
