"""Define the parts of a `glare` answer that panoramas and single pictures share."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama, SunSource, counted, utc_text
from fieldlum.optics.photometry.melanopic import melanopic_ratio
from fieldlum.optics.projection import NOT_SEEN
from fieldlum.year.glare.pictures import Picture
from fieldlum.year.glare.standards import disturbed_share

# Upper limits of DGP of the four grades (Wienold 2009; Mardaljevic et al. 2012).
VERDICTS = (
    (0.35, "imperceptible"),
    (0.40, "perceptible"),
    (0.45, "disturbing"),
    (np.inf, "intolerable"),
)


# More than sun and sky give: the sun's illuminance outside the atmosphere is 133 100 lx (IES
# Lighting Handbook). Chosen above it, for sunlit snow. A picture in cd/m2 instead of Radiance's
# W/sr/m2 is 179 times too bright.
MOST_EV_LX = 200_000.0
# DGP was derived from rooms with at least this vertical illuminance (Wienold 2009); evalglare warns
# at the same limit.
LEAST_EV_LX = 380.0
_SCALE = "scale the picture with --calibrate-ev LX, the vertical illuminance measured at the lens"


class ViewAnswer(TypedDict):
    """The figures of one view direction in `glare --json`, with names as in `glare_directions`.

    azimuth_deg, altitude_deg : the view direction, clockwise from true north and above the horizon;
    altitude_deg for single pictures only. task_cdm2, window_to_task, uniformity : see
    `contrast.ViewRegions.ratios`. melanopic_edi_lx : measured by the camera's colour, or Ev times
    1.0 if `melanopic_der` calls it an estimate; u_melanopic_edi_lx : its standard uncertainty, None
    for an estimate and for a picture without uncertainty. verdict : the grade of DGP; "A to B" if
    dgp_low and dgp_high have different grades; "not seen" as in seen. seen : "seen", "partly seen"
    or "not seen"; seen_share : share (0 to 1) of the vertical illuminance of a uniform field that
    comes from seen pixels. dgp_low, dgp_high : bounds of DGP, for a partly seen direction only.
    source_count : number of glare sources of a
    single picture; sources : its strongest ones, at most 20. reference : evalglare's figures, if
    requested; a panorama has them for fully seen directions only.

    Figures are None for a direction of a panorama that is not seen. ugr, dgi, ugp, cgi are also
    None without a glare source, and so are the figures of a region that the picture does not cover.
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
    u_melanopic_edi_lx: float | None
    verdict: str
    seen: str
    seen_share: float
    dgp_low: NotRequired[float]
    dgp_high: NotRequired[float]
    source_count: NotRequired[int]
    sources: NotRequired[list[dict[str, float]]]
    reference: NotRequired[dict[str, float | str]]


class GlareAnswer(TypedDict):
    """The object that `glare --json` prints for one picture.

    file : path of the picture. t_utc : time of the picture; None if unknown. heading_deg : azimuth
    of a panorama's centre column, or of a fisheye's view, clockwise from true north. sun : the sun
    as a source next to the pixels (fields of `SunSource`); None without a sun. melanopic_der :
    where melanopic EDI comes from: "D65, assumed" for an estimate, else "colour". views : one entry
    for each view direction. disturbed_share : share (0 to 1) of the views with a grade whose DGP is
    above 0.40; None if no view has a grade. covered_share : share of the front hemisphere that the
    picture covers; 1 for a panorama. rammg_cdm2, rammg_lightness : of a panorama only, see
    `contrast`. calibration_factor : factor that scaled the luminance to a measured illuminance;
    absent without one.
    """

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
    """Return the grade of a DGP, which must not be NaN.

    Below 0.35 imperceptible, below 0.40 perceptible, below 0.45 disturbing, otherwise intolerable.
    """
    return next(name for limit, name in VERDICTS if dgp < limit)


def bounds_verdict(low: float, high: float) -> str:
    """Return one grade, or two if the unseen part decides between them."""
    least, most = verdict(low), verdict(high)
    return least if least == most else f"{least} to {most}"


def answer_of(
    path: Path,
    picture: Picture,
    views: list[ViewAnswer],
    warnings: list[str],
    sun: SunSource | None,
    covered_share: float,
    factor: float,
) -> GlareAnswer:
    """Return the object that `glare --json` prints for a picture, from the figures of its views.

    path : becomes `file`. warnings : texts that come before those of `picture_warnings`. sun : the
    sun as a source next to the pixels, or None. covered_share : share (0 to 1) of the front
    hemisphere that the picture covers. factor : by which the picture was scaled; 1 if it was not.
    """
    panorama = picture.panorama
    graded = [
        np.nan if view["dgp"] is None or view["seen"] == NOT_SEEN else view["dgp"] for view in views
    ]
    return {
        "file": str(path),
        "t_utc": utc_text(panorama.t_utc) if panorama.t_utc else None,
        "heading_deg": panorama.heading_deg,
        "sun": None if sun is None else asdict(sun),
        "melanopic_der": "D65, assumed" if melanopic_ratio(panorama) is None else "colour",
        "views": views,
        "disturbed_share": plain(float(disturbed_share(np.array([graded]))[0])),
        "warnings": warnings
        + picture_warnings(picture)
        + _level_warnings(views, is_scaled=factor != 1.0),
        "covered_share": covered_share,
    }


def _level_warnings(views: list[ViewAnswer], *, is_scaled: bool) -> list[str]:
    """Return a warning if a view has more light than sun and sky give, or if all views are dark."""
    most = max((view["ev_lx"] or 0.0 for view in views), default=0.0)
    if most > MOST_EV_LX:
        return [
            f"Ev of {most:.0f} lx is more than sun and sky give ({MOST_EV_LX:.0f} lx): the "
            "luminance is not calibrated, or the pixels are in cd/m2 instead of Radiance's "
            f"W/sr/m2; {_SCALE}"
        ]
    if 0.0 < most < LEAST_EV_LX:
        known = "" if is_scaled else f"; if the picture is not calibrated, {_SCALE}"
        return [
            f"Ev is at most {most:.3g} lx: below {LEAST_EV_LX:.0f} lx a DGP may be too low{known}"
        ]
    return []


def scaled_sun(sun: SunSource | None, factor: float) -> SunSource | None:
    """Return a copy of `sun` with its illuminance multiplied by `factor`; None if `sun` is None."""
    if sun is None:
        return None
    return replace(sun, normal_illuminance_lx=sun.normal_illuminance_lx * factor)


def seen_pixels(panorama: Panorama) -> np.ndarray | None:
    """Return a mask [H, W], True for pixels that a lens saw; None if all were seen.

    It is also None for a panorama without flags.
    """
    if panorama.flags is None:
        return None
    outside = (panorama.flags & Flag.OUTSIDE_LENS) > 0
    return ~outside if outside.any() else None


def valid_pixels(panorama: Panorama, path: Path) -> tuple[np.ndarray, list[str]]:
    """Return a copy of the luminance [H, W] with unseen and negative pixels set to 0, and warnings.

    Negative pixels are noise: a warning gives their number; without any the list is empty. Raises
    InputError, which names `path`, if a seen pixel is not finite.
    """
    pixels = np.array(panorama.luminance_cdm2, np.float32)
    seen_mask = seen_pixels(panorama)
    if seen_mask is not None:
        pixels[~seen_mask] = 0.0
    bad = int((~np.isfinite(pixels)).sum())
    if bad:
        raise InputError(
            path,
            f"{counted(bad, 'pixel')} with an infinite or missing (NaN) luminance",
            "a finite luminance in cd/m2 in every pixel",
            "merge or render the picture again",
        )
    dark = int((pixels < 0).sum())
    np.maximum(pixels, 0.0, out=pixels)
    warning = f"luminance below 0 cd/m2 counts as 0: {counted(dark, 'pixel')}"
    return pixels, [warning] if dark else []


def picture_warnings(picture: Picture) -> list[str]:
    """Return texts that warn a user about a picture, first those of its reader (`picture.notes`).

    The others are about a missing view direction, a picture without light, and clipped pixels.
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
            f"clipped in every frame: {counted(clipped, 'pixel')}; the true luminance there, and "
            "DGP, may be higher; capture shorter exposures as well"
        )
    return warnings


def plain(value: float) -> float | None:
    """Return `value` as a float, or None if it is NaN or infinite."""
    return float(value) if np.isfinite(value) else None
