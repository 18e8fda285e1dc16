"""Convert counts and codes of a camera frame to linear light, by the camera's profile.

Merge, calibrate and the simulated cameras share these rules, so that a frame has the same meaning
in all of them: which frames belong to a profile, black level and saturation, gain, the true shutter
time with its uncertainty, filters, vignetting, response, and the lens on a part of the sensor.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Integers
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Exposure
from fieldlum.optics.camera_curves import check_vignetting, response_table
from fieldlum.optics.exposure import prior_u_log, true_times_s, z_per_cdm2
from fieldlum.optics.profiles import CameraProfile, Lens
from fieldlum.optics.projection import LensGeometry, signed_angle_deg
from fieldlum.optics.raw import Mosaic, same_model

# Shutter times or apertures with a smaller relative difference are one setting; chosen. Settings
# differ by 12 %.
SAME_LABEL = 0.02
# Floor of the relative uncertainty of the exposure ratio of two frames: linearity of the sensor,
# change of light within a second. Well below the shutter priors; not measured.
U_FRAME_RATIO = 5e-4


def check_frame(path: Path, shape: tuple[int, ...], model: str, profile: CameraProfile) -> None:
    """Raise InputError for a frame whose size or camera model differs from the profile's.

    shape: (height, width, ...); model: as recorded in the file, "" if it is not.
    """
    body = profile.camera
    if shape[:2] != (body.height_px, body.width_px):
        finding = f"a frame of {shape[1]} x {shape[0]} pixels"
        expected = f"{body.width_px} x {body.height_px} pixels, the size of {body.name}"
        raise InputError(path, finding, expected, "use a profile of this camera (--camera)")
    if model and body.model and not same_model(model, body.model):
        expected = f"{body.model}, the camera of {body.name}"
        remedy = "use a profile of this camera, or write that model under [camera]"
        raise InputError(path, f"the frame was taken by {model}", expected, remedy)


def black_dn(mosaic: Mosaic, profile: CameraProfile) -> Sequence[float]:
    """Return the black levels of R, G1, G2, B [DN]: the profile's, or the file's if all are 0."""
    own = profile.sensor.black_dn
    return own if any(own) else mosaic.black_dn


def saturation_plateau(counts: Integers, white_dn: float) -> float | None:
    """Return the count at which a sensor saturates [DN]; None if these counts do not show it.

    counts: raw counts of any shape; white_dn: the white level in the file, below which many sensors
    saturate. Saturated pixels are a spike at the upper end of the histogram; the result is its mean
    count. The highest count (without a few hot pixels) must be at least half of white_dn, and the
    spike must have at least 8 pixels, 0.02 % of all pixels and ten times the pixels of equal runs
    of counts below it, as no bright smooth scene has.
    """
    flat = np.maximum(counts.ravel(), 0)
    pixels_of_count = np.bincount(flat, minlength=1)
    above = flat.size - np.cumsum(pixels_of_count)  # pixels above each count
    top = int(np.argmax(above <= max(8, 2e-5 * flat.size)))
    width = max(1, round(0.002 * white_dn))  # of the spike, in counts
    downwards = pixels_of_count[max(top + 1 - 12 * width, 0) : top + 1][::-1]  # from the highest
    spike, below = downwards[:width].sum(), downwards[2 * width :].sum() / 10
    if top < 0.5 * white_dn or spike < max(2e-4 * flat.size, 8, 10 * below):
        return None
    return float(top - np.average(np.arange(width), weights=downwards[:width]))


def full_dn(
    mosaic: Mosaic,
    profile: CameraProfile,
    plateau_dn: Sequence[float | None] = (None, None, None, None),
) -> list[float]:
    """Return the counts at which R, G1, G2, B saturate, in DN, black included.

    For each colour this is the least of the profile's saturation, the file's white level and
    plateau_dn: the count at which frames were seen to saturate, None if it was not measured.
    """
    tops = zip(profile.sensor.saturation_dn, plateau_dn, strict=True)
    return [min(own, mosaic.white_dn, plateau or np.inf) for own, plateau in tops]


def curve_u_rel(profile: CameraProfile) -> float:
    """Return the relative uncertainty of the conversion from counts or codes to light.

    A JPEG camera has the uncertainty of its response, a raw camera that of its linearity.
    """
    raw = profile.camera.kind == "raw"
    return profile.sensor.linearity_u_rel if raw else profile.response.u_rel


def gain_e_per_dn(iso: float, profile: CameraProfile) -> float:
    """Return the sensor's gain at an ISO, in electrons per count (DN).

    iso: of the exposure; the profile states the gain at another one.
    """
    return profile.sensor.gain_e_per_dn * profile.sensor.iso / iso


def true_shutter_s(shutter_s: float, profile: CameraProfile) -> tuple[float, float]:
    """Return the true time [s] of a nominal shutter time [s], and its relative uncertainty.

    The true time is the profile's measured time of a nominal time within 2 %; without a measured
    one it is the time by the profile's shutter law plus the sensor's constant exposure offset.
    shutter_s: the nominal time. The uncertainty is that of the measured time, else `prior_u_log`.
    """
    for measured in profile.shutter:
        if abs(measured.nominal_s / shutter_s - 1) < SAME_LABEL:
            return measured.true_s, measured.u_rel
    seconds = float(true_times_s(shutter_s, profile.shutter_law)) + profile.sensor.exposure_offset_s
    return seconds, float(prior_u_log(seconds))


def frame_z_per_cdm2(exposure: Exposure, profile: CameraProfile) -> float:
    """Return the linear signal z (1 at full scale) that 1 cd/m2 causes in a frame without a filter.

    exposure: of the frame, with its nominal shutter time, which is converted to the true one.
    """
    shutter_s, _ = true_shutter_s(exposure.shutter_s, profile)
    return z_per_cdm2(shutter_s, exposure.f_number, exposure.iso, profile.scale.k)


def nd_factors(name: str, profile: CameraProfile) -> tuple[float, float, float]:
    """Return the light without a filter over the light through it, at least 1, for R, G, B.

    name: of the filter; "" for none, which gives (1, 1, 1). Raises InputError for a filter that the
    profile does not have.
    """
    factors = {"": (1.0, 1.0, 1.0), **{nd.name: nd.factor_rgb for nd in profile.nd}}
    if name in factors:
        return factors[name]
    finding = f"the filter '{name}' is not in the profile"
    expected = f"one of: {', '.join(filter(None, factors)) or 'it has none'}"
    raise InputError(profile.camera.name, finding, expected, "add the filter under [[nd]]")


def vignetting_of(lens: Lens, f_number: float) -> tuple[tuple[float, ...], float]:
    """Return a lens's vignetting at an aperture: coefficients of V, and relative u at the edge.

    f_number: of the aperture. V is the transmission relative to the axis, in powers of the angle
    over half of the full angle, from power 0. An aperture without a curve uses the nearest curve,
    at most 0.4 stops away; a lens without any curve has V = 1 and no uncertainty. Raises InputError
    for other apertures and for an impossible curve.
    """
    if not lens.vignetting:
        return (1.0,), 0.0
    remedy = "calibrate this aperture: fieldlum calibrate vignette"
    nearest = min(lens.vignetting, key=lambda v: abs(np.log(v.f_number / f_number)))
    # a curve is valid for its own aperture: a third of a stop, with rounding
    if abs(2 * np.log2(nearest.f_number / f_number)) > 0.4:
        measured = ", ".join(f"f/{v.f_number:g}" for v in lens.vignetting)
        finding = f"no vignetting curve for f/{f_number:g}"
        raise InputError(lens.name, finding, f"one of {measured}", remedy)
    if wrong := check_vignetting(nearest.coefficients):
        finding = f"the curve of f/{nearest.f_number:g}: {wrong}"
        raise InputError(lens.name, finding, "1 on the axis, 0 to 1 at the edge", remedy)
    return nearest.coefficients, nearest.u_rel


def response_tables(profile: CameraProfile) -> Floats:
    """Return the linear light z (1 at full scale) of the 256 codes of R, G, B, [256, 3].

    Raises InputError for an invalid response in the profile.
    """
    r, remedy = profile.response, "calibrate it again: fieldlum calibrate response"
    with input_errors(profile.camera.name, "a valid [response]", remedy, ValueError):
        tables = [response_table(r.kind, curve) for curve in (r.red, r.green, r.blue)]
    return np.stack(tables, axis=1)


def sensor_pitch_deg(profile: CameraProfile) -> float:
    """Return the angle across a sensor pixel, averaged over the field of the finest lens [deg]."""
    return min(lens.full_angle_deg / (2.0 * lens.radius_px) for lens in profile.lens)


def lens_geometry(
    lens: Lens, turn_deg: float = 0.0, corner_px: tuple[float, float] = (0.0, 0.0)
) -> LensGeometry:
    """Return the lens's geometry in pixels of a crop of the sensor, with the camera turned.

    turn_deg: the camera's heading minus the panorama's, clockwise, added to the lens's azimuth;
    corner_px: x, y of the crop's top left corner on the sensor.
    """
    x, y = lens.centre_px
    return replace(
        lens,
        centre_px=(x - corner_px[0], y - corner_px[1]),
        azimuth_deg=float(signed_angle_deg(lens.azimuth_deg + turn_deg)),
    )
