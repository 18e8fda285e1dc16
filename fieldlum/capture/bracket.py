"""Take one bracket: store each frame as the camera wrote it, check it, and journal it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from fieldlum.capture.reconnect import FIRST_PAUSE_S, MAX_PAUSE_S, Keeper, error_text, plain_info
from fieldlum.capture.recorder import Recorder
from fieldlum.capture.utc_clock import SteadyClock
from fieldlum.capture.verify import as_taken
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import CameraSetup, Exposure, Slot
from fieldlum.devices import BracketingCamera, Camera, IlluminanceMeter, ReportingCamera
from fieldlum.devices.clock import Backoff
from fieldlum.session import Session, disk_is_full, sha256, sync_folder
from fieldlum.session.files.capture_json import CaptureFile, Frame, frame_fields, interval_of
from fieldlum.session.inside import link_on_the_way
from fieldlum.session.ledger import SlotState
from fieldlum.session.tables import DeviceTable

STALE_S = 60.0  # after a longer pause between frames the light may have changed; not measured
_FOLDER_BYTES = 1 << 14  # a new folder with its entries; not measured


@dataclass(frozen=True, slots=True)
class FrameChecks:
    """Checks of new frames; each returns what is wrong, or nothing ("") if the frame is good.

    settings: compares EXIF with the requested exposure; pixels: reads the pixels; darkest: checks
    whether over half of a bracket's darkest frame is clipped. By default every frame is accepted.
    """

    settings: Callable[[Path, Exposure], str] = lambda path, exposure: ""
    pixels: Callable[[Path], str] = lambda path: ""
    darkest: Callable[[Path], str] = lambda path: ""


NO_CHECKS = FrameChecks()


@dataclass(slots=True)
class BracketCapture:
    """Takes the frames of slots, one slot after the other (`take`).

    A doubtful frame is taken once more while the slot's window is open, unless an earlier second
    frame of the bracket is doubtful too. between: called with each frame, and with
    None while waiting, to log irradiance and to refresh the display. meter: illuminance meter, read
    before the first and after the last frame of each slot, None without one; frame_bytes: size of
    the largest frame so far, for which the disk must have space.
    """

    session: Session
    setup: CameraSetup
    camera: Keeper[Camera]
    recorder: Recorder
    clock: SteadyClock
    checks: FrameChecks
    between: Callable[[Frame | None], None]
    meter: Keeper[IlluminanceMeter] | None = None
    frame_bytes: int = 0

    def take(self, slot: Slot, state: SlotState, deadline: datetime) -> SlotState:
        """Take the missing frames of a slot; return its final state, done or aborted.

        state: from the journal, with the frames already taken. After a failure, try again until
        `deadline`, the end of the slot's window.
        """
        folder = self.session.capture_file(slot.id).parent
        wanted = shots(slot.exposures, self.setup)
        if (link := link_on_the_way(self.session.root, folder)) is not None:
            return self.abort(slot, state, f"{link} is a symbolic link: replace it by a folder")
        _sweep(folder)
        disk = Backoff(FIRST_PAUSE_S, MAX_PAUSE_S)
        if state.outcome == "":
            state = self._start(slot, 1)
        while True:
            state = self._not_too_old(slot, folder, state)
            if not state.frames:
                state = self._read_meter(slot, state)
            have = {frame.index for frame in state.frames}
            missing = [shot for shot in wanted if shot.index not in have]
            if not missing:
                return self._complete(slot, folder, state, wanted, deadline)
            try:
                is_whole = not have and self._takes_whole_brackets(wanted)
                taken = self._expose(missing if is_whole else missing[:1], folder, state.attempt)
            # A driver's defect may cost one frame, but must not end a capture of a month.
            except Exception as error:
                self._failed(error, folder)
                if disk_is_full(error):
                    can_go_on = self._wait_for_room(deadline, disk.next_s())
                else:
                    can_go_on = self._wait_for(lambda: self.camera.get() is not None, deadline)
                if not can_go_on:
                    return self.abort(slot, state, error_text(error))
                continue
            for frame in taken:
                if not self.recorder.tell("frame", slot=slot.id, frame=frame_fields(frame)):
                    return self.abort(slot, state, "could not write the frame to the journal")
                state = replace(state, frames=(*state.frames, frame))
                self.between(frame)
            for frame in taken:
                state = self._again(slot, folder, state, wanted[frame.index], frame, deadline)

    def _failed(self, error: Exception, folder: Path) -> None:
        """Free the reserve after a full disk; drop the camera after another error of it."""
        _sweep(folder)  # an incomplete frame takes up space
        if disk_is_full(error):
            self.recorder.make_room()
        elif not isinstance(error, _Away):
            self.camera.lost(error)

    def resumable(self, slot: Slot, state: SlotState) -> bool:
        """Return whether all frames exist, or the last one ended at most a minute ago.

        Without a frame it is False.
        """
        if len(state.frames) == len(shots(slot.exposures, self.setup)):
            return True
        return bool(state.frames) and self._pause_s(state) <= STALE_S

    def _pause_s(self, state: SlotState) -> float:
        last = max(state.frames, key=lambda frame: frame.t_utc)
        return (self.clock.now() - last.t_utc).total_seconds() - last.seconds

    def _again(
        self,
        slot: Slot,
        folder: Path,
        state: SlotState,
        shot: FrameRequest,
        doubtful: Frame,
        deadline: datetime,
    ) -> SlotState:
        """Take a doubtful frame again while the slot's window is open.

        Both files remain; the second one is used. If an earlier second frame of this bracket is
        doubtful too, nothing is taken again, because the cause is then a setting of the camera.
        """
        in_time = self.clock.now() + timedelta(seconds=doubtful.seconds) <= deadline
        in_vain = any(frame.instead_of and frame.doubt for frame in state.frames)
        if not doubtful.doubt or in_vain or not in_time:
            return state
        try:
            (second,) = self._expose([shot], folder, state.attempt, instead_of=doubtful.file)
        except Exception as error:  # the doubtful frame is already in the journal, so it is used
            self._failed(error, folder)
            return state
        second = replace(second, doubt=second.doubt or self.checks.pixels(folder / second.file))
        fields = frame_fields(second)
        if not self.recorder.tell("retake", slot=slot.id, frame=fields, why=doubtful.doubt):
            return state
        self.between(second)
        return _with_frame(state, second)

    def _complete(
        self,
        slot: Slot,
        folder: Path,
        state: SlotState,
        wanted: Sequence[FrameRequest],
        deadline: datetime,
    ) -> SlotState:
        """Read the pixels of each frame after the camera has finished; return the final state.

        Take a frame again if it does not open and the slot's window is still open. Second frames
        were read when they were taken. A bracket of which most frames cannot be read is aborted,
        because it cannot be merged.
        """
        for frame in sorted(state.frames, key=lambda frame: frame.index):
            if not (frame.doubt or frame.instead_of) and (
                why := self.checks.pixels(folder / frame.file)
            ):
                doubtful = replace(frame, doubt=why)
                state = _with_frame(state, doubtful)
                state = self._again(slot, folder, state, wanted[frame.index], doubtful, deadline)
            self.between(None)
        lost = [f for f in state.frames if f.doubt and self.checks.pixels(folder / f.file)]
        count = len(state.frames)
        if not lost or count - len(lost) >= max(2, count / 2):  # `merge` needs so many
            return self._finish(slot, folder, state)
        why = f"{len(lost)} of {count} frames cannot be read: {lost[0].file}: {lost[0].doubt}"
        return self.abort(slot, state, why)

    def _start(self, slot: Slot, attempt: int) -> SlotState:
        self.recorder.tell("started", slot=slot.id, attempt=attempt)
        return SlotState("started", attempt)

    def _not_too_old(self, slot: Slot, folder: Path, state: SlotState) -> SlotState:
        """Start the bracket again if its pause is too long; move its frames to a subfolder."""
        if not state.frames or self.resumable(slot, state):
            return state
        self.recorder.claim(_FOLDER_BYTES)
        aside = folder / f"attempt-{state.attempt}"
        if aside.is_symlink():
            aside.unlink()
        aside.mkdir(exist_ok=True)
        for frame in state.frames:
            for name in (frame.file, frame.instead_of):
                if name and (folder / name).exists():
                    (folder / name).replace(aside / name)
        sync_folder(folder)
        return self._start(slot, state.attempt + 1)

    def _expose(
        self, wanted: Sequence[FrameRequest], folder: Path, attempt: int, instead_of: str = ""
    ) -> list[Frame]:
        """Take one frame, or all frames of a bracket in one call; return them only if all exist."""
        if self.camera.get() is None:
            raise _Away("the camera is away")
        self.recorder.claim(self.frame_bytes * len(wanted))
        folder.mkdir(parents=True, exist_ok=True)
        begun, boot = self.clock.now(), self.clock.boottime()
        exposures = [shot.exposure for shot in wanted]
        # Each try has its own file name, so that a frame which a hung camera delivers late cannot
        # replace another.
        targets = [folder / f".{s.stem}.{os.getpid()}.{attempt}.{boot:.3f}" for s in wanted]

        def take(camera: Camera) -> list[Path]:
            if len(wanted) == 1:
                heading_deg = wanted[0].heading_deg
                return [camera.expose(exposures[0], targets[0], heading_deg=heading_deg)]
            if not isinstance(camera, BracketingCamera):
                raise DeviceError("another camera was connected, which takes single frames")
            return camera.expose_bracket(exposures, targets)

        files = self.camera.call(take, sum(e.shutter_s for e in exposures))
        each_s = (self.clock.boottime() - boot) / len(wanted)
        return [
            self._stored(s, path, begun + timedelta(seconds=k * each_s), each_s, instead_of)
            for k, (s, path) in enumerate(zip(wanted, files, strict=True))
        ]

    def _stored(
        self, shot: FrameRequest, written: Path, begun: datetime, seconds: float, instead_of: str
    ) -> Frame:
        """Check a new frame, give it its final name, and return it.

        begun, seconds: UTC of the request, and the time that the frame took [s].
        """
        camera, exposure = self.camera.get(), shot.exposure
        if isinstance(camera, ReportingCamera):
            exposure = camera.exposure_taken(written) or exposure
        if doubt := self.checks.settings(written, exposure):
            exposure = as_taken(written, exposure)
        final = written.with_name(f"{shot.stem}{'_again' if instead_of else ''}{written.suffix}")
        if self.recorder.flush:
            with written.open("rb+") as file:
                os.fsync(file.fileno())
        written.replace(final)
        if self.recorder.flush:
            sync_folder(final.parent)
        self.frame_bytes = max(self.frame_bytes, final.stat().st_size)
        return Frame(
            shot.index,
            final.name,
            exposure,
            shot.heading_deg,
            begun,
            seconds,
            sha256(final),
            doubt,
            instead_of,
        )

    def _takes_whole_brackets(self, wanted: Sequence[FrameRequest]) -> bool:
        """Return whether the camera can take these frames as one bracket by itself.

        This is several times faster than frame by frame.
        """
        camera = self.camera.get()
        still = all(shot.heading_deg is None and not shot.exposure.nd for shot in wanted)
        return (
            still and isinstance(camera, BracketingCamera) and len(wanted) in camera.bracket_shots
        )

    def _wait_for_room(self, deadline: datetime, pause_s: float) -> bool:
        """Wait until a frame fits on the disk; return False at the deadline.

        Wait at least `pause_s`, because free space does not show that a disk quota is exhausted.
        """
        earliest = self.clock.now() + timedelta(seconds=pause_s)

        def has_room() -> bool:
            late_enough = self.clock.now() >= earliest
            return late_enough and not self.recorder.missing_bytes(self.frame_bytes)

        return self._wait_for(has_room, deadline)

    def _wait_for(self, ready: Callable[[], bool], deadline: datetime) -> bool:
        while self.clock.now() < deadline:
            if ready():
                return True
            self.clock.sleep(1.0)
            self.between(None)
        return False

    def _finish(self, slot: Slot, folder: Path, state: SlotState) -> SlotState:
        state = self._read_meter(slot, state)
        doubts = [f"{frame.file}: {frame.doubt}" for frame in state.frames if frame.doubt]
        again = [f"{f.file} taken again" for f in state.frames if f.instead_of and not f.doubt]
        darkest = min(
            state.frames,
            key=lambda f: (f.exposure.nd == "", f.exposure.shutter_s / f.exposure.f_number**2),
        )
        if text := self.checks.darkest(folder / darkest.file):
            doubts.append(f"{darkest.file}: {text}")
        try:
            self._write(folder, slot, state)
        except OSError as error:
            if not disk_is_full(error):
                raise
            self.recorder.make_room()  # frees the reserve; capture.json has a few kilobytes
            self._write(folder, slot, state)
        why = "; ".join(again + doubts)
        self.recorder.tell("done", slot=slot.id, frames=len(state.frames), why=why)
        return replace(state, outcome="done", why=why)

    def _read_meter(self, slot: Slot, state: SlotState) -> SlotState:
        """Read the illuminance at the lens. A failing meter does not affect the bracket."""
        if self.meter is None or self.meter.get() is None:
            return state
        try:
            reading = self.meter.call(lambda meter: meter.read())
        except Exception as error:  # as with the other devices
            self.meter.lost(error)
            return state
        self.recorder.tell("illuminance", slot=slot.id, illuminance_lx=reading.illuminance_lx)
        return replace(state, illuminance_lx=(*state.illuminance_lx, reading.illuminance_lx))

    def abort(self, slot: Slot, state: SlotState, why: str) -> SlotState:
        """Journal a slot as aborted for the reason `why`, and return its state.

        Its frames remain; capture.json records whether they are all that were planned.
        """
        folder = self.session.capture_file(slot.id).parent
        if link_on_the_way(self.session.root, folder) is None:
            _sweep(folder)
            if state.frames:
                with suppress(OSError):  # the journal has the same content
                    self._write(folder, slot, state)
        self.recorder.tell("aborted", slot=slot.id, frames=len(state.frames), why=why)
        return replace(state, outcome="aborted", why=why)

    def _write(self, folder: Path, slot: Slot, state: SlotState) -> None:
        camera = self.camera.get()
        info = plain_info(camera.info) if camera is not None else {}
        is_complete = len(state.frames) == len(shots(slot.exposures, self.setup))
        write_capture(folder, slot, state, self.setup, info, complete=is_complete)


def _with_frame(state: SlotState, frame: Frame) -> SlotState:
    """Return a state with a frame in place of the one of the same index."""
    others = (other for other in state.frames if other.index != frame.index)
    return replace(state, frames=(*others, frame))


def _sweep(folder: Path) -> None:
    """Delete temporary files of frames that were never journalled."""
    with suppress(OSError):
        for scrap in folder.glob(".*"):
            scrap.unlink(missing_ok=True)


class _Away(DeviceError):
    """The camera is away, which was already reported."""


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """One frame to take: its number in the bracket (from 0), its exposure, and the heading.

    heading_deg: clockwise from north; None without a turned head.
    """

    index: int
    exposure: Exposure
    heading_deg: float | None

    @property
    def stem(self) -> str:
        """File name without suffix: index, shutter time, heading and filter (``03_0.5s_h90``)."""
        turned = "" if self.heading_deg is None else f"_h{self.heading_deg:g}"
        return f"{self.index:02d}_{self.exposure.shutter_s:.6g}s{turned}" + (
            f"_{self.exposure.nd}" if self.exposure.nd else ""
        )


def shots(exposures: Sequence[Exposure], setup: CameraSetup) -> tuple[FrameRequest, ...]:
    """Return the frames of a bracket: all exposures at the first heading, then at the next."""
    headings: tuple[float | None, ...] = setup.headings or (None,)
    pairs = [(exposure, heading) for heading in headings for exposure in exposures]
    return tuple(FrameRequest(i, exposure, heading) for i, (exposure, heading) in enumerate(pairs))


def write_capture(
    folder: Path,
    slot: Slot,
    state: SlotState,
    setup: CameraSetup,
    camera: DeviceTable,
    *,
    complete: bool,
) -> None:
    """Write capture.json about a slot's frames into its folder, atomically, for merge.

    complete: whether all planned frames were taken; camera: what the camera reports about itself.
    Raises ValueError if the state has no frame.
    """
    frames = tuple(sorted(state.frames, key=lambda frame: frame.index))
    readings = state.illuminance_lx
    CaptureFile(
        slot.id,
        frames,
        *interval_of(frames),
        complete,
        setup.profile,
        setup.heading_deg,
        camera,
        sum(readings) / len(readings) if readings else None,
    ).write(folder / "capture.json")
