"""export: the room as a honeybee model, read by honeybee's own schema and lit by Radiance."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Obstruction, Room, Window
from fieldlum.optics.projection import direction
from fieldlum.room.scene.box_room import build
from fieldlum.room.scene.radiance import SKY_TEXT, octree, rad_text, trace
from fieldlum.room.scene.write_honeybee import honeybee_model

ROOM = Room(
    width_m=4,
    depth_m=5,
    height_m=3,
    camera_x_m=2,
    camera_y_m=2,
    camera_z_m=1.4,
    wall_azimuth_deg=170.0,
    window=(
        Window("south", left_m=0.5, width_m=3, sill_m=0.8, height_m=1.9, panes=2),
        Window("east", left_m=1.0, width_m=1.5, sill_m=0.0, height_m=3.0, transmittance=0.5),
    ),
    obstruction=(Obstruction(1, 3.5, 0, 1, 0.5, 0.8), Obstruction(0, -6, -0.05, 8, 1, 4)),
)


def _polygon(part: dict[str, Any], material: str, holes: list[dict[str, Any]]) -> str:
    """Return an object of a honeybee model as a Radiance polygon, with its holes on seams."""
    ring = part["geometry"]["boundary"]
    for hole in holes:
        inner = hole["geometry"]["boundary"]
        ring = [*ring, ring[0], *(inner[k] for k in (0, 3, 2, 1, 0))]
    numbers = " ".join(f"{x:.7g}" for point in ring for x in point)
    return f"{material} polygon {part['identifier']}\n0\n0\n{3 * len(ring)} {numbers}\n"


def _radiance(model: dict[str, Any]) -> str:
    texts = []
    for m in model["properties"]["radiance"]["modifiers"]:
        if m["type"] == "Glass":
            texts.append(f"void glass {m['identifier']}\n0\n0\n3" + 3 * f" {m['r_transmissivity']}")
        else:
            rgb = 3 * f" {m['r_reflectance']}"
            texts.append(f"void plastic {m['identifier']}\n0\n0\n5{rgb} 0 0")
    faces = model["rooms"][0]["faces"]
    panes = [pane for face in faces for pane in face["apertures"]]
    for part in (*faces, *panes, *model["orphaned_shades"]):
        modifier = part["properties"]["radiance"]["modifier"]
        texts.append(_polygon(part, modifier, part.get("apertures", [])))
    return "\n".join(texts)


@pytest.mark.authority
def test_honeybees_schema_accepts_the_room() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the schema's own fields
        from honeybee_schema.model import Model
    for room in (ROOM, replace(ROOM, window=(), obstruction=())):
        read = Model.model_validate(honeybee_model(room, [170.0]))
        assert read.rooms is not None and len(read.rooms[0].faces) == 6
        assert len([a for f in read.rooms[0].faces for a in f.apertures or []]) == len(room.window)


@pytest.mark.authority
def test_the_model_is_the_room_of_radiance_in_true_north() -> None:
    model, scene = honeybee_model(ROOM, [170.0, 80.0]), build(ROOM)
    sensors = model["properties"]["radiance"]["sensor_grids"][0]["sensors"]
    assert sensors[1]["dir"] == pytest.approx(direction(0.0, 80.0), abs=1e-6)
    eye: Floats = np.array(sensors[0]["pos"])
    assert scene.to_room(eye) == pytest.approx(scene.camera_m, abs=1e-5)
    altitude, azimuth = np.meshgrid(np.arange(-60.0, 80.0, 4.0), np.arange(1.0, 360.0, 4.0))
    rays = direction(altitude.ravel(), azimuth.ravel())
    with octree(_radiance(model), SKY_TEXT) as honeybee:
        theirs = trace(honeybee, eye, rays)
    with octree(rad_text(scene), SKY_TEXT) as own:
        ours = trace(own, np.array(scene.camera_m), scene.to_room(rays))
    assert {round(float(x), 1) for x in ours} >= {0.0, 0.5, 0.9}, "both panes are in view"
    assert theirs == pytest.approx(ours, abs=0.01)


@pytest.mark.analytic
def test_faces_look_out_of_the_room_and_hold_their_panes() -> None:
    middle = np.array([2.0, 2.5, 1.5]) @ build(ROOM).turn
    faces = honeybee_model(ROOM, [])["rooms"][0]["faces"]
    for face in faces:
        for part in (face, *face["apertures"]):
            a, b, c, _ = np.array(part["geometry"]["boundary"])
            normal = np.cross(b - a, c - b)
            assert normal @ (a - middle) > 0, part["identifier"]
    (east,) = next(face["apertures"] for face in faces if face["identifier"] == "east")
    heights = sorted({point[2] for point in east["geometry"]["boundary"]})
    assert heights == pytest.approx([0.005, 2.995]), "a pane may not touch the edge of its wall"
