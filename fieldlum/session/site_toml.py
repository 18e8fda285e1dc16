"""SITE.toml: place, camera and room of a site."""

import math
import re
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

from fieldlum.core.errors import InputError, did_you_mean
from fieldlum.core.records import CameraSetup, Site, SiteFile
from fieldlum.core.strict_toml import TomlTable, build, plain, read_toml
from fieldlum.optics.projection import direction
from fieldlum.sky import sun

# Largest difference of a zone's time and solar time: western China's clocks are 3.1 h ahead, more
# than others. Chosen.
_MAX_OFF_SUN_H = 4.0
# A place is refused if it is farther from its time zone's city than this, and the other sign of
# latitude or longitude is at most half as far. No country with one zone on both sides of the
# equator is that large: Leticia in Colombia is 1090 km from Bogota.
_FAR_FROM_ZONE_KM = 1500.0
# A line of zone.tab, such as "IT +4154+01229 Europe/Rome"; whole degrees suffice.
_ZONE_PLACE = re.compile(r"[A-Z]{2}\t([+-]\d\d)\d+([+-]\d{3})\d+\t([^\t]+)")
_MERIDIANS_MEET_DEG = 85.0  # stations near the poles use the time of their supply base; chosen


def site_from_table(table: TomlTable, where: str) -> SiteFile:
    """Return the site, camera and room in the tables of a SITE.toml.

    where: name of the source, for errors. Raises InputError for unknown keys, an impossible place,
    or a time zone that is unknown or over 4 h from the solar time of the longitude.
    """
    setup = build(SiteFile, table, where)
    site = setup.site
    try:
        ZoneInfo(site.timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        found = f"unknown time zone '{site.timezone}'"
        remedy = f"correct timezone{did_you_mean(site.timezone, available_timezones())}"
        raise InputError(where, found, "a name like Europe/Rome", remedy) from None
    off_h = abs(sun.zone_off_sun_h(site))
    if abs(site.latitude_deg) < _MERIDIANS_MEET_DEG and off_h > _MAX_OFF_SUN_H:
        found = f"longitude_deg = {site.longitude_deg:g} with timezone {site.timezone}, "
        found += f"whose clock is {off_h:.1f} h from solar time"
        remedy = "correct one of the two; east is positive, west negative"
        raise InputError(where, found, f"at most {_MAX_OFF_SUN_H:g} h", remedy)
    return setup


@cache
def _zone_places() -> dict[str, tuple[float, float]]:
    """Return latitude and longitude [deg] of each time zone's city, from zone.tab of tzdata."""
    text = (files("tzdata") / "zoneinfo" / "zone.tab").read_text(encoding="utf-8")
    matches = (_ZONE_PLACE.match(line) for line in text.splitlines())
    return {match[3]: (float(match[1]), float(match[2])) for match in matches if match}


def wrong_sign_text(site: Site) -> str:
    """Return a sentence if a latitude or longitude probably has the wrong sign; else "".

    A sign is probably wrong if the site is over 1500 km from the city of its time zone, and would
    be at most half as far with another sign or with both numbers exchanged. A zone that is no city,
    such as UTC, is not checked.
    """
    city = _zone_places().get(site.timezone)
    lat, lon = site.latitude_deg, site.longitude_deg
    if city is None:
        return ""

    def distance_km(lat: float, lon: float) -> float:
        """Return the distance of a place from the city of the time zone.

        lat, lon: of the place [deg], north and east positive. The Earth is a sphere with its mean
        radius.
        """
        return 6371.0 * math.acos(min(float(direction(lat, lon) @ direction(*city)), 1.0))

    near_km, which = min(
        (distance_km(-lat, lon), "latitude"),
        (distance_km(lat, -lon), "longitude"),
        (distance_km(-lat, -lon), "latitude and longitude"),
        (distance_km(lon, lat) if abs(lon) <= 90.0 else math.inf, ""),
    )
    if (stated_km := distance_km(lat, lon)) < _FAR_FROM_ZONE_KM or near_km > stated_km / 2:
        return ""
    found = f"{lat:g}, {lon:g} is {stated_km:.0f} km from {site.timezone}"
    how = f"the other sign of the {which}" if which else "latitude and longitude exchanged"
    return f"{found}, and with {how} {near_km:.0f} km"


def with_paths_from(setup: SiteFile, folder: Path) -> SiteFile:
    """Return a site whose camera profile and room file are paths from the current folder.

    The two names in `setup` are searched in `folder`, then in the folders above it, so that another
    file of the same name in the current folder is not used. A name that is in none of these, such
    as that of a shipped profile, or that means the same file from the current folder, remains. A
    path may be relative, so it holds only while the current folder remains the same.
    """

    def path_of(name: str) -> str:
        """Return the path of the file that a name in SITE.toml means.

        Return the name itself if it already is such a path, or if there is no such file.
        """
        paths = (above / name for above in (folder, *folder.absolute().parents))
        path = next((path for path in paths if path.is_file()), None) if name else None
        is_here = path is None or (Path(name).is_file() and path.samefile(name))
        return name if is_here else str(path)

    camera = replace(setup.camera, profile=path_of(setup.camera.profile))
    room = setup.room and replace(setup.room, file=path_of(setup.room.file))
    return replace(setup, camera=camera, room=room)


def site_table(setup: SiteFile) -> TomlTable:
    """Return a site as the nested tables of a SITE.toml; the inverse of `site_from_table`."""
    return plain(setup)


def load_site(path: Path) -> SiteFile:
    """Return the site, camera and room of a SITE.toml.

    The camera's height may be stated in [camera] or in [room], and then counts in both. The
    camera's `assumed` lists heading and profile if they are not stated. Raises InputError for a
    file or a value that cannot be used, and for two different heights.
    """
    table = read_toml(path)
    camera, room = table.setdefault("camera", {}), table.get("room")
    if isinstance(camera, dict):
        missing = {"heading_deg": "heading_deg" not in camera, "profile": not camera.get("profile")}
        camera.setdefault("assumed", [name for name, is_missing in missing.items() if is_missing])
    if isinstance(camera, dict) and isinstance(room, dict):
        height = camera.get("height_m", room.get("camera_z_m", CameraSetup().height_m))
        if room.setdefault("camera_z_m", height) != camera.setdefault("height_m", height):
            found = f"[camera] height_m = {height} and [room] camera_z_m = {room['camera_z_m']}"
            raise InputError(path, found, "one height of the camera", "remove one of the two keys")
    setup = site_from_table(table, str(path))
    if wrong := wrong_sign_text(setup.site):
        remedy = "correct the sign (north and east are positive), or state a nearer time zone"
        raise InputError(path, wrong, "a place near its time zone", remedy)
    return with_paths_from(setup, path.parent)
