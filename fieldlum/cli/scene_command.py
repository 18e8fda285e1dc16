"""`fieldlum scene`: find the geometry of a room from its captures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from fieldlum.cli.options import Above0, OpenSession, Port, command_of
from fieldlum.cli.terminal import notes, print_answer, progress, say, table_lines, unattended
from fieldlum.core.records import JsonTable

if TYPE_CHECKING:
    from fieldlum.room.fit.scene_file import Scene


@click.group("scene")
def command() -> None:
    """Find the room's geometry, north and clock error from captures."""


@command_of("fit", command)
def fit(
    pairs: Path,
    site: Path | None = None,
    out: Path | None = None,
    clock_sd: Above0 = 5.0,
    as_json: bool = False,
) -> None:
    """Find north, clock, windows and furniture from captured sun patches.

    The fit starts from the site's `[room]`. It writes scene.toml, with values before and after the
    fit and their uncertainties, and pictures for checking. SITE.toml and the session do not change.
    `train` then uses scene/ next to the pairs, unless its --scene names another folder or none.

    \b
    Example:
      fieldlum scene fit office-2027
      fieldlum scene fit renderings/pairs.csv --site office.toml --out office-scene

    Options:
      --out: Folder to write. [default: scene/ in the session's folder]
      --clock-sd: Standard uncertainty of the captures' times in minutes; 0.1 for a clock
          set by NTP.
    """
    from fieldlum.learn.models.training_data import in_usual_room, load_pairs
    from fieldlum.room.fit.stage import run

    folder = out or (pairs if pairs.is_dir() else pairs.parent) / "scene"
    with progress("reading pictures"):
        data = in_usual_room(load_pairs(pairs, site))
    with progress("fitting the scene"):
        scene, files = run(data, folder, clock_sd_min=clock_sd)
    print_answer(as_json, answer_of(scene), _lines(scene))
    notes(() if as_json else scene.notes)
    say("written: " + ", ".join(str(file) for file in files))


def answer_of(scene: Scene) -> JsonTable:
    """Return the object that `scene fit --json` prints.

    Keys of `Scene`: north_deg, clock_min, u, chosen, verdict, trusted, hours, notes. Other keys:
    misfit_before, misfit_after, misfit_none: share (0 to 1) of pixels that are wrong with the
    stated room, the fitted room and no patch; camera_m: x, y, z; window: for each window wall,
    left_m, width_m, sill_m, height_m. expected_log10_mse, trusted_share: None; `train --json` has
    them.
    """
    room = scene.room
    of_scene = ("north_deg", "clock_min", "u", "chosen", "verdict", "trusted", "hours")
    of_window = ("wall", "left_m", "width_m", "sill_m", "height_m")
    misfits = {"misfit_before": "stated", "misfit_after": "fitted", "misfit_none": "none"}
    return {
        **{name: getattr(scene, name) for name in of_scene},
        **{name: scene.misfit.get(key) for name, key in misfits.items()},
        # keys of earlier versions, which scripts may read
        **dict.fromkeys(("expected_log10_mse", "trusted_share")),
        "camera_m": [room.camera_x_m, room.camera_y_m, room.camera_z_m],
        "window": [{name: getattr(window, name) for name in of_window} for window in room.window],
        "notes": list(scene.notes),
    }


def _lines(scene: Scene) -> list[str]:
    """Return the lines that the terminal shows of a fitted scene: its values, and the verdict."""
    rows = [
        {"name": name, "stated": scene.before[name], "fitted": value, "u": scene.u[name]}
        for name, value in scene.after.items()
    ]
    furniture = f"bars and furniture: {len(scene.room.obstruction)}"
    return [*table_lines(rows), furniture, scene.verdict]


@command_of("click", command)
def click_corners(
    session: OpenSession,
    slot: str = "",
    csv_path: Path | None = None,
    camera_height_m: Annotated[float | None, click.FloatRange(0.05, 50.0)] = None,
    force: bool = False,
    port: Port = 8766,
    as_json: bool = False,
) -> None:
    """Describe the room by clicking its corners on a panorama.

    Click corners of floor, ceiling and windows. The box, the windows and the hour's sun patch are
    drawn over the picture at once. The command writes scene/clicked.toml. The session gets this
    room if it has no [room], or with --csv and --force; `scene fit` then starts from it.

    \b
    Example:
      fieldlum scene click office-2027
      fieldlum scene click office-2027 --csv corners.csv --camera-height 1.42

    Options:
      --slot: Panorama to click on. [default: that with the highest sun]
      --csv FILE: Read corners from a csv of kind,window,x_px,y_px instead of a page.
      --camera-height M: Height of the lens above the floor, the only length needed.
          [default: the session's]
      --port: Port of the page; 0 takes a free one.
    """
    from fieldlum.web import click_room, server

    height_m = camera_height_m or session.site_file().camera.height_m
    picture = click_room.ClickedPicture.of(session, slot)
    if csv_path is None:
        served = server.prepare(click_room.click_routes(picture, height_m), port, lan=False)
        click.echo(served.address)
        sys.stdout.flush()
        with unattended():
            served.run()
        return
    from fieldlum.room.scene.clicked import read_clicks, room_from_clicks

    clicks, earlier = read_clicks(csv_path), session.site_file().room
    clicked = room_from_clicks(clicks, picture.grid, height_m, earlier, where=str(csv_path))
    table = click_room.clicked_table(clicked)
    path, is_written = click_room.save_room(session, clicked, replace_room=force)
    lines = [f"{row['name']:22} {row['value']:9.3f} +- {row['u']:.3f}" for row in table["rows"]]
    lines.append(f"the south wall faces {table['faces']}; misfit {clicked.misfit_px:.2f} px rms")
    print_answer(as_json, {**table, "file": str(path), "taken": is_written}, lines)
    if as_json:
        return
    notes(clicked.notes)
    earlier = "the session still has its earlier room: use --force to replace it"
    say(f"written: {path}; {'the session has this room now' if is_written else earlier}")
