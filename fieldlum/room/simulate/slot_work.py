"""Slots of a simulated session as units of work."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.records import Panorama, Slot
from fieldlum.core.scheduler import WorkUnit
from fieldlum.optics.images import write_panorama
from fieldlum.room.simulate.fine_windows import FineWindows, fine_windows
from fieldlum.room.simulate.troubles import Troubles, knocked_camera, troubled_pictures
from fieldlum.room.simulate.truth import Rendering, SimulatedRoom, simulated_room
from fieldlum.session import Session, replacing_path, sha256
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view import write_sky_picture

# rendered together: more would need more memory, fewer more multiplications; chosen
SLOTS_A_UNIT = 16


@dataclass(frozen=True, slots=True)
class _TruthJob:
    """Some slots to render. Folders are relative to the unit's; shining: the true light.

    pitch_deg: of the pictures around windows.
    """

    session: str
    cache: str
    key: str  # sha256 of session.toml
    height: int
    quality: str
    pitch_deg: float
    slots: tuple[Slot, ...]
    light: Light
    shining: Light
    planned_utc: tuple[datetime, ...]  # of all slots: troubles depend on them
    troubles: Troubles


def truth_units(
    session: Session,
    cache: Path,
    slots: Sequence[Slot],
    owed: Sequence[int],
    light: Light,
    shining: Light,
    *,
    height: int,
    quality: str,
    pitch_deg: float,
    troubles: Troubles,
) -> list[WorkUnit]:
    """Return units of work, 16 slots each (the last may have fewer), that render some slots.

    owed: indices into `slots` of those to render, from 0; light: as stated, for the sun patches;
    shining: as the room receives it; cache: folder of the Radiance coefficients; height: rows of
    the panoramas; quality: a key of `QUALITIES`; pitch_deg: of the pictures around windows.
    """
    root, coefficients = session.root.resolve(), cache.resolve()
    folder = Path(os.path.commonpath([root, coefficients]))
    name = root.relative_to(folder).as_posix()
    units = []
    for start in range(0, len(owed), SLOTS_A_UNIT):
        rows = np.array(owed[start : start + SLOTS_A_UNIT])
        some = tuple(slots[k] for k in rows)
        job = _TruthJob(
            session=name,
            cache=coefficients.relative_to(folder).as_posix(),
            key=sha256(session.toml),
            height=height,
            quality=quality,
            pitch_deg=pitch_deg,
            slots=some,
            light=light[rows],
            shining=shining[rows],
            planned_utc=tuple(slot.t_utc for slot in slots),
            troubles=troubles,
        )
        files = (f"{name}/{session.toml.name}",)
        units.append(WorkUnit(f"truth-{some[0].id}", render_slots, folder, job, files=files))
    return units


def render_slots(folder: Path, job: _TruthJob) -> None:
    """Render the slots of `job`; write a panorama and a panorama of sun patches for each.

    Around the windows also write a picture as fine as the sensor, unless a knock turned the camera.
    folder: that of the unit, to which the paths in `job` are relative. The stored Radiance
    coefficients are used, or computed if there are none.
    """
    session, wrong = Session(folder / job.session), job.troubles
    stored = (session.root, folder / job.cache, job.key, job.height, job.quality)
    truth, timezone = _stored_truth(*stored), _stored_truth(*stored).setup.site.timezone
    made = truth.render(job.shining)
    maps = made.luminance_cdm2
    if wrong.names:
        # Patches are computed from what is stated, as `pair` does.
        stated = truth.render(job.light)
        made = replace(made, patch_cdm2=stated.patch_cdm2)
        times = [slot.t_utc for slot in job.slots]
        maps = troubled_pictures(maps, truth.view.sky > 0, times, job.planned_utc, timezone, wrong)
    fine = _stored_windows(*stored, job.pitch_deg)
    for k, slot in enumerate(job.slots):
        turned = knocked_camera(slot.t_utc, job.planned_utc, timezone, wrong)
        if fine is not None and not turned:
            factor = maps[k] / np.maximum(made.luminance_cdm2[k], 1e-9) if wrong.names else None
            write_sky_picture(session.truth_sky_picture(slot.id), fine.picture(made, k, factor))
    _write(session, truth, replace(made, luminance_cdm2=maps), job.slots)


@lru_cache(maxsize=1)
def _stored_truth(root: Path, cache: Path, key: str, height: int, quality: str) -> SimulatedRoom:
    """Load the coefficients once in each process; sessions are distinguished by `key`."""
    return simulated_room(Session(root).site_file(), height=height, quality=quality, cache=cache)


@lru_cache(maxsize=1)
def _stored_windows(
    root: Path, cache: Path, key: str, height: int, quality: str, pitch_deg: float
) -> FineWindows | None:
    """Trace the windows once in each process."""
    return fine_windows(_stored_truth(root, cache, key, height, quality), pitch_deg)


def _write(session: Session, truth: SimulatedRoom, made: Rendering, slots: Sequence[Slot]) -> None:
    for k, slot in enumerate(slots):
        panorama = truth.as_panorama(made, k)
        with replacing_path(session.truth_panorama(slot.id)) as path:
            write_panorama(path, panorama)
        patch = Panorama(
            made.patch_cdm2[k],
            panorama.heading_deg,
            t_utc=panorama.t_utc,
            sun=panorama.sun,
            attributes={"direct": "only"},
        )
        with replacing_path(session.truth_sunpatch(slot.id)) as path:
            write_panorama(path, patch)
