"""Run libgphoto2 in a child process: open a camera, set it, take a picture, copy it.

The child is killed if it hangs and restarted after a crash. It runs `serve(pipe)`: it receives
(command, arguments) and answers ("ok", result), ("error", text), or ("full", errno) for a full
disk, which is not the camera's fault.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from fieldlum.core.errors import DeviceError
from fieldlum.devices import retried, store_frame
from fieldlum.optics.raw import RAW_SUFFIXES
from fieldlum.session import disk_is_full

# Names of the three settings by brand; the first name that a camera has is used.
WIDGETS = {
    "shutter": ("shutterspeed", "shutterspeed2", "exptime"),
    "aperture": ("aperture", "f-number"),
    "iso": ("iso", "isospeed"),
}
_ERRORS = {  # codes of gphoto2-port-result.h and gphoto2-result.h
    -1: "unspecified error",
    -3: "out of memory, or the camera's card is full; delete pictures on the card",
    -7: "input/output error; check the cable",
    -10: "timeout",
    -52: "the camera is not on USB; check the cable and switch the camera on",
    -53: "another program uses it; close that program, or run 'gio mount -s gphoto2'",
    -105: "no camera found; switch it on, set it to PTP, and check the cable",
    -115: "the camera's card is full; delete pictures on it",
}
_BUSY = -110  # GP_ERROR_CAMERA_BUSY of gphoto2-result.h
_TRIES = 4  # number of tries, half a second apart, while the camera is busy; chosen, not measured


Serve = Callable[[Connection], None]


def failure(error: Exception) -> tuple[str, Any]:
    """Return the child's answer to an exception: ("full", errno) or ("error", text)."""
    return (
        ("full", error.errno)
        if isinstance(error, OSError) and disk_is_full(error)
        else ("error", str(error))
    )


class Child:
    """A child process that starts with the first command and runs one command at a time.

    name : for errors; serve : function that the child runs; starts : number of times that it was
    started. The next command after its end starts it again.
    """

    def __init__(self, name: str, serve: Serve) -> None:
        self._name, self._serve = name, serve
        self._lock = threading.Lock()
        self._process: Any = None
        self._pipe: Connection | None = None
        self.starts = 0

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.is_alive()

    def ask(self, command: str, *arguments: Any, timeout_s: float) -> Any:
        """Send a command to the child and return its answer.

        Raises DeviceError if the child reports an error, dies, or does not answer within
        `timeout_s` (it is then killed); OSError if the child found the disk full.
        """
        with self._lock:
            pipe = self._ready()
            try:
                pipe.send((command, arguments))
                if not pipe.poll(timeout_s):
                    self._kill()
                    raise DeviceError(
                        f"{self._name}: '{command}' did not answer within {timeout_s:g} s "
                        "and its process was killed; check cable and battery"
                    )
                kind, result = pipe.recv()
            except (EOFError, OSError):
                code = self._kill(grace_s=5.0)  # the process is ending, so wait for its exit code
                why = (
                    f"signal {signal.Signals(-code).name}"
                    if code is not None and code < 0
                    else f"exit code {code}"
                )
                raise DeviceError(
                    f"{self._name}: the driver crashed in '{command}' ({why}); check cable and "
                    "battery, then run the command again"
                ) from None
        if kind == "full":
            raise OSError(result, os.strerror(result))
        if kind == "error":
            raise DeviceError(f"{self._name}: {result}")
        return result

    def _ready(self) -> Connection:
        if self._pipe is None or not self.alive:
            self._kill()
            # Never fork, because neither libusb nor threads survive it.
            context = multiprocessing.get_context("spawn")
            ours, theirs = context.Pipe()
            self._process = context.Process(
                target=self._serve, args=(theirs,), daemon=True, name=self._name
            )
            self._process.start()
            theirs.close()
            self._pipe, self.starts = ours, self.starts + 1
        return self._pipe

    def _kill(self, grace_s: float = 0.1) -> int | None:
        """End the process and return its exit code."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._process is None:
            return None
        self._process.join(grace_s)
        if self._process.is_alive():
            self._process.kill()
        self._process.join(5.0)
        code = self._process.exitcode
        with suppress(ValueError):
            self._process.close()
        self._process = None
        return code

    def close(self, timeout_s: float = 3.0) -> None:
        """Tell the child to end, and kill it if it still runs after `timeout_s`."""
        with self._lock:
            if self._pipe is not None and self.alive:
                with suppress(OSError, EOFError):
                    self._pipe.send(("close", ()))
                    self._process.join(timeout_s)
            self._kill()


def serve(pipe: Connection) -> None:
    """Answer the commands to the camera that come through `pipe`, until `close`.

    It ends also if the parent closes the pipe or ends.
    """
    import gphoto2 as gp

    camera: Any = None
    while True:
        try:
            command, arguments = pipe.recv()
        except (EOFError, OSError):
            command, arguments = "close", ()
        try:
            if command == "open":
                camera = _open(gp, *arguments)
                result: Any = _describe(gp, camera)
            elif command == "set":
                result = _set(gp, camera, *arguments)
            elif command == "expose":
                result = _expose(gp, camera, *arguments)
            else:
                if camera is not None:
                    with suppress(gp.GPhoto2Error):
                        camera.exit()
                return
            pipe.send(("ok", result))
        except gp.GPhoto2Error as error:
            pipe.send(("error", _ERRORS.get(error.code, f"{error.string} ({error.code})")))
        except (OSError, ValueError) as error:
            pipe.send(failure(error))


def _open(gp: Any, model: str) -> Any:
    camera = gp.Camera()
    if model:
        cameras = [entry for entry in gp.Camera.autodetect() if model.lower() in entry[0].lower()]
        if not cameras:
            raise ValueError(
                f"no camera named {model}; connected: "
                f"{[e[0] for e in gp.Camera.autodetect()] or 'none'}"
            )
        name, port = cameras[0]
        abilities, ports = gp.CameraAbilitiesList(), gp.PortInfoList()
        abilities.load()
        ports.load()
        camera.set_abilities(abilities[abilities.lookup_model(name)])
        camera.set_port_info(ports[ports.lookup_path(port)])
    camera.init()
    return camera


def _value(gp: Any, camera: Any, name: str) -> Any:
    try:
        return camera.get_single_config(name).get_value()
    except gp.GPhoto2Error:
        return None


def _describe(gp: Any, camera: Any) -> dict[str, Any]:
    """Return what the camera reports: the fields of `CameraInfo`, and its settings.

    settings : (widget, choices) by shutter, aperture, iso, for those that a computer can set.
    """
    settings: dict[str, tuple[str, list[str]]] = {}
    for role, names in WIDGETS.items():
        for name in names:
            with suppress(gp.GPhoto2Error):
                widget = camera.get_single_config(name)
                if not widget.get_readonly():
                    settings[role] = (name, list(widget.get_choices()))
                    break
    asked = time.time()
    clock = next(
        (v for n in ("datetimeutc", "datetime") if isinstance(v := _value(gp, camera, n), int)),
        None,
    )
    return {
        "make": str(_value(gp, camera, "manufacturer") or ""),
        "model": str(_value(gp, camera, "cameramodel") or camera.get_abilities().model),
        "serial": str(_value(gp, camera, "serialnumber") or "").lstrip("0"),
        "firmware": str(_value(gp, camera, "deviceversion") or ""),
        "lens": str(_value(gp, camera, "lensname") or ""),
        "battery": str(_value(gp, camera, "batterylevel") or ""),
        "clock_offset_s": None if clock is None else clock - asked,
        "settings": settings,
    }


def _patiently(work: Callable[[], Any]) -> Any:
    """Call `work`; call it again while the camera reports that it is busy."""
    return retried(work, _TRIES, lambda error: getattr(error, "code", 0) == _BUSY, 0.5)


def _set(gp: Any, camera: Any, name: str, text: str) -> str:
    """Set a widget to one of its own choices, and return the value that it then has.

    A text that is not among the choices is never sent to libgphoto2, because it silently replaces
    some such texts and crashes on others.
    """
    widget = camera.get_single_config(name)
    if text not in list(widget.get_choices()):
        raise ValueError(f"{name}: {text} is not offered; expected one of the camera's choices")
    if widget.get_value() != text:
        widget.set_value(text)
        _patiently(lambda: camera.set_single_config(name, widget))
    return camera.get_single_config(name).get_value()


def _expose(gp: Any, camera: Any, target: str, delete: bool, late_ms: int) -> str:
    """Take a picture, copy it to `target` plus its suffix, and return the path.

    From a pair of raw and JPEG only the raw file is copied. late_ms : time to wait for the second
    file.
    """
    for _ in range(50):  # discard events of earlier pictures
        if camera.wait_for_event(1)[0] == gp.GP_EVENT_TIMEOUT:
            break
    first = _patiently(lambda: camera.capture(gp.GP_CAPTURE_IMAGE))
    files = [(first.folder, first.name)]
    kind, data = camera.wait_for_event(late_ms)
    while kind not in (gp.GP_EVENT_TIMEOUT, gp.GP_EVENT_CAPTURE_COMPLETE) and len(files) < 4:
        if kind == gp.GP_EVENT_FILE_ADDED and (data.folder, data.name) not in files:
            files.append((data.folder, data.name))
        kind, data = camera.wait_for_event(late_ms)
    folder, name = min(files, key=lambda f: Path(f[1]).suffix.lower() not in RAW_SUFFIXES)
    shot = camera.file_get(folder, name, gp.GP_FILE_TYPE_NORMAL)
    # `shot` must exist until this copy is complete
    body = bytes(memoryview(shot.get_data_and_size()))
    path = Path(f"{target}{Path(name).suffix.lower()}")
    store_frame(path, body)
    if delete:
        for folder, name in files:
            camera.file_delete(folder, name)
    return str(path)
