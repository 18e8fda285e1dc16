"""Trace rays and paths through a scene with Mitsuba 3; glass is added to every segment.

Mitsuba intersects, samples and evaluates the materials. This module follows the paths, so that one
set of paths serves every hour: where a path leaves to the sky it meets a patch of the sky, and
where it meets a surface it meets a cell whose sunlight is known for every hour.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from geometry import PANE_INDEX, Group, Pane
from numpy.typing import NDArray

mi.set_variant("llvm_ad_mono")

Array = NDArray[Any]

_EPS_M = 2e-4  # start of a ray above its surface
_COAT_INDEX = 1.49  # of Mitsuba's roughplastic
_COAT_REFLECTANCE = 0.092  # of that index for diffuse light (Fresnel, averaged over the hemisphere)
_COSINES = np.linspace(1e-3, 1.0, 512)  # cosines of the table of transmittance


@dataclass(frozen=True)
class Hits:
    """What rays [n] met; arrays [n] or [n, 3]. normal: on the side from which the ray came.

    reflectance: diffuse; out, weight: sampled next direction and its weight.
    """

    valid: Array
    distance: Array
    point: Array
    normal: Array
    group: Array
    reflectance: Array
    out: Array
    weight: Array


class World:
    """A scene that Mitsuba traces. groups: materials by name; panes: the glass."""

    def __init__(self, groups: Mapping[str, Group], panes: Sequence[Pane]) -> None:
        self.groups = list(groups.values())
        self.names = list(groups)
        self.panes = [(pane, _glass(pane)) for pane in panes]
        self.transmittance = np.array([g.transmittance for g in self.groups])
        self.coated = np.array([g.gloss > 0 for g in self.groups])
        scene, owner = mitsuba_scene(groups)
        self.scene: Any = mi.load_dict(scene, optimize=False)
        table = np.zeros(1 + len(self.scene.shapes()) + 1000, np.uint32)
        for shape in self.scene.shapes():
            index = int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])
            table[index] = owner[shape.id()]
        self._group_of_shape = mi.UInt32(table)

    def hit(self, origin: Array, ray: Array, rng: np.random.Generator) -> Hits:
        """Intersect rays and sample the materials that they meet."""
        random = rng.random((3, len(origin)), np.float32)
        si = self.scene.ray_intersect(_mi_ray(origin, ray))
        valid = si.is_valid()
        context, bsdf = mi.BSDFContext(), si.bsdf()
        sample, weight = bsdf.sample(
            context, si, mi.Float(random[0]), mi.Point2f(random[1], random[2]), valid
        )
        reflectance = bsdf.eval_diffuse_reflectance(si, valid)[0]  # under a coat: of the base
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        group = dr.gather(mi.UInt32, self._group_of_shape, shape, valid)
        out = si.to_world(sample.wo)
        parts = (valid, si.t, si.p, si.n, group, reflectance, out, weight[0])
        dr.eval(*parts)
        normal = np.array(si.n).T
        normal *= -np.sign((normal * ray).sum(1))[:, None]
        hits = Hits(
            np.array(valid),
            np.array(si.t),
            np.array(si.p).T,
            normal,
            np.array(group).astype(int),
            self._below_coat(np.array(reflectance), np.array(group).astype(int)),
            np.array(out).T,
            np.array(weight[0]),
        )
        return self._through(hits, random)

    def _below_coat(self, base: Array, group: Array) -> Array:
        """Return the diffuse reflectance of surfaces with a coat, from that of their base."""
        inside = 1 - (1 - _COAT_REFLECTANCE) / _COAT_INDEX**2
        coated = base * (1 - _COAT_REFLECTANCE) * (1 - inside) / (1 - base * inside)
        return np.where(self.coated[group], coated, base)

    def _through(self, hits: Hits, random: Array) -> Hits:
        """Send a share of the paths on through surfaces that transmit diffusely."""
        tau = np.where(hits.valid, self.transmittance[hits.group], 0.0)
        thin = tau > 0
        if thin.any():
            total = tau + hits.reflectance
            across = thin & (random[0] * total < tau)
            radius, angle = np.sqrt(random[1][thin]), 2 * np.pi * random[2][thin]
            a, b = _tangents(hits.normal[thin])
            up = np.sqrt(1 - radius**2) * np.where(across[thin], -1, 1)
            hits.out[thin] = (
                (radius * np.cos(angle))[:, None] * a
                + (radius * np.sin(angle))[:, None] * b
                + up[:, None] * hits.normal[thin]
            )
            hits.weight[thin] = total[thin]
        return hits

    def clear(self, origin: Array, ray: Array) -> Array:
        """Return whether rays [n] leave the scene."""
        return ~np.array(self.scene.ray_test(_mi_ray(origin, ray)))

    def reflected(self, origin: Array, ray: Array, sun: Array) -> Array:
        """Return material times cosine [n] for light from `sun` [n, 3] at what the rays meet."""
        si = self.scene.ray_intersect(_mi_ray(origin, ray))
        to_sun = si.to_local(mi.Vector3f(*_columns(sun)))
        return np.array(si.bsdf().eval(mi.BSDFContext(), si, to_sun, si.is_valid())[0])

    def glass(self, origin: Array, ray: Array, distance: Array | float) -> tuple[Array, Array]:
        """Return the transmittance [n] of the glass on segments, and whether they cross any."""
        factor, crossed = np.ones(len(origin)), np.zeros(len(origin), bool)
        for pane, table in self.panes:
            along, other = ray[:, pane.axis], 1 - pane.axis
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (pane.at - origin[:, pane.axis]) / along
                a = origin[:, other] + t * ray[:, other]
                z = origin[:, 2] + t * ray[:, 2]
            inside = (t > 0) & (t < distance)
            inside &= (a > pane.low[0]) & (a < pane.high[0])
            inside &= (z > pane.low[1]) & (z < pane.high[1])
            k = np.flatnonzero(inside)
            factor[k] *= np.interp(np.abs(along[k]), _COSINES, table)
            crossed |= inside
        return factor, crossed


def lifted(point: Array, normal: Array) -> Array:
    return point + normal * (_EPS_M * (1 + np.abs(point).max(1, keepdims=True) * 0.05))


def mitsuba_scene(groups: Mapping[str, Group]) -> tuple[dict[str, Any], dict[str, int]]:
    """Return Mitsuba's description of the surfaces, and the group of each shape by its id."""
    scene: dict[str, Any] = {"type": "scene"}
    owner = {}
    for number, (name, group) in enumerate(groups.items()):
        bsdf = _bsdf(group)
        if group.quads or group.triangles:
            scene[name] = {**_mesh(name, group), "bsdf": bsdf}
            owner[name] = number
        for k, shape in enumerate(group.round):
            scene[f"{name}_{k}"] = {**shape, "bsdf": bsdf}
            owner[f"{name}_{k}"] = number
    return scene, owner


def _bsdf(group: Group) -> dict[str, Any]:
    colour: dict[str, Any] = {"type": "uniform", "value": group.reflectance}
    if group.texture:
        colour = {
            "type": "checkerboard",
            "color0": colour,
            "color1": {"type": "uniform", "value": group.texture[0]},
        }
    if group.gloss:
        inner = {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": group.gloss,
            "diffuse_reflectance": colour,
            "nonlinear": True,
        }
    else:
        inner = {"type": "diffuse", "reflectance": colour}
    return {"type": "twosided", "bsdf": inner}


def _mesh(name: str, group: Group) -> dict[str, Any]:
    quads = [np.asarray(q).reshape(-1, 4, 3) for q in group.quads]
    parts = [np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]) for q in quads]
    parts += [np.asarray(t).reshape(-1, 3, 3) for t in group.triangles]
    corners = np.concatenate(parts)
    mesh = mi.Mesh(name, 3 * len(corners), len(corners), has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = corners.reshape(-1).astype(np.float32)
    params["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axis = normal.argmax(1)
    size = 2 * (group.texture[1] if group.texture else 1.0)
    across = np.array([(1, 2), (0, 2), (0, 1)])[axis]  # [n, 2]
    uv = np.take_along_axis(corners, across[:, None, :], 2) / size
    params["vertex_texcoords"] = uv.reshape(-1).astype(np.float32)
    params.update()
    path = Path(tempfile.mkdtemp()) / f"{name}.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True}


def _glass(pane: Pane) -> Array:
    """Return the transmittance of a pane for unpolarised light at the table's cosines."""
    cos = _COSINES
    inner = np.sqrt(1 - (1 - cos**2) / PANE_INDEX**2)
    through = pane.transmittance ** (1 / inner)
    total = np.zeros_like(cos)
    for a, b in ((cos, PANE_INDEX * inner), (PANE_INDEX * cos, inner)):
        r = ((a - b) / (a + b)) ** 2
        t1 = (1 - r) ** 2 * through / (1 - (r * through) ** 2)
        r1 = r * (1 + t1 * through)
        clear = (1 - r) / (1 + r)  # second pane without tint
        clear_r = r * (1 + clear)
        total += t1 if pane.panes == 1 else t1 * clear / (1 - r1 * clear_r)
    return total / 2


def _tangents(normal: Array) -> tuple[Array, Array]:
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    a = np.cross(normal, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return a, np.cross(normal, a)


def _columns(vectors: Array) -> list[Array]:
    return [np.ascontiguousarray(c, np.float32) for c in vectors.T]


def _mi_ray(origin: Array, ray: Array) -> Any:
    return mi.Ray3f(mi.Point3f(*_columns(origin)), mi.Vector3f(*_columns(ray)))
