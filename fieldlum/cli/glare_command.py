"""`fieldlum glare`: glare of single pictures."""

from collections.abc import Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import click

from fieldlum.cli.command_parameters import FILE_PATH
from fieldlum.cli.options import Azimuths, command_of, new_files
from fieldlum.cli.terminal import notes, print_answer, say, table_lines
from fieldlum.core.records import JsonTable

_COLUMNS = (
    *("azimuth_deg", "dgp", "dgp_low", "dgp_high", "dgps", "ev_lx", "melanopic_edi_lx"),
    *("u_melanopic_edi_lx", "ugr", "dgi", "window_to_task", "verdict"),
)


@command_of("glare")
def command(
    images: tuple[Path, ...],
    view_azimuths: Azimuths = (),
    view_options: str = "",
    part: str = "",
    calibrate_ev_lx: Annotated[float | None, click.FloatRange(min=0, min_open=True)] = None,
    csv_path: Annotated[Path | None, FILE_PATH] = None,
    budget_path: Annotated[Path | None, FILE_PATH] = None,
    json_lines: bool = False,
    reference: bool = False,
    lamps: bool | None = None,
    force: bool = False,
) -> None:
    """Compute glare of pictures (.exr, .hdr) or of a session's captures.

    A panorama is judged in ten directions unless --view-azimuth names some, a fisheye in
    its own direction, on its own pixels. If a picture cannot be read, it is reported, the others
    are judged, and the exit code is 3.

    \b
    Example:
      fieldlum glare panoramas/20270320T193000Z.exr --view-azimuth 180 --view-azimuth 216 --json

    Options:
      --json: Print one JSON object for each file, one per line.
      --view-azimuth DEG: Judge a panorama in this direction, clockwise from true north; can
          be repeated. [default: ten directions]
      --view VIEW OPTIONS: View of the pictures as Radiance options, such as "-vta -vd 0 -1
          0 -vh 180 -vv 180", or "equirect heading_deg=180"; replaces the VIEW of the file.
      --calibrate-ev LX: Scale each picture to this measured vertical illuminance of its
          (first) view.
      --csv FILE: Write one row for each picture and view.
      --budget FILE: Write each source of uncertainty of DGP, Ev, melanopic EDI and the pixel ahead
          as a csv (GUM), for each panorama and view.
      --reference: Also run evalglare and show its result.
      --lamps/--no-lamps: Electric light is on (melanopic EDI is 4 % lower), or off (it is more
          certain).
    """
    if budget_path is not None and (view_options or part or calibrate_ev_lx is not None):
        text = "--budget is of a picture as stored: no --view, --part, --calibrate-ev"
        raise click.UsageError(text)
    new_files(csv_path, budget_path, force=force)
    from fieldlum.core.errors import InputError, NotEnoughDataError
    from fieldlum.session import open_session
    from fieldlum.session.codec import write_csv
    from fieldlum.year.glare.picture_glare import picture_glare
    from fieldlum.year.glare.uncertainty_budget import Budget, budget_of_file, write_budgets

    folders = [open_session(path).panorama_files() if path.is_dir() else [path] for path in images]
    pictures = list(chain.from_iterable(folders))
    if not pictures:
        raise NotEnoughDataError(f"{images[0]}: no panorama to judge; run fieldlum merge SESSION")
    judge = partial(picture_glare, view_options=view_options, part=part, lamps=lamps)
    rows: list[dict[str, Any]] = []
    budgets: list[tuple[str, Budget]] = []
    unreadable = 0
    for path in pictures:
        try:
            answer = judge(path, view_azimuths, reference=reference, measured_ev_lx=calibrate_ev_lx)
            notes(f"{path}: {warning}" for warning in answer["warnings"])
            rows += csv_rows(answer)
            print_answer(json_lines, answer, _lines(answer))
            if budget_path is not None:
                seen_deg = [v["azimuth_deg"] for v in answer["views"] if v["dgp"] is not None]
                budgets += [(str(path), row) for row in budget_of_file(path, seen_deg, lamps)]
        except InputError as error:
            say(f"fieldlum glare: {error}")
            unreadable += 1
    if csv_path is not None:
        write_csv(csv_path, rows)
    if budget_path is not None and budgets:
        write_budgets(budget_path, budgets)
    if unreadable:
        raise SystemExit(InputError.exit_code)


def csv_rows(answer: JsonTable) -> list[dict[str, object]]:
    """Return one row of --csv, by column, for each view direction of a `glare` answer.

    answer: result of `picture_glare`, whose keys are the columns. Columns of the picture are
    repeated in each row; those of evalglare's figures begin with reference_. Lists and tables are
    left out, except the warnings, which become one text.
    """
    of_picture = {**answer, "warnings": "; ".join(answer["warnings"])}
    rows = []
    for view in answer["views"]:
        reference = {f"reference_{key}": v for key, v in (view.get("reference") or {}).items()}
        cells = {"file": answer["file"], **view, **of_picture, **reference}
        rows.append({k: v for k, v in cells.items() if not isinstance(v, dict | list | tuple)})
    return rows


def _lines(answer: JsonTable) -> Iterator[str]:
    """Yield the lines that the terminal shows of an answer of `glare --json`."""
    from fieldlum.session.panorama_sun import SUN_FROM

    yield answer["file"]
    if "calibration_factor" in answer:
        yield f"  scaled by {answer['calibration_factor']:.4g} to the measured illuminance"
    if (sun := answer["sun"]) is not None:
        source = SUN_FROM.get(str(sun["origin"]), str(sun["origin"]))
        yield f"  the sun's disc: {sun['normal_illuminance_lx']:.0f} lx normal to it, {source}"
    yield from table_lines(answer["views"], _COLUMNS, "  ")
    if others := [view["reference"] for view in answer["views"] if view.get("reference")]:
        yield from ("  evalglare:", *table_lines(others, indent="  "))
    share = answer["disturbed_share"]
    if share is not None and len(answer["views"]) > 1:
        yield f"  disturbing (DGP above 0.40) in {100 * share:.0f} % of the seen directions"
    by_colour = answer["melanopic_der"] == "colour"
    how = "the camera's colour" if by_colour else "an estimate: Ev with the spectrum of D65"
    yield f"  melanopic EDI by {how}"
