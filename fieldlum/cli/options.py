"""Options and arguments of several commands: one name, one meaning, one help text."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from datetime import date, datetime, time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from fieldlum.cli.command_parameters import FILE_PATH, PATH, declare
from fieldlum.core.errors import DeviceError, InputError

if TYPE_CHECKING:
    from fieldlum.core.scheduler import Scheduler
    from fieldlum.session import Session as OpenSession
else:
    OpenSession = Any  # the argument SESSION: the session of the folder that the user names

CaptureSet = Literal["month", "9-day", "12-day", "4-day", "even"]
Above0 = Annotated[float, click.FloatRange(min=0, min_open=True)]
Azimuths = Annotated[tuple[float, ...], click.FloatRange(-360, 360)]
Port = Annotated[int, click.IntRange(0, 65535)]
Seed = Annotated[int, click.IntRange(0, 2**32 - 1)]
Year = Annotated[int | None, click.IntRange(1950, 2100)]


def calendar_day(text: str) -> datetime:
    """Return the midnight that begins a date such as 2027-03-20, without a time zone.

    Raises click.BadParameter for a text that is no such date.
    """
    with suppress(ValueError):
        return datetime.combine(date.fromisoformat(text), time())
    raise click.BadParameter(f"{text}: expected a date that exists, like 2027-03-20")


DEVICES = ("camera", "pyranometer", "meter")


def _open_session(text: str) -> OpenSession:
    """Return the session in the folder that SESSION names."""
    from fieldlum.session import open_session

    return open_session(PATH.convert(text, None, None))  # no parameter, no context of click


def _scheduler(text: str) -> Scheduler:
    """Return the scheduler that --scheduler names."""
    from fieldlum.core.scheduler import parse_scheduler

    return parse_scheduler(text)


def _shared(
    session: Annotated[Any, "SESSION", _open_session],
    pairs: Annotated[Path, "SESSION|PAIRS.csv"],
    as_json: bool = False,
    force: bool = False,
    camera: str | None = None,
    pyranometer: str | None = None,
    meter: str | None = None,
    label_shift_min: Annotated[float, click.FloatRange(-720, 720)] = 0.0,
    site: Path | None = None,
    scene: str = "",
    sky_view: Annotated[Path | None, FILE_PATH] = None,
    scheduler: Annotated[Any, _scheduler] = "local",
    part: str = "",
) -> None:
    """Declare the options and arguments that several commands share, by name.

    Options:
      --json: Print the answer as one JSON object.
      --force: Compute again if nothing changed, and replace existing files.
      --camera URI: For example sim:office?seed=1, gphoto: or theta:http://192.168.1.1.
          [default: as in the last capture]
      --pyranometer URI: For example serial:/dev/ttyUSB0?kind=spn1. [default: as in the last
          capture]
      --meter URI: Illuminance meter at the lens, like cl200a:/dev/ttyUSB1. [default: as in the
          last capture]
      --label-shift MIN: Minutes to add to the times of the weather file, if they are known to be
          wrong.
      --site: SITE.toml. [default: the session's, or site.toml in the folder of the csv]
      --scene DIR|none: Folder of a fitted scene, or the word none. [default: scene/ next to the
          pairs, if it exists]
      --sky-view FILE: sky_view.exr that decides when the sun's disc is seen. [default: that of
          the session or the model, else estimated from the panoramas]
      --scheduler local|N|tcp://HOST:PORT|FILE.json: Where the work runs: here, in N processes,
          or on a Dask cluster (needs dask).
      --part NAME: Read this part, layer or stereo view of an .exr that has several.
    """


SHARED = {str(parameter.name): parameter for parameter in declare(_shared, "shared", {}).params}
"""Options and arguments of several commands, by the name of the function's parameter."""


def command_of(
    name: str, group: click.Group | None = None
) -> Callable[[Callable[..., Any]], click.Command]:
    """Return a decorator that turns a function into a command, as `command_parameters` describes.

    name: of the command; group: to which it is added, None for a command of `fieldlum` itself.
    """

    def decorate(function: Callable[..., Any]) -> click.Command:
        """Return the command that replaces the function; function: with its help as docstring."""
        created = declare(function, name, SHARED)
        if group is not None:
            group.add_command(created)
        return created

    return decorate


def device_uris(session: OpenSession, *given: str | None) -> tuple[str, ...]:
    """Return the URIs of camera, pyranometer and meter, in this order; "" without a device.

    given: the values of the three options; None takes the URI of the session's last capture. A
    given URI that names a program, a file or another computer is permitted from now on. Raises
    InputError for a URI in the session that needs a permission and has none on this computer, and
    for a session.toml that cannot be read.
    """
    from fieldlum.cli.terminal import say
    from fieldlum.devices.address_permission import permission_subject, require_permitted
    from fieldlum.session.permits import permit

    stored = session.table().get("devices", {}).get("uris", {})
    uris = dict(zip(DEVICES, given, strict=True))
    for name, uri in uris.items():
        if uri:
            try:
                with suppress(DeviceError):  # opening the device reports it
                    if wanted := permission_subject(uri):
                        permit(wanted)
            except OSError as error:
                say(f"note: could not store that you permit {uri} ({error}): name it again")
        elif uri is None and stored.get(name):
            require_permitted(stored[name], session.toml, f"--{name}")
    return tuple(stored.get(name, "") if uri is None else uri for name, uri in uris.items())


def new_files(*paths: Path | None, force: bool) -> None:
    """Raise InputError if a file to write exists already, unless `force`.

    paths: the files; None: there is no such file to write.
    """
    for path in paths:
        if path is not None and path.exists() and not force:
            remedy = "choose another name, or replace it by --force"
            raise InputError(path, "the file exists already", "a new file", remedy)


# Width by height of maps as in Liu, Colburn and Inanici 2020, and of a fisheye: evalglare's usual
# pictures are 800 to 1200 pixels across.
DEFAULT_SIZE, DEFAULT_FISHEYE_SIZE = "460x230", "1000x1000"


def picture_height(size: str | None, ratio: int = 2) -> int:
    """Return the height [px] that --size WxH states; ratio: W / H, 2 of a panorama, 1 of a fisheye.

    size: such as "460x230"; None for the default of this ratio. Raises click.UsageError for another
    ratio, or a height outside 8 to 8192 (a panorama of 0.5 GB).
    """
    example = DEFAULT_SIZE if ratio == 2 else DEFAULT_FISHEYE_SIZE
    size = size or example
    width, _, height = size.lower().partition("x")
    width_px, height_px = (int(t) if t.isdecimal() else 0 for t in (width, height))
    if width_px != ratio * height_px or not 8 <= height_px <= 8192:
        rule = "a panorama is twice as wide as high" if ratio == 2 else "a fisheye is square"
        raise click.UsageError(f"--size {size}: {rule}, 8 to 8192 pixels high, like {example}")
    return height_px
