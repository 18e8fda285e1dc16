"""Drive a tethered camera through libgphoto2: ``gphoto:``, ``gphoto:Nikon``.

The option ``?delete=1`` deletes each picture from the card after it was copied.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from fieldlum.core.errors import DeviceError, install_text
from fieldlum.core.records import Exposure
from fieldlum.devices import CameraInfo, nearest, refuse_turning
from fieldlum.devices.clock import Clock
from fieldlum.devices.gphoto_child import Child, Serve, serve
from fieldlum.devices.serial_port import closed_on_error
from fieldlum.devices.uri import DeviceUri, integer_option
from fieldlum.session import Session

# Timeouts in seconds; READOUT_S is added to the shutter time. Chosen so that slow cards pass; not
# measured.
OPEN_S = 30.0
SET_S = 15.0
READOUT_S = 30.0
_NUMBER = re.compile(r"(?:f/|iso ?)?(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))? ?s?", re.IGNORECASE)


def setting_value(text: str) -> float | None:
    """Return the number in a camera's text: 1/250, 0.0040s, 1.3, f/5.6, ISO 100.

    Return None for Bulb, Auto and other words.
    """
    match = _NUMBER.fullmatch(text.strip())
    if match is None or (match[2] is not None and not float(match[2])):
        return None
    return float(match[1]) / float(match[2] or 1)


def choose(role: str, asked: float, choices: list[str]) -> str:
    """Return the entry of `choices`, as the camera writes it, that is nearest to the value `asked`.

    role : shutter ([s]), aperture (f-number) or iso; nearest : by ratio. Raises DeviceError if no
    choice is within 1/6 EV.
    """
    offered = {value: text for text in choices if (value := setting_value(text)) is not None}
    unit = {"shutter": "s", "aperture": "", "iso": ""}[role]
    ev_per_octave = 2.0 if role == "aperture" else 1.0
    return offered[nearest(asked, offered, f"camera {role}", unit, ev_per_octave=ev_per_octave)]


def _roles(exposure: Exposure) -> tuple[tuple[str, float], ...]:
    return ("aperture", exposure.f_number), ("iso", exposure.iso), ("shutter", exposure.shutter_s)


class GphotoCamera:
    """A tethered camera, by libgphoto2 in a child process; implements `Camera` and `Choosing`.

    After a hang or a crash the next `expose` restarts the child. delete : whether copied pictures
    are deleted from the card; readout_s : time that is added to the shutter time before a call
    counts as hung; late_file_s : time to wait for the second file of a raw and JPEG pair. Raises
    DeviceError if the camera cannot be opened or offers no shutter times.
    """

    def __init__(
        self,
        serve: Serve,
        model: str = "",
        *,
        delete: bool = False,
        readout_s: float = READOUT_S,
        late_file_s: float = 0.15,
    ) -> None:
        self._child = Child("gphoto", serve)
        self._model, self._delete = model, delete
        self._readout_s = readout_s
        self._late_ms = round(1000 * late_file_s)
        self._about: dict[str, Any] = {}
        with closed_on_error(self):
            self._open()

    def _open(self) -> None:
        self._about = self._child.ask("open", self._model, timeout_s=OPEN_S)
        self._opened_at_start = self._child.starts
        if "shutter" not in self._about["settings"]:
            raise DeviceError("gphoto: the camera offers no shutter times; set its dial to M")

    @property
    def info(self) -> CameraInfo:
        """Return what the camera reports about itself."""
        about = {k: v for k, v in self._about.items() if k != "settings"}
        return CameraInfo("gphoto", **about)

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Set what the camera lets a computer set, take the frame and copy it; return the file.

        The EXIF of the frame is not checked. Raises DeviceError for a heading, or if the camera
        fails, does not offer the exposure or shows another setting, and OSError if the disk is
        full.
        """
        refuse_turning("gphoto", heading_deg)
        if not self._child.alive or self._child.starts != self._opened_at_start:
            self._open()
        for role, asked in _roles(exposure):
            self._set(role, asked)
        wait_s = exposure.shutter_s + self._readout_s
        return Path(
            self._child.ask("expose", str(target), self._delete, self._late_ms, timeout_s=wait_s)
        )

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError for a setting over 1/6 EV from each of the camera's choices.

        Settings that the camera does not let a computer set are not checked.
        """
        for role, asked in _roles(exposure):
            if role in self._about["settings"]:
                choose(role, asked, self._about["settings"][role][1])

    def _set(self, role: str, asked: float) -> None:
        # A manual lens or a fixed setting: `capture` checks the EXIF of the frame instead.
        if role not in self._about["settings"]:
            return
        widget, choices = self._about["settings"][role]
        text = choose(role, asked, choices)
        shown = self._child.ask("set", widget, text, timeout_s=SET_S)
        if shown != text:
            raise DeviceError(
                f"gphoto: {widget} was set to {text}, but the camera shows {shown}; set its "
                "dial to M"
            )

    def close(self) -> None:
        """End the child process, which releases the camera."""
        self._child.close()


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> GphotoCamera:
    """Open the first tethered camera, or the first whose model contains the URI's place.

    Raises DeviceError for an unknown option, without the package gphoto2, without a camera, or for
    one that offers no shutter times.
    """
    from importlib.util import find_spec

    options = uri.read(delete=integer_option(0, 1))
    if find_spec("gphoto2") is None:
        raise DeviceError(
            f"{uri.text}: the package gphoto2 is missing; {install_text('gphoto')} (Linux, macOS)"
        )
    return GphotoCamera(serve, uri.place, delete=bool(options.get("delete", 0)))
