"""Define the tables of a camera profile, calibration/NAME.toml, and refuse impossible values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Literal

from fieldlum.core.errors import InputError
from fieldlum.optics.photometry import rises
from fieldlum.optics.projection import LensGeometry, angle_of_radius


@dataclass(frozen=True, slots=True)
class CameraBody:
    """Name and kind of the camera, the size of its frames [px], and a lens's fixed aperture.

    date: ISO date of the calibration. fixed_f_number: aperture of a lens that writes none to
    EXIF; 0 if EXIF states it.
    """

    name: str
    kind: Literal["raw", "jpeg"]
    width_px: int
    height_px: int
    make: str = ""
    model: str = ""
    date: str = ""
    note: str = ""
    fixed_f_number: float = 0.0

    @property
    def pixels(self) -> int:
        """Number of pixels of a frame."""
        return self.width_px * self.height_px


@dataclass(frozen=True, slots=True)
class Sensor:
    """The sensor of a raw camera; four values are those of R, G1, G2, B, in DN.

    cfa: colours of the top left 2 x 2 pixels. black_dn: counts without light. saturation_dn:
    the plateau in the frames, not the white level in the file. white_dn: counts (black
    included) at which linear z is 1 by definition; it determines only the unit of scale.k.
    gain_e_per_dn: at ISO `iso`. linearity: light over counts is 1 + a1 x + a2 x2 + ..., with x
    the share of white_dn above black; empty if not calibrated. linearity_u_rel: relative
    standard uncertainty. exposure_offset_s: seconds by which an electronic shutter opens longer
    than stated. bad_px: (column, row) of pixels that are never used.
    """

    cfa: str = "RGGB"
    black_dn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    saturation_dn: tuple[float, ...] = (65535.0, 65535.0, 65535.0, 65535.0)
    white_dn: float = 65535.0
    gain_e_per_dn: float = 1.0
    read_noise_e: float = 3.0
    iso: float = 100.0
    linearity: tuple[float, ...] = ()
    # A 12-bit CCD of EMVA1288/datasets departs by +0.3 to -1.2 %; uniform over 1.5 % is 0.43 %
    # (bench/real_sensor.py).
    linearity_u_rel: float = 0.0043
    exposure_offset_s: float = 0.0
    bad_px: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Bracket:
    """The exposures that a plan uses by default; shutter times are nominal.

    nd_shutter_s: times of the frames through a filter, for plans that name one; nd: names of
    filters with such times; no plan uses them by itself.
    """

    f_number: float
    iso: float
    shutter_s: tuple[float, ...]
    nd: tuple[str, ...] = ()
    nd_shutter_s: tuple[float, ...] = ()
    seconds_per_frame: float = 2.0
    megabytes_per_frame: float = 25.0


@dataclass(frozen=True, slots=True)
class ShutterTime:
    """The measured true time of a nominal shutter time, and its relative standard uncertainty."""

    nominal_s: float
    true_s: float
    u_rel: float = 0.002


@dataclass(frozen=True, slots=True)
class Vignetting:
    """Vignetting V in powers of r = angle / (full angle / 2): V = sum c_k r^k.

    c_0 is first, V(0) = 1; valid at f_number. u_rel: relative standard uncertainty.
    """

    f_number: float
    coefficients: tuple[float, ...]
    u_rel: float = 0.01


@dataclass(frozen=True, slots=True)
class Lens(LensGeometry):
    """One lens on the sensor: its geometry on the complete sensor, its name and vignetting.

    azimuth_deg: of the optical axis relative to the camera's heading, clockwise.
    """

    name: str = "lens"
    vignetting: tuple[Vignetting, ...] = ()


@dataclass(frozen=True, slots=True)
class Response:
    """The response of a JPEG camera, from codes to linear z in [0, 1].

    red, green, blue: for a polynomial the coefficients, c_0 first, of code / 255; for a table
    256 values of z. Codes outside low_code ... high_code have no weight. u_rel: relative
    standard uncertainty.
    """

    kind: Literal["linear", "srgb", "polynomial", "table"] = "linear"
    red: tuple[float, ...] = ()
    green: tuple[float, ...] = ()
    blue: tuple[float, ...] = ()
    low_code: int = 27
    high_code: int = 228
    u_rel: float = 0.01


@dataclass(frozen=True, slots=True)
class Colour:
    """Luminance from linear camera R, G, B: Y = y_from_rgb . RGB.

    rgb_to_radiance: matrix of 9 values, row by row; if empty, no colour is written, only Y.
    melanopic_from_rgb: weights of R, G, B in melanopic luminance; if empty, melanopic EDI is an
    estimate. melanopic_u_rel: relative standard uncertainty of melanopic over photopic light under
    daylight.
    """

    y_from_rgb: tuple[float, float, float] = (0.265, 0.670, 0.065)
    rgb_to_radiance: tuple[float, ...] = ()
    u_rel: float = 0.02
    melanopic_from_rgb: tuple[float, ...] = ()
    melanopic_u_rel: float = 0.0


@dataclass(frozen=True, slots=True)
class Scale:
    """The scale k: L = k * 87 * N^2 / (t S) * z with z in [0, 1], t in s (87: hdrgen's stonits).

    N: f-number, t: shutter time, S: ISO. u_rel: relative standard uncertainty of k. f_numbers:
    apertures for which k is valid; empty for all.
    """

    k: float = 1.0
    u_rel: float = 0.05
    f_numbers: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class StrayLight:
    """Stray light of the lenses: the kernel K at ascending angles; empty if not calibrated.

    See photometry/stray_light.py; u_rel is relative to the stray light, not to the luminance.
    """

    angle_deg: tuple[float, ...] = ()
    per_sr: tuple[float, ...] = ()
    u_rel: float = 0.0


@dataclass(frozen=True, slots=True)
class NeutralDensity:
    """A neutral-density filter: its name, its factor by colour, and the relative uncertainty.

    factor_rgb: luminance without the filter over luminance with it, for red, green and blue.
    """

    name: str
    factor_rgb: tuple[float, float, float]
    u_rel: float = 0.02


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a profile's values: source, who fitted them, frames' hashes, log.

    log: one line for each fit, with the choice and its reason.
    """

    source: str = ""
    fitted_by: str = ""
    frames_sha256: tuple[str, ...] = ()
    log: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """A camera profile: everything between sensor counts and cd/m2, with its uncertainty.

    glare_floor_rel: veiling glare of the lens, as a share of the mean luminance; 0 once [stray]
    is calibrated. expires: ISO date after which doctor reports a failure, or "". shutter_law:
    how nominal times without a measured time are converted (photometry/shutter_law.py).
    """

    camera: CameraBody
    lens: tuple[Lens, ...]
    bracket: Bracket
    sensor: Sensor = field(default_factory=Sensor)
    shutter: tuple[ShutterTime, ...] = ()
    response: Response = field(default_factory=Response)
    colour: Colour = field(default_factory=Colour)
    scale: Scale = field(default_factory=Scale)
    nd: tuple[NeutralDensity, ...] = ()
    glare_floor_rel: float = 0.0005
    stray: StrayLight = field(default_factory=StrayLight)
    expires: str = ""
    provenance: Provenance = field(default_factory=Provenance)
    shutter_law: Literal["auto", "third-stops", "half-stops", "exact"] = "auto"


# ----------------------------------------------------------------------------------------------
# values that no camera can have


_Problem = tuple[str, ...]  # what was found, what is expected; what to do, if not to correct it


def check_camera(profile: CameraProfile, where: str) -> None:
    """Raise InputError for values that no camera can have; where: the profile, for the error."""
    if not profile.lens:
        raise InputError(where, "no [[lens]]", "at least one lens", "add a table [[lens]]")
    checks = (_range_problems, _lens_problems, _sensor_problems, _table_problems)
    for finding, expected, *remedy in chain.from_iterable(check(profile) for check in checks):
        correct = remedy[0] if remedy else "correct this value in the profile"
        raise InputError(where, finding, expected, correct)


def _range_problems(p: CameraProfile) -> Iterator[_Problem]:
    positive: dict[str, Iterable[float]] = {
        "camera.width_px": (p.camera.width_px,),
        "camera.height_px": (p.camera.height_px,),
        "lens.radius_px": (x.radius_px for x in p.lens),
        "lens.full_angle_deg": (x.full_angle_deg for x in p.lens),
        "lens.vignetting.f_number": (v.f_number for x in p.lens for v in x.vignetting),
        "bracket.shutter_s": (*p.bracket.shutter_s, *p.bracket.nd_shutter_s),
        "bracket.f_number": (p.bracket.f_number,),
        "bracket.iso": (p.bracket.iso,),
        "sensor.gain_e_per_dn": (p.sensor.gain_e_per_dn,),
        "sensor.iso": (p.sensor.iso,),
        "shutter.nominal_s and true_s": (t for x in p.shutter for t in (x.nominal_s, x.true_s)),
        "scale.k": (p.scale.k,),
        "scale.f_numbers": p.scale.f_numbers,
        "nd.factor_rgb": (f for x in p.nd for f in x.factor_rgb),
    }
    for key, value in ((key, value) for key, values in positive.items() for value in values):
        if not 0 < value < 1e12:
            yield f"{key} = {value:g}", "a number above 0"
    if min(p.sensor.read_noise_e, p.bracket.seconds_per_frame, p.bracket.megabytes_per_frame) < 0:
        yield "read_noise_e, seconds_per_frame or megabytes_per_frame below 0", "0 or more"
    parts = (p.colour, p.scale, p.response, p.stray, *p.shutter, *p.nd)
    shares = [*(part.u_rel for part in parts), *(v.u_rel for x in p.lens for v in x.vignetting)]
    shares += [p.colour.melanopic_u_rel, p.sensor.linearity_u_rel, p.glare_floor_rel]
    for value in shares:
        if not 0 <= value < 1:
            expected = "u_rel and glare_floor_rel from 0 to below 1"
            yield f"u_rel or glare_floor_rel = {value:g}", expected


def _sensor_problems(p: CameraProfile) -> Iterator[_Problem]:
    black, saturation = p.sensor.black_dn, p.sensor.saturation_dn
    if max(p.camera.width_px, p.camera.height_px) > 100_000:
        yield "a sensor with over 100 000 pixels a side", "a possible camera"
    if len(black) != 4 or len(saturation) != 4:
        counts = f"{len(black)} values of black_dn, {len(saturation)} of saturation_dn"
        yield f"[sensor] has {counts}", "four values of each: R, G1, G2, B"
    if not max(black) < min(*saturation, p.sensor.white_dn):
        finding = f"[sensor] black_dn = {max(black):g} is not below saturation_dn and white_dn"
        yield finding, "a black level below saturation_dn and white_dn"
    if not rises(p.sensor.linearity):
        finding = f"sensor.linearity = {', '.join(f'{a:g}' for a in p.sensor.linearity)}"
        remedy = "calibrate it again: fieldlum calibrate linearity"
        yield finding, "corrected counts that rise with the raw counts", remedy
    if abs(p.sensor.exposure_offset_s) >= 0.01:
        finding = f"sensor.exposure_offset_s = {p.sensor.exposure_offset_s:g}"
        remedy = "write it in seconds, or calibrate it again: fieldlum calibrate linearity"
        yield finding, "an offset in seconds, smaller than 0.01", remedy


def _table_problems(p: CameraProfile) -> Iterator[_Problem]:
    """Yield tables of colour, response and stray light whose values do not belong together."""
    radiance, melanopic = len(p.colour.rgb_to_radiance), len(p.colour.melanopic_from_rgb)
    if radiance not in (0, 9):
        yield f"colour.rgb_to_radiance has {radiance} values", "9 values, or none"
    if melanopic not in (0, 3) or (melanopic and not radiance):
        finding = f"colour.melanopic_from_rgb has {melanopic} values, rgb_to_radiance {radiance}"
        yield finding, "3 values next to 9 of rgb_to_radiance, or none"
    low, high = p.response.low_code, p.response.high_code
    if not 0 <= low < high <= 255:
        yield f"response.low_code {low}, high_code {high}", "0 <= low < high <= 255"
    angles, values = p.stray.angle_deg, p.stray.per_sr
    rising = all(a < b for a, b in pairwise(angles))
    if len(angles) != len(values) or not rising or not all(0 < a <= 180 for a in angles):
        finding = f"[stray] angle_deg = {list(angles)} with {len(values)} values of per_sr"
        yield finding, "rising angles from 0 to 180, and a value for each"
    if not all(a >= b for a, b in pairwise(values)) or min(values, default=0.0) < 0:
        yield f"[stray] per_sr = {list(values)}", "values of 0 or more that do not rise"


def _lens_problems(p: CameraProfile) -> Iterator[_Problem]:
    """Yield a lens of over 300 degrees, and one whose radius does not rise to 1 at the edge."""
    remedy = "fit it again: fieldlum calibrate lens"
    for lens in p.lens:
        if lens.full_angle_deg > 300:
            yield "a lens with over 300 degrees", "a possible camera"
        if lens.mapping != "polynomial":
            continue
        coefficients = ", ".join(f"{c:g}" for c in lens.coefficients) or "no coefficients"
        finding = f"lens '{lens.name}': polynomial of {coefficients}"
        try:
            angle_of_radius(lens, 1.0)
        except ValueError as error:
            yield f"{finding} ({error})", "a polynomial that rises up to the edge", remedy
        if abs(sum(lens.coefficients) - 1.0) > 0.02:
            total = f"{finding}, with the sum {sum(lens.coefficients):g}"
            yield total, "coefficients that sum to 1", remedy
