"""The command line: one module per command.

stdout has the answer; stderr has notes and progress.
"""

import errno
import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import click

from fieldlum.cli.command_parameters import InOrder
from fieldlum.cli.terminal import printable, say
from fieldlum.core import errors
from fieldlum.version import __version__

# In the order of the work. Each name is a module of this folder with a click command `command`.
COMMANDS = (
    *("demo", "new", "plan", "doctor", "capture", "log", "import", "status", "watch"),
    *("calibrate", "merge", "pair", "scene", "train", "predict", "glare", "view", "bench"),
    *("report", "compare", "export", "pack", "simulate", "campaign", "info", "permit"),
)

INTERRUPTED = 130  # 128 + SIGINT, as POSIX shells report Ctrl-C
# Packages that may be missing, and the extra of pyproject.toml that has each. A small computer that
# only captures lacks those of `compute`.
EXTRAS = {
    **dict.fromkeys(("numba", "torch", "pyradiance"), "compute"),
    **dict.fromkeys(("starlette", "uvicorn"), "web"),
    **{"distributed": "cluster", "apprise": "notify"},
}

# What to do after an error of a folder or a disk, by errno. Such errors can happen in any command,
# and no stage can correct them.
_NOT_PERMITTED = "expected a place open to you; change its permissions, or choose another place"
_DISK_FULL = "free disk space, then start the command again: finished work is not repeated"
_KIND = "expected a folder where one is needed, a file where one is, no link or pipe; correct it"
DISK_TROUBLE = {
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), _NOT_PERMITTED),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _DISK_FULL),
    **dict.fromkeys((errno.ENOLCK, errno.ENOTSUP), "move the session to a disk with locks"),
    **dict.fromkeys((errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ELOOP, errno.ENXIO), _KIND),
    errno.EIO: "the disk or card does not answer: copy the readable files to another one",
    errno.ENAMETOOLONG: "choose shorter names",
    errno.EOVERFLOW: "restore the file from a copy, or remove it",
    errno.EMLINK: "use a copy of the folder (cp -r), whose files have one name each",
}


class _CommandGroup(InOrder):
    """The group of all commands, which prints the tool's own errors as one line.

    The module of a command is loaded only when the command is used.
    """

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, or None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        return import_module(f"fieldlum.cli.{cmd_name}_command").command

    def invoke(self, ctx: click.Context) -> object:
        """Run the command; print an expected error as one line and exit with its code."""
        _hold_standard_files()
        code = errors.InputError.exit_code
        try:
            with _warnings_as_notes(), _children_import_nothing_here():
                return super().invoke(ctx)
        except errors.FieldlumError as error:
            text, code = str(error), error.exit_code
        except OSError as error:
            if error.errno not in DISK_TROUBLE:
                raise
            # a temporary file's name is that of the file which it replaces, with a prefix
            place = re.sub(r"\.\w{12}\.tmp\.", "", f"{error.filename}: ") if error.filename else ""
            text = f"{place}{error.strerror or error}; {DISK_TROUBLE[error.errno]}"
        except ModuleNotFoundError as error:
            if error.name not in EXTRAS:
                raise
            how = errors.install_text(EXTRAS[error.name])
            text = f"the package {error.name} is not installed; {how}"
        except MemoryError as error:
            text = f"{errors.reason_of(error)}: look for a file of excessive size"
        except KeyboardInterrupt:
            text, code = "interrupted; start it again to continue", INTERRUPTED
        # One line, without control codes that file names may contain.
        line = printable(text.replace("\n", " "))
        click.echo(f"fieldlum {ctx.invoked_subcommand}: {line}", err=True)
        sys.exit(code)


@contextmanager
def _children_import_nothing_here() -> Iterator[None]:
    """Keep Python processes started in a `with` block from importing from the current folder.

    That folder may be a session from another person, whose files must not run.
    """
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _warnings_as_notes() -> Iterator[None]:
    """Print warnings raised in a `with` block on stderr, without control codes.

    A warning of fieldlum is one line, printed once; the others are shown as Python shows them.
    """
    with warnings.catch_warnings():
        show, shown = warnings.showwarning, set[str]()

        def note(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            """Print one warning; the arguments are those of `warnings.showwarning`.

            place, more: file, line and so on, which a warning of fieldlum does not show.
            """
            if issubclass(category, errors.Caution):
                if str(message) not in shown:
                    shown.add(str(message))
                    say(f"WARNING: {message}")
            else:
                show(printable(str(message)), category, *place, **more)

        warnings.showwarning = note
        yield


def _hold_standard_files() -> None:
    """Open the null device in place of each closed standard file (`<&- >&-`).

    Otherwise the next opened file, such as the journal, would get its number, and libraries would
    print into that file.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115


@click.group(
    cls=_CommandGroup,
    commands=dict.fromkeys(COMMANDS, click.Command(None)),  # in the order of --help
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(__version__, package_name="fieldlum")
def main() -> None:
    """From a camera, a pyranometer and a laptop on site to a year of luminance maps of a room.

    \b
    See all stages on simulated captures:   fieldlum demo
    Describe your own room:                 fieldlum new SITE.toml
    """
