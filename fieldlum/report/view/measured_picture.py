"""A picture with everything that is shown of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import Flag
from fieldlum.optics.projection import equirect_rays, equirect_solid_angles
from fieldlum.year.glare.own_pixels import glare_of_pixels
from fieldlum.year.glare.picture_grid import picture_grid
from fieldlum.year.glare.picture_view import PictureView, picture_rays
from fieldlum.year.glare.pictures import Picture, read_picture
from fieldlum.year.glare.single import picture_glare

_DRAWN_SOURCES = 12  # strongest sources with an outline; not measured
Outline = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class MeasuredPicture:
    """A picture with its figures.

    luminance_cdm2 : [H, W], NaN where no lens saw. solid_angle_sr : [H, W] of complete pixels, 0
    where the view has no direction. u_cdm2 : standard uncertainty [H, W], None if unknown. view :
    None for a panorama. heading_deg : azimuth of the centre column, clockwise from true north.
    ev_lx, dgp : in the view direction, None if unknown; edi_lx : melanopic EDI there with its
    standard uncertainty, None without calibrated colour. outlines : pixels (x, y) from the top
    left, around the strongest glare sources of a fisheye; none for a panorama. notes : warnings of
    the glare figures.
    """

    name: str
    luminance_cdm2: Floats32
    solid_angle_sr: Floats32
    u_cdm2: Floats32 | None
    view: PictureView | None
    heading_deg: float
    ev_lx: float | None
    dgp: float | None
    edi_lx: tuple[float, float] | None
    outlines: tuple[Outline, ...]
    notes: tuple[str, ...]

    def cosine_to(self, towards: Floats) -> Floats:
        """Return the cosine between pixels and a unit vector (x east, y north, z up), [H, W].

        It is -1 where the picture has no direction.
        """
        height, width = self.luminance_cdm2.shape
        if self.view is None:
            return equirect_rays(height, width, self.heading_deg) @ towards
        right, up, forward = self.view.frame @ towards
        y = 0.5 - (np.arange(height) + 0.5) / height
        x = (np.arange(width) + 0.5) / width - 0.5
        rays = picture_rays(self.view, x[None, :], y[:, None])
        cosine = rays.right * right + rays.up * up + rays.forward * forward
        return np.where(rays.density > 0, cosine, -1.0)


def read_measured_picture(path: Path, part: str = "") -> MeasuredPicture:
    """Read a picture and judge its glare. Raises InputError for an unusable file.

    part : name of the part, layer or stereo view of an .exr; "" for the only one.
    """
    picture = read_picture(path, part=part)
    panorama = picture.panorama
    luminance = np.array(panorama.luminance_cdm2, np.float32)
    if panorama.flags is not None:
        luminance[(panorama.flags & Flag.OUTSIDE_LENS) > 0] = np.nan
    azimuths_deg = (panorama.heading_deg,) if picture.view is None else ()
    answer = picture_glare(path, azimuths_deg, part=part)
    row = answer["views"][0]
    edi, u_edi = row["melanopic_edi_lx"], row["u_melanopic_edi_lx"]
    return MeasuredPicture(
        name=path.name,
        luminance_cdm2=luminance,
        solid_angle_sr=_solid_angles(picture),
        u_cdm2=panorama.u_cdm2,
        view=picture.view,
        heading_deg=panorama.heading_deg,
        ev_lx=row["ev_lx"],
        dgp=row["dgp"],
        edi_lx=None if edi is None or u_edi is None else (edi, u_edi),
        outlines=_outlines(picture, luminance),
        notes=tuple(answer["warnings"]),
    )


def _solid_angles(picture: Picture) -> Floats32:
    """Return the solid angle of each complete pixel [sr], also behind the observer, [H, W]."""
    height, width = picture.panorama.luminance_cdm2.shape
    if picture.view is None:
        return equirect_solid_angles(height, width).astype(np.float32)
    y = 0.5 - (np.arange(height) + 0.5) / height
    x = (np.arange(width) + 0.5) / width - 0.5
    density = picture_rays(picture.view, x[None, :], y[:, None]).density
    return (density / (height * width)).astype(np.float32)


def _outlines(picture: Picture, luminance: Floats32) -> tuple[Outline, ...]:
    """Return polygons around the strongest sources; none for a panorama, which has many views."""
    import cv2

    if picture.view is None:
        return ()
    pixels = np.maximum(np.nan_to_num(luminance), 0.0)
    label = glare_of_pixels(pixels, picture_grid(picture.view, *pixels.shape))[1].label
    outlines: list[Outline] = []
    for number in range(1, min(int(label.max()), _DRAWN_SOURCES) + 1):
        mask = (label == number).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        for contour in sorted(contours, key=len, reverse=True)[:20]:
            points = cv2.approxPolyDP(contour, 1.0, True).reshape(-1, 2)
            outlines.append(tuple((int(x), int(y)) for x, y in points))
    return tuple(outlines)
