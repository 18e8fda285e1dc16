"""Light of a box room in any hour: coefficients from sky and surfaces to points, with all bounces.

Every surface is cut into pieces. Rays from the middles of the pieces, and from the points that the
pixels see, go to the first surface or to the sky. This gives sparse coefficients of both for the
same columns: 2305 Reinhart patches of the sky, the open plain below the horizon, then the pieces.
Interreflection follows from the coefficients of the pieces by a fixed point.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, Room, SiteFile, SunSource
from fieldlum.optics import images, melanopic
from fieldlum.optics.projection import equirect_rays
from fieldlum.room.scene import trace
from fieldlum.room.scene.box_room import BoxScene
from fieldlum.room.scene.view import SceneView, SurfaceSamples, patch_rays, traced_view
from fieldlum.sky.daylight import Light
from fieldlum.sky.perez import reinhart_index, reinhart_patches
from fieldlum.sky.sun import horizontal_beam

SKY = len(reinhart_patches())
PLAIN = SKY  # column of the open plain
FIRST_PIECE = SKY + 1  # column of the first piece of surface
_RAYS_A_RUN = 200_000  # decides memory and speed only
_OFFSET_M = 1e-3  # points are this far above their surface, so that rays do not hit it
_SUB = 4  # squared: sample points of direct sun in a piece
_OTHER_FACE_M = 1000.0  # between faces for a search: larger than any room with its outdoors
_OTHERS = np.array([(1, 2), (0, 2), (0, 1)])  # the two axes across each axis
# Points that share light: those within two pixels on one face, which have the noise of 400 rays.
_SHARED, _SHARED_PX = 21, 2.0
# Colours of the surfaces: R, G, B of reflectance relative to each other. Chosen: a wooden floor,
# off-white walls and ceiling, grass and asphalt outdoors; others are grey.
_COLOURS = {
    "floor": (1.30, 0.93, 0.50),
    "wall": (1.04, 1.00, 0.88),
    "ceiling": (1.01, 1.00, 0.96),
    "ground": (0.96, 1.05, 0.65),
}
_COLOUR_BOUNCES = 6  # later ones change colours by up to 1.5 %, median 0.06 % (demo)
_MAX_REFLECTANCE = 0.95  # of one colour, so that bounces end; chosen
_TO_XYZ = images.rgb_to_xyz(images.RADIANCE_CHROMATICITIES)
_FROM_XYZ = np.linalg.inv(_TO_XYZ)
_Y = np.array(images.RADIANCE_Y, np.float32)  # of R, G and B


@dataclass(frozen=True, slots=True)
class Quality:
    """Sizes that decide accuracy and time.

    piece_m : size of the surface pieces in the room; pixel_rays, piece_rays : directions from each
    pixel's point and from each piece.
    """

    piece_m: float
    pixel_rays: int
    piece_rays: int


# Accuracy of "quick" against Radiance: docs/validation.md; the others are chosen around it.
QUALITIES = {
    "draft": Quality(0.8, 64, 128),
    "quick": Quality(0.4, 400, 1024),
    "paper": Quality(0.3, 1024, 2048),
}


def box_room(setup: SiteFile) -> Room:
    """Return the room of a site. Raises InputError for a site without a box room."""
    if setup.room is None or setup.room.kind != "box":
        expected, remedy = '[room] with kind = "box"', "state the geometry of the room in SITE.toml"
        raise InputError(setup.site.name, "the site has no box room", expected, remedy)
    return setup.room


# ----------------------------------------------------------------------------------------------
# pieces


@dataclass(frozen=True)
class Pieces:
    """The faces of all boxes, cut into rectangles.

    Face 6 b + 2 axis is that of box b at its low end of the axis, the next that at its high end.
    low, size [f, 2] m and counts [f, 2]: of each face along its two axes; first [f]: its first
    piece. Arrays over pieces [p]: axis and sign of the normal; reflectance; middle [p, 3] of the
    part that is not inside another box (NaN if all is). Sample points for direct sun: position
    [q, 3], piece [q], and share [q] of the piece's open part.
    """

    low: Floats
    size: Floats
    counts: Indices
    first: Indices
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    reflectance: Floats
    middle: Floats
    position: Floats
    piece: NDArray[np.int32]
    share: Floats

    def __len__(self) -> int:
        return len(self.axis)

    def at(self, face: Indices, position: Floats) -> Indices:
        """Return the indices [n] of the pieces that hold points on faces.

        face: index of each point's face [n]; position: of the points on the faces [n, 3] m, in room
        axes.
        """
        inside = np.take_along_axis(position, _OTHERS[face // 2 % 3], 1) - self.low[face]
        place = (inside / self.size[face] * self.counts[face]).astype(np.intp)
        a, b = np.clip(place, 0, self.counts[face] - 1).T
        return self.first[face] + a + self.counts[face, 0] * b


def cut_into_pieces(scene: BoxScene, piece_m: float) -> Pieces:
    """Cut the faces of all boxes into pieces with edges of about `piece_m` metres.

    Outside the room edges are up to 2 m, or 4 m on the ground.
    """
    faces = np.arange(6 * len(scene.boxes))
    axis, sign, others = faces // 2 % 3, faces % 2 * 2 - 1, _OTHERS[faces // 2 % 3]
    corners = np.stack((scene.low, scene.high)).repeat(6, axis=1)  # [2, f, 3]
    at_m = corners[faces % 2, faces, axis]
    low, high = (np.take_along_axis(corner, others, 1) for corner in corners)
    middle = corners.mean(axis=0)
    middle[faces, axis] = at_m + 0.01 * sign
    inside = ((middle > scene.shell[0]) & (middle < scene.shell[1])).all(axis=1)
    outside_m = np.clip(np.sqrt((high - low).prod(axis=1)) / 6.0, piece_m, max(piece_m, 2.0))
    step = np.where(inside, piece_m, outside_m)
    ground = np.isin(faces // 6, scene.of_kind("ground"))
    step[ground] = np.where((axis == 2) & (sign > 0), 4.0, np.inf)[ground]  # no ray meets its sides
    # a reveal has one side of its pane in each piece
    minimum = np.where(np.isin(faces // 6, scene.of_kind("wall")), 2, 1)[:, None]
    counts = np.maximum(np.round((high - low) / step[:, None]), minimum).astype(np.intp)
    number = counts.prod(axis=1)
    first, of = np.cumsum(number) - number, faces.repeat(number)
    row, column = np.divmod(np.arange(len(of)) - first[of], counts[of, 0])
    sub = (np.arange(_SUB) + 0.5) / _SUB
    inner = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)
    place = np.stack((column, row), axis=1)[:, None] + inner  # [p, points, 2]
    place = low[of, None] + place / counts[of, None] * (high - low)[of, None]
    position = np.empty((*place.shape[:2], 3))
    np.put_along_axis(position, others[of, None], place, 2)
    position[np.arange(len(of)), :, axis[of]] = at_m[of, None]
    position, piece = position.reshape(-1, 3), np.arange(len(of)).repeat(_SUB**2).astype(np.int32)
    free = _is_free(scene, position, axis[of][piece], sign[of][piece])
    position, piece = position[free], piece[free]
    count = np.bincount(piece, minlength=len(of))
    total = np.stack([np.bincount(piece, position[:, k], len(of)) for k in range(3)], axis=1)
    with np.errstate(invalid="ignore"):
        middle = total / count[:, None]
    return Pieces(
        low,
        size=high - low,
        counts=counts,
        first=first,
        axis=axis[of].astype(np.int8),
        sign=sign[of].astype(np.int8),
        reflectance=scene.reflectance[of // 6],
        middle=middle,
        position=position,
        piece=piece,
        share=1.0 / count[piece],
    )


def _is_free(
    scene: BoxScene, position: Floats, axis: NDArray[np.integer], sign: NDArray[np.integer]
) -> Mask:
    """Return which points [q, 3] on faces of an axis and sign [q] no other box covers, [q]."""
    probe = position.copy()
    probe[np.arange(len(probe)), axis] += sign * _OFFSET_M
    free = np.ones(len(probe), bool)
    for box in scene.boxes:
        free &= ~((probe > box.low) & (probe < box.high)).all(axis=1)
    return free


# ----------------------------------------------------------------------------------------------
# coefficients


def _hemispheres(normal: Floats, rays: int, rng: np.random.Generator) -> Floats:
    """Return cosine-weighted directions in the hemispheres of m normals, [m rays, 3].

    Roberts' R2 sequence, which fills the square evenly at any count, shifted at random for each
    point (Cranley and Patterson 1976), mapped to the disc, then to the sphere (Malley).
    normal: [m, 3]; rays: directions for each.
    """
    steps = np.array([0.7548776662466927, 0.5698402909980532])  # 1/g, 1/g^2 with g^3 = g + 1
    square = (np.arange(rays)[None, :, None] * steps + rng.random((len(normal), 1, 2))) % 1.0
    radius, turn = np.sqrt(square[..., :1]), 2.0 * np.pi * square[..., 1:]
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(helper, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)[:, None]
    toward = radius * (np.cos(turn) * across[:, None] + np.sin(turn) * up)
    toward += np.sqrt(1.0 - square[..., :1]) * normal[:, None]
    return toward.reshape(-1, 3)


def _form_factors(
    scene: BoxScene, pieces: Pieces, position: Floats, normal: Floats, rays: int, workers: int
) -> Any:
    """Return the irradiance at points [m, 3] per luminance of each column, CSR [m, columns].

    position, normal: of the points [m, 3]; columns: sky patches, the ground outside and `pieces`;
    workers: threads. Rows sum to at most pi. rays : directions from each point, the same in every
    run.
    """
    from scipy.sparse import csr_matrix, vstack

    step, columns = max(1, _RAYS_A_RUN // rays), FIRST_PIECE + len(pieces)

    def gathered(start: int) -> Any:
        """Return what the rays of points from `start` on end at, as weights [points, columns].

        Columns: sky patches, the ground outside and pieces of surfaces; a row sums up to pi, the
        irradiance by a luminance of 1.
        """
        origin, up = position[start : start + step], normal[start : start + step]
        toward = _hemispheres(up, rays, np.random.default_rng(start))
        rows, at, weights = [], [], []
        for e in trace.ray_ends(scene, (origin + up * _OFFSET_M).repeat(rays, axis=0), toward):
            sky = reinhart_index(e.toward @ scene.turn)
            face = 6 * e.box + 2 * e.axis + (e.sign > 0)
            piece = FIRST_PIECE + pieces.at(np.maximum(face, 0), e.position)
            outdoors = np.where(e.toward[:, 2] > 0, sky, PLAIN)
            at.append(np.where(e.box >= 0, piece, outdoors))
            rows.append(e.row // rays)
            weights.append(e.weight.astype(np.float32) * np.float32(np.pi / rays))
        where = (np.concatenate(rows), np.concatenate(at))
        return csr_matrix((np.concatenate(weights), where), (len(origin), columns))

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(gathered, range(0, len(position), step)))
    return vstack(parts, format="csr") if parts else csr_matrix((0, columns), dtype=np.float32)


def joined(s: SurfaceSamples) -> tuple[SurfaceSamples, NDArray[np.int64]]:
    """Join the samples of one face in a pixel to the middle one, with the sum of their weights.

    s: m samples. Return the k joined ones, and a number for the face of each [k]; those of faces
    that face the same way are near each other.
    """
    side = s.axis.astype(np.int64) * 2 + (s.sign > 0)
    code = (side * 10_000 + s.box) * 2 + s.mirrored
    key = s.pixel * (int(code.max(initial=0)) + 1) + code
    order = np.argsort(key, kind="stable")
    _, start, count = np.unique(key[order], return_index=True, return_counts=True)
    rows = order[start + count // 2]
    weight = np.add.reduceat(s.weight[order], start) if len(start) else s.weight
    return SurfaceSamples._make(v[rows] for v in s)._replace(weight=weight), code[rows]


def near_light(
    places: tuple[Floats, NDArray[np.int64]],
    points: tuple[Floats, NDArray[np.int64]],
    count: int,
    reach_m: Floats,
) -> Any:
    """Return the matrix [n, m] that averages the light of points at n places; its rows sum to 1.

    places, points: positions [n, 3] and numbers of faces, as `joined` returns them. A place has
    the light of the `count` nearest points of its face, with less weight beyond `reach_m` [n]; of a
    face without a point, that of the next face that faces the same way.
    """
    from scipy.sparse import csr_matrix
    from scipy.spatial import KDTree

    # the number of the face is a fourth coordinate: points of other faces are far away
    at = np.column_stack((places[0], places[1] * _OTHER_FACE_M))
    lit = np.column_stack((points[0], points[1] * _OTHER_FACE_M))
    away, index = KDTree(lit).query(at, k=min(count, len(lit)))
    away, index = np.reshape(away, (len(at), -1)), np.reshape(index, (len(at), -1))
    weight = np.exp((away[:, :1] ** 2 - away**2) / reach_m[:, None] ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    where = (np.arange(len(at)).repeat(index.shape[1]), index.ravel())
    return csr_matrix((weight.ravel().astype(np.float32), where), (len(at), len(lit)))


# ----------------------------------------------------------------------------------------------
# light


@dataclass(frozen=True)
class Rendering:
    """Pictures of n moments, without the sun disc.

    luminance_cdm2 : [n, H, W]; patch_cdm2 : [n, H, W] of direct sun, with the fewer rays of
    `scene.sun_patches`; disc_lx : [n] on a plane normal to the sun at the camera; visible_fraction
    : [n] of the disc; light : as requested; points_lx : [m, n] irradiance of the pixels' points
    without direct sun; colour : [n, H, W, 3] R, G, B for a luminance of 1, None for grey.
    """

    luminance_cdm2: Floats32
    patch_cdm2: Floats32
    disc_lx: Floats
    visible_fraction: Floats
    light: Light
    points_lx: Floats32
    colour: Floats32 | None = None


@dataclass(frozen=True)
class LitRoom:
    """A room whose light can be computed for any sky and sun; `lit_room` creates it.

    samples, faces : the m points that the pixels show, as `joined` returns them. point_coefficients
    : daylight coefficients, CSR [m, columns]: irradiance [lx] of a point per luminance [cd/m2] of a
    sky patch, of the plain, or of one of p surface pieces, in this order of columns;
    outdoor_coefficients, bounce_coefficients : the same of the pieces, of sky and plain and of
    pieces, CSR [p, columns]. smooth : CSR [m, m], means over neighbours on one face; to_pixels :
    CSR [H W, m], luminance of a pixel per irradiance of a point.
    """

    setup: SiteFile
    view: SceneView
    pieces: Pieces
    samples: SurfaceSamples
    faces: NDArray[np.int64]
    point_coefficients: Any
    smooth: Any
    to_pixels: Any
    outdoor_coefficients: Any
    bounce_coefficients: Any

    @cached_property
    def _sun_points(self) -> tuple[trace.SunPoints, trace.SunPoints, trace.SunPoints]:
        """Points of the pictures' direct sun, those of a model's patches, and the pieces'."""
        room, p, rays = box_room(self.setup), self.pieces, patch_rays(self.view.height)
        height, heading_deg = self.view.height, self.view.heading_deg
        shown = traced_view(room, height, heading_deg, rays + 1).sun_points()
        given = traced_view(room, height, heading_deg, rays).sun_points()
        axis, sign = p.axis[p.piece], p.sign[p.piece]
        lit = trace.sun_points(shown.scene, p.position, axis, sign, p.share, p.piece, len(p))
        return shown, given, lit

    def render(self, light: Light, *, coloured: bool = False) -> Rendering:
        """Render all moments of `light` at once; memory grows with their number.

        coloured : also the colours, which do not change the luminance.
        """
        n, height = len(light), self.view.height
        toward, direct_lx = self.view.scene.to_room(light.apparent_sun_direction), light.direct_lx
        shown, given, sunlit = (
            np.zeros((n, points.targets), np.float32) for points in self._sun_points
        )
        lit = direct_lx > 0
        for out, points in zip((shown, given, sunlit), self._sun_points, strict=True):
            out[lit] = points.direct(toward[lit]) * direct_lx[lit, None]
        outdoors = np.zeros((FIRST_PIECE, n), np.float32)
        outdoors[:SKY], outdoors[PLAIN] = light.sky_cdm2.T, light.sky.ground_cdm2
        points_lx = self.smooth @ (self.point_coefficients @ self.columns(outdoors, sunlit.T))
        out = np.ascontiguousarray((self.to_pixels @ points_lx).T, np.float32) + shown
        sky = self.view.sky.ravel()
        seen = np.flatnonzero(sky)
        rays = equirect_rays(height, 2 * height, self.view.heading_deg).reshape(-1, 3)
        seen_cdm2 = light.sky_at(rays[seen]) * sky[seen]
        out[:, seen] += seen_cdm2
        out += light.sky.ground_cdm2[:, None].astype(np.float32) * self.view.plain.ravel()
        colour = None
        if coloured:
            colour = self._colour(light, outdoors, sunlit.T, shown, seen_cdm2)
            colour = colour.reshape(n, height, -1, 3)
        visible, through = trace.disc_visibility(self.view.scene, toward)
        return Rendering(
            luminance_cdm2=out.reshape(n, height, -1),
            patch_cdm2=given.reshape(n, height, -1),
            disc_lx=direct_lx * visible * through,
            visible_fraction=visible,
            light=light,
            points_lx=points_lx,
            colour=colour,
        )

    def _colour(
        self,
        light: Light,
        outdoors: Floats32,
        sunlit: Floats32,
        shown: Floats32,
        seen_cdm2: Floats32,
    ) -> Floats32:
        """Return R, G, B of all pixels for a luminance of 1, [n, pixels, 3].

        outdoors [FIRST_PIECE, n], sunlit [p, n], shown [n, pixels] : as in `render`; seen_cdm2 [n,
        s] : of the sky through glass. Each colour bounces by itself; glass is neutral.
        """
        clear, patches = light.sky.clearness[:, None], reinhart_patches()
        sun = _rgb(melanopic.sun_xyz(light.apparent_altitude_deg))  # [n, 3]
        sky = _rgb(melanopic.sky_xyz(outdoors[:SKY].T, clear))  # [n, SKY, 3]
        share, seen = self.view.sky.ravel(), np.flatnonzero(self.view.sky)
        seen_rgb = seen_cdm2[..., None] * _rgb(melanopic.sky_xyz(seen_cdm2 / share[seen], clear))
        weight = patches.solid_angles_sr * patches.directions[:, 2]
        beam_lx = horizontal_beam(light.direct_lx, light.sun_altitude_deg)
        ground = np.einsum("s,sn,nsc->nc", weight, outdoors[:SKY], sky) + beam_lx[:, None] * sun
        ground = ground * _tint("ground")
        ground *= (light.sky.ground_cdm2 / np.maximum(ground @ _Y, 1e-9))[:, None]
        of_piece, of_pixel = self._tints
        out = np.empty((*shown.shape, 3), np.float32)
        parts = [np.vstack((outdoors[:SKY] * sky[..., c].T, ground[None, :, c])) for c in range(3)]
        first = np.hstack([sunlit * sun[:, c] for c in range(3)])
        tint = of_piece.repeat(len(light), axis=1)
        columns = self.columns(np.hstack(parts).astype(np.float32), first, tint, _COLOUR_BOUNCES)
        by_colour = np.split(self.pixels_cdm2(columns).T, 3)
        for c, bounced in enumerate(by_colour):
            lit = bounced + shown * sun[:, c, None]
            out[..., c] = lit * of_pixel[:, c] + ground[:, c, None] * self.view.plain.ravel()
            out[:, seen, c] += seen_rgb[..., c]
        out /= np.maximum(out @ _Y, 1e-9)[..., None]
        return out

    @cached_property
    def _tints(self) -> tuple[Floats32, Floats32]:
        """Colours of the pieces [p, 3] and, averaged over the surfaces in each, of pixels."""
        scene, s, p = self.view.scene, self.view.samples, self.pieces
        tints = np.array([_tint(box.kind) for box in scene.boxes])
        highest = _MAX_REFLECTANCE / np.maximum(scene.reflectance, 1e-9)
        tints = np.minimum(tints, np.maximum(highest, 1.0)[:, None]).astype(np.float32)
        weight, pixels = s.weight * scene.reflectance[s.box], 2 * self.view.height**2
        sums = [np.bincount(s.pixel, weight * tints[s.box, c], pixels) for c in range(3)]
        of_pixel = np.stack(sums, axis=1).astype(np.float32)
        of_pixel /= np.maximum(of_pixel @ _Y, 1e-9)[:, None]
        faces = np.arange(len(p.counts)).repeat(p.counts.prod(axis=1))
        return tints[faces // 6], of_pixel

    def columns(
        self,
        outdoors: Floats32,
        first_lx: Floats32 | float = 0.0,
        tint: Floats32 | float = 1.0,
        bounces: int = 0,
    ) -> Floats32:
        """Return the luminance of sky and plain, then of pieces after all bounces, [columns, n].

        outdoors: luminance of sky and plain [FIRST_PIECE, n] cd/m2; first_lx: illuminance of the
        pieces by direct sun [p, n]; tint: factor on their reflectances [p, n]; bounces: their
        number, 0 for all.
        """
        reflect = (self.pieces.reflectance[:, None] * tint / np.pi).astype(np.float32)
        first = self.outdoor_coefficients @ outdoors + first_lx
        pieces = reflect * first
        for _ in range(bounces or self._passes):
            pieces = reflect * (first + self.bounce_coefficients @ pieces)
        return np.concatenate((outdoors, pieces))

    def pixels_cdm2(self, columns: Floats32) -> Floats32:
        """Return the luminance of surfaces without their direct sunlight, in all pixels.

        columns: the result of `columns`, [columns, n] for n moments; it includes sunlight after
        bounces. Sky and plain that are seen through windows are not added. The result is [H W, n],
        cd/m2.
        """
        return self.to_pixels @ (self.smooth @ (self.point_coefficients @ columns))

    @cached_property
    def _passes(self) -> int:
        """Number of bounces after which an evenly lit room changes by less than 1e-4.

        It is the same for every hour, whatever other hours are in the same block.
        """
        reflect = (self.pieces.reflectance / np.pi).astype(np.float32)
        pieces = reflect
        for k in range(1, 60):
            after = reflect * (1 + self.bounce_coefficients @ pieces)
            if float((after - pieces).max()) < 1e-4 * float(after.mean()):
                return k
            pieces = after
        return 60

    def as_panorama(self, rendering: Rendering, k: int) -> Panorama:
        """Return moment `k` (from 0) of a rendering as a panorama, with its visible sun apart."""
        about = {"made_by": "fieldlum simulate", "room": self.setup.site.name}
        light, sun, visible = rendering.light, None, float(rendering.visible_fraction[k])
        if 0.0 < visible < 1.0:
            scene = self.view.scene
            glass = trace.disc_glass(scene, scene.to_room(light.apparent_sun_direction[k]))
            about[trace.DISC_RAYS] = "".join("1" if ray else "0" for ray in glass > 0)
        if rendering.disc_lx[k] > 0:
            sun = SunSource(
                altitude_deg=float(light.apparent_altitude_deg[k]),
                azimuth_deg=float(light.sun_azimuth_deg[k]),
                normal_illuminance_lx=float(rendering.disc_lx[k]),
                visible_fraction=visible,
                origin="rendering",
            )
        heading, t_utc, rgb = self.view.heading_deg, light.t_utc[k], None
        luminance = rendering.luminance_cdm2[k]
        if rendering.colour is not None:
            rgb = rendering.colour[k] * luminance[..., None] / images.RADIANCE_LM_PER_W
            of_rgb = (melanopic.MELANOPIC_FROM_XYZ @ _TO_XYZ, np.eye(3), melanopic.BY_CHART[1])
            about[melanopic.ATTRIBUTE] = melanopic.attribute_text(*of_rgb)
        return Panorama(luminance, heading, t_utc=t_utc, sun=sun, rgb=rgb, attributes=about)


def _rgb(xyz: Floats) -> Floats32:
    """Return R, G, B [..., 3] of Radiance's primaries; a colour beyond them is cut off."""
    return np.maximum(xyz @ _FROM_XYZ.T, 0.0).astype(np.float32)


def _tint(kind: str) -> Floats32:
    tint = np.array(_COLOURS.get(kind, (1.0, 1.0, 1.0)), np.float32)
    tint /= tint @ _Y
    return tint


def lit_room(
    setup: SiteFile, *, height: int = 115, quality: str = "quick", workers: int | None = None
) -> LitRoom:
    """Trace the coefficients of a box room; the same room gives the same result always.

    height : rows of the panorama; quality : a key of `QUALITIES`; workers : threads, by default one
    for each core, at most 8. Raises InputError for a site without a box room and for an impossible
    room.
    """
    from scipy.sparse import csr_matrix

    how, heading = QUALITIES[quality], setup.camera.heading_deg % 360.0
    view = traced_view(box_room(setup), height, heading)
    scene, pieces = view.scene, cut_into_pieces(view.scene, how.piece_m)
    threads = min(workers or os.cpu_count() or 1, 8)
    s, faces = joined(view.samples)
    m, free = len(s.pixel), np.flatnonzero(np.isfinite(pieces.middle[:, 0]))
    normals = np.eye(3)[pieces.axis[free]] * pieces.sign[free, None]
    gathered = _form_factors(scene, pieces, pieces.middle[free], normals, how.piece_rays, threads)
    spread = csr_matrix(
        (np.ones(len(free), np.float32), (free, np.arange(len(free)))), (len(pieces), len(free))
    )
    of_pieces = (spread @ gathered).tocsr()
    normals = np.eye(3)[s.axis] * s.sign[:, None]
    point_coefficients = _form_factors(scene, pieces, s.position, normals, how.pixel_rays, threads)
    reach_m = np.linalg.norm(s.position - scene.camera_m, axis=1) * np.pi / height * _SHARED_PX
    smooth = near_light((s.position, faces), (s.position, faces), _SHARED, reach_m)
    luminance = (s.weight * scene.reflectance[s.box] / np.pi).astype(np.float32)
    to_pixels = csr_matrix((luminance, (s.pixel, np.arange(m))), (2 * height**2, m))
    return LitRoom(
        setup,
        view,
        pieces,
        s,
        faces,
        point_coefficients=point_coefficients,
        smooth=smooth,
        to_pixels=to_pixels,
        outdoor_coefficients=of_pieces[:, :FIRST_PIECE].tocsr(),
        bounce_coefficients=of_pieces[:, FIRST_PIECE:].tocsr(),
    )
