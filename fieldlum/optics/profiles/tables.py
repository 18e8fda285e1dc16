"""Define the tables of a camera profile, calibration/NAME.toml."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from fieldlum.optics.projection import LensGeometry


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

    nd: names of filters; for each, the times nd_shutter_s are repeated with the filter.
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
class Lens:
    """One lens on the sensor.

    Pixel coordinates: (0, 0) is the top left corner of the sensor's top left pixel. centre_px:
    of the image circle, x to the right, y down; radius_px: of the image circle at
    full_angle_deg / 2. coefficients: c_k of a polynomial mapping, r / radius_px = sum c_k
    (angle / half angle)^(k + 1). azimuth_deg: of the optical axis relative to the camera's
    heading, clockwise; tilt_deg: up; roll_deg: clockwise as seen from behind the camera.
    """

    centre_px: tuple[float, float]
    radius_px: float
    full_angle_deg: float
    mapping: Literal["equidistant", "equisolid", "polynomial"] = "equisolid"
    coefficients: tuple[float, ...] = ()
    name: str = "lens"
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    vignetting: tuple[Vignetting, ...] = ()

    @property
    def geometry(self) -> LensGeometry:
        """Geometry of the lens on the complete sensor, relative to the camera's heading."""
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
    """

    y_from_rgb: tuple[float, float, float] = (0.265, 0.670, 0.065)
    rgb_to_radiance: tuple[float, ...] = ()
    u_rel: float = 0.02


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
