"""`fieldlum export`: what was measured, in the files of other programs."""

from pathlib import Path

from fieldlum.cli.options import Azimuths, OpenSession, command_of
from fieldlum.cli.terminal import progress, tell


@command_of("export")
def command(session: OpenSession, out: Path | None = None, view_azimuths: Azimuths = ()) -> None:
    """Write a session's results for other programs.

    maps/SLOT-AZIMUTH.hdr: Radiance fisheyes with VIEW, for evalglare; sky_view.csv: the share of
    the sun's beam that arrives from each direction, and sky_view_mask.png; room.rad: the fitted or
    stated room, for Radiance; pairs.nc and year.nc: netCDF with units, for xarray. pairs.csv and
    hourly.csv of the session are tables already.

    \b
    Example:
      fieldlum export office-2027 --view-azimuth 180

    Options:
      --out: Folder to write. [default: SESSION/export]
      --view-azimuth DEG: Direction of the fisheyes, clockwise from true north; can be repeated.
          [default: the camera's heading]
    """
    from fieldlum.report.export_and_pack import export

    with progress("exporting"):
        files = export(session, out or session.root / "export", view_azimuths)
    for path in files:
        tell(str(path))
