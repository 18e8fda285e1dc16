"""Compute the glare of one picture, as plain values for a terminal, a pipe or Python."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable, Panorama, SunSource, counted, utc_text
from fieldlum.optics import projection
from fieldlum.optics.images import clipped_text, require_panorama
from fieldlum.optics.melanopic import melanopic_edi, melanopic_ratio
from fieldlum.sky.sun_disc import find_disc, without_disc
from fieldlum.year.glare import metrics, pictures
from fieldlum.year.glare.pictures import Picture
from fieldlum.year.glare.sources import (
    Sources,
    Views,
    glare_sources,
    panorama_views,
    view_azimuths_deg,
)
from fieldlum.year.glare.standards import disturbed_share

# Upper limits of DGP of the grades below the highest (Wienold 2009; Mardaljevic et al. 2012).
VERDICTS = ((0.35, "imperceptible"), (0.40, "perceptible"), (0.45, "disturbing"))
# More than sun and sky give: the sun's illuminance outside the atmosphere is 133 100 lx (IES
# Lighting Handbook). Chosen above it, for sunlit snow. A picture in cd/m2 instead of Radiance's
# W/sr/m2 is 179 times too bright.
MAX_EV_LX = 200_000.0
# DGP was derived from rooms with at least this vertical illuminance (Wienold 2009); evalglare warns
# at the same limit.
MIN_DGP_EV_LX = 380.0
_SCALE = "scale the picture by Ev measured at the lens (fieldlum glare --calibrate-ev LX)"


def picture_glare(
    path: Path,
    azimuths_deg: Sequence[float] = (),
    *,
    reference: bool = False,
    view_options: str = "",
    part: str = "",
    measured_ev_lx: float | None = None,
    lamps: bool | None = None,
) -> JsonTable:
    """Return the object that `glare --json` prints for a .hdr or .exr picture.

    azimuths_deg : view directions, clockwise from north; if empty, ten around a panorama, or a
    fisheye's own. reference : add evalglare's figures. view_options : Radiance's options that
    replace the view in the file; "" to use the file's. part : name of the part, layer or stereo
    view of an .exr; "" for the only one. measured_ev_lx : scale the picture so that its first view
    has this vertical illuminance; None for no scaling. lamps : electric light is on, or off; None
    if unknown. Keys: those of `glare_answer`; with measured_ev_lx also calibration_factor, by which
    the luminance was multiplied. Raises InputError for an unusable picture, for azimuths other than
    the own one of a picture that is no panorama, or if a picture to scale has no light in its first
    view, or not all of it; with `reference` FieldlumError if evalglare prints no figures.
    """
    picture = pictures.read_picture(path, view_options, part)
    picture = picture if lamps is None else picture._replace(lamps=lamps)
    judge = partial(glare_answer, picture, path, azimuths_deg)
    if measured_ev_lx is None:
        return judge(reference=reference)[0]
    first = judge()[0]["views"][0]
    if first["seen_share"] < projection.FULLY_SEEN_SHARE:
        found = f"{100 * (1 - first['seen_share']):.0f} % of the first view is not in the picture"
        remedy = "measure Ev in a direction that is, or omit --calibrate-ev"
        raise InputError(path, found, "a view in full to scale by its Ev", remedy)
    ev = first["ev_lx"]
    if not ev or ev <= 0.0:
        found, expected = "no light was seen in the first view direction", "light to scale"
        raise InputError(path, found, expected, "check the direction, or omit --calibrate-ev")
    factor = measured_ev_lx / ev
    return judge(reference=reference, factor=factor)[0] | {"calibration_factor": factor}


def panorama_glare(panorama: Panorama, azimuths_deg: Sequence[float] = ()) -> JsonTable:
    """Return the same as `picture_glare`, for a panorama in memory; the answer's `file` is "".

    The keys are those of `glare_answer`; there are no figures of evalglare, and it is unknown
    whether lamps are on. azimuths_deg : view directions, clockwise from north; ten if empty. Raises
    InputError for a map that is not twice as wide as high, or has seen pixels that are not finite.
    """
    require_panorama(panorama, "panorama")
    # None: a panorama has no view of its own
    answer, _ = glare_answer(Picture(panorama, None), Path("panorama"), azimuths_deg)
    return answer | {"file": ""}


def glare_answer(
    picture: Picture,
    path: Path,
    azimuths_deg: Sequence[float] = (),
    *,
    reference: bool = False,
    factor: float = 1.0,
) -> tuple[JsonTable, Sources]:
    """Return the `glare` answer of a picture with its luminance times `factor`, and its sources.

    path : names the picture in the answer and in errors. azimuths_deg : view directions, clockwise
    from north; if empty, ten around a panorama, or a fisheye's own. reference : add evalglare's
    figures. Raises InputError for seen pixels that are not finite, and for azimuths other than the
    own one of a picture that is no panorama; FieldlumError if evalglare prints no figures. Keys of
    the answer:

    file; t_utc : time of the picture; None if unknown. heading_deg : azimuth of a panorama's centre
    column, or of a fisheye's view. sun : the sun as a source next to the pixels (fields of
    `SunSource`); None without a sun. melanopic_der : "D65, assumed" for an estimate, else "colour".
    disturbed_share : share (0 to 1) of the views with a grade whose DGP is above 0.40; None if no
    view has a grade. warnings : texts. covered_share : share of the front hemisphere that the
    picture covers; 1 for a panorama. rammg_cdm2 : of a panorama, see `metrics.rammg`.

    views, a table for each direction : azimuth_deg, altitude_deg (of a single picture) : its
    direction. The names of `METRICS` and of `region_ratios`. melanopic_edi_lx : measured by the
    camera's colour, or estimated; u_melanopic_edi_lx : its standard uncertainty, or None. verdict :
    the grade of DGP; "A to B" if dgp_low and dgp_high have different ones; "not seen". seen :
    "seen", "partly seen" or "not seen", by seen_share (see `ViewCoverage`). dgp_low, dgp_high :
    bounds of DGP of a partly seen direction. source_count : number of glare sources of a single
    picture; sources : tables of its strongest 20, by the fields of `Sources`, but with right_deg
    and up_deg. reference : fields of `ReferenceGlare`, if requested, of fully seen directions of a
    panorama, or of a single picture. Undefined figures are None.
    """
    panorama, heading_deg = picture.panorama, picture.panorama.heading_deg
    views, share = _views_and_share(picture, path, azimuths_deg)
    pixels, warnings = valid_pixels(panorama, path)
    pixels *= np.float32(factor)
    sun = panorama.sun
    if sun is not None:
        sun = replace(sun, normal_illuminance_lx=sun.normal_illuminance_lx * factor)
    if views.is_panorama:
        pixels, sun = take_out_sun(pixels, heading_deg, sun)
    sources = glare_sources(pixels, views)
    rows = _view_rows(pixels, picture, views, sources, sun)
    if reference:
        _add_reference(rows, pixels, picture, views, sun)
    graded = [np.nan if row["seen"] == projection.NOT_SEEN else row["dgp"] for row in rows]
    answer: JsonTable = {
        "file": str(path),
        "t_utc": utc_text(panorama.t_utc) if panorama.t_utc else None,
        "heading_deg": heading_deg,
        "sun": None if sun is None else asdict(sun),
        "melanopic_der": "D65, assumed" if melanopic_ratio(panorama) is None else "colour",
        "views": rows,
        "disturbed_share": plain(float(disturbed_share(np.array([graded], float))[0])),
        "warnings": [*_picture_texts(picture), *warnings, *_figure_texts(rows, share, factor)],
        "covered_share": share,
    }
    if views.is_panorama:
        answer["rammg_cdm2"] = metrics.rammg(pixels)
    return answer, sources


def _views_and_share(
    picture: Picture, path: Path, azimuths_deg: Sequence[float]
) -> tuple[Views, float]:
    """Return the weights of a picture's pixels, and the share of the hemisphere that it covers.

    azimuths_deg : view directions around a panorama, ten if empty; the share is then 1. Raises
    InputError, which names `path`, for azimuths other than the own one of another picture.
    """
    panorama, view = picture.panorama, picture.view
    height, width = panorama.luminance_cdm2.shape
    if view is None:
        azimuths = azimuths_deg or view_azimuths_deg(panorama.heading_deg)
        place = (panorama.heading_deg, np.asarray(azimuths, float) % 360.0)
        return panorama_views(height, width, *place, panorama.seen), 1.0
    off_deg = projection.signed_angle_deg(np.asarray(azimuths_deg) - view.azimuth_deg)
    if np.abs(off_deg).max(initial=0.0) > 1e-3:
        found = f"a picture of one view direction, {view.azimuth_deg:.1f} deg"
        raise InputError(path, found, "a panorama", "remove --view-azimuth")
    views = pictures.picture_views(view, height, width, panorama.seen)
    return views, min(1.0, float(views.moments[:, 0].sum(dtype=float)) / (2.0 * np.pi))


def _view_rows(
    pixels: Floats, picture: Picture, views: Views, sources: Sources, sun: SunSource | None
) -> list[JsonTable]:
    """Return the tables `views` of the answer (see `glare_answer`), one for each view direction.

    pixels : luminance [H, W] cd/m2 without the sun; views, sources : weights and glare sources of
    the picture; sun : its sun, None without one.
    """
    rays = None if sun is None else projection.direction(sun.altitude_deg, sun.azimuth_deg)[None]
    disc = None if sun is None else np.array([sun.normal_illuminance_lx])
    coverage = metrics.view_coverage(views)
    parts = metrics.glare_directions(pixels[None], views, rays, disc, sources=[sources])
    brightest = metrics.brightest_cdm2(pixels[None], views)
    bounds = metrics.unseen_dgp_bounds(coverage, parts["ev_lx"], parts["contrast"], brightest)
    light = (pixels.ravel(), views.illuminance, sun, parts["sun_ev_lx"][0])
    edi, u_edi = melanopic_edi(picture.panorama, *light, lamps=picture.lamps)
    figures = {name: parts[name] for name in metrics.METRICS}
    figures |= metrics.region_ratios(pixels[None], metrics.region_weights(views))
    figures |= {"melanopic_edi_lx": edi[None], "u_melanopic_edi_lx": u_edi[None]}
    rows = []
    for i, azimuth in enumerate(views.azimuths_deg):
        row: JsonTable = {"azimuth_deg": float(azimuth)}
        row |= {name: plain(values[0, i]) for name, values in figures.items()}
        row |= {"verdict": _verdict(row["dgp"]), "seen": coverage.words[i]}
        row["seen_share"] = float(coverage.seen_share[i])
        if row["seen"] == projection.PARTLY_SEEN:
            low, high = (float(bound[0, i]) for bound in bounds)
            words = dict.fromkeys((_verdict(low), _verdict(high)))
            row |= {"dgp_low": low, "dgp_high": high, "verdict": " to ".join(words)}
        if row["seen"] == projection.NOT_SEEN:
            row["verdict"] = projection.NOT_SEEN
            row |= dict.fromkeys(figures) if views.is_panorama else {}
        if picture.view is not None:
            row["altitude_deg"] = picture.view.altitude_deg
            row |= {"source_count": len(sources.pixels), "sources": _source_rows(sources)}
        rows.append(row)
    return rows


def _verdict(dgp: float) -> str:
    """Return the grade of a DGP, such as "perceptible"; the DGP must not be NaN."""
    return next((name for limit, name in VERDICTS if dgp < limit), "intolerable")


def _source_rows(sources: Sources) -> list[dict[str, float]]:
    """Return the figures of the 20 strongest sources of a single view, the strongest first."""
    names = ("mean_cdm2", "solid_angle_sr", "right_deg", "up_deg", "ev_lx")
    mean, omega, right, up, ev_lx, _ = sources
    figures = np.stack([mean, omega, np.degrees(right), np.degrees(up), ev_lx])[..., 0]  # [5, s]
    # not all, because a noisy picture can have thousands
    order = np.argsort(sources.contrast[:, 0])[::-1][:20]
    return [dict(zip(names, figures[:, i].tolist(), strict=True)) for i in order]


def _add_reference(
    rows: list[JsonTable], pixels: Floats, picture: Picture, views: Views, sun: SunSource | None
) -> None:
    """Add evalglare's figures to the rows; of a panorama, to those of fully seen directions.

    rows: one for each of `views`, changed in place; pixels: luminance [H, W] cd/m2 without the
    sun's disc, which is drawn from `sun`.
    """
    heading_deg, view = picture.panorama.heading_deg, picture.view
    for row in rows:
        if view is not None:
            disc = 0.0 if sun is None else pictures.disc_pixels(views, pixels.shape, sun)
            row["reference"] = pictures.reference_glare(pixels + disc, view=view.text)._asdict()
        elif row["seen"] == projection.SEEN:
            shown = pictures.panorama_to_fisheye(pixels, heading_deg, row["azimuth_deg"], sun=sun)
            row["reference"] = pictures.reference_glare(shown)._asdict()


# ----------------------------------------------------------------------------------------------
# pixels


def valid_pixels(panorama: Panorama, path: Path) -> tuple[Floats32, list[str]]:
    """Return a copy of the luminance [H, W] with unseen and negative pixels set to 0, and warnings.

    Negative pixels are noise: a warning gives their number; without any the list is empty. Raises
    InputError, which names `path`, if a seen pixel is not finite.
    """
    pixels = np.where(panorama.seen, panorama.luminance_cdm2, np.float32(0.0)).astype(np.float32)
    if bad := int((~np.isfinite(pixels)).sum()):
        found = f"{counted(bad, 'pixel')} with an infinite or missing (NaN) luminance"
        expected = "a finite luminance in cd/m2 in every pixel"
        raise InputError(path, found, expected, "merge or render the picture again")
    dark = int((pixels < 0).sum())
    np.maximum(pixels, 0.0, out=pixels)
    warning = f"luminance below 0 cd/m2 counts as 0: {counted(dark, 'pixel')}"
    return pixels, [warning] if dark else []


def take_out_sun(
    luminance_cdm2: Floats, heading_deg: float, recorded: SunSource | None
) -> tuple[Floats, SunSource | None]:
    """Return the map without a sun disc in its pixels, and the sun as a source; None without a sun.

    luminance_cdm2 : [H, W = 2H], which is not changed in place; heading_deg : azimuth of its centre
    column, clockwise from north. recorded : the sun that the picture records separately: it is
    returned, with the same map. If it is None, a disc in the pixels (of a rendering) is searched by
    `find_disc` and removed; the sun that is returned has the origin "picture".
    """
    disc = None if recorded else find_disc(luminance_cdm2, heading_deg)
    if disc is None:
        return luminance_cdm2, recorded
    place = (disc.altitude_deg, disc.azimuth_deg)
    sun = SunSource(*place, normal_illuminance_lx=disc.normal_lx, origin="picture")
    return without_disc(luminance_cdm2, disc), sun


def plain(value: float) -> float | None:
    """Return `value`, of any unit, as a float for JSON, or None if it is NaN or infinite."""
    return float(value) if np.isfinite(value) else None


# ----------------------------------------------------------------------------------------------
# warnings


def _picture_texts(picture: Picture) -> Iterator[str]:
    """Yield the notes of the picture's reader, and warnings of unseen, dark and clipped pixels."""
    panorama, unseen = picture.panorama, ~picture.panorama.seen
    if picture.view is None and unseen.any():
        yield (
            f"no lens saw {100 * unseen.mean():.0f} % of the panorama: view directions that "
            "are mostly unseen have no result; partly seen ones have the lowest and highest DGP "
            "for an unseen part between black and the brightest 1 % of the seen part"
        )
    yield from picture.notes
    if not picture.directed:
        yield (
            "the picture's VIEW has no direction (-vd): glare is right, but the azimuth of "
            f"{panorama.heading_deg:.0f} deg is an assumption; state the view with --view"
        )
    if not (panorama.luminance_cdm2 > 0).any():
        yield "the picture has no light, so glare has no meaning; check how it was written"
    if clipped := panorama.clipped_count:
        yield clipped_text(clipped)


def _figure_texts(rows: Sequence[Mapping[str, Any]], share: float, factor: float) -> Iterator[str]:
    """Yield warnings of a small picture, more light than sun and sky give, and darkness.

    rows: figures of each view; share: part (0 to 1) of the hemisphere in front that the picture
    covers; factor: by which its luminance was multiplied (--calibrate-ev), 1 if it was not.
    """
    if share < projection.FULLY_SEEN_SHARE:
        yield (
            f"the picture covers {100 * share:.0f} % of the hemisphere in front: Ev is a lower "
            "bound, and DGP counts the part outside the picture as black; a partly seen view has "
            "bounds of DGP too; use a 180-degree fisheye"
        )
    highest = max((row["ev_lx"] or 0.0 for row in rows), default=0.0)
    if highest > MAX_EV_LX:
        yield (
            f"Ev of {highest:.0f} lx is more than sun and sky give ({MAX_EV_LX:.0f} lx): the "
            "luminance is not calibrated, or the pixels are in cd/m2 instead of Radiance's "
            f"W/sr/m2; {_SCALE}"
        )
    elif 0.0 < highest < MIN_DGP_EV_LX:
        remedy = f"; if the picture is not calibrated, {_SCALE}" if factor == 1.0 else ""
        lowest = f"{MIN_DGP_EV_LX:.0f} lx"
        yield f"Ev is at most {highest:.3g} lx: below {lowest} a DGP may be too low{remedy}"
