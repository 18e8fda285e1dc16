"""Camera profiles: calibration/NAME.toml, everything between sensor counts and cd/m2."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

from fieldlum.errors import InputError
from fieldlum.photometry import rises
from fieldlum.projection import LensGeometry, angle_of_radius, judged_text, seen_by_lenses
from fieldlum.records import CameraSetup, Exposure
from fieldlum.strict_toml import build, plain, read_toml

_HERE = Path(__file__).parent


def shipped(kind: Literal["calibration", "capture_plans"]) -> Path:
    """Return the folder of the shipped files, in a wheel or in a checkout."""
    in_wheel = _HERE / "_shipped" / kind
    return in_wheel if in_wheel.is_dir() else _HERE.parent / kind


@dataclass(frozen=True, slots=True)
class CameraBody:
    """The camera's name, kind and size."""

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
    """The sensor of a raw camera; four values are those of R, G1, G2, B, in DN."""

    cfa: str = "RGGB"
    black_dn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    # The plateau, not the file's tag.
    saturation_dn: tuple[float, ...] = (65535.0, 65535.0, 65535.0, 65535.0)
    # Counts (black included) at which linear z is 1 by definition; determines only the unit of
    # scale.k.
    white_dn: float = 65535.0
    gain_e_per_dn: float = 1.0  # at iso
    read_noise_e: float = 3.0
    iso: float = 100.0
    # Light over counts, 1 + a1 x + a2 x2 + ..., x the share of white_dn above black; empty: not
    # calibrated.
    linearity: tuple[float, ...] = ()
    # Relative; a 12-bit CCD of EMVA1288/datasets departs by +0.3 to -1.2 %, uniform over 1.5 % is
    # 0.43 % (bench/real_sensor.py).
    linearity_u_rel: float = 0.0043
    exposure_offset_s: float = 0.0  # an electronic shutter opens so much longer than it states
    bad_px: tuple[tuple[int, int], ...] = ()  # column, row of pixels that are never used


@dataclass(frozen=True, slots=True)
class Bracket:
    """The exposures of a plan by default; shutter times are nominal."""

    f_number: float
    iso: float
    shutter_s: tuple[float, ...]
    nd: tuple[str, ...] = ()  # one more bracket tail per filter, at the shortest times
    nd_shutter_s: tuple[float, ...] = ()
    seconds_per_frame: float = 2.0
    megabytes_per_frame: float = 25.0


@dataclass(frozen=True, slots=True)
class ShutterTime:
    """A measured shutter time."""

    nominal_s: float
    true_s: float
    u_rel: float = 0.002


@dataclass(frozen=True, slots=True)
class Vignetting:
    """Relative transmission V in powers of r = angle / (full angle / 2): V = sum c_k r^k.

    c_0 is first, V(0) = 1.
    """

    f_number: float
    coefficients: tuple[float, ...]
    u_rel: float = 0.01


@dataclass(frozen=True, slots=True)
class Lens:
    """One lens on the sensor.

    Pixel coordinates: (0, 0) is the top left corner of the sensor's top left pixel.
    """

    centre_px: tuple[float, float]  # x to the right, y down
    radius_px: float  # of the image circle at full_angle_deg / 2
    full_angle_deg: float
    mapping: Literal["equidistant", "equisolid", "polynomial"] = "equisolid"
    # Of a polynomial: r / radius_px = sum c_k (angle / half angle)^(k + 1).
    coefficients: tuple[float, ...] = ()
    name: str = "lens"
    azimuth_deg: float = 0.0  # optical axis relative to the camera's heading, clockwise
    tilt_deg: float = 0.0  # up
    roll_deg: float = 0.0  # clockwise as seen from behind the camera
    vignetting: tuple[Vignetting, ...] = ()

    @property
    def geometry(self) -> LensGeometry:
        """The lens on its complete sensor, relative to the camera's heading."""
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
    """The response of a JPEG camera: code value to linear z in [0, 1]."""

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
    # 9 values, row by row; empty: no colour is written, only Y.
    rgb_to_radiance: tuple[float, ...] = ()
    u_rel: float = 0.02


@dataclass(frozen=True, slots=True)
class Scale:
    """L = k * 87 * N^2 / (t S) * z with z in [0, 1], t in s (87: hdrgen's stonits)."""

    k: float = 1.0
    u_rel: float = 0.05
    f_numbers: tuple[float, ...] = ()  # apertures for which k is valid; empty: all


@dataclass(frozen=True, slots=True)
class StrayLight:
    """Stray light of the lenses: K at ascending angles; empty: not calibrated.

    See photometry/stray_light.py; u_rel is of the stray light, not of the luminance.
    """

    angle_deg: tuple[float, ...] = ()
    per_sr: tuple[float, ...] = ()
    u_rel: float = 0.0


@dataclass(frozen=True, slots=True)
class NeutralDensity:
    """A neutral-density filter of the lens."""

    name: str
    factor_rgb: tuple[float, float, float]  # luminance without over luminance with the filter
    u_rel: float = 0.02


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a profile's values."""

    source: str = ""
    fitted_by: str = ""
    frames_sha256: tuple[str, ...] = ()
    log: tuple[str, ...] = ()  # one line for each fit: the choice and its reason


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
    # Veiling glare of the lens, as a share of the mean luminance; 0 once [stray] is calibrated.
    glare_floor_rel: float = 0.0005
    stray: StrayLight = field(default_factory=StrayLight)
    expires: str = ""  # ISO date; doctor warns after it
    provenance: Provenance = field(default_factory=Provenance)
    # How nominal times without a measured one are read: see photometry/shutter_law.py.
    shutter_law: Literal["auto", "third-stops", "half-stops", "exact"] = "auto"


def coverage_text(profile: CameraProfile, setup: CameraSetup) -> str:
    """Return which view directions these lenses and headings can judge; empty if all.

    For one lens without turned head the text names headings that would see all.
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
        return f"{text}; use a lens that sees more, or turn the camera to several headings"
    named = ", ".join(f"{heading:g}" for heading in opposite)
    return f"{text}; for all directions write headings = [{named}] under [camera] in SITE.toml"


DEFAULT_CAMERA = "sim-dual-fisheye"


def find_camera_profile(name: str) -> Path:
    """Return the path of a profile: the path itself, or a name in the shipped calibration/.

    Raises InputError with the list of profiles.
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
    raise InputError(
        name, "no such camera profile", f"a TOML file or one of: {known}", "correct it"
    )


def load_camera_profile(name: str | Path) -> CameraProfile:
    """Read a profile. Raises InputError for a file that is no profile, or has impossible values."""
    path = find_camera_profile(str(name))
    profile = build(CameraProfile, read_toml(path), str(path))
    check_camera(profile, str(path))
    return profile


def check_camera(profile: CameraProfile, where: str) -> None:
    """Raise InputError, with the key, for values that no camera can have."""
    p = profile
    if not p.lens:
        raise InputError(where, "no [[lens]]", "at least one lens", "add it")
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
                raise InputError(where, f"{key} = {value:g}", "a number above 0", "correct it")
    relative = (
        p.colour.u_rel,
        p.scale.u_rel,
        p.response.u_rel,
        p.sensor.linearity_u_rel,
        p.glare_floor_rel,
        p.stray.u_rel,
        *(x.u_rel for x in p.shutter),
    )
    relative += (*(x.u_rel for x in p.nd), *(v.u_rel for x in p.lens for v in x.vignetting))
    if not all(0 <= value < 1 for value in relative):
        raise InputError(
            where,
            f"a relative value of {next(v for v in relative if not 0 <= v < 1):g}",
            "u_rel and glare_floor_rel from 0 to below 1",
            "correct it",
        )
    _check_stray(p.stray, where)
    if min(p.sensor.read_noise_e, p.bracket.seconds_per_frame, p.bracket.megabytes_per_frame) < 0:
        raise InputError(
            where,
            "read_noise_e, seconds_per_frame or megabytes_per_frame below 0",
            "0 or more",
            "correct it",
        )
    if (
        max(x.full_angle_deg for x in p.lens) > 300
        or max(p.camera.width_px, p.camera.height_px) > 100_000
    ):
        raise InputError(
            where,
            "a lens beyond 300 degrees or a sensor beyond 100 000 pixels",
            "a possible camera",
            "correct it",
        )
    for lens in p.lens:
        _check_mapping(lens, where)
    if len(p.sensor.black_dn) != 4 or len(p.sensor.saturation_dn) != 4:
        found = "another count of values in [sensor] black_dn or saturation_dn"
        raise InputError(where, found, "four values: R, G1, G2, B", "correct it")
    if not max(p.sensor.black_dn) < min(*p.sensor.saturation_dn, p.sensor.white_dn):
        raise InputError(
            where,
            "[sensor] black at or above saturation",
            "black below saturation and white",
            "correct it",
        )
    if not rises(p.sensor.linearity):
        found = f"sensor.linearity = {', '.join(f'{a:g}' for a in p.sensor.linearity)}"
        raise InputError(
            where, found, "a correction that rises with the counts", "fieldlum calibrate linearity"
        )
    if abs(p.sensor.exposure_offset_s) >= 0.01:
        found = f"sensor.exposure_offset_s = {p.sensor.exposure_offset_s:g}"
        raise InputError(where, found, "microseconds: less than 0.01 s")
    if len(p.colour.rgb_to_radiance) not in (0, 9):
        found = f"colour.rgb_to_radiance of {len(p.colour.rgb_to_radiance)} values"
        raise InputError(where, found, "9 values, or none", "correct it")
    if not 0 <= p.response.low_code < p.response.high_code <= 255:
        found = f"response.low_code {p.response.low_code}, high_code {p.response.high_code}"
        raise InputError(where, found, "0 <= low < high <= 255", "correct it")


def _check_stray(kernel: StrayLight, where: str) -> None:
    angles, values = kernel.angle_deg, kernel.per_sr
    rising = all(a < b for a, b in pairwise(angles))
    if len(angles) != len(values) or not rising or not all(0 < a <= 180 for a in angles):
        found = f"[stray] angle_deg = {list(angles)} with {len(values)} values of per_sr"
        raise InputError(
            where, found, "rising angles from 0 to 180, a value for each", "correct it"
        )
    falling = all(a >= b for a, b in pairwise(values))
    if not falling or min(values, default=0.0) < 0:
        found = f"[stray] per_sr = {list(values)}"
        raise InputError(where, found, "values of 0 or more that do not rise", "correct it")


def _check_mapping(lens: Lens, where: str) -> None:
    """Raise InputError unless the radius rises with the angle up to the edge, and is 1 there."""
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
            where, f"{found} ({error})", "a polynomial that rises up to the edge", remedy
        ) from None
    if abs(sum(lens.coefficients) - 1.0) > 0.02:
        raise InputError(
            where,
            f"{found}, with the sum {sum(lens.coefficients):g}",
            "coefficients that sum to 1",
            remedy,
        )


def save_profile(path: Path, profile: CameraProfile) -> None:
    """Write a profile as TOML, completely or not at all."""
    import tomli_w

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(tomli_w.dumps(plain(profile)), encoding="utf-8")
    temporary.replace(path)


def bracket_exposures(bracket: Bracket) -> tuple[Exposure, ...]:
    """Return the exposures of a bracket: longest first, then those through each filter."""
    open_frames = [
        Exposure(t, bracket.f_number, bracket.iso) for t in sorted(bracket.shutter_s, reverse=True)
    ]
    filtered = [
        Exposure(t, bracket.f_number, bracket.iso, name)
        for name in bracket.nd
        for t in sorted(bracket.nd_shutter_s, reverse=True)
    ]
    return (*open_frames, *filtered)
