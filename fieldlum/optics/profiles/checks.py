"""Checks of a camera profile: values that no camera can have."""

from __future__ import annotations

from itertools import pairwise

from fieldlum.core.errors import InputError
from fieldlum.optics.photometry import rises
from fieldlum.optics.profiles.tables import CameraProfile, Lens, StrayLight
from fieldlum.optics.projection import angle_of_radius


def _impossible(where: str, found: str, expected: str) -> InputError:
    return InputError(where, found, expected, "correct this value in the profile")


def check_camera(profile: CameraProfile, where: str) -> None:
    """Raise InputError for values that no camera can have; where: the profile, for the error."""
    p = profile
    if not p.lens:
        raise InputError(where, "no [[lens]]", "at least one lens", "add a table [[lens]]")
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
                raise _impossible(where, f"{key} = {value:g}", "a number above 0")
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
        raise _impossible(
            where,
            f"u_rel or glare_floor_rel = {next(v for v in relative if not 0 <= v < 1):g}",
            "u_rel and glare_floor_rel from 0 to below 1",
        )
    _check_stray(p.stray, where)
    if min(p.sensor.read_noise_e, p.bracket.seconds_per_frame, p.bracket.megabytes_per_frame) < 0:
        raise _impossible(
            where, "read_noise_e, seconds_per_frame or megabytes_per_frame below 0", "0 or more"
        )
    if (
        max(x.full_angle_deg for x in p.lens) > 300
        or max(p.camera.width_px, p.camera.height_px) > 100_000
    ):
        raise _impossible(
            where,
            "a lens with over 300 degrees, or a sensor with over 100 000 pixels a side",
            "a possible camera",
        )
    for lens in p.lens:
        _check_mapping(lens, where)
    if len(p.sensor.black_dn) != 4 or len(p.sensor.saturation_dn) != 4:
        counts = f"{len(p.sensor.black_dn)} values of black_dn, {len(p.sensor.saturation_dn)}"
        raise _impossible(
            where, f"[sensor] has {counts} of saturation_dn", "four values of each: R, G1, G2, B"
        )
    if not max(p.sensor.black_dn) < min(*p.sensor.saturation_dn, p.sensor.white_dn):
        raise _impossible(
            where,
            f"[sensor] black_dn = {max(p.sensor.black_dn):g} is not below saturation_dn and "
            "white_dn",
            "a black level below saturation_dn and white_dn",
        )
    if not rises(p.sensor.linearity):
        raise InputError(
            where,
            f"sensor.linearity = {', '.join(f'{a:g}' for a in p.sensor.linearity)}",
            "corrected counts that rise with the raw counts",
            "calibrate it again: fieldlum calibrate linearity",
        )
    if abs(p.sensor.exposure_offset_s) >= 0.01:
        raise InputError(
            where,
            f"sensor.exposure_offset_s = {p.sensor.exposure_offset_s:g}",
            "an offset in seconds, smaller than 0.01",
            "write it in seconds, or calibrate it again: fieldlum calibrate linearity",
        )
    if len(p.colour.rgb_to_radiance) not in (0, 9):
        raise _impossible(
            where,
            f"colour.rgb_to_radiance has {len(p.colour.rgb_to_radiance)} values",
            "9 values, or none",
        )
    if not 0 <= p.response.low_code < p.response.high_code <= 255:
        raise _impossible(
            where,
            f"response.low_code {p.response.low_code}, high_code {p.response.high_code}",
            "0 <= low < high <= 255",
        )


def _check_stray(kernel: StrayLight, where: str) -> None:
    angles, values = kernel.angle_deg, kernel.per_sr
    rising = all(a < b for a, b in pairwise(angles))
    if len(angles) != len(values) or not rising or not all(0 < a <= 180 for a in angles):
        raise _impossible(
            where,
            f"[stray] angle_deg = {list(angles)} with {len(values)} values of per_sr",
            "rising angles from 0 to 180, and a value for each",
        )
    falling = all(a >= b for a, b in pairwise(values))
    if not falling or min(values, default=0.0) < 0:
        raise _impossible(
            where, f"[stray] per_sr = {list(values)}", "values of 0 or more that do not rise"
        )


def _check_mapping(lens: Lens, where: str) -> None:
    """Raise InputError unless the radius increases with the angle up to the edge, where it is 1."""
    if lens.mapping != "polynomial":
        return
    finding = (
        f"lens '{lens.name}': polynomial of "
        f"{', '.join(f'{c:g}' for c in lens.coefficients) or 'no coefficients'}"
    )
    remedy = "fit it again: fieldlum calibrate lens"
    try:
        angle_of_radius(lens.geometry, 1.0)
    except ValueError as error:
        raise InputError(
            where, f"{finding} ({error})", "a polynomial that rises up to the edge", remedy
        ) from None
    if abs(sum(lens.coefficients) - 1.0) > 0.02:
        raise InputError(
            where,
            f"{finding}, with the sum {sum(lens.coefficients):g}",
            "coefficients that sum to 1",
            remedy,
        )
