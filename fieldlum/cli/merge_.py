"""`fieldlum merge`: turn brackets into calibrated luminance maps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from fieldlum.cli.options import (
    DEFAULT_FISHEYE_SIZE,
    DEFAULT_SIZE,
    command_of,
    dimensions,
    new_file,
    panorama_height,
    scheduler_of,
)
from fieldlum.cli.terminal import print_answer, progress, say
from fieldlum.core.errors import InputError

if TYPE_CHECKING:
    from fieldlum.core.scheduler import Scheduler
    from fieldlum.merge import MergeOptions
    from fieldlum.session import Session


@command_of("merge")
def command(
    session: Path | None = None,
    more: tuple[Path, ...] = (),
    frames: bool = False,
    camera: str | None = None,
    out: Path | None = None,
    size: str | None = None,
    projection: Literal["equirect", "fisheye"] = "equirect",
    heading: float = 180.0,
    fit: bool | None = None,
    scheduler_text: str = "local",
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Merge brackets to calibrated luminance maps.

    \b
    Example:
      fieldlum merge my-session --scheduler processes:2
      fieldlum merge --frames *.JPG --camera mine.toml --out office.hdr --projection fisheye

    Options:
      --frames: Merge the named FILES instead of a session.
      --camera: Camera profile: a TOML file or a name in calibration/ (with --frames).
      --out: OUT.exr or OUT.hdr (with --frames).
      --size WxH: Size of the result. [default: that of the session's panoramas, else 460x230;
          fisheye 1000x1000]
      --projection: Panorama, or equidistant fisheye along the first lens (with --frames).
      --heading DEG: Azimuth that the camera faces (with --frames).
      --fit/--no-fit: Estimate exposure ratios from the frames. [default: for raw frames
          only]
    """
    from fieldlum.merge import MergeOptions
    from fieldlum.session import open_session

    if session is None or (frames and (not camera or out is None)):
        raise click.UsageError("name a SESSION, or --frames FILE... --camera PROFILE --out OUT")
    if frames:
        assert camera and out is not None
        new_file(out, force)
        options = MergeOptions(_file_height(size, projection), projection, fit)
        _merge_files([session, *more], camera, out, options, heading, as_json)
        return
    if more or camera or out or projection != "equirect":
        raise click.UsageError("several files, --camera, --out and --projection need --frames")
    height = panorama_height(size) if size else _present_height(open_session(session))
    options = MergeOptions(height, fit=fit)
    _merge_session(open_session(session), options, scheduler_of(scheduler_text), force, as_json)


def _present_height(session: Session) -> int:
    """Return the height of the session's panoramas, so that later brackets get the same size."""
    from fieldlum.session.files.sidecar import newest_sidecar

    before = newest_sidecar(session)
    height = None if before is None else before.inputs.get("height")
    return height if isinstance(height, int) else panorama_height(DEFAULT_SIZE)


def _file_height(size: str | None, projection: str) -> int:
    if projection == "equirect":
        return panorama_height(size or DEFAULT_SIZE)
    width, height = dimensions(size or DEFAULT_FISHEYE_SIZE)
    if width != height:
        rule = f"a fisheye picture must be square, for example {DEFAULT_FISHEYE_SIZE}"
        raise click.UsageError(f"--size {size}: {rule}")
    return height


def _merge_session(
    session: Session, options: MergeOptions, scheduler: Scheduler, force: bool, as_json: bool
) -> None:
    from fieldlum import merge

    with progress("Merge") as bar:
        verdicts = merge.run(session, options, scheduler=scheduler, force=force, progress=bar)
    lines = [f"{v.slot} {v.state}: {v.text}" for v in verdicts]
    print_answer(as_json, {"slots": [v.table() for v in verdicts]}, lines)
    counts = Counter(v.state for v in verdicts)
    if not as_json:
        say(", ".join(f"{counts[s]} {s}" for s in ("merged", "kept", "failed") if counts[s]))
        if (sheet := session.panoramas / "contact-1.png").is_file():
            say(f"look at {sheet}")
    if counts["failed"]:
        raise SystemExit(InputError.exit_code)


def _merge_files(
    files: list[Path],
    camera: str,
    out: Path,
    options: MergeOptions,
    heading_deg: float,
    as_json: bool,
) -> None:
    from fieldlum.merge import files_to_picture
    from fieldlum.optics.profiles import load_camera_profile

    with progress("Merge") as bar:
        result, facts = files_to_picture(
            files, load_camera_profile(camera), out, options, heading_deg=heading_deg, progress=bar
        )
    lines, names = [f"{out}: {result.verdict}"], [f.file for f in result.report.frames]
    for pair in result.report.neighbours:
        pixels = f"{pair.residual_percent:+.2f} % ({pair.pixels} pixels)"
        lines.append(f"  {names[pair.long]} to {names[pair.short]}: {pixels}")
    for name, value in facts.items():
        lines.append(f"  {name}: {value:.5g}" if isinstance(value, float) else f"  {name}: {value}")
    answer = {"out": str(out), "verdict": result.verdict, **facts, "quality": result.quality}
    print_answer(as_json, answer, lines)
