"""`fieldlum compare`: a simulation of the room and what was measured."""

from pathlib import Path
from typing import Annotated

from fieldlum.cli.command_parameters import EXISTING_PATH
from fieldlum.cli.options import Azimuths, OpenSession, command_of
from fieldlum.cli.terminal import print_answer, progress, say, table_lines


@command_of("compare")
def command(
    session: OpenSession,
    result: Annotated[Path, EXISTING_PATH],
    out: Path | None = None,
    view_azimuths: Azimuths = (),
    as_json: bool = False,
) -> None:
    """Compare a simulation with the measurement: where it errs, and when.

    RESULT is a folder of pictures named by slots (20270320T193000Z.hdr), compared with the
    captures; or a year of DGP or vertical illuminance, compared with the newest predicted year: a
    csv or tab-separated table with month, day, hour (or hoy, or 8760 rows) and dgp or ev, or a
    folder of honeybee-radiance with one GRID.dgp, .ill or .npy.

    \b
    Example:
      fieldlum compare office-2027 renderings/
      fieldlum compare office-2027 annual.tsv --view-azimuth 180

    Options:
      --out: Folder of compare.csv and compare.png. [default: SESSION/compare]
      --view-azimuth DEG: Direction of a view that the file does not name, clockwise from true
          north; repeat it for each sensor of a grid.
    """
    from fieldlum.report.compare import compare
    from fieldlum.year.predict import newest_annual

    folder, annual = out or session.root / "compare", newest_annual(session)
    with progress("comparing"):
        comparison = compare(session, result, folder, view_azimuths, annual)
    answer = {name: value for name, value in comparison._asdict().items() if name != "files"}
    lines = table_lines(comparison.surfaces or comparison.directions)
    print_answer(as_json, answer, [*lines, *comparison.text])
    say("written: " + ", ".join(str(path) for path in comparison.files))
