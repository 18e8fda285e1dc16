"""Drive a Ricoh Theta by Open Spherical Camera over HTTP: ``theta:http://192.168.1.1``.

The option ``?delete=1`` deletes pictures after they were copied. Source: Ricoh's THETA Web API
v2.1. If the file format is raw+ (Z1), the DNG of a single picture is copied, else the JPEG.
"""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from msgspec import json

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure
from fieldlum.devices import CameraInfo, nearest, refuse_turning, store_frame
from fieldlum.devices.clock import Clock
from fieldlum.devices.uri import DeviceUri, integer_option
from fieldlum.session import Session

ADDRESS = "http://192.168.1.1"  # of the camera's own access point
# Timeout that is added to the shutter time, and pause between status requests. Chosen, not
# measured.
READOUT_S = 40.0
POLL_S = 0.3
BRACKET_SHOTS = range(2, 14)  # all models take up to 13, Z1 and V up to 19 (THETA Web API v2.1)
_MAX_FILE_BYTES = 200_000_000  # bytes; longer answers are cut and then rejected
Reply = dict[str, Any]
"""A JSON object that the camera answered; each value is checked where it is used."""
_MANUAL = {"captureMode": "image", "exposureProgram": 1, "whiteBalance": "daylight"}


class ThetaCamera:
    """A Ricoh Theta; implements `Camera`, `Choosing` and `BracketingCamera`.

    address : such as http://192.168.1.1; delete : whether pictures are deleted after they were
    copied. Raises DeviceError if the camera does not answer or reports an error.
    """

    def __init__(
        self, address: str, clock: Clock, *, delete: bool = False, timeout_s: float = 10.0
    ) -> None:
        self._address, self._clock = address.rstrip("/"), clock
        self._delete, self._timeout_s = delete, timeout_s
        about, state = self._get("/osc/info"), self._post("/osc/state", {}).get("state", {})
        self._set(_MANUAL)
        names = (
            "shutterSpeedSupport",
            "isoSupport",
            "apertureSupport",
            "remainingPictures",
            "dateTimeZone",
        )
        options = self._options(*names)
        self._offers = {
            "shutter": _numbers(options.get("shutterSpeedSupport")),
            "iso": _numbers(options.get("isoSupport")),
            "aperture": _numbers(options.get("apertureSupport")),
        }
        level = state.get("batteryLevel")
        self.info = CameraInfo(
            "theta",
            str(about.get("manufacturer", "")),
            str(about.get("model", "")),
            str(about.get("serialNumber", "")),
            str(about.get("firmwareVersion", "")),
            battery=f"{100 * level:.0f} %" if isinstance(level, int | float) else "",
            clock_offset_s=self._clock_offset(options.get("dateTimeZone")),
            frames_left=rest if isinstance(rest := options.get("remainingPictures"), int) else None,
        )

    def _clock_offset(self, text: Any) -> float | None:
        """Return the offset of a camera's clock from its text, ``2027:03:20 15:30:00+00:00``.

        The camera states integer seconds.
        """
        with suppress(ValueError, TypeError, AttributeError):
            day, _, clock = text.partition(" ")
            stamp = datetime.fromisoformat(f"{day.replace(':', '-')}T{clock}")
            return (stamp - self._clock.now()).total_seconds()
        return None

    # --------------------------------------------------------------------------------------
    # pictures

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Set the exposure, check the setting, take the frame and fetch it; return the file.

        The EXIF of the frame is not checked. Raises DeviceError for a heading, or if the camera
        fails, does not offer the exposure or shows another setting, and OSError if the disk is
        full.
        """
        refuse_turning("theta", heading_deg)
        wanted = self._chosen(exposure)
        self._set({**_MANUAL, **wanted})
        shown = self._options(*wanted)
        for name, value in wanted.items():
            if abs(float(shown.get(name, 0.0)) - value) > 1e-3 * value:
                raise DeviceError(
                    f"theta: {name} was set to {value:g}, but the camera shows {shown.get(name)}; "
                    "restart the camera, then capture again"
                )
        results = self._command("camera.takePicture", {}, exposure.shutter_s + READOUT_S)
        urls = [
            url
            for name in ("_dngFileUrl", "fileUrl")
            if isinstance(url := results.get(name), str) and url
        ]
        if not urls:
            raise DeviceError(
                "theta: the picture was taken, but the camera names no file for it; take it again"
            )
        path = self._fetch(urls[0], target)
        self._clear(urls)
        return path

    @property
    def bracket_shots(self) -> range:
        """The possible numbers of frames in a bracket: 2 to 13."""
        return BRACKET_SHOTS

    def expose_bracket(self, exposures: Sequence[Exposure], targets: Sequence[Path]) -> list[Path]:
        """Take 2 to 13 JPEG frames with one command, in the order of `exposures`; return the files.

        targets : one path for each frame, to which its suffix is added. Raises DeviceError for
        another number of frames, or if the camera fails or does not offer an exposure, OSError if
        the disk is full; frames that were already fetched stay on the disk.
        """
        if len(exposures) not in self.bracket_shots:
            low, high = self.bracket_shots[0], self.bracket_shots[-1]
            raise DeviceError(
                f"theta: a bracket of {len(exposures)} frames; expected {low} to {high}; "
                "plan fewer or more exposures"
            )
        shots = [
            {"exposureProgram": 1, "whiteBalance": "daylight", **self._chosen(e)} for e in exposures
        ]
        self._set(
            {**_MANUAL, "_autoBracket": {"_bracketNumber": len(shots), "_bracketParameters": shots}}
        )
        patience = sum(e.shutter_s for e in exposures) + READOUT_S + 2.0 * len(shots)
        # The camera reports only the number of frames; their EXIF states the settings.
        urls = self._command("camera.startCapture", {"_mode": "bracket"}, patience).get("fileUrls")
        if not isinstance(urls, list) or len(urls) != len(shots):
            count = len(urls) if isinstance(urls, list) else "no"
            raise DeviceError(
                f"theta: the camera took {count} frames of a bracket; expected "
                f"{len(shots)}; capture the bracket again"
            )
        paths = [self._fetch(str(url), target) for url, target in zip(urls, targets, strict=True)]
        self._clear([str(u) for u in urls])
        return paths

    def _chosen(self, exposure: Exposure) -> dict[str, float]:
        """Return the camera's steps for an exposure.

        Raises DeviceError if a value is more than 1/6 EV from every step.
        """
        offers = self._offers
        chosen = {
            "shutterSpeed": nearest(exposure.shutter_s, offers["shutter"], "theta shutter", "s"),
            "iso": nearest(exposure.iso, offers["iso"], "theta ISO"),
        }
        if offers["aperture"]:
            chosen["aperture"] = nearest(
                exposure.f_number, offers["aperture"], "theta aperture", ev_per_octave=2.0
            )
        return chosen

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError for a setting that is over 1/6 EV from every step of the camera.

        The aperture is not checked if the camera reports no apertures.
        """
        self._chosen(exposure)

    def _fetch(self, url: str, target: Path) -> Path:
        parts = urlsplit(url)
        if parts.scheme != "http" or parts.hostname != urlsplit(self._address).hostname:
            raise DeviceError(
                f"theta: the camera names a file at {url}; expected a file at {self._address}; "
                "check that the address in the URI is that of the Theta"
            )
        path = target.with_name(f"{target.name}{Path(parts.path).suffix.lower()}")
        body = self._http(urllib.request.Request(url), 60.0)
        store_frame(path, body)
        return path

    def _clear(self, urls: list[str]) -> None:
        if self._delete:
            self._command("camera.delete", {"fileUrls": urls}, self._timeout_s)

    def close(self) -> None:
        """Do nothing: HTTP leaves no connection open."""

    # --------------------------------------------------------------------------------------
    # protocol

    def _set(self, options: Mapping[str, object]) -> None:
        self._command("camera.setOptions", {"options": options}, self._timeout_s)

    def _options(self, *names: str) -> Reply:
        results = self._command("camera.getOptions", {"optionNames": list(names)}, self._timeout_s)
        answer = results.get("options")
        return answer if isinstance(answer, dict) else {}

    def _command(self, name: str, parameters: Mapping[str, object], patience_s: float) -> Reply:
        """Execute a command, wait until it is complete, and return its results.

        Raises DeviceError if the camera reports an error or does not answer.
        """
        reply = self._post("/osc/commands/execute", {"name": name, "parameters": parameters})
        started = self._clock.boottime()
        while reply.get("state") == "inProgress":
            if self._clock.boottime() - started > patience_s:
                raise DeviceError(
                    f"theta: the command {name} did not end within {patience_s:g} s; restart the "
                    "camera"
                )
            self._clock.sleep(POLL_S)
            reply = self._post("/osc/commands/status", {"id": reply.get("id")})
        if reply.get("state") != "done":
            raise DeviceError(
                f"theta: {name}: {_error_text(reply)}; restart the camera, then try again"
            )
        results = reply.get("results")
        return results if isinstance(results, dict) else {}

    def _get(self, path: str) -> Reply:
        return _json(self._http(urllib.request.Request(self._address + path), self._timeout_s))

    def _post(self, path: str, body: Mapping[str, object]) -> Reply:
        headers = {"Content-Type": "application/json;charset=utf-8", "Accept": "application/json"}
        request = urllib.request.Request(self._address + path, json.encode(body), headers)
        return _json(self._http(request, self._timeout_s))

    def _http(self, request: urllib.request.Request, timeout_s: float) -> bytes:
        """Return the body of the answer, also that of an HTTP error with a JSON body.

        Raises DeviceError for every other fault.
        """
        try:
            with urllib.request.urlopen(request, timeout=timeout_s) as response:
                body = response.read(_MAX_FILE_BYTES)
                length = response.headers.get("Content-Length")
        except urllib.error.HTTPError as error:
            with error:
                body, length = error.read(100_000), None
            if not body.lstrip().startswith(b"{"):
                raise DeviceError(
                    f"theta: the camera answered HTTP {error.code} to {request.full_url}; restart "
                    "the camera, and check the address in the URI"
                ) from None
        except (OSError, ValueError) as error:
            why = getattr(error, "reason", error)
            raise DeviceError(
                f"theta: {self._address}: {why}; connect the computer to the camera's network"
            ) from None
        if length is not None and length.isdigit() and len(body) != int(length):
            raise DeviceError(
                f"theta: {request.full_url} is incomplete: {len(body)} of {length} bytes; move the "
                "computer closer to the camera, then capture again"
            )
        return body


def _json(body: bytes) -> Reply:
    try:
        return json.decode(body, type=Reply)
    except (ValueError, RecursionError):
        raise DeviceError(
            f"theta: the camera answered {body[:40]!r}; expected a JSON object; check that the "
            "address in the URI is that of the Theta, and restart it"
        ) from None


def _error_text(reply: Reply) -> str:
    error = reply.get("error")
    if not isinstance(error, dict):
        return f"state {reply.get('state')!r}"
    return f"{error.get('code', 'error')}: {error.get('message', '')}".rstrip(": ")


def _numbers(values: object) -> list[float]:
    listed = values if isinstance(values, list) else []
    return [
        float(v) for v in listed if isinstance(v, int | float) and not isinstance(v, bool) and v > 0
    ]


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> ThetaCamera:
    """Open the Theta at the URI's address (default: http://192.168.1.1).

    Raises DeviceError for an unknown option, an address that is not http, no answer, or an error
    that the camera reports.
    """
    options = uri.read(delete=integer_option(0, 1))
    address = uri.place or ADDRESS
    if urlsplit(address).scheme != "http" or not urlsplit(address).hostname:
        raise DeviceError(f"{uri.text}: no HTTP address; expected a URI like theta:{ADDRESS}")
    return ThetaCamera(address, clock, delete=bool(options.get("delete", 0)))
