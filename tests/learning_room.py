"""A small room for the learning tests: linear in sky and sun, made of numbers, no rendering."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.records import CameraSetup, Panorama, Site, SiteFile, utc_text
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.images import write_panorama
from fieldlum.optics.projection import equirect_rays
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at

SEATTLE = Site("Test room", 47.6, -122.3, "America/Los_Angeles")
SETUP = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0))
SITE_TOML = """[site]
name = "Test room"
latitude_deg = 47.6
longitude_deg = -122.3
timezone = "America/Los_Angeles"
"""


def scaled(light: Light, factor: float) -> Light:
    """Return the same sky and sun, `factor` times as bright."""
    names = ("norm_cdm2", "ground_cdm2", "direct_lx", "diffuse_lx")
    bright = {name: getattr(light.sky, name) * factor for name in names}
    more = {"dni_wm2": light.dni_wm2 * factor, "dhi_wm2": light.dhi_wm2 * factor}
    return replace(light, **more, perez=replace(light.sky, **bright))


def light_of_days(days: tuple[str, ...], seed: int = 0) -> Light:
    """Every second daylight hour of some days, with clouds that come and go."""
    times = [
        datetime.fromisoformat(day).replace(tzinfo=UTC) + timedelta(hours=8.5 + hour)
        for day in days
        for hour in range(1, 24, 2)
    ]
    altitude = sun.position(times, SEATTLE).altitude_deg
    times = [t for t, a in zip(times, altitude, strict=True) if a > 4.0]
    clear = sun.clearsky(times, SEATTLE)
    cloud = np.random.default_rng(seed).uniform(0.0, 1.0, len(times))
    return light_at(times, SEATTLE, clear.dni_wm2 * cloud, clear.dhi_wm2 * (2.0 - cloud))


def room(
    light: Light, height: int = 12, heading_deg: float = 180.0
) -> tuple[np.ndarray, np.ndarray]:
    """Maps and sun patches [n, H, 2H]: window sky in the middle, walls lit by sky and sun, a
    spot that walks.
    """
    rays = equirect_rays(height, 2 * height, heading_deg)
    window = (-rays[..., 1] > 0.8) & (np.abs(rays[..., 2]) < 0.45)
    south = np.maximum(-light.sun_direction[:, 1], 0.0)
    depth = 0.2 + 0.5 * (1.0 - rays[..., 1]) / 2.0
    walls = light.diffuse_lx[:, None, None] * 0.02 * depth
    walls = walls + (light.direct_lx * south)[:, None, None] * 0.006 * (1.2 - depth)
    spot = light.sun_direction * np.array(
        [-1.0, 1.0, -1.0]
    )  # where the light falls: opposite to the sun
    near = np.exp((np.einsum("hwk,nk->nhw", rays, spot) - 1.0) / 0.01)
    patch = near * (light.direct_lx * south)[:, None, None] * 0.1 * ~window
    sky = 0.8 * light.sky_at(rays.reshape(-1, 3)).reshape(len(light), height, 2 * height)
    maps = np.where(window, sky, walls) + patch
    return maps.astype(np.float32), patch.astype(np.float32)


def dataset(days: tuple[str, ...], seed: int = 0, height: int = 12) -> Dataset:
    light = light_of_days(days, seed)
    maps, patch = room(light, height)
    return Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=patch,
        disc_lx=np.zeros(len(light)),
        heading_deg=180.0,
        days=np.array(
            [sun.standard_date(t, SEATTLE.timezone) for t in light.t_utc], "datetime64[D]"
        ),
        slots=tuple(f"{t:%Y%m%dT%H%M%SZ}" for t in light.t_utc),
        setup=SETUP,
        seen=np.ones(maps.shape[1:], bool),
        steadiness=np.zeros(len(light)),
        source="test",
    )


def write_pairs(folder: Path, data: Dataset, *, sun_in_map: bool = False) -> Path:
    """The data as pairs.csv with EXR pictures and a site.toml."""
    assert data.patch_cdm2 is not None
    lines = [
        "t_utc,panorama,dni_wm2,dhi_wm2,sun_altitude_deg,sun_azimuth_deg,sunpatch,sun_in_map,ok"
    ]
    for k, slot in enumerate(data.slots):
        for kind, maps in (("m", data.luminance_cdm2), ("p", data.patch_cdm2)):
            write_panorama(folder / f"{kind}{k}.exr", Panorama(maps[k], data.heading_deg))
        light = data.light
        figures = (
            light.dni_wm2[k],
            light.dhi_wm2[k],
            light.sun_altitude_deg[k],
            light.sun_azimuth_deg[k],
        )
        shown = ",".join(f"{v:.9g}" for v in figures)
        dni_dhi, at = shown.split(",")[:2], shown.split(",")[2:]
        lines.append(
            f"{utc_text(light.t_utc[k])},m{k}.exr,{','.join(dni_dhi)},{','.join(at)},p{k}.exr,{int(sun_in_map)},1"
        )
        assert slot
    (folder / "site.toml").write_text(SITE_TOML, encoding="utf-8")
    path = folder / "pairs.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
