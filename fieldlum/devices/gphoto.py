"""Drive a tethered camera through libgphoto2: ``gphoto:``, ``gphoto:Nikon``.

The option ``?delete=1`` deletes each picture from the card after it was copied. libgphoto2 runs in
a child process, which is killed if it hangs; after a hang or a crash the camera is opened again.
"""

import multiprocessing
import re
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from msgspec import Struct

from fieldlum.core.errors import DeviceError, install_text
from fieldlum.core.records import Exposure
from fieldlum.devices import Camera, CameraInfo, DeviceUri, nearest, retry, serial_port, store_frame
from fieldlum.devices.clock import Clock
from fieldlum.optics.raw import RAW_SUFFIXES
from fieldlum.session import Session, disk_is_full

# Timeout of a command [s], in addition to the shutter time. Chosen so that slow cards pass; not
# measured.
PATIENCE_S = 30.0
_LATE_MS = 150  # wait for the second file of a raw and JPEG pair; chosen
_BUSY = -110  # code of an error of libgphoto2: GP_ERROR_CAMERA_BUSY
_NUMBER = re.compile(r"(?:f/|iso ?)?(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))? ?s?", re.IGNORECASE)
# Names of the three settings by brand, in the order in which they are set; the first name that a
# camera has is used.
_WIDGETS = {
    "aperture": ("aperture", "f-number"),
    "iso": ("iso", "isospeed"),
    "shutter": ("shutterspeed", "shutterspeed2", "exptime"),
}
_REMEDY = (
    "switch the camera on, set it to PTP, check its cable and whether its card is full, and end "
    "other programs that use it ('gio mount -s gphoto2')"
)
Serve = Callable[[Connection], None]
"""The function that a child process runs: it answers commands through a pipe."""


def setting_value(text: str) -> float | None:
    """Return the number in a camera's text of a setting: shutter time [s], f-number or ISO.

    A text is a decimal or a fraction, if necessary after f/ or ISO or before s, such as 1/250,
    0.0040s, f/5.6 and ISO 100. None for Bulb, Auto and other words.
    """
    match = _NUMBER.fullmatch(text.strip())
    if match is None or (match[2] is not None and not float(match[2])):
        return None
    return float(match[1]) / float(match[2] or 1)


def choose(setting: str, planned: float, choices: list[str]) -> str:
    """Return the camera's text, of those in `choices`, for the value nearest by ratio to `planned`.

    setting : shutter ([s]), aperture (f-number) or iso. Raises DeviceError if no choice is within
    1/6 EV.
    """
    offered = {value: text for text in choices if (value := setting_value(text)) is not None}
    unit = "s" if setting == "shutter" else ""
    ev = 2.0 if setting == "aperture" else 1.0
    return offered[nearest(planned, offered, f"camera {setting}", unit, ev_per_double=ev)]


class GphotoCamera(Camera):
    """A tethered camera; libgphoto2 runs in a child process, which is killed if it hangs.

    Raises DeviceError if the camera cannot be opened or offers no shutter times.
    """

    def __init__(self, serve: Serve, model: str = "", *, delete: bool = False) -> None:
        """Open the first camera whose name contains `model`, in a child process that runs `serve`.

        delete: delete pictures on the card after copying.
        """
        self._child = Child("gphoto", serve)
        self._delete = delete
        with serial_port.closed_on_error(self):
            about: dict[str, Any] = self._child.ask("open", model, timeout_s=PATIENCE_S)
            # name of the widget and its choices, by setting: shutter, aperture, iso
            self._settings: dict[str, tuple[str, list[str]]] = about.pop("settings")
            self.info = CameraInfo("gphoto", **about)
            if "shutter" not in self._settings:
                raise DeviceError("gphoto: the camera offers no shutter times; set its dial to M")

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame, copy it to `target` plus the camera's suffix, and return the file.

        Only settings that a computer can set are set, for example no aperture of a manual lens; the
        frame's EXIF is not checked. heading_deg must be None. Raises DeviceError for a heading, or
        if the camera fails, does not offer the exposure or shows another setting, and OSError if
        the disk is full.
        """
        self.refuse_turning(heading_deg)
        for widget, text in self._texts_by_widget(exposure).items():
            shown = self._child.ask("set", widget, text, timeout_s=PATIENCE_S)
            if shown != text:
                found = f"{widget} was set to {text}, but the camera shows {shown}"
                raise DeviceError(f"gphoto: {found}; set its dial to M")
        wait_s = exposure.shutter_s + PATIENCE_S
        return Path(self._child.ask("expose", str(target), self._delete, timeout_s=wait_s))

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError for a setting over 1/6 EV from each of the camera's choices.

        Settings that the camera does not let a computer set are not checked.
        """
        self._texts_by_widget(exposure)

    def _texts_by_widget(self, exposure: Exposure) -> dict[str, str]:
        """Return the camera's text of each setting that a computer can set, by widget.

        Raises DeviceError if no choice of a widget is within 1/6 EV.
        """
        f_number, iso, shutter_s = exposure.f_number, exposure.iso, exposure.shutter_s
        planned = {"aperture": f_number, "iso": iso, "shutter": shutter_s}
        widgets = self._settings.items()
        return {name: choose(setting, planned[setting], of) for setting, (name, of) in widgets}

    def close(self) -> None:
        """End the child process, which releases the camera."""
        self._child.close()


class _Options(Struct):
    """Options of the URI; delete: delete pictures on the card after copying."""

    delete: bool = False


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> GphotoCamera:
    """Open the first tethered camera, or the first whose model contains the text after `gphoto:`.

    clock, session: not used by this driver.

    Raises DeviceError for an unknown option, without the package gphoto2, without a camera, or for
    one that offers no shutter times.
    """
    from importlib.util import find_spec

    options = uri.read(_Options)
    if find_spec("gphoto2") is None:
        remedy = f"{install_text('gphoto')} (Linux, macOS)"
        raise DeviceError(f"{uri.text}: the package gphoto2 is missing; {remedy}")
    return GphotoCamera(serve, uri.place, delete=options.delete)


# ----------------------------------------------------------------------------------------------
# the child process


class Child:
    """A child process that executes one command at a time; it is killed if it does not answer.

    name : for errors; serve : function that the child runs: it receives (command, arguments) and
    answers ("ok", result) or ("error", exception).
    """

    def __init__(self, name: str, serve: Serve) -> None:
        self._name = name
        # Never fork, because neither libusb nor threads survive it.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, command: str, *arguments: Any, timeout_s: float) -> Any:
        """Send a command with its arguments to the child, and return the result that it answers.

        Raises the error that it answers, and DeviceError if the child ends, or does not answer
        within `timeout_s` and is killed.
        """
        try:
            self._pipe.send((command, arguments))
            answer: Any = self._pipe.recv() if self._pipe.poll(timeout_s) else None
        except (EOFError, OSError):
            code = self._end(5.0)  # the process is ending, so wait for its exit code
            cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            why = f"the driver crashed in '{command}' ({cause}); check cable and battery"
            raise DeviceError(f"{self._name}: {why}") from None
        if answer is None:
            self._end(0.1)
            why = f"did not answer within {timeout_s:g} s and its process was killed"
            raise DeviceError(f"{self._name}: '{command}' {why}; check cable and battery")
        kind, result = answer
        if kind == "error":
            raise result
        return result

    def _end(self, grace_s: float) -> int:
        """Kill the process if it still runs after `grace_s`, and return its exit code.

        The code is minus the number of the signal that ended it.
        """
        self._process.join(grace_s)
        self._process.kill()
        self._process.join(5.0)
        self._pipe.close()
        return self._process.exitcode or 0

    def close(self, timeout_s: float = 3.0) -> None:
        """Send the command to end to the child, and kill it if it still runs after `timeout_s`."""
        with suppress(OSError):
            self._pipe.send(("close", ()))
        self._end(timeout_s)


def serve(pipe: Connection) -> None:
    """Execute the commands that come through `pipe`, and answer each, until the command `close`.

    This is what the child process runs. The commands are the methods of `_Driver`. The child ends
    also if the parent closes the pipe or ends.
    """
    driver = _Driver()
    while True:
        command, arguments = "close", ()
        with suppress(EOFError, OSError):
            command, arguments = pipe.recv()
        try:
            result = getattr(driver, command)(*arguments)
            if command == "close":
                return
            pipe.send(("ok", result))
        except driver.gp.GPhoto2Error as error:
            why = f"{error.string} ({error.code}); {_REMEDY}"
            pipe.send(("error", DeviceError(f"gphoto: {why}")))
        except (OSError, ValueError) as error:
            full = isinstance(error, OSError) and disk_is_full(error)
            pipe.send(("error", error if full else DeviceError(f"gphoto: {error}")))


class _Driver:
    """The commands of the child process; each raises gphoto2's GPhoto2Error if the camera fails."""

    def __init__(self) -> None:
        import gphoto2

        self.gp: Any = gphoto2
        self._camera = self.gp.Camera()

    def open(self, model: str) -> dict[str, Any]:
        """Open the first camera whose name contains `model`, and return what it reports.

        The keys are fields of `CameraInfo`, and settings: by setting (shutter, aperture, iso) the
        name of the camera's widget and its choices. Raises ValueError if no connected camera has
        such a name.
        """
        gp, self._camera = self.gp, self.gp.Camera()
        if model:
            connected = list(gp.Camera.autodetect())
            cameras = [entry for entry in connected if model.lower() in entry[0].lower()]
            if not cameras:
                names = [name for name, _ in connected] or "none"
                raise ValueError(f"no camera named {model}; connected: {names}")
            name, port = cameras[0]
            abilities, ports = gp.CameraAbilitiesList(), gp.PortInfoList()
            abilities.load()
            ports.load()
            self._camera.set_abilities(abilities[abilities.lookup_model(name)])
            self._camera.set_port_info(ports[ports.lookup_path(port)])
        self._camera.init()
        camera_unix_s, unix_s = self._value("datetimeutc", "datetime"), time.time()
        return {
            "make": str(self._value("manufacturer")),
            "model": str(self._value("cameramodel") or self._camera.get_abilities().model),
            "serial": str(self._value("serialnumber")).lstrip("0"),
            "firmware": str(self._value("deviceversion")),
            "lens": str(self._value("lensname")),
            "battery": str(self._value("batterylevel")),
            "clock_offset_s": camera_unix_s - unix_s if isinstance(camera_unix_s, int) else None,
            "settings": self._settings(),
        }

    def _value(self, *names: str) -> Any:
        """Return the first value of the camera that is not empty, tried by `names`; "" without one.

        names: of widgets of libgphoto2, because brands use different ones.
        """
        for name in names:
            with suppress(self.gp.GPhoto2Error):
                if value := self._camera.get_single_config(name).get_value():
                    return value
        return ""

    def _settings(self) -> dict[str, tuple[str, list[str]]]:
        """Return the name and the choices of the widget of each setting that a computer can set.

        They are by setting: shutter, aperture, iso. A camera has no widget of the other brands.
        """
        settings: dict[str, tuple[str, list[str]]] = {}
        for setting, names in _WIDGETS.items():
            for name in reversed(names):  # so that the first name has the last word
                with suppress(self.gp.GPhoto2Error):
                    widget = self._camera.get_single_config(name)
                    if not widget.get_readonly():
                        settings[setting] = (name, list(widget.get_choices()))
        return settings

    def set(self, name: str, text: str) -> str:
        """Set the widget `name` to one of its own choices, and return the value that it then has.

        Raises ValueError for a text that is not among the choices. Such a text is never sent to
        libgphoto2, which silently replaces some of them and crashes on others.
        """
        widget = self._camera.get_single_config(name)
        if text not in list(widget.get_choices()):
            raise ValueError(f"{name}: {text} is not one of the camera's choices")
        if widget.get_value() != text:
            widget.set_value(text)
            self._while_busy(lambda: self._camera.set_single_config(name, widget))
        return self._camera.get_single_config(name).get_value()

    def expose(self, target: str, delete: bool) -> str:
        """Take a picture, copy it to `target` plus its suffix, and return the path.

        From a pair of raw and JPEG only the raw file is copied. delete: delete all files of the
        picture on the card afterwards. Raises OSError if the copy cannot be written.
        """
        gp, camera = self.gp, self._camera
        for _ in range(50):  # discard events of earlier pictures; a camera has fewer
            if camera.wait_for_event(1)[0] == gp.GP_EVENT_TIMEOUT:
                break
        first = self._while_busy(lambda: camera.capture(gp.GP_CAPTURE_IMAGE))
        files = [(first.folder, first.name)]
        kind, data = camera.wait_for_event(_LATE_MS)
        while kind not in (gp.GP_EVENT_TIMEOUT, gp.GP_EVENT_CAPTURE_COMPLETE) and len(files) < 4:
            if kind == gp.GP_EVENT_FILE_ADDED and (data.folder, data.name) not in files:
                files.append((data.folder, data.name))
            kind, data = camera.wait_for_event(_LATE_MS)
        raw_files = [file for file in files if Path(file[1]).suffix.lower() in RAW_SUFFIXES]
        folder, name = (raw_files or files)[0]
        camera_file = camera.file_get(folder, name, gp.GP_FILE_TYPE_NORMAL)
        # `camera_file` must exist until this copy is complete
        body = bytes(memoryview(camera_file.get_data_and_size()))
        path = Path(f"{target}{Path(name).suffix.lower()}")
        store_frame(path, body)
        if delete:
            for folder, name in files:
                camera.file_delete(folder, name)
        return str(path)

    def _while_busy(self, action: Callable[[], Any]) -> Any:
        """Return the result of `action`; call it again after 0.5 s while the camera is busy."""
        return retry(action, lambda error: getattr(error, "code", 0) == _BUSY, 0.5)

    def close(self) -> None:
        """Release the camera."""
        with suppress(self.gp.GPhoto2Error):
            self._camera.exit()
