"""Replay existing frames as a camera, for rehearsals: ``replay:FOLDER``.

Each frame of the folder is returned once, in the order of the camera's clock, for the first
exposure that it matches.
"""

import shutil
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from msgspec import Struct

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import Exposure
from fieldlum.devices import Camera, CameraInfo, DeviceUri
from fieldlum.devices.clock import Clock
from fieldlum.optics.exposure import same_exposure
from fieldlum.optics.raw import FrameInfo, frame_files, read_exif
from fieldlum.session import Session, exposure_text


def frames_of(folder: Path) -> list[tuple[Path, FrameInfo]]:
    """Return the path and the EXIF of all frames in a folder and its subfolders.

    They are in order of the camera's clock, then of the path; frames without a time are last. Files
    without an exposure in their EXIF are skipped. Raises DeviceError if no frame remains.
    """
    paths, frames = [], []
    with suppress(InputError):
        paths = frame_files(folder, deep=True)
    for path in paths:
        with suppress(InputError):
            frames.append((path, read_exif(path)))
    if not frames:
        expected = "expected raw or JPEG files with their exposure in EXIF"
        raise DeviceError(f"replay: no frames in {folder}; {expected}; name another folder")

    def camera_time(frame: tuple[Path, FrameInfo]) -> datetime:
        """Return a frame's time on the camera's clock, read as UTC if it has no zone.

        A frame without a time gets the last time that Python has.
        """
        t_camera = frame[1].t_camera or datetime.max.replace(tzinfo=UTC)
        return t_camera if t_camera.tzinfo else t_camera.replace(tzinfo=UTC)

    return sorted(frames, key=camera_time)


class ReplayCamera(Camera):
    """A camera that returns copies of frames which were taken before.

    Raises DeviceError if the folder and its subfolders have no frame.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._clock = clock
        self._unused = frames_of(folder)
        first = self._unused[0][1]
        self.info = CameraInfo("replay", make=first.make, model=first.model)

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Copy the next unused frame with this exposure to `target` plus its suffix.

        Return the copy, after the shutter time. heading_deg is ignored. Raises DeviceError if no
        such frame is left, OSError if the disk is full.
        """
        for i, (path, info) in enumerate(self._unused):
            # EXIF does not state a filter
            if same_exposure(info.exposure, exposure) and info.exposure.nd in ("", exposure.nd):
                del self._unused[i]
                written = target.with_name(f"{target.name}{path.suffix.lower()}")
                shutil.copyfile(path, written)
                self._clock.sleep(exposure.shutter_s)
                return written
        found = f"no unused frame of {exposure_text(exposure)}, only {len(self._unused)} of others"
        raise DeviceError(f"replay: {found}; plan what the folder has")


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> ReplayCamera:
    """Open the folder in a URI ``replay:FOLDER`` as a camera that returns its frames.

    session: not used. Raises DeviceError for any option, for a missing folder, or one without
    frames.
    """
    uri.read(Struct)
    folder = Path(uri.place)
    if not uri.place or not folder.is_dir():
        raise DeviceError(f"{uri.text}: no such folder; expected replay:FOLDER; correct the path")
    return ReplayCamera(folder, clock)
