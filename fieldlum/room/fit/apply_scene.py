"""Apply a fitted scene to captures: north, clock, room and sun patches."""

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.room.fit.scene_file import SCENE_TOML, Scene, read_scene
from fieldlum.session.files.model_files import UsedScene
from fieldlum.session.site_toml import site_table
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.pose import STATED_SD

# Chosen: larger than the rounding of a panorama's header, smaller than the 0.1 degrees to which
# north is determined.
_SAME_HEADING_DEG = 0.05


def with_patches(data: Dataset) -> Dataset:
    """Return the captures with sun patches computed from the room of `data.setup`.

    `data` must have a room. Patches are the luminance of surfaces by direct sun only, cd/m2 [n, H,
    W]. Raises InputError for an impossible room.
    """
    return replace(data, patch_cdm2=data.patches(data.light))


def earlier(light: Light, minutes: float, data: Dataset) -> Light:
    """Return the light with times and sun `minutes` earlier (negative: later).

    Irradiance does not change. Recorded sun angles are shifted by the sun's motion in that time;
    they are not computed again, because a rendering can have another formula for the sun. data: the
    captures, only for their site.
    """
    if not minutes:
        return light
    site = data.setup.site
    times = tuple(t - timedelta(minutes=minutes) for t in light.t_utc)
    stated, true = sun.position(light.t_utc, site), sun.position(times, site)
    altitude = light.sun_altitude_deg + true.altitude_deg - stated.altitude_deg
    turn = signed_angle_deg(np.asarray(true.azimuth_deg - stated.azimuth_deg))
    azimuth = (light.sun_azimuth_deg + turn) % 360.0
    return replace(light, t_utc=times, sun_altitude_deg=altitude, sun_azimuth_deg=azimuth)


def with_scene(data: Dataset, scene: Scene, *, source: Path | str = SCENE_TOML) -> Dataset:
    """Return the captures with the corrections of a scene.

    If the scene's chosen geometry is "fitted", heading and room become relative to true north, the
    sun is at the true times, and sun patches are computed from the fitted room. If it is "stated",
    only the patches change: they are computed from the stated room. If it is "none", the patches
    are removed. source: the scene's file, for errors. Raises InputError if heading (by over 0.05
    degrees) or room of the captures differ from those that the fit started at, and for an
    impossible room.
    """
    _check_stated(data, scene, source)
    about: UsedScene = {
        "north_deg": scene.north_deg,
        "clock_min": scene.clock_min,
        "chosen": scene.chosen,
        "stated": site_table(data.setup),
        "stated_heading_deg": data.heading_deg,
    }
    if scene.chosen == "none":
        return replace(data, patch_cdm2=None, scene=about)
    if scene.chosen == "stated":
        return with_patches(replace(data, scene=about))
    setup, north_deg, clock_min = data.setup, scene.north_deg, scene.clock_min
    camera = replace(setup.camera, heading_deg=(setup.camera.heading_deg + north_deg) % 360.0)
    u_deg, latitude_deg = scene.u.get("north_deg", STATED_SD[0]), setup.site.latitude_deg
    turned = replace(
        data,
        scene=about,
        light=earlier(data.light, clock_min, data),
        heading_deg=(data.heading_deg + north_deg) % 360.0,
        setup=replace(setup, camera=camera, room=scene.room),
        sky_view=data.sky_view and data.sky_view.turned(north_deg, u_deg, clock_min, latitude_deg),
    )
    return with_patches(turned)


def _check_stated(data: Dataset, scene: Scene, source: Path | str) -> None:
    """Raise InputError if heading or room of the captures differ from those the fit started at.

    source: the scene's file, for the error.
    """
    fit_again, train = "fit the scene again (fieldlum scene fit)", "or train with --scene none"
    turned_deg = abs(float(signed_angle_deg(data.heading_deg - scene.stated_heading_deg)))
    if turned_deg > _SAME_HEADING_DEG:
        finding = (
            f"fitted at heading {scene.stated_heading_deg:g} degrees, but the captures have "
            f"heading {data.heading_deg:g} degrees"
        )
        remedy = f"{fit_again}, restore the earlier heading, {train}"
        raise InputError(source, finding, "the same heading", remedy)
    if data.setup.room != scene.stated_room:
        finding = "fitted from another [room] than that of the captures"
        remedy = f"{fit_again}, restore the earlier [room], {train}"
        raise InputError(source, finding, "the same [room]", remedy)


def apply_scene(data: Dataset, pairs: Path, option: str, patch: str) -> tuple[Dataset, str]:
    """Return the captures as the option ``--scene`` demands, and the patch mode for training.

    pairs: the pairs.csv of the captures, or its session's folder. option: a folder with scene.toml;
    "none" to ignore any scene; empty for the folder scene/ next to the csv (in the session), if it
    has a scene.toml. A scene is applied by `with_scene`, and its verdict is added to the notes.
    patch: the requested mode ("absolute", "gain" or "none"); it is returned unchanged, except
    "none" if the scene chose no patches. Without a scene, patches are computed for captures that
    have none, if the site has a `[room]` with windows and `patch` is not "none". Raises InputError
    for a scene.toml that is missing or invalid, for captures whose heading or room differ from
    those of the fit, and for an impossible room.
    """
    session = pairs if pairs.is_dir() else pairs.parent
    folder = Path(option or session / "scene")
    if option != "none" and (option or (folder / SCENE_TOML).is_file()):
        scene = read_scene(folder)
        data = with_scene(data, scene, source=folder / SCENE_TOML)
        doubt = "" if scene.trusted else "WARNING: the scene is not trusted. "
        data = replace(data, notes=(*data.notes, f"{doubt}scene {folder}: {scene.verdict}"))
        return data, "none" if scene.chosen == "none" else patch
    room = data.setup.room
    if data.patch_cdm2 is None and patch != "none" and room is not None and room.window:
        data = with_patches(data)
        data = replace(data, notes=(*data.notes, "sun patches computed from [room]"))
    return data, patch
