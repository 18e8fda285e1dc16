"""The sky view through frames: simulated cameras before windows with bars, slats, leaves, a facade.

    python bench/sky_view_frames.py OUT [ROOM ...] [--size 300] [--captures 24] [--poses]

For each room: renders captures (clouds of sd 20 % on Perez skies) at the sensor's resolution, takes
brackets, merges them, estimates the sky view without any room, and compares the sun's disc of a
year's hours with the true one. --size: diameter of the fisheye [px]; --poses: the same frames with
a wrong heading (1 and 5 degrees), tilt (1 degree) or lens scale (1 %), each with and without the
captured discs. Prints one row each; OUT keeps the merges, so that a second run
is quick.

DGP's mean squared error is that of the disc alone (true maps), then that of a model, transport of
nine cloudy days without a room, with the true disc and with the estimated one.
"""

from __future__ import annotations

import argparse
import pickle
import shutil
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path

import numpy as np
from troubles import Trouble, Troubles, true_light

from fieldlum import plan
from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.records import CameraSetup, Obstruction, Panorama, Room, Site, SiteFile, Window
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import DetailedPanorama, SimulatedLight
from fieldlum.learn import transport
from fieldlum.learn.models.training_data import Dataset
from fieldlum.merge import MergeOptions, Shot, merge_shots
from fieldlum.merge.bracket import MergeResult
from fieldlum.optics.linear_light import sensor_pitch_deg
from fieldlum.optics.profiles import CameraProfile, bracket_exposures, load_camera_profile
from fieldlum.optics.projection import direction
from fieldlum.room import simulate
from fieldlum.room.scene import build, disc_visibility
from fieldlum.room.scene.radiosity import LitRoom
from fieldlum.room.simulate.fine_windows import fine_windows
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.estimate_from_captures import Captured, sky_view_of
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs
from fieldlum.sky.sky_view.visible_disc import disc_of_hours, drawn_shares
from fieldlum.weather import Weather
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views

YEAR = 2027
HEIGHT = 60  # rows of the truth and of panoramas
YEAR_HOURS = 1500  # of a year, at random, of which the disc is compared
GLARE_HOURS = 40  # of these, for DGP: those whose disc is most in error
CLOUDS = Troubles(clouds=Trouble(0.2, 9))  # on the Perez skies of captures
DIRECTIONS_DEG = np.arange(0.0, 360.0, 45.0)
SEATTLE = Site("frames", 47.6, -122.3, "America/Los_Angeles")
WRONG = {"": (0.0, 0.0, 0.0), "heading 1": (1.0, 0.0, 0.0), "heading 5": (5.0, 0.0, 0.0)}
WRONG |= {"tilt 1": (0.0, 1.0, 0.0), "scale 1 %": (0.0, 0.0, 0.01)}


def rooms() -> dict[str, SiteFile]:
    """Return the rooms by name."""
    window = Window("south", 0.5, 3.0, 0.8, 1.9, frame_m=0.06, panes=3, transom_m=2.1)
    rng = np.random.default_rng(4)
    slats = tuple(
        Obstruction(0.55, 0.03, 1.75 + 0.05 * k, 2.9, 0.04, 0.003, 0.6) for k in range(19)
    )
    leaves = tuple(
        Obstruction(float(x), float(y), float(z), 0.14, 0.02, 0.14, 0.2)
        for x, y, z in rng.uniform((0.0, -8.5, 1.5), (3.5, -7.0, 6.0), (110, 3))
    )
    trunk = Obstruction(1.7, -7.8, 0.0, 0.25, 0.25, 3.0, 0.2)
    facade = Obstruction(-8.0, -14.0, 0.0, 20.0, 2.0, 6.5, 0.8)

    def site(extra: tuple[Obstruction, ...], azimuth_deg: float = 180.0) -> SiteFile:
        room = Room(
            width_m=4.0,
            depth_m=5.0,
            height_m=3.0,
            camera_x_m=2.0,
            camera_y_m=2.0,
            camera_z_m=1.2,
            wall_azimuth_deg=azimuth_deg,
            window=(window,),
            obstruction=extra,
        )
        return SiteFile(SEATTLE, CameraSetup("", azimuth_deg), room)

    return {
        "office": site(()),
        "blind": site(slats),
        "tree": site((trunk, *leaves)),
        "facade": site((facade,), 270.0),
    }


def camera(size_px: int) -> CameraProfile:
    """Return a raw camera whose fisheye of 190 degrees is `size_px` wide."""
    small = load_camera_profile("sim-fisheye")
    side = size_px + 12 + size_px % 2
    body = replace(small.camera, width_px=side, height_px=side)
    lens = replace(small.lens[0], centre_px=(side / 2, side / 2), radius_px=size_px / 2)
    bracket = replace(small.bracket, shutter_s=(1.0, 0.0666666667, 0.004, 0.00025))
    return replace(small, camera=body, lens=(lens,), bracket=bracket)


def wrong_profile(true: CameraProfile, tilt_deg: float, scale: float) -> CameraProfile:
    """Return the profile that somebody states whose camera is tilted, or whose lens is wider."""
    lens = true.lens[0]
    stated = replace(
        lens, tilt_deg=lens.tilt_deg - tilt_deg, radius_px=lens.radius_px * (1.0 + scale)
    )
    return replace(true, lens=(stated,))


class OneScene:
    """A world that shows one panorama, which can be exchanged."""

    panorama: Panorama

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama at any time."""
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return no irradiance."""
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


@dataclass(frozen=True)
class Case:
    """A room, the light of a year's hours, the disc's true share of their beam, and captures.

    sunny: the hours with a beam; maps: the true ones in these hours and those of transport, learnt
    from nine days without a room, [m, H, W]; dgp: of both with the true disc, [m, d].
    """

    setup: SiteFile
    truth: LitRoom
    light: Light
    visible: Floats
    share: Floats
    captured: Indices
    sunny: Indices
    maps: tuple[Floats32, Floats32]
    dgp: tuple[Floats, Floats]


def case(setup: SiteFile, captures: int) -> Case:
    """Return the hours of a room and choose its captures: overcast, with the disc, and clear."""
    weather = simulate.weather_for(setup, seed=3)
    rows = np.flatnonzero((weather.dni_wm2 + weather.dhi_wm2 > 0) & np.isfinite(weather.ghi_wm2))
    rows = np.sort(np.random.default_rng(5).choice(rows, YEAR_HOURS, replace=False))
    times = [weather.t_utc[k] for k in rows]
    light = light_at(times, setup.site, weather.dni_wm2[rows], weather.dhi_wm2[rows])
    light = light[light.sun_altitude_deg > 2.0]
    assert setup.room is not None
    scene = build(setup.room)
    visible, through = disc_visibility(scene, scene.to_room(light.apparent_sun_direction))
    overcast = np.flatnonzero((light.dni_wm2 < 20.0) & (light.dhi_wm2 > 60.0))
    with_disc = np.flatnonzero((visible > 0.0) & (light.dni_wm2 > 200.0))
    clear = np.flatnonzero((visible == 0.0) & (light.dni_wm2 > 200.0))
    third, rng = captures // 3, np.random.default_rng(6)
    chosen = [rng.permutation(some)[:third] for some in (overcast, with_disc, clear)]
    truth = simulate.lit_room(setup, height=HEIGHT, quality="draft")
    model = transport.fit(nine_days(setup, weather, truth))
    sunny, share = np.flatnonzero(light.direct_lx > 1000.0), visible * through
    lit = light[sunny]
    maps = truth.render(lit).luminance_cdm2, model.predict(lit).luminance_cdm2
    dgp = tuple(dgp_of(some, lit, share[sunny], setup.camera.heading_deg) for some in maps)
    return Case(
        setup=setup,
        truth=truth,
        light=light,
        visible=visible,
        share=share,
        captured=np.sort(np.concatenate(chosen)),
        sunny=sunny,
        maps=maps,
        dgp=(dgp[0], dgp[1]),
    )


def dgp_of(maps: Floats32, light: Light, share: Floats, heading_deg: float) -> Floats:
    """Return DGP of maps [n, H, W] with a disc of a share [n] of the beam, [n, d]."""
    views = panorama_views(*maps.shape[1:], heading_deg, DIRECTIONS_DEG)
    disc_lx = share * light.direct_lx
    return glare_directions(maps, views, light.apparent_sun_direction, disc_lx)["dgp"]


def nine_days(setup: SiteFile, weather: Weather, truth: LitRoom) -> Dataset:
    """Return the captures of nine days under clouds, without a room or the sun's disc."""
    slots = plan.make_plan(setup, plan.Request("9-day", date(YEAR, 1, 1), None, YEAR)).slots
    times = [slot.t_utc for slot in slots]
    then = weather.at(times)
    light = light_at(times, setup.site, np.nan_to_num(then.dni_wm2), np.nan_to_num(then.dhi_wm2))
    lit = (light.dni_wm2 + light.dhi_wm2 > 0.0) & (light.sun_altitude_deg > 0.0)
    light = light[lit]
    maps = truth.render(true_light(light, CLOUDS, setup.site)).luminance_cdm2
    return Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=None,
        disc_lx=np.zeros(len(light)),
        heading_deg=setup.camera.heading_deg,
        days=np.array([sun.standard_date(t, setup.site.timezone) for t in light.t_utc], "M8[D]"),
        slots=tuple(slot.id for slot, some in zip(slots, lit, strict=True) if some),
        setup=replace(setup, room=None),
        seen=np.ones(maps.shape[1:], bool),
        steadiness=np.zeros(len(light)),
    )


def take(made: Case, profile: CameraProfile, folder: Path, stated: dict[str, CameraProfile]):
    """Yield, for each capture, its merges by the name of the stated pose; `folder` keeps them."""
    truth = made.truth
    fine = fine_windows(truth, sensor_pitch_deg(profile))
    assert fine is not None
    site, heading = made.setup.site, made.setup.camera.heading_deg
    cloudy = true_light(made.light[made.captured], CLOUDS, site)
    frames = folder / "frames"
    # one camera for all captures, because its map from scene to sensor takes most of the time
    world, clock = OneScene(), FastClock(cloudy.t_utc[0])
    taken = SimulatedCamera(world, profile, clock, heading_deg=heading)
    for k in range(len(cloudy)):
        stored = folder / f"{k:02d}.pickle"
        if stored.is_file():
            yield pickle.loads(stored.read_bytes())
            continue
        rendering = truth.render(cloudy[[k]])
        plain = truth.as_panorama(rendering, 0)
        values = {name: getattr(plain, name) for name in Panorama.__dataclass_fields__}
        world.panorama = DetailedPanorama(**values, detail=fine.picture(rendering, 0))
        shutil.rmtree(frames, ignore_errors=True)
        frames.mkdir(parents=True)
        clock.true_utc = cloudy.t_utc[k]
        shots = [
            Shot(taken.expose(e, frames / f"{i:02d}"), e, None)
            for i, e in enumerate(bracket_exposures(profile.bracket, "nd5"))
        ]
        sun = float(cloudy.apparent_altitude_deg[k]), float(cloudy.sun_azimuth_deg[k])
        merges = {
            name: merge_shots(
                shots,
                known,
                MergeOptions(height=2 * HEIGHT),
                heading_deg=(heading + WRONG[name][0]) % 360.0,
                sun_deg=sun,
                latitude_deg=site.latitude_deg,
            )
            for name, known in stated.items()
        }
        stored.write_bytes(pickle.dumps(merges))
        yield merges


def judge(made: Case, merges: list[MergeResult], with_discs: bool, axis_deg: float) -> str:
    """Estimate the sky view from merges; return a row of figures of the year's hours."""
    light = made.light[made.captured]
    beam = np.maximum(light.direct_lx, 1.0)
    shares = np.array(
        [0.0 if m.panorama.sun is None else m.panorama.sun.normal_illuminance_lx for m in merges]
    )
    shares = np.where(light.direct_lx > 1000.0, shares / beam, np.nan)
    lit = light.diffuse_lx > 1000.0
    rows = [k for k, m in enumerate(merges) if lit[k] and (with_discs or m.sun is None)]
    pictures = {k: m.sky for k, m in enumerate(merges) if m.sky is not None}
    captured = Captured(light, lambda k: pictures[k], shares).take(rows)
    measured = [(k, sun) for k in rows if (sun := merges[k].sun) is not None]
    discs = MeasuredDiscs(
        np.array([s.altitude_deg for _, s in measured]),
        np.array([s.azimuth_deg for _, s in measured]),
        np.array([s.sigma_deg for _, s in measured]),
        tuple(light.t_utc[k] for k, _ in measured),
    )
    view = sky_view_of(
        captured, discs, made.setup.site, axis_deg, lambda rays: in_lens(rays, axis_deg)
    )
    disc = disc_of_hours(view, made.light)
    sunny = made.sunny
    own = disc.best_lx[sunny] / made.light.direct_lx[sunny]
    true = made.share[sunny]
    drawn = drawn_shares(view, made.light[sunny], np.random.default_rng(0))
    seen = ~np.isnan(drawn).any(axis=0)
    low, high = np.percentile(np.nan_to_num(drawn), [2.5, 97.5], axis=0)
    inside = (true >= low - 0.02) & (true <= high + 0.02)
    open_hours = seen & (low <= 0.02) & (high > 0.02)  # whether there is a disc
    partly = (made.visible[sunny] > 0.05) & (made.visible[sunny] < 0.95)
    shown, there = own > 0.02, true > 0.02
    told = seen & ~open_hours
    error = (own - true)[partly]
    rms, behind = float(np.sqrt(np.mean(error**2))), np.maximum(own, true) > 0.02
    off = f"{view.pose.heading_deg:+.2f}+-{view.pose.heading_sd_deg:.2f}"
    return (
        f"discs {len(measured)}, heading {off}, shown {(shown & there).sum()}/{there.sum()}, "
        f"phantom {(shown & ~there).sum()}/{(~there).sum()}, "
        f"partly rms {rms:.3f} ({partly.sum()}), "
        f"mean of all shown {(own - true)[behind].mean():+.3f}, "
        f"interval holds {inside[seen].mean():.3f} (with disc {inside[seen & there].mean():.3f}), "
        f"cannot tell {open_hours.sum()}, of the others shown {(shown & there & told).sum()}/"
        f"{(there & told).sum()}, phantom {(shown & ~there & told).sum()}/{(~there & told).sum()}, "
        f"{glare(made, own, low, high)}"
    )


def in_lens(rays: Floats, axis_deg: float) -> Mask:
    """Return whether the lens of 190 degrees saw directions [p, 3]."""
    return rays @ direction(0.0, axis_deg) > np.cos(np.radians(94.0))


def glare(made: Case, own: Floats, low: Floats, high: Floats) -> str:
    """Return DGP's errors by the disc alone and by the model, and the views in another class.

    own, low, high: share of the beam in the sunny hours, with the bounds of its interval. A class
    is stated if both bounds of the disc give it.
    """
    sunny, heading_deg = made.sunny, made.setup.camera.heading_deg
    true = made.share[sunny]
    worst = np.argsort(-np.abs(own - true), kind="stable")[:GLARE_HOURS]
    some = made.light[sunny[worst]]
    # hours beyond the worst have nearly the true disc
    dgp = made.dgp[0].copy(), made.dgp[1].copy()
    for values, maps in zip(dgp, made.maps, strict=True):
        values[worst] = dgp_of(maps[worst], some, own[worst], heading_deg)
    errors = [((v - made.dgp[0]) ** 2).mean() for v in (dgp[0], made.dgp[1], dgp[1])]
    bounds = [dgp_of(made.maps[0][worst], some, s[worst], heading_deg) for s in (low, high)]
    every = made.dgp[0][worst], dgp[0][worst], *bounds
    there, best, least, most = (np.digitize(values, (0.35, 0.40, 0.45)) for values in every)
    stated = least == most
    return (
        f"DGP MSE of the disc {errors[0]:.1e}, of transport with the true disc {errors[1]:.1e}, "
        f"own {errors[2]:.1e}, ratio {errors[2] / errors[1]:.2f}, other class "
        f"{(best != there).sum()}/{there.size}, stated and wrong "
        f"{(stated & (least != there)).sum()}/{stated.sum()}"
    )


def main() -> None:
    """Print one row for each room and stated pose."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", nargs="*")
    parser.add_argument("--size", type=int, default=300)
    parser.add_argument("--captures", type=int, default=24)
    parser.add_argument("--poses", action="store_true")
    asked = parser.parse_args()
    profile = camera(asked.size)
    names = list(WRONG) if asked.poses else [""]
    stated = {name: wrong_profile(profile, *WRONG[name][1:]) for name in names}
    for name, setup in rooms().items():
        if asked.rooms and name not in asked.rooms:
            continue
        made = case(setup, asked.captures)
        folder = asked.out / name / f"{asked.size}-{asked.captures}-{len(names)}"
        folder.mkdir(parents=True, exist_ok=True)
        captures = list(take(made, profile, folder, stated))
        for pose in names:
            axis_deg = setup.camera.heading_deg + WRONG[pose][0]
            for discs in (True, False):
                row = judge(made, [c[pose] for c in captures], discs, axis_deg)
                print(f"{name}, {asked.size} px, {pose or 'true pose'}: {row}", flush=True)


if __name__ == "__main__":
    main()
