"""Compute sunpatches/<slot>.exr of captured hours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldlum.core.records import Panorama, Progress, SiteFile, utc_text
from fieldlum.core.scheduler import LOCAL, Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.room.scene import iter_sun_patches
from fieldlum.room.scene.view import patch_rays
from fieldlum.session import Session, replacing_path
from fieldlum.session.codec import digest, made_from, write_object
from fieldlum.sky.light import Light

# number of slots in a unit; few are enough, because the room's rays are traced once per process;
# chosen
SLOTS_A_UNIT = 16


def write_patches(
    session: Session,
    setup: SiteFile,
    pictures: Sequence[tuple[str, Path]],
    light: Light,
    *,
    force: bool,
    scheduler: Scheduler = LOCAL,
    progress: Progress,
) -> list[str]:
    """Compute sunpatches/<slot>.exr of n slots; return their paths in the session, "" without room.

    pictures : slot and panorama; light : of the n slots. Existing patches are used again unless
    `force`.
    """
    if setup.room is None or not pictures:
        return [""] * len(pictures)
    first = read_panorama(pictures[0][1])
    size = first.luminance_cdm2.shape[0], first.heading_deg
    known = [plain(setup.room), plain(setup.camera), *size, patch_rays(size[0])]
    suns = light.apparent_altitude_deg, light.sun_azimuth_deg, light.direct_lx
    slots, recipes, missing = [slot for slot, _ in pictures], [], []
    for k, (slot, altitude, azimuth, lx) in enumerate(zip(slots, *suns, strict=True)):
        recipe = digest([*known, round(float(altitude), 4), round(float(azimuth), 4), f"{lx:.5g}"])
        recipes.append(recipe)
        stored = made_from(session.sunpatch_sidecar(slot), recipe, [session.sunpatch(slot)])
        if force or stored is None:
            missing.append(k)
    jobs = [missing[k : k + SLOTS_A_UNIT] for k in range(0, len(missing), SLOTS_A_UNIT)]
    units = [
        WorkUnit(
            f"sun-patches-{slots[job[0]]}",
            trace_patches,
            session.root,
            ([(slots[k], recipes[k]) for k in job], light[job], size),
            (session.toml.name,),
        )
        for job in jobs
    ]
    run_each(units, scheduler, UnitOutcome.result, progress)
    return [session.sunpatch(slot).relative_to(session.root).as_posix() for slot in slots]


def trace_patches(
    root: Path, argument: tuple[Sequence[tuple[str, str]], Light, tuple[int, float]]
) -> None:
    """Write the sun patches of one unit of work; the room is that of session.toml.

    argument : slots and digests of what a patch depends on, their light, and height [px] and
    heading [deg] of the panoramas. Raises InputError for an impossible room.
    """
    job, light, (height, heading_deg) = argument
    session = Session(root)
    setup = session.site_file()
    assert setup.room is not None
    suns, shape = light.apparent_sun_direction, {"height": height, "heading_deg": heading_deg}
    parts = iter_sun_patches(setup.room, suns, light.direct_lx, **shape)
    pictures = (picture for part in parts for picture in part.luminance_cdm2)
    for (slot, recipe), t_utc, picture in zip(job, light.t_utc, pictures, strict=True):
        with replacing_path(session.sunpatch(slot)) as path:
            write_panorama(path, Panorama(picture, heading_deg, t_utc=t_utc))
        note = {"slot": slot, "t_utc": utc_text(t_utc), "inputs": recipe}
        write_object(session.sunpatch_sidecar(slot), note)
