"""Compute sunpatches/<slot>.exr of captured hours."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama, Progress, SiteFile, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.room.scene import iter_sun_patches
from fieldlum.room.scene.view import patch_rays
from fieldlum.session import Session, replacing_path
from fieldlum.session.codec import digest, made_from, write_object
from fieldlum.sky import sun

# number of slots in a unit; few are enough, because the room's rays are traced once per process;
# chosen
SLOTS_A_UNIT = 16
Item = tuple[str, Path, datetime]  # slot, its panorama, its time


class _Patch(NamedTuple):
    """One patch: the sun as the picture shows it, and the digest of what it depends on."""

    slot: str
    t_utc: datetime
    altitude_deg: float
    azimuth_deg: float
    full_normal_lx: float
    recipe: str


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
    size = first.luminance_cdm2.shape[0], first.heading_deg
    places = sun.position([t for _, _, t in items], setup.site)
    apparent_deg = sun.apparent_altitude_deg(places.altitude_deg)
    known = [plain(setup.room), plain(setup.camera), *size, patch_rays(size[0])]
    missing = []
    for (slot, _, t_utc), altitude, azimuth, lx in zip(
        items,
        apparent_deg.tolist(),
        places.azimuth_deg.tolist(),
        full_normal_lx.tolist(),
        strict=True,
    ):
        recipe = digest([*known, round(altitude, 4), round(azimuth, 4), f"{lx:.5g}"])
        stored = made_from(session.sunpatch_sidecar(slot), recipe, [session.sunpatch(slot)])
        if force or stored is None:
            missing.append(_Patch(slot, t_utc, altitude, azimuth, lx, recipe))
    jobs = [missing[k : k + SLOTS_A_UNIT] for k in range(0, len(missing), SLOTS_A_UNIT)]
    units = [
        WorkUnit(
            f"sun-patches-{job[0].slot}",
            trace_patches,
            session.root,
            (job, size),
            (session.toml.name,),
        )
        for job in jobs
    ]
    run_each(units, scheduler, UnitOutcome.result, progress)
    return [session.sunpatch(slot).relative_to(session.root).as_posix() for slot, _, _ in items]


def trace_patches(root: Path, argument: tuple[Sequence[_Patch], tuple[int, float]]) -> None:
    """Write the sun patches of one unit of work; the room is that of session.toml.

    argument : the patches, and height [px] and heading [deg] of the panoramas. Raises InputError
    for an impossible room.
    """
    job, (height, heading_deg) = argument
    session = Session(root)
    setup = session.site_file()
    assert setup.room is not None
    suns = sun.direction([p.altitude_deg for p in job], [p.azimuth_deg for p in job])
    full_normal_lx = np.array([p.full_normal_lx for p in job])
    shape = {"height": height, "heading_deg": heading_deg}
    parts = iter_sun_patches(setup.room, suns, full_normal_lx, **shape)
    pictures = (picture for part in parts for picture in part.luminance_cdm2)
    for patch, picture in zip(job, pictures, strict=True):
        with replacing_path(session.sunpatch(patch.slot)) as path:
            write_panorama(path, Panorama(picture, heading_deg, t_utc=patch.t_utc))
        note = {"slot": patch.slot, "t_utc": utc_text(patch.t_utc), "inputs": patch.recipe}
        write_object(session.sunpatch_sidecar(patch.slot), note)
