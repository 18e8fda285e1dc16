"""Ground truth of a box room: any hour's luminance map from cached Radiance coefficients."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, Progress, Room, SiteFile, SunSource, quiet
from fieldlum.core.strict_toml import plain
from fieldlum.optics.projection import equirect_rays
from fieldlum.room.scene.patches import disc_visibility, visible_disc
from fieldlum.room.scene.points import SunPoints, sun_points
from fieldlum.room.scene.sun_disc import DISC_RAYS
from fieldlum.room.scene.view import SceneView, look, patch_rays
from fieldlum.room.simulate.gather import FIRST_PIECE, PLAIN, SKY, Pieces, cut, gather
from fieldlum.room.simulate.pixel_points import PixelPoints, pixel_points
from fieldlum.session import replacing_path
from fieldlum.session.codec import digest
from fieldlum.sky.light import Light, light_at

VERSION = 3  # of the coefficients; increase it to recompute all stored ones


@dataclass(frozen=True, slots=True)
class Quality:
    """Sizes that decide accuracy and time.

    piece_m : size of the surface pieces in the room; pixel_rays, piece_rays : directions from each
    pixel's point and from each piece; smooth_px : radius within which neighbours on one face share
    their gathered light.
    """

    piece_m: float
    pixel_rays: int
    piece_rays: int
    smooth_px: int = 2


# Accuracy of "quick" against Radiance: docs/validation.md; the others are chosen around it.
QUALITIES = {
    "draft": Quality(0.8, 64, 128),
    "quick": Quality(0.4, 400, 1024),
    "paper": Quality(0.3, 576, 2048, 3),
}


@dataclass(frozen=True)
class Rendering:
    """Pictures of n moments, without the sun disc.

    luminance_cdm2 : [n, H, W]; patch_cdm2 : [n, H, W] of direct sun, with the fewer rays of
    `scene.sun_patches`; disc_lx : [n] on a plane normal to the sun at the camera; visible_fraction
    : [n] of the disc; light : as requested; points_lx : [m, n] irradiance of the pixels' points
    without direct sun.
    """

    luminance_cdm2: Floats32
    patch_cdm2: Floats32
    disc_lx: Floats
    visible_fraction: Floats
    light: Light
    points_lx: Floats32

    def __len__(self) -> int:
        return len(self.luminance_cdm2)

    def source(self, k: int) -> SunSource | None:
        """Return the sun of moment k as the lens sees it; None if it is hidden or down."""
        if self.disc_lx[k] <= 0:
            return None
        angles = float(self.light.shown_altitude_deg[k]), float(self.light.sun_azimuth_deg[k])
        return SunSource(
            *angles, float(self.disc_lx[k]), float(self.visible_fraction[k]), "rendering"
        )


@dataclass(frozen=True)
class SimulatedRoom:
    """A room that can be rendered in any light; `simulated_room` creates it.

    from_points : CSR [m, columns] gathered irradiance of the pixels' points; points : where they
    are, and their part in each pixel (reflectance / pi, glass, smoothing); from_pieces : CSR [p,
    columns] of the surface pieces. key : identifies room, size and quality; "" if not stored.
    """

    setup: SiteFile
    view: SceneView
    pieces: Pieces
    from_points: Any
    points: PixelPoints
    from_pieces: Any
    key: str = ""

    @property
    def height(self) -> int:
        """Rows of the panorama."""
        return self.view.height

    @property
    def to_pixels(self) -> Any:
        """The matrix from the points' irradiance to the pixels' luminance, CSR [H W, m]."""
        return self.points.to_pixels

    @property
    def sun_rays(self) -> int:
        """Rays of direct sun in each direction of a pixel: more than a model's patches have."""
        return patch_rays(self.height) + 1

    @cached_property
    def _view_points(self) -> tuple[SunPoints, SunPoints]:
        """Return the points of the pictures' direct sun, and those of sun patches for a model."""
        return self._points(self.sun_rays), self._points(patch_rays(self.height))

    def _points(self, rays: int) -> SunPoints:
        view = look(box_room(self.setup), self.height, self.view.heading_deg, rays)
        return view.sun_points()

    @cached_property
    def _piece_points(self) -> SunPoints:
        p = self.pieces
        axis, sign = p.axis[p.piece], p.sign[p.piece]
        return sun_points(self.view.scene, p.position, axis, sign, p.share, p.piece, len(p))

    @cached_property
    def _sky_rays(self) -> Floats:
        return equirect_rays(self.height, 2 * self.height, self.view.heading_deg).reshape(-1, 3)

    @cached_property
    def _seen_sky(self) -> Indices:
        return np.flatnonzero(self.view.sky.ravel() > 0)

    def render(self, light: Light) -> Rendering:
        """Render all moments of `light` at once; memory grows with their number."""
        n, pixels = len(light), 2 * self.height**2
        toward = self.view.scene.to_room(light.shown_sun_direction)
        direct_lx = light.direct_lx
        shown, given = np.zeros((2, n, pixels), np.float32)
        sunlit = np.zeros((n, len(self.pieces)), np.float32)
        for k in np.flatnonzero(direct_lx > 0):
            for patch, points in zip((shown, given), self._view_points, strict=True):
                patch[k] = points.direct(toward[k]) * direct_lx[k]
            sunlit[k] = self._piece_points.direct(toward[k]) * direct_lx[k]
        points_lx = np.asarray(self.from_points @ self._columns(light, sunlit), np.float32)
        out = np.ascontiguousarray((self.to_pixels @ points_lx).T, np.float32)
        out += shown
        seen_sky = self._seen_sky
        out[:, seen_sky] += light.sky_at(self._sky_rays[seen_sky]) * self.view.sky.ravel()[seen_sky]
        out += light.sky.ground_cdm2[:, None].astype(np.float32) * self.view.plain.ravel()
        visible, through = disc_visibility(self.view.scene, toward)
        shape = (n, self.height, 2 * self.height)
        disc_lx = direct_lx * visible * through
        patches = given.reshape(shape)
        return Rendering(out.reshape(shape), patches, disc_lx, visible, light, points_lx)

    def _columns(self, light: Light, sunlit: Floats32) -> Floats32:
        """Return the luminance of sky, plain, and pieces after all bounces, [columns, n]."""
        outdoors = np.zeros((FIRST_PIECE, len(light)), np.float32)
        outdoors[:SKY] = light.sky_cdm2.T
        outdoors[PLAIN] = light.sky.ground_cdm2
        return self.columns(outdoors, sunlit.T)

    def columns(self, outdoors: Floats32, first_lx: Floats32 | float = 0.0) -> Floats32:
        """Return the luminance of sky and plain, then of pieces after all bounces, [columns, n].

        outdoors: luminance of sky and plain [FIRST_PIECE, n] cd/m2; first_lx: illuminance of the
        pieces by direct sun [p, n].
        """
        reflect = (self.pieces.reflectance / np.pi).astype(np.float32)[:, None]
        first = self._outdoors @ outdoors + first_lx
        pieces = reflect * first
        for _ in range(self._passes):
            pieces = reflect * (first + self._bounces @ pieces)
        return np.concatenate((outdoors, pieces))

    def pixels_cdm2(self, columns: Floats32) -> Floats32:
        """Return the luminance of surfaces without their direct sunlight, in all pixels.

        columns: the result of `columns`, [columns, n] for n moments; it includes sunlight after
        bounces. Sky and plain that are seen through windows are not added. The result is [H W, n],
        cd/m2.
        """
        return self.to_pixels @ (self.from_points @ columns)

    @cached_property
    def _passes(self) -> int:
        """Number of bounces after which an evenly lit room changes by less than 1e-4.

        It is the same for every hour, whatever other hours are in the same block.
        """
        reflect = (self.pieces.reflectance / np.pi).astype(np.float32)
        pieces = reflect
        for k in range(1, 60):
            after = reflect * (1 + self._bounces @ pieces)
            if float((after - pieces).max()) < 1e-4 * float(after.mean()):
                return k
            pieces = after
        return 60

    @cached_property
    def _outdoors(self) -> Any:
        return self.from_pieces[:, :FIRST_PIECE].tocsr()

    @cached_property
    def _bounces(self) -> Any:
        return self.from_pieces[:, FIRST_PIECE:].tocsr()

    def panorama(self, t_utc: datetime, dni_wm2: float, dhi_wm2: float) -> Panorama:
        """Render one moment with its DNI and DHI as a panorama with its separate visible sun."""
        light = light_at([t_utc], self.setup.site, np.array([dni_wm2]), np.array([dhi_wm2]))
        return self.as_panorama(self.render(light), 0)

    def as_panorama(self, made: Rendering, k: int) -> Panorama:
        """Return moment `k` (from 0) of a rendering as a panorama, with its visible sun apart."""
        about = {"made_by": "fieldlum simulate", "room": self.setup.site.name}
        if 0.0 < made.visible_fraction[k] < 1.0:
            toward = self.view.scene.to_room(made.light.shown_sun_direction[k])
            rays = visible_disc(self.view.scene, toward)
            about[DISC_RAYS] = "".join("1" if ray else "0" for ray in rays)
        return Panorama(
            made.luminance_cdm2[k],
            self.view.heading_deg,
            t_utc=made.light.t_utc[k],
            sun=made.source(k),
            attributes=about,
        )


# ----------------------------------------------------------------------------------------------
# computing and storing


def box_room(setup: SiteFile) -> Room:
    """Return the room of a site. Raises InputError for a site without a box room."""
    if setup.room is None or setup.room.kind != "box":
        raise InputError(
            setup.site.name,
            "the site has no box room",
            '[room] with kind = "box"',
            "state the geometry of the room in SITE.toml",
        )
    return setup.room


def simulated_room(
    setup: SiteFile,
    *,
    height: int = 115,
    quality: str = "quick",
    cache: Path | None = None,
    workers: int | None = None,
    progress: Progress = quiet,
    of_pieces: Any = None,
) -> SimulatedRoom:
    """Compute the Radiance coefficients of a box room, or read them from `cache` (a folder).

    They are stored there under a hash of room, heading, size and quality; None stores nothing.
    of_pieces: `SimulatedRoom.from_pieces` of the same room and quality at another height, which is
    not computed again. Raises InputError without a box room or for an impossible one, KeyError for
    a quality not in `QUALITIES`, RuntimeError if Radiance fails.
    """
    room = box_room(setup)
    how = QUALITIES[quality]
    heading = setup.camera.heading_deg % 360.0
    view = look(room, height, heading)
    pieces = cut(view.scene, how.piece_m)
    points = pixel_points(view, how.smooth_px)
    key = digest(
        {
            "room": plain(room),
            "height": height,
            "heading": heading,
            "how": asdict(how),
            "version": VERSION,
        }
    )[:16]
    folder = cache / f"coefficients-{key}" if cache is not None else None
    if folder is not None and (folder / "complete").is_file():
        matrices = [_load(folder, name, FIRST_PIECE + len(pieces)) for name in ("points", "pieces")]
        return SimulatedRoom(setup, view, pieces, matrices[0], points, matrices[1], key)
    scene = view.scene
    total = len(pieces) + len(points.rows)

    def both(finished: int, _all: int, text: str, base: int = 0) -> None:
        progress(base + finished, total, text)

    if of_pieces is None:
        of_pieces = _gather_pieces(scene, pieces, how, workers, both)
    from_points = gather(
        scene,
        pieces,
        view.position[points.rows],
        points.normals,
        how.pixel_rays,
        workers=workers,
        text="light on the pixels",
        progress=lambda finished, all_, text: both(finished, all_, text, len(pieces)),
    )
    if folder is not None:
        _save(folder, "points", from_points)
        _save(folder, "pieces", of_pieces)
        with replacing_path(folder / "complete") as path:
            path.write_text(json.dumps({"key": key, "quality": quality}), encoding="utf-8")
    return SimulatedRoom(setup, view, pieces, from_points, points, of_pieces, key)


def _gather_pieces(
    scene: Any, pieces: Pieces, how: Quality, workers: int | None, progress: Progress
) -> Any:
    """Gather at the pieces, CSR [p, columns]; rows of pieces inside other boxes stay empty."""
    from scipy.sparse import csr_matrix

    free = pieces.free
    gathered = gather(
        scene,
        pieces,
        pieces.middle[free],
        pieces.normals[free],
        how.piece_rays,
        workers=workers,
        text="light between surfaces",
        progress=progress,
    )
    spread = csr_matrix(
        (np.ones(len(free), np.float32), (free, np.arange(len(free)))), (len(pieces), len(free))
    )
    return (spread @ gathered).tocsr()


def _save(folder: Path, name: str, matrix: Any) -> None:
    for part in ("data", "indices", "indptr"):
        with replacing_path(folder / f"{name}-{part}.npy") as path:
            np.save(path, getattr(matrix, part))


def _load(folder: Path, name: str, columns: int) -> Any:
    """Read a matrix as memory maps, so that many processes share it and opening is quick."""
    from scipy.sparse import csr_matrix

    data, indices, indptr = (
        np.load(folder / f"{name}-{part}.npy", mmap_mode="r")
        for part in ("data", "indices", "indptr")
    )
    return csr_matrix((data, indices, indptr), (len(indptr) - 1, columns))
