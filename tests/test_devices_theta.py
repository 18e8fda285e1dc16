"""devices: a Theta, played by a local server that speaks the documented protocol (RICOH THETA
Web API v2.1).
"""

import io
import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldlum.capture.frame_checks import compare_exif
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure
from fieldlum.devices import open_camera
from fieldlum.devices.clock import FastClock
from fieldlum.devices.theta import ThetaCamera
from fieldlum.optics.raw.writing import write_dng, write_jpeg

pytestmark = pytest.mark.contract

START = datetime(2027, 3, 20, 15, tzinfo=UTC)


class Theta(BaseHTTPRequestHandler):
    """State lives in the server's `camera` dictionary."""

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def _answer(self, reply: dict[str, Any], code: int = 200) -> None:
        body = json.dumps(reply).encode()
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    @property
    def camera(self) -> dict[str, Any]:
        return self.server.camera  # type: ignore[attr-defined]

    def do_GET(self) -> None:
        if self.path == "/osc/info":
            about = {
                "manufacturer": "RICOH",
                "model": "RICOH THETA Z1",
                "serialNumber": "YN14",
                "firmwareVersion": "3",
            }
            return self._answer(about)
        body = self.camera["files"][self.path]
        self.send_response(200)
        self.send_header("Content-Length", str(len(body) + self.camera.get("short", 0)))
        self.end_headers()
        self.wfile.write(body)

    def do_POST(self) -> None:
        sent = json.loads(self.rfile.read(int(self.headers["Content-Length"])) or b"{}")
        if self.path == "/osc/state":
            return self._answer({"state": {"batteryLevel": 0.67}})
        if self.path == "/osc/commands/status":
            self.camera["polls"] -= 1
            if self.camera["polls"] > 0:
                return self._answer(
                    {"state": "inProgress", "id": sent["id"], "progress": {"completion": 0.5}}
                )
            return self._answer({"state": "done", "results": self.camera["results"]})
        command = sent["name"].removeprefix("camera.")
        if command in self.camera["errors"]:
            error = {"code": self.camera["errors"][command], "message": "no"}
            return self._answer({"name": sent["name"], "state": "error", "error": error}, 403)
        getattr(self, f"_{command}")(sent.get("parameters", {}))

    def _done(self, results: dict[str, Any]) -> None:
        self._answer({"state": "done", "results": results})

    def _getOptions(self, parameters: dict[str, Any]) -> None:
        known = self.camera["options"]
        self._done({"options": {n: known[n] for n in parameters["optionNames"] if n in known}})

    def _setOptions(self, parameters: dict[str, Any]) -> None:
        self.camera["options"].update(parameters["options"])
        self._done({})

    def _delete(self, parameters: dict[str, Any]) -> None:
        self.camera["deleted"] += parameters["fileUrls"]
        self._done({})

    def _store(self, exposure: Exposure, suffix: str) -> str:
        path = self.camera["folder"] / f"R{len(self.camera['files']):04d}{suffix}"
        if suffix == ".DNG":
            write_dng(
                path, np.full((8, 8), 600, np.uint16), exposure, black_dn=(512,) * 4, white_dn=16383
            )
        else:
            write_jpeg(path, np.full((8, 8, 3), 99, np.uint8), exposure)
        self.camera["files"][f"/files/{path.name}"] = path.read_bytes()
        return f"{self.camera['address']}/files/{path.name}"

    def _takePicture(self, parameters: dict[str, Any]) -> None:
        o = self.camera["options"]
        exposure = Exposure(o["shutterSpeed"] * self.camera["lie"], o["aperture"], o["iso"])
        self.camera["results"] = {"fileUrl": self._store(exposure, ".JPG"), "_dngFileUrl": ""}
        if self.camera["raw"]:
            self.camera["results"]["_dngFileUrl"] = self._store(exposure, ".DNG")
        self.camera["polls"] = 3
        self._answer({"state": "inProgress", "id": "7"})


@pytest.fixture
def theta(tmp_path: Path) -> Iterator[dict[str, Any]]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Theta)
    (tmp_path / "camera").mkdir()
    options = {
        "shutterSpeedSupport": [0.25, 0.1, 0.01666666, 0.004, 0.001],
        "isoSupport": [80, 100, 200],
        "apertureSupport": [2.1, 3.5, 5.6],
        "remainingPictures": 412,
        "dateTimeZone": "2027:03:20 16:00:03+01:00",
    }
    server.camera = {  # type: ignore[attr-defined]
        "options": options,
        "files": {},
        "errors": {},
        "raw": True,
        "lie": 1.0,
        "deleted": [],
        "polls": 0,
        "folder": tmp_path / "camera",
        "address": f"http://127.0.0.1:{server.server_port}",
    }
    thread = threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
    )
    thread.start()
    yield server.camera  # type: ignore[attr-defined]
    server.shutdown()
    thread.join()
    server.server_close()


def opened(theta: dict[str, Any], options: str = "") -> ThetaCamera:
    camera = open_camera(f"theta:{theta['address']}{options}", clock=FastClock(START))
    assert isinstance(camera, ThetaCamera)
    return camera


def test_info_and_one_raw_picture(theta: dict[str, Any], tmp_path: Path) -> None:
    camera = opened(theta, "?delete=1")
    info = camera.info
    assert (info.model, info.serial, info.battery, info.frames_left) == (
        "RICOH THETA Z1",
        "YN14",
        "67 %",
        412,
    )
    assert info.clock_offset_s == 3.0
    path = camera.expose(Exposure(1 / 250, 5.6, 100.0), tmp_path / "f00.x")
    assert path.name == "f00.x.dng" and path.read_bytes() == theta["files"]["/files/R0001.DNG"]
    assert theta["options"]["exposureProgram"] == 1 and theta["options"]["shutterSpeed"] == 0.004
    assert len(theta["deleted"]) == 2
    camera.close()


def test_nothing_snaps_silently(theta: dict[str, Any], tmp_path: Path) -> None:
    camera = opened(theta)
    with pytest.raises(DeviceError, match=r"theta shutter: 0.033333 s is not offered"):
        camera.expose(Exposure(1 / 30, 5.6), tmp_path / "f")
    with pytest.raises(DeviceError, match=r"theta aperture: 8 is not offered"):
        camera.expose(Exposure(0.004, 8.0), tmp_path / "f")
    assert not list(tmp_path.glob("f*"))
    with pytest.raises(DeviceError, match="no turning head"):
        camera.expose(Exposure(0.004, 5.6), tmp_path / "f", heading_deg=0.0)


@pytest.mark.slow
def test_what_the_camera_made_is_kept(theta: dict[str, Any], tmp_path: Path) -> None:
    theta["lie"] = 2.0
    asked = Exposure(0.004, 5.6)
    path = opened(theta, "?delete=1").expose(asked, tmp_path / "f")
    assert path.read_bytes() == theta["files"]["/files/R0001.DNG"] and len(theta["deleted"]) == 2
    assert compare_exif(path, asked)[0] == "shutter 0.008 instead of 0.004"


def test_its_errors_become_ours(theta: dict[str, Any], tmp_path: Path) -> None:
    camera = opened(theta)
    theta["errors"] = {"takePicture": "noFreeSpace"}
    with pytest.raises(DeviceError, match=r"camera.takePicture: noFreeSpace: no"):
        camera.expose(Exposure(0.004, 5.6), tmp_path / "f")
    theta["errors"], theta["short"] = {}, 10
    with pytest.raises(DeviceError, match=r"IncompleteRead|is incomplete"):
        camera.expose(Exposure(0.004, 5.6), tmp_path / "f")
    theta["short"], theta["address"] = 0, "http://192.0.2.9"
    with pytest.raises(DeviceError, match="expected a file at"):
        camera.expose(Exposure(0.004, 5.6), tmp_path / "f")


def test_one_that_never_ends(
    theta: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = opened(theta)
    monkeypatch.setattr("fieldlum.devices.theta.POLL_S", 30.0)  # of a clock that does not wait
    monkeypatch.setattr(
        Theta,
        "_takePicture",
        lambda self, p: (theta.update(polls=99), self._answer({"state": "inProgress", "id": "7"}))[
            1
        ],
    )
    with pytest.raises(DeviceError, match="did not end within"):
        camera.expose(Exposure(0.004, 5.6), tmp_path / "f")


def test_nobody_there() -> None:
    with pytest.raises(DeviceError, match="connect the computer"):
        ThetaCamera("http://127.0.0.1:9", FastClock(START))
    for bad in ("theta:ftp://192.168.1.1", "theta:192.168.1.1"):
        with pytest.raises(DeviceError, match="no HTTP address"):
            open_camera(bad, clock=FastClock(START))


def test_what_is_no_theta(theta: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for body in (b"<html>router</html>", b"[1]", b"\xff"):
        monkeypatch.setattr(
            ThetaCamera,
            "_http",
            lambda self, request, timeout_s, body=body: io.BytesIO(body).read(),
        )
        with pytest.raises(DeviceError, match="expected a JSON object; check that the address"):
            opened(theta)
