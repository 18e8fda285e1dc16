"""Parse device URIs: ``scheme:place?option=value&option=value``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, TypeVar
from urllib.parse import parse_qsl, unquote

from fieldlum.core.errors import DeviceError

Number = TypeVar("Number", int, float)


@dataclass(frozen=True, slots=True)
class DeviceUri:
    """A parsed device URI: scheme:place?name=value&name=value.

    text : all of it; options : the values by name.
    """

    text: str
    scheme: str
    place: str = ""
    options: dict[str, str] = field(default_factory=dict)

    def read(self, **readers: Callable[[str], Any]) -> Mapping[str, Any]:
        """Return the URI's options, each converted by the function of the same name in `readers`.

        Raises DeviceError, naming the option, for an unknown option or a bad value.
        """
        for name in self.options:
            if name not in readers:
                near = get_close_matches(name, readers, n=1)
                hint = (
                    f"did you mean '{near[0]}'?"
                    if near
                    else f"known: {', '.join(sorted(readers)) or 'none'}"
                )
                raise DeviceError(f"{self.text}: unknown option '{name}'; {hint}")
        values = {}
        for name, value in self.options.items():
            try:
                values[name] = readers[name](value)
            except ValueError as error:
                raise DeviceError(
                    f"{self.text}: option {name}={value}; {error}; correct the URI"
                ) from None
        return values


def parse_uri(text: str) -> DeviceUri:
    """Parse a URI. Raises DeviceError without a scheme, for a repeated option or one without =."""
    scheme, colon, rest = text.partition(":")
    if not colon or not re.fullmatch(r"[a-z][a-z0-9+]*", scheme):
        raise DeviceError(
            f"{text}: not a device URI; expected one like sim:office or "
            "serial:/dev/ttyUSB0?kind=spn1"
        )
    place, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise DeviceError(f"{text}: options '{query}'; expected name=value joined by &") from None
    if len({name for name, _ in pairs}) != len(pairs):
        raise DeviceError(f"{text}: an option occurs twice; remove one of the two")
    return DeviceUri(text, scheme, unquote(place), dict(pairs))


def one_of(*choices: str) -> Callable[[str], str]:
    """Return a function that returns a text unchanged if it is one of `choices`.

    It raises ValueError for any other text.
    """

    def reader(value: str) -> str:
        if value not in choices:
            raise ValueError(f"expected one of {', '.join(choices)}")
        return value

    return reader


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a function that converts a text to a number from `low` to `high`.

    It raises ValueError for any other text.
    """
    return _within(float, f"a number from {low:g} to {high:g}", low, high)


def integer_option(low: int, high: int) -> Callable[[str], int]:
    """Return a function that converts a text to an integer from `low` to `high`.

    It raises ValueError for any other text.
    """
    return _within(int, f"an integer from {low} to {high}", low, high)


def _within(
    convert: Callable[[str], Number], expected: str, low: float, high: float
) -> Callable[[str], Number]:
    def reader(value: str) -> Number:
        try:
            parsed = convert(value)
        except ValueError:
            raise ValueError(f"expected {expected}") from None
        if not low <= parsed <= high:
            raise ValueError(f"expected {expected}")
        return parsed

    return reader
