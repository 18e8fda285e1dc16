"""Drive a Raspberry Pi camera through the program rpicam-still: ``rpicam:``, ``rpicam:1``.

The place is the camera's number (default 0). Options: ``f_number`` of the lens, which no frame
states, and ``program`` for another path of rpicam-still. Each frame is a raw DNG with fixed
shutter, gain and white balance. Its exposure comes from the metadata that the program writes,
because the sensor exposes for an integer number of lines: 60 us gives 114 us on one module.

Source: rpicam-apps (options, the metadata's keys, the list of cameras). Untested on hardware.
"""

import errno
import math
import os
import re
import signal
import subprocess
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct, field, json

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, shutter_text
from fieldlum.devices import Camera, CameraInfo, DeviceUri
from fieldlum.devices.clock import Clock
from fieldlum.optics.exposure import SAME_SETTING_EV
from fieldlum.session import Session

PROGRAM = "rpicam-still"
# Start of the camera stack, and number of frames that it discards before the one that it writes.
# Long exposures take several times their length (rpicam-apps and its predecessor report up to 7).
# The first value is chosen.
START_S = 20.0
DISCARDED_FRAMES = 7.0
# Analogue gain has steps of a few percent. A digital gain above 1 means that the sensor could not
# expose so long (an OV5647 set to 6 s gives 1.06 s and a digital gain of 4). Chosen.
GAIN_TOLERANCE = 0.03
ISO_OF_GAIN_1 = 100.0  # rpicam-apps writes ISO = 100 times the gain into its DNGs
_Positive = Annotated[float, Meta(gt=0.0)]
_CAMERA_LINE = re.compile(r"(?m)^(\d+) : (\S+) \[")


class FrameMetadata(Struct, frozen=True):
    """What rpicam-still reports about a frame: shutter time [us] and two gains (factors).

    In its JSON they are ExposureTime, AnalogueGain and DigitalGain.
    """

    shutter_us: _Positive = field(name="ExposureTime")
    analogue_gain: _Positive = field(name="AnalogueGain")
    digital_gain: _Positive = field(default=1.0, name="DigitalGain")

    @property
    def shutter_s(self) -> float:
        """Shutter time [s]."""
        return self.shutter_us * 1e-6

    def exposure(self, planned: Exposure) -> Exposure:
        """Return the exposure that the sensor took; aperture and filter are those of `planned`.

        The ISO is 100 times the analogue gain, or the planned ISO if that differs by at most 3 %.
        """
        iso = ISO_OF_GAIN_1 * self.analogue_gain
        is_planned = abs(iso / planned.iso - 1.0) <= GAIN_TOLERANCE
        return replace(planned, shutter_s=self.shutter_s, iso=planned.iso if is_planned else iso)


def parse_metadata(text: str) -> FrameMetadata:
    """Return the metadata of a frame in the JSON text that rpicam-still wrote about it.

    A missing digital gain is 1. Raises DeviceError for any other text, and for numbers that are not
    above 0 and finite.
    """
    try:
        return json.decode(text, type=FrameMetadata)
    except (ValueError, RecursionError) as error:
        found = f"{str(error)[:120]}; expected JSON with ExposureTime and AnalogueGain above 0"
        raise DeviceError(f"rpicam: metadata: {found}; install a newer rpicam-apps") from None


def parse_cameras(text: str) -> dict[int, str]:
    """Return the names of sensors, such as imx477, by camera number; empty without a camera.

    text: what `rpicam-still --list-cameras` prints.
    """
    return {int(m[1]): m[2] for m in _CAMERA_LINE.finditer(text)}


class RpicamCamera(Camera):
    """A Raspberry Pi camera, which reports the exposure that it took.

    Raises DeviceError if the program is missing or fails, or does not list the camera.
    """

    def __init__(self, place: str, f_number: float, *, program: str) -> None:
        """Find the camera in the list that the program prints.

        place: the camera's number as a text, "" for 0; f_number: of its lens; program: name or path
        of rpicam-still.
        """
        self._program, self._f_number, self._start_s = program, f_number, START_S
        if not (place == "" or place.isdigit()):
            raise DeviceError(f"rpicam:{place}: name the camera by its number, such as rpicam:0")
        self._number = int(place or 0)
        cameras = parse_cameras(self._run(["--list-cameras"], START_S))
        if self._number not in cameras:
            listed = ", ".join(f"{n} ({name})" for n, name in cameras.items())
            listed = listed or "none: check the ribbon cable, then restart"
            raise DeviceError(f"rpicam: no camera {self._number}; {PROGRAM} names {listed}")
        model = cameras[self._number]
        self.info = CameraInfo("rpicam", make="Raspberry Pi", model=model, clock_offset_s=0.0)
        self._taken: dict[Path, Exposure] = {}  # of the newest frame, by its file

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one raw frame and return its file, `target` plus .dng.

        heading_deg must be None. The frame's shutter time may differ from the planned one: see
        `exposure_taken`. Raises DeviceError for a heading, or if the module or the program fails or
        cannot take this exposure, and OSError if the disk is full.
        """
        self.refuse_turning(heading_deg)
        self.check_offered(exposure)
        # The program writes the raw frame next to the picture that it is requested to write.
        ends = (".dng", ".jpg", ".json")
        written, picture, about = (target.with_name(f"{target.name}{end}") for end in ends)
        try:
            timeout_s = self._start_s + DISCARDED_FRAMES * exposure.shutter_s
            arguments = [
                *("--camera", str(self._number), "--nopreview", "--immediate", "--raw"),
                *("--shutter", str(max(1, round(exposure.shutter_s * 1e6)))),
                *("--gain", f"{exposure.iso / ISO_OF_GAIN_1:g}", "--awbgains", "1,1"),
                *("--denoise", "off", "--metadata", str(about), "--metadata-format", "json"),
                *("--output", str(picture)),
            ]
            self._run(arguments, timeout_s)
            if not about.is_file():
                raise DeviceError("rpicam: no metadata, so no known exposure; update rpicam-apps")
            metadata = parse_metadata(about.read_text(encoding="utf-8", errors="replace"))
            _check_taken(metadata, exposure)
            size = written.stat().st_size if written.is_file() else 0
            if size < 100_000:  # that of the smallest module has over a million
                raise DeviceError(f"rpicam: a raw frame of only {size} bytes; check the cable")
        except BaseException:
            written.unlink(missing_ok=True)
            raise
        finally:
            picture.unlink(missing_ok=True)
            about.unlink(missing_ok=True)
        self._taken = {written: metadata.exposure(exposure)}
        return written

    def exposure_taken(self, written: Path) -> Exposure | None:
        """Return the true exposure of the newest frame, by its metadata; None for other files."""
        return self._taken.get(written)

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError for an aperture over 2 % from the lens's, and for an ISO below 97."""
        if abs(exposure.f_number / self._f_number - 1.0) > 0.02:
            found = f"f/{exposure.f_number:g} is planned, and the lens has f/{self._f_number:g}"
            remedy = "state f_number=... in the URI, or correct [bracket] of the profile and plan"
            raise DeviceError(f"rpicam: {found}; {remedy}")
        if exposure.iso < ISO_OF_GAIN_1 * (1.0 - GAIN_TOLERANCE):
            found = f"ISO {exposure.iso:g} would need a gain below 1"
            raise DeviceError(f"rpicam: {found}; plan with ISO 100 or more")

    def _run(self, arguments: list[str], timeout_s: float) -> str:
        """Run the program with some arguments, and return what it prints.

        After `timeout_s` it counts as hung, and is killed with all processes that it started.
        Raises DeviceError if it does not start, hangs or fails, OSError if the disk is full.
        """
        command, pipe = [self._program, *arguments], subprocess.PIPE
        how: dict[str, Any] = {"stdout": pipe, "stderr": subprocess.STDOUT, "errors": "replace"}
        how |= {"stdin": subprocess.DEVNULL, "start_new_session": True}
        try:
            process = subprocess.Popen(command, **how)
        except OSError as error:
            why, remedy = error.strerror, "install it with: sudo apt install rpicam-apps"
            raise DeviceError(f"rpicam: {self._program} does not start ({why}); {remedy}") from None
        with process:
            try:
                printed: str = process.communicate(timeout=timeout_s)[0]
            except BaseException as error:
                with suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                if not isinstance(error, subprocess.TimeoutExpired):
                    raise
                why = f"{PROGRAM} did not end within {timeout_s:.0f} s and was killed"
                raise DeviceError(f"rpicam: {why}; check the camera's cable") from None
        if "No space left on device" in printed:
            raise OSError(errno.ENOSPC, "No space left on device")
        if process.returncode != 0 or "ERROR: ***" in printed:
            lines = [line.strip() for line in printed.splitlines() if line.strip()]
            errors = [line for line in lines if "ERROR" in line]
            why = f"{(errors or lines or ['nothing printed'])[-1][:200]}; run it in a terminal"
            if "in use by another process" in printed:
                why = "another program uses the camera; end that program"
            raise DeviceError(f"rpicam: {PROGRAM} failed (code {process.returncode}): {why}")
        return printed


def _check_taken(metadata: FrameMetadata, planned: Exposure) -> None:
    """Raise DeviceError if a frame shows that the sensor cannot take the planned exposure.

    A repetition would not help: the shutter time is too long for it, or it lacks the gain.
    """
    off_ev = abs(math.log2(metadata.shutter_s / planned.shutter_s))
    if off_ev > SAME_SETTING_EV and metadata.digital_gain > 1.0 + 10 * GAIN_TOLERANCE:
        found = f"{shutter_text(planned.shutter_s)} s requested, {metadata.shutter_s:.4g} s exposed"
        why = f"{found}, digital gain {metadata.digital_gain:g}: too long for this camera module"
        raise DeviceError(f"rpicam: {why}; remove it from [bracket] in the profile and plan again")
    gain = planned.iso / ISO_OF_GAIN_1
    if abs(math.log2(metadata.analogue_gain / gain)) > SAME_SETTING_EV:
        found = f"gain {gain:g} requested, {metadata.analogue_gain:g} used"
        raise DeviceError(f"rpicam: {found}; plan an ISO that this camera module has")


class _Options(Struct):
    """Options of the URI; f_number: of the lens; program: name or path of rpicam-still."""

    f_number: Annotated[float, Meta(ge=0.5, le=64.0)] | None = None
    program: str = PROGRAM


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> RpicamCamera:
    """Open the Raspberry Pi camera of a URI ``rpicam:NUMBER?f_number=F``.

    clock: not used; session: without f_number the aperture is that of its plan. Raises DeviceError
    if the plan does not have exactly one aperture, for an unknown option, and for a missing camera;
    InputError for a plan that cannot be read.
    """
    options = uri.read(_Options)
    f_numbers: set[float] = {options.f_number} if options.f_number else set()
    if session is not None and not f_numbers:
        f_numbers = {e.f_number for slot in session.slots() for e in slot.exposures}
    if len(f_numbers) != 1:
        remedy = "state the lens's aperture in the URI, such as rpicam:0?f_number=2.0"
        raise DeviceError(f"rpicam: the plan has no single aperture; {remedy}")
    return RpicamCamera(uri.place, f_numbers.pop(), program=options.program)
