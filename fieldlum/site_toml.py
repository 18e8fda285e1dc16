"""SITE.toml: place, camera and room of a site."""

from __future__ import annotations

from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from fieldlum import sun
from fieldlum.errors import InputError
from fieldlum.records import CameraSetup, SiteFile
from fieldlum.strict_toml import TomlTable, build, plain, read_toml

# Hours between a zone's time and its sun: western China's clocks are 3.1 h ahead, more than others.
# Chosen.
_MOST_OFF_SUN_H = 4.0


_MERIDIANS_MEET_DEG = 85.0  # stations near the poles use the time of their supply base; chosen


def site_from_table(table: TomlTable, where: str) -> SiteFile:
    """Build the site, camera and room from the parsed content of a SITE.toml.

    where: name of the source in errors. Raises InputError for unknown keys, an impossible place, or
    a time zone that is unknown or over 4 h from the solar time of the longitude.
    """
    setup = build(SiteFile, table, where)
    site = setup.site
    if not -90 <= site.latitude_deg <= 90:
        raise InputError(
            where,
            f"latitude_deg = {site.latitude_deg:g}",
            "-90 to 90 deg",
            "correct it; south is negative",
        )
    if not -180 <= site.longitude_deg <= 180:
        raise InputError(
            where,
            f"longitude_deg = {site.longitude_deg:g}",
            "-180 to 180 deg",
            "correct it; east is positive",
        )
    if not -500 <= site.altitude_m <= 9000:
        raise InputError(
            where,
            f"altitude_m = {site.altitude_m:g}",
            "-500 to 9000 m",
            "state metres above the sea",
        )
    try:
        ZoneInfo(site.timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise InputError(
            where,
            f"unknown time zone '{site.timezone}'",
            "an IANA name such as America/Los_Angeles",
            "correct timezone",
        ) from None
    if (
        abs(site.latitude_deg) < _MERIDIANS_MEET_DEG
        and abs(off_h := sun.zone_off_sun_h(site)) > _MOST_OFF_SUN_H
    ):
        raise InputError(
            where,
            f"longitude_deg = {site.longitude_deg:g} with timezone {site.timezone}, "
            f"whose clock is {abs(off_h):.1f} h from solar time",
            f"at most {_MOST_OFF_SUN_H:g} h",
            "correct one of the two; east is positive, west negative",
        )
    return setup


def site_table(setup: SiteFile) -> TomlTable:
    """Return a site as the nested tables of a SITE.toml; the inverse of `site_from_table`."""
    return plain(setup)


def load_site(path: Path) -> SiteFile:
    """Read a SITE.toml. Raises InputError for a file or a value that cannot be used.

    The camera's height may be stated in [camera] or in [room], and then counts in both; two
    different heights are an error.
    """
    table = read_toml(path)
    camera, room = table.setdefault("camera", {}), table.get("room")
    if isinstance(camera, dict) and isinstance(room, dict):
        height = camera.get("height_m", room.get("camera_z_m", CameraSetup().height_m))
        if room.setdefault("camera_z_m", height) != camera.setdefault("height_m", height):
            raise InputError(
                path,
                f"[camera] height_m = {height} and [room] camera_z_m = {room['camera_z_m']}",
                "one height of the camera",
                "remove one of the two keys",
            )
    return site_from_table(table, str(path))
