"""Simulate sessions whose truth is known: a box room rendered at every planned slot.

The simulated camera and pyranometer read truth/<slot>.exr (a panorama and its separate sun) and
truth/irradiance.csv. truth/pairs.csv lists the same panoramas, so that `train` and `bench` can use
the truth itself; pairs.csv does the same until `pair` writes the pairs of the captures.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.files import remove_scraps, replacing_path, sha256
from fieldlum.core.records import SiteFile, Slot
from fieldlum.core.scheduler import LOCAL, Scheduler, UnitOutcome, WorkUnit, run_each
from fieldlum.core.strict_toml import plain
from fieldlum.optics import images, linear_light, profiles
from fieldlum.room.scene import build
from fieldlum.room.scene.radiosity import LitRoom, box_room, lit_room
from fieldlum.room.simulate.fine_windows import FineWindows, fine_windows
from fieldlum.session import Session, codec, create_session, update_session
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import PairRow, write_simulated_pairs
from fieldlum.session.folder import PlanTable
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.picture import write_sky_picture
from fieldlum.weather import Weather, weather_for

_VERSION = 4  # of the rendering; increase it to render all hours again
# slots rendered together: more would need more memory, fewer more multiplications
_SLOTS_A_UNIT = 16


@dataclass(frozen=True, slots=True)
class Simulated:
    """Numbers of slots of a run, and the name of the weather.

    rendered: by this run; kept: by an earlier run; dark: without light in the weather or with the
    sun down, which are in pairs.csv with ok = 0 and are not rendered.
    """

    rendered: int
    kept: int
    dark: int
    weather: str


def sample_slots(
    setup: SiteFile, weather: Weather, count: int, seed: int, without: Sequence[datetime] = ()
) -> list[Slot]:
    """Draw `count` daylight hours of a weather year at random; return them as slots in time order.

    Daylight: sun above the horizon, and DNI or DHI above 0. The slots have the times of the
    weather's rows, no exposures and no tags. seed : of the draw; without : exact times of rows that
    are not drawn. Raises NotEnoughDataError if the year has fewer other hours.
    """
    day = weather.daylight()
    excluded = set(without)
    free = np.array([k for k, t in enumerate(day.t_utc) if t not in excluded])
    if count > len(free):
        unused = f"the weather year has only {len(free)} unused hours with light"
        raise NotEnoughDataError(f"{count} hours requested, but {unused}; request fewer")
    rows = np.sort(np.random.default_rng(seed).permutation(free)[:count])
    times = [day.t_utc[k] for k in rows]
    at = sun.position(times, setup.site)
    return [
        Slot(t, sun_altitude_deg=float(a), sun_azimuth_deg=float(z), exposures=())
        for t, a, z in zip(times, at.altitude_deg, at.azimuth_deg, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class _Room:
    """What decides how a session's room is traced; renderings with equal settings share the result.

    key: sha256 of session.toml; height: rows of the panoramas; quality: a key of `QUALITIES`;
    pitch_deg: of the pixels of the pictures around windows.
    """

    key: str
    height: int
    quality: str
    pitch_deg: float


@dataclass(frozen=True, slots=True)
class _Job:
    """Some slots to render, and the light of each; coloured: with colours of sky, sun, surfaces."""

    room: _Room
    coloured: bool
    slots: tuple[Slot, ...]
    light: Light


def run(
    session: Session,
    weather: Weather,
    *,
    height: int = 230,
    quality: str = "paper",
    coloured: bool = False,
    force: bool = False,
    scheduler: Scheduler = LOCAL,
) -> Simulated:
    """Render the truth of every slot of a session's plan and write its pairs.

    Slots that were rendered before in the same way are kept, unless `force`; pictures of another
    rendering are deleted. height : rows of the panoramas; quality : a key of `QUALITIES`; coloured
    : sky, sun and surfaces have colours. Writes the folder truth/, pairs as `write_pairs`, and the
    table [simulation] of session.toml. Raises InputError for a room that cannot be rendered or a
    camera profile that cannot be read.
    """
    setup, slots = session.site_file(), session.slots()
    for folder in (session.root, session.truth, session.truth / "sunpatches"):
        remove_scraps(folder)
    build(box_room(setup))  # raises for an impossible room, before anything is deleted
    light, lit = _light_of(setup, slots, weather)
    pitch_deg = linear_light.sensor_pitch_deg(profiles.load_camera_profile(setup.camera.profile))
    room = _Room(sha256(session.toml), height, quality, pitch_deg)
    _delete_other_pictures(session, slots, weather, room, coloured)
    missing = [int(k) for k in np.flatnonzero(lit) if force or not _is_rendered(session, slots[k])]
    units = []
    for start in range(0, len(missing), _SLOTS_A_UNIT):
        rows = np.array(missing[start : start + _SLOTS_A_UNIT])
        job = _Job(room, coloured, tuple(slots[k] for k in rows), light[rows])
        name, files = f"truth-{job.slots[0].id}", (session.toml.name,)
        units.append(WorkUnit(name, render_slots, session.root.resolve(), job, files=files))
    run_each(units, scheduler, UnitOutcome.result)
    _write_irradiance(session, weather, slots)
    write_pairs(session, slots, light, lit, weather)
    about = {
        "weather": weather.name,
        "height": height,
        "quality": quality,
        "synthetic_weather": weather.synthetic,
    }
    update_session(session, {"simulation": about})
    return Simulated(
        rendered=len(missing),
        kept=int(lit.sum()) - len(missing),
        dark=int((~lit).sum()),
        weather=weather.name,
    )


def render_slots(folder: Path, job: _Job) -> None:
    """Render the slots of `job` in the session `folder`: a panorama and its sun patches for each.

    They are written below truth/, with a picture of what is around the windows, as fine as the
    sensor. job: as `run` makes it; a process traces the room once for all jobs.
    """
    session = Session(folder)
    room, fine = _traced(folder, job.room)
    truth = room.render(job.light, coloured=job.coloured)
    for k, slot in enumerate(job.slots):
        if fine is not None:
            write_sky_picture(session.truth_sky_picture(slot.id), fine.picture(truth, k))
        panorama = room.as_panorama(truth, k)
        direct = {"luminance_cdm2": truth.patch_cdm2[k], "attributes": {"direct": "only"}}
        patches = replace(panorama, rgb=None, **direct)
        with replacing_path(session.truth_panorama(slot.id)) as path:
            images.write_panorama(path, panorama)
        with replacing_path(session.truth_sunpatch(slot.id)) as path:
            images.write_panorama(path, patches)


@lru_cache(maxsize=1)
def _traced(root: Path, how: _Room) -> tuple[LitRoom, FineWindows | None]:
    """Trace a session's room and windows once in each process; `how.key` separates sessions."""
    room = lit_room(Session(root).site_file(), height=how.height, quality=how.quality)
    return room, fine_windows(room, how.pitch_deg)


def make_session(out: Path, setup: SiteFile, slots: Sequence[Slot], about: PlanTable) -> Session:
    """Create the session folder `out` with `slots`, put in order of time, as its plan.

    setup: the content of SITE.toml; slots: in any order; about: further keys of the table [plan].
    Raises InputError if `out` is a session, is inside one, or has a plan.csv that fieldlum did not
    write.
    """
    in_order = sorted(slots, key=lambda slot: slot.t_utc)
    return create_session(out, setup, in_order, {**about, "slots": len(slots)})


def _light_of(setup: SiteFile, slots: Sequence[Slot], weather: Weather) -> tuple[Light, Mask]:
    """Return the light of the slots, and a mask, True for slots that have sun or sky light.

    The mask [len(slots)] is False if the sun is down or DNI and DHI are 0 or missing.
    """
    times = [slot.t_utc for slot in slots]
    irradiance = weather.at(times)
    dni, dhi = np.nan_to_num(irradiance.dni_wm2), np.nan_to_num(irradiance.dhi_wm2)
    light = light_at(times, setup.site, dni, dhi)
    return light, (dni + dhi > 0) & (light.sun_altitude_deg > 0)


def _delete_other_pictures(
    session: Session, slots: Sequence[Slot], weather: Weather, how: _Room, coloured: bool
) -> None:
    """Delete the slots' pictures if truth/made.json states another rendering than this one.

    It states room, size, quality, weather and colours, and is written again. Otherwise an
    interrupted run could leave a mixture. how: how the room is rendered; coloured: whether the
    pictures have colours.
    """
    path, setup = session.truth / "made.json", session.site_file()
    irradiance = np.concatenate((weather.dni_wm2, weather.dhi_wm2)).astype("<f4")
    light = hashlib.sha256(irradiance.tobytes()).hexdigest()
    room = [plain(setup.room), setup.camera.heading_deg, how.height, how.quality, _VERSION]
    now = {"room": codec.digest(room), "weather": weather.name, "light_sha256": light}
    now |= {"window_pitch_deg": f"{how.pitch_deg:.4f}", "troubles": ""}
    now |= {"coloured": True} if coloured else {}
    if codec.current_note(path, now) is not None:
        return
    for slot in slots:
        for place in (session.truth_panorama, session.truth_sunpatch, session.truth_sky_picture):
            place(slot.id).unlink(missing_ok=True)
    codec.write_object(path, now)


def _is_rendered(session: Session, slot: Slot) -> bool:
    """Return whether the slot's panorama and sun patches were rendered by an earlier run."""
    return session.truth_panorama(slot.id).is_file() and session.truth_sunpatch(slot.id).is_file()


def _write_irradiance(session: Session, weather: Weather, slots: Sequence[Slot]) -> None:
    """Write truth/irradiance.csv over the planned days.

    Each hour has two rows, at its begin and end, because readers interpolate between rows.
    """
    days = sorted({sun.standard_date(slot.t_utc, weather.site.timezone) for slot in slots})
    times: list[datetime] = []
    for day in days:
        start = sun.standard_midnight(day, weather.site.timezone)
        for hour in range(24):
            begin = start + timedelta(hours=hour)
            times += [begin, begin + timedelta(minutes=59, seconds=59)]
    light = weather.at(times)
    ghi, dni, dhi = map(np.nan_to_num, (light.ghi_wm2, light.dni_wm2, light.dhi_wm2))
    seconds = np.array([t.timestamp() for t in times])
    truth = CleanIrradiance(t_unix_s=seconds, ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni)
    truth.write(session.truth_irradiance)


def write_pairs(
    session: Session, slots: Sequence[Slot], light: Light, lit: Mask, weather: Weather
) -> None:
    """Write truth/pairs.csv: the rendered panorama and the light of each slot, as if measured.

    The session's pairs.csv is written with the same rows, unless it has pairs of merged panoramas.
    light: of all slots; lit [len(slots)]: True for rendered slots, others get ok = 0; weather: for
    the global irradiance.
    """
    ghi = np.nan_to_num(weather.at([slot.t_utc for slot in slots]).ghi_wm2)
    columns = (light.dni_wm2, light.dhi_wm2, ghi, light.sun_altitude_deg, light.sun_azimuth_deg)
    rows = []
    for slot, ok, values in zip(slots, lit.tolist(), np.stack(columns, axis=1), strict=True):
        dni, dhi, total, altitude_deg, azimuth_deg = values.tolist()
        panorama, patch = (
            path.relative_to(session.root).as_posix() if ok else ""
            for path in (session.truth_panorama(slot.id), session.truth_sunpatch(slot.id))
        )
        row = PairRow(
            t_utc=slot.t_utc,
            panorama=panorama,
            dni_wm2=dni,
            dhi_wm2=dhi,
            ghi_wm2=total,
            source="measured",
            sun_altitude_deg=altitude_deg,
            sun_azimuth_deg=azimuth_deg,
            sunpatch=patch,
            ok=ok,
            why="" if ok else "no light in the weather",
        )
        rows.append(row)
    write_simulated_pairs(session, tuple(rows))
