"""Run libgphoto2 in a child process: open a camera, set it, take a picture, copy it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from fieldlum.devices import retried, store_frame
from fieldlum.devices.driver_process import failure
from fieldlum.optics.raw import RAW_SUFFIXES

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
