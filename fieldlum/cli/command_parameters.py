"""Declare a command's parameters once: types in the signature, help in the docstring.

    @command_of("log")
    def command(session: OpenSession, every_s: Annotated[float, click.FloatRange(0.1)] = 5.0):
        '''Log irradiance without a camera.

        Options:
          --every S: Seconds between rows.
        '''

A line of `Options:` belongs to the parameter of the same name, which may end with a unit or an s,
or begin with as_ (`--every` is `every_s`). A bool is a flag, a Literal a choice, `tuple[X, ...]`
can be repeated; a function in `Annotated` reads the text. A parameter without a line is a shared
option, by its name (`options.SHARED`), or an argument.
"""

import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import click

from fieldlum.core.errors import InputError, did_you_mean

_ENTRY = re.compile(r"(?P<names>--[^\s:]+)(?: (?P<metavar>.+?))?: (?P<help>.+)")


class _LocalPath(click.Path):
    """The type of an option or argument that is a path of the file system.

    URLs are rejected, because one would become a folder named "s3:". A missing path that must exist
    is an InputError, as for every missing file.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; raise BadParameter for an empty text or a URL."""
        if value == "":  # as of an empty variable of the shell; Path would be the current folder
            self.fail("an empty text; expected a path", param, ctx)
        if "://" in str(value):
            self.fail(f"{value} is a URL; copy its content, and name the path", param, ctx)
        if self.exists and not Path(value).exists():
            what = "a file or folder that exists"
            raise InputError(value, "no such file or folder", what, "check the path")
        return super().convert(value, param, ctx)


class Named(click.Choice[str]):
    """One of some names; the error for another text has the most similar name."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """Return the text of the error; the arguments are those of click."""
        near = did_you_mean(str(value), map(str, self.choices))
        return super().get_invalid_choice_message(value, ctx).rstrip(".") + near


def numbers(count: int, mark: str) -> Callable[[str], tuple[float, ...]]:
    """Return the type of an option of `count` numbers with a `mark` between, such as 9x6.

    The type is a function that converts the option's text to a tuple. For any other text it raises
    ValueError, which click prints as an error of usage.
    """

    def read(text: str) -> tuple[float, ...]:
        """Return the numbers in a text; raise ValueError for any other text."""
        with suppress(ValueError):
            values = tuple(float(part) for part in text.lower().split(mark))
            if len(values) == count and all(map(math.isfinite, values)):
                return values
        raise ValueError(f"{text}: expected {count} numbers with '{mark}' between")

    return read


class InOrder(click.Group):
    """A group that lists its commands in the order of the work."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return list(self.commands)


PATH = _LocalPath(path_type=Path)
EXISTING_PATH = _LocalPath(path_type=Path, exists=True)
FILE_PATH = _LocalPath(path_type=Path, dir_okay=False)


def declare(
    function: Callable[..., Any], name: str, shared: Mapping[str, click.Parameter]
) -> click.Command:
    """Return a click command that calls a function; the function's parameters are its options.

    name: of the command. The function's docstring is the help; below its line "Options:" is an
    entry for each option, in the grammar that this module's docstring describes. shared: options by
    the name of their parameter, for parameters that have neither an entry nor a text in their type;
    a parameter without any of the three is an argument.
    """
    text, _, options = inspect.cleandoc(function.__doc__ or "").partition("\n\nOptions:\n")
    lines = re.sub(r"\n {4,}", " ", options).splitlines()
    entries = [entry for line in lines if (entry := _ENTRY.fullmatch(line.strip()))]
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = []
    for parameter in inspect.signature(function).parameters.values():
        own = [entry for entry in entries if _is_of(parameter.name, entry["names"])]
        # view_azimuth_deg belongs to --view-azimuth, although --view would fit
        entry = max(own, key=lambda entry: len(entry["names"]), default=None)
        declared = _parameter(parameter, hints[parameter.name], entry)
        is_shared = entry is None and declared.metavar is None
        parameters.append(shared.get(parameter.name, declared) if is_shared else declared)
    return click.Command(name, callback=function, params=parameters, help=text)


def _is_of(parameter: str, names: str) -> bool:
    """Return whether an option sets a parameter; names: such as "--every" or "--fit/--no-fit"."""
    name = names.split("/")[0].removeprefix("--").replace("-", "_")
    return re.fullmatch(rf"(as_)?{name}s?(_\w*)?", parameter) is not None


def _finite(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
    """Return the value of an option; raise BadParameter for NaN and infinity, which click reads."""
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, float) and not math.isfinite(number):
            raise click.BadParameter(f"{number} is not a finite number", ctx, param)
    return value


def _parameter(
    parameter: inspect.Parameter, hint: Any, entry: re.Match[str] | None
) -> click.Parameter:
    """Return the click option of a parameter, or its argument if `entry` is None.

    hint: the parameter's type; entry: its line below "Options:", as `_ENTRY` matches it.
    """
    extras: tuple[Any, ...] = ()
    if typing.get_origin(hint) is typing.Annotated:  # a text for the help, or a function
        hint, extras = hint.__origin__, hint.__metadata__
    if typing.get_origin(hint) in (typing.Union, types.UnionType):  # X | None
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    default = parameter.default
    is_required = default is inspect.Parameter.empty
    settings: dict[str, Any] = {"required": True} if is_required else {"default": default}
    parts = typing.get_args(hint) if typing.get_origin(hint) is tuple else ()
    base, is_many = parts[0] if parts else hint, parts[-1:] == (Ellipsis,)
    if typing.get_origin(base) is Literal:
        settings["type"] = Named(typing.get_args(base))
    elif base is not bool and base is not Any:
        settings["type"] = PATH if base is Path else base
    for extra in filter(callable, extras):
        settings["type"] = extra
        if isinstance(extra, click.FloatRange | click.IntRange):
            extra.name = "number" if isinstance(extra, click.FloatRange) else "integer"
    if entry is None:
        metavar = next((extra for extra in extras if isinstance(extra, str)), None)
        nargs = -1 if is_many else 1
        return click.Argument([parameter.name], nargs=nargs, metavar=metavar, **settings)
    if parts:
        settings |= {"multiple": True} if is_many else {"nargs": len(parts), "type": str}
    if base is bool:
        settings |= {"is_flag": True}
    if base is float:
        settings["callback"] = _finite
    is_empty = default in (None, "", ()) or default is False
    settings["show_default"] = not is_required and not is_empty
    names = [parameter.name, entry["names"]]
    return click.Option(names, metavar=entry["metavar"], help=entry["help"], **settings)
