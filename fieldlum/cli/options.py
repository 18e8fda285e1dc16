"""Define options and arguments of several commands: one name, one meaning, one help text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from fieldlum.core.scheduler import Scheduler
    from fieldlum.session import Session

Command = TypeVar("Command", bound=Callable[..., Any])
Decorator = Callable[[Command], Command]


class LazyGroup(click.Group):
    """A group that loads the module of a command only when the command is used.

    names: in the order of the help. module: name of a command's module in this package, with {} for
    the command's name; the module has a click command `command`.
    """

    def __init__(self, *args: Any, names: Sequence[str], module: str, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._names, self._module = tuple(names), module

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return list(self._names)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, or None for an unknown name."""
        if cmd_name not in self._names:
            return None
        return import_module(f"fieldlum.cli.{self._module.format(cmd_name)}").command


class _LocalPath(click.Path):
    """A path of the file system.

    URLs are rejected, because one would become a folder named "s3:".
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if "://" in str(value):
            self.fail(
                f"{value} is a URL; expected a path, because a bucket has no locks; only "
                "pair --pairs-to and predict --maps-to write to a URL",
                param,
                ctx,
            )
        return super().convert(value, param, ctx)


class _PathOrUrl(click.Path):
    """A path of a file system, or a URL as text."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return str(value) if "://" in str(value) else super().convert(value, param, ctx)


PATH = _LocalPath(path_type=Path)
PATH_OR_URL = _PathOrUrl(path_type=Path)
EXISTING_PATH = _LocalPath(path_type=Path, exists=True)
FILE_PATH = _LocalPath(path_type=Path, dir_okay=False)
CAPTURE_SET = click.Choice(("month", "9-day", "12-day", "4-day", "even", "best"))

session_argument = click.argument("session_folder", metavar="SESSION", type=PATH)
"""The session folder, as the parameter `session_folder`."""

pairs_argument = click.argument("pairs", metavar="SESSION|PAIRS.csv", type=PATH)
"""A session or a pairs.csv, as the parameter `pairs`."""

_OF_LAST_CAPTURE = "[default: as in the last capture]"
_DEVICES = (
    ("--camera", "For example sim:office?seed=1, gphoto: or theta:http://192.168.1.1."),
    ("--pyranometer", "For example serial:/dev/ttyUSB0?kind=spn1."),
    ("--meter", "Illuminance meter at the lens, like cl200a:/dev/ttyUSB1."),
)


def device_options(function: Command) -> Command:
    """Add the options --camera, --pyranometer and --meter to a command."""
    for name, text in reversed(_DEVICES):
        function = click.option(name, metavar="URI", help=f"{text} {_OF_LAST_CAPTURE}")(function)
    return function


def device_uris(session: Session, *given: str | None) -> tuple[str, ...]:
    """Return the URIs of camera, pyranometer and meter, in this order; "" without a device.

    given: the values of the three options; None takes the URI of the session's last capture. A
    given URI that names a program, a file or another computer is permitted from now on. Raises
    InputError for one of the session that was never permitted on this computer.
    """
    from fieldlum.devices.stored import require_permitted

    uris = session.table().get("devices", {}).get("uris", {})
    answer = []
    for (option, _), uri in zip(_DEVICES, given, strict=True):
        if uri is None:
            uri = uris.get(option.removeprefix("--"), "")
            if uri:
                require_permitted(uri, session.toml, option)
        else:
            _permit_device(uri)
        answer.append(uri)
    return tuple(answer)


def _permit_device(uri: str) -> None:
    """Permit a URI that the user named, for later commands that take it from the session."""
    from fieldlum.cli.terminal import say
    from fieldlum.core.errors import DeviceError
    from fieldlum.devices.stored import names_more
    from fieldlum.session.permits import permit

    try:
        if uri and (wanted := names_more(uri)):
            permit(wanted)
    except DeviceError:  # opening the device reports it
        return
    except OSError as error:
        say(f"note: could not store that you permit {uri} ({error}): name it again next time")


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the answer as one JSON object."
)
json_lines_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object for each file, one per line."
)
force_option = click.option(
    "--force", is_flag=True, help="Compute again, even if the inputs have not changed."
)
label_shift_option = click.option(
    "--label-shift",
    "label_shift_min",
    type=click.FloatRange(-720, 720),
    default=0.0,
    metavar="MIN",
    help="Minutes to add to the times of the weather file, if they are known to be wrong.",
)
site_option = click.option(
    "--site",
    type=PATH,
    help="SITE.toml. [default: the session's, or site.toml in the folder of the csv]",
)
scene_option = click.option(
    "--scene",
    metavar="DIR|none",
    default="",
    help="Folder of a fitted scene, or the word none. [default: scene/ next to the pairs, if it "
    "exists]",
)

sky_view_option = click.option(
    "--sky-view",
    type=FILE_PATH,
    metavar="FILE",
    help="sky_view.exr that decides when the sun's disc is seen. [default: that of the session, "
    "else estimated from the panoramas]",
)


def out_option(content: str, *, default: str = "", required: bool = False) -> Decorator:
    """Return the click option --out; its help is `content` "to write", such as "Plan to write"."""
    text = f"{content} to write." + (f" [default: {default}]" if default else "")
    return click.option("--out", type=PATH, required=required, help=text)


def budget_option(default_min: float, text: str) -> Decorator:
    """Return the click option --budget, in minutes, with the help `text`."""
    return click.option(
        "--budget",
        default=default_min,
        show_default=True,
        type=click.FloatRange(min=0, min_open=True),
        help=text,
    )


seeds_option = click.option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(min=1),
    help="Trainings of each random model, with seeds 0, 1, 2 ...",
)
scheduler_option = click.option(
    "--scheduler",
    "--workers",
    "scheduler_text",
    default="local",
    show_default=True,
    metavar="local|N|processes:N|tcp://HOST:PORT|FILE.json",
    help="Where the work runs: here, in N processes, or on a Dask cluster (fieldlum[cluster]).",
)
"""Where units of work run, as the parameter `scheduler_text`."""


def scheduler_of(text: str) -> Scheduler:
    """Return the scheduler for the text of --scheduler. Raises InputError for an unknown text."""
    from fieldlum.cli.terminal import say
    from fieldlum.core.scheduler import parse_scheduler

    return parse_scheduler(text, say)


# ----------------------------------------------------------------------------------------------
# sizes

DEFAULT_SIZE = "460x230"  # the maps of Liu, Colburn and Inanici 2020
DEFAULT_FISHEYE_SIZE = "1000x1000"  # evalglare's usual pictures are 800 to 1200 pixels across
_LARGEST_PX = 16384  # largest width: a map of 134 million pixels, 0.5 GB in float32; chosen


def dimensions(size: str) -> tuple[int, int]:
    """Parse --size WxH to width and height [px]. Raises click.UsageError for anything else."""
    width, _, height = size.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise click.UsageError(f"--size {size}: write WIDTHxHEIGHT, for example {DEFAULT_SIZE}")
    if not (8 <= int(width) <= _LARGEST_PX and 8 <= int(height) <= _LARGEST_PX // 2):
        raise click.UsageError(
            f"--size {size}: the width must be 8 to {_LARGEST_PX}, the height 8 to "
            f"{_LARGEST_PX // 2}"
        )
    return int(width), int(height)


def panorama_height(size: str) -> int:
    """Parse a panorama's --size WxH to its height [px]. Raises click.UsageError unless W = 2H."""
    width, height = dimensions(size)
    if width != 2 * height:
        raise click.UsageError(
            f"--size {size}: a panorama must be twice as wide as high, for example {DEFAULT_SIZE}"
        )
    return height


part_option = click.option(
    "--part",
    default="",
    metavar="NAME",
    help="Read this part, layer or stereo view of an .exr that has several.",
)
