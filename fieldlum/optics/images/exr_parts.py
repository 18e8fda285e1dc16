"""Choose one picture of an EXR file that has several parts, layers or views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldlum.core.errors import InputError

_OWN_CHANNELS = ("Y", "R", "G", "B", "u", "flags")
_REMEDY = "name one with --part NAME (glare, view, info), or write only that picture"


@dataclass(frozen=True, slots=True)
class ExrPart:
    """A part of an EXR file: its attributes, and the names of its channels."""

    header: Mapping[str, Any]
    channels: tuple[str, ...]

    @property
    def deep(self) -> bool:
        """Whether its pixels have several samples at several depths."""
        return "deep" in str(self.header.get("type", "")).lower()


@dataclass(frozen=True, slots=True)
class ExrPicture:
    """A flat picture in an EXR file: the index of its part, and its channels.

    name : of its part, layer or view; "" for plain channels of a file with one part without a name.
    channels : plain name, such as R, by the name in the file.
    """

    name: str
    part: int
    channels: Mapping[str, str]

    @property
    def plain(self) -> bool:
        """Whether its channels belong to no layer."""
        return all(name == plain_name for name, plain_name in self.channels.items())


def chosen_picture(parts: Sequence[ExrPart], name: str, path: Path) -> tuple[ExrPicture, str]:
    """Return the picture with this name, or the only one if `name` is "", and a note.

    Plain channels are the picture of a file with one part: a note names layers next to them. Raises
    InputError, with the names, if several parts, layers or views could be meant, if there is no
    such name, and for a file without a flat picture with Y or R, G, B.
    """
    pictures = _pictures(parts)
    names = [picture.name or "(plain channels)" for picture in pictures]
    if not pictures:
        raise _no_picture(parts, path)
    if name:
        for picture in pictures:
            if name == picture.name:
                return picture, ""
        raise InputError(path, f"no part {name[:80]}", f"one of {_listed(names)}", _REMEDY)
    if len(parts) > 1:
        every = [str(part.header.get("name", "")) for part in parts]
        raise InputError(
            path,
            f"{len(parts)} parts: {_listed(every)}",
            f"the name of the picture to read: {_listed(names)}",
            _REMEDY,
        )
    if len(pictures) == 1:
        return pictures[0], ""
    if pictures[0].plain and len(_views(parts[0])) < 2:
        others = _listed(names[1:])
        return pictures[0], f"the plain channels are read; the EXR has further layers: {others}"
    what = "views" if len(_views(parts[0])) > 1 else "layers"
    raise InputError(path, f"{len(names)} {what}: {_listed(names)}", "one picture", _REMEDY)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)[:200]


def _no_picture(parts: Sequence[ExrPart], path: Path) -> InputError:
    if all(part.deep for part in parts):
        return InputError(
            path,
            "an EXR with deep data",
            "a flat picture",
            "flatten it with the program that wrote it",
        )
    shown = ", ".join(sorted({name for part in parts for name in part.channels}))[:120]
    return InputError(
        path,
        f"channels {shown}",
        "a channel Y in cd/m2, or R, G and B, of one layer",
        "write only that layer",
    )


def _views(part: ExrPart) -> list[str]:
    """Return the names of the views of a stereo part; the plain channels are the first one."""
    stated = part.header.get("multiView")
    return [str(view) for view in stated] if isinstance(stated, list | tuple) else []


def _pictures(parts: Sequence[ExrPart]) -> list[ExrPicture]:
    """Return the flat pictures of all parts, those of plain channels first in their part."""
    pictures: list[ExrPicture] = []
    for index, part in enumerate(parts):
        if part.deep:
            continue
        prefixes = sorted({name[: name.rfind(".") + 1] for name in part.channels})
        layers = [prefix for prefix in prefixes if _is_picture(prefix, part.channels)]
        for prefix in layers:
            own, layer = str(part.header.get("name", "")), prefix.rstrip(".")
            if not prefix and len(_views(part)) > 1:
                layer = _views(part)[0]
            elif not prefix or (len(parts) > 1 and len(layers) == 1):
                layer = own
            elif len(parts) > 1:
                layer = f"{own}.{layer}"
            wanted = _OWN_CHANNELS if not prefix else _OWN_CHANNELS[:4]
            channels = {f"{prefix}{c}": c for c in wanted if f"{prefix}{c}" in part.channels}
            pictures.append(ExrPicture(layer, index, channels))
    return pictures


def _is_picture(prefix: str, names: Sequence[str]) -> bool:
    """Return whether a layer has R, G, B, or a luminance Y.

    X, Y, Z of a layer are a position or a normal; without a layer they are CIE XYZ.
    """
    if all(f"{prefix}{c}" in names for c in "RGB"):
        return True
    return f"{prefix}Y" in names and (not prefix or f"{prefix}X" not in names)
