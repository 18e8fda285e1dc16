"""Pair every panorama with its irradiance, its sun and its sun patch (`fieldlum pair`).

`bracket_irradiance` computes the irradiance during the bracket, `sun_strength` the sun's
illuminance at the lens, `camera_sky_view` where the camera sees the sky; this file runs
the stage and traces the sun patches.
"""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core import errors
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.records import Flag, Panorama, Site, SiteFile, parse_utc, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.pair.bracket_irradiance import BracketIrradiance, irradiance_during
from fieldlum.pair.camera_sky_view import Shown, in_patches, shares_of_beam, write_sky_view
from fieldlum.pair.sun_strength import DNI, SKY_VIEW, completed_sun, is_measured, measured_sun
from fieldlum.room.scene import sun_patches
from fieldlum.room.scene.view import patch_rays
from fieldlum.session import Session, marks, remove_scraps, replacing_path, sha256
from fieldlum.session.codec import current_note, digest, write_object
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import PairRow, PairsFile, light_digests
from fieldlum.session.files.sidecar import Sidecar, warn_if_picture_changed
from fieldlum.session.panorama_sun import SunRow, write_suns
from fieldlum.sky import log_clock_offset, picture_axes, sun
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.sky_directions import BEAM_LX

_CLIPPED_PERCENT = 50.0  # more of the view says little about the room; chosen


@dataclass(frozen=True, slots=True)
class BracketInterval:
    """One merged bracket: its panorama, its capture, and what merge recorded about it.

    slot: its id. capture: its times, and the illuminance by a meter at the lens. complete: whether
    no frame is missing or unreadable. frames: sha256 of each frame. double_of: id of another slot
    with the same frames, or "". sun_u_percent: relative standard uncertainty of the sun's
    illuminance because few sensor pixels are on the disc. clipped_percent: share of the view that
    is clipped in every frame. camera: model, serial number and lens of the camera, where it reports
    them.
    """

    slot: str
    panorama: Path
    capture: CaptureFile
    complete: bool = True
    frames: frozenset[str] = frozenset()
    double_of: str = ""
    sun_u_percent: float = 0.0
    clipped_percent: float = 0.0
    camera: str = ""


def merged_brackets(session: Session) -> list[BracketInterval]:
    """Return the bracket of every panorama, in order of time, compared with the others.

    The times are those of its capture.json. If that file is missing, they are 15 s before and 15 s
    after the panorama's time (of its sidecar, else of its name). `double_of` is set for brackets
    that share frames: a card was imported twice with two clock offsets, and at least one of the two
    slots is wrong. `camera` is set only where it differs from the camera of most brackets. Raises
    InputError for a panorama whose time is unknown, and for a damaged capture.json or sidecar.
    """
    brackets = [_bracket_of(session, path) for path in session.panorama_files()]
    slots_of: dict[str, list[str]] = {}
    for bracket in brackets:
        for frame in bracket.frames:
            slots_of.setdefault(frame, []).append(bracket.slot)
    usual = dict(Counter(each.camera for each in brackets if each.camera).most_common(1))

    def compared(bracket: BracketInterval) -> BracketInterval:
        """Return the bracket with `double_of` and `camera` by comparison with all brackets."""
        sharing = (slot for frame in bracket.frames for slot in slots_of[frame])
        other = next((slot for slot in sharing if slot != bracket.slot), "")
        camera = "" if bracket.camera in usual else bracket.camera
        return replace(bracket, double_of=other, camera=camera)

    return [compared(bracket) for bracket in brackets]


def _bracket_of(session: Session, path: Path) -> BracketInterval:
    """Return the times and quality of a panorama's bracket, by capture.json and sidecar.

    path: of the panorama. Raises InputError if neither these files nor its name state a time.
    """
    slot = path.stem
    capture = CaptureFile.find(session.capture_file(slot))
    sidecar = Sidecar.find(session.sidecar(slot))
    if capture is None:
        expected = "a name such as 20270320T153000Z"
        remedy = "merge the bracket again, or move the panorama out of panoramas/"
        with input_errors(path, expected, remedy, ValueError):
            middle = (sidecar.t_utc if sidecar else None) or parse_utc(slot)
            half = timedelta(seconds=15)
            start, end = middle - half, middle + half
            capture = CaptureFile(slot=slot, frames=(), t_open_utc=start, t_close_utc=end)
    camera = (str(capture.camera.get(key, "")) for key in ("model", "serial", "lens"))
    return BracketInterval(
        slot,
        path,
        capture,
        complete=capture.complete and not (sidecar and sidecar.report.lost),
        frames=frozenset(frame.sha256 for frame in capture.frames if frame.sha256),
        sun_u_percent=sidecar.sun.u_mosaic_percent if sidecar and sidecar.sun else 0.0,
        clipped_percent=(sidecar.report.clipped_percent if sidecar else None) or 0.0,
        camera=" ".join(camera).strip(),
    )


def judge(
    bracket: BracketInterval, light: BracketIrradiance, altitude_deg: float, azimuth_deg: float
) -> PairRow:
    """Return the row of pairs.csv for a bracket, with the verdict on whether it may be used.

    light: irradiance during the bracket; altitude_deg (true), azimuth_deg (clockwise from north):
    of the sun in the middle of the bracket. `ok` is False if the row must not be used; `why` has
    the reason, or doubts about a usable row.
    """
    why = light.why
    top_wm2 = sun.extraterrestrial_wm2([bracket.capture.t_mid_utc])[0]
    if bracket.double_of:
        why = (
            f"the same frames as slot {bracket.double_of}: a card was imported with two clock "
            "offsets; import it again with the right --utc-offset, which removes the wrong one, "
            "then merge and pair again"
        )
    elif not why and bracket.clipped_percent > _CLIPPED_PERCENT:
        clipped = f"{bracket.clipped_percent:.0f} % of the view are clipped in every frame"
        why = f"{clipped}: frames are missing, or the shortest is too long"
    elif not why and altitude_deg < 0.0:
        why = "the sun is below the horizon"
    elif not why and sun.too_weak(light.ghi_wm2, altitude_deg, top_wm2):
        why = "less light than the darkest overcast sky: a covered instrument, or values in kW/m2"
    doubts = ["" if bracket.complete else "bracket incomplete"]
    if bracket.camera:
        doubts.append(f"taken by {bracket.camera}, not by the camera of most: check its profile")
    if (u := bracket.sun_u_percent) >= 5.0:
        doubts.append(f"the sun covers few pixels: its illuminance is uncertain by {u:.0f} %")
    name = f"{bracket.panorama.parent.name}/{bracket.panorama.name}"
    return PairRow(
        t_utc=bracket.capture.t_mid_utc,
        panorama=name,
        dni_wm2=light.dni_wm2,
        dhi_wm2=light.dhi_wm2,
        ghi_wm2=light.ghi_wm2,
        source=light.source,
        sun_altitude_deg=altitude_deg,
        sun_azimuth_deg=azimuth_deg,
        steadiness=light.steadiness,
        ok=not why,
        why=why or _joined(*doubts, light.caution),
        doubtful=light.doubtful,
    )


def _joined(*texts: str) -> str:
    """Return the texts that are not empty, separated by semicolons."""
    return "; ".join(text for text in texts if text)


def check_night(path: Path, log: CleanIrradiance, site: Site) -> None:
    """Raise InputError if the log has over 5 minutes of light at night (`lit_at_night`).

    path: of the log, for the error. The cause is a wrong clock or a wrong place.
    """
    lit = log_clock_offset.lit_at_night(log.t_unix_s, log.ghi_wm2, site)
    if len(lit) > 5:
        dark = f"{len(lit)} minutes with the sun well below the horizon"
        finding = f"irradiance was logged in {dark}, first at {utc_text(lit[0])}"
        remedy = "check the logger's clock (import --logger-utc-offset) and the longitude's sign"
        raise InputError(path, finding, "no light at night", remedy)


def run(session: Session, *, force: bool = False, scheduler: Scheduler = LOCAL) -> list[PairRow]:
    """Write pairs.csv, suns.csv and, with a room, sunpatches/; return the rows of pairs.csv.

    force: compute the sky view and the sun patches again even if they exist; scheduler: where sun
    patches are computed. The panoramas do not change. A simulated session's own pairs remain in
    truth/pairs.csv. sky_view.exr is written too. Raises NotEnoughDataError if nothing is merged,
    InputError as `merged_brackets` and `check_night` do, without a valid irradiance/clean.csv, for
    an invalid session.toml, and for an impossible room.
    """
    brackets = merged_brackets(session)
    if not brackets:
        remedy = f"run fieldlum merge {session.root}"
        raise NotEnoughDataError(f"{session.panoramas}: no panorama to pair; {remedy}")
    for folder in (session.root, session.panoramas, session.sunpatches):
        remove_scraps(folder)
    setup, log = session.site_file(), CleanIrradiance.read(session.clean_irradiance)
    check_night(session.clean_irradiance, log, setup.site)
    places = sun.position([b.capture.t_mid_utc for b in brackets], setup.site)
    angles = np.stack([places.altitude_deg, places.azimuth_deg], axis=1).tolist()
    rows = [
        judge(b, irradiance_during(log, b.capture.t_open_utc, b.capture.t_close_utc), *at)
        for b, at in zip(brackets, angles, strict=True)
    ]
    usable = [k for k, row in enumerate(rows) if row.ok]
    used = ([brackets[k] for k in usable], [rows[k] for k in usable])
    completed = _complete_suns(session, setup, *used, force, scheduler)
    for k, row in zip(usable, completed, strict=True):
        rows[k] = row
    inputs = light_digests(session, {b.slot: b.capture.t_mid_utc for b in brackets})
    rows = [replace(row, inputs=inputs[b.slot]) for b, row in zip(brackets, rows, strict=True)]
    pairs = PairsFile(session.pairs, tuple(rows))
    pairs.write()
    for text in pairs.pair_again:
        warnings.warn(text.removeprefix("WARNING: "), errors.Caution, stacklevel=2)
    return rows


def _complete_suns(
    session: Session,
    setup: SiteFile,
    brackets: Sequence[BracketInterval],
    rows: Sequence[PairRow],
    force: bool,
    scheduler: Scheduler,
) -> list[PairRow]:
    """Write sky_view.exr, suns.csv and, with a room, the sun patches; return the completed rows.

    brackets, rows: the usable ones, in one order. The rows get the path of their sun patch and
    cautions about the sun. A sun that the picture does not measure gets the illuminance of DNI
    times the share of the beam by the sky view.
    """
    light = _light(session, brackets, rows)
    beams_lx, altitudes_deg = light.direct_lx.tolist(), light.apparent_altitude_deg.tolist()
    sightings = list(map(_shown_by, brackets, beams_lx, altitudes_deg))
    view = write_sky_view(session, sightings, light, setup.site, force=force)
    shares, by_view = shares_of_beam(view, setup.room, light)
    patches = write_patches(session, setup, brackets, light, force, scheduler)
    completed: list[PairRow] = []
    suns: list[SunRow] = []
    for k, (row, sighting, patch) in enumerate(zip(rows, sightings, patches, strict=True)):
        source, caution = sighting.sun, sighting.caution
        if source is not None and not is_measured(source):
            origin = SKY_VIEW if by_view[k] else DNI
            share, beam_lx = float(shares[k]), float(light.direct_lx[k])
            source, more = completed_sun(source, beam_lx, share, origin)
            caution = _joined(caution, more)
        if source is not None:
            suns.append(SunRow(row.panorama, **asdict(source), bound_lx=sighting.recorded_lx))
        completed.append(replace(row, sunpatch=patch, why=_joined(row.why, caution)))
    write_suns(session.suns, suns)
    return completed


def _light(session: Session, brackets: Sequence[BracketInterval], rows: Sequence[PairRow]) -> Light:
    """Return the light outside at the rows, with the room's states by the marks of their slots."""
    marked = marks(session)
    states = tuple(marked.get(bracket.slot, "") for bracket in brackets)
    names = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")
    columns: dict[str, Any] = {n: np.array([getattr(r, n) for r in rows], float) for n in names}
    t_utc = tuple(row.t_utc for row in rows)
    return Light(t_utc=t_utc, **columns, states=states if any(states) else None)


def _shown_by(bracket: BracketInterval, full_normal_lx: float, altitude_deg: float) -> Shown:
    """Return what a bracket's panorama shows; of an unreadable one only a caution.

    full_normal_lx: illuminance of the unhidden disc, on a plane normal to it; altitude_deg:
    apparent altitude of the sun.
    """
    warn_if_picture_changed(bracket.panorama)
    try:
        panorama = read_panorama(bracket.panorama)
    except errors.FieldlumError as error:
        return Shown(bracket.slot, caution=str(error))
    sun, caution = measured_sun(panorama, full_normal_lx, bracket.capture.illuminance_lx)
    seen = np.isfinite(panorama.seen_cdm2)
    recorded_lx = panorama.sun.normal_illuminance_lx if panorama.sun else 0.0
    heading_deg, at = panorama.heading_deg, None
    if sun is not None:
        at = (sun.altitude_deg, sun.azimuth_deg)
    elif full_normal_lx > BEAM_LX:
        flags = panorama.flags
        clipped = None if flags is None else (flags & Flag.CLIPPED_HIGH) > 0
        light = panorama.luminance_cdm2
        at = picture_axes.sun_elsewhere(light, heading_deg, full_normal_lx, clipped, altitude_deg)
    patches = in_patches(panorama)
    return Shown(bracket.slot, sun, recorded_lx, caution, seen, heading_deg, at, patches)


# ----------------------------------------------------------------------------------------------
# sun patches

# Slots in a unit of work. Few are enough, because the room's rays are traced once per process.
# Chosen.
SLOTS_A_UNIT = 16


def write_patches(
    session: Session,
    setup: SiteFile,
    brackets: Sequence[BracketInterval],
    light: Light,
    force: bool,
    scheduler: Scheduler,
) -> list[str]:
    """Write sunpatches/<slot>.exr of n brackets; return the paths in the session, "" without room.

    light: at the n brackets. A patch that exists for the same room, camera and sun is used again
    unless `force`. scheduler: where the others are computed. Raises InputError for an impossible
    room, or a first panorama that cannot be read.
    """
    if setup.room is None or not brackets:
        return [""] * len(brackets)
    first = read_panorama(brackets[0].panorama)
    height = first.luminance_cdm2.shape[0]
    common = [plain(setup.room), plain(setup.camera), height, first.heading_deg, patch_rays(height)]
    suns = (light.apparent_altitude_deg, light.sun_azimuth_deg, light.direct_lx)
    recipes, missing = [], []
    for k, (bracket, altitude, azimuth, lx) in enumerate(zip(brackets, *suns, strict=True)):
        recipe = digest([*common, round(float(altitude), 4), round(float(azimuth), 4), f"{lx:.5g}"])
        recipes.append((bracket.slot, recipe))
        sidecar, patch = session.sunpatch_sidecar(bracket.slot), session.sunpatch(bracket.slot)
        note = None if force else current_note(sidecar, recipe, [patch])
        if note is None or note.get("sha256") != sha256(patch):
            missing.append(k)
    units = []
    for first_k in range(0, len(missing), SLOTS_A_UNIT):
        job = missing[first_k : first_k + SLOTS_A_UNIT]
        argument = ([recipes[k] for k in job], light[job], (height, first.heading_deg))
        name, toml = f"sun-patches-{recipes[job[0]][0]}", (session.toml.name,)
        units.append(WorkUnit(name, trace_patches, session.root, argument, toml))
    run_each(units, scheduler, UnitOutcome.result)
    paths = (session.sunpatch(bracket.slot) for bracket in brackets)
    return [path.relative_to(session.root).as_posix() for path in paths]


def trace_patches(
    root: Path, argument: tuple[Sequence[tuple[str, str]], Light, tuple[int, float]]
) -> None:
    """Write the sun patches of one unit of work; the room is that of session.toml.

    root: of the session. argument: (slot id, digest of what its patch depends on) of n slots, their
    light, and (height [px], heading [deg clockwise from north]) of the panoramas. Raises InputError
    for an impossible room.
    """
    job, light, (height, heading_deg) = argument
    session = Session(root)
    setup = session.site_file()
    assert setup.room is not None
    suns, lx = light.apparent_sun_direction, light.direct_lx
    pictures = sun_patches(setup.room, suns, lx, height=height, heading_deg=heading_deg)
    for (slot, recipe), t_utc, picture in zip(job, light.t_utc, pictures, strict=True):
        with replacing_path(session.sunpatch(slot)) as path:
            write_panorama(path, Panorama(picture, heading_deg, t_utc=t_utc))
        note = {"slot": slot, "t_utc": utc_text(t_utc), "inputs": recipe}
        note["sha256"] = sha256(session.sunpatch(slot))
        write_object(session.sunpatch_sidecar(slot), note)
