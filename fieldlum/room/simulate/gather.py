"""Coefficients of a room's points for each part of the sky and each surface piece, by rcontrib.

Every surface is cut into pieces. rcontrib follows rays from the middles of the pieces, and from the
points that the pixels see, to the first surface. This gives sparse coefficients of both for the
same columns: 2305 Reinhart patches of the sky, the open plain below the horizon, then the pieces.
`truth` computes interreflection from the pieces' coefficients.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.core.records import Progress, quiet
from fieldlum.room.scene.geometry import BoxScene
from fieldlum.room.scene.radiance import PLAIN_TEXT, SKY_TEXT, Face, faces, octree, rad_text
from fieldlum.sky.perez import reinhart_patches

SKY_MF = 4  # 4 x 4 Reinhart patches for each Tregenza patch: 2305 in total
SKY = len(reinhart_patches(SKY_MF))
PLAIN = SKY  # column of the open plain
FIRST_PIECE = SKY + 1  # column of the first piece of surface
# Size of one rcontrib run: decides memory and speed only. Chosen.
_POINTS_A_RUN = 1200
_RAYS_A_RUN = 600_000
_OFFSET_M = 1e-3  # points are this far above their surface, so that rays do not hit it; chosen
_SUB = 4  # squared: sample points of direct sun in a piece; chosen, not measured
# Distances are rounded to this many decimals [m2], so that members of a set that are equally far
# from its middle, as in a symmetric room, are taken by their order. Their last bit differs between
# processors (docs/validation.md).
_TIE_DECIMALS = 9


@dataclass(frozen=True)
class Pieces:
    """All surfaces, cut into rectangles.

    counts [faces, 2]: number of pieces along the sides of each face; first [faces]: index of its
    first piece. Arrays over pieces [p]: face; reflectance; middle [p, 3] of the part that is not
    inside another box (NaN if all is). Sample points for direct sun: position [q, 3], piece [q],
    and share [q] of the piece's open part.
    """

    faces: tuple[Face, ...]
    counts: NDArray[np.int32]  # [faces, 2]
    first: NDArray[np.int32]
    face: NDArray[np.int32]
    reflectance: Floats
    middle: Floats
    position: Floats
    piece: NDArray[np.int32]
    share: Floats

    def __len__(self) -> int:
        return len(self.face)

    @property
    def free(self) -> Indices:
        """Indices [k], ascending, of the pieces that are not completely inside another box."""
        return np.flatnonzero(np.isfinite(self.middle[:, 0]))

    @cached_property
    def axis(self) -> NDArray[np.int8]:
        """Axis of the normal of each piece in the room's frame: 0 for x, 1 for y, 2 for z, [p]."""
        return np.array([f.axis for f in self.faces], np.int8)[self.face]

    @cached_property
    def sign(self) -> NDArray[np.int8]:
        """Direction of each piece's normal along its axis, 1 or -1, [p]."""
        return np.array([f.sign for f in self.faces], np.int8)[self.face]

    @cached_property
    def normals(self) -> Floats:
        """Normal of each piece as a unit vector in the room's axes, [p, 3]."""
        out = np.zeros((len(self), 3))
        out[np.arange(len(self)), self.axis] = self.sign
        return out


def cut(scene: BoxScene, piece_m: float) -> Pieces:
    """Cut the faces of all boxes into pieces with edges of about `piece_m` metres.

    Outside the room edges are up to 2 m, or 4 m on the ground.
    """
    visible = tuple(faces(scene))
    counts = np.array([_count(scene, f, piece_m) for f in visible], np.int32)
    first = np.concatenate([[0], np.cumsum(counts.prod(axis=1))]).astype(np.int32)
    face = np.repeat(np.arange(len(visible)), counts.prod(axis=1)).astype(np.int32)
    position = np.concatenate(
        [_grid(f, na, nb) for f, (na, nb) in zip(visible, counts, strict=True)]
    )
    piece = np.arange(len(face)).repeat(_SUB**2).astype(np.int32)
    sides = np.array([(f.axis, f.sign) for f in visible])[face[piece]]
    probe = position.copy()
    probe[np.arange(len(probe)), sides[:, 0]] += sides[:, 1] * _OFFSET_M
    buried = np.zeros(len(probe), bool)
    for low, high in zip(scene.low, scene.high, strict=True):
        buried |= ((probe > low) & (probe < high)).all(axis=1)
    position, piece = position[~buried], piece[~buried]
    count = np.bincount(piece, minlength=len(face))
    with np.errstate(invalid="ignore"):
        middle = np.stack(
            [np.bincount(piece, position[:, k], len(face)) / count for k in range(3)], axis=1
        )
    reflectance = scene.reflectance[np.array([f.box for f in visible])][face]
    return Pieces(
        visible, counts, first, face, reflectance, middle, position, piece, 1.0 / count[piece]
    )


def _grid(face: Face, na: int, nb: int) -> Floats:
    """Return _SUB x _SUB points in each piece of a face, by piece, [na nb _SUB _SUB, 3]."""
    step = (np.arange(_SUB) + 0.5) / _SUB
    jb, ja, sb, sa = (
        m.ravel() for m in np.meshgrid(np.arange(nb), np.arange(na), step, step, indexing="ij")
    )
    out = np.empty((len(ja), 3))
    out[:, face.axis] = face.at_m
    out[:, face.others[0]] = face.low_m[0] + (ja + sa) / na * (face.high_m[0] - face.low_m[0])
    out[:, face.others[1]] = face.low_m[1] + (jb + sb) / nb * (face.high_m[1] - face.low_m[1])
    return out


def _count(scene: BoxScene, face: Face, piece_m: float) -> tuple[int, int]:
    spans = np.array(face.high_m) - np.array(face.low_m)
    kind = scene.boxes[face.box].kind
    if kind == "ground":
        step = 4.0
    elif _in_room(scene, face):
        step = piece_m
    else:
        step = max(piece_m, min(2.0, float(np.sqrt(spans.prod())) / 6))
    n = np.maximum(np.round(spans / step), 1).astype(int)
    return int(n[0]), int(n[1])


def _in_room(scene: BoxScene, face: Face) -> bool:
    middle = face.corners().mean(axis=0)
    middle[face.axis] += face.sign * 0.01
    low, high = np.array(scene.shell)
    return bool(((middle > low) & (middle < high)).all())


# ----------------------------------------------------------------------------------------------
# rcontrib


def _bin_file(pieces: Pieces) -> str:
    """Return a .cal file with the bin of each face from the point of the hit."""
    lines = ["keep(n,x):if(x,if(n-1-x,floor(x),n-1),0);"]
    names = "Px", "Py", "Pz"
    for k, (f, (na, nb)) in enumerate(zip(pieces.faces, pieces.counts, strict=True)):
        terms = [
            f"keep({n},({names[axis]}-({low:.9g}))*{n / (high - low):.9g})"
            for axis, low, high, n in zip(f.others, f.low_m, f.high_m, (na, nb), strict=True)
        ]
        lines.append(f"b{k}={terms[0]}+{na}*{terms[1]};")
    return "\n".join(lines)


def _hemispheres(position: Floats, normal: Floats, rays: int, rng: np.random.Generator) -> Floats32:
    """Return cosine-weighted rays into each point's hemisphere, origin and direction, [m, rays, 6].

    Roberts' R2 sequence, which fills the square evenly at any count, shifted at random for each
    point (Cranley and Patterson 1976), mapped to the disc, then to the sphere (Malley). rcontrib's
    own sampling takes its seed from the clock; with these rays a room has the same result always.
    """
    steps = np.array([0.7548776662466927, 0.5698402909980532])  # 1/g, 1/g^2 with g^3 = g + 1
    square = (np.arange(rays)[None, :, None] * steps + rng.random((len(position), 1, 2))) % 1.0
    radius, turn = np.sqrt(square[..., :1]), 2.0 * np.pi * square[..., 1:]
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(helper, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)[:, None]
    toward = radius * (np.cos(turn) * across[:, None] + np.sin(turn) * up)
    toward += np.sqrt(1.0 - square[..., :1]) * normal[:, None]
    origin = np.broadcast_to(position[:, None], toward.shape)
    return np.concatenate((origin, toward), axis=2, dtype=np.float32)


def _command(
    scene: BoxScene, pieces: Pieces, cal: Path, octree_path: Path, points: bytes, rays: int
) -> Any:
    import pyradiance

    params = ["-h", "-ab", "0", "-c", str(rays), "-lw", "1e-10", "-lr", "8", "-w-"]
    run = pyradiance.Rcontrib(points, octree_path, inform="f", outform="f", params=params)
    north = scene.to_room((0.0, 1.0, 0.0))
    param = f"MF={SKY_MF},rNx=0,rNy=0,rNz=-1,Ux={north[0]:.9g},Uy={north[1]:.9g},Uz=0"
    run.add_modifier("skyglow", calfile="reinhartb.cal", nbins=str(SKY), binv="rbin", param=param)
    run.add_modifier("plainglow", nbins="1", binv="0")
    for k, n in enumerate(pieces.counts.prod(axis=1)):
        run.add_modifier(f"f{k}", calfile=str(cal) if k == 0 else None, nbins=str(n), binv=f"b{k}")
    return run


def gather(
    scene: BoxScene,
    pieces: Pieces,
    position: Floats,
    normal: Floats,
    rays: int,
    *,
    workers: int | None = None,
    progress: Progress = quiet,
    text: str = "",
) -> Any:
    """Return the irradiance at points [m, 3] per luminance of each column, CSR [m, 2306 + pieces].

    Rows sum to at most pi. rays : directions sampled from each point, the same in every run. Raises
    RuntimeError with Radiance's message if rcontrib fails.
    """
    from scipy.sparse import vstack

    lifted = position + normal * _OFFSET_M
    points_a_run = max(1, min(_POINTS_A_RUN, _RAYS_A_RUN // rays))
    starts = range(0, len(lifted), points_a_run)
    columns = FIRST_PIECE + len(pieces)
    with octree(rad_text(scene, pieces.faces), SKY_TEXT, PLAIN_TEXT) as built:
        cal = built.with_suffix(".cal")
        cal.write_text(_bin_file(pieces), encoding="ascii")

        def gathered(start: int) -> Any:
            part = slice(start, start + points_a_run)
            stream = _hemispheres(lifted[part], normal[part], rays, np.random.default_rng(start))
            answer = _command(scene, pieces, cal, built, stream.tobytes(), rays)()
            return np.float32(np.pi) * _sparse(answer, len(stream), columns)

        parts = []
        with ThreadPoolExecutor(workers or min(os.cpu_count() or 1, 8)) as pool:
            for k, part in enumerate(pool.map(gathered, starts)):
                parts.append(part)
                progress(min((k + 1) * points_a_run, len(lifted)), len(lifted), text)
    return vstack(parts, format="csr", dtype=np.float32) if parts else _sparse(b"", 0, columns)


def _sparse(answer: bytes, rows: int, columns: int) -> Any:
    """Convert rcontrib's R G B floats to CSR; all surfaces are grey, so that red is enough."""
    from scipy.sparse import csr_matrix

    values = np.frombuffer(answer, "<f4").reshape(rows, columns, 3)[:, :, 0]
    return csr_matrix(values)


def representatives(
    keys: Sequence[NDArray[np.integer]], position: Floats, weight: Floats
) -> tuple[Indices, Floats]:
    """Group points by equal keys; return one point of each group and the group's total weight.

    The point is the index, from 0, of the member nearest to the group's middle, [groups]. Groups
    are in ascending order of their keys. keys : integers [m] each; position : [m, 3]; weight : [m].
    """
    code = np.zeros(len(position), np.int64)
    for key in keys:
        code = code * (int(key.max(initial=0)) + 1) + key
    _, inverse, count = np.unique(code, return_inverse=True, return_counts=True)
    middle = (
        np.stack([np.bincount(inverse, position[:, k]) for k in range(3)], axis=1) / count[:, None]
    )
    away = ((position - middle[inverse]) ** 2).sum(axis=1)
    order = np.lexsort((np.round(away, _TIE_DECIMALS), inverse))
    nearest = order[np.concatenate([[0], np.cumsum(count)[:-1]])]
    return nearest, np.bincount(inverse, weight).astype(np.float64)
