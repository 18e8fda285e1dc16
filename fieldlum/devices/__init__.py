"""Cameras and instruments, each opened by one URI.

    sim:office?seed=1                     the shipped simulators (camera and pyranometer)
    gphoto:  gphoto:Nikon                 a tethered camera
    theta:http://192.168.1.1              a Ricoh Theta
    replay:FOLDER                         frames that were taken before
    serial:/dev/serial/by-id/...?kind=spn1
    serial:/dev/serial/by-id/...?kind=ascii&profile=arduino-json
    modbus:/dev/serial/by-id/...?kind=smp&unit=1
    cl200a:/dev/serial/by-id/...          an illuminance meter

An option that a driver does not have raises a DeviceError with its name. Drivers only query
instruments; no driver changes a setting of one.
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


FORM_ALONE = "form alone"  # the `guard` of an instrument whose lines have no checksum


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What a camera states about itself; empty or None where it states nothing."""

    kind: str  # the driver
    make: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""
    lens: str = ""
    battery: str = ""
    clock_offset_s: float | None = None  # the camera's clock minus the computer's
    frames_left: int | None = None  # that fit on its card


@dataclass(frozen=True, slots=True)
class InstrumentInfo:
    """What an instrument states about itself; empty where it states nothing."""

    kind: str  # the driver or register profile
    model: str = ""
    serial: str = ""
    firmware: str = ""
    calibration_date: str = ""  # ISO
    sensitivity: str = ""  # with its unit
    status: str = ""  # empty: no fault reported
    port: str = ""
    gives: tuple[str, ...] = ("ghi",)  # of ghi, dhi, dni, illuminance
    # How a damaged answer is detected: CRC-16, exclusive or, asked twice; FORM_ALONE: by form only.
    guard: str = ""


class Camera(Protocol):
    """A camera that takes one frame at a time."""

    @property
    def info(self) -> CameraInfo:
        """What the camera states about itself."""
        ...

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame and return its file: the name of `target` plus the camera's suffix.

        heading_deg : view direction of a camera on a turning head. Raises DeviceError if the camera
        cannot take exactly this frame.
        """
        ...

    def close(self) -> None:
        """Release the camera."""
        ...


@runtime_checkable
class BracketingCamera(Protocol):
    """A camera that takes all frames of a bracket by itself after one command."""

    @property
    def bracket_shots(self) -> range:
        """The counts of frames that a bracket may have."""
        ...

    def expose_bracket(self, exposures: Sequence[Exposure], targets: Sequence[Path]) -> list[Path]:
        """Take all frames in the given order, each to its target's name plus a suffix.

        Raises DeviceError.
        """
        ...


@runtime_checkable
class ReportingCamera(Protocol):
    """A camera that states the exposure it took, which may differ from the requested one."""

    def exposure_taken(self, written: Path) -> Exposure | None:
        """Return the exposure of the frame just written; None where it is not known."""
        ...


@runtime_checkable
class Choosing(Protocol):
    """A camera whose settings have fixed steps."""

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError, with the nearest step, for an exposure that is not offered."""
        ...


def refuse_turning(kind: str, heading_deg: float | None) -> None:
    """Raise DeviceError if a frame has a heading: this camera has no turning head."""
    if heading_deg is not None:
        raise DeviceError(
            f"{kind}: this camera has no turning head; remove headings from the site file"
        )


def not_offered(camera: Camera, exposures: Iterable[Exposure]) -> list[str]:
    """Return why a camera will not take these exposures, one sentence each, without repetition.

    Empty for a camera that does not report its steps.
    """
    reasons: list[str] = []
    if not isinstance(camera, Choosing):
        return reasons
    for exposure in exposures:
        try:
            camera.check_offered(exposure)
        except DeviceError as error:
            reasons.append(str(error))
    return list(dict.fromkeys(reasons))


class Pyranometer(Protocol):
    """An instrument that measures irradiance."""

    @property
    def info(self) -> InstrumentInfo:
        """What the instrument states about itself."""
        ...

    def read(self) -> IrradianceSample:
        """Return one reading, taken now.

        Raises DeviceError for silence and for an answer that cannot be trusted.
        """
        ...

    def close(self) -> None:
        """Release the instrument."""
        ...


@runtime_checkable
class Streaming(Protocol):
    """An instrument that sends readings without a request."""

    def refused(self) -> list[str]:
        """Return the lines that were rejected since the last call, each with the reason."""
        ...


@dataclass(frozen=True, slots=True)
class IlluminanceReading:
    """One reading of an illuminance meter; raw is its answer as received."""

    illuminance_lx: float
    low_battery: bool = False
    raw: str = ""


class IlluminanceMeter(Protocol):
    """An instrument that measures illuminance."""

    @property
    def info(self) -> InstrumentInfo:
        """What the meter states about itself."""
        ...

    def read(self) -> IlluminanceReading:
        """Return one reading, taken now. Raises DeviceError."""
        ...

    def close(self) -> None:
        """Release the meter."""
        ...


# Scheme -> module and function; a module is imported only when its scheme is used.
CAMERAS = {
    "sim": ("fieldlum.devices.simulated", "open_camera"),
    "gphoto": ("fieldlum.devices.gphoto", "open_camera"),
    "theta": ("fieldlum.devices.theta", "open_camera"),
    "rpicam": ("fieldlum.devices.rpicam", "open_camera"),
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
            f"{uri.text}: no {what} driver '{uri.scheme}:'; expected one of "
            f"{', '.join(sorted(table))}"
        )
    module, function = table[uri.scheme]
    return getattr(import_module(module), function)


def open_camera(uri: str, *, clock: Clock, session: Session | None = None) -> Camera:
    """Open a camera. Raises DeviceError for an unknown scheme or option, or a missing camera."""
    parsed = parse_uri(uri)
    return _driver(parsed, CAMERAS, "camera")(parsed, clock=clock, session=session)


def open_pyranometer(uri: str, *, clock: Clock, session: Session | None = None) -> Pyranometer:
    """Open a pyranometer. Raises DeviceError as `open_camera` does.

    session : its simulated truth is read by the simulator; other drivers ignore it.
    """
    parsed = parse_uri(uri)
    return _driver(parsed, PYRANOMETERS, "pyranometer")(parsed, clock=clock, session=session)


def open_meter(uri: str, *, clock: Clock) -> IlluminanceMeter:
    """Open an illuminance meter next to the lens: ``cl200a:/dev/serial/by-id/...``.

    Raises DeviceError.
    """
    parsed = parse_uri(uri)
    return _driver(parsed, METERS, "illuminance meter")(parsed, clock=clock)
