"""Choose the sun's illuminance at the lens: by the picture, a meter, the room or DNI."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.records import CLIPPED_SUN, Panorama, SunSource
from fieldlum.optics.photometry import vertical_illuminance_lx
from fieldlum.optics.projection import direction
from fieldlum.session.panorama_sun import MEASURED_ORIGINS

METER, DNI = "meter", "dni"
# A picture whose sun exceeds both limits reveals a wrong clock, unit or column. Not measured.
MOST_OVER_DNI, FAINT_SUN_LX = 1.5, 10_000.0
_LEAST_COSINE = 0.2  # a meter under a more oblique sun is too inaccurate (78 degrees); not measured


@dataclass(frozen=True, slots=True)
class Seen:
    """The visible share of the sun's disc from the lens and the glazing's transmittance.

    Both follow from the room's geometry; without a room they are 1 and not `known`.
    """

    visible_fraction: float = 1.0
    transmittance: float = 1.0
    known: bool = False


def complete_sun(
    panorama: Panorama, full_normal_lx: float, view: Seen, meter_lx: float | None
) -> tuple[SunSource | None, str]:
    """Return the picture's sun with its illuminance at the lens (None: no sun), and a caution.

    full_normal_lx: DNI times the direct luminous efficacy of Perez et al. (1990), before the glass
    [lx]. A sun that the picture measured is not changed. Any other sun of the picture is completed
    by the meter, else by DNI and the room; it is returned unchanged, with a caution, if the room
    hides it or if DNI gives less than the clipped picture shows. A sun that the picture does not
    show is not added.
    """
    stated = panorama.sun
    if stated is None:
        hidden = view.known and view.visible_fraction > 0.5 and full_normal_lx > 20_000.0
        return (
            None,
            "the sun is in view by the room's geometry, but not in the picture" if hidden else "",
        )
    if stated.origin in MEASURED_ORIGINS:
        brighter = stated.normal_illuminance_lx > MOST_OVER_DNI * full_normal_lx + FAINT_SUN_LX
        return stated, "the picture's sun is brighter than DNI allows" if brighter else ""
    bound_lx = stated.normal_illuminance_lx if stated.origin == CLIPPED_SUN else 0.0
    if view.known and view.visible_fraction == 0.0:
        return stated, "the sun is in the picture, but hidden by the room's geometry"
    expected_lx = full_normal_lx * view.visible_fraction * view.transmittance
    by_meter = _by_meter(panorama, stated, meter_lx)
    if by_meter is not None and bound_lx <= by_meter <= 1.5 * full_normal_lx:
        normal_lx, origin = by_meter, METER
    elif expected_lx >= bound_lx:
        normal_lx, origin = expected_lx, DNI
    else:
        return stated, "DNI gives a weaker sun than the clipped picture shows"
    caution = (
        ""
        if view.known or origin == METER
        else "the sun was computed from DNI without the glazing, because the site has no [room]"
    )
    source = replace(
        stated,
        normal_illuminance_lx=normal_lx,
        visible_fraction=view.visible_fraction,
        origin=origin,
    )
    return source, caution


def _by_meter(panorama: Panorama, sun: SunSource, meter_lx: float | None) -> float | None:
    """Return the sun's normal illuminance by the meter [lx].

    It is the measured minus the picture's vertical illuminance, divided by the cosine of incidence.
    """
    if meter_lx is None:
        return None
    ahead = direction(0.0, panorama.heading_deg)
    cosine = float(np.dot(direction(sun.altitude_deg, sun.azimuth_deg), ahead))
    if cosine < _LEAST_COSINE:
        return None
    image_lx = vertical_illuminance_lx(
        panorama.luminance_cdm2, panorama.heading_deg, panorama.heading_deg
    )
    return (meter_lx - image_lx) / cosine
