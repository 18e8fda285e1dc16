"""The page of `fieldlum scene click`, which turns clicked corners of a panorama into a room."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import JsonTable, Room, parse_utc
from fieldlum.optics.images import read_panorama
from fieldlum.optics.projection import direction
from fieldlum.room.scene import sun_patches
from fieldlum.room.scene.clicked import ClickedRoom, ClickGrid, clicks_from_rows, room_from_clicks
from fieldlum.room.scene.drawing import compass_text, outline_pixels
from fieldlum.session import Session, update_session, write_file
from fieldlum.session.site_toml import site_table
from fieldlum.sky import sun
from fieldlum.web.server import json_body, picture_routes, static_route
from fieldlum.web.snapshot import scale_of

_PATCH_HEIGHT_PX = 90  # of the sun patch that is drawn: 2 degrees a pixel; chosen
_NUMBERS_KEPT = ("width_m", "depth_m", "height_m", "camera_x_m", "camera_y_m", "wall_azimuth_deg")


@dataclass(frozen=True, slots=True)
class ClickedPicture:
    """The panorama whose corners the user clicks; slot: its id; grid: its pixels and heading."""

    session: Session
    slot: str
    grid: ClickGrid

    @classmethod
    def of(cls, session: Session, slot: str = "") -> ClickedPicture:
        """Return the panorama of a slot, or of "" the one with the highest sun.

        Raises InputError if it does not exist, NotEnoughDataError if no slot is merged.
        """
        files = session.panorama_files()
        chosen = next((path for path in files if path.stem == slot), None) if slot else None
        if not files:
            remedy = f"run fieldlum merge {session.root}"
            raise NotEnoughDataError(f"{session.root}: no merged panorama; {remedy}")
        if slot and chosen is None:
            expected = f"a slot such as {files[-1].stem}"
            raise InputError(session.root, f"no panorama {slot}", expected, "see panoramas/")
        heights_deg = {slot.id: slot.sun_altitude_deg for slot in session.slots()}
        path = chosen or max(files, key=lambda file: heights_deg.get(file.stem, -90.0))
        panorama = read_panorama(path)
        height, width = panorama.luminance_cdm2.shape
        return cls(session, path.stem, ClickGrid(height, width, panorama.heading_deg))


def clicked_table(clicked: ClickedRoom) -> JsonTable:
    """Return a clicked room with the keys of the page's JSON.

    rows: {"name", "value", "u"} for each length [m] and angle [deg] of `Room`, windows as
    window.NUMBER.left_m from 0; faces: compass direction of the south wall; walls: of each window;
    misfit_px, notes: as in `ClickedRoom`.
    """
    room = clicked.room
    rows = [(name, getattr(room, name)) for name in _NUMBERS_KEPT]
    for place, window in enumerate(room.window):
        names = ("left_m", "width_m", "sill_m", "height_m")
        rows += [(f"window.{place}.{name}", getattr(window, name)) for name in names]
    return {
        "rows": [{"name": name, "value": value, "u": clicked.u[name]} for name, value in rows],
        "faces": compass_text(room.wall_azimuth_deg),
        "walls": [window.wall for window in room.window],
        "misfit_px": clicked.misfit_px,
        "notes": list(clicked.notes),
    }


def save_room(session: Session, clicked: ClickedRoom, *, replace_room: bool) -> tuple[Path, bool]:
    """Write scene/clicked.toml, a complete SITE.toml with the clicked room.

    Also write the room into the session if it has none, or if `replace_room`. Return the file, and
    whether the room was written into the session. A box that the session has keeps what clicks do
    not measure, such as reflectances.
    """
    setup = session.site_file()
    room = clicked.room
    if setup.room is not None and setup.room.kind == "box":
        lengths = {name: getattr(room, name) for name in (*_NUMBERS_KEPT, "camera_z_m")}
        room = replace(setup.room, window=room.window, **lengths)
    camera = replace(setup.camera, height_m=room.camera_z_m)
    new = replace(setup, room=room, camera=camera)
    path = session.root / "scene" / "clicked.toml"
    lines = ["# Written by fieldlum scene click. Standard uncertainties, from the clicks' pixels:"]
    lines += [f"#   {name} +- {u:.3g}" for name, u in clicked.u.items()]
    write_file(path, "\n".join(lines) + "\n\n" + tomli_w.dumps(site_table(new)))
    is_written = setup.room is None or replace_room
    if is_written:
        update_session(session, {"setup": site_table(new)})
    return path, is_written


def click_routes(picture: ClickedPicture, camera_height_m: float) -> list[Route]:
    """Return the web routes of the page; camera_height_m: initial camera height on the page [m]."""
    session = picture.session

    def about(request: Request) -> Response:
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

    def solved(clicked: ClickedRoom, replace_room: bool) -> JsonTable:
        lines = outline_pixels(clicked.room, picture.grid)
        return clicked_table(clicked) | {"lines": lines, "patches": _patches(clicked.room, picture)}

    def saved(clicked: ClickedRoom, replace_room: bool) -> JsonTable:
        path, is_written = save_room(session, clicked, replace_room=replace_room)
        return {"file": str(path), "taken": is_written}

    def posted(path: str, make: Callable[[ClickedRoom, bool], JsonTable]) -> Route:
        """Return the route of `make` for posted clicks; an InputError becomes a sentence."""

        def answer(asked: Mapping[str, Any]) -> JsonTable:
            clicks, height_m = clicks_from_rows(asked["clicks"]), float(asked["camera_height_m"])
            clicked = room_from_clicks(clicks, picture.grid, height_m)
            return make(clicked, asked.get("replace") is True)

        async def handle(request: Request) -> Response:
            # bytes: far more than the clicks of a room
            asked = await json_body(request, 200_000)
            try:
                return JSONResponse(await asyncio.to_thread(answer, asked))
            except InputError as error:
                return JSONResponse({"error": str(error)})
            except (ValueError, TypeError, KeyError):
                raise HTTPException(400) from None

        return Route(path, handle, methods=["POST"])

    return [
        static_route("/", "click.html"),
        static_route("/click.js", "click.js"),
        static_route("/page.css", "page.css"),
        Route("/room.json", about),
        posted("/solve.json", solved),
        posted("/save.json", saved),
        *picture_routes(session),
    ]


def _patches(room: Room, picture: ClickedPicture) -> list[list[float]]:
    """Return outlines of the sun patch at the picture's hour, as pixel positions x, y, x, y ..."""
    import cv2

    site = picture.session.site_file().site
    try:
        at = sun.position([parse_utc(picture.slot)], site)
    except ValueError:
        return []
    altitude, azimuth = float(at.altitude_deg[0]), float(at.azimuth_deg[0])
    if altitude <= 0:
        return []
    toward = direction(altitude, azimuth)[None]
    heading = picture.grid.heading_deg
    size = _PATCH_HEIGHT_PX
    light = sun_patches(room, toward, 1.0, height=size, heading_deg=heading, sub=1)[0]  # [H, W]
    # the dim rim of a patch is no outline
    lit = light > 0.05 * max(float(light.max()), 1e-12)
    mask = np.ascontiguousarray(lit.astype(np.uint8))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    factor = picture.grid.height_px / _PATCH_HEIGHT_PX
    outlines = [(contour.reshape(-1, 2) + 0.5) * factor for contour in contours if len(contour) > 2]
    return [np.round(outline, 1).ravel().tolist() for outline in outlines]
