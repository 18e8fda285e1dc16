"""Parse device URIs: ``scheme:place?option=value&option=value``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import TypeVar
from urllib.parse import parse_qsl, unquote

from msgspec import Struct, ValidationError, convert

from fieldlum.core.errors import DeviceError

Options = TypeVar("Options", bound=Struct)


@dataclass(frozen=True, slots=True)
class DeviceUri:
    """A parsed device URI: scheme:place?name=value&name=value.

    text : all of it; options : the values by name.
    """

    text: str
    scheme: str
    place: str = ""
    options: dict[str, str] = field(default_factory=dict)

    def read(self, kind: type[Options]) -> Options:
        """Return the URI's options as a Struct with the type, limits and default of each option.

        Raises DeviceError, naming the option, for an unknown option or a bad value.
        """
        names = kind.__struct_fields__
        if unknown := [name for name in self.options if name not in names]:
            near = get_close_matches(unknown[0], names, n=1)
            known = f"known: {', '.join(sorted(names)) or 'none'}"
            hint = f"did you mean '{near[0]}'?" if near else known
            raise DeviceError(f"{self.text}: unknown option '{unknown[0]}'; {hint}")
        try:
            return convert(self.options, kind, strict=False)
        except ValidationError as error:
            why, _, name = str(error).strip("`").partition(" - at `$.")
            what = f"option {name}={self.options[name]}"
            raise DeviceError(f"{self.text}: {what}; {why}; correct the URI") from None


def parse_uri(text: str) -> DeviceUri:
    """Parse a URI. Raises DeviceError without a scheme, for a repeated option or one without =."""
    scheme, colon, rest = text.partition(":")
    if not colon or not re.fullmatch(r"[a-z][a-z0-9+]*", scheme):
        example = "sim:office or serial:/dev/ttyUSB0?kind=spn1"
        raise DeviceError(f"{text}: not a device URI; expected one like {example}")
    place, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise DeviceError(f"{text}: options '{query}'; expected name=value joined by &") from None
    if len(dict(pairs)) < len(pairs):
        raise DeviceError(f"{text}: an option occurs twice; remove one of the two")
    return DeviceUri(text, scheme, unquote(place), dict(pairs))
