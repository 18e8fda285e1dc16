"""`fieldlum merge`: turn brackets into calibrated luminance maps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from fieldlum.cli.options import OpenSession, command_of, new_files, picture_height
from fieldlum.cli.terminal import notes, print_answer, progress, say, table_lines
from fieldlum.core.errors import InputError

if TYPE_CHECKING:
    from fieldlum.merge import MergeResult


@command_of("merge")
def command(
    source: Annotated[Path | None, "[SESSION]"] = None,
    more: tuple[Path, ...] = (),
    frames: bool = False,
    camera: str | None = None,
    out: Path | None = None,
    size: str | None = None,
    projection: Literal["equirect", "fisheye"] = "equirect",
    heading: Annotated[float, click.FloatRange(-360, 360)] = 180.0,
    fit: bool | None = None,
    scheduler: Any = "local",
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Merge brackets to calibrated luminance maps.

    \b
    Example:
      fieldlum merge my-session --scheduler processes:2
      fieldlum merge --frames bracket/ --camera mine.toml --out office.hdr --projection fisheye

    Options:
      --frames: Merge the named files, or those in a folder, instead of a session.
      --camera PROFILE: Camera profile: a TOML file, or a shipped name (with --frames).
      --out: OUT.exr or OUT.hdr (with --frames).
      --size WxH: Size of the result. [default: that of the session's panoramas, else 460x230;
          fisheye 1000x1000]
      --projection: Panorama, or equidistant fisheye along the first lens (with --frames).
      --heading DEG: Azimuth that the camera faces, clockwise from true north (with --frames).
      --fit/--no-fit: Estimate exposure ratios from the frames. [default: for raw frames
          only]
    """
    from fieldlum import merge
    from fieldlum.optics.profiles import load_camera_profile, uncalibrated_text
    from fieldlum.optics.raw import frame_files
    from fieldlum.session import open_session

    if source is None or (frames and (not camera or out is None)):
        raise click.UsageError("name a SESSION, or --frames FILE... --camera PROFILE --out OUT")
    if frames:
        assert camera and out is not None
        new_files(out, force=force)
        height_px = picture_height(size, ratio=2 if projection == "equirect" else 1)
        options = merge.MergeOptions(height_px, projection, fit)
        files, profile = frame_files(source, *more), load_camera_profile(camera)
        notes(filter(None, [uncalibrated_text(profile)]))
        with progress("Merge"):
            result, facts = merge.files_to_picture(
                files, profile, out, options, heading_deg=heading
            )
        answer = {"out": str(out), "verdict": result.verdict, **facts, "quality": result.quality}
        print_answer(as_json, answer, _lines(out, result, facts))
        return
    if source.is_file() or more or camera or out or projection != "equirect" or heading != 180.0:
        raise click.UsageError("files, --camera, --out, --projection, --heading need --frames")
    session = open_session(source)
    profile = load_camera_profile(session.site_file().camera.profile)
    notes(filter(None, [uncalibrated_text(profile)]))
    options = merge.MergeOptions(picture_height(size or _present_size(session)), fit=fit)
    with progress("Merge"):
        verdicts = merge.run(session, options, scheduler=scheduler, force=force)
    lines = [f"{verdict.slot} {verdict.state}: {verdict.text}" for verdict in verdicts]
    print_answer(as_json, {"slots": [verdict.table() for verdict in verdicts]}, lines)
    counts = Counter(verdict.state for verdict in verdicts)
    if not as_json:
        say(", ".join(f"{counts[s]} {s}" for s in ("merged", "kept", "failed") if counts[s]))
        if (sheet := session.panoramas / "contact-1.png").is_file():
            say(f"look at {sheet}")
    if counts["failed"]:
        raise SystemExit(InputError.exit_code)


def _present_size(session: OpenSession) -> str | None:
    """Return the size of the session's panoramas as --size states it, None without any.

    Brackets that are merged later get the same size.
    """
    from fieldlum.session.files.sidecar import newest_sidecar

    newest = newest_sidecar(session)
    height = None if newest is None else newest.inputs.get("height")
    return f"{2 * height}x{height}" if isinstance(height, int) else None


def _lines(out: Path, result: MergeResult, facts: dict[str, float | None]) -> list[str]:
    """Return the lines that the terminal shows of a merged picture; facts: figures by name."""
    neighbours = table_lines(result.quality["neighbours"], indent="  ")
    unknown = "unknown: the lens did not see all that lights the plane"
    figures = [f"  {n}: {unknown if v is None else f'{v:.5g}'}" for n, v in facts.items()]
    return [f"{out}: {result.verdict}", *neighbours, *figures]
