"""Provide simulated devices: ``sim:office?seed=1`` as a camera or as a pyranometer.

Camera options: seed, profile (name or path; default: the session's, else sim-dual-fisheye),
clock_offset (s, the camera's clock minus the computer's). Pyranometer options: seed, noise (W/m2).
"""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import CameraSetup, IrradianceSample
from fieldlum.devices import Camera, DeviceUri, InstrumentInfo, Pyranometer, spn1
from fieldlum.devices.clock import Clock
from fieldlum.devices.simulated.world import World, open_world
from fieldlum.session import Session


class SimulatedSpn1(Pyranometer):
    """A simulated SPN1, whose answers have the form of the instrument's and are read like those.

    world : the simulated place; seed : of its noise; noise_wm2 : standard deviation of the noise.
    """

    def __init__(self, world: World, clock: Clock, seed: int, noise_wm2: float) -> None:
        self._world, self._clock, self._noise_wm2 = world, clock, noise_wm2
        self._rng = np.random.default_rng([seed, 1])
        serial, gives = f"A{100 + seed % 900}", ("ghi", "dhi")
        self.info = InstrumentInfo("spn1", model="Delta-T SPN1", serial=serial, gives=gives)

    def read(self) -> IrradianceSample:
        """Return a reading on which two answers agree; raise DeviceError if none do."""
        return spn1.agreed_sample(self._clock.now(), self.answer)

    def answer(self) -> bytes:
        """Return the instrument's answer to the command S, without the echo."""
        light = self._world.irradiance(self._clock.now())
        noise = self._rng.normal(0.0, self._noise_wm2, 2)
        total, diffuse = np.maximum(np.array([light.ghi_wm2, light.dhi_wm2]) + noise, 0.0)
        # The instrument's rule for a beam over 120 W/m2 (SPN1 User Manual, p. 20).
        sunshine = total > 1.35 * diffuse and total > 24.0
        return b"%6.1f,%6.1f,%d\r" % (total, diffuse, sunshine)


_Seed = Annotated[int, Meta(ge=0, le=2**31)]


class _CameraOptions(Struct):
    """Options of the URI as a camera; clock_offset: its clock minus the computer's [s].

    seed: of noise and clouds; profile: name or path of the camera profile, "" for the session's.
    """

    seed: _Seed = 1
    profile: str = ""
    clock_offset: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0


class _PyranometerOptions(Struct):
    """Options of the URI as a pyranometer.

    seed: of noise and clouds; noise: standard deviation of its noise [W/m2].
    """

    seed: _Seed = 1
    noise: Annotated[float, Meta(ge=0.0, le=100.0)] = 1.0


def _check_place(uri: DeviceUri) -> None:
    """Raise DeviceError unless the place of a URI is office or empty."""
    if uri.place not in ("office", ""):
        found = f"no simulated place '{uri.place}'; expected sim:office"
        raise DeviceError(f"{uri.text}: {found}; correct the URI")


def open_camera(uri: DeviceUri, *, clock: Clock, session: Session | None = None) -> Camera:
    """Open a simulated camera, which photographs a simulated session or office.

    clock : simulated or real; session : its SITE.toml states the heading, and the camera profile
    unless the URI does; None for defaults and an office. Raises DeviceError for another place than
    office or an unknown option, InputError for a bad profile, SITE.toml or truth/ of the session.
    """
    from fieldlum.devices.simulated.camera import SimulatedCamera
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
    )


def open_pyranometer(uri: DeviceUri, clock: Clock, session: Session | None = None) -> Pyranometer:
    """Open a simulated SPN1, which measures the irradiance of a simulated session or office.

    clock : simulated or real; session : None for an office. Raises DeviceError for another place
    than office and for unknown options, InputError for a bad SITE.toml or truth/ of the session.
    """
    _check_place(uri)
    options = uri.read(_PyranometerOptions)
    return SimulatedSpn1(open_world(session, options.seed), clock, options.seed, options.noise)
