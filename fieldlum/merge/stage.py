"""Merge every captured slot of a session to panoramas/<slot>.exr (`fieldlum merge SESSION`)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from textwrap import wrap
from zoneinfo import ZoneInfo

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fieldlum.core import scheduler as work
from fieldlum.core.errors import FieldlumError, InputError, NotEnoughDataError
from fieldlum.core.false_colour import RANGE_CDM2, coloured, png_of
from fieldlum.core.files import check_writable, remove_scraps, replacing_path, sha256, write_file
from fieldlum.core.records import CLIPPED_SUN, JsonTable, Site, counted, parse_utc, utc_text
from fieldlum.merge.bracket import MergeOptions, MergeResult, merge_shots
from fieldlum.merge.shots import Shot, middle_of, shots_of_slot, verified
from fieldlum.merge.sun_and_sky import disc_px, expected_sun_deg, mosaic_u_rel
from fieldlum.optics import images, raw
from fieldlum.optics.illuminance import illuminance_ahead_lx
from fieldlum.optics.profiles import CameraProfile, find_camera_profile, load_camera_profile
from fieldlum.session import Session
from fieldlum.session.codec import current_note, digest, sealed, to_json, warn_if_changed, write_csv
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.files.sidecar import MergeReport, Sidecar, SidecarSun, readable_sidecars
from fieldlum.sky.sky_view.picture import write_sky_picture
from fieldlum.version import __version__

# Increase it when the arithmetic changes: earlier panoramas are then merged again.
_RECIPE = 8


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of one bracket.

    slot: name of the slot; state: "merged", "kept" (merged by an earlier run from the same inputs)
    or "failed". text: the panorama's verdict, or why the merge failed. report: figures of the
    merge; None if it failed.
    """

    slot: str
    state: str
    text: str
    report: MergeReport | None = None

    def table(self) -> JsonTable:
        """Return the verdict with keys slot, state, text and quality, the report's figures.

        quality is {} if the merge failed.
        """
        quality = to_json(self.report) if self.report else {}
        return {"slot": self.slot, "state": self.state, "text": self.text, "quality": quality}


@dataclass(frozen=True, slots=True)
class _MergeJob:
    """What the merge of one bracket needs besides its files.

    The job contains no path, because it is sent to workers on other computers.
    """

    slot: str
    profile: CameraProfile
    profile_sha256: str
    heading_deg: float
    site: Site
    options: MergeOptions
    force: bool


def _recipe(job: _MergeJob, shots: list[Shot], t_utc: datetime, complete: bool) -> JsonTable:
    """Return everything that a panorama depends on, for its sidecar; equal recipes, equal pictures.

    shots: the bracket's frames; t_utc: its time; complete: whether it has all planned frames.
    `digest` of the result is a hash of all other keys.
    """
    keys = ("sha256", "heading_deg", "exposure")
    frames = [{"file": s.path.name} | {k: to_json(getattr(s, k)) for k in keys} for s in shots]
    inputs = {
        "recipe": _RECIPE,
        "frames": frames,
        "profile_sha256": job.profile_sha256,
        "height": job.options.height,
        "heading_deg": job.heading_deg,
        "t_utc": utc_text(t_utc),
        "complete": complete,
        "place_deg": [job.site.latitude_deg, job.site.longitude_deg],
        "fit": job.options.fit,
    }
    return {**inputs, "digest": digest(inputs)}


def _untouched(shots: list[Shot], sidecar: Path) -> bool:
    """Return whether no frame changed since the merge that wrote the sidecar, by the files' times.

    All frames must have a recorded sha256, with which that merge compared the files. This spares
    reading all frames of a session again.
    """
    if not sidecar.is_file() or not all(shot.sha256 for shot in shots):
        return False
    return max(s.path.stat().st_mtime_ns for s in shots) < sidecar.stat().st_mtime_ns


def _merged_before(session: Session, slot: str, recipe: JsonTable) -> Sidecar | None:
    """Return the sidecar of the slot's panorama if that was merged with the same recipe, else None.

    None too if the panorama or its sidecar is damaged.
    """
    path, picture = session.sidecar(slot), session.panorama(slot)
    table = current_note(path, recipe, [picture])
    with suppress(InputError):
        if table is not None and (sidecar := Sidecar.from_table(table, path)).fits(picture):
            return sidecar
    return None


def merge_slot(root: Path, job: _MergeJob) -> Verdict:
    """Merge one bracket of the session in the folder `root`, from frames to files.

    Writes the panorama and its sidecar, unless both exist from the same inputs. A bracket that
    cannot be merged gets the state "failed". Raises OSError for a fault of the computer, such as a
    full disk, because the bracket is not at fault.
    """
    session = Session(root)
    try:
        shots = shots_of_slot(session.capture_file(job.slot).parent)
        untouched = not job.force and _untouched(shots, session.sidecar(job.slot))
        shots = shots if untouched else verified(shots)
        capture = CaptureFile.find(session.capture_file(job.slot))
        t_of_frames = capture.t_mid_utc if capture is not None else middle_of(shots)
        t_utc = t_of_frames or parse_utc(job.slot)  # else the planned time
        complete = capture is None or capture.complete
        recipe = _recipe(job, shots, t_utc, complete)
        before = None if job.force else _merged_before(session, job.slot, recipe)
        if before is not None:
            return Verdict(job.slot, "kept", before.verdict, before.report)
        shots = verified(shots) if untouched else shots
        result, lost = _merge_readable(job, shots, expected_sun_deg(t_utc, job.site))
        result = replace(result, panorama=replace(result.panorama, t_utc=t_utc))
        result = _with_session_facts(result, job.profile, complete, lost)
        # Without a digest the slot is merged again once the missing frames are back.
        _write(session, job, result, {**recipe, "digest": ""} if lost else recipe)
        return Verdict(job.slot, "merged", result.verdict, result.report)
    except (FieldlumError, OSError) as error:
        if work.worker_fault(error):
            raise
        return Verdict(job.slot, "failed", str(error))


def _merge_readable(
    job: _MergeJob, shots: list[Shot], sun_deg: tuple[float, float] | None
) -> tuple[MergeResult, list[str]]:
    """Merge the readable frames, and return the names of the others.

    Raises InputError if less than half of the frames, or fewer than two, are readable. sun_deg:
    altitude and azimuth of the sun, None if it is unknown.
    """
    merged = partial(
        merge_shots,
        profile=job.profile,
        options=job.options,
        heading_deg=job.heading_deg,
        sun_deg=sun_deg,
        latitude_deg=job.site.latitude_deg,
    )
    try:
        return merged(shots), []
    except InputError:
        pixels = job.profile.camera.pixels
        lost = [s.path.name for s in shots if raw.unreadable(s.path, camera_pixels=pixels)]
        if not lost or len(shots) - len(lost) < max(2, len(shots) / 2):
            raise
        return merged([s for s in shots if s.path.name not in lost]), lost


def _with_session_facts(
    result: MergeResult, profile: CameraProfile, complete: bool, lost: list[str]
) -> MergeResult:
    """Return the result with what only the session knows: illuminance at the heading, lost frames.

    The verdict mentions lost and missing frames, and an uncertain sun. complete: whether all
    planned frames exist; lost: names of unreadable frames.
    """
    ev_lx = illuminance_ahead_lx(result.panorama, result.panorama.sun)
    report = structs.replace(result.report, vertical_illuminance_lx=ev_lx, lost=tuple(lost))
    text = result.verdict
    if not complete:
        text = f"incomplete bracket: not all planned frames exist; {text}"
    if lost:
        why = "because the pixels cannot be read: copy these frames from the card again"
        text = f"merged without {', '.join(lost)}, {why}; {text}"
    return replace(result, report=report, verdict=text + _sun_note(result, profile))


def _write(session: Session, job: _MergeJob, result: MergeResult, recipe: JsonTable) -> None:
    """Write the pictures, then the sidecar with the recipe as its inputs.

    The order makes an interruption harmless: a picture without a sidecar is merged again later.
    """
    picture = session.panorama(job.slot)
    with replacing_path(picture) as path:
        images.write_panorama(path, result.panorama)
    sky = session.sky_picture(job.slot)
    if result.sky is None:
        sky.unlink(missing_ok=True)  # of an earlier merge
    else:
        write_sky_picture(sky, result.sky)
    profile, sun = job.profile, result.panorama.sun
    sidecar_sun = None
    if sun is not None:
        sidecar_sun = SidecarSun(
            altitude_deg=sun.altitude_deg,
            azimuth_deg=sun.azimuth_deg,
            normal_illuminance_lx=sun.normal_illuminance_lx,
            u_mosaic_percent=round(100 * _sun_u_rel(profile), 2),
            origin=sun.origin,
            lower_bound=sun.origin == CLIPPED_SUN,
            measured=result.sun,
        )
    Sidecar(
        slot=job.slot,
        t_utc=result.panorama.t_utc,
        verdict=result.verdict,
        report=result.report,
        sun=sidecar_sun,
        factors={
            "k": profile.scale.k,
            "y_from_rgb": profile.colour.y_from_rgb,
            "u_percent": {
                "k": 100 * profile.scale.u_rel,
                "colour": 100 * profile.colour.u_rel,
                "glare_floor": 100 * profile.glare_floor_rel,
            },
        },
        profile={"name": profile.camera.name, "sha256": job.profile_sha256},
        inputs=recipe,
        sha256=sha256(picture),
        software={"fieldlum": __version__},
    ).write(session.sidecar(job.slot))


def _sun_u_rel(profile: CameraProfile) -> float:
    """Return the relative u of the sun's illuminance due to the mosaic, 0 for a JPEG camera."""
    return mosaic_u_rel(disc_px(profile.lens)) if profile.camera.kind == "raw" else 0.0


def _sun_note(result: MergeResult, profile: CameraProfile) -> str:
    """Return a note for the verdict if the sun disc's illuminance has an u of 2 % or more; else "".

    The cause is a disc that covers few sensor pixels. "" too for a sun that all frames clipped.
    """
    u_rel, sun = _sun_u_rel(profile), result.panorama.sun
    if sun is None or sun.origin == CLIPPED_SUN or u_rel < 0.02:
        return ""
    return (
        f"; the sun is only {disc_px(profile.lens):.1f} px wide on the sensor, so the uncertainty "
        f"of the sun's illuminance is {100 * u_rel:.0f} %"
    )


# ----------------------------------------------------------------------------------------------
# many brackets


def _units(
    session: Session, slots: Sequence[str], options: MergeOptions, force: bool
) -> list[work.WorkUnit]:
    """Return the merge of each slot as a unit of work for a scheduler."""
    setup, units = session.site_file(), []
    path = find_camera_profile(setup.camera.profile)
    of_camera = (load_camera_profile(path), sha256(path), setup.camera.heading_deg, setup.site)
    for slot in slots:
        job = _MergeJob(slot, *of_camera, options, force)
        note = session.capture_file(slot)
        files = (note.relative_to(session.root).as_posix(),) if note.is_file() else ()
        units.append(work.WorkUnit(slot, merge_slot, session.root, job, files=files))
    return units


def _verdict(outcome: work.UnitOutcome) -> Verdict:
    """Return the verdict of a finished unit of work: "failed" too if its workers failed.

    Raises other errors, which are defects of the program.
    """
    if isinstance(outcome.error, InputError | OSError):
        return Verdict(outcome.unit.name, "failed", str(outcome.error))
    return outcome.result()


def run(
    session: Session,
    options: MergeOptions | None = None,
    *,
    scheduler: work.Scheduler = work.LOCAL,
    force: bool = False,
) -> list[Verdict]:
    """Merge every captured slot that has no panorama from the same frames, profile and options.

    Write quality.csv and the contact sheets if a panorama is new. scheduler: where brackets are
    merged. force: merge slots with such a panorama again. Return one verdict for each captured
    slot, sorted by slot; slots that were not merged again have the state "kept". Raises
    NotEnoughDataError if nothing was captured, InputError if all brackets failed or session.toml or
    the camera profile is invalid, OSError if panoramas/ cannot be written.
    """
    slots = [folder.name for folder in session.captured_folders()]
    if not slots:
        raise NotEnoughDataError(f"{session.raw}: no captured slots; run fieldlum capture first")
    units = _units(session, slots, options or MergeOptions(), force)
    check_writable(session.panoramas)
    session.panoramas.mkdir(parents=True, exist_ok=True)
    verdicts: list[Verdict] = []
    work.run_each(units, scheduler, lambda outcome: verdicts.append(_verdict(outcome)))
    remove_scraps(session.panoramas)  # of workers killed in this run
    verdicts.sort(key=lambda v: v.slot)
    if summary_due(session):
        write_summary(session)
    elif session.quality.is_file():
        warn_if_changed(session.quality)
    if all(v.state == "failed" for v in verdicts):
        count, first = counted(len(verdicts), "bracket"), verdicts[0]
        found = f"0 of {count} could be merged; {first.slot}: {first.text}"
        raise InputError(session.raw, found, remedy="correct the cause and merge again")
    return verdicts


@contextmanager
def merging(session: Session, options: MergeOptions) -> Iterator[Callable[[str], object]]:
    """Give a function that starts the merge of a captured slot, by name, in another process.

    Capture goes on meanwhile; how a merge ends is not reported here. The folder panoramas/ is
    created at the start. Merges that have not begun at the end are cancelled: `run` merges those
    slots, and the ones that failed. Raises InputError if session.toml or the camera profile is
    invalid.
    """
    slots = [slot.id for slot in session.slots()]
    # False: not merged again if already merged
    units = dict(zip(slots, _units(session, slots, options, False), strict=True))
    session.panoramas.mkdir(parents=True, exist_ok=True)
    pool = work.start_pool(1)
    try:
        yield lambda slot: pool.submit(merge_slot, session.root, units[slot].argument)
    finally:
        pool.shutdown(cancel_futures=True)


# ----------------------------------------------------------------------------------------------
# all brackets: quality.csv and contact-1.png and so on, panoramas in false colour


# Layout of a sheet of 1 500 px that shows a day in a few rows: a thumbnail, its place with three
# lines of text, a page.
_WIDTH, _HEIGHT, _PLACE = 184, 92, (190, 138)
_PER_ROW, _PER_PAGE = 8, 96


def write_contact_sheets(session: Session, sidecars: Sequence[Sidecar]) -> None:
    """Write thumbnails of the panoramas to panoramas/contact-1.png and so on; remove older pages.

    One thumbnail for each sidecar, 96 on a page; its place stays white if the panorama is missing.
    False colour by log luminance from 1 to 10 000 cd/m2. Pixels with any flag are grey. Raises
    InputError for a panorama that cannot be read.
    """
    zone = ZoneInfo(session.site_file().site.timezone)
    for page in count(1):
        path = session.panoramas / f"contact-{page}.png"
        if on_page := sidecars[(page - 1) * _PER_PAGE : page * _PER_PAGE]:
            write_file(path, png_of(_sheet(session, on_page, zone)))
        elif path.is_file():
            path.unlink()
        else:
            return


def _sheet(session: Session, sidecars: Sequence[Sidecar], zone: ZoneInfo) -> NDArray[np.uint8]:
    """Return the picture of one page, RGB [H, W, 3], with the colour scale at its foot.

    sidecars: of the page's panoramas; zone: time zone of the times below them.
    """
    foot = -(-len(sidecars) // _PER_ROW) * _PLACE[1]
    sheet = np.full((foot + 34, _PER_ROW * _PLACE[0], 3), 255, np.uint8)
    for number, sidecar in enumerate(sidecars):
        x, y = number % _PER_ROW * _PLACE[0], number // _PER_ROW * _PLACE[1]
        local = f" {sidecar.t_utc.astimezone(zone):%H:%M}" if sidecar.t_utc else ""
        label = f"{sidecar.slot}{local} {sidecar.verdict.partition(':')[0]}"
        for line, text in enumerate(wrap(label, 30, max_lines=3, placeholder=" ...")):
            _write_text(sheet, text, (x + 2, y + _HEIGHT + 13 * (line + 1)))
        path = session.panorama(sidecar.slot)
        if path.is_file():
            sheet[y : y + _HEIGHT, x : x + _WIDTH] = _thumbnail(path)
    sheet[foot + 4 : foot + 16, 6:466] = coloured(np.geomspace(*RANGE_CDM2, 460))
    for k, text in enumerate(("1", "10", "100", "1000", "10 000 cd/m2")):
        _write_text(sheet, text, (6 + min(115 * k, 430), foot + 29))
    return sheet


def _write_text(sheet: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    """Write a small black text into the sheet; at: x, y of its lower left corner [px]."""
    cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)


def _thumbnail(path: Path) -> NDArray[np.uint8]:
    """Return a panorama as a thumbnail in false colour, RGB [_HEIGHT, _WIDTH, 3]."""
    panorama = images.read_panorama(path)
    flags = 0 if panorama.flags is None else panorama.flags
    light = np.where(flags, np.float32(np.nan), panorama.luminance_cdm2)
    small = cv2.resize(light, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_NEAREST)
    return coloured(np.asarray(small, np.float32))


def write_summary(session: Session) -> None:
    """Write contact sheets and quality.csv (`QUALITY_COLUMNS`) of all merged brackets.

    Raises InputError for a panorama that cannot be read. quality.csv, with its SHA-256 next to it,
    is written last, because `summary_due` compares its date with the sidecars'.
    """
    sidecars = [note for note in readable_sidecars(session.sidecar_files()) if note.report.frames]
    write_contact_sheets(session, sidecars)
    with sealed(session.quality):
        write_csv(session.quality, map(_row, sidecars), QUALITY_COLUMNS, digits=4)


def summary_due(session: Session) -> bool:
    """Return whether a panorama's sidecar is newer than quality.csv, or quality.csv is missing.

    The summary must then be written again. Without any sidecar it is not due.
    """
    path = session.quality
    written_ns = path.stat().st_mtime_ns if path.is_file() else -1
    return any(path.stat().st_mtime_ns > written_ns for path in session.sidecar_files())


QUALITY_COLUMNS = (
    *("slot", "t_utc", "verdict", "frames", "residual_percent", "exposure_span_percent"),
    *("shift_px", "shift_u_px", "motion_percent", "clipped_percent", "bloom_percent"),
    *("below_noise_percent", "outside_percent", "u_ratio_percent", "sun_lx", "sun_origin"),
    "vertical_illuminance_lx",
)
"""Of quality.csv; sun_lx: on a plane normal to the sun; an empty cell could not be determined."""


def _row(sidecar: Sidecar) -> JsonTable:
    """Return the row of a panorama in quality.csv: figures of the merge, and of the sun disc."""
    sun = sidecar.sun
    return {
        **structs.asdict(sidecar.report),
        "slot": sidecar.slot,
        "t_utc": sidecar.t_utc,
        "verdict": sidecar.verdict,
        "frames": len(sidecar.report.frames),
        "sun_lx": sun and sun.normal_illuminance_lx,
        "sun_origin": sun and sun.origin,
    }
