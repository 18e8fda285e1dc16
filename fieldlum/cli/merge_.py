"""`fieldlum merge`: brackets to calibrated luminance maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli.options import (
    DEFAULT_FISHEYE_SIZE,
    DEFAULT_SIZE,
    dimensions,
    force_option,
    json_option,
    panorama_height,
    scheduler_of,
    scheduler_option,
)
from fieldlum.cli.terminal import emit_json, progress, say

if TYPE_CHECKING:
    from fieldlum.scheduler import Scheduler


@click.command()
@click.argument("session", required=False, type=click.Path(path_type=Path))
@click.argument("more", nargs=-1, type=click.Path(path_type=Path))
@click.option("--frames", is_flag=True, help="Merge the FILES named, instead of a session.")
@click.option(
    "--camera", help="Camera profile: a TOML file or a name in calibration/ (with --frames)."
)
@click.option("--out", type=click.Path(path_type=Path), help="OUT.exr or OUT.hdr (with --frames).")
@click.option(
    "--size", help=f"WxH of the result. [default: {DEFAULT_SIZE}; fisheye {DEFAULT_FISHEYE_SIZE}]"
)
@click.option(
    "--projection",
    type=click.Choice(["equirect", "fisheye"]),
    default="equirect",
    show_default=True,
    help="Panorama, or equidistant fisheye along the first lens (with --frames).",
)
@click.option(
    "--heading",
    type=float,
    default=180.0,
    show_default=True,
    help="Where the camera looks, with --frames.",
)
@click.option(
    "--fit/--no-fit",
    default=None,
    help="Estimate exposure ratios from the frames.  [default: raw only]",
)
@click.option(
    "--drop-moved", is_flag=True, help="Leave frames out of pixels that something moved through."
)
@click.option(
    "--workers",
    type=click.IntRange(1),
    metavar="N",
    help="The same as --scheduler processes:N.",
)
@scheduler_option
@force_option
@json_option
def command(
    session: Path | None,
    more: tuple[Path, ...],
    frames: bool,
    camera: str | None,
    out: Path | None,
    size: str | None,
    projection: str,
    heading: float,
    fit: bool | None,
    drop_moved: bool,
    workers: int | None,
    scheduler_text: str,
    force: bool,
    as_json: bool,
) -> None:
    """Merge brackets to calibrated luminance maps.

    \b
    Example:
      fieldlum merge my-session --scheduler processes:2
      fieldlum merge --frames *.JPG --camera mine.toml --out office.hdr --projection fisheye
    """
    if session is None:
        raise click.UsageError("name a SESSION, or --frames FILE... --camera PROFILE --out OUT")
    if frames:
        if not camera or out is None:
            raise click.UsageError("--frames needs --camera PROFILE and --out OUT.exr or OUT.hdr")
        _merge_files(
            [session, *more], camera, out, size, projection, heading, fit, drop_moved, as_json
        )
        return
    if more:
        raise click.UsageError(f"one SESSION, not {1 + len(more)} paths; for files use --frames")
    if camera or out or projection != "equirect":
        raise click.UsageError(
            "--camera, --out and --projection go with --frames; a session knows its own"
        )
    scheduler = scheduler_of(scheduler_text, workers)
    _merge_session(
        session, panorama_height(size or DEFAULT_SIZE), fit, drop_moved, scheduler, force, as_json
    )


def _merge_session(
    root: Path,
    height: int,
    fit: bool | None,
    drop_moved: bool,
    scheduler: Scheduler,
    force: bool,
    as_json: bool,
) -> None:
    from dataclasses import asdict

    from fieldlum import merge
    from fieldlum.session import open_session

    with progress("Merge") as bar:
        verdicts = merge.run(
            open_session(root),
            scheduler=scheduler,
            height=height,
            fit=fit,
            drop_moved=drop_moved,
            force=force,
            progress=bar,
        )
    if as_json:
        emit_json({"slots": [asdict(v) for v in verdicts]})
        return
    for v in verdicts:
        click.echo(f"{v.slot} {v.state}: {v.text}")
    counts = {
        state: sum(v.state == state for v in verdicts) for state in ("merged", "kept", "failed")
    }
    say(", ".join(f"{n} {state}" for state, n in counts.items() if n))


def _merge_files(
    files: list[Path],
    camera: str,
    out: Path,
    size: str | None,
    projection: str,
    heading: float,
    fit: bool | None,
    drop_moved: bool,
    as_json: bool,
) -> None:
    from fieldlum.merge import files_to_picture
    from fieldlum.profiles import load_camera_profile

    if projection == "equirect":
        pixels = panorama_height(size or DEFAULT_SIZE)
    else:
        width, pixels = dimensions(size or DEFAULT_FISHEYE_SIZE)
        if width != pixels:
            raise click.UsageError(f"--size {size}: a fisheye picture is square")
    with progress("Merge") as bar:
        result, facts = files_to_picture(
            files,
            load_camera_profile(camera),
            out,
            pixels=pixels,
            projection=projection,
            heading_deg=heading,
            fit=fit,
            drop_moved=drop_moved,
            progress=bar,
        )
    if as_json:
        emit_json({"out": str(out), "verdict": result.verdict, **facts, "quality": result.quality})
        return
    click.echo(f"{out}: {result.verdict}")
    for n in result.quality["neighbours"]:
        long, short = (result.quality["frames"][n[k]]["file"] for k in ("long", "short"))
        click.echo(f"  {long} to {short}: {n['residual_percent']:+.2f} % ({n['pixels']} pixels)")
    for name, value in facts.items():
        click.echo(f"  {name}: {value:.5g}" if isinstance(value, float) else f"  {name}: {value}")
