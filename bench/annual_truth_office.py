"""The office of raytraverse's validation set: its planes by formula, its hits by rtrace.

Glass, the fabric and the glass facade opposite are planes whose formulas (m_glass.c, the fabric's
.cal) are evaluated here, so that their specular parts are exact. Radiance's rtrace finds what each
ray hits, and who casts shadows. The sun's direct light is exact at every point.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FAR_M = 1e6
TN = 0.763  # transmissivity of the panes (options/*.rad), transmittance 0.7
PANES_X = ((-1.345, -0.03), (0.03, 1.345))
PANES_Z = ((0.0, 0.94), (1.0, 1.94), (2.0, 3.2))
FABRIC = (0.05, 1.3, 0.95, 3.2)  # y, half width, lower and upper edge (options/fabric.rad) [m]
FABRIC_TAU, FABRIC_CUT_DEG = 0.03, 75.0
MIRROR = (6.0, 6.0, -0.05, 20.0)  # the same for the glass facade (options/north_glass.rad)


@dataclass(frozen=True)
class Scene:
    """Name, sign of y towards the window's outside, and which of the two planes it has."""

    name: str
    outward: int
    fabric: bool
    mirror: bool
    octree: Path

    @property
    def glass_y(self) -> float:
        return 0.1 * self.outward


@dataclass(frozen=True)
class Points:
    """Surface points: position, normal towards the viewer, reflectance, [n, ...]."""

    position: Array
    normal: Array
    reflectance: Array


SCENES = {
    "01_glz": ("office", -1, False, False),
    "03_shd": ("office", -1, True, False),
    "05_ngl": ("office_n", 1, False, True),
}


# ----------------------------------------------------------------------------------------------
# optics of the planes


def glass(cosine: Array) -> tuple[Array, Array]:
    """Transmittance and reflectance of a pane, as Radiance's m_glass.c computes them (n = 1.52)."""
    c1 = np.clip(np.abs(cosine), 1e-6, 1.0)
    c2 = np.sqrt(1.0 - (1.0 - c1**2) / 1.52**2)
    inside = TN ** (1.0 / c2)
    through, back = np.zeros_like(c1), np.zeros_like(c1)
    for r in (
        ((c1 - 1.52 * c2) / (c1 + 1.52 * c2)) ** 2,
        ((c2 - 1.52 * c1) / (c2 + 1.52 * c1)) ** 2,
    ):
        through += 0.5 * (1 - r) ** 2 * inside / (1 - r**2 * inside**2)
        back += 0.5 * r * (1 + (1 - 2 * r) * inside**2) / (1 - r**2 * inside**2)
    return through, back


def fabric_through(cosine: Array) -> Array:
    """Direct transmittance of the fabric: tau(0.03, 4, 2.9, 75) of roos_fabric.cal."""
    p, q, a = 4.0, 2.9, 8.0
    z0 = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)) * 0.636619772368
    b = 0.25 / q
    z = z0 + 1.0 - FABRIC_CUT_DEG / 90.0
    gamma = (5.26 + 0.06 * p) + (0.73 + 0.04 * p) * q
    fall = a * z ** (5.2 + 0.7 * q) + b * z**2 + (1 - a - b) * z**gamma
    return np.where(z0 < FABRIC_CUT_DEG / 90.0, FABRIC_TAU * np.maximum(1.0 - fall, 0.0), 0.0)


def _at_plane(
    origin: Array, ray: Array, y: float, length: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Distance to the plane at y, and whether the ray crosses it before its end."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (y - origin[:, 1]) / ray[:, 1]
    ok = np.isfinite(t) & (t > 1e-6) & (t < length)
    return np.where(ok, t, 0.0), ok


def pane_share(scene: Scene, origin: Array, ray: Array, length: Array) -> Array:
    """Glass on the way, [n]: the panes' transmittance where they are crossed, else 1."""
    t, crosses = _at_plane(origin, ray, scene.glass_y, length)
    at = origin + ray * t[:, None]
    x_ok = np.zeros(len(ray), bool)
    z_ok = np.zeros(len(ray), bool)
    for low, high in PANES_X:
        x_ok |= (at[:, 0] > low) & (at[:, 0] < high)
    for low, high in PANES_Z:
        z_ok |= (at[:, 2] > low) & (at[:, 2] < high)
    return np.where(crosses & x_ok & z_ok, glass(ray[:, 1])[0], 1.0)


def rectangle(
    plane: tuple[float, float, float, float], origin: Array, ray: Array, length: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points where rays cross an upright rectangle, and whether they do."""
    y, half, low, high = plane
    t, crosses = _at_plane(origin, ray, y, length)
    at = origin + ray * t[:, None]
    return at, crosses & (np.abs(at[:, 0]) < half) & (at[:, 2] > low) & (at[:, 2] < high)


# ----------------------------------------------------------------------------------------------
# rtrace


def opaque_text(folder: Path, model: str) -> str:
    """The office without its panes."""
    text = (folder / "RAD" / f"{model}.rad").read_text()
    return re.sub(
        r"^wg\w+Mat polygon \S+\s+0\s+0\s+12\s+(?:[-\d.eE+]+\s+){12}", "", text, flags=re.M
    )


@contextmanager
def opened(folder: Path, name: str) -> Iterator[Scene]:
    import pyradiance

    model, outward, fabric, mirror = SCENES[name]
    with tempfile.TemporaryDirectory() as work:
        rad, octree = Path(work) / "scene.rad", Path(work) / "scene.oct"
        rad.write_text(opaque_text(folder, model))
        octree.write_bytes(pyradiance.oconv(rad, warning=False))
        yield Scene(name, outward, fabric, mirror, octree)


def first_hit(scene: Scene, origin: Array, ray: Array) -> tuple[Array, Points]:
    """Length [n] of each ray (1e10: none) and what it hits (reflectance by -av 1)."""
    import pyradiance

    rays = np.concatenate((origin, ray), axis=1).astype("<f4").tobytes()
    params = ["-ab", "0", "-av", "1", "1", "1", "-aw", "0", "-lr", "1", "-w-"]
    answer = pyradiance.rtrace(
        rays, scene.octree, header=False, inform="f", outform="f", outspec="LpNv", params=params
    )
    found = np.frombuffer(answer, "<f4").reshape(-1, 10).astype(float)
    normal = found[:, 4:7]
    normal = np.where((normal * ray).sum(axis=1, keepdims=True) > 0, -normal, normal)
    return found[:, 0], Points(found[:, 1:4], normal, found[:, 8])


def clear_way(scene: Scene, origin: Array, ray: Array) -> NDArray[np.bool_]:
    if not len(origin):
        return np.zeros(0, bool)
    return first_hit(scene, origin, ray)[0] > FAR_M


# ----------------------------------------------------------------------------------------------
# direct sun


def sun_share(scene: Scene, points: Points, suns: Array) -> Array:
    """Irradiance at points [n] per normal irradiance of each sun [h, 3], by the sky's sun and by
    its image in the glass facade: [h, n].
    """
    out = np.zeros((len(suns), len(points.position)), np.float32)
    lifted = points.position + 1e-3 * points.normal
    for image in (False, True)[: 2 if scene.mirror else 1]:
        toward = suns * np.array([1.0, -1.0 if image else 1.0, 1.0])
        jobs: list[tuple[int, NDArray[np.intp]]] = []
        for k, s in enumerate(toward):
            if s[2] <= 0 or (image and s[1] <= 0):
                continue
            rows = np.flatnonzero((points.normal @ s > 0) & _may_see(scene, lifted, s))
            if len(rows):
                jobs.append((k, rows))
        for first in range(0, len(jobs), 100):
            part = jobs[first : first + 100]
            rows = np.concatenate([r for _, r in part])
            hour = np.concatenate([np.full(len(r), k) for k, r in part])
            seen = sun_through(scene, lifted[rows], toward[hour], image)
            cosine = (points.normal[rows] * toward[hour]).sum(axis=1)
            np.add.at(out, (hour, rows), seen * cosine)
    return out


def _may_see(scene: Scene, position: Array, s: Array) -> NDArray[np.bool_]:
    """Points outside the room, and those inside from which the way to the sun leaves by the
    window's opening."""
    inside = position[:, 1] * scene.outward < -1e-3
    if s[1] * scene.outward <= 0:
        return ~inside
    t = -position[:, 1] / s[1]
    x, z = position[:, 0] + t * s[0], position[:, 2] + t * s[2]
    return ~inside | ((np.abs(x) < 1.5) & (z > -0.1) & (z < 3.4))


def sun_through(scene: Scene, origin: Array, ray: Array, image: bool) -> Array:
    """Share of the sun's light that arrives at each point along each way, [n]."""
    far = np.full(len(ray), FAR_M)
    share = pane_share(scene, origin, ray, far)
    if scene.fabric:
        _, crosses = rectangle(FABRIC, origin, ray, far)
        share = np.where(crosses, share * fabric_through(ray[:, 1]), share)
    if not scene.mirror:
        return np.where(clear_way(scene, origin, ray), share, 0.0)
    at, crosses = rectangle(MIRROR, origin, ray, far)
    if not image:  # the facade itself, black from behind, hides what is beyond
        return np.where(~crosses & clear_way(scene, origin, ray), share, 0.0)
    ok = crosses & clear_way(scene, origin, ray)
    back = ray * np.array([1.0, -1.0, 1.0])
    ok[ok] = clear_way(scene, at[ok] - np.array([0.0, 1e-3, 0.0]), back[ok])
    return np.where(ok, share * glass(ray[:, 1])[1], 0.0)
