"""Hold a sky view: where the camera sees the sky, and how much of the beam arrives from there.

The file sky_view.exr has the channels openness, u, count, transmittance, low and high; its grid is
in true north, as the pictures' stated heading gives it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError, reason_of
from fieldlum.core.records import JsonTable
from fieldlum.session.writing import replacing_path
from fieldlum.sky.sky_view.picture import SkyGrid
from fieldlum.sky.sky_view.pose import CameraPose

FORMAT = 1  # of the file; docs/file-formats.md
NAME = "sky_view.exr"
CHANNELS = ("openness", "u", "count", "transmittance", "low", "high")
# Sharp edges of coarse pictures are drawn at this size: half of the disc. Chosen.
_FINE_DEG = 0.13
_SHUT, _OPEN = 0.2, 0.8  # neighbours of an edge between no sky and open sky; chosen
_OPEN_PIXEL = 0.95  # openness of a pixel that has no edge: known to 0.05; chosen
_EDGE_ROUNDS = 6  # of shortening; chosen
_LENS_PIXEL_DEG = 1.0  # larger pixels are not a lens's own; chosen
_EDGE_DOUBT = (0.75, 0.25)  # interpolated openness where an edge is at the latest, and at the least
FRAME = "true north"  # of the grid's azimuths
_EXPECTED = "a sky view as docs/sky-view.md describes it"
_REMEDY = "run fieldlum pair, or fieldlum train, again"
_ROUNDING = 1e-4  # by which shares may be outside 0 to 1; chosen


@dataclass(frozen=True)
class SkyView:
    """The sky as the camera sees it; arrays [h, w] on `grid`, NaN in directions not seen.

    openness: share of the direction's solid angle through which the sky is seen, 0 to 1; u: its
    standard uncertainty; count: captures behind it; transmittance: of the pane for the beam; low,
    high: 95 % bounds of openness times transmittance. captures: number of captures used; pose: of
    the pictures; state: of the room in these captures; notes: texts for the user; inputs: what the
    view was computed from.
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
    state: str = ""
    notes: tuple[str, ...] = ()
    inputs: JsonTable = field(default_factory=dict)

    @property
    def through(self) -> Floats32:
        """Openness times transmittance, [h, w]: the share of the beam that arrives."""
        return self.openness * self.transmittance

    def turned(self, north_deg: float) -> SkyView:
        """Return the view with a corrected heading; north_deg: to add to the stated one."""
        heading_deg = (self.grid.heading_deg + north_deg) % 360.0
        return replace(self, grid=replace(self.grid, heading_deg=heading_deg))

    def write(self, path: Path) -> None:
        """Write the view as an EXR of six float32 channels."""
        import OpenEXR

        about = {
            "format": FORMAT,
            "frame": FRAME,
            "grid": asdict(self.grid),
            "captures": self.captures,
            "pose": asdict(self.pose),
            "state": self.state,
            "notes": list(self.notes),
            "inputs": self.inputs,
        }
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "fieldlum:sky_view": json.dumps(about, sort_keys=True),
        }
        channels = {name: np.ascontiguousarray(getattr(self, name)) for name in CHANNELS}
        with replacing_path(path) as temporary:
            OpenEXR.File(header, channels).write(str(temporary))

    @classmethod
    def read(cls, path: Path) -> SkyView:
        """Read a view; only format, grid and the channels are needed.

        Raises InputError for a missing file or other content, such as another frame or unit.
        """
        if not path.is_file():
            raise InputError(path, "no such file", _EXPECTED, _REMEDY)
        try:
            about, channels = _content(path)
            if about["format"] > FORMAT:
                raise ValueError(f"format {about['format']}, this fieldlum reads 1 to {FORMAT}")
            grid = SkyGrid(**about["grid"])
            arrays = {name: channels[name] for name in CHANNELS}
            _check(grid, arrays, about.get("frame", FRAME))
            stated = about.get("pose")
            pose = CameraPose.from_table(stated) if stated else CameraPose()
            return cls(
                grid,
                **arrays,
                captures=about.get("captures", 0),
                pose=pose,
                state=about.get("state", ""),
                notes=tuple(about.get("notes", ())),
                inputs=about.get("inputs", {}),
            )
        except Exception as error:  # OpenEXR raises RuntimeError, UnicodeDecodeError and others
            raise InputError(path, reason_of(error), _EXPECTED, _REMEDY) from None

    @classmethod
    def find(cls, path: Path) -> SkyView | None:
        """Read a view; None for a missing file. Raises InputError for other content."""
        return cls.read(path) if path.is_file() else None

    @cached_property
    def sharp(self) -> SharpView:
        """The shares of the beam at half of the disc's size or finer, for sampling.

        In a coarse picture, an edge between shut and open sky is sharp at the place where the
        interpolated openness is one half. Slats and leaves, finer than a pixel, keep their mean.
        """
        factor = max(1, int(np.ceil(self.grid.step_deg / _FINE_DEG)))
        values = [self.through, self.low, self.high]
        if factor > 1:
            values = _fine_edges(values, self.openness, factor)
        grid = replace(
            self.grid,
            step_deg=self.grid.step_deg / factor,
            height=self.grid.height * factor,
            width=self.grid.width * factor,
        )
        return SharpView(grid, *(np.asarray(v, np.float32) for v in values))


@dataclass(frozen=True, slots=True)
class SharpView:
    """Shares of the beam on a grid that resolves the disc: best, low and high, [h, w]."""

    grid: SkyGrid
    best: Floats32
    low: Floats32
    high: Floats32

    def at(self, towards: Floats) -> tuple[Floats32, Floats32, Floats32]:
        """Return best, low and high in directions [..., 3], NaN where not seen, [...] each."""
        row, column = self.grid.pixels(towards)
        i, j = np.floor(row).astype(int), np.floor(column).astype(int)
        outside = (i < 0) | (i >= self.grid.height) | (j >= self.grid.width)
        i = np.clip(i, 0, self.grid.height - 1)
        j = np.clip(j, 0, self.grid.width - 1)
        best, low, high = (
            np.where(outside, np.float32(np.nan), values[i, j])
            for values in (self.best, self.low, self.high)
        )
        return best, low, high


def _check(grid: SkyGrid, arrays: dict[str, Floats32], frame: str) -> None:
    """Raise ValueError for another frame, an impossible grid, or shares outside 0 to 1."""
    if frame != FRAME:
        raise ValueError(f"azimuths from {frame!r} instead of {FRAME!r}")
    if any(array.shape != (grid.height, grid.width) for array in arrays.values()):
        raise ValueError(f"channels that are not {grid.width} x {grid.height} pixels")
    bottom_deg = grid.first_altitude_deg - grid.height * grid.step_deg
    around_deg = grid.width * grid.step_deg
    if not -91.0 < bottom_deg < grid.first_altitude_deg < 91.0 or not 0.0 < around_deg < 361.0:
        raise ValueError(
            f"a grid from {bottom_deg:g} to {grid.first_altitude_deg:g} degrees of altitude and "
            f"{around_deg:g} degrees around"
        )
    for name in ("openness", "transmittance", "low", "high"):
        values = arrays[name][~np.isnan(arrays[name])]
        wrong = values[(values < -_ROUNDING) | (values > 1.0 + _ROUNDING)]
        if len(wrong):
            raise ValueError(f"{name} of {wrong[0]:g}, which is no share from 0 to 1")
    if (arrays["low"] > arrays["high"] + _ROUNDING).any():
        raise ValueError("low above high in some pixels")


def _content(path: Path) -> tuple[dict[str, Any], dict[str, Floats32]]:
    import OpenEXR

    with path.open("rb") as file:
        # Check the first bytes before OpenEXR reads the file, because OpenEXR prints to stderr.
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError("not an OpenEXR file")
    with OpenEXR.File(str(path), separate_channels=True) as exr:
        about = json.loads(str(exr.header()["fieldlum:sky_view"]))
        channels = {
            name: np.asarray(exr.channels()[name].pixels, np.float32).copy() for name in CHANNELS
        }
    return about, channels


def _fine_edges(values: list[Floats32], openness: Floats32, factor: int) -> list[Floats]:
    """Return best, low and high enlarged by `factor`, with sharp edges between open sky and none.

    A lens blurs an edge over two pixels; where exactly it is, is known to half of that. Pixels of
    a degree are means of a lens's pixels: the shortest edges give each its openness.
    """
    from scipy.ndimage import binary_opening, maximum_filter, minimum_filter

    shown = np.nan_to_num(openness)
    coarse = factor * _FINE_DEG > _LENS_PIXEL_DEG
    size = 3 if coarse else 5
    most, least = maximum_filter(shown, size), minimum_filter(shown, size)
    if coarse:
        mixed = (shown > 0.0) & (shown < _OPEN_PIXEL)
        texture = np.asarray(binary_opening(mixed, np.ones((3, 3))), bool)
        edge, smooth = _enlarged((most > 0.0) & ~texture, factor), _shortest_edges(shown, factor)
    else:
        edge = _enlarged((most > _OPEN) & (least < _SHUT), factor)
        smooth = _interpolated(shown, factor)
    outside = _enlarged(np.isnan(openness), factor)
    maps = []
    for value, half in zip(values, (0.5, *_EDGE_DOUBT), strict=True):
        pane = maximum_filter(np.nan_to_num(value), size)  # value of the open neighbour
        sharp = np.where(smooth >= half, _enlarged(pane, factor), 0.0)
        fine = np.where(edge, sharp, _enlarged(np.nan_to_num(value), factor))
        maps.append(np.where(outside, np.nan, fine))
    return maps


def _shortest_edges(openness: Floats, factor: int) -> Floats:
    """Return a fine map that is above one half in the open share of each pixel, with short edges.

    Motion by mean curvature (Merriman, Bence, Osher 1994) with the area of each pixel kept: blur,
    then in each pixel the brightest parts, as many as its openness, are open.
    """
    from scipy.ndimage import gaussian_filter

    (height, width), n = openness.shape, factor**2
    mixed = np.nonzero((openness > 0.0) & (openness < _OPEN_PIXEL))
    count = np.round(openness[mixed] * n)[:, None]
    smooth = sharp = _interpolated(openness, factor)
    pixels = np.repeat((openness >= _OPEN_PIXEL)[..., None], n, axis=-1).astype(np.float32)
    for _ in range(_EDGE_ROUNDS):
        parts = smooth.reshape(height, factor, width, factor).swapaxes(1, 2)[mixed].reshape(-1, n)
        rank = np.argsort(np.argsort(-parts, axis=1, kind="stable"), axis=1)
        pixels[mixed] = rank < count
        sharp = pixels.reshape(height, width, factor, factor).swapaxes(1, 2)
        sharp = sharp.reshape(height * factor, width * factor)
        smooth = gaussian_filter(sharp, 0.5 * factor, mode="nearest", truncate=3.0)
    # where best is open or shut, low and high follow it
    return np.where(sharp > 0.5, np.maximum(smooth, 0.5), np.minimum(smooth, 0.499))


def _enlarged(values: np.ndarray, factor: int) -> np.ndarray:
    return np.repeat(np.repeat(values, factor, axis=0), factor, axis=1)


def _interpolated(values: Floats, factor: int) -> Floats:
    """Return a map enlarged by `factor`, linear between the centres of pixels."""
    for axis in (0, 1):
        size = values.shape[axis]
        at = np.clip((np.arange(size * factor) + 0.5) / factor - 0.5, 0.0, size - 1.0)
        below = np.minimum(at.astype(int), max(size - 2, 0))
        share = np.expand_dims(at - below, 1 - axis)
        above = np.minimum(below + 1, size - 1)
        values = np.take(values, below, axis) * (1.0 - share) + np.take(values, above, axis) * share
    return values
