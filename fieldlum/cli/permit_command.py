"""`fieldlum permit`: permit a room file that runs commands, or a link in a session."""

from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli.declared import EXISTING_PATH
from fieldlum.cli.options import command_of
from fieldlum.core.errors import InputError, kind_of


@command_of("permit")
def command(paths: Annotated[tuple[Path, ...], "PATH...", EXISTING_PATH]) -> None:
    """Permit a room file that runs commands, or a link in a session.

    A Radiance room file (kind = "radiance") can run any command, and a link can lead out of the
    session. fieldlum uses neither before you permit it. The permission holds on this computer until
    the file, a file that it names, or the link's target changes. Read a room file first.

    \b
    Example:
      fieldlum permit office.rad
    """
    from fieldlum.room.scene.embedded_commands import commands, what_runs
    from fieldlum.session.permits import permit
    from fieldlum.session.safe_paths import link_subject

    for path in paths:
        if path.is_symlink():
            permit(link_subject(path, path.resolve()))
            click.echo(f"{path}: the link to {path.resolve()} is permitted on this computer")
            continue
        if path.is_file() and (kind := kind_of(path.read_bytes()[:16])):
            raise InputError(path, kind, "a Radiance room file or a link", "name the room's file")
        wanted = what_runs(path)
        if wanted is None:
            click.echo(f"{path}: needs no permission: it runs nothing")
            continue
        permit(wanted)
        for line in commands(path):
            click.echo(f"{path}: runs: {ascii(line)[1:-1]}")
        click.echo(f"{path}: permitted on this computer until it changes")
