"""`fieldlum glare`: glare of single pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from fieldlum.cli.options import json_lines_option
from fieldlum.cli.terminal import emit_json, say


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--view-azimuth",
    "azimuths",
    multiple=True,
    type=float,
    metavar="DEG",
    help="Look there, clockwise from true north; may be given several times. [default: where it "
    "faces]",
)
@json_lines_option
@click.option(
    "--reference", is_flag=True, help="Ask evalglare too, on an 800-pixel fisheye of each view."
)
def command(
    images: tuple[Path, ...], azimuths: tuple[float, ...], as_json: bool, reference: bool
) -> None:
    """Glare of panoramas and fisheyes (.exr, .hdr).

    A panorama is looked at in ten directions unless --view-azimuth names some; a fisheye in its
    own. A picture without a true VIEW is refused, with the line to write.

    \b
    Example:
      fieldlum glare panoramas/20270320T193000Z.exr --view-azimuth 180 --view-azimuth 216 --json
    """
    if not all(math.isfinite(azimuth) for azimuth in azimuths):
        raise click.BadParameter("write degrees, like 180", param_hint="--view-azimuth")
    from fieldlum.glare.single import picture_glare

    for path in images:
        answer = picture_glare(path, azimuths, reference=reference)
        for warning in answer["warnings"]:
            say(f"fieldlum glare: {path}: {warning}")
        if as_json:
            emit_json(answer)
        else:
            _table(answer)


def _table(answer: dict[str, Any]) -> None:
    click.echo(f"{answer['file']}  (DGP, DGPs: 0 to 1; Ev, melanopic EDI: lx)")
    click.echo("  view     DGP   DGPs     Ev   m-EDI*   UGR    DGI   window:task  verdict")
    for view in answer["views"]:
        if view["dgp"] is None:
            click.echo(f"  {view['azimuth_deg']:5.1f}°  {view['verdict']}")
            continue
        shown = {k: "    -" if v is None else v for k, v in view.items()}
        bounds = (
            f", DGP {view['dgp_low']:.3f} to {view['dgp_high']:.3f}" if "dgp_low" in view else ""
        )
        click.echo(
            f"  {view['azimuth_deg']:5.1f}°  {view['dgp']:.3f}  {view['dgps']:.3f}  "
            f"{view['ev_lx']:6.0f}"
            f"  {view['melanopic_edi_lx']:6.0f}  {_figure(shown['ugr'])}  {_figure(shown['dgi'])}"
            f"  {_figure(shown['window_to_task'])}        {view['verdict']}{bounds}"
        )
    click.echo("  * an estimate: Ev with the spectrum of D65")


def _figure(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:5.1f}"
