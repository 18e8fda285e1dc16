"""`fieldlum permit`: permit a link in a session."""

from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli.command_parameters import EXISTING_PATH
from fieldlum.cli.options import command_of
from fieldlum.core.errors import InputError


@command_of("permit")
def command(links: Annotated[tuple[Path, ...], "LINK...", EXISTING_PATH]) -> None:
    """Permit a link in a session, such as raw on another disk.

    A link can lead out of the session; fieldlum follows it after you permit it. The permission
    holds on this computer until the link's target changes.

    \b
    Example:
      fieldlum permit office-2027/raw
    """
    from fieldlum.session.permits import permit
    from fieldlum.session.safe_paths import link_subject

    for path in links:
        if not path.is_symlink():
            raise InputError(path, "no link", "a link in a session", "name the link itself")
        permit(link_subject(path, path.resolve()))
        click.echo(f"{path}: the link to {path.resolve()} is permitted on this computer")
