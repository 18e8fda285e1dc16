"""The page of `fieldlum scene click`, which turns clicked corners of a panorama into a room."""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomli_w
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import JsonTable, Room, parse_utc
from fieldlum.optics import images, projection
from fieldlum.room.scene import drawing, sun_patches
from fieldlum.room.scene.clicked import ClickedRoom, ClickGrid, clicks_from_rows, room_from_clicks
from fieldlum.session import Session, site_toml, update_session, write_file
from fieldlum.sky import sun
from fieldlum.web.server import json_body, picture_routes, static_route
from fieldlum.web.snapshot import scale_of

_PATCH_HEIGHT_PX = 90  # of the map from which sun patches are outlined: 2 degrees a pixel; chosen


@dataclass(frozen=True, slots=True)
class ClickedPicture:
    """The panorama on which the user clicks the room's corners.

    session: that has the panorama; slot: id of the panorama's slot; grid: its size and heading.
    """

    session: Session
    slot: str
    grid: ClickGrid

    @classmethod
    def of(cls, session: Session, slot: str = "") -> Self:
        """Return the panorama of a slot; for "" that with the highest sun in the plan.

        Raises InputError if it does not exist or cannot be read, NotEnoughDataError if no slot is
        merged.
        """
        merged = {path.stem: path for path in session.panorama_files()}
        if not merged:
            remedy = f"run fieldlum merge {session.root}"
            raise NotEnoughDataError(f"{session.root}: no merged panorama; {remedy}")
        if slot and slot not in merged:
            expected = f"a slot such as {max(merged)}"
            raise InputError(session.root, f"no panorama {slot}", expected, "see panoramas/")
        altitudes_deg = {slot.id: slot.sun_altitude_deg for slot in session.slots()}
        slot = slot or max(merged, key=lambda name: altitudes_deg.get(name, -90.0))
        panorama = images.read_panorama(merged[slot])
        height, width = panorama.luminance_cdm2.shape
        return cls(session, slot, ClickGrid(height, width, panorama.heading_deg))


def clicked_table(clicked: ClickedRoom) -> JsonTable:
    """Return a clicked room as JSON for the page.

    rows: {"name", "value", "u"} for each clicked length [m] and angle [deg], u: its standard
    uncertainty. Names are fields of `Room`, and for windows window.NUMBER.FIELD of `Window`, with
    numbers from 0, such as window.0.left_m. faces: compass direction of the wall "south"; walls:
    the name in the room of each window's wall; misfit_px, notes: see `ClickedRoom`.
    """
    room, rows = clicked.room, []
    for name, u in clicked.u.items():
        *place, field = name.split(".")
        owner = room.window[int(place[1])] if place else room
        rows.append({"name": name, "value": getattr(owner, field), "u": u})
    return {
        "rows": rows,
        "faces": drawing.compass_text(room.wall_azimuth_deg),
        "walls": [window.wall for window in room.window],
        "misfit_px": clicked.misfit_px,
        "notes": list(clicked.notes),
    }


def save_room(session: Session, clicked: ClickedRoom, *, replace_room: bool) -> tuple[Path, bool]:
    """Write the session's scene/clicked.toml, a complete SITE.toml with the clicked room.

    Also write the room into session.toml if that has none, or if `replace_room`. Return the path of
    clicked.toml, and whether the room was written into session.toml. An earlier clicked.toml is
    replaced. Raises InputError if session.toml cannot be read.
    """
    setup, room = session.site_file(), clicked.room
    new_setup = replace(setup, room=room, camera=replace(setup.camera, height_m=room.camera_z_m))
    path = session.root / "scene" / "clicked.toml"
    lines = ["# Written by fieldlum scene click. Standard uncertainties, from the clicks' pixels:"]
    lines += [f"#   {name} +- {u:.3g}" for name, u in clicked.u.items()]
    write_file(path, "\n".join(lines) + "\n\n" + tomli_w.dumps(site_toml.site_table(new_setup)))
    is_written = setup.room is None or replace_room
    if is_written:
        update_session(session, {"setup": site_toml.site_table(new_setup)})
    return path, is_written


def click_routes(picture: ClickedPicture, camera_height_m: float) -> list[Route]:
    """Return the web routes of the page of `fieldlum scene click`.

    picture: on which the user clicks; camera_height_m: initial value of the camera's height on the
    page.
    """
    session = picture.session

    def describe(request: Request) -> Response:
        """Answer with the panorama's size and scale, and whether the site has a room."""
        setup, path = session.site_file(), session.panorama(picture.slot)
        answer = {
            "name": setup.site.name,
            "slot": picture.slot,
            "width": picture.grid.width_px,
            "height": picture.grid.height_px,
            "scale": scale_of([path]),
            "camera_height_m": camera_height_m,
            "has_room": setup.room is not None,
        }
        return JSONResponse(answer)

    def show(clicked: ClickedRoom, replace_room: bool) -> JsonTable:
        """Return `clicked_table` with the keys lines and patches; nothing is written.

        They are the edges of the room (`outline_pixels`) and the outlines of its sun patches, in
        pixels of the picture. replace_room has no effect.
        """
        lines = drawing.outline_pixels(clicked.room, picture.grid)
        patches = _patch_outlines(clicked.room, picture)
        return clicked_table(clicked) | {"lines": lines, "patches": patches}

    def save(clicked: ClickedRoom, replace_room: bool) -> JsonTable:
        """Write the clicked room with `save_room`; return its results by the keys file and taken.

        replace_room: whether an earlier room of the session is replaced.
        """
        path, is_written = save_room(session, clicked, replace_room=replace_room)
        return {"file": str(path), "taken": is_written}

    return [
        static_route("/", "click.html"),
        static_route("/click.js", "click.js"),
        static_route("/page.css", "page.css"),
        Route("/room.json", describe),
        _click_route("/solve.json", picture, show),
        _click_route("/save.json", picture, save),
        *picture_routes(session),
    ]


def _click_route(
    path: str, picture: ClickedPicture, use: Callable[[ClickedRoom, bool], JsonTable]
) -> Route:
    """Return a route that answers posted clicks with `use` of their room.

    use: is called with the room, which has what clicks do not measure from the session's, and
    whether it may replace that. An InputError becomes a sentence on the page.
    """

    def answer(body: Mapping[str, Any]) -> JsonTable:
        """Return what `use` returns for the room of the clicks in a request's body.

        body: its keys are clicks (for `clicks_from_rows`), camera_height_m, and replace: whether
        the session's room may be replaced. Raises InputError for clicks that form no room, and
        KeyError, TypeError or ValueError for a missing or wrong key.
        """
        clicks, height_m = clicks_from_rows(body["clicks"]), float(body["camera_height_m"])
        earlier = picture.session.site_file().room
        clicked = room_from_clicks(clicks, picture.grid, height_m, earlier)
        return use(clicked, body.get("replace") is True)

    async def handle(request: Request) -> Response:
        """Answer a request with the result of `answer` as JSON, or {"error": sentence}.

        Raises HTTPException with status 400 if fields of its body are missing or wrong, and as
        `json_body` does for a body of over 200 000 bytes or other content.
        """
        body = await json_body(request, 200_000)  # bytes: far more than the clicks of a room
        try:
            return JSONResponse(await asyncio.to_thread(answer, body))
        except InputError as error:
            return JSONResponse({"error": str(error)})
        except (ValueError, TypeError, KeyError):
            raise HTTPException(400) from None

    return Route(path, handle, methods=["POST"])


def _patch_outlines(room: Room, picture: ClickedPicture) -> list[list[float]]:
    """Return the outlines of the sun patches in the room at the picture's time.

    An outline is a list x, y, x, y ... of pixel positions in the picture. The list is empty without
    sun above the horizon.
    """
    import cv2

    site = picture.session.site_file().site
    try:
        at = sun.position([parse_utc(picture.slot)], site)
    except ValueError:
        return []
    altitude_deg, azimuth_deg = float(at.altitude_deg[0]), float(at.azimuth_deg[0])
    if altitude_deg <= 0:
        return []
    to_sun = projection.direction(altitude_deg, azimuth_deg)[None]  # [1, 3]
    heading, size = picture.grid.heading_deg, _PATCH_HEIGHT_PX
    light = sun_patches(room, to_sun, 1.0, height=size, heading_deg=heading, sub=1)[0]  # [H, W]
    # Without the dim rim of a patch, where the sun is partly hidden. Chosen.
    is_lit = light > 0.05 * max(float(light.max()), 1e-12)
    mask = np.ascontiguousarray(is_lit.astype(np.uint8))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    scale = picture.grid.height_px / size
    outlines = [(contour.reshape(-1, 2) + 0.5) * scale for contour in contours if len(contour) > 2]
    return [np.round(outline, 1).ravel().tolist() for outline in outlines]
