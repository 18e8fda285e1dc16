"""Define the values that stages exchange: frozen, with units in their names and times in UTC."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import IntFlag
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from fieldlum.core.arrays import Floats, Floats32, Integers, Mask
from fieldlum.core.strict_toml import Positive

# Largest picture that is read, unless a camera's profile states more: 0.5 GB of JPEG codes, 1.9 GB
# of float32 colours. The largest sensors in use have 150 million pixels.
MAX_PIXELS = 160_000_000
Cfa = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
"""Colour filters of a Bayer mosaic: its top left 2 x 2 pixels, row by row."""

# ----------------------------------------------------------------------------------------------
# time


def utc_text(t_utc: datetime) -> str:
    """Return a time in UTC as ``2027-03-20T15:30:00Z``.

    A fraction of a second is cut to three digits; full seconds have none. Raises ValueError for a
    time without a time zone.
    """
    if t_utc.tzinfo is None:
        raise ValueError(f"naive time {t_utc}: add a time zone")
    t = t_utc.astimezone(UTC).replace(tzinfo=None)
    return t.isoformat(timespec="milliseconds" if t.microsecond else "seconds") + "Z"


def parse_time(text: str) -> datetime:
    """Return the time of an ISO text, without a time zone if the text has no offset.

    Raises ValueError for another text, and for 06.30, which Python reads as 06:00:00.3.
    """
    before, point, _ = text.replace(",", ".").partition(".")
    if point and not re.search(r"\d\d(:?)\d\d\1\d\d$", before):
        raise ValueError(f"time {text!r} has a point after hours or minutes")
    return datetime.fromisoformat(text)


def require_known_year(*times: datetime | None) -> None:
    """Raise ValueError for a time outside the years 1900 to 2199.

    The ephemeris has no other years, and pandas counts nanoseconds from 1677 to 2262.
    """
    for t in times:
        if t is not None and not 1900 <= t.year < 2200:
            raise ValueError(f"time {t:%Y-%m-%d}, expected 1900 to 2199")


def parse_utc(text: str) -> datetime:
    """Return the UTC time of an ISO text with an offset, such as that of `utc_text`.

    Raises ValueError for another text, for a time without an offset, and for a year that
    `require_known_year` refuses.
    """
    t = parse_time(text)
    if t.tzinfo is None:
        remedy = "write it as UTC, such as 2027-03-20T15:30:00Z"
        raise ValueError(f"time {text!r} has no time zone: {remedy}")
    require_known_year(t)
    return t.astimezone(UTC)


def slot_id(t_utc: datetime) -> str:
    """Return the name of a slot that begins at a time (UTC): ``20270320T153000Z``.

    Raises ValueError for a time without a time zone.
    """
    return re.sub(r"[-:]|\.\d+", "", utc_text(t_utc))


# ----------------------------------------------------------------------------------------------
# flags


class Flag(IntFlag):
    """Bits that state why a pixel's value must be used with care; a pixel without bits is good."""

    CLIPPED_HIGH = 1  # every frame is saturated, so that the value is a lower bound
    BELOW_NOISE = 2  # no frame rises above its noise
    BLOOM = 4  # a neighbouring pixel is saturated
    MOTION = 8  # frames disagree beyond their noise
    ND = 16  # the value comes from frames through a neutral-density filter
    FILLED = 32  # interpolated from neighbours
    OUTSIDE_LENS = 64  # no lens saw it


# ----------------------------------------------------------------------------------------------
# site and room


@dataclass(frozen=True, slots=True)
class Site:
    """A place and its time zone.

    Latitude is positive to the north, longitude to the east. timezone: IANA name. altitude_m:
    above sea level.
    """

    name: str
    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=180.0)]
    timezone: str = "UTC"
    altitude_m: Annotated[float, Meta(ge=-500.0, le=9000.0)] = 0.0


_Azimuth = Annotated[float, Meta(ge=-360.0, le=360.0)]


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """The camera of a session.

    Azimuths are clockwise from true north. profile: name of a profile in calibration/, or a path;
    "" for the default simulated camera; heading_deg: azimuth of the panorama's centre column;
    headings: azimuths [deg] to which a single fisheye is turned in each bracket, empty for a fixed
    camera; height_m: of the lens above the floor; assumed: keys that SITE.toml does not state,
    although the results depend on them; filter: name of the neutral-density filter that a person
    puts on for the frames of the sun, "" for none.
    """

    profile: str = ""
    heading_deg: _Azimuth = 180.0
    headings: tuple[_Azimuth, ...] = ()
    height_m: Positive = 1.6
    assumed: tuple[str, ...] = ()
    filter: str = ""


@dataclass(frozen=True, slots=True)
class Window:
    """A glazed rectangle in a wall of a box room, with its frame.

    wall: by the room's own names, not the compass: "south" is at y = 0 (see `Room`); left_m: from
    the wall's left end, seen from inside, to the rectangle; sill_m: height of its lower edge above
    the floor; width_m, height_m: its size; transmittance: of the glass for light at normal
    incidence, above 0, at most 0.92. panes: number of equal panes next to each other, separated by
    vertical bars; frame_m: width of the frame, which is inside the rectangle, and of the bars, 0
    for none; transom_m: height of a horizontal bar above the floor, 0 for none.
    """

    wall: Literal["south", "west", "north", "east"]
    left_m: float
    width_m: float
    sill_m: float
    height_m: float
    transmittance: float = 0.88
    panes: int = 1
    frame_m: float = 0.05
    transom_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Obstruction:
    """A box inside or outside of the room, in the coordinates of `Room`.

    x_m, y_m, z_m: its corner with the smallest coordinates; width_m, depth_m, height_m: its size
    along x, y, z. y is 0 at the south wall and grows into the room; z is 0 at the floor.
    reflectance: diffuse, 0 to below 1.
    """

    x_m: float
    y_m: float
    z_m: float
    width_m: float
    depth_m: float
    height_m: float
    reflectance: float = 0.35


@dataclass(frozen=True, slots=True)
class Room:
    """A box room (kind box), or the Radiance file of a room (kind radiance).

    The "south" wall of a box is y = 0 and faces ``wall_azimuth_deg``. width_m is along x, which is
    east if the south wall faces south: it grows towards the right-hand end of that wall seen from
    OUTSIDE. depth_m is along y, away from the south wall; height_m along z. wall_azimuth_deg:
    azimuth of the south wall's outward normal, clockwise from true north. camera_x_m, camera_y_m,
    camera_z_m: the lens. camera_tilt_deg: angle by which the panorama's centre column points up,
    and camera_roll_deg: by which its right-hand side is low. wall_thickness_m: of the four walls.
    reflectance_...: diffuse, 0 to below 1; ground: outdoors; frame: of window frames. window,
    obstruction: see `Window` and `Obstruction`. All these are of kind box only. file: path of a
    .rad of geometry, and viewpoint_m: the lens in it, three numbers: x east, y north, z up (both
    kind radiance only).
    """

    kind: Literal["box", "radiance"] = "box"
    width_m: float = 6.0
    depth_m: float = 14.0
    height_m: float = 4.5
    camera_x_m: float = 3.0
    camera_y_m: float = 3.0
    camera_z_m: float = 1.6
    camera_tilt_deg: float = 0.0
    camera_roll_deg: float = 0.0
    wall_azimuth_deg: float = 180.0
    wall_thickness_m: float = 0.25
    reflectance_walls: float = 0.5
    reflectance_ceiling: float = 0.8
    reflectance_floor: float = 0.2
    reflectance_ground: float = 0.2
    reflectance_frame: float = 0.4
    window: tuple[Window, ...] = ()
    obstruction: tuple[Obstruction, ...] = ()
    file: str = ""
    viewpoint_m: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class PyranometerSetup:
    """The pyranometer of a session as SITE.toml states it; reports show both texts.

    kind: such as spn1; profile: name of its profile; "" if not stated.
    """

    kind: str = ""
    profile: str = ""


@dataclass(frozen=True, slots=True)
class SiteFile:
    """The content of SITE.toml: place, camera, room (None if not described) and pyranometer."""

    site: Site
    camera: CameraSetup = field(default_factory=CameraSetup)
    room: Room | None = None
    pyranometer: PyranometerSetup = field(default_factory=PyranometerSetup)


# ----------------------------------------------------------------------------------------------
# capture


@dataclass(frozen=True, slots=True)
class Exposure:
    """Camera settings of one frame: nominal shutter time [s], f-number, ISO and filter.

    nd: name of a neutral-density filter of the profile, "" for none.
    """

    shutter_s: Positive
    f_number: Positive
    iso: Positive = 100.0
    nd: str = ""


JsonTable = dict[str, Any]
"""A JSON object; tests/test_json_keys.py lists the keys of those that commands print."""


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless it is 1, such as "3 rooms"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def listed(names: Sequence[object], maximum: int = 5) -> str:
    """Return the first `maximum` names and the number of the others, such as "a, b and 3 more"."""
    more = f" and {len(names) - maximum} more" if len(names) > maximum else ""
    return ", ".join(map(str, names[:maximum])) + more


def shutter_text(shutter_s: float) -> str:
    """Return a shutter time [s] as cameras show it, without the unit: 1/250, 0.4, 2.

    Times below 0.3 s become fractions.
    """
    return f"1/{1 / shutter_s:.6g}" if shutter_s < 0.3 else f"{shutter_s:.6g}"


@dataclass(frozen=True, slots=True)
class Slot:
    """One planned bracket: its start t_utc, the sun's position then, the exposures and tags.

    tags: words that the plan attaches to the bracket; empty without any. sun_altitude_deg: true
    altitude, without refraction; sun_azimuth_deg: clockwise from north.
    """

    t_utc: datetime
    sun_altitude_deg: float
    sun_azimuth_deg: float
    exposures: tuple[Exposure, ...]
    tags: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Name of the slot, which is its UTC start."""
        return slot_id(self.t_utc)


@dataclass(frozen=True, slots=True)
class IrradianceSample:
    """One reading of a pyranometer in W/m²; None for components that it does not measure.

    t_utc: time of the reading; ghi: global horizontal irradiance; dhi: diffuse horizontal; dni:
    direct normal; temperature_c: as the instrument reports it [deg C]. status: as the instrument
    reports it, "" for no fault; raw: the line or register words as received.
    """

    t_utc: datetime
    ghi_wm2: float | None = None
    dhi_wm2: float | None = None
    dni_wm2: float | None = None
    temperature_c: float | None = None
    status: str = ""
    raw: str = ""


# ----------------------------------------------------------------------------------------------
# luminance


# `SunSource.origin` of a sun that every frame clips: its illuminance is a lower bound.
CLIPPED_SUN = "clipped"


@dataclass(frozen=True, slots=True)
class SunSource:
    """The sun as the lens sees it, separate from the map.

    altitude_deg: apparent, with refraction; azimuth_deg: clockwise from true north.
    normal_illuminance_lx: of the visible part of the disc, on a plane normal to the sun, at the
    lens; a lower bound if origin is "clipped". visible_fraction: share (0 to 1) of the disc's area
    that is not hidden. origin: where the illuminance comes from: nd-frames, merge, clipped, meter,
    sky-view, dni, rendering, picture (`SUN_FROM` of session.panorama_sun explains each); "" if
    unknown.
    """

    altitude_deg: float
    azimuth_deg: float
    normal_illuminance_lx: float
    visible_fraction: float = 1.0
    origin: str = ""


# Name of an attribute of merged pictures: the standard uncertainties that all pixels share, as
# "SOURCE=PERCENT SOURCE=PERCENT ...". They are percent of a pixel's luminance, except that of the
# source VEILING_GLARE, which is percent of the picture's mean luminance.
U_PERCENT, VEILING_GLARE = "u_percent", "veiling-glare"


@dataclass(frozen=True, slots=True)
class Panorama:
    """A luminance map of all directions; a sun disc that fieldlum measured is separate, in `sun`.

    luminance_cdm2, u_cdm2 (standard uncertainty), flags (`Flag` bits): [H, W = 2H], row 0 at the
    zenith, azimuth clockwise to the right; rgb: [H, W, 3], of which 179 (0.265 R + 0.670 G + 0.065
    B) is the luminance. heading_deg: azimuth of the centre column, clockwise from true north.
    t_utc: of the picture, the middle of its bracket. t_utc, u_cdm2, flags, rgb: None if unknown.
    sun: None if no sun was removed from the map or added to it; a map of another program may then
    contain the disc. attributes: further texts of the picture's file, by name.
    """

    luminance_cdm2: Floats
    heading_deg: float
    u_cdm2: Floats | None = None
    flags: Integers | None = None
    t_utc: datetime | None = None
    sun: SunSource | None = None
    # Radiance's units, W/sr/m2; its luminous efficacy is 179 lm/W
    rgb: Floats | None = None
    attributes: dict[str, str] = field(default_factory=dict)

    @property
    def shared_u_rel(self) -> dict[str, float]:
        """The relative standard uncertainties that all pixels of the picture share, by source.

        They are those in the attribute `u_percent`, such as "scale=2 colour=1", divided by 100;
        empty without the attribute. That of `VEILING_GLARE` is relative to the mean luminance of
        the picture, the others are relative to a pixel's luminance. Raises ValueError for an
        attribute of another form, with which no file is read.
        """
        words = self.attributes.get(U_PERCENT, "").split()
        return {name: float(text) / 100 for name, text in (word.split("=") for word in words)}

    @property
    def seen(self) -> Mask:
        """Mask [H, W], True for pixels that a lens saw; True everywhere if flags are unknown."""
        if self.flags is None:
            return np.ones(self.luminance_cdm2.shape, bool)
        return (self.flags & Flag.OUTSIDE_LENS) == 0

    @property
    def clipped_count(self) -> int:
        """Number of pixels that are clipped in every frame; 0 if flags are unknown."""
        return 0 if self.flags is None else int((self.flags & Flag.CLIPPED_HIGH > 0).sum())

    @property
    def seen_cdm2(self) -> Floats32:
        """Copy of the luminance [H, W], NaN in pixels that no lens saw."""
        return np.where(self.seen, self.luminance_cdm2, np.float32(np.nan)).astype(np.float32)
