"""Cameras and instruments behind one URI each.

    sim:office?seed=1                     the shipped simulators (camera and pyranometer)
    gphoto:  gphoto:Nikon                 a tethered camera
    theta:http://192.168.1.1              a Ricoh Theta
    replay:FOLDER                         frames that were taken before
    serial:/dev/serial/by-id/...?kind=spn1
    serial:/dev/serial/by-id/...?kind=ascii&profile=arduino-json
    modbus:/dev/serial/by-id/...?kind=smp&unit=1
    cl200a:/dev/serial/by-id/...          an illuminance meter

An option that a driver does not know is a DeviceError naming it. Drivers only ever ask instruments;
none writes to one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from fieldlum.devices.uri import DeviceUri, parse_uri
from fieldlum.errors import DeviceError
from fieldlum.records import Exposure, IrradianceSample

if TYPE_CHECKING:
    from fieldlum.devices.clock import Clock
    from fieldlum.session import Session


FORM_ALONE = "form alone"


@dataclass(frozen=True, slots=True)
class CameraInfo:
    kind: str  # the driver
    make: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""
    lens: str = ""
    battery: str = ""
    clock_offset_s: float | None = None  # camera's clock minus ours, where the camera tells
    frames_left: int | None = None  # on its card, where the camera tells


@dataclass(frozen=True, slots=True)
class InstrumentInfo:
    kind: str  # the driver or register profile
    model: str = ""
    serial: str = ""
    firmware: str = ""
    calibration_date: str = ""  # ISO
    sensitivity: str = ""  # with its unit
    status: str = ""  # empty: all well
    port: str = ""
    gives: tuple[str, ...] = ("ghi",)  # of ghi, dhi, dni, illuminance
    guard: str = (
        ""  # what shows a damaged answer: CRC-16, exclusive or, asked twice; FORM_ALONE is none
    )


class Camera(Protocol):
    @property
    def info(self) -> CameraInfo: ...

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame and return its file: `target`'s name with the camera's suffix put behind
        it.

        heading_deg: where a turned head shall look. Raises DeviceError when the camera cannot do
        just this.
        """
        ...

    def close(self) -> None: ...


@runtime_checkable
class BracketingCamera(Protocol):
    """A camera that takes a whole bracket by itself, in one go."""

    @property
    def bracket_shots(self) -> range:
        """How many frames a bracket may have."""
        ...

    def expose_bracket(self, exposures: Sequence[Exposure], targets: Sequence[Path]) -> list[Path]:
        """All frames in the order asked for, each to its target's name with a suffix. Raises
        DeviceError.
        """
        ...


@runtime_checkable
class Choosing(Protocol):
    """A camera that offers its settings in steps."""

    def check_offered(self, exposure: Exposure) -> None:
        """Raises DeviceError, naming the nearest, for an exposure that is not offered."""
        ...


def not_offered(camera: Camera, exposures: Iterable[Exposure]) -> list[str]:
    """Why a camera will take none of these frames: a sentence each, doubles once; none for one
    that takes anything.
    """
    said: list[str] = []
    if not isinstance(camera, Choosing):
        return said
    for exposure in exposures:
        try:
            camera.check_offered(exposure)
        except DeviceError as error:
            said.append(str(error))
    return list(dict.fromkeys(said))


class Pyranometer(Protocol):
    @property
    def info(self) -> InstrumentInfo: ...

    def read(self) -> IrradianceSample:
        """One reading, now. Raises DeviceError for silence and for an answer that cannot be
        trusted.
        """
        ...

    def close(self) -> None: ...


@runtime_checkable
class Streaming(Protocol):
    """An instrument that talks by itself."""

    def refused(self) -> list[str]:
        """What of its lines was refused since this was last asked: why, and the line as it came."""
        ...


@dataclass(frozen=True, slots=True)
class IlluminanceReading:
    illuminance_lx: float
    low_battery: bool = False
    raw: str = ""


class IlluminanceMeter(Protocol):
    @property
    def info(self) -> InstrumentInfo: ...

    def read(self) -> IlluminanceReading:
        """One reading, now. Raises DeviceError."""
        ...

    def close(self) -> None: ...


# Scheme -> module and function; modules are imported when their scheme is asked for.
CAMERAS = {
    "sim": ("fieldlum.devices.simulated", "open_camera"),
    "gphoto": ("fieldlum.devices.gphoto", "open_camera"),
    "theta": ("fieldlum.devices.theta", "open_camera"),
    "replay": ("fieldlum.devices.replay", "open_camera"),
}
METERS = {
    "cl200a": ("fieldlum.devices.cl200a", "open_meter"),
}
PYRANOMETERS = {
    "sim": ("fieldlum.devices.simulated", "open_pyranometer"),
    "serial": ("fieldlum.devices.serial_ascii", "open_pyranometer"),
    "modbus": ("fieldlum.devices.modbus", "open_pyranometer"),
}


def _driver(uri: DeviceUri, table: dict[str, tuple[str, str]], what: str) -> Any:
    if uri.scheme not in table:
        raise DeviceError(
            f"{uri.text}: no {what} driver '{uri.scheme}:', there are {', '.join(sorted(table))}"
        )
    module, function = table[uri.scheme]
    return getattr(import_module(module), function)


def open_camera(uri: str, *, clock: Clock, session: Session | None = None) -> Camera:
    """Raises DeviceError for an unknown scheme or option, or a camera that is not there."""
    asked = parse_uri(uri)
    return _driver(asked, CAMERAS, "camera")(asked, clock=clock, session=session)


def open_pyranometer(uri: str, *, clock: Clock, session: Session | None = None) -> Pyranometer:
    """`session` matters to the simulator only: its truth. Raises DeviceError as `open_camera`."""
    asked = parse_uri(uri)
    return _driver(asked, PYRANOMETERS, "pyranometer")(asked, clock=clock, session=session)


def open_meter(uri: str, *, clock: Clock) -> IlluminanceMeter:
    """An illuminance meter beside the lens: ``cl200a:/dev/serial/by-id/...``. Raises
    DeviceError.
    """
    asked = parse_uri(uri)
    return _driver(asked, METERS, "illuminance meter")(asked, clock=clock)
