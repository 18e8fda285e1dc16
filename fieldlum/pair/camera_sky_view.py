"""Write sky_view.exr of a session: the directions in which its camera sees the sky."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.plot_style import RED, new_figure, open_axes, styled
from fieldlum.core.records import JsonTable, Panorama, Room, Site, SunSource
from fieldlum.optics import images, projection
from fieldlum.pair.sun_strength import is_measured
from fieldlum.session import Session, codec, replacing_path, sha256
from fieldlum.sky import perez, picture_axes
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view import measured_discs, visible_disc
from fieldlum.sky.sky_view.estimate_from_captures import Captured, sky_view_of
from fieldlum.sky.sky_view.picture import SkyPicture, cut_panorama, read_sky_picture
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.version import __version__

_SKY, _NOT_SEEN = (0.12, 0.37, 0.66), (0.93, 0.73, 0.36)  # colours, from 0 to 1
# Ratio of the bounds of a share that calls the view undecided: glass of a stated room is known to
# 20 % (EN 410: 0.7 to 0.9 for clear double and single panes).
_WIDE = 1.5


@dataclass(frozen=True, slots=True)
class Shown:
    """What the panorama of one usable bracket shows.

    slot: id of the bracket; sun: None without one; recorded_lx: normal illuminance of the sun in
    the panorama's file, 0 without one; caution: a sentence about the sun or the file, or ""; seen
    [H, W]: pixels with a value, None for a panorama that cannot be read; heading_deg: azimuth of
    the centre column, clockwise from north; sun_at_deg: altitude and azimuth of the sun in the
    picture, or of a spot that may be the sun, None without; patches_cdm2 [2305]: luminance in
    the directions of `reinhart_patches`, NaN where not seen.
    """

    slot: str
    sun: SunSource | None = None
    recorded_lx: float = 0.0
    caution: str = ""
    seen: Mask | None = None
    heading_deg: float = 0.0
    sun_at_deg: tuple[float, float] | None = None
    patches_cdm2: Floats32 = field(default_factory=lambda: np.full(2305, np.nan, np.float32))

    @property
    def measured_lx(self) -> float:
        """Illuminance of the disc normal to the sun [lx]: 0 without one, NaN if not measured."""
        if self.sun is None:
            return 0.0
        return self.sun.normal_illuminance_lx if is_measured(self.sun) else math.nan


@dataclass(frozen=True, slots=True)
class _Pictures:
    """Merge's sky pictures (`is_cut`) if all captures have one, else the panoramas."""

    files: list[Path]
    is_cut: bool

    @classmethod
    def of(cls, session: Session, slots: Sequence[str]) -> _Pictures:
        """Return the pictures of some captures by the ids of their slots."""
        cuts = [session.sky_picture(slot) for slot in slots]
        is_cut = all(file.is_file() for file in cuts)
        return cls(cuts if is_cut else [session.panorama(slot) for slot in slots], is_cut)

    @property
    def digest(self) -> str:
        """Digest of the contents of all files."""
        return codec.data_digest([sha256(file) if file.is_file() else "" for file in self.files])

    def read(self, k: int) -> SkyPicture:
        """Return the picture of capture k, from 0."""
        file = self.files[k]
        return read_sky_picture(file) if self.is_cut else cut_panorama(images.read_panorama(file))


def write_sky_view(
    session: Session, shown: Sequence[Shown], light: Light, site: Site, *, force: bool
) -> SkyView | None:
    """Estimate the sky view of n usable captures, write it with its picture, and return it.

    shown, light: of the same n captures; site: the place. A view in the session that was computed
    from the same inputs is returned instead, unless `force`. The files are sky_view.exr and
    sky_view.png in the session. Without a capture by daylight the result is None, and an earlier
    view is removed. Raises InputError for a picture or sidecar that cannot be read.
    """
    rows = [k for k, capture in enumerate(shown) if capture.seen is not None]
    if not rows:
        session.sky_view.unlink(missing_ok=True)
        return None
    captures, light = [shown[k] for k in rows], light[rows]
    slots = [capture.slot for capture in captures]
    pictures, discs = _Pictures.of(session, slots), measured_discs.read_discs(session)
    shares = np.array([c.measured_lx for c in captures]) / np.maximum(light.direct_lx, 1.0)
    inputs: JsonTable = {
        "captures": slots,
        "pictures": pictures.digest,
        "others": codec.data_digest(__version__, light, shares, discs),
    }
    with suppress(InputError):  # a damaged view is estimated again
        stored = None if force else SkyView.find(session.sky_view)
        if stored is not None and stored.inputs == inputs:
            return stored
    elsewhere = np.stack([c.patches_cdm2 for c in captures]) if pictures.is_cut else None
    captured = Captured(light, pictures.read, shares, elsewhere)
    in_lens = _in_lens(captures) if pictures.is_cut else None
    try:
        view = sky_view_of(captured, discs, site, captures[0].heading_deg, in_lens)
    except NotEnoughDataError:
        session.sky_view.unlink(missing_ok=True)
        return None
    places = {k: at for k, capture in enumerate(captures) if (at := capture.sun_at_deg) is not None}
    suns = np.stack([light.apparent_altitude_deg, light.sun_azimuth_deg], axis=1)[[*places]]
    height = len(captures[0].seen) if captures[0].seen is not None else 1
    wrong = picture_axes.wrong_axes(suns, [*places.values()], captures[0].heading_deg, height)
    notes = [f"WARNING: {wrong.found}: {wrong.remedy}"] if wrong and wrong.sure else []
    view = replace(view, inputs=inputs, notes=(*view.notes, *notes))
    view.write(session.sky_view)
    suns = view.pose.in_pictures(light.apparent_sun_direction[shares != 0.0])
    overcast = captures[int(np.argmax(light.dhi_wm2 - light.dni_wm2))].slot
    picture = session.sky_view.with_suffix(".png")
    draw(picture, view, images.read_panorama(session.panorama(overcast)), suns)
    return view


def is_outdated(session: Session, view: SkyView) -> bool:
    """Return whether merge wrote other pictures since `pair` wrote the session's sky view.

    It is False for a view that was not computed from pictures of a session.
    """
    recorded = view.inputs.get("pictures")
    return bool(recorded) and _Pictures.of(session, view.inputs["captures"]).digest != recorded


def _in_lens(captures: Sequence[Shown]) -> Callable[[Floats], Mask]:
    """Return a function of directions [p, 3]: which of them a lens saw in 80 % of captures, [p]."""
    masks = [capture.seen for capture in captures if capture.seen is not None]
    alike = [mask for mask in masks if mask.shape == masks[0].shape]
    often = np.add.reduce(alike, dtype=int) > 0.8 * len(alike)
    heading_deg = captures[0].heading_deg

    def in_lens(rays: Floats) -> Mask:
        """Return a mask [p] of the directions [p, 3] that a lens saw in most captures."""
        return often.ravel()[projection.flat_pixels(rays, often.shape, heading_deg)]

    return in_lens


def in_patches(panorama: Panorama) -> Floats32:
    """Return the luminance at the centres of `reinhart_patches`, NaN where no lens saw [2305]."""
    light = panorama.seen_cdm2
    towards = perez.reinhart_patches().directions
    return light.ravel()[projection.flat_pixels(towards, light.shape, panorama.heading_deg)]


def shares_of_beam(view: SkyView | None, room: Room | None, light: Light) -> tuple[Floats, Mask]:
    """Return the share of the beam that arrives in n hours [n], and a mask [n]: by the sky view.

    The sky view decides where its lower bound is above 0, except where its interval is wide and the
    stated room shows the sun. Elsewhere the share is that of the room, NaN without a room. Raises
    InputError for an impossible room.
    """
    shares, by_view = np.full(len(light), np.nan), np.zeros(len(light), bool)
    if room is not None:
        shares = visible_disc.room_shares(room, light.apparent_sun_direction)
    if view is not None:
        disc = visible_disc.disc_of_hours(view, light)
        is_wide = disc.high_lx > _WIDE * disc.low_lx
        by_view = (disc.low_lx > 0.0) & (light.direct_lx > 0.0) & ~(is_wide & (shares > 0.0))
        shares[by_view] = disc.best_lx[by_view] / light.direct_lx[by_view]
    return shares, by_view


def draw(path: Path, view: SkyView, panorama: Panorama, suns: Floats) -> None:
    """Draw a view's openness over a panorama, and write it to `path` as a PNG.

    panorama: shown behind it; suns [n, 3]: unit vectors (x east, y north, z up) to the captured
    discs, as the panoramas show them.
    """
    grid = view.grid
    # edges of the view, in degrees
    left = grid.heading_deg + (grid.first_azimuth_deg + 180.0) % 360.0 - 180.0  # azimuth
    right, top = left + grid.width * grid.step_deg, grid.first_altitude_deg
    bottom = top - grid.height * grid.step_deg
    blind = np.isnan(view.openness)[..., None]
    colours = np.where(blind, _NOT_SEEN, _SKY)
    alpha = 0.7 * np.where(blind, 0.5, np.nan_to_num(view.openness)[..., None])
    altitude, azimuth = projection.altitude_azimuth_deg(suns)
    middle = panorama.heading_deg
    with styled():
        figure = new_figure(10.0, 1.6 + 9.0 * (top - bottom + 10.0) / (right - left + 10.0))
        axes = figure.subplots()
        for turn in (0.0, 360.0):  # a view can cross the panorama's edge
            extent = (middle - 180.0 + turn, middle + 180.0 + turn, -90.0, 90.0)
            light = np.log10(np.maximum(np.nan_to_num(panorama.luminance_cdm2), 1.0))
            axes.imshow(light, cmap="gray", extent=extent)
        axes.imshow(np.concatenate([colours, alpha], -1), extent=(left, right, bottom, top))
        axes.plot(left + (azimuth - left) % 360.0, altitude, "o", mfc="none", mec=RED, ms=5)
        axes.set(xlim=(left - 5.0, right + 5.0), ylim=(bottom - 5.0, min(top + 5.0, 90.0)))
        axes.set_xlabel("azimuth, clockwise from true north, as the heading states it (degrees)")
        axes.set_ylabel("altitude (degrees)")
        axes.xaxis.set_major_formatter(lambda azimuth, _: f"{azimuth % 360.0:g}")
        axes.set_title(
            f"Sky view, captures: {view.captures}; blue is sky (by openness), yellow no lens saw"
            + (", red circles are captured discs of the sun" if len(suns) else "")
            + "\nsky well below the lowest path of the sun is not examined: it stays white",
            fontsize=9,
        )
        open_axes(axes)
        with replacing_path(path) as temporary:
            figure.savefig(temporary, dpi=100, bbox_inches="tight", format="png")
