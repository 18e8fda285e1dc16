"""Take one bracket: store each frame as the camera wrote it, check it, and journal it."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import product
from pathlib import Path

from fieldlum.capture.disk_writer import Recorder
from fieldlum.capture.reconnect import Keeper, error_text, pause_s, plain_info
from fieldlum.capture.steady_clock import SteadyClock
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import CameraSetup, Exposure, Slot
from fieldlum.devices import Camera, IlluminanceMeter
from fieldlum.session import Session, disk_is_full, safe_paths, sha256, sync_folder
from fieldlum.session.files.capture_json import CaptureFile, Frame, frame_fields, interval_of
from fieldlum.session.folder import DeviceTable
from fieldlum.session.slot_states import SlotState

# After a longer pause between two frames the light may have changed. Not measured.
_MAX_FRAME_PAUSE_S = 60.0


@dataclass(frozen=True, slots=True)
class FrameChecks:
    """Checks of new frames; each returns a sentence on the fault, or "" for a good frame.

    settings: compares EXIF with the requested exposure; also returns the exposure to record.
    pixels: reads the pixels. darkest: checks whether over half of a bracket's darkest frame is
    clipped. By default every frame is accepted.
    """

    settings: Callable[[Path, Exposure], tuple[str, Exposure]] = lambda path, nominal: ("", nominal)
    pixels: Callable[[Path], str] = lambda path: ""
    darkest: Callable[[Path], str] = lambda path: ""


NO_CHECKS = FrameChecks()


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """One frame to take.

    index: its number in the bracket, from 0; heading_deg: azimuth of the view, clockwise from true
    north; None without a turned head.
    """

    index: int
    exposure: Exposure
    heading_deg: float | None

    @property
    def stem(self) -> str:
        """File name without suffix: index, shutter time, heading and filter (``03_0.5s_h90``)."""
        turned = "" if self.heading_deg is None else f"_h{self.heading_deg:g}"
        nd = f"_{self.exposure.nd}" if self.exposure.nd else ""
        return f"{self.index:02d}_{self.exposure.shutter_s:.6g}s{turned}{nd}"


@dataclass(slots=True)
class BracketCapture:
    """Takes the missing frames of one slot (`take`).

    setup: with the headings; camera: holds the camera; recorder: writes the journal. A doubtful
    frame is taken once more while the slot's window is open, unless an earlier second frame of the
    bracket is doubtful too. state: from the journal, with the frames already taken; deadline: the
    end of the slot's window. between: called with each new frame, and with None while waiting or
    reading pixels, to log irradiance and to refresh the display. meter: illuminance meter, read
    before the first and after the last frame, None without one; frame_bytes: size of the largest
    frame so far, for which the disk must have space. folder: of the slot's files; requests: all
    planned frames.
    """

    session: Session
    setup: CameraSetup
    camera: Keeper[Camera]
    recorder: Recorder
    clock: SteadyClock
    checks: FrameChecks
    between: Callable[[Frame | None], None]
    meter: Keeper[IlluminanceMeter] | None
    frame_bytes: int
    slot: Slot
    state: SlotState
    deadline: datetime
    folder: Path = field(init=False)
    requests: tuple[FrameRequest, ...] = field(init=False)

    def __post_init__(self) -> None:
        """Derive the slot's folder and its planned frames."""
        self.folder = self.session.capture_file(self.slot.id).parent
        self.requests = frame_requests(self.slot.exposures, self.setup)

    def take(self) -> SlotState:
        """Take the missing frames; return the slot's final state, done or aborted.

        After a failure, try again until the deadline.
        """
        if (link := safe_paths.link_on_the_way(self.session.root, self.folder)) is not None:
            return self.abort(f"{link} is a symbolic link: replace it by a folder")
        _delete_temporary_files(self.folder)
        times_full = 0  # failures because the disk was full
        if self.state.outcome == "":
            self._start(1)
        while True:
            self._restart_if_stale()
            if not self.state.frames:
                self._read_meter()
            taken = {frame.index for frame in self.state.frames}
            missing = [request for request in self.requests if request.index not in taken]
            if not missing:
                return self._check_pixels()
            try:
                frame = self._expose(missing[0])
            # A driver's defect may cost one frame, but must not end a capture of a month.
            except Exception as error:
                self._handle_failure(error)
                if disk_is_full(error):
                    times_full += 1
                    can_go_on = self._wait_for_space(pause_s(times_full))
                else:
                    can_go_on = self._wait_for(lambda: self.camera.get() is not None)
                if not can_go_on:
                    return self.abort(error_text(error))
                continue
            if not self.recorder.write_event("frame", slot=self.slot.id, frame=frame_fields(frame)):
                return self.abort("could not write the frame to the journal")
            self._store_in_state(frame)
            self.between(frame)
            self._retake(frame)

    def resumable(self) -> bool:
        """Return whether an interrupted bracket can be continued with the frames that it has.

        It can if all frames exist, or if one ended at most a minute ago (chosen), so that the light
        is still the same.
        """
        earliest = self.clock.now() - timedelta(seconds=_MAX_FRAME_PAUSE_S)
        ends = [frame.t_utc + timedelta(seconds=frame.seconds) for frame in self.state.frames]
        return len(ends) == len(self.requests) or any(end >= earliest for end in ends)

    def abort(self, why: str) -> SlotState:
        """Journal the slot as aborted for the reason `why`, and return its state.

        Its frames remain; capture.json records whether they are all that were planned.
        """
        frames = self.state.frames
        if safe_paths.link_on_the_way(self.session.root, self.folder) is None:
            _delete_temporary_files(self.folder)
            if frames:
                with suppress(OSError):  # the journal has the same content
                    self._write()
        self.recorder.write_event("aborted", slot=self.slot.id, frames=len(frames), why=why)
        return replace(self.state, outcome="aborted", why=why)

    def _store_in_state(self, frame: Frame) -> None:
        """Add a frame to the state; it replaces an earlier frame of the same index."""
        others = (other for other in self.state.frames if other.index != frame.index)
        self.state = replace(self.state, frames=(*others, frame))

    def _handle_failure(self, error: Exception) -> None:
        """Free space if the disk was full; after another error, close the camera to reopen it.

        After `_Away`, the error of a camera that is not open, nothing is closed.
        """
        _delete_temporary_files(self.folder)  # an incomplete frame takes up space
        if disk_is_full(error):
            self.recorder.release_reserve()
        elif not isinstance(error, _Away):
            self.camera.mark_lost(error)

    def _retake(self, doubtful: Frame) -> None:
        """Take a doubtful frame again while the slot's window is open.

        Do nothing for a frame without a doubt. Both files remain; the second one is used. If an
        earlier second frame of this bracket is doubtful too, nothing is taken again, because the
        cause is then a setting of the camera.
        """
        is_in_time = self.clock.now() + timedelta(seconds=doubtful.seconds) <= self.deadline
        was_futile = any(frame.instead_of and frame.doubt for frame in self.state.frames)
        if not doubtful.doubt or was_futile or not is_in_time:
            return
        try:
            second = self._expose(self.requests[doubtful.index], instead_of=doubtful.file)
        except Exception as error:  # the doubtful frame is already in the journal, so it is used
            self._handle_failure(error)
            return
        doubt = second.doubt or self.checks.pixels(self.folder / second.file)
        second = replace(second, doubt=doubt)
        fields = frame_fields(second)
        if self.recorder.write_event("retake", slot=self.slot.id, frame=fields, why=doubtful.doubt):
            self.between(second)
            self._store_in_state(second)

    def _check_pixels(self) -> SlotState:
        """Read the pixels of each frame after the last one; return the slot's final state.

        Take a frame again if it does not open and the slot's window is still open. Second frames
        were read when they were taken. A bracket of which most frames cannot be read is aborted,
        because it cannot be merged.
        """
        for frame in sorted(self.state.frames, key=lambda frame: frame.index):
            is_read = frame.doubt or frame.instead_of
            fault = "" if is_read else self.checks.pixels(self.folder / frame.file)
            if fault:
                doubtful = replace(frame, doubt=fault)
                self._store_in_state(doubtful)
                self._retake(doubtful)
            self.between(None)  # None: there is no new frame
        frames = self.state.frames
        lost = [f for f in frames if f.doubt and self.checks.pixels(self.folder / f.file)]
        if not lost or len(frames) - len(lost) >= max(2, len(frames) / 2):  # enough for `merge`
            return self._complete_bracket()
        shown = f"{lost[0].file}: {lost[0].doubt}"
        return self.abort(f"{len(lost)} of {len(frames)} frames cannot be read: {shown}")

    def _start(self, attempt: int) -> None:
        """Journal the start of an attempt (from 1), which has no frames yet."""
        self.recorder.write_event("started", slot=self.slot.id, attempt=attempt)
        self.state = SlotState("started", attempt)

    def _restart_if_stale(self) -> None:
        """Start the bracket again if it paused for too long; move its frames to a subfolder."""
        if not self.state.frames or self.resumable():
            return
        self.recorder.ensure_space(1 << 14)  # a new folder with its entries
        aside = self.folder / f"attempt-{self.state.attempt}"
        if aside.is_symlink():
            aside.unlink()
        aside.mkdir(exist_ok=True)
        for frame in self.state.frames:
            for name in (frame.file, frame.instead_of):
                if name and (self.folder / name).exists():
                    (self.folder / name).replace(aside / name)
        sync_folder(self.folder)
        self._start(self.state.attempt + 1)

    def _expose(self, request: FrameRequest, instead_of: str = "") -> Frame:
        """Take one frame, check its settings, give its file the final name, and return the frame.

        instead_of: name of the doubtful file that the frame replaces, "" for a first frame. Raises
        DeviceError or the driver's error if the camera fails, OSError if the disk does.
        """
        if self.camera.get() is None:
            raise _Away("the camera is away")
        self.recorder.ensure_space(self.frame_bytes)
        self.folder.mkdir(parents=True, exist_ok=True)
        begun_utc, begun_s, nominal = self.clock.now(), self.clock.boottime(), request.exposure
        # Each try has its own file name, so that a frame which a hung camera delivers late cannot
        # replace another.
        target = self.folder / f".{request.stem}.{os.getpid()}.{self.state.attempt}.{begun_s:.3f}"

        def take(camera: Camera) -> tuple[Path, Exposure]:
            """Return the file that the camera wrote, and the exposure that it reports.

            Without a report it is the planned exposure. camera: the opened one.
            """
            written = camera.expose(nominal, target, heading_deg=request.heading_deg)
            return written, camera.exposure_taken(written) or nominal

        written, taken = self.camera.call(take, nominal.shutter_s)
        seconds = self.clock.boottime() - begun_s
        doubt, taken = self.checks.settings(written, taken)
        final = written.with_name(f"{request.stem}{'_again' if instead_of else ''}{written.suffix}")
        if self.recorder.flush:
            with written.open("rb+") as file:
                os.fsync(file.fileno())
        written.replace(final)
        if self.recorder.flush:
            sync_folder(final.parent)
        self.frame_bytes = max(self.frame_bytes, final.stat().st_size)
        return Frame(
            index=request.index,
            file=final.name,
            exposure=taken,
            heading_deg=request.heading_deg,
            t_utc=begun_utc,
            seconds=round(seconds, 3),
            sha256=sha256(final),
            doubt=doubt,
            instead_of=instead_of,
        )

    def _wait_for_space(self, least_s: float) -> bool:
        """Wait until a frame fits on the disk; return whether it does before the deadline.

        Wait at least `least_s`, because free space does not show that a disk quota is exhausted.
        """
        earliest = self.clock.now() + timedelta(seconds=least_s)
        missing, size = self.recorder.missing_bytes, self.frame_bytes
        return self._wait_for(lambda: self.clock.now() >= earliest and not missing(size))

    def _wait_for(self, is_ready: Callable[[], bool]) -> bool:
        """Wait until `is_ready()`; return whether it became so before the deadline.

        It is tried every second; in between irradiance is logged and the display refreshed.
        """
        while self.clock.now() < self.deadline:
            if is_ready():
                return True
            self.clock.sleep(1.0)
            self.between(None)  # None: there is no new frame
        return False

    def _complete_bracket(self) -> SlotState:
        """Write capture.json and the journal's entry of a bracket with all its frames.

        The state's `why` gets the doubts about frames, and the fault of the darkest one.
        """
        self._read_meter()
        frames = self.state.frames
        notes = [f"{f.file} taken again" for f in frames if f.instead_of and not f.doubt]
        notes += [f"{f.file}: {f.doubt}" for f in frames if f.doubt]
        exposures = [frame.exposure for frame in frames]
        # Frames through a filter (False) are darker than all others (True).
        light = [(e.nd == "", e.shutter_s / e.f_number**2) for e in exposures]
        darkest = frames[light.index(min(light))]
        if text := self.checks.darkest(self.folder / darkest.file):
            notes.append(f"{darkest.file}: {text}")
        try:
            self._write()
        except OSError as error:
            if not disk_is_full(error):
                raise
            self.recorder.release_reserve()  # capture.json needs only a few kilobytes
            self._write()
        why = "; ".join(notes)
        self.recorder.write_event("done", slot=self.slot.id, frames=len(frames), why=why)
        return replace(self.state, outcome="done", why=why)

    def _read_meter(self) -> None:
        """Journal the illuminance at the lens [lx]; a failing meter does not affect the bracket."""
        if self.meter is None or self.meter.get() is None:
            return
        try:
            lux = self.meter.call(lambda meter: meter.read())
        except Exception as error:  # as with the other devices
            self.meter.mark_lost(error)
            return
        self.recorder.write_event("illuminance", slot=self.slot.id, illuminance_lx=lux)
        self.state = replace(self.state, illuminance_lx=(*self.state.illuminance_lx, lux))

    def _write(self) -> None:
        """Write capture.json with the frames taken so far."""
        camera = self.camera.get()
        info = plain_info(camera.info) if camera is not None else {}
        is_complete = len(self.state.frames) == len(self.requests)
        write_capture(self.folder, self.slot, self.state, self.setup, info, complete=is_complete)


def _delete_temporary_files(folder: Path) -> None:
    """Delete the files of incomplete frames in a slot's folder; their names begin with a point."""
    with suppress(OSError):
        for scrap in folder.glob(".*"):
            scrap.unlink(missing_ok=True)


class _Away(DeviceError):
    """The camera is away, and the journal already has the event."""


def frame_requests(exposures: Sequence[Exposure], setup: CameraSetup) -> tuple[FrameRequest, ...]:
    """Return the frames of a bracket: all exposures at the first heading, then at the next.

    setup: with the headings; without any, the frames have the heading None.
    """
    pairs = product(setup.headings or (None,), exposures)
    return tuple(FrameRequest(i, exposure, heading) for i, (heading, exposure) in enumerate(pairs))


def write_capture(
    folder: Path,
    slot: Slot,
    state: SlotState,
    setup: CameraSetup,
    camera: DeviceTable,
    *,
    complete: bool,
) -> None:
    """Write capture.json, from which `merge` reads a slot's frames, into the slot's folder.

    The file is complete or absent. folder: raw/SLOT; state: with the frames and the illuminances
    [lx], whose mean is written; setup: whose profile and heading are written; complete: whether all
    planned frames were taken; camera: what the camera reports about itself. Raises ValueError if
    the state has no frame, OSError if the file cannot be written.
    """
    frames = tuple(sorted(state.frames, key=lambda frame: frame.index))
    readings_lx = state.illuminance_lx
    opened_utc, closed_utc = interval_of(frames)
    capture = CaptureFile(
        slot=slot.id,
        frames=frames,
        t_open_utc=opened_utc,
        t_close_utc=closed_utc,
        complete=complete,
        profile=setup.profile,
        heading_deg=setup.heading_deg,
        camera=camera,
        illuminance_lx=sum(readings_lx) / len(readings_lx) if readings_lx else None,
    )
    capture.write(folder / "capture.json")
