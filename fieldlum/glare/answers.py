"""Define the parts of a `glare` answer that panoramas and single pictures share."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np

from fieldlum.errors import InputError
from fieldlum.glare.pictures import Picture
from fieldlum.glare.standards import disturbed_share
from fieldlum.records import Flag, Panorama, SunSource, utc_text

# Upper limits of DGP of the four grades (Wienold 2009; Mardaljevic et al. 2012).
VERDICTS = (
    (0.35, "imperceptible"),
    (0.40, "perceptible"),
    (0.45, "disturbing"),
    (np.inf, "intolerable"),
)


class ViewAnswer(TypedDict):
    """The figures of one view direction in `glare --json`; None where there is no figure.

    That is the case for an unseen direction, and for an index of sources without a source. dgp_low,
    dgp_high: bounds for a partly seen direction. sources: the strongest glare sources of a single
    picture. reference: the result of evalglare.
    """

    azimuth_deg: float
    altitude_deg: NotRequired[float]
    ev_lx: float | None
    dgp: float | None
    dgps: float | None
    ugr: float | None
    dgi: float | None
    ugp: float | None
    cgi: float | None
    veiling_cdm2: float | None
    veiling_age70_cdm2: float | None
    task_cdm2: float | None
    window_to_task: float | None
    uniformity: float | None
    melanopic_edi_lx: float | None
    verdict: str
    seen: str
    seen_share: float
    dgp_low: NotRequired[float]
    dgp_high: NotRequired[float]
    source_count: NotRequired[int]
    sources: NotRequired[list[dict[str, float]]]
    reference: NotRequired[dict[str, float | str]]


class GlareAnswer(TypedDict):
    """The object that `glare --json` prints for one picture."""

    file: str
    t_utc: str | None
    heading_deg: float
    sun: dict[str, float | str] | None
    melanopic_der: str
    views: list[ViewAnswer]
    disturbed_share: float | None
    warnings: list[str]
    covered_share: float
    rammg_cdm2: NotRequired[float]
    rammg_lightness: NotRequired[float]
    calibration_factor: NotRequired[float]


def verdict(dgp: float) -> str:
    """Return the grade of a DGP: imperceptible, perceptible, disturbing or intolerable."""
    return next(name for limit, name in VERDICTS if dgp < limit)


def answer_of(
    path: Path,
    picture: Picture,
    views: list[ViewAnswer],
    warnings: list[str],
    sun: SunSource | None,
    covered_share: float,
) -> GlareAnswer:
    """Return the object that `glare --json` prints for a picture, from the figures of its views."""
    panorama = picture.panorama
    known = [np.nan if view["dgp"] is None else view["dgp"] for view in views]
    return {
        "file": str(path),
        "t_utc": utc_text(panorama.t_utc) if panorama.t_utc else None,
        "heading_deg": panorama.heading_deg,
        "sun": None if sun is None else asdict(sun),
        "melanopic_der": "D65, assumed",
        "views": views,
        "disturbed_share": plain(float(disturbed_share(np.array([known]))[0])),
        "warnings": warnings + picture_warnings(picture),
        "covered_share": covered_share,
    }


def scaled_sun(sun: SunSource | None, factor: float) -> SunSource | None:
    """Return the sun with `factor` times its illuminance; None without a sun."""
    if sun is None:
        return None
    return replace(sun, normal_illuminance_lx=sun.normal_illuminance_lx * factor)


def seen_pixels(panorama: Panorama) -> np.ndarray | None:
    """Return a mask [H, W] of the pixels that a lens saw; None if all were seen."""
    if panorama.flags is None:
        return None
    outside = (panorama.flags & Flag.OUTSIDE_LENS) > 0
    return ~outside if outside.any() else None


def valid_pixels(panorama: Panorama, path: Path) -> tuple[np.ndarray, list[str]]:
    """Return the luminance [H, W] with unseen and negative pixels set to 0, and warnings.

    Negative pixels are noise. Raises InputError for seen pixels that are not finite.
    """
    pixels = np.array(panorama.luminance_cdm2, np.float32)
    seen = seen_pixels(panorama)
    if seen is not None:
        pixels[~seen] = 0.0
    bad = int((~np.isfinite(pixels)).sum())
    if bad:
        raise InputError(
            path,
            f"{bad} pixels are not finite",
            "a finite luminance in cd/m2 in every pixel",
            "merge or render the picture again",
        )
    dark = int((pixels < 0).sum())
    np.maximum(pixels, 0.0, out=pixels)
    return pixels, [f"{dark} pixels below 0 cd/m2 count as 0"] if dark else []


def picture_warnings(picture: Picture) -> list[str]:
    """Return the reader's warnings on a picture, and others about its pixels and its view.

    These are about a missing view direction, a picture without light, and clipped pixels.
    """
    warnings = list(picture.notes)
    if not picture.directed:
        warnings.append(
            "the picture's VIEW has no direction (-vd): the glare figures are right, but the "
            f"azimuth of {picture.panorama.heading_deg:.0f} deg is an assumption; state the view "
            "with --view"
        )
    if not (picture.panorama.luminance_cdm2 > 0).any():
        warnings.append(
            "the picture has no light: no pixel is above 0 cd/m2, so the glare figures have "
            "no meaning; check how the picture was written"
        )
    flags = picture.panorama.flags
    clipped = 0 if flags is None else int((flags & Flag.CLIPPED_HIGH > 0).sum())
    if clipped:
        warnings.append(
            f"{clipped} pixels are clipped in every frame: their luminance, and DGP, are "
            "lower bounds; capture shorter exposures as well"
        )
    return warnings


def plain(value: float) -> float | None:
    """Return the number, or None if it is not finite."""
    return float(value) if np.isfinite(value) else None
