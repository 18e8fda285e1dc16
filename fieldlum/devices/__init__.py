"""Cameras and instruments, each opened by one URI.

    sim:office?seed=1                     the shipped simulators (camera and pyranometer)
    gphoto:  gphoto:Nikon                 a tethered camera
    theta:http://192.168.1.1              a Ricoh Theta
    rpicam:0?f_number=2.0                 a Raspberry Pi camera
    serial:/dev/serial/by-id/...?kind=spn1
    serial:/dev/serial/by-id/...?kind=ascii&profile=arduino-json
    modbus:/dev/serial/by-id/...?kind=smp&unit=1
    cl200a:/dev/serial/by-id/...          an illuminance meter
    t10a:/dev/serial/by-id/...?head=3     one head of a chain of illuminance meters

An option that a driver does not have raises a DeviceError with its name. No driver changes an
instrument's calibration or writes its registers.
"""

import math
import os
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl, unquote

from msgspec import Struct

from fieldlum.core.errors import DeviceError, InputError, did_you_mean
from fieldlum.core.records import Exposure, IrradianceSample, shutter_text
from fieldlum.core.strict_toml import build
from fieldlum.devices.clock import Clock
from fieldlum.optics.exposure import SAME_SETTING_EV
from fieldlum.session import Session

T = TypeVar("T")
# Most calls for one result, while a camera is busy or a meter changes its range; chosen, not
# measured.
_MAX_TRIES = 4


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What a camera reports about itself; "" or None where the driver does not know a value.

    kind : the driver, such as gphoto; battery : the level as a text, such as "80 %"; clock_offset_s
    : the camera's clock minus the computer's [s]; frames_left : number of frames that still fit on
    its storage.
    """

    kind: str
    make: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""
    lens: str = ""
    battery: str = ""
    clock_offset_s: float | None = None
    frames_left: int | None = None


@dataclass(frozen=True, slots=True)
class InstrumentInfo:
    """What is known about an instrument, from its answers, profile or driver; "" where unknown.

    kind : the driver or register profile; calibration_date : in ISO form; sensitivity : with its
    unit; status : "" if no fault is reported; port : file or network address of its connection;
    gives : quantities that it measures, of ghi, dhi, dni, illuminance; is_checked : whether a
    checksum or a second query reveals damaged answers; False if only their form does.
    """

    kind: str
    model: str = ""
    serial: str = ""
    firmware: str = ""
    calibration_date: str = ""
    sensitivity: str = ""
    status: str = ""
    port: str = ""
    gives: tuple[str, ...] = ("ghi",)
    is_checked: bool = True


class Device:
    """A camera or an instrument that was opened by its URI."""

    def close(self) -> None:
        """Release the device for other programs."""


class Camera(Device, ABC):
    """A camera that takes one frame at a time; info : what it reports about itself.

    A driver implements `expose`, `close` if it holds a connection open, and those of the other
    methods that its camera supports.
    """

    info: CameraInfo

    @abstractmethod
    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        """Take one frame, write it to `target` plus the camera's suffix, and return the file.

        heading_deg : view direction [deg clockwise from north], for a camera on a turning head;
        others ignore or reject it. Raises DeviceError if the camera fails or does not offer this
        exposure, OSError if the disk is full.
        """

    def check_offered(self, exposure: Exposure) -> None:
        """Raise DeviceError, with the reason, for an exposure that the camera cannot take.

        A camera that does not override this method takes any exposure.
        """

    def exposure_taken(self, written: Path) -> Exposure | None:
        """Return the exposure of the newest frame, the file `written`; None if not reported."""
        return None

    def refuse_turning(self, heading_deg: float | None) -> None:
        """Raise DeviceError unless `heading_deg` is None, for a camera without a turning head."""
        if heading_deg is not None:
            remedy = "remove headings from the site file and plan a new session with it"
            raise DeviceError(f"{self.info.kind}: this camera has no turning head; {remedy}")


def not_offered(camera: Camera, exposures: Iterable[Exposure]) -> list[str]:
    """Return the reasons why the camera cannot take some of these exposures; empty if it can.

    A reason is a text of `check_offered`; if it is that of several exposures, it is returned once.
    """
    reasons: list[str] = []
    for exposure in exposures:
        try:
            camera.check_offered(exposure)
        except DeviceError as error:
            reasons.append(str(error))
    return list(dict.fromkeys(reasons))


def store_frame(path: Path, body: bytes) -> None:
    """Write the bytes of a frame's file, and return when the disk has stored them.

    Raises OSError, for example if the disk is full.
    """
    with path.open("wb") as file:
        file.write(body)
        file.flush()
        os.fsync(file.fileno())


def retry(
    action: Callable[[], T], is_temporary: Callable[[Exception], bool], pause_s: float = 0.0
) -> T:
    """Return the result of `action`; call it up to four times, if an error is temporary.

    is_temporary: returns whether an error may not occur again, such as that of a busy device;
    pause_s: time between two calls [s]. Raises the error of the last call, or the first error that
    is not temporary.
    """
    for _ in range(_MAX_TRIES - 1):
        try:
            return action()
        except Exception as error:
            if not is_temporary(error):
                raise
        time.sleep(pause_s)
    return action()


class Pyranometer(Device, ABC):
    """An instrument that measures irradiance; info : what it reports about itself."""

    info: InstrumentInfo

    @abstractmethod
    def read(self) -> IrradianceSample:
        """Return one reading: a new one, or the newest that the instrument sent by itself.

        Raises DeviceError if the instrument does not answer, or if the answer is damaged or
        impossible.
        """

    def refused(self) -> list[str]:
        """Return the lines rejected since the last call (the newest 100), each with the reason.

        Here there are none; instruments that send lines by themselves override the method.
        """
        return []


class IlluminanceMeter(Device, ABC):
    """An instrument that measures illuminance; info : its kind, model and port."""

    info: InstrumentInfo

    @abstractmethod
    def read(self) -> float:
        """Measure the illuminance [lx]. Raises DeviceError if the meter cannot measure it."""


Options = TypeVar("Options", bound=Struct)


@dataclass(frozen=True, slots=True)
class DeviceUri:
    """A parsed device URI: scheme:place?name=value&name=value.

    text : the complete URI; scheme : names the driver; place : a port, address or folder, by the
    driver; options : the values as text, by name.
    """

    text: str
    scheme: str
    place: str = ""
    options: dict[str, str] = field(default_factory=dict)

    def read(self, options_type: type[Options]) -> Options:
        """Return the URI's options as an object of `options_type`, the Struct of the driver.

        Its fields state the name, type, limits and default of each option. Raises DeviceError, with
        the option's name, for an option that has no field and for a value that does not fit.
        """
        try:
            return build(options_type, self.options, self.text, strict=False)
        except InputError as error:
            raise DeviceError(str(error).replace("unknown key", "unknown option")) from None


def parse_uri(text: str) -> DeviceUri:
    """Return the parts of a device URI, such as ``modbus:/dev/ttyUSB0?kind=smp``.

    Raises DeviceError for a text without a scheme, and for an option that is repeated or has no =.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or not re.fullmatch(r"[a-z][a-z0-9+]*", scheme):
        example = "sim:office or serial:/dev/ttyUSB0?kind=spn1"
        raise DeviceError(f"{text}: not a device URI; expected one like {example}")
    place, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise DeviceError(f"{text}: options '{query}'; expected name=value joined by &") from None
    if len(dict(pairs)) < len(pairs):
        raise DeviceError(f"{text}: an option occurs twice; remove one of the two")
    return DeviceUri(text, scheme, unquote(place), dict(pairs))


# Module of fieldlum.devices by scheme of the URI; its `open_camera`, `open_meter` or
# `open_pyranometer` opens the device. A module is imported only when its scheme is used.
CAMERAS = {"sim": "simulated"} | {name: name for name in ("gphoto", "theta", "rpicam")}
METERS = {"cl200a": "cl200a", "t10a": "cl200a"}
PYRANOMETERS = {"sim": "simulated", "serial": "ascii_lines", "modbus": "modbus"}


def _open(text: str, modules: dict[str, str], device: str, **arguments: Any) -> Any:
    """Return the device that a URI names, opened by the driver of the URI's scheme.

    text: the URI; modules: the drivers by scheme; device: "camera", "pyranometer" or "meter";
    arguments: of the driver's function, such as `open_camera`. Raises DeviceError for an unknown
    scheme, and the errors of the driver.
    """
    uri = parse_uri(text)
    if uri.scheme not in modules:
        expected = f"expected one of {', '.join(sorted(modules))}"
        remedy = f"correct the URI{did_you_mean(uri.scheme, modules)}"
        raise DeviceError(f"{text}: no {device} driver '{uri.scheme}:'; {expected}; {remedy}")
    driver = import_module(f"fieldlum.devices.{modules[uri.scheme]}")
    return getattr(driver, f"open_{device}")(uri, **arguments)


def open_camera(uri: str, *, clock: Clock, session: Session | None = None) -> Camera:
    """Open the camera that a device URI names, such as ``gphoto:``, by the driver of its scheme.

    clock : gives the time, and waits for the camera. session : the simulator reads its SITE.toml
    and its rendered panoramas, rpicam its planned aperture; other drivers ignore it. Raises
    DeviceError for a malformed URI, an unknown scheme or option, or a missing camera; InputError
    for a file of the session or a camera profile that cannot be used.
    """
    return _open(uri, CAMERAS, "camera", clock=clock, session=session)


def open_pyranometer(uri: str, *, clock: Clock, session: Session | None = None) -> Pyranometer:
    """Open the pyranometer that a device URI names, such as ``modbus:/dev/ttyUSB0?kind=smp``.

    clock : gives the times of readings. session : the simulator reads its SITE.toml and simulated
    irradiance; other drivers ignore it. Raises DeviceError for a malformed URI, an unknown scheme
    or option, or a missing instrument; InputError for a file of the session or an instrument
    profile that cannot be used.
    """
    return _open(uri, PYRANOMETERS, "pyranometer", clock=clock, session=session)


def open_meter(uri: str, *, clock: Clock, session: Session | None = None) -> IlluminanceMeter:
    """Open the illuminance meter that a device URI names, such as ``cl200a:/dev/ttyUSB0``.

    clock : waits for the meter. session : not used; the other openers have it too, and a capture
    calls all three alike. Raises DeviceError for a malformed URI, an unknown scheme or option, a
    port that cannot be opened, or a meter that does not answer.
    """
    return _open(uri, METERS, "meter", clock=clock)


def nearest(
    planned: float, offered: Iterable[float], name: str, unit: str = "", *, ev_per_double: float = 1
) -> float:
    """Return the value, of those that a camera offers, that is nearest by ratio to a planned one.

    name : of the setting, such as "theta shutter", and unit : of the values, for errors.
    ev_per_double : change of the exposure [EV] for twice the value: 2 for f-numbers, 1 for shutter
    times and ISO. Raises DeviceError if the nearest value is more than 1/6 EV away, or if no
    positive value is offered or planned.
    """
    choices, shown = [value for value in offered if value > 0], f"{planned:.5g} {unit}".strip()
    if not (planned > 0 and choices):
        found = f"{shown} planned, but the camera offers no values to set"
        raise DeviceError(f"{name}: {found}; turn it to its manual mode")
    best = min(choices, key=lambda value: abs(math.log2(value / planned)))
    if abs(ev_per_double * math.log2(best / planned)) > SAME_SETTING_EV:
        step = shutter_text(best) if unit == "s" else f"{best:.5g}"
        found = f"{shown} is not offered by the camera; the nearest value is {step}"
        raise DeviceError(f"{name}: {found}: plan with that value")
    return best
