"""`fieldlum view`: show luminance pictures."""

from pathlib import Path
from typing import Annotated, Any

import click

from fieldlum.cli.command_parameters import FILE_PATH
from fieldlum.cli.options import command_of, new_files
from fieldlum.cli.terminal import notes, say, table_lines, tell
from fieldlum.core.errors import InputError, NotEnoughDataError


def _region(text: str) -> Any:
    """Return the region that a text of --region describes."""
    from fieldlum.report.view import parse_region

    return parse_region(text)


@command_of("view")
def command(
    files: tuple[Path, ...],
    out: Annotated[Path | None, FILE_PATH] = None,
    regions: Annotated[tuple[Any, ...], _region] = (),
    csv_path: Annotated[Path | None, FILE_PATH] = None,
    view_options: str = "",
    part: str = "",
    force: bool = False,
) -> None:
    """Show pictures in false colour, with statistics of regions.

    FILES are .exr or .hdr; a session means its latest panorama. Several pictures share one scale.
    If a file cannot be read, it is reported, the others are shown, and the exit code is 3.

    \b
    Example:
      fieldlum view office.hdr --out office.html --region cone:180,-30,15 --csv regions.csv

    Options:
      --out FILE.png|FILE.html: False-colour picture (.png), or a page that works offline
          (.html). [default: FILE-view.html of the first picture]
      --region REGION: Statistics of rect:x,y,w,h, circle:x,y,r (pixels from the top left) or
          cone:AZ,ALT,RADIUS (degrees; azimuth from north); can be repeated.
      --csv FILE: Write the statistics of the regions.
      --view VIEW: View of the pictures, as for fieldlum glare.
    """
    from fieldlum.report import view
    from fieldlum.session.codec import write_csv

    if csv_path is not None and not regions:
        raise click.UsageError("--csv has the statistics of regions: name one with --region")
    new_files(out, csv_path, force=force)
    files = tuple(map(_latest_panorama, files))
    out = out or files[0].with_name(f"{files[0].stem}-view.html")
    if out.suffix.lower() not in (".png", ".html"):
        raise click.BadParameter(f"{out}: expected a .png or .html file", param_hint="--out")
    pictures: list[view.MeasuredPicture] = []
    for path in files:
        try:
            pictures.append(view.read_measured_picture(path, part, view_options))
        except InputError as error:
            say(f"fieldlum view: {error}")
    rows = [view.region_statistics(region, picture) for picture in pictures for region in regions]
    if pictures and out.suffix.lower() == ".png":
        view.write_png(out, pictures, regions)
    elif pictures:
        view.write_page(out, pictures, rows)
    for picture in pictures:
        notes(f"{picture.name}: {note}" for note in picture.notes)
    for line in (*table_lines(rows), *([str(out)] if pictures else ())):
        tell(line)
    if csv_path is not None:
        write_csv(csv_path, rows)
    if len(pictures) < len(files):
        raise SystemExit(InputError.exit_code)


def _latest_panorama(path: Path) -> Path:
    """Return the latest panorama of a session, or the path itself if it is no folder."""
    from fieldlum.session import open_session

    if not path.is_dir():
        return path
    panoramas = sorted(open_session(path).panorama_files())
    if not panoramas:
        raise NotEnoughDataError(f"{path}: no panorama to view; run fieldlum merge {path}")
    say(f"note: {panoramas[-1]} is the latest panorama, of {len(panoramas)}")
    return panoramas[-1]
