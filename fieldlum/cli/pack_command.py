"""`fieldlum pack`: a session as an archive for publication."""

from pathlib import Path
from typing import Annotated

import click
from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

from fieldlum.cli.command_parameters import FILE_PATH
from fieldlum.cli.options import OpenSession, command_of
from fieldlum.cli.terminal import notes, progress


@command_of("pack")
def command(
    session: OpenSession,
    archive: Annotated[Path, FILE_PATH],
    title: str,
    authors: tuple[str, ...],
    licence: str,
    publisher: str,
    people: str,
) -> None:
    """Pack a session for publication, with data sheet and DOI metadata.

    Frames whose EXIF has a position, an owner or a serial number are refused. Device addresses,
    messages, locks and models stay at home. Every file has its checksum in MANIFEST.sha256.

    \b
    Example:
      fieldlum pack office-2027 office-2027.zip --title "Office" --author "Roe, Jo" \
--licence CC-BY-4.0 --publisher Zenodo --people "nobody is visible"

    Options:
      --title: Title of the data set.
      --author NAME: Author as "Family, Given"; can be repeated.
      --licence SPDX: Licence of the data, such as CC-BY-4.0.
      --publisher TEXT: Who publishes it and gives the DOI, such as Zenodo or a university.
      --people TEXT: Who can be seen, and how they consented.
    """
    from fieldlum.report.export_and_pack import Statement, pack

    if not all(text.strip() for text in (title, *authors, publisher, people)):
        raise click.UsageError("--title, --author, --publisher and --people: write a text")
    try:
        spdx = canonicalize_license_expression(licence)
    except InvalidLicenseExpression as error:
        remedy = f"{error}; write an SPDX identifier, like CC-BY-4.0"
        raise click.BadParameter(remedy, param_hint="--licence") from error
    with progress("packing"):
        cautions = pack(session, archive, Statement(title, authors, spdx, publisher, people))
    notes(cautions)
    click.echo(str(archive))
