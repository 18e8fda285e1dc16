"""Compute a box room's light in any hour: daylight coefficients of its points, with all bounces.

Every surface is cut into pieces. Rays from the middles of the pieces, and from the points that the
pixels see, go to the first surface or to the sky. This gives sparse coefficients of both for the
same columns: 2305 Reinhart patches of the sky, the open plain below the horizon, then the pieces.
Interreflection follows from the coefficients of the pieces, bounce by bounce.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, vstack

from fieldlum.core.arrays import Floats, Floats32, Indices, Ints8, Ints32, Ints64
from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, Room, SiteFile, SunSource
from fieldlum.optics import images, melanopic, projection
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
_SUB = 4  # in each direction of a piece, sample points of direct sun
_OTHER_FACE_M = 1000.0  # between faces for a search: larger than any room with its outdoors
_OTHERS = np.array([(1, 2), (0, 2), (0, 1)])  # the two axes across each axis
# Number of neighbouring points whose light is averaged, and their reach in pixels: each point alone
# has the noise of 400 rays.
_SHARED, _SHARED_PX = 21, 2.0
# Colours of the surfaces: R, G, B of reflectance relative to each other. Chosen: a wooden floor,
# off-white walls and ceiling, grass and asphalt outdoors; others are grey.
_COLOURS = {
    "floor": (1.30, 0.93, 0.50),
    "wall": (1.04, 1.00, 0.88),
    "ceiling": (1.01, 1.00, 0.96),
    "ground": (0.96, 1.05, 0.65),
}
_COLOUR_BOUNCES = 6  # later bounces change colours by up to 1.5 %, median 0.06 % (demo)
_MAX_REFLECTANCE = 0.95  # of one colour, so that bounces end; chosen
_TO_XYZ = images.rgb_to_xyz(images.RADIANCE_CHROMATICITIES)
_FROM_XYZ = np.linalg.inv(_TO_XYZ)
_Y = np.array(images.RADIANCE_Y, np.float32)  # luminance of R, G and B


class Quality(NamedTuple):
    """Sizes that decide accuracy and time of a rendering.

    piece_m : length of the surface pieces' edges in the room; pixel_rays, piece_rays : number of
    rays from each pixel's point and from each piece.
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
    low, size [f, 2] m: lower ends and lengths of each of f faces along its two axes, those across
    its normal in the order x, y, z; counts [f, 2]: of its pieces along them; first [f]: index of
    its first piece. For each of p pieces: axis (0 to 2) and sign (-1 or 1) of the normal;
    reflectance; middle [p, 3] m of the part that is not inside another box (NaN if all is). For
    each of q sample points for direct sun: position [q, 3] m; piece [q]: index of its piece; share
    [q]: 1 over the number of that piece's points. Positions are in room axes.
    """

    low: Floats
    size: Floats
    counts: Indices
    first: Indices
    axis: Ints8
    sign: Ints8
    reflectance: Floats
    middle: Floats
    position: Floats
    piece: Ints32
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
        column, row = np.clip(place, 0, self.counts[face] - 1).T
        return self.first[face] + column + self.counts[face, 0] * row


def cut_into_pieces(scene: BoxScene, piece_m: float) -> Pieces:
    """Cut the faces of all boxes into pieces with edges of about `piece_m` metres.

    Outside the room edges are up to 2 m, or 4 m on the ground.
    """
    faces = np.arange(6 * len(scene.boxes))  # as `Pieces` numbers them
    axis, sign = faces // 2 % 3, faces % 2 * 2 - 1  # of their normals
    corners = np.stack((scene.low, scene.high)).repeat(6, axis=1)  # [2, f, 3]
    at_m = corners[faces % 2, faces, axis]  # coordinate of each face along its normal
    low, high = (np.take_along_axis(corner, _OTHERS[axis], 1) for corner in corners)  # [f, 2]
    middle = corners.mean(axis=0)
    middle[faces, axis] = at_m + 0.01 * sign
    counts = _piece_counts(scene, middle, high - low, piece_m)
    number = counts.prod(axis=1)
    first, face = np.cumsum(number) - number, faces.repeat(number)  # face: of each piece
    row, column = np.divmod(np.arange(len(face)) - first[face], counts[face, 0])
    sub = (np.arange(_SUB) + 0.5) / _SUB
    inner = np.stack(np.meshgrid(sub, sub), axis=-1).reshape(-1, 2)  # sample points of a piece
    place = np.stack((column, row), axis=1)[:, None] + inner  # [p, points, 2]
    place = low[face, None] + place / counts[face, None] * (high - low)[face, None]
    position, piece = _open_points(scene, place, axis[face], sign[face], at_m[face])
    count = np.bincount(piece, minlength=len(face))
    total = np.stack([np.bincount(piece, position[:, k], len(face)) for k in range(3)], axis=1)
    with np.errstate(invalid="ignore"):
        middle = total / count[:, None]
    return Pieces(
        low,
        size=high - low,
        counts=counts,
        first=first,
        axis=axis[face].astype(np.int8),
        sign=sign[face].astype(np.int8),
        reflectance=scene.reflectance[face // 6],
        middle=middle,
        position=position,
        piece=piece,
        share=1.0 / count[piece],
    )


def _piece_counts(scene: BoxScene, middle: Floats, size: Floats, piece_m: float) -> Indices:
    """Return the number of pieces of each face along its two axes, [f, 2].

    middle: of the faces, slightly in front of them [f, 3] m; size: along their two axes [f, 2] m;
    piece_m: length of a piece's edges in the room.
    """
    faces = np.arange(len(size))
    inside = ((middle > scene.shell[0]) & (middle < scene.shell[1])).all(axis=1)
    outside_m = np.clip(np.sqrt(size.prod(axis=1)) / 6.0, piece_m, max(piece_m, 2.0))
    edge_m = np.where(inside, piece_m, outside_m)
    ground = np.isin(faces // 6, scene.of_kind("ground"))
    edge_m[ground] = np.where(faces % 6 == 5, 4.0, np.inf)[ground]  # no ray meets all but its top
    # a reveal has one side of its pane in each piece
    minimum = np.where(np.isin(faces // 6, scene.of_kind("wall")), 2, 1)[:, None]
    return np.maximum(np.round(size / edge_m[:, None]), minimum).astype(np.intp)


def _open_points(
    scene: BoxScene, place: Floats, axis: Indices, sign: Indices, at_m: Floats
) -> tuple[Floats, Ints32]:
    """Return the points of p pieces that no box covers, [q, 3] m, and the piece of each, [q].

    place: of s points in each piece along the two axes of its face [p, s, 2] m; axis, sign: of the
    pieces' normals [p]; at_m: their coordinates along that axis [p].
    """
    position = np.empty((*place.shape[:2], 3))
    np.put_along_axis(position, _OTHERS[axis][:, None], place, 2)
    position[np.arange(len(axis)), :, axis] = at_m[:, None]
    position, piece = position.reshape(-1, 3), np.arange(len(axis)).repeat(place.shape[1])
    above = position.copy()
    above[np.arange(len(above)), axis[piece]] += sign[piece] * _OFFSET_M
    is_open = np.ones(len(above), bool)
    for box in scene.boxes:
        is_open &= ~((above > box.low) & (above < box.high)).all(axis=1)
    return position[is_open], piece[is_open].astype(np.int32)


# ----------------------------------------------------------------------------------------------
# coefficients


def _hemispheres(normal: Floats, rays: int, rng: np.random.Generator) -> Floats:
    """Return cosine-weighted directions in the hemispheres of m normals, [m rays, 3].

    They are Roberts' R2 sequence, which fills the square evenly at any count, shifted at random for
    each point (Cranley and Patterson 1976), mapped to the disc, then to the sphere (Malley).
    normal: [m, 3]; rays: number of directions for each.
    """
    steps = np.array([0.7548776662466927, 0.5698402909980532])  # 1/g, 1/g^2 with g^3 = g + 1
    square = (np.arange(rays)[None, :, None] * steps + rng.random((len(normal), 1, 2))) % 1.0
    radius, turn = np.sqrt(square[..., :1]), 2.0 * np.pi * square[..., 1:]
    side, up = projection.across_axes(normal)
    toward = radius * (np.sin(turn) * up[:, None] - np.cos(turn) * side[:, None])
    toward += np.sqrt(1.0 - square[..., :1]) * normal[:, None]
    return toward.reshape(-1, 3)


def _form_factors(
    scene: BoxScene, pieces: Pieces, position: Floats, normal: Floats, rays: int
) -> Any:
    """Return the irradiance at m points per luminance of each column, CSR [m, columns].

    position, normal: of the points [m, 3]; columns: sky patches, the open plain and `pieces`; rays:
    number of directions from each point, the same in every run. Rows sum to at most pi, the
    irradiance by a luminance of 1 all around. There is one thread for each core, at most 8.
    """
    step, columns = max(1, _RAYS_A_RUN // rays), FIRST_PIECE + len(pieces)

    def gathered(start: int) -> Any:
        """Return the rows of the `step` points from index `start` on, CSR [points, columns].

        At the end there can be fewer. The random shift depends on `start` only.
        """
        origin, up = position[start : start + step], normal[start : start + step]
        toward = _hemispheres(up, rays, np.random.default_rng(start))
        rows, column, weights = [], [], []
        for e in trace.ray_ends(scene, (origin + up * _OFFSET_M).repeat(rays, axis=0), toward):
            sky = reinhart_index(e.toward @ scene.turn)
            face = 6 * e.box + 2 * e.axis + (e.sign > 0)
            piece = FIRST_PIECE + pieces.at(np.maximum(face, 0), e.position)
            outdoors = np.where(e.toward[:, 2] > 0, sky, PLAIN)
            column.append(np.where(e.box >= 0, piece, outdoors))
            rows.append(e.row // rays)
            weights.append(e.weight.astype(np.float32) * np.float32(np.pi / rays))
        where = (np.concatenate(rows), np.concatenate(column))
        return csr_matrix((np.concatenate(weights), where), (len(origin), columns))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        parts = list(pool.map(gathered, range(0, len(position), step)))
    return vstack(parts, format="csr") if parts else csr_matrix((0, columns), dtype=np.float32)


def joined(s: SurfaceSamples) -> tuple[SurfaceSamples, Ints64]:
    """Return k samples, one for each face in each pixel, and a number for the face of each, [k].

    s: m samples. Of those on one face in a pixel the middle one remains, with the sum of their
    weights. Samples seen in a mirror and directly are on different faces. The numbers of faces that
    face the same way are near each other.
    """
    side = s.axis.astype(np.int64) * 2 + (s.sign > 0)
    face = (side * 10_000 + s.box) * 2 + s.mirrored
    key = s.pixel * (int(face.max(initial=0)) + 1) + face
    order = np.argsort(key, kind="stable")
    _, start, count = np.unique(key[order], return_index=True, return_counts=True)
    rows = order[start + count // 2]
    weight = np.add.reduceat(s.weight[order], start) if len(start) else s.weight
    return SurfaceSamples._make(v[rows] for v in s)._replace(weight=weight), face[rows]


def near_light(
    places: tuple[Floats, Ints64], points: tuple[Floats, Ints64], count: int, reach_m: Floats
) -> Any:
    """Return the matrix that averages the light of m points at n places, CSR [n, m], rows sum to 1.

    places, points: positions [n, 3], [m, 3] m, and numbers of their faces by `joined` [n], [m]. A
    place has the light of the `count` nearest points of its face, with less weight beyond `reach_m`
    [n]; on a face without a point, that of the next face that faces the same way.
    """
    from scipy.spatial import KDTree

    # the number of the face is a fourth coordinate: points of other faces are far away
    at = np.column_stack((places[0], places[1] * _OTHER_FACE_M))
    lit = np.column_stack((points[0], points[1] * _OTHER_FACE_M))
    away_m, index = KDTree(lit).query(at, k=min(count, len(lit)))
    away_m, index = np.reshape(away_m, (len(at), -1)), np.reshape(index, (len(at), -1))
    weight = np.exp((away_m[:, :1] ** 2 - away_m**2) / reach_m[:, None] ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    where = (np.arange(len(at)).repeat(index.shape[1]), index.ravel())
    return csr_matrix((weight.ravel().astype(np.float32), where), (len(at), len(lit)))


# ----------------------------------------------------------------------------------------------
# light


class Rendering(NamedTuple):
    """Pictures of n moments, without the sun disc.

    luminance_cdm2 : [n, H, W]; patch_cdm2 : [n, H, W] of direct sun only, with fewer rays for each
    pixel, those of `scene.sun_patches`; disc_lx : [n] illuminance on a plane normal to the sun at
    the camera; visible_fraction : [n] of the sun disc; light : of sky and sun, as requested;
    points_lx : [m, n] illuminance of the pixels' points without direct sun; colour : [n, H, W, 3]
    R, G, B for a luminance of 1, None for grey.
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
    faces: Ints64
    point_coefficients: Any
    smooth: Any
    to_pixels: Any
    outdoor_coefficients: Any
    bounce_coefficients: Any

    @cached_property
    def _sun_points(self) -> tuple[trace.SunPoints, trace.SunPoints, trace.SunPoints]:
        """Points for the direct sun of the pictures, of the sun patches, and of the pieces."""
        room, p, rays = box_room(self.setup), self.pieces, patch_rays(self.view.height)
        height, heading_deg = self.view.height, self.view.heading_deg
        of_pictures = traced_view(room, height, heading_deg, rays + 1).sun_points()
        of_patches = traced_view(room, height, heading_deg, rays).sun_points()
        axis, sign, scene = p.axis[p.piece], p.sign[p.piece], self.view.scene
        of_pieces = trace.sun_points(scene, p.position, axis, sign, p.share, p.piece, len(p))
        return of_pictures, of_patches, of_pieces

    def render(self, light: Light, *, coloured: bool = False) -> Rendering:
        """Render all moments of `light` at once; memory grows with their number.

        coloured : also the colours, which do not change the luminance. The first call traces the
        points of the direct sun, which are kept.
        """
        n, height = len(light), self.view.height
        toward, direct_lx = self.view.scene.to_room(light.apparent_sun_direction), light.direct_lx
        direct_sun = [np.zeros((n, points.targets), np.float32) for points in self._sun_points]
        lit = direct_lx > 0
        for out, points in zip(direct_sun, self._sun_points, strict=True):
            out[lit] = points.direct(toward[lit]) * direct_lx[lit, None]
        sunlit_cdm2, patch_cdm2, pieces_lx = direct_sun
        outdoors = np.zeros((FIRST_PIECE, n), np.float32)
        outdoors[:SKY], outdoors[PLAIN] = light.sky_cdm2.T, light.sky.ground_cdm2
        points_lx = self.smooth @ (self.point_coefficients @ self.columns(outdoors, pieces_lx.T))
        out = np.ascontiguousarray((self.to_pixels @ points_lx).T, np.float32) + sunlit_cdm2
        sky = self.view.sky.ravel()
        seen = np.flatnonzero(sky)
        rays = projection.equirect_rays(height, 2 * height, self.view.heading_deg).reshape(-1, 3)
        seen_cdm2 = light.sky_at(rays[seen]) * sky[seen]
        out[:, seen] += seen_cdm2
        out += light.sky.ground_cdm2[:, None].astype(np.float32) * self.view.plain.ravel()
        colour = None
        if coloured:
            colour = self._colour(light, outdoors, pieces_lx.T, sunlit_cdm2, seen_cdm2)
            colour = colour.reshape(n, height, -1, 3)
        visible, transmittance = trace.disc_visibility(self.view.scene, toward)
        return Rendering(
            luminance_cdm2=out.reshape(n, height, -1),
            patch_cdm2=patch_cdm2.reshape(n, height, -1),
            disc_lx=direct_lx * visible * transmittance,
            visible_fraction=visible,
            light=light,
            points_lx=points_lx,
            colour=colour,
        )

    def _colour(
        self,
        light: Light,
        outdoors: Floats32,
        pieces_lx: Floats32,
        sunlit_cdm2: Floats32,
        seen_cdm2: Floats32,
    ) -> Floats32:
        """Return R, G, B of all pixels for a luminance of 1, [n, pixels, 3].

        outdoors : luminance of sky and plain [FIRST_PIECE, n] cd/m2; pieces_lx : direct sun on the
        pieces [p, n]; sunlit_cdm2 : luminance of the pixels' surfaces by direct sun [n, pixels];
        seen_cdm2 : of the sky through glass, in the pixels that show it [n, s]. Light of R, G and B
        bounces separately; glass is neutral.
        """
        clear, patches = light.sky.clearness[:, None], reinhart_patches()
        sun = _rgb(melanopic.sun_xyz(light.apparent_altitude_deg))  # [n, 3]
        sky = _rgb(melanopic.sky_xyz(outdoors[:SKY].T, clear))  # [n, SKY, 3]
        share, seen = self.view.sky.ravel(), np.flatnonzero(self.view.sky)
        seen_rgb = seen_cdm2[..., None] * _rgb(melanopic.sky_xyz(seen_cdm2 / share[seen], clear))
        cosine_sr = patches.solid_angles_sr * patches.directions[:, 2]
        beam_lx = horizontal_beam(light.direct_lx, light.sun_altitude_deg)
        ground = np.einsum("s,sn,nsc->nc", cosine_sr, outdoors[:SKY], sky) + beam_lx[:, None] * sun
        ground = ground * _tint("ground")
        ground *= (light.sky.ground_cdm2 / np.maximum(ground @ _Y, 1e-9))[:, None]
        of_piece, of_pixel = self._tints
        out = np.empty((*sunlit_cdm2.shape, 3), np.float32)
        # the three colours are three times as many moments: [..., 3 n]
        parts = [np.vstack((outdoors[:SKY] * sky[..., c].T, ground[None, :, c])) for c in range(3)]
        first_lx = np.hstack([pieces_lx * sun[:, c] for c in range(3)])
        tint = of_piece.repeat(len(light), axis=1)
        columns = self.columns(np.hstack(parts).astype(np.float32), first_lx, tint, _COLOUR_BOUNCES)
        for c, bounced in enumerate(np.split(self.pixels_cdm2(columns).T, 3)):
            lit = bounced + sunlit_cdm2 * sun[:, c, None]
            out[..., c] = lit * of_pixel[:, c] + ground[:, c, None] * self.view.plain.ravel()
            out[:, seen, c] += seen_rgb[..., c]
        out /= np.maximum(out @ _Y, 1e-9)[..., None]
        return out

    @cached_property
    def _tints(self) -> tuple[Floats32, Floats32]:
        """Colours of the pieces [p, 3] and of the pixels [pixels, 3], by their surfaces.

        Colours are factors on the reflectances; a pixel has the mean of its surfaces.
        """
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

        It is for n moments, in cd/m2. outdoors: luminance of sky and plain [FIRST_PIECE, n] cd/m2;
        first_lx: illuminance of the pieces by direct sun [p, n]; tint: factor on their reflectances
        [p, n]; bounces: their number, 0 for as many as matter.
        """
        cdm2_per_lx = (self.pieces.reflectance[:, None] * tint / np.pi).astype(np.float32)
        outdoor_lx = self.outdoor_coefficients @ outdoors + first_lx
        pieces_cdm2 = cdm2_per_lx * outdoor_lx
        for _ in range(bounces or self._bounces):
            pieces_cdm2 = cdm2_per_lx * (outdoor_lx + self.bounce_coefficients @ pieces_cdm2)
        return np.concatenate((outdoors, pieces_cdm2))

    def pixels_cdm2(self, columns: Floats32) -> Floats32:
        """Return the luminance of surfaces without their direct sunlight, in all pixels, cd/m2.

        columns: the result of `columns`, [columns, n] for n moments; it includes sunlight after
        bounces. Sky and plain that are seen through windows are not added. The result is [H W, n].
        """
        return self.to_pixels @ (self.smooth @ (self.point_coefficients @ columns))

    @cached_property
    def _bounces(self) -> int:
        """Number of bounces after which an evenly lit room changes by less than 1e-4; at most 60.

        It is the same for every hour, whatever other hours are in the same block.
        """
        cdm2_per_lx = (self.pieces.reflectance / np.pi).astype(np.float32)
        before = cdm2_per_lx
        for k in range(1, 60):
            after = cdm2_per_lx * (1 + self.bounce_coefficients @ before)
            if float((after - before).max()) < 1e-4 * float(after.mean()):
                return k
            before = after
        return 60

    def as_panorama(self, rendering: Rendering, k: int) -> Panorama:
        """Return moment `k` (from 0) of a rendering as a panorama, with its visible sun separate.

        A partly hidden disc has the attribute `trace.DISC_RAYS`.
        """
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
    """Return factors on the reflectance of a box in R, G, B, which keep its luminance, [3]."""
    tint = np.array(_COLOURS.get(kind, (1.0, 1.0, 1.0)), np.float32)
    tint /= tint @ _Y
    return tint


def lit_room(setup: SiteFile, *, height: int = 115, quality: str = "quick") -> LitRoom:
    """Trace a box room's coefficients, from which `LitRoom.render` computes its light in any hour.

    height : rows of the panorama, whose centre column is at the heading of the site's camera;
    quality : a key of `QUALITIES`. The same room always gives the same result. Raises InputError
    for a site without a box room and for an impossible room.
    """
    sizes, heading = QUALITIES[quality], setup.camera.heading_deg % 360.0
    view = traced_view(box_room(setup), height, heading)
    scene, pieces = view.scene, cut_into_pieces(view.scene, sizes.piece_m)
    rows = np.flatnonzero(np.isfinite(pieces.middle[:, 0]))  # of pieces that are not covered
    normals, middles = np.eye(3)[pieces.axis[rows]] * pieces.sign[rows, None], pieces.middle[rows]
    of_open = _form_factors(scene, pieces, middles, normals, sizes.piece_rays)
    one = np.ones(len(rows), np.float32)
    to_all = csr_matrix((one, (rows, np.arange(len(rows)))), (len(pieces), len(rows)))
    of_pieces = (to_all @ of_open).tocsr()  # zeros for covered pieces
    s, faces = joined(view.samples)
    normals = np.eye(3)[s.axis] * s.sign[:, None]
    of_points = _form_factors(scene, pieces, s.position, normals, sizes.pixel_rays)
    reach_m = np.linalg.norm(s.position - scene.camera_m, axis=1) * np.pi / height * _SHARED_PX
    smooth = near_light((s.position, faces), (s.position, faces), _SHARED, reach_m)
    luminance = (s.weight * scene.reflectance[s.box] / np.pi).astype(np.float32)
    points = np.arange(len(s.pixel))
    return LitRoom(
        setup,
        view,
        pieces,
        s,
        faces,
        point_coefficients=of_points,
        smooth=smooth,
        to_pixels=csr_matrix((luminance, (s.pixel, points)), (2 * height**2, len(points))),
        outdoor_coefficients=of_pieces[:, :FIRST_PIECE].tocsr(),
        bounce_coefficients=of_pieces[:, FIRST_PIECE:].tocsr(),
    )
