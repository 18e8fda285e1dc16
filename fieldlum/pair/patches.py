"""Compute sunpatches/<slot>.exr of captured hours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama, Progress, Room, SiteFile, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.room.scene import iter_sun_patches
from fieldlum.room.scene.view import patch_rays
from fieldlum.session import Session, replacing_path
from fieldlum.session.codec import write_object
from fieldlum.session.provenance import digest, made_from
from fieldlum.sky import sun

# number of slots in a unit; few are enough, because the room's rays are traced once per process;
# chosen
SLOTS_A_UNIT = 16
Item = tuple[str, Path, datetime]  # slot, its panorama, its time


def write_patches(
    session: Session,
    setup: SiteFile,
    items: Sequence[Item],
    full_normal_lx: Floats,
    *,
    force: bool,
    scheduler: Scheduler = LOCAL,
    progress: Progress,
) -> list[str]:
    """Compute sunpatches/<slot>.exr of slots; return their paths in the session, "" without a room.

    items : slot, panorama and time; full_normal_lx : of the unobstructed sun, [n] lx. Existing
    patches are used again unless `force`.
    """
    if setup.room is None or not items:
        return [""] * len(items)
    first = read_panorama(items[0][1])
    height, heading = first.luminance_cdm2.shape[0], first.heading_deg
    places = sun.position([t for _, _, t in items], setup.site)
    shown_deg = sun.shown_altitude_deg(places.altitude_deg)
    angles = list(zip(shown_deg.tolist(), places.azimuth_deg.tolist(), strict=True))
    recipes = [
        _recipe(setup.room, setup, height, heading, *at, float(lx))
        for at, lx in zip(angles, full_normal_lx, strict=True)
    ]
    owed = [
        i
        for i, ((slot, _, _), recipe) in enumerate(zip(items, recipes, strict=True))
        if force
        or made_from(session.sunpatch_sidecar(slot), recipe, [session.sunpatch(slot)]) is None
    ]
    jobs = [
        _PatchJob(
            tuple(items[i][0] for i in rows),
            tuple(items[i][2] for i in rows),
            tuple(angles[i] for i in rows),
            tuple(float(full_normal_lx[i]) for i in rows),
            tuple(recipes[i] for i in rows),
            height,
            heading,
        )
        for rows in (owed[k : k + SLOTS_A_UNIT] for k in range(0, len(owed), SLOTS_A_UNIT))
    ]
    units = [_unit(session, job) for job in jobs]
    run_each(units, scheduler, UnitOutcome.result, progress)
    return [session.sunpatch(slot).relative_to(session.root).as_posix() for slot, _, _ in items]


def _recipe(
    room: Room,
    setup: SiteFile,
    height: int,
    heading: float,
    altitude: float,
    azimuth: float,
    normal_lx: float,
) -> str:
    """Return the digest of everything that a patch depends on."""
    text = [
        plain(room),
        plain(setup.camera),
        height,
        patch_rays(height),
        heading,
        round(altitude, 4),
        round(azimuth, 4),
        f"{normal_lx:.5g}",
    ]
    return digest(text)


@dataclass(frozen=True, slots=True)
class _PatchJob:
    """Some slots of one session; the worker reads the room from session.toml."""

    slots: tuple[str, ...]
    t_utc: tuple[datetime, ...]
    angles_deg: tuple[tuple[float, float], ...]  # shown altitude, azimuth
    full_normal_lx: tuple[float, ...]
    recipes: tuple[str, ...]
    height: int
    heading_deg: float


def trace_patches(root: Path, job: _PatchJob) -> None:
    """Write the sun patches of one unit of work. Raises InputError for an impossible room."""
    session = Session(root)
    setup = session.site_file()
    assert setup.room is not None
    altitude_deg, azimuth_deg = np.array(job.angles_deg).T
    finished = 0
    for part in iter_sun_patches(
        setup.room,
        setup,
        sun.direction(altitude_deg, azimuth_deg),
        np.array(job.full_normal_lx),
        height=job.height,
        heading_deg=job.heading_deg,
    ):
        for k in range(len(part.luminance_cdm2)):
            patch = Panorama(part.luminance_cdm2[k], job.heading_deg, t_utc=job.t_utc[finished])
            _write(session, job.slots[finished], patch, job.recipes[finished])
            finished += 1


def _unit(session: Session, job: _PatchJob) -> WorkUnit:
    name = f"sun-patches-{job.slots[0]}"
    return WorkUnit(name, trace_patches, session.root, job, files=(session.toml.name,))


def _write(session: Session, slot: str, patch: Panorama, recipe: str) -> None:
    picture = session.sunpatch(slot)
    with replacing_path(picture) as path:
        write_panorama(path, patch)
    when = utc_text(patch.t_utc) if patch.t_utc else ""
    note = {"slot": slot, "t_utc": when, "inputs": recipe}
    write_object(session.sunpatch_sidecar(slot), note)
