"""`fieldlum scene click`: describe the room by clicking its corners on a panorama."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import Port, command_of


@command_of("click")
def command(
    session_folder: Path,
    slot: str = "",
    csv_path: Path | None = None,
    camera_height_m: Annotated[float | None, click.FloatRange(0.05, 50.0)] = None,
    replace_room: bool = False,
    port: Port = 8766,
    as_json: bool = False,
) -> None:
    """Describe the room by clicking its corners on a panorama.

    Click corners of floor, ceiling and windows. The box, the windows and the hour's sun patch are
    drawn over the picture at once. The command writes scene/clicked.toml. The session gets this
    room if it has no [room], or if you replace it; `scene fit` then starts from it.

    \b
    Example:
      fieldlum scene click office-2027
      fieldlum scene click office-2027 --csv corners.csv --camera-height 1.42

    Options:
      --slot: Panorama to click on. [default: the newest]
      --csv FILE: Read corners from a csv of kind,window,x_px,y_px instead of a page.
      --camera-height M: Height of the lens above the floor, the only length needed.
          [default: the session's]
      --replace: With --csv: replace the room that the session has.
      --port: Port of the page; 0 takes a free one.
    """
    from fieldlum.session import open_session

    session = open_session(session_folder)
    height_m = camera_height_m or session.site_file().camera.height_m
    with terminal.web_library():
        from fieldlum.web import click_room, server
    picture = click_room.ClickedPicture.of(session, slot)
    if csv_path is None:
        served = server.prepare(click_room.click_routes(picture, height_m), port, lan=False)
        click.echo(served.address)
        sys.stdout.flush()
        with terminal.unattended():
            served.run()
        return
    from fieldlum.room.scene.clicked import room_from_clicks
    from fieldlum.room.scene.clicks import read_clicks

    clicked = room_from_clicks(read_clicks(csv_path), picture.grid, height_m, where=str(csv_path))
    table = click_room.clicked_table(clicked)
    path, taken = click_room.save_room(session, clicked, replace_room=replace_room)
    if as_json:
        terminal.emit_json({**table, "file": str(path), "taken": taken})
        return
    for row in table["rows"]:
        click.echo(f"{row['name']:22} {row['value']:9.3f} +- {row['u']:.3f}")
    click.echo(f"the south wall faces {table['faces']}; misfit {clicked.misfit_px:.2f} px rms")
    for note in clicked.notes:
        terminal.say(f"note: {note}")
    earlier = "the session still has its earlier room: use --replace to replace it"
    terminal.say(f"written: {path}; {'the session has this room now' if taken else earlier}")
