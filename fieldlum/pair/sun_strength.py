"""Choose the sun's illuminance at the lens: by the picture, a meter, or DNI and the sky view."""

import math
from dataclasses import replace

import numpy as np

from fieldlum.core.records import CLIPPED_SUN, Panorama, SunSource
from fieldlum.optics.illuminance import illuminance_ahead_lx
from fieldlum.optics.projection import direction
from fieldlum.session.panorama_sun import MEASURED_ORIGINS

METER, DNI, SKY_VIEW = "meter", "dni", "sky-view"
# A picture whose sun exceeds both limits reveals a wrong clock, unit or column. Not measured.
MAX_OVER_DNI, FAINT_SUN_LX = 1.5, 10_000.0
_MIN_COSINE = 0.2  # a meter under a more oblique sun is too inaccurate (78 degrees); not measured


def measured_sun(
    panorama: Panorama, full_normal_lx: float, meter_lx: float | None
) -> tuple[SunSource | None, str]:
    """Return the picture's sun, with the meter's illuminance if it is clipped, and a caution or "".

    full_normal_lx: DNI times the direct luminous efficacy of Perez et al. (1990), before the glass
    [lx]. meter_lx: vertical illuminance by the meter at the lens, None without one. The sun by the
    meter counts if it is between the clipped disc's lower bound and 1.5 times full_normal_lx
    (chosen). The sun is None if the picture shows none: it is not added from DNI. The caution is
    about a picture's measured sun that is brighter than DNI allows.
    """
    stated = panorama.sun
    if stated is None:
        return None, ""
    if stated.origin in MEASURED_ORIGINS:
        brighter = stated.normal_illuminance_lx > MAX_OVER_DNI * full_normal_lx + FAINT_SUN_LX
        return stated, "the picture's sun is brighter than DNI allows" if brighter else ""
    by_meter = _by_meter(panorama, stated, meter_lx)
    if by_meter is None or not min_normal_lx(stated) <= by_meter <= 1.5 * full_normal_lx:
        return stated, ""
    return replace(stated, normal_illuminance_lx=by_meter, origin=METER), ""


def is_measured(sun: SunSource) -> bool:
    """Return whether the picture or a meter measured the sun's illuminance."""
    return sun.origin in (*MEASURED_ORIGINS, METER)


def completed_sun(
    sun: SunSource, full_normal_lx: float, share: float, origin: str
) -> tuple[SunSource, str]:
    """Return a sun that was not measured, with its illuminance by DNI, and a caution or "".

    full_normal_lx: DNI times its luminous efficacy, before the glass. share: of the beam that
    arrives at the lens, 0 to 1; NaN if unknown. origin: source of the share, for
    `SunSource.origin`. If DNI gives less than the clipped picture shows, the sun is returned
    unchanged.
    """
    unknown = math.isnan(share)
    expected_lx = full_normal_lx * (1.0 if unknown else share)
    if expected_lx < min_normal_lx(sun):
        return sun, "DNI gives a weaker sun than the clipped picture shows"
    caution = "the sun was computed from DNI without the glazing: the sky view does not decide it"
    completed = replace(sun, normal_illuminance_lx=expected_lx, origin=origin)
    return completed, caution if unknown else ""


def min_normal_lx(sun: SunSource) -> float:
    """Return the lower bound [lx] of the sun's normal illuminance that a clipped disc gives.

    It is 0 for other discs: they are measured, or not in the picture.
    """
    return sun.normal_illuminance_lx if sun.origin == CLIPPED_SUN else 0.0


def _by_meter(panorama: Panorama, sun: SunSource, meter_lx: float | None) -> float | None:
    """Return the sun's normal illuminance by the meter [lx], None if it cannot be computed.

    It is the meter's minus the picture's vertical illuminance, divided by the cosine of incidence.
    meter_lx: vertical illuminance by the meter at the lens, None without one. The angle of
    incidence must be under 78 degrees, and what the plane faces must be in full view.
    """
    if meter_lx is None:
        return None
    heading_deg = panorama.heading_deg
    towards, ahead = direction(sun.altitude_deg, sun.azimuth_deg), direction(0.0, heading_deg)
    cosine = float(np.dot(towards, ahead))
    if cosine < _MIN_COSINE:
        return None
    image_lx = illuminance_ahead_lx(panorama)
    return None if image_lx is None else (meter_lx - image_lx) / cosine
