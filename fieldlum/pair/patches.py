"""Direct sun in the room, for the hours that were captured: sunpatches/<slot>.exr, and what the
lens sees of it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum import sun
from fieldlum.images import read_panorama, write_panorama
from fieldlum.pair.sun_strength import Seen
from fieldlum.profiles import plain
from fieldlum.records import Float, Panorama, Progress, Room, SiteFile, utc_text
from fieldlum.session import Session, replacing, replacing_path

Item = tuple[str, Path, datetime]  # slot, its panorama, its time


def seen_and_patches(
    session: Session,
    setup: SiteFile,
    items: Sequence[Item],
    full_normal_lx: Float,
    *,
    force: bool,
    progress: Progress,
) -> list[tuple[Seen, str]]:
    """What each slot's lens sees of the sun, and its patch's path relative to the session (""
    without a room).
    """
    if setup.room is None or not items:
        return [(Seen(), "")] * len(items)
    first = read_panorama(items[0][1])
    height, heading = first.luminance_cdm2.shape[0], first.heading_deg
    places = sun.position([t for _, _, t in items], setup.site)
    angles = list(
        zip(places.apparent_altitude_deg.tolist(), places.azimuth_deg.tolist(), strict=True)
    )
    recipes = [
        _recipe(setup.room, setup, height, heading, *at, float(lx))
        for at, lx in zip(angles, full_normal_lx, strict=True)
    ]
    known = [
        None if force else _known(session, item[0], r)
        for item, r in zip(items, recipes, strict=True)
    ]
    owed = [i for i, seen in enumerate(known) if seen is None]
    if owed:
        _make(
            session,
            setup,
            [items[i] for i in owed],
            [angles[i] for i in owed],
            np.asarray(full_normal_lx)[owed],
            [recipes[i] for i in owed],
            height,
            heading,
            progress,
        )
    seen = [
        s or _known(session, item[0], r) or Seen()
        for s, item, r in zip(known, items, recipes, strict=True)
    ]
    paths = [session.sunpatch(slot).relative_to(session.root).as_posix() for slot, _, _ in items]
    return list(zip(seen, paths, strict=True))


def _recipe(
    room: Room,
    setup: SiteFile,
    height: int,
    heading: float,
    altitude: float,
    azimuth: float,
    normal_lx: float,
) -> str:
    """What a patch depends on, as a digest."""
    text = [
        plain(room),
        plain(setup.camera),
        height,
        heading,
        round(altitude, 4),
        round(azimuth, 4),
        f"{normal_lx:.5g}",
    ]
    return hashlib.sha256(json.dumps(text, sort_keys=True).encode()).hexdigest()


def _known(session: Session, slot: str, recipe: str) -> Seen | None:
    """From the sidecar of a patch that was made by this very recipe."""
    picture, note = session.sunpatch(slot), session.sunpatch_sidecar(slot)
    try:
        table = json.loads(note.read_text(encoding="utf-8"))
        if table["recipe"] != recipe or not picture.is_file():
            return None
        return Seen(float(table["visible_fraction"]), float(table["disc_transmittance"]), True)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _make(
    session: Session,
    setup: SiteFile,
    items: Sequence[Item],
    angles: Sequence[tuple[float, float]],
    full_normal_lx: Float,
    recipes: Sequence[str],
    height: int,
    heading: float,
    progress: Progress,
) -> None:
    from fieldlum.scene import iter_sun_patches

    assert setup.room is not None
    altitude, azimuth = np.array(angles).T
    done = 0
    for part in iter_sun_patches(
        setup.room,
        setup,
        sun.direction(altitude, azimuth),
        np.asarray(full_normal_lx, float),
        height=height,
        heading_deg=heading,
    ):
        for k in range(len(part.luminance_cdm2)):
            slot, _, t_utc = items[done]
            sight = {
                "visible_fraction": float(part.visible_fraction[k]),
                "disc_transmittance": float(part.disc_transmittance[k]),
            }
            _write(
                session,
                slot,
                Panorama(part.luminance_cdm2[k], heading, t_utc=t_utc),
                recipes[done],
                sight,
            )
            done += 1
            progress(done, len(items), f"sun patch {slot}")


def _write(
    session: Session, slot: str, patch: Panorama, recipe: str, sight: dict[str, Any]
) -> None:
    picture = session.sunpatch(slot)
    with replacing_path(picture) as path:
        write_panorama(path, patch)
    when = utc_text(patch.t_utc) if patch.t_utc else ""
    with replacing(picture.with_suffix(".json"), "w", encoding="utf-8") as file:
        json.dump({"slot": slot, "t_utc": when, **sight, "recipe": recipe}, file)
