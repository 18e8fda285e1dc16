"""Provide simulated devices: ``sim:office?seed=1`` as a camera or as a pyranometer.

Camera options: seed, profile (name or path; default: the session's, else sim-dual-fisheye),
clock_offset (s, the camera's clock minus the computer's), overhead (s between frames). Pyranometer
options: seed, noise (W/m2).
"""

from __future__ import annotations

from fieldlum.core.errors import DeviceError
from fieldlum.devices import Camera, Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.uri import DeviceUri, integer_option, number
from fieldlum.session import Session

_SEED = integer_option(0, 2**31)


def _check_place(uri: DeviceUri) -> None:
    if uri.place not in ("office", ""):
        raise DeviceError(
            f"{uri.text}: no simulated place '{uri.place}'; expected sim:office; correct the URI"
        )


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> Camera:
    """Open a simulated camera that photographs the panoramas of `open_world`.

    session : its SITE.toml names the camera profile and the heading, unless the URI has a profile.
    Raises DeviceError for another place than office or an unknown option, InputError for a bad
    profile, SITE.toml or truth/ of the session.
    """
    from fieldlum.core.records import CameraSetup
    from fieldlum.devices.simulated.camera import SimulatedCamera
    from fieldlum.devices.simulated.office import open_world
    from fieldlum.optics.profiles import load_camera_profile

    _check_place(uri)
    options = uri.read(
        seed=_SEED, profile=str, clock_offset=number(-1e9, 1e9), overhead=number(0.0, 600.0)
    )
    seed = options.get("seed", 1)
    setup = session.site_file().camera if session is not None else CameraSetup()
    return SimulatedCamera(
        open_world(session, seed),
        load_camera_profile(options.get("profile", setup.profile)),
        clock,
        heading_deg=setup.heading_deg,
        seed=seed,
        clock_offset_s=options.get("clock_offset", 0.0),
        overhead_s=options.get("overhead"),
    )


def open_pyranometer(
    uri: DeviceUri, *, clock: Clock, session: Session | None = None
) -> Pyranometer:
    """Open a simulated SPN1 on a pseudo-terminal, read by the real driver; see `open_world`.

    Raises DeviceError for another place than office, for unknown options and on Windows, InputError
    for a bad SITE.toml or truth/ of the session.
    """
    from fieldlum.devices.simulated.office import open_world
    from fieldlum.devices.simulated.spn1 import open_simulated

    _check_place(uri)
    options = uri.read(seed=_SEED, noise=number(0.0, 100.0))
    seed = options.get("seed", 1)
    return open_simulated(open_world(session, seed), clock, seed, options.get("noise", 1.0))
