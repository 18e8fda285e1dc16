"""Strict TOML: site files, camera profiles, capture plans. An unknown key is an error, not a
shrug.
"""

from __future__ import annotations

import math
import tomllib
import types
import typing
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from fieldlum import sun
from fieldlum.errors import InputError
from fieldlum.projection import LensGeometry, angle_of_radius, judged_text, seen_by_lenses
from fieldlum.records import CameraSetup, Exposure, SiteFile

T = TypeVar("T")
_HERE = Path(__file__).parent


def shipped(kind: Literal["calibration", "capture_plans"]) -> Path:
    """Folder of the shipped files, in a wheel or in a checkout."""
    in_wheel = _HERE / "_shipped" / kind
    return in_wheel if in_wheel.is_dir() else _HERE.parent / kind


# ----------------------------------------------------------------------------------------------
# strict building


def build(cls: type[T], table: dict[str, Any], where: str) -> T:
    """A frozen dataclass from a TOML table; nested dataclasses, tuples and Literals are checked.

    Raises InputError naming `where`, the key, what was found and what was expected.
    """
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, n=1)
            hint = (
                f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(sorted(known))}"
            )
            raise InputError(where, f"unknown key '{key}'", remedy=hint)
    for name, f in known.items():
        if name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise InputError(where, f"no '{name}'", f"a value for '{name}'", "add it")
    return cls(
        **{key: _value(hints[key], value, f"{where} [{key}]") for key, value in table.items()}
    )


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), value, where)
    if hint is typing.Any:
        return value
    if origin is Literal:
        if value not in arguments:
            raise InputError(where, repr(value), "one of " + ", ".join(map(str, arguments)))
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(where, repr(value), "a list")
        inner = arguments[0] if len(arguments) == 2 and arguments[1] is Ellipsis else None
        if inner is None and len(value) != len(arguments):
            raise InputError(where, f"{len(value)} values", f"{len(arguments)} values")
        return tuple(
            _value(inner or arguments[i], v, f"{where} #{i + 1}") for i, v in enumerate(value)
        )
    if origin is dict:
        if not isinstance(value, dict):
            raise InputError(where, repr(value), "a table")
        return {str(k): _value(arguments[1], v, f"{where}.{k}") for k, v in value.items()}
    if is_dataclass(hint):
        if not isinstance(value, dict):
            raise InputError(where, repr(value), "a table")
        return build(typing.cast(type, hint), value, where)
    if hint is float:
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise InputError(where, repr(value), "a number")
        return float(value)
    if isinstance(hint, type) and (
        not isinstance(value, hint) or (hint is int and isinstance(value, bool))
    ):
        raise InputError(
            where, repr(value), {int: "a whole number", str: "text", bool: "true or false"}[hint]
        )
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Raises InputError for a missing file or for what is not TOML."""
    try:
        return tomllib.loads(
            path.read_text(encoding="utf-8-sig")
        )  # editors of Windows put a mark before the text
    except OSError as error:
        raise InputError(path, error.strerror or str(error), "a readable TOML file") from None
    except UnicodeDecodeError as error:
        raise InputError(
            path,
            f"byte {error.object[error.start]:#04x} that is no UTF-8",
            "TOML in UTF-8",
            "save it again with the encoding UTF-8",
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            path, str(error), "TOML", "mend that line: text in quotes, decimals with a point"
        ) from None


def plain(value: Any) -> Any:
    """Dataclasses to what TOML can hold: no None, tuples as lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


# ----------------------------------------------------------------------------------------------
# SITE.toml


_MOST_OFF_SUN_H = 4.0  # western China's clocks are 3.1 h ahead of their sun, more than any other's
_MERIDIANS_MEET_DEG = 85.0  # stations near the poles keep the time of whoever supplies them


def site_from_table(table: dict[str, Any], where: str) -> SiteFile:
    """Raises InputError for unknown keys, an impossible place or an unknown time zone."""
    setup = build(SiteFile, table, where)
    site = setup.site
    if not -90 <= site.latitude_deg <= 90:
        raise InputError(
            where, f"latitude_deg = {site.latitude_deg:g}", "-90 to 90", "south is negative"
        )
    if not -180 <= site.longitude_deg <= 180:
        raise InputError(
            where, f"longitude_deg = {site.longitude_deg:g}", "-180 to 180", "east is positive"
        )
    if not -500 <= site.altitude_m <= 9000:
        raise InputError(
            where, f"altitude_m = {site.altitude_m:g}", "-500 to 9000", "metres above the sea"
        )
    try:
        ZoneInfo(site.timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise InputError(
            where,
            f"unknown time zone '{site.timezone}'",
            "an IANA name such as America/Los_Angeles",
        ) from None
    if (
        abs(site.latitude_deg) < _MERIDIANS_MEET_DEG
        and abs(off_h := sun.zone_off_sun_h(site)) > _MOST_OFF_SUN_H
    ):
        found = (
            f"longitude_deg = {site.longitude_deg:g} with timezone {site.timezone}, "
            f"{abs(off_h):.1f} h off the sun"
        )
        raise InputError(
            where, found, f"at most {_MOST_OFF_SUN_H:g} h", "east is positive, west negative"
        )
    return setup


def site_table(setup: SiteFile) -> dict[str, Any]:
    """Inverse of `site_from_table`."""
    return plain(setup)


def load_site(path: Path) -> SiteFile:
    """A person's file. The camera's height may stand in [camera] or in [room], and counts in
    both.
    """
    table = read_toml(path)
    camera, room = table.setdefault("camera", {}), table.get("room")
    if isinstance(camera, dict) and isinstance(room, dict):
        height = camera.get("height_m", room.get("camera_z_m", CameraSetup().height_m))
        if room.setdefault("camera_z_m", height) != camera.setdefault("height_m", height):
            found = f"[camera] height_m = {height} and [room] camera_z_m = {room['camera_z_m']}"
            raise InputError(path, found, "one height", "leave one of them out")
    return site_from_table(table, str(path))


# ----------------------------------------------------------------------------------------------
# camera profiles


@dataclass(frozen=True, slots=True)
class CameraBody:
    name: str
    kind: Literal["raw", "jpeg"]
    width_px: int
    height_px: int
    make: str = ""
    model: str = ""
    date: str = ""  # of the calibration, ISO
    note: str = ""
    fixed_f_number: float = 0.0  # of a lens that no frame states; 0: the EXIF has it


@dataclass(frozen=True, slots=True)
class Sensor:
    """Raw cameras: per CFA colour R, G1, G2, B where four values stand. [DN]"""

    cfa: str = "RGGB"
    black_dn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    saturation_dn: tuple[float, ...] = (
        65535.0,
        65535.0,
        65535.0,
        65535.0,
    )  # the plateau, not the file's tag
    white_dn: float = (
        65535.0  # DN where linear z = 1 by definition (minus black); only fixes what scale.k means
    )
    gain_e_per_dn: float = 1.0  # at iso
    read_noise_e: float = 3.0
    iso: float = 100.0
    bad_px: tuple[tuple[int, int], ...] = ()  # column, row of pixels that are never used


@dataclass(frozen=True, slots=True)
class Bracket:
    """The exposures to plan by default; shutter times as the camera names them."""

    f_number: float
    iso: float
    shutter_s: tuple[float, ...]
    nd: tuple[str, ...] = ()  # one more bracket tail per filter, at the shortest times
    nd_shutter_s: tuple[float, ...] = ()
    seconds_per_frame: float = 2.0
    megabytes_per_frame: float = 25.0


@dataclass(frozen=True, slots=True)
class ShutterTime:
    nominal_s: float
    true_s: float
    u_rel: float = 0.002


@dataclass(frozen=True, slots=True)
class Vignetting:
    """Relative transmission V in powers of r = angle / (full angle / 2): V = sum c_k r^k, c_0
    first, V(0) = 1.
    """

    f_number: float
    coefficients: tuple[float, ...]
    u_rel: float = 0.01


@dataclass(frozen=True, slots=True)
class Lens:
    """One lens on the sensor. Pixel coordinates: (0, 0) is the top left corner of the sensor's
    top left pixel.
    """

    centre_px: tuple[float, float]  # x to the right, y down
    radius_px: float  # of the image circle at full_angle_deg / 2
    full_angle_deg: float
    mapping: Literal["equidistant", "equisolid", "polynomial"] = "equisolid"
    coefficients: tuple[
        float, ...
    ] = ()  # polynomial: r / radius_px = sum c_k (angle / half angle)^(k+1)
    name: str = "lens"
    azimuth_deg: float = 0.0  # optical axis relative to the camera's heading, clockwise
    tilt_deg: float = 0.0  # up
    roll_deg: float = 0.0  # clockwise as seen from behind the camera
    vignetting: tuple[Vignetting, ...] = ()

    @property
    def geometry(self) -> LensGeometry:
        """Where it puts a direction, on the whole sensor, relative to the camera's heading."""
        return LensGeometry(
            self.centre_px,
            self.radius_px,
            self.full_angle_deg,
            self.mapping,
            self.coefficients,
            self.azimuth_deg,
            self.tilt_deg,
            self.roll_deg,
        )


@dataclass(frozen=True, slots=True)
class Response:
    """JPEG: code value to linear z in [0, 1]."""

    kind: Literal["linear", "srgb", "polynomial", "table"] = "linear"
    red: tuple[float, ...] = ()  # polynomial: c_0 first, in code / 255; table: 256 values
    green: tuple[float, ...] = ()
    blue: tuple[float, ...] = ()
    low_code: int = 27  # codes outside [low, high] carry no weight
    high_code: int = 228
    u_rel: float = 0.01


@dataclass(frozen=True, slots=True)
class Colour:
    """Luminance from linear camera R, G, B: Y = y_from_rgb . RGB."""

    y_from_rgb: tuple[float, float, float] = (0.265, 0.670, 0.065)
    rgb_to_radiance: tuple[
        float, ...
    ] = ()  # 9 values, row by row; empty: no colour is written, only Y
    u_rel: float = 0.02


@dataclass(frozen=True, slots=True)
class Scale:
    """L = k * 87 * N^2 / (t S) * z with z in [0, 1], t in s (87: hdrgen's stonits)."""

    k: float = 1.0
    u_rel: float = 0.05
    f_numbers: tuple[float, ...] = ()  # when given, k holds for these apertures only


@dataclass(frozen=True, slots=True)
class NeutralDensity:
    name: str
    factor_rgb: tuple[float, float, float]  # luminance without over luminance with the filter
    u_rel: float = 0.02


@dataclass(frozen=True, slots=True)
class Provenance:
    source: str = ""
    fitted_by: str = ""
    frames_sha256: tuple[str, ...] = ()
    log: tuple[str, ...] = ()  # one line a fit: what was chosen and why


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """calibration/NAME.toml: everything between sensor counts and cd/m2, with its uncertainty."""

    camera: CameraBody
    lens: tuple[Lens, ...]
    bracket: Bracket
    sensor: Sensor = field(default_factory=Sensor)
    shutter: tuple[ShutterTime, ...] = ()
    response: Response = field(default_factory=Response)
    colour: Colour = field(default_factory=Colour)
    scale: Scale = field(default_factory=Scale)
    nd: tuple[NeutralDensity, ...] = ()
    glare_floor_rel: float = 0.0005  # veiling glare of the lens, as a share of the mean luminance
    expires: str = ""  # ISO date; doctor warns after it
    provenance: Provenance = field(default_factory=Provenance)
    # What nominal times mean where [[shutter]] has no measured one: see photometry/shutter_law.py.
    shutter_law: Literal["auto", "third-stops", "half-stops", "exact"] = "auto"


def coverage_text(profile: CameraProfile, setup: CameraSetup) -> str:
    """Return which view directions these lenses and headings can judge; empty when they see all.

    With one lens and no turned head the remedy names headings that would see all.
    """
    lenses = [lens.geometry for lens in profile.lens]
    headings = setup.headings or (setup.heading_deg,)
    turns = [heading - setup.heading_deg for heading in headings]
    text = judged_text(seen_by_lenses(lenses, turns), setup.heading_deg)
    if not text:
        return ""
    opposite = [setup.heading_deg % 360.0, (setup.heading_deg + 180.0) % 360.0]
    seen = seen_by_lenses(lenses, [heading - setup.heading_deg for heading in opposite])
    if judged_text(seen, setup.heading_deg):
        return f"{text}; take a lens that sees more, or turn the camera to several headings"
    named = ", ".join(f"{heading:g}" for heading in opposite)
    return f"{text}; for all directions write headings = [{named}] under [camera] in SITE.toml"


DEFAULT_CAMERA = "sim-dual-fisheye"


def find_camera_profile(name: str) -> Path:
    """A path as it stands, else a name in the shipped calibration/. Raises InputError listing
    what there is.
    """
    path = Path(name or DEFAULT_CAMERA)
    for candidate in (
        path,
        shipped("calibration") / path.name,
        shipped("calibration") / f"{path.name}.toml",
    ):
        if candidate.is_file():
            return candidate
    known = ", ".join(sorted(p.stem for p in shipped("calibration").glob("*.toml")))
    raise InputError(name, "no such camera profile", f"a TOML file or one of: {known}")


def load_camera_profile(name: str | Path) -> CameraProfile:
    """Raises InputError for a file that is no profile, or has figures no camera can have."""
    path = find_camera_profile(str(name))
    profile = build(CameraProfile, read_toml(path), str(path))
    check_camera(profile, str(path))
    return profile


def check_camera(profile: CameraProfile, where: str) -> None:
    """Raises InputError, naming the key, for figures that no camera can have."""
    p = profile
    if not p.lens:
        raise InputError(where, "no [[lens]]", "at least one")
    positive: dict[str, tuple[float, ...]] = {
        "camera.width_px": (p.camera.width_px,),
        "camera.height_px": (p.camera.height_px,),
        "lens.radius_px": tuple(x.radius_px for x in p.lens),
        "lens.full_angle_deg": tuple(x.full_angle_deg for x in p.lens),
        "lens.vignetting.f_number": tuple(v.f_number for x in p.lens for v in x.vignetting),
        "bracket.shutter_s": (*p.bracket.shutter_s, *p.bracket.nd_shutter_s),
        "bracket.f_number": (p.bracket.f_number,),
        "bracket.iso": (p.bracket.iso,),
        "sensor.gain_e_per_dn": (p.sensor.gain_e_per_dn,),
        "sensor.iso": (p.sensor.iso,),
        "shutter.nominal_s and true_s": tuple(
            t for x in p.shutter for t in (x.nominal_s, x.true_s)
        ),
        "scale.k": (p.scale.k,),
        "scale.f_numbers": p.scale.f_numbers,
        "nd.factor_rgb": tuple(f for x in p.nd for f in x.factor_rgb),
    }
    for key, values in positive.items():
        for value in values:
            if not 0 < value < 1e12:
                raise InputError(where, f"{key} = {value:g}", "a number above 0")
    relative = (
        p.colour.u_rel,
        p.scale.u_rel,
        p.response.u_rel,
        p.glare_floor_rel,
        *(x.u_rel for x in p.shutter),
    )
    relative += (*(x.u_rel for x in p.nd), *(v.u_rel for x in p.lens for v in x.vignetting))
    if not all(0 <= value < 1 for value in relative):
        raise InputError(
            where,
            f"a share of {next(v for v in relative if not 0 <= v < 1):g}",
            "u_rel: 0 to below 1",
        )
    if min(p.sensor.read_noise_e, p.bracket.seconds_per_frame, p.bracket.megabytes_per_frame) < 0:
        raise InputError(
            where, "read_noise_e, seconds_per_frame or megabytes_per_frame below 0", "0 or more"
        )
    if (
        max(x.full_angle_deg for x in p.lens) > 300
        or max(p.camera.width_px, p.camera.height_px) > 100_000
    ):
        raise InputError(
            where, "a lens beyond 300 degrees or a sensor beyond 100 000 pixels", "a real camera"
        )
    for lens in p.lens:
        _check_mapping(lens, where)
    if len(p.sensor.black_dn) != 4 or len(p.sensor.saturation_dn) != 4:
        raise InputError(where, "[sensor] black_dn or saturation_dn", "four values: R, G1, G2, B")
    if not max(p.sensor.black_dn) < min(*p.sensor.saturation_dn, p.sensor.white_dn):
        raise InputError(
            where, "[sensor] black at or above saturation", "black below saturation and white"
        )
    if len(p.colour.rgb_to_radiance) not in (0, 9):
        raise InputError(
            where, f"colour.rgb_to_radiance of {len(p.colour.rgb_to_radiance)} values", "9, or none"
        )
    if not 0 <= p.response.low_code < p.response.high_code <= 255:
        raise InputError(where, "response.low_code, high_code", "0 <= low < high <= 255")


def _check_mapping(lens: Lens, where: str) -> None:
    """The radius must rise with the angle up to the edge of the circle, and reach 1 there."""
    if lens.mapping != "polynomial":
        return
    found = (
        f"lens '{lens.name}': polynomial of "
        f"{', '.join(f'{c:g}' for c in lens.coefficients) or 'no coefficients'}"
    )
    remedy = "fit it again: fieldlum calibrate lens"
    try:
        angle_of_radius(lens.geometry, 1.0)
    except ValueError as error:
        raise InputError(
            where, f"{found} ({error})", "one that rises up to the edge of the circle", remedy
        ) from None
    if abs(sum(lens.coefficients) - 1.0) > 0.02:
        raise InputError(
            where,
            f"{found}, in all {sum(lens.coefficients):g}",
            "coefficients that sum to 1",
            remedy,
        )


def save_profile(path: Path, profile: CameraProfile) -> None:
    """Write as TOML, whole or not at all."""
    import tomli_w

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(tomli_w.dumps(plain(profile)), encoding="utf-8")
    temporary.replace(path)


def bracket_exposures(bracket: Bracket) -> tuple[Exposure, ...]:
    """Longest first, then the frames through each filter."""
    open_frames = [
        Exposure(t, bracket.f_number, bracket.iso) for t in sorted(bracket.shutter_s, reverse=True)
    ]
    filtered = [
        Exposure(t, bracket.f_number, bracket.iso, name)
        for name in bracket.nd
        for t in sorted(bracket.nd_shutter_s, reverse=True)
    ]
    return (*open_frames, *filtered)
