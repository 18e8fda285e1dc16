"""Camera profiles: calibration/NAME.toml, everything between sensor counts and cd/m2."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from fieldlum.core.errors import InputError, did_you_mean
from fieldlum.core.files import write_file
from fieldlum.core.records import CameraSetup, Cfa, Exposure, Slot, counted
from fieldlum.core.strict_toml import NotNegative, Positive, Share, build, plain, read_toml
from fieldlum.optics.camera_curves import corrected_counts_rise
from fieldlum.optics.projection import LensGeometry, angle_of_radius, judged_text, seen_by_lenses

_Side = Annotated[int, Meta(gt=0, le=100_000)]  # px
_OfColours = Annotated[tuple[float, ...], Meta(min_length=4, max_length=4)]  # R, G1, G2, B
# Shipped profiles to start a calibration with have 0.15 (vignetting), 0.2 and 0.5; the worst
# calibrated one has 0.05.
_U_NOT_CALIBRATED = 0.1

# ----------------------------------------------------------------------------------------------
# the tables of a profile


@dataclass(frozen=True, slots=True)
class CameraBody:
    """Name and kind of the camera, the size of its frames [px], and a lens's fixed aperture.

    make, model: as in EXIF, "" if unknown. date: ISO date of the calibration, "" without one. note:
    for readers. fixed_f_number: aperture of a lens that writes none to EXIF; 0 if EXIF states it.
    """

    name: str
    kind: Literal["raw", "jpeg"]
    width_px: _Side
    height_px: _Side
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

    cfa: colours of the top left 2 x 2 pixels. black_dn: counts without light. saturation_dn: the
    plateau in the frames, not the white level in the file. white_dn: counts (black included) at
    which linear z is 1 by definition; it determines only the unit of scale.k. gain_e_per_dn:
    electrons per count at ISO `iso`. read_noise_e: standard deviation of a pixel, in electrons.
    linearity: light over counts is 1 + a1 x + a2 x2 + ..., with x the share of white_dn above
    black; empty if not calibrated. linearity_u_rel: relative standard uncertainty of the corrected
    counts. exposure_offset_s: seconds by which an electronic shutter opens longer than stated.
    bad_px: (column, row) of pixels that are never used.
    """

    cfa: Cfa = "RGGB"
    black_dn: _OfColours = (0.0, 0.0, 0.0, 0.0)
    saturation_dn: _OfColours = (65535.0, 65535.0, 65535.0, 65535.0)
    white_dn: float = 65535.0
    gain_e_per_dn: Positive = 1.0
    read_noise_e: NotNegative = 3.0
    iso: Positive = 100.0
    linearity: tuple[float, ...] = ()
    # A 12-bit CCD of EMVA1288/datasets departs by +0.3 to -1.2 %; uniform over 1.5 % is 0.43 %
    # (bench/real_sensor.py).
    linearity_u_rel: Share = 0.0043
    exposure_offset_s: Annotated[float, Meta(gt=-0.01, lt=0.01)] = 0.0
    bad_px: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Bracket:
    """The exposures that a plan uses by default; shutter times are nominal.

    nd_shutter_s: times of the frames through a filter, for plans that name one; nd: names of
    filters with such times. f_number, iso: of all frames. seconds_per_frame, megabytes_per_frame:
    for the duration of a bracket and the size of its files.
    """

    f_number: Positive
    iso: Positive
    shutter_s: tuple[Positive, ...]
    nd: tuple[str, ...] = ()
    nd_shutter_s: tuple[Positive, ...] = ()
    seconds_per_frame: NotNegative = 2.0
    megabytes_per_frame: NotNegative = 25.0


@dataclass(frozen=True, slots=True)
class ShutterTime:
    """The measured true time of a nominal shutter time, and its relative standard uncertainty."""

    nominal_s: Positive
    true_s: Positive
    u_rel: Share = 0.002


@dataclass(frozen=True, slots=True)
class Vignetting:
    """Vignetting V in powers of r = angle / (full angle / 2): V = sum c_k r^k.

    c_0 is first, V(0) = 1; valid at f_number. u_rel: relative standard uncertainty.
    """

    f_number: Positive
    coefficients: tuple[float, ...]
    u_rel: Share = 0.01


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

    red, green, blue: for a polynomial the coefficients, c_0 first, of code / 255; for a table 256
    values of z; else empty. Codes outside low_code ... high_code have no weight. u_rel: relative
    standard uncertainty of z.
    """

    kind: Literal["linear", "srgb", "polynomial", "table"] = "linear"
    red: tuple[float, ...] = ()
    green: tuple[float, ...] = ()
    blue: tuple[float, ...] = ()
    low_code: int = 27
    high_code: int = 228
    u_rel: Share = 0.01


@dataclass(frozen=True, slots=True)
class Colour:
    """Luminance from linear camera R, G, B: Y = y_from_rgb . RGB.

    u_rel: relative standard uncertainty of Y. rgb_to_radiance: matrix to Radiance's R, G, B of 9
    values, row by row; if empty, no colour is written, only Y. melanopic_from_rgb: weights of R, G,
    B in melanopic luminance; if empty, melanopic EDI is an estimate. melanopic_u_rel: relative
    standard uncertainty of melanopic over photopic light under daylight.
    """

    y_from_rgb: tuple[float, float, float] = (0.265, 0.670, 0.065)
    rgb_to_radiance: tuple[float, ...] = ()
    u_rel: Share = 0.02
    melanopic_from_rgb: tuple[float, ...] = ()
    melanopic_u_rel: Share = 0.0


@dataclass(frozen=True, slots=True)
class Scale:
    """The scale k: L = k * 87 * N^2 / (t S) * z with z in [0, 1], t in s (87: hdrgen's stonits).

    N: f-number, t: shutter time, S: ISO. u_rel: relative standard uncertainty of k. f_numbers:
    apertures for which k is valid; empty for all.
    """

    k: Positive = 1.0
    u_rel: Share = 0.05
    f_numbers: tuple[Positive, ...] = ()


@dataclass(frozen=True, slots=True)
class StrayLight:
    """Stray light of the lenses: the kernel K [1/sr] at ascending angles; empty if not calibrated.

    K is the share of a direction's light that appears in each steradian at that angle from it
    (optics/stray_light.py). angle_deg: above 0 to 180; per_sr: K at each of them. u_rel: standard
    uncertainty relative to the stray light, not to the luminance.
    """

    angle_deg: tuple[float, ...] = ()
    per_sr: tuple[float, ...] = ()
    u_rel: Share = 0.0


@dataclass(frozen=True, slots=True)
class NeutralDensity:
    """A neutral-density filter: its name, its factor by colour, and the relative uncertainty.

    factor_rgb: luminance without the filter over luminance with it, for red, green and blue. u_rel:
    relative standard uncertainty of the factors.
    """

    name: str
    factor_rgb: tuple[Positive, Positive, Positive]
    u_rel: Share = 0.02


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a profile's values: source, who fitted them, hashes of the frames used, log.

    log: one line for each fit, with the choice and its reason.
    """

    source: str = ""
    fitted_by: str = ""
    frames_sha256: tuple[str, ...] = ()
    log: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """A camera profile: everything between sensor counts and cd/m2, with its uncertainty.

    lens: one table for each lens on the sensor; shutter: measured shutter times; nd: filters;
    glare_floor_rel: veiling glare of the lens, as a share of the picture's mean luminance; 0 once
    [stray] is calibrated. expires: ISO date after which doctor reports a failure, or "".
    shutter_law: how nominal times without a measured time are converted (optics/exposure.py).
    """

    camera: CameraBody
    lens: Annotated[tuple[Lens, ...], Meta(min_length=1)]
    bracket: Bracket
    sensor: Sensor = field(default_factory=Sensor)
    shutter: tuple[ShutterTime, ...] = ()
    response: Response = field(default_factory=Response)
    colour: Colour = field(default_factory=Colour)
    scale: Scale = field(default_factory=Scale)
    nd: tuple[NeutralDensity, ...] = ()
    glare_floor_rel: Share = 0.0005
    stray: StrayLight = field(default_factory=StrayLight)
    expires: str = ""
    provenance: Provenance = field(default_factory=Provenance)
    shutter_law: Literal["auto", "third-stops", "half-stops", "exact"] = "auto"


# ----------------------------------------------------------------------------------------------
# values that do not belong together


def check_profile(profile: CameraProfile, where: str) -> None:
    """Raise InputError for values that no camera has together; where: the profile, for the error.

    They are values of lenses, sensor, colour, response and stray light. The range of each single
    value is checked when the profile is read.
    """

    def wrong(finding: str, expected: str, remedy: str = "") -> InputError:
        """Return the error for a value; remedy: "" for correcting the value."""
        return InputError(where, finding, expected, remedy or "correct this value in the profile")

    fit_again = "fit it again: fieldlum calibrate lens"
    for lens in (lens for lens in profile.lens if lens.mapping == "polynomial"):
        shown = list(lens.coefficients) or "no coefficients"
        finding = f"lens '{lens.name}': polynomial of {shown}"
        try:
            angle_of_radius(lens, 1.0)
        except ValueError as error:
            expected = "a polynomial that rises up to the edge"
            raise wrong(f"{finding} ({error})", expected, fit_again) from None
        if abs(sum(lens.coefficients) - 1.0) > 0.02:
            finding = f"{finding}, with the sum {sum(lens.coefficients):g}"
            raise wrong(finding, "coefficients that sum to 1", fit_again)
    sensor, colour, stray = profile.sensor, profile.colour, profile.stray
    if not max(sensor.black_dn) < min(*sensor.saturation_dn, sensor.white_dn):
        finding = f"[sensor] black_dn = {max(sensor.black_dn):g}"
        raise wrong(finding, "less than saturation_dn and white_dn")
    if not corrected_counts_rise(sensor.linearity):
        finding = f"sensor.linearity = {list(sensor.linearity)}"
        raise wrong(finding, "corrected counts that rise with the raw counts", "calibrate it again")
    radiance, melanopic = len(colour.rgb_to_radiance), len(colour.melanopic_from_rgb)
    if radiance not in (0, 9):
        raise wrong(f"colour.rgb_to_radiance has {radiance} values", "9 values, or none")
    if melanopic not in (0, 3) or (melanopic and not radiance):
        finding = f"colour.melanopic_from_rgb has {melanopic} values, rgb_to_radiance {radiance}"
        raise wrong(finding, "3 values next to 9 of rgb_to_radiance, or none")
    low, high = profile.response.low_code, profile.response.high_code
    if not 0 <= low < high <= 255:
        raise wrong(f"response.low_code {low}, high_code {high}", "0 <= low < high <= 255")
    angles, values = stray.angle_deg, stray.per_sr
    rising = all(a < b for a, b in pairwise(angles))
    if len(angles) != len(values) or not rising or not all(0 < a <= 180 for a in angles):
        finding = f"[stray] angle_deg = {list(angles)} with {len(values)} values of per_sr"
        raise wrong(finding, "rising angles from 0 to 180, and a value for each")
    if not all(a >= b for a, b in pairwise(values)) or min(values, default=0.0) < 0:
        raise wrong(f"[stray] per_sr = {list(values)}", "values of 0 or more that do not rise")


# ----------------------------------------------------------------------------------------------
# profiles that fieldlum ships, and files


_PACKAGE = Path(__file__).parents[1]


def shipped(kind: Literal["calibration", "capture_plans"]) -> Path:
    """Return the folder of the shipped files of a kind, in a wheel or in a checkout."""
    in_wheel = _PACKAGE / "_shipped" / kind
    return in_wheel if in_wheel.is_dir() else _PACKAGE.parent / kind


def coverage_text(profile: CameraProfile, setup: CameraSetup) -> str:
    """Return one sentence on the view directions that lenses and headings see; "" if all.

    setup: heading, or headings, of the camera. If the heading and its opposite would see all
    directions, the text names these two.
    """
    heading_deg = setup.heading_deg
    turns = [heading - heading_deg for heading in setup.headings or (heading_deg,)]
    text = judged_text(seen_by_lenses(profile.lens, turns), heading_deg)
    if not text:
        return ""
    if judged_text(seen_by_lenses(profile.lens, (0.0, 180.0)), heading_deg):
        return f"{text}; use a lens that sees more, or turn the camera to several headings"
    both = f"[{heading_deg % 360.0:g}, {(heading_deg + 180.0) % 360.0:g}]"
    text = f"{text}; for all directions write headings = {both} under [camera] in SITE.toml"
    return f"{text}, and a person turns the camera in each bracket"


DEFAULT_CAMERA = "sim-dual-fisheye"


def camera_names() -> list[str]:
    """Return the names of the shipped camera profiles, simulated cameras last."""
    names = (path.stem for path in shipped("calibration").glob("*.toml"))
    return sorted(names, key=lambda name: (name.startswith("sim-"), name))


def assumed_texts(setup: CameraSetup) -> list[str]:
    """Return a sentence for the heading and one for the camera that SITE.toml does not state."""
    texts = []
    if "heading_deg" in setup.assumed:
        texts.append(
            f"no heading of the camera is stated: {setup.heading_deg:g} deg is assumed, and a "
            "wrong heading turns every result; measure it and state heading_deg under [camera]"
        )
    if "profile" in setup.assumed:
        texts.append(
            f"no camera is stated: times, exposures and directions are those of the simulated "
            f"{DEFAULT_CAMERA}, and the size of the files is unknown; state profile under "
            "[camera] (fieldlum new lists cameras)"
        )
    return texts


def turning_text(setup: CameraSetup) -> str:
    """Return a sentence that a person must turn a camera with headings; "" for a fixed camera."""
    if not setup.headings:
        return ""
    headings = ", ".join(f"{heading:g}" for heading in setup.headings)
    return (
        f"each bracket is taken at the headings {headings} deg, and no driver turns a camera: a "
        "person turns it to each heading, takes all exposures there and imports the card (fieldlum "
        "import); if the camera stays, remove headings from SITE.toml and plan again"
    )


def uncalibrated_text(profile: CameraProfile) -> str:
    """Return one sentence on the parts of a profile that are not calibrated; "" if all are.

    Without a date of calibration no part is calibrated: `calibrate` sets the date with the first
    part that it fits. With a date, a part is not calibrated while its uncertainty is over
    `_U_NOT_CALIBRATED`.
    """
    vignetting = max((v.u_rel for lens in profile.lens for v in lens.vignetting), default=0.0)
    parts = {"scale": profile.scale.u_rel, "colour": profile.colour.u_rel, "vignetting": vignetting}
    limit = _U_NOT_CALIBRATED if profile.camera.date else 0.0
    shares = [f"{name} {100 * u:.0f} %" for name, u in parts.items() if u > limit]
    texts = f"standard uncertainties are {', '.join(shares)}"
    if not profile.camera.date:
        why = f"no date of calibration: {texts}, and directions may be wrong by some degrees"
    else:
        why = f"parts that are not calibrated: {texts}" if shares else ""
    return f"{profile.camera.name} has {why} (fieldlum calibrate -h)" if why else ""


def find_camera_profile(name: str) -> Path:
    """Return the path of a profile: `name` as a path, or else a file that is shipped.

    A relative path is from the current folder. Of a path without a file, the last part is looked up
    among the shipped names, which may omit .toml; "" means sim-dual-fisheye. Raises InputError,
    with the shipped names, if no file fits.
    """
    path, folder = Path(name or DEFAULT_CAMERA), shipped("calibration")
    for candidate in (path, folder / path.name, folder / f"{path.name}.toml"):
        if candidate.is_file():
            return candidate
    expected = f"the path of a TOML file, or one of: {', '.join(camera_names())}"
    remedy = "correct --camera, or profile under [camera] in SITE.toml or session.toml"
    remedy += did_you_mean(name, camera_names())
    raise InputError(name, "no such camera profile", expected, remedy)


def load_camera_profile(name: str | Path) -> CameraProfile:
    """Read a profile: a shipped one by name, or any by path; "" is sim-dual-fisheye.

    Raises InputError for a missing file, one that is not a profile, or impossible values.
    """
    path = find_camera_profile(str(name))
    profile = build(CameraProfile, read_toml(path), str(path))
    check_profile(profile, str(path))
    return profile


def save_profile(path: Path, profile: CameraProfile) -> None:
    """Write a profile as TOML, over an existing file; the file appears complete or not at all.

    Raises OSError if it cannot be written.
    """
    import tomli_w

    write_file(path, tomli_w.dumps(plain(profile)))


def bracket_exposures(bracket: Bracket, filter_name: str = "") -> tuple[Exposure, ...]:
    """Return the exposures without a filter, then those through one; each longest time first.

    filter_name: the filter whose exposures of the profile are added; "" for none.
    """
    times = [(time, "") for time in sorted(bracket.shutter_s, reverse=True)]
    if filter_name:
        times += [(time, filter_name) for time in sorted(bracket.nd_shutter_s, reverse=True)]
    f_number, iso = bracket.f_number, bracket.iso
    return tuple(Exposure(shutter_s=t, f_number=f_number, iso=iso, nd=name) for t, name in times)


def planned_exposures(profile: CameraProfile, setup: CameraSetup) -> tuple[Exposure, ...]:
    """Return the exposures of each slot; frames through a filter only if `setup` names one.

    Raises InputError for a filter that the profile does not have, or without times for it.
    """
    names = [nd.name for nd in profile.nd]
    if setup.filter and not (setup.filter in names and profile.bracket.nd_shutter_s):
        what = "shutter times through" if setup.filter in names else "filter"
        expected = f"one of its filters ({', '.join(names) or 'none'}), with nd_shutter_s"
        remedy = "correct filter under [camera] in SITE.toml, or add [[nd]] to the profile"
        remedy += did_you_mean(setup.filter, names)
        raise InputError(profile.camera.name, f"no {what} '{setup.filter}'", expected, remedy)
    return bracket_exposures(profile.bracket, setup.filter)


def sun_text(slots: Sequence[Slot]) -> str:
    """Return a sentence on how the sun's disc is measured; "" without filter and sun in view."""
    if names := sorted({e.nd for slot in slots for e in slot.exposures if e.nd}):
        remedy = "a person must put it on and take it off in each bracket"
        return f"frames are planned through the filter {', '.join(names)}: {remedy}"
    if not (in_view := sum("sun-in-view" in slot.tags for slot in slots)):
        return ""
    text = f"the sun is in view of the lens in {counted(in_view, 'slot')}"
    return f"{text}, which no exposure reaches: the illuminance of its disc is computed from DNI"
