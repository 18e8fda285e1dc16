"""Drive a Ricoh Theta by Open Spherical Camera over HTTP: ``theta:http://192.168.1.1``.

The option ``?delete=1`` deletes pictures after they were copied. Source: Ricoh's THETA Web API
v2.1. If the file format is raw+ (Z1), the DNG of a single picture is copied, else the JPEG.
"""

import urllib.error
import urllib.request
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from msgspec import Struct, json

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure
from fieldlum.devices import Camera, CameraInfo, DeviceUri, nearest, store_frame
from fieldlum.devices.clock import Clock
from fieldlum.session import Session

ADDRESS = "http://192.168.1.1"  # of the camera's own access point
# Longest wait for an answer, timeout that is added to the shutter time, and pause between status
# requests. Chosen, not measured.
_ANSWER_S = 10.0
READOUT_S = 40.0
POLL_S = 0.3
Reply = dict[str, Any]
"""A JSON object that the camera answered; each value is checked where it is used."""
_MANUAL = {"captureMode": "image", "exposureProgram": 1, "whiteBalance": "daylight"}
# Names of options of the API; with the end Support: of the values that the camera offers.
_SETTINGS = ("shutterSpeed", "iso", "aperture")


class ThetaCamera(Camera):
    """A Ricoh Theta, which is set to manual exposure and daylight white balance.

    Raises DeviceError if the camera does not answer or reports an error.
    """

    def __init__(self, address: str, clock: Clock, *, delete: bool = False) -> None:
        """Connect to the camera at `address`, such as http://192.168.1.1.

        delete: delete pictures on the camera after copying.
        """
        self._address, self._clock, self._delete = address.rstrip("/"), clock, delete
        about, state = self._ask("/osc/info"), self._ask("/osc/state", {}).get("state", {})
        self._command("camera.setOptions", {"options": _MANUAL}, _ANSWER_S)
        offers = [f"{name}Support" for name in _SETTINGS]
        options = self._options(*offers, "remainingPictures", "dateTimeZone")
        # values that the camera offers: shutter times [s], ISO, f-numbers
        self._offers = [_positive_numbers(options.get(name)) for name in offers]
        level, frames_left = state.get("batteryLevel"), options.get("remainingPictures")
        self.info = CameraInfo(
            kind="theta",
            make=str(about.get("manufacturer", "")),
            model=str(about.get("model", "")),
            serial=str(about.get("serialNumber", "")),
            firmware=str(about.get("firmwareVersion", "")),
            battery=f"{100 * level:.0f} %" if isinstance(level, int | float) else "",
            clock_offset_s=self._clock_offset(options.get("dateTimeZone")),
            frames_left=frames_left if isinstance(frames_left, int) else None,
        )

    def _clock_offset(self, text: Any) -> float | None:
        """Return the camera's clock minus the computer's [s]; None if `text` is no time.

        text: the camera's time, such as ``2027:03:20 15:30:00+00:00``.
        """
        with suppress(ValueError, TypeError):
            camera_time = datetime.strptime(text, "%Y:%m:%d %H:%M:%S%z")
            return (camera_time - self._clock.now()).total_seconds()
        return None

    # --------------------------------------------------------------------------------------
    # pictures

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame, copy it to `target` plus the camera's suffix, and return the file.

        heading_deg must be None. The EXIF of the frame is not checked. Raises DeviceError for a
        heading, or if the camera fails, does not offer the exposure or shows another setting, and
        OSError if the disk is full.
        """
        self.refuse_turning(heading_deg)
        settings = self._settings_for(exposure)
        self._command("camera.setOptions", {"options": {**_MANUAL, **settings}}, _ANSWER_S)
        shown = self._options(*settings)
        for name, value in settings.items():
            if abs(float(shown.get(name, 0.0)) - value) > 1e-3 * value:
                found = f"{name} was set to {value:g}, but the camera shows {shown.get(name)}"
                raise DeviceError(f"theta: {found}; restart the camera, then capture again")
        results = self._command("camera.takePicture", {}, exposure.shutter_s + READOUT_S)
        files = [results.get(name) for name in ("_dngFileUrl", "fileUrl")]
        urls = [url for url in files if isinstance(url, str) and url]
        if not urls:
            raise DeviceError("theta: the camera names no file for its picture; take it again")
        parts = urlsplit(urls[0])  # a file elsewhere would not be the camera's picture
        if parts.scheme != "http" or parts.hostname != urlsplit(self._address).hostname:
            found = f"the camera names a file at {urls[0]}; expected a file at {self._address}"
            raise DeviceError(f"theta: {found}; check the address in the URI")
        path = target.with_name(f"{target.name}{Path(parts.path).suffix.lower()}")
        store_frame(path, self._http(urllib.request.Request(urls[0]), 60.0))
        if self._delete:
            self._command("camera.delete", {"fileUrls": urls}, _ANSWER_S)
        return path

    def _settings_for(self, exposure: Exposure) -> dict[str, float]:
        """Return the values that the camera offers nearest to an exposure, by the API's names.

        Raises DeviceError if a value of the exposure is more than 1/6 EV from all offered ones.
        """
        shutters_s, isos, f_numbers = self._offers
        settings = {
            "shutterSpeed": nearest(exposure.shutter_s, shutters_s, "theta shutter", "s"),
            "iso": nearest(exposure.iso, isos, "theta ISO"),
        }
        if f_numbers:
            f_number = nearest(exposure.f_number, f_numbers, "theta aperture", ev_per_double=2.0)
            settings["aperture"] = f_number
        return settings

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError for a setting that is over 1/6 EV from every step of the camera.

        Settings are shutter time, ISO and aperture. The aperture is not checked if the camera
        reports no apertures.
        """
        self._settings_for(exposure)

    # --------------------------------------------------------------------------------------
    # protocol

    def _options(self, *names: str) -> Reply:
        """Return the present values of some options, by the API's names."""
        results = self._command("camera.getOptions", {"optionNames": list(names)}, _ANSWER_S)
        answer = results.get("options")
        return answer if isinstance(answer, dict) else {}

    def _command(self, name: str, parameters: Mapping[str, object], patience_s: float) -> Reply:
        """Execute a command, wait until it is complete, and return its results.

        name, parameters: as in Ricoh's THETA Web API; patience_s: longest duration of the command.
        Raises DeviceError if the camera reports an error or does not answer.
        """
        reply = self._ask("/osc/commands/execute", {"name": name, "parameters": parameters})
        started = self._clock.boottime()
        while reply.get("state") == "inProgress":
            if self._clock.boottime() - started > patience_s:
                why = f"the command {name} did not end within {patience_s:g} s"
                raise DeviceError(f"theta: {why}; restart the camera")
            self._clock.sleep(POLL_S)
            reply = self._ask("/osc/commands/status", {"id": reply.get("id")})
        if reply.get("state") != "done":
            error = reply.get("error")
            error = error if isinstance(error, dict) else {"code": f"state {reply.get('state')!r}"}
            why = f"{error.get('code', 'error')}: {error.get('message', '')}".rstrip(": ")
            raise DeviceError(f"theta: {name}: {why}; restart the camera, then try again")
        results = reply.get("results")
        return results if isinstance(results, dict) else {}

    def _ask(self, path: str, body: Mapping[str, object] | None = None) -> Reply:
        """Return the JSON object that the camera answers.

        path: of the request; body: for a POST, None for a GET. Raises DeviceError for another
        answer or none.
        """
        headers = {"Content-Type": "application/json;charset=utf-8", "Accept": "application/json"}
        data = None if body is None else json.encode(body)
        request = urllib.request.Request(self._address + path, data, headers)
        answer = self._http(request, _ANSWER_S)
        try:
            return json.decode(answer, type=Reply)
        except (ValueError, RecursionError):
            found = f"the camera answered {answer[:40]!r}; expected a JSON object"
            remedy = "check that the address in the URI is that of the Theta, and restart it"
            raise DeviceError(f"theta: {found}; {remedy}") from None

    def _http(self, request: urllib.request.Request, timeout_s: float) -> bytes:
        """Return the body of the answer to a request; that of an HTTP error too if it is JSON.

        Raises DeviceError for every other fault, also for an incomplete body.
        """
        try:
            with urllib.request.urlopen(request, timeout=timeout_s) as response:
                return response.read()
        except urllib.error.HTTPError as error:
            with error:
                body = error.read()
            if body.lstrip().startswith(b"{"):
                return body
            why = f"HTTP {error.code}"
        except (OSError, ValueError, HTTPException) as error:
            why = f"no answer ({error or type(error).__name__})"
        remedy = "connect the computer to the camera's network, and check the address in the URI"
        raise DeviceError(f"theta: {request.full_url}: {why}; {remedy}")


def _positive_numbers(values: object) -> list[float]:
    """Return the numbers above 0 in a list of the camera's answer; empty if it is no list."""
    listed = values if isinstance(values, list) else []
    return [float(v) for v in listed if isinstance(v, int | float) and v is not True and v > 0]


class _Options(Struct):
    """Options of the URI; delete: delete pictures on the camera after copying."""

    delete: bool = False


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> ThetaCamera:
    """Open the Theta at the URI's address (default: http://192.168.1.1).

    clock: waits for the camera; session: not used. Raises DeviceError for an unknown option, an
    address that is not http, no answer, or an error that the camera reports.
    """
    options = uri.read(_Options)
    address = uri.place or ADDRESS
    if urlsplit(address).scheme != "http" or not urlsplit(address).hostname:
        raise DeviceError(f"{uri.text}: no HTTP address; expected a URI like theta:{ADDRESS}")
    return ThetaCamera(address, clock, delete=options.delete)
