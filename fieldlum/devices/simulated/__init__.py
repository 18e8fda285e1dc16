"""Provide simulated devices: ``sim:office?seed=1`` as a camera or as a pyranometer.

Camera options: seed, profile (name or path; default: the session's, else sim-dual-fisheye),
clock_offset (s, the camera's clock minus the computer's), overhead (s between frames). Pyranometer
options: seed, noise (W/m2).
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError
from fieldlum.devices import Camera, Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.uri import DeviceUri
from fieldlum.session import Session

_Seed = Annotated[int, Meta(ge=0, le=2**31)]


class _CameraOptions(Struct):
    seed: _Seed = 1
    profile: str = ""
    clock_offset: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0
    overhead: Annotated[float, Meta(ge=0.0, le=600.0)] | None = None


class _PyranometerOptions(Struct):
    seed: _Seed = 1
    noise: Annotated[float, Meta(ge=0.0, le=100.0)] = 1.0


def _check_place(uri: DeviceUri) -> None:
    if uri.place not in ("office", ""):
        found = f"no simulated place '{uri.place}'; expected sim:office"
        raise DeviceError(f"{uri.text}: {found}; correct the URI")


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> Camera:
    """Open a simulated camera that photographs the panoramas of `open_world`.

    session : its SITE.toml names the camera profile and the heading, unless the URI has a profile.
    Raises DeviceError for another place than office or an unknown option, InputError for a bad
    profile, SITE.toml or truth/ of the session.
    """
    from fieldlum.core.records import CameraSetup
    from fieldlum.devices.simulated.camera import SimulatedCamera
    from fieldlum.devices.simulated.world import open_world
    from fieldlum.optics.profiles import load_camera_profile

    _check_place(uri)
    options = uri.read(_CameraOptions)
    setup = session.site_file().camera if session is not None else CameraSetup()
    return SimulatedCamera(
        open_world(session, options.seed),
        load_camera_profile(options.profile or setup.profile),
        clock,
        heading_deg=setup.heading_deg,
        seed=options.seed,
        clock_offset_s=options.clock_offset,
        overhead_s=options.overhead,
    )


def open_pyranometer(
    uri: DeviceUri, *, clock: Clock, session: Session | None = None
) -> Pyranometer:
    """Open a simulated SPN1; see `open_world`.

    Raises DeviceError for another place than office and for unknown options, InputError for a bad
    SITE.toml or truth/ of the session.
    """
    from fieldlum.devices.simulated.spn1 import SimulatedSpn1
    from fieldlum.devices.simulated.world import open_world

    _check_place(uri)
    options = uri.read(_PyranometerOptions)
    return SimulatedSpn1(open_world(session, options.seed), clock, options.seed, options.noise)
