"""Open serial pyranometers: ``serial:PLACE?kind=spn1`` or ``?kind=ascii&profile=NAME``.

PLACE is a device file or usb=VID:PID:SERIAL.
"""

from __future__ import annotations

from fieldlum.core.errors import DeviceError
from fieldlum.devices import Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.uri import DeviceUri, integer_option, number, one_of
from fieldlum.session import Session


def open_pyranometer(
    uri: DeviceUri, *, clock: Clock, session: Session | None = None
) -> Pyranometer:
    """Open the serial pyranometer that a URI names: an SPN1, or one that prints lines.

    Raises DeviceError for unknown options, a missing port, kind or profile, and for an SPN1 that
    does not answer; InputError for a broken profile.
    """
    if not uri.place:
        raise DeviceError(
            f"{uri.text}: no port; expected a URI like serial:/dev/serial/by-id/NAME?kind=spn1"
        )
    kind = one_of("spn1", "ascii")
    if uri.options.get("kind") == "ascii":
        return _open_lines(uri, clock)
    options = uri.read(kind=kind, baud=integer_option(300, 921600), timeout=number(0.1, 60.0))
    if "kind" not in options:
        raise DeviceError(f"{uri.text}: no kind; add ?kind=spn1 or ?kind=ascii&profile=NAME")
    from fieldlum.devices.spn1 import Spn1

    return Spn1(
        uri.place, clock, baud=options.get("baud", 9600), timeout_s=options.get("timeout", 2.0)
    )


def _open_lines(uri: DeviceUri, clock: Clock) -> Pyranometer:
    from fieldlum.devices.ascii_lines import load_ascii_profile
    from fieldlum.devices.serial_lines import LineInstrument

    options = uri.read(kind=str, profile=str, silence=number(0.1, 600.0))
    if "profile" not in options:
        raise DeviceError(
            f"{uri.text}: no profile; add &profile=NAME or &profile= and the path of a TOML file"
        )
    profile = load_ascii_profile(options["profile"])
    return LineInstrument(uri.place, profile, clock, silence_s=options.get("silence"))
