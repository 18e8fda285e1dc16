"""Sun discs of merged panoramas as a prior of the scene: sidecars in, north and level out."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Panorama, Room, Site, SunSource, Window
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.merge import MergeOptions, Shot, merge_shots
from fieldlum.optics.profiles import bracket_exposures, load_camera_profile
from fieldlum.room.fit.guess import guess_of
from fieldlum.room.fit.parameters import LEVEL_SD_DEG
from fieldlum.room.fit.pose_prior import (
    pose_note,
    pose_of,
    prior_of,
)
from fieldlum.session import Session
from fieldlum.session.files.sidecar import MeasuredSun, Sidecar, SidecarSun
from fieldlum.sky import sun
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs, read_discs

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles")
TIMES = [datetime(2027, 3, 20, 17, 30, tzinfo=UTC) + timedelta(hours=1.3 * k) for k in range(5)]
NORTH_DEG = 1.3


def _write_sidecar(session: Session, slot: str, when: datetime, place: tuple[float, ...]) -> None:
    session.panoramas.mkdir(exist_ok=True)
    seen = SidecarSun(measured=MeasuredSun(*place, when))
    Sidecar(slot, when, sun=seen).write(session.sidecar(slot))


def _slot(when: datetime) -> str:
    return f"{when:%Y%m%dT%H%M%SZ}"


@pytest.mark.analytic
def test_sidecars_give_the_pose(tmp_path: Path) -> None:
    session = Session(tmp_path)
    assert len(read_discs(session)) == 0
    shown = sun.position(TIMES, SEATTLE)
    for k, when in enumerate(TIMES):
        place = (shown.apparent_altitude_deg[k], shown.azimuth_deg[k] - NORTH_DEG, 0.03)
        _write_sidecar(session, _slot(when), when, tuple(map(float, place)))
    Sidecar("20270320T150000Z").write(session.sidecar("20270320T150000Z"))  # shows no disc
    discs = read_discs(session)
    assert len(discs) == len(TIMES)
    pose = pose_of(discs, SEATTLE, 180.0, 0.1)
    assert pose is not None and pose["heading_deg"] == pytest.approx(NORTH_DEG, abs=0.01)
    assert pose.u["heading_deg"] < 0.05 and "5 measured sun discs" in pose_note(pose, len(discs))
    one = np.ones(2)
    two = MeasuredDiscs(one, one, one, tuple(TIMES[:2]))
    assert pose_of(two, SEATTLE, 180.0, 0.1) is None


@pytest.mark.property
def test_an_open_clock_leaves_a_valley_and_no_wrong_north() -> None:
    shown = sun.position(TIMES, SEATTLE)
    discs = MeasuredDiscs(
        shown.apparent_altitude_deg, shown.azimuth_deg - NORTH_DEG, np.full(5, 0.03), tuple(TIMES)
    )
    pose = pose_of(discs, SEATTLE, 180.0, 5.0)
    assert pose is not None
    prior = prior_of(pose)
    start = replace(
        guess_of(Room(window=(Window("south", 1.0, 2.0, 0.8, 1.8),))), north_deg=NORTH_DEG
    )
    # A late clock with the pose that follows it costs what the priors of clock and level cost: a
    # minute goes with 0.17 degrees of roll. Without the pose it contradicts the discs.
    slopes = prior.covariance[:3, 3] / prior.covariance[3, 3]
    pose_late = [*(prior.values[:3] + slopes * (1.5 - prior.values[3])), 1.5]
    late = replace(prior, values=np.array(pose_late)).applied(start)
    assert late.clock_min == 1.5 and abs(late.north_deg - NORTH_DEG) > 0.1
    assert np.sum(prior.deviations(late) ** 2) < (0.17 * 1.5 / LEVEL_SD_DEG) ** 2 + 0.5
    assert np.sum(prior.deviations(replace(start, clock_min=1.5)) ** 2) > 12.0


@pytest.mark.slow
@pytest.mark.authority
def test_simulated_frames_give_north_to_a_twentieth_of_a_degree(tmp_path: Path) -> None:
    """authority: the simulated camera, whose stated heading is 1.3 degrees off."""
    profile = load_camera_profile("sim-fisheye")
    session = Session(tmp_path)
    room = np.full((184, 368), 200.0, np.float32)
    rgb = np.repeat(room[..., None] / 179.0, 3, axis=2).astype(np.float32)
    shown = sun.position(TIMES, SEATTLE)
    for k, when in enumerate(TIMES):
        altitude = float(shown.apparent_altitude_deg[k])
        azimuth = float(shown.azimuth_deg[k])
        disc = SunSource(altitude, azimuth - NORTH_DEG, 60_000.0)
        panorama = Panorama(room, 180.0, sun=disc, rgb=rgb)
        camera = SimulatedCamera(_World(panorama), profile, FastClock(when), heading_deg=180.0)
        folder = tmp_path / f"frames{k}"
        folder.mkdir()
        shots = [
            Shot(camera.expose(e, folder / f"{i:02d}"), e, None)
            for i, e in enumerate(bracket_exposures(profile.bracket, "nd5"))
        ]
        merged = merge_shots(shots, profile, MergeOptions(height=92), sun_deg=(altitude, azimuth))
        assert merged.sun is not None
        place = (merged.sun.altitude_deg, merged.sun.azimuth_deg, merged.sun.sigma_deg)
        _write_sidecar(session, _slot(when), when, place)
    pose = pose_of(read_discs(session), SEATTLE, 180.0, 0.1)
    assert pose is not None and not pose.dropped
    assert pose["heading_deg"] == pytest.approx(NORTH_DEG, abs=0.05)
    assert abs(pose["tilt_deg"]) < 0.05 and abs(pose["roll_deg"]) < 0.1


class _World:
    """A still room: what a simulated camera photographs."""

    def __init__(self, panorama: Panorama) -> None:
        self.panorama = panorama

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)
