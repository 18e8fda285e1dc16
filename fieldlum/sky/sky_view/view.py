"""Store a sky view: where the camera sees the sky, and how much of the beam arrives from there.

The file sky_view.exr has the channels openness, u, count, transmittance, low and high; its grid is
in true north, as the pictures' stated heading gives it. Views of other states of the room, and of
single seasons, are further layers of the file.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import binary_opening, find_objects, maximum_filter

from fieldlum.core import files, room_states, strict_toml
from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError, reason_of
from fieldlum.core.records import JsonTable
from fieldlum.optics.images import exr_headers, opened_exr
from fieldlum.session.codec import sealed, warn_if_changed
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.picture import SkyGrid
from fieldlum.sky.sky_view.pose import CameraPose

FORMAT = 1  # of the file; docs/file-formats.md
SKY_VIEW = "sky_view.exr"
_OF_OTHERS = ("state", "days", "captures")  # what is stored of other states and seasons
CHANNELS = ("openness", "u", "count", "transmittance", "low", "high")
# A view of a season is used up to this many days before and after its captures. Leaves of
# temperate trees come and fall within two to four weeks. Chosen.
REACH_DAYS = 30
_FINE_DEG = 0.13  # pixels of sharp edges: half of the disc; chosen
LENS_PIXEL_DEG = 1.0  # larger pixels are means of a lens's; chosen
_OPEN_PIXEL = 0.95  # openness of a pixel that has no edge: known to 0.05; chosen
# A lens blurs an edge over two pixels: less open is shut, and as much less than 1 is open. Chosen.
_LENS_BLUR = 0.2
_MIN_WIDTH = 0.02  # of bounds that leave something open, share of the beam; chosen
# Smoothed share of open sky from which a place counts as open in the maps best, low and high.
# Chosen for the bounds.
_DOUBT = (0.5, 0.75, 0.25)
# Length and width of the blur along an edge, in pixels: bars narrower than a pixel do not break up
# (rooms of docs/validation.md). Chosen.
_EDGE_BLUR = (1.2, 0.35)
# Steps of that blur in a pixel; its short standard deviation then is two of them.
_BLUR_STEPS = 5
FRAME = "true north"  # of the grid's azimuths
_EXPECTED = "a sky view as docs/sky-view.md describes it"
_REMEDY = "run fieldlum pair, or fieldlum train, again"
_ROUNDING = 1e-4  # by which shares may be outside 0 to 1; chosen


@dataclass(frozen=True)
class SkyView:
    """The sky as the camera sees it; arrays [h, w] on `grid`, NaN in directions not seen.

    openness: share of the direction's solid angle through which the sky is seen, 0 to 1; u: its
    standard uncertainty; count: captures that show the direction; transmittance: of the glass in
    front for the beam; low, high: 95 % bounds of openness times transmittance. captures: number of
    captures used; pose: of the pictures; notes: texts for the user; inputs: what the view was
    computed from. state: blinds and tint, "" for the usual; days: of the year that have captures,
    if the view holds only within REACH_DAYS of them, else empty; others: views of other states and
    seasons, on the same grid.
    """

    grid: SkyGrid
    openness: Floats32
    u: Floats32
    count: Floats32
    transmittance: Floats32
    low: Floats32
    high: Floats32
    captures: int = 0
    pose: CameraPose = field(default_factory=CameraPose)
    notes: tuple[str, ...] = ()
    inputs: JsonTable = field(default_factory=dict)
    state: str = ""
    days: tuple[int, ...] = ()
    others: tuple[SkyView, ...] = ()

    @property
    def through(self) -> Floats32:
        """Openness times transmittance, [h, w]: the share of the beam that arrives."""
        return self.openness * self.transmittance

    def turned(
        self, north_deg: float, u_deg: float, late_min: float = 0.0, latitude_deg: float = 0.0
    ) -> SkyView:
        """Return the view with a corrected heading and clock.

        north_deg: to add to the stated heading; u_deg: its standard uncertainty; late_min: by how
        much the captures' times were too late; latitude_deg: of the site.
        """
        grid = replace(self.grid, heading_deg=(self.grid.heading_deg + north_deg) % 360.0)
        pose = self.pose.at_clock(late_min, latitude_deg).turned(north_deg, u_deg)
        others = (v.turned(north_deg, u_deg, late_min, latitude_deg) for v in self.others)
        return replace(self, grid=grid, pose=pose, others=tuple(others))

    def where(self, known: Mask, base: SkyView) -> SkyView:
        """Return the view with the values of `base` where it is not `known` [h, w].

        base: a view on the same grid.
        """
        arrays = {n: np.where(known, getattr(self, n), getattr(base, n)) for n in CHANNELS}
        return replace(self, **arrays)

    def of_hours(self, light: Light) -> list[tuple[Indices, SkyView]]:
        """Return the views that apply to the n hours of `light`, each with the hours' indices [k].

        They are those of the hour's state of the room (without a mark: this view's state) and of
        the nearest season. An hour whose state no view has gets this view with a lower bound of 0.
        """
        marks = light.states or ("",) * len(light)
        states = np.array([room_states.cover_state(text) or self.state for text in marks])
        views, days = (self, *self.others), light.day_of_year
        distances = [np.where(states == v.state, v.days_from(days), np.inf) for v in views]
        # the last choice, for hours of another state: farther than any view of the hour's state
        nearest = np.argmin([*distances, np.full(len(days), REACH_DAYS + 2)], axis=0)
        choices = enumerate((*views, replace(self, low=0.0 * self.low)))
        return [(rows, view) for k, view in choices if len(rows := np.flatnonzero(nearest == k))]

    def days_from(self, day: Indices) -> Indices:
        """Return the distance [days] from days of the year [n] to the nearest of `days`, [n].

        It is at most REACH_DAYS + 1, which is also the result of a view for the complete year.
        """
        # differences modulo a year of 366 days, -183 to 182
        apart = np.abs((day[:, None] - np.array(self.days, int) + 183) % 366 - 183)
        return apart.min(axis=1, initial=REACH_DAYS + 1)

    def write(self, path: Path) -> None:
        """Write the file: an EXR with six float32 channels for this view and each of the others.

        It is complete or not at all; its SHA-256 is written next to it, to NAME.sha256.
        """
        import OpenEXR

        about = {
            "format": FORMAT,
            "frame": FRAME,
            "grid": asdict(self.grid),
            "captures": self.captures,
            "state": self.state,
            "pose": asdict(self.pose),
            "notes": list(self.notes),
            "inputs": self.inputs,
            "others": [{name: getattr(v, name) for name in _OF_OTHERS} for v in self.others],
        }
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "fieldlum:sky_view": json.dumps(about, sort_keys=True),
        }
        channels = {
            _layer(k) + name: np.ascontiguousarray(getattr(view, name))
            for k, view in enumerate((self, *self.others))
            for name in CHANNELS
        }
        with sealed(path), files.replacing_path(path) as temporary:
            OpenEXR.File(header, channels).write(str(temporary))

    @classmethod
    def read(cls, path: Path) -> SkyView:
        """Read a view with its other states and seasons from a file that `write` wrote.

        Of the header only format and grid are required. Raises InputError for a missing file or
        other content, such as azimuths from another north, or shares outside 0 to 1; warns if the
        file changed since `write`.
        """
        if not path.is_file():
            raise InputError(path, "no such file", _EXPECTED, _REMEDY)
        warn_if_changed(path)
        try:
            about, views = _content(path)
            if about["format"] > FORMAT:
                raise ValueError(f"format {about['format']}, this fieldlum reads 1 to {FORMAT}")
            grid = SkyGrid(**about["grid"])
            for arrays in views:
                _check(grid, arrays, about.get("frame", FRAME))
            pose = strict_toml.convert(about.get("pose") or {}, CameraPose)
            more = {name: about[name] for name in ("captures", "inputs", "state") if name in about}
            others = tuple(
                cls(grid, **arrays, **{**table, "days": tuple(table["days"])}, pose=pose)
                for arrays, table in zip(views[1:], about.get("others", ()), strict=True)
            )
            notes = tuple(about.get("notes", ()))
            return cls(grid, **views[0], **more, pose=pose, notes=notes, others=others)
        except Exception as error:  # OpenEXR raises RuntimeError, UnicodeDecodeError and others
            raise InputError(path, reason_of(error), _EXPECTED, _REMEDY) from None

    @classmethod
    def find(cls, path: Path) -> SkyView | None:
        """Read a view; None for a missing file. Raises InputError for other content."""
        return cls.read(path) if path.is_file() else None

    def beam_shares(self, towards: Floats) -> Floats32:
        """Return the share of the beam that arrives from directions: best, low and high, [3, ...].

        towards: unit vectors [..., 3], x east, y north, z up, as the pictures show them
        (`CameraPose.in_pictures`). The result is NaN where no lens saw. Slats and leaves that are
        finer than a pixel have their mean.
        """
        grid, maps = self._sharp
        inside, row, column = grid.indices(towards)
        return np.where(inside, maps[:, row, column], np.float32(np.nan))

    @cached_property
    def _sharp(self) -> tuple[SkyGrid, Floats32]:
        """A grid that resolves the sun's disc, and the share of the beam on it, with sharp edges.

        The share has its best value, lower and upper bound, [3, h, w].
        """
        factor = max(1, int(np.ceil(self.grid.step_deg / _FINE_DEG)))
        maps = np.stack([self.through, self.low, self.high]).astype(np.float32)
        if factor > 1:
            # Where captures gave only bounds, u is `undecided_u` of these, or somewhat less after
            # discs corrected them (0.8, chosen): no edge narrows these. Open pixels have no edge.
            width = np.fmax(self.high - self.low, _MIN_WIDTH)
            undecided = self.u > 0.8 * undecided_u(width, self.transmittance)
            undecided &= self.openness < _OPEN_PIXEL
            maps = _fine_edges(maps, self.openness, undecided, factor)
        step_deg, (height, width) = self.grid.step_deg / factor, maps.shape[1:]
        return replace(self.grid, step_deg=step_deg, height=height, width=width), maps


def _check(grid: SkyGrid, arrays: dict[str, Floats32], frame: str) -> None:
    """Raise ValueError for another frame, an impossible grid, or shares outside 0 to 1.

    arrays: the channels by name, [h, w] each.
    """
    if frame != FRAME:
        raise ValueError(f"azimuths from {frame!r} instead of {FRAME!r}")
    if any(array.shape != (grid.height, grid.width) for array in arrays.values()):
        raise ValueError(f"channels that are not {grid.width} x {grid.height} pixels")
    bottom_deg = grid.first_altitude_deg - grid.height * grid.step_deg
    around_deg = grid.width * grid.step_deg
    if not -91.0 < bottom_deg < grid.first_altitude_deg < 91.0 or not 0.0 < around_deg < 361.0:
        altitudes = f"{bottom_deg:g} to {grid.first_altitude_deg:g} degrees of altitude"
        raise ValueError(f"a grid from {altitudes} and {around_deg:g} degrees around")
    for name in ("openness", "transmittance", "low", "high"):
        values = arrays[name][~np.isnan(arrays[name])]
        wrong = values[(values < -_ROUNDING) | (values > 1.0 + _ROUNDING)]
        if len(wrong):
            raise ValueError(f"{name} of {wrong[0]:g}, which is no share from 0 to 1")
    if (arrays["low"] > arrays["high"] + _ROUNDING).any():
        raise ValueError("low above high in some pixels")


def _content(path: Path) -> tuple[dict[str, Any], list[dict[str, Floats32]]]:
    """Return a file's header, and for each of its views the channels by name, [h, w] each."""
    exr_headers(path)  # raises InputError for a file that is no .exr
    with opened_exr(path, separate_channels=True) as exr:
        about = json.loads(str(exr.header()["fieldlum:sky_view"]))
        stored, views = exr.channels(), 1 + len(about.get("others", ()))
        return about, [
            {c: np.asarray(stored[_layer(k) + c].pixels, np.float32).copy() for c in CHANNELS}
            for k in range(views)
        ]


def _layer(k: int) -> str:
    """Return the prefix of a view's channels in the file; k: 0 for the main view, others from 1."""
    return f"other{k}." if k else ""


def undecided_u(width: Floats, transmittance: Floats) -> Floats:
    """Return the standard uncertainty of openness where captures decide only its bounds, [h, w].

    width: upper less lower bound of the share of the beam; transmittance: of the pane. The openness
    is uniformly distributed between the bounds; the uncertainty is at most 1.
    """
    return np.minimum(width / np.fmax(transmittance, _MIN_WIDTH) / 12**0.5, 1.0)


def _fine_edges(maps: Floats32, openness: Floats32, undecided: Mask, factor: int) -> Floats32:
    """Return best, low and high [3, h, w] enlarged by `factor`, with sharp edges.

    maps [3, h, w], openness [h, w], undecided [h, w] (pixels that keep their bounds): at the view's
    own resolution. The edges between sky and what is in front of it are the shortest that give each
    pixel its openness. Slats and leaves keep the mean of their pixel (`_texture`).
    """
    shown, size = np.nan_to_num(openness), 3
    is_sharp = factor * _FINE_DEG <= LENS_PIXEL_DEG  # a lens's own pixels, not means of several
    if is_sharp:
        shown, size = np.clip((shown - _LENS_BLUR) / (1.0 - 2.0 * _LENS_BLUR), 0.0, 1.0), 5
    mixed = (shown > 0.0) & (shown < _OPEN_PIXEL)
    texture = _texture(shown, mixed, size, is_sharp)
    edge = _enlarged((maximum_filter(shown, size) > 0.0) & ~texture, factor)
    own = _enlarged(maps, factor)
    open_share = np.zeros(own.shape[1:], np.float32)  # smoothed, of each fine place
    reached = maximum_filter(shown, 11) > 0.0  # five pixels: four standard deviations of the blur
    for box in find_objects(reached.astype(np.int8)):  # one box around all that is reached
        fine_box = tuple(slice(s.start * factor, s.stop * factor) for s in box)
        open_share[fine_box] = _shortest_edges(shown[box], factor)
    out = own.copy()
    for fine, values, minimum in zip(out, maps, _DOUBT, strict=True):
        pane = maximum_filter(np.nan_to_num(values), size)  # value of the open neighbour
        fine[edge] = np.where(open_share >= minimum, _enlarged(pane, factor), 0.0)[edge]
    # Slats of a lens's pixel look like a blurred edge, and a bar in a pixel between open ones can
    # be anywhere in it: the pixel's own bounds hold too.
    bars = mixed & between(shown >= _OPEN_PIXEL)
    doubted = _enlarged(bars | undecided | is_sharp, factor)
    out[1] = np.where(doubted, np.minimum(out[1], own[1]), out[1])  # low
    out[2] = np.where(doubted, np.maximum(out[2], own[2]), out[2])  # high
    return np.where(np.isnan(own), own, out)


def _texture(openness: Floats32, mixed: Mask, size: int, is_sharp: bool) -> Mask:
    """Return a mask [h, w] of mixed pixels that show slats or leaves instead of a single edge.

    They fill a square of `size` pixels. In pixels that are means of several of a lens (not
    `is_sharp`), mixed pixels without an open neighbour count too: gaps in a tree's crown have none.
    """
    texture = np.asarray(binary_opening(mixed, np.ones((size, size))), bool)
    if is_sharp:
        return texture
    blocks = np.asarray(binary_opening(mixed, np.ones((2, 2))), bool)
    no_edge = blocks & (maximum_filter(openness, 3) < _OPEN_PIXEL)
    # a single pixel is a corner
    strips = [binary_opening(no_edge, np.ones(shape)) for shape in ((1, 3), (3, 1))]
    return texture | (blocks & maximum_filter(np.any(strips, axis=0), 3))


def between(marked: Mask) -> Mask:
    """Return the pixels between two marked ones of their row or column, [h, w]."""
    pairs = [np.roll(marked, 1, axis) & np.roll(marked, -1, axis) for axis in (0, 1)]
    return pairs[0] | pairs[1]


def _shortest_edges(openness: Floats32, factor: int) -> Floats32:
    """Return the smoothed share of open sky, [h factor, w factor]: above 0.5 where it is open.

    openness [h, w]. The open parts have the shortest edges that give each pixel its openness:
    threshold dynamics (Merriman, Bence, Osher 1994) with a fixed area in each pixel. The map is
    blurred, then in each mixed pixel the brightest of its factor x factor parts are opened, as many
    as its openness. A blur along bars keeps bars that are narrower than a pixel in one piece.
    """

    def evenly(values: Floats32, pixel: float) -> Floats32:
        """Return a map [h, w] blurred by a round Gaussian; edges are continued by their values.

        The standard deviation is half a pixel of the sky view. values: without NaN; pixel: width of
        a pixel of the sky view in pixels of the map.
        """
        blurred = cv2.GaussianBlur(values, (0, 0), 0.5 * pixel, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred, np.float32)

    (height, width), count = openness.shape, factor**2  # count: parts of a pixel
    mixed = np.nonzero((openness > 0.0) & (openness < _OPEN_PIXEL))  # m pixels
    open_count = np.round(openness[mixed] * count)[:, None]  # [m, 1]
    sharp = np.asarray(cv2.resize(openness, (width * factor, height * factor)), np.float32)
    parts = np.repeat((openness >= _OPEN_PIXEL)[..., None], count, axis=-1).astype(np.float32)
    for _ in range(4):
        smooth = _blurred(sharp, factor, _along_edges)
        by_pixel = smooth.reshape(height, factor, width, factor).swapaxes(1, 2)  # [h, w, f, f]
        brightness = by_pixel[mixed].reshape(-1, count)  # [m, count]
        rank = np.argsort(np.argsort(-brightness, axis=1, kind="stable"), axis=1)
        parts[mixed] = rank < open_count
        sharp = parts.reshape(height, width, factor, factor).swapaxes(1, 2)
        sharp = sharp.reshape(height * factor, width * factor)
    smooth = _blurred(sharp, factor, evenly)
    # the blur must not change which side of 0.5 a place is on: low and high follow best
    return np.where(sharp > 0.5, np.maximum(smooth, 0.5), np.minimum(smooth, 0.499))


def _blurred(
    values: Floats32, factor: int, blur: Callable[[Floats32, float], Floats32]
) -> Floats32:
    """Return a map [h, w] blurred at a reduced size, for speed.

    factor: width of a pixel of the sky view in pixels of the map; blur: a function of the reduced
    map and of that width in it.
    """
    step = max(1, factor // _BLUR_STEPS)
    size = (values.shape[1] // step, values.shape[0] // step)
    small = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)
    return np.asarray(cv2.resize(blur(small, factor / step), values.shape[::-1]), np.float32)


def _along_edges(values: Floats32, pixel: float) -> Floats32:
    """Return a map [h, w] blurred along its edges and bars.

    pixel: width of a pixel of the sky view in it. Of the blurs by eight long Gaussians, each place
    has the one that differs most from the blur by a round Gaussian.
    """
    long, short = _EDGE_BLUR  # standard deviations in pixels of the sky view
    reach = int(np.ceil(3.0 * pixel))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] / pixel
    best = even = cv2.GaussianBlur(values, (0, 0), long * pixel, borderType=cv2.BORDER_REPLICATE)
    for angle in np.arange(8) * np.pi / 8.0:
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        kernel = np.exp(-0.5 * ((along / long) ** 2 + (across / short) ** 2))
        blurred = cv2.filter2D(values, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
        best = np.where(np.abs(blurred - even) > np.abs(best - even), blurred, best)
    return np.asarray(best, np.float32)


def _enlarged(values: np.ndarray, factor: int) -> np.ndarray:
    """Return maps [..., h, w] with each pixel repeated `factor` times in both directions."""
    return values.repeat(factor, axis=-2).repeat(factor, axis=-1)
