"""Write box rooms as Radiance text, and trace rooms of .rad files by rtrace."""

import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Ints32
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.files import read_bytes
from fieldlum.core.progress import progress
from fieldlum.core.records import Room
from fieldlum.optics.images import RADIANCE_LM_PER_W, RADIANCE_Y
from fieldlum.room.scene.box_room import BoxScene, transmissivity, upright
from fieldlum.room.scene.trace import SUN_RADIUS_DEG
from fieldlum.room.scene.view import patch_rays, pixel_rays

SUN_SR = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))
# Radiance runs every line of a scene that begins with an exclamation mark, also in the scenes of
# octrees and meshes that it loads (readobj.c, readoct.c).
_COULD_RUN = re.compile(rb"!(.{,80})|\b(?:instance|mesh)\b|FORMAT=Radiance_octree")
# Direct light only, with all sources tested, and at most four reflections or transmissions.
_TRACE = ["-ab", "0", "-dj", "0", "-dt", "0", "-dc", "1", "-lr", "4", "-w-"]


# ----------------------------------------------------------------------------------------------
# boxes to .rad


def corners_of(axis: int, at_m: float, low: Floats, high: Floats) -> Floats:
    """Return the corners [4, 3] of a rectangle, counter-clockwise as seen from the axis's high end.

    axis: of its normal, 0 to 2; at_m: its coordinate there. low, high: its extent on the other two
    axes [3] m; the third number is ignored.
    """
    corners = np.array([low, low, high, high])
    other = (axis + 1) % 3
    corners[1, other], corners[3, other] = high[other], low[other]
    corners[:, axis] = at_m
    return corners


def _rectangle(name: str, material: str, axis: int, at_m: float, low: Floats, high: Floats) -> str:
    """Return a rectangle as Radiance text.

    axis: of its normal, 0 to 2; at_m: its coordinate there; low, high [3]: ends on the other axes.
    """
    numbers = " ".join(f"{x:.7g}" for x in corners_of(axis, at_m, low, high).ravel())
    return f"{material} polygon {name}\n0\n0\n12 {numbers}\n"


def rad_text(scene: BoxScene) -> str:
    """Return the room as Radiance text in room axes, without sky and sun.

    Box k of the scene (from 0) has the material ``m<k>``, the pane of opening k ``g<k>``.
    """
    parts = ["# a fieldlum box room; x right, y away from the south wall, z up\n"]
    for k, (low, high) in enumerate(zip(scene.low, scene.high, strict=True)):
        r = f"{scene.reflectance[k]:.6g}"
        parts.append(f"void plastic m{k}\n0\n0\n5 {r} {r} {r} 0 0\n")
        for side, (axis, corner) in enumerate(product(range(3), (low, high))):
            parts.append(_rectangle(f"box{k}_{side}", f"m{k}", axis, corner[axis], low, high))
    for k, o in enumerate(scene.openings):
        tn = f"{transmissivity(o.transmittance):.6f}"
        parts.append(f"void glass g{k}\n0\n0\n3 {tn} {tn} {tn}\n")
        pane = upright(o.axis, (o.pane_m, o.pane_m), o.u_m, o.z_m, 0.0, "pane")
        ends = (np.array(pane.low), np.array(pane.high))
        parts.append(_rectangle(f"pane{k}", f"g{k}", o.axis, o.pane_m, *ends))
    return "".join(parts)


SKY_TEXT = "void glow skyglow\n0\n0\n4 1 1 1 0\nskyglow source sky\n0\n0\n4 0 0 1 180\n"


def sun_text(direction: Floats, normal_illuminance_lx: float = RADIANCE_LM_PER_W) -> str:
    """Return the sun as Radiance text.

    direction: unit vector to the sun, in the axes of the scene [3]; normal_illuminance_lx: on a
    plane normal to it; 179 lx, the default, are 1 W/m2. The disc has the radius SUN_RADIUS_DEG.
    """
    radiance = normal_illuminance_lx / RADIANCE_LM_PER_W / SUN_SR
    x, y, z = direction
    light = f"void light solar\n0\n0\n3 {radiance:.8g} {radiance:.8g} {radiance:.8g}\n"
    return f"{light}solar source sun\n0\n0\n4 {x:.9g} {y:.9g} {z:.9g} {2 * SUN_RADIUS_DEG}\n"


@contextmanager
def octree(*texts: str, base: Path | None = None) -> Iterator[Path]:
    """Yield the path of a temporary octree of Radiance texts; it is deleted when the block ends.

    base: an octree on top of which the texts are; None for none. Raises RuntimeError for text that
    Radiance does not accept.
    """
    import pyradiance

    with tempfile.TemporaryDirectory(prefix="fieldlum-") as folder:
        rad, oct_ = Path(folder) / "scene.rad", Path(folder) / "scene.oct"
        rad.write_text("\n".join(texts), encoding="latin-1")
        oct_.write_bytes(pyradiance.oconv(rad, octree=base, warning=False))
        yield oct_


def trace(
    octree_path: Path, origins: Floats, directions: Floats, extra: Sequence[str] = ()
) -> Floats:
    """Return the radiance along n rays by rtrace, with direct light only, [n] W/sr/m2.

    origins : [n, 3] or [3]; directions : [n, 3]; both in the axes of the octree; extra : more
    options of rtrace, of which an ``-ab`` of 1 or more adds bounces. Colours are weighted by
    Radiance's own luminance weights.
    """
    import pyradiance

    rays = np.concatenate((np.broadcast_to(origins, directions.shape), directions), axis=1)
    how = {"header": False, "inform": "f", "outform": "f", "params": [*_TRACE, *extra]}
    answer = pyradiance.rtrace(rays.astype("<f4").tobytes(), octree_path, **how)
    return np.frombuffer(answer, "<f4").reshape(-1, 3) @ np.array(RADIANCE_Y)


# ----------------------------------------------------------------------------------------------
# rooms from files


def _geometry(path: Path) -> str:
    """Return the text of a room's file. Raises InputError if Radiance could run a command by it."""
    data = read_bytes(path)
    if match := _COULD_RUN.search(data):
        found = "a scene that loads another one, which could run commands"
        if match[1] is not None:
            found = f"a scene that runs the command: {match[1].decode('ascii', 'replace').strip()}"
        remedy = "write it flat, and without ! in comments: xform -e ROOM.rad > FLAT.rad"
        raise InputError(path, found, "a .rad file of mere geometry", remedy)
    return data.decode("latin-1")


@contextmanager
def _room_octree(room: Room) -> Iterator[Path]:
    """Yield the path of a temporary octree of the room's file.

    Raises InputError if the file is missing or invalid, or could run a command.
    """
    path = Path(room.file)
    if not path.is_file():
        remedy = "correct the key file in [room]"
        raise InputError(path, "no such file", "a Radiance .rad file of the room", remedy)
    expected, remedy = "a scene that Radiance accepts", f"correct it; check with: oconv {path}"
    with input_errors(path, expected, remedy, RuntimeError), octree(_geometry(path)) as tree:
        yield tree


def _viewpoint(room: Room) -> Floats:
    """Return the camera's place in a room of kind "radiance", [3] m, x east, y north, z up.

    Raises InputError if it has not three numbers.
    """
    if len(room.viewpoint_m) != 3:
        expected, remedy = "three numbers: x east, y north, z up", "correct viewpoint_m"
        raise InputError("[room]", f"viewpoint_m {room.viewpoint_m}", expected, remedy)
    return np.array(room.viewpoint_m)


def traced(
    room: Room, suns: Floats, normal_lx: Floats, height: int, heading_deg: float
) -> Floats32:
    """Return sun patches of a room of kind "radiance", traced by rtrace -ab 0, [n, H, W] cd/m2.

    suns : [n, 3] unit vectors in world axes (x east, y north); normal_lx : [n], lx on a plane
    normal to the sun. height : rows H of the panoramas, W = 2H; heading_deg : azimuth of their
    centre, clockwise from true north. Pixels have the rays of `patch_rays`. Raises InputError for a
    room file that is missing, invalid, or could run a command, and for a viewpoint_m without three
    numbers.
    """
    eye = _viewpoint(room)
    pixel, rays = pixel_rays(height, heading_deg, patch_rays(height))
    maps = np.zeros((len(suns), height, 2 * height), np.float32)
    with _room_octree(room) as base:
        for hour in np.flatnonzero((normal_lx > 0.0) & (suns[:, 2] > 0.0)):
            progress(int(hour), len(suns), "sun patches")
            with octree(sun_text(suns[hour]), base=base) as lit:
                values = trace(lit, eye, rays, ["-dv-"])
            maps[hour] = _pixel_mean(pixel, values, height) * normal_lx[hour]
    progress(len(suns), len(suns), "")
    return maps


def traced_sky_share(room: Room, rays: Floats) -> Floats:
    """Return the share of the open sky's light that rays from the viewpoint receive, [m].

    room: of kind "radiance"; rays [m, 3]: directions in world axes, x east, y north, z up. The
    share is 0 behind an opaque surface and below the horizon, else the transmittance of the glass.
    Raises InputError for a room file that is missing, invalid or could run a command, and for a
    viewpoint_m without three numbers.
    """
    with _room_octree(room) as base, octree(SKY_TEXT, base=base) as lit:
        return np.asarray(trace(lit, _viewpoint(room), rays), float)


def _pixel_mean(pixel: Ints32, values: Floats, height: int) -> Floats32:
    """Return the mean of each pixel's rays, 0 for pixels without a ray, [H, W].

    pixel [m], values [m]: flat index and value of each ray; height: rows H of the panorama.
    """
    count = 2 * height**2
    total = np.bincount(pixel, values, count) / np.maximum(np.bincount(pixel, minlength=count), 1)
    return total.reshape(height, 2 * height).astype(np.float32)
