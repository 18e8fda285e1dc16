"""Write box rooms as honeybee models (HBJSON)."""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

from fieldlum.core.records import Room
from fieldlum.optics.projection import direction
from fieldlum.room.scene import build
from fieldlum.room.scene.box_room import INDEX, WALLS, Box, BoxScene, Span, transmissivity, upright
from fieldlum.room.scene.radiance import corners_of

MODEL_NAME = "fieldlum_room"
_SCHEMA = "2.3.0"  # of honeybee-schema, by which the tests read the model
_EDGE_M = 0.005  # honeybee rejects a pane that touches the edge of its wall; chosen
_SHADES = ("frame", "obstruction", "ground")


def honeybee_model(room: Room, azimuths_deg: Sequence[float]) -> dict[str, Any]:
    """Return a box room as a Model of honeybee-schema: x east, y true north, z up, in m.

    The keys are those of the schema's Model. azimuths_deg: clockwise from true north; each is a
    sensor at the camera. The faces are the inside of the room, with the panes in them; reveals,
    frames, obstructions and the ground are shades. It has no thermal properties. Raises InputError
    for an impossible room.
    """
    scene = build(room)
    inside = Box((0.0, 0.0, 0.0), (room.width_m, room.depth_m, room.height_m), 0.0, "room")
    sides = {"floor": (2, 0), "ceiling": (2, 1), **WALLS}
    faces = [_face(scene, inside, name, *side) for name, side in sides.items()]
    reflectances = {
        "floor": room.reflectance_floor,
        "ceiling": room.reflectance_ceiling,
        "wall": room.reflectance_walls,
        **{f"box_{k}": scene.boxes[k].reflectance for k in scene.of_kind(*_SHADES)},
    }
    eye = np.round(np.array(scene.camera_m) @ scene.turn, 6).tolist()
    sensors = [
        {"pos": eye, "dir": np.round(direction(0.0, azimuth), 6).tolist()}
        for azimuth in azimuths_deg
    ]
    radiance = {
        "type": "ModelRadianceProperties",
        "modifiers": [
            *(_material("Plastic", name, "reflectance", r) for name, r in reflectances.items()),
            *(
                _material("Glass", f"pane_{k}", "transmissivity", transmissivity(o.transmittance))
                for k, o in enumerate(scene.openings)
            ),
        ],
        "sensor_grids": [{"type": "SensorGrid", "identifier": "camera", "sensors": sensors}],
    }
    return {
        "type": "Model",
        "identifier": MODEL_NAME,
        "version": _SCHEMA,
        "units": "Meters",
        "tolerance": 0.001,
        "rooms": [
            {"type": "Room", "identifier": "room", "faces": faces, "properties": _of("Room", {})}
        ],
        "orphaned_shades": list(_shades(scene)),
        "properties": {"type": "ModelProperties", "radiance": radiance},
    }


def _material(kind: str, name: str, quantity: str, value: float) -> dict[str, Any]:
    """Return a grey modifier of honeybee-radiance; quantity: reflectance or transmissivity."""
    # honeybee-radiance reads no material without these, although the schema has defaults
    more = {"specularity": 0.0, "roughness": 0.0}
    if kind == "Glass":
        more = {"refraction_index": INDEX}
    colour = {f"{channel}_{quantity}": round(value, 6) for channel in "rgb"}
    return {"type": kind, "identifier": name, **colour, **more}


def _of(kind: str, radiance: dict[str, str]) -> dict[str, Any]:
    """Return the properties of an object; kind: its type, such as Face; radiance: its modifier."""
    radiance = {"type": f"{kind}RadiancePropertiesAbridged", **radiance}
    return {"type": f"{kind}PropertiesAbridged", "radiance": radiance}


def _side(
    scene: BoxScene, box: Box, axis: int, side: int, kind: str, name: str, modifier: str
) -> dict[str, Any]:
    """Return a side of a box as a honeybee object; its normal points out of the box.

    axis: of the normal, 0 to 2; side: 0 for the lower, 1 for the upper end of the axis; kind: the
    object's type; name: its identifier; modifier: identifier of its material.
    """
    low, high = np.array(box.low), np.array(box.high)
    corners = corners_of(axis, (low, high)[side][axis], low, high) @ scene.turn
    boundary = np.round(corners if side else corners[::-1], 6).tolist()
    return {
        "type": kind,
        "identifier": name,
        "geometry": {"type": "Face3D", "boundary": boundary},
        "properties": _of(kind, {"modifier": modifier}),
    }


def _face(scene: BoxScene, inside: Box, name: str, axis: int, side: int) -> dict[str, Any]:
    """Return the floor, the ceiling or a wall with its windows, as a Face.

    inside: the room's air; name: the identifier; axis: of its normal, 0 to 2; side: 0 for the
    lower, 1 for the upper end of the axis.
    """
    kind = ("floor", "ceiling")[side] if axis == 2 else "wall"
    face_type = {"floor": "Floor", "ceiling": "RoofCeiling", "wall": "Wall"}[kind]
    outdoors = {"boundary_condition": {"type": "Outdoors"}}
    face = _side(scene, inside, axis, side, "Face", name, kind) | outdoors
    panes = []
    for k, o in enumerate(scene.openings):
        if (o.axis, o.outward) == (axis, 2 * side - 1):
            u, z = _off_edges(o.u_m, inside.high[o.along]), _off_edges(o.z_m, inside.high[2])
            pane = upright(axis, (o.inner_m, o.inner_m), u, z, 0.0, "pane")
            aperture = _side(scene, pane, axis, side, "Aperture", f"window_{k}", f"pane_{k}")
            panes.append(aperture | outdoors)
    return face | {"face_type": face_type, "apertures": panes}


def _off_edges(span_m: Span, length_m: float) -> Span:
    """Return the part of a span that is at least 5 mm from both ends of its wall, 0 and length."""
    return max(span_m[0], _EDGE_M), min(span_m[1], length_m - _EDGE_M)


def _shades(scene: BoxScene) -> Iterator[dict[str, Any]]:
    """Yield the sides of boxes other than floor, ceiling and walls, and the reveals, as Shades."""
    for k in scene.of_kind(*_SHADES):
        box = scene.boxes[k]
        for axis, side in product(range(3), (0, 1)):
            yield _side(scene, box, axis, side, "Shade", f"{box.kind}_{k}_{axis}{side}", f"box_{k}")
    for k, o in enumerate(scene.openings):
        inner, outer = sorted((o.inner_m, o.outer_m))
        hole = upright(o.axis, (inner, outer), o.u_m, o.z_m, 0.0, "reveal")
        for axis, side in product((o.along, 2), (0, 1)):
            yield _side(scene, hole, axis, side, "Shade", f"reveal_{k}_{axis}{side}", "wall")
