"""Write panoramas as OpenEXR; read them, and RGB or luminance of other programs."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama, SunSource, parse_utc, utc_text
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images.primaries import BT709_CHROMATICITIES, luminance_weights
from fieldlum.optics.images.radiance_header import MAX_PIXELS
from fieldlum.optics.profiles import CameraProfile

# ----------------------------------------------------------------------------------------------
# one picture of an EXR file that has several parts, layers or views


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


# Values of all channels together, 2.6 GB: limits the memory that decoding may take. Chosen.
_MAX_VALUES = 4 * MAX_PIXELS
# 1 cd/m2 for an RGB of 1: without an attribute whiteLuminance the unit of a file is not stated.
# Chosen.
_WHITE_CDM2_UNSTATED = 1.0
NO_UNIT = "the EXR states no unit (no whiteLuminance): its values are taken as cd/m2"

# ----------------------------------------------------------------------------------------------
# writing


def calibration_mark(profile: CameraProfile) -> dict[str, str]:
    """Return the attributes that a merged picture stores about its calibration.

    These are the camera's name, the scale factor k, and a digest of the profile's lenses, sensor,
    shutter times, response, colour, filters and stray light. `calibrate scale` needs the old k: it
    multiplies k by the ratio of the meters to the picture.
    """
    p = profile
    colour = {k: v for k, v in plain(p.colour).items() if not k.startswith("melanopic")}
    parts = plain([p.lens, p.sensor, p.shutter, p.response, colour, p.nd])
    if p.stray.angle_deg:  # absent without it, so that earlier pictures have the same digest
        parts.append(plain(p.stray))
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return {"camera": p.camera.name, "k": f"{p.scale.k:.8g}", "calibration": digest[:16]}


_DISK_ERRNOS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EROFS,
    errno.EACCES,
    errno.ENOENT,
)


def _disk_error(path: Path, error: RuntimeError) -> Exception:
    """Return a disk error that OpenEXR reported, as an OSError with its number.

    Else `error` itself.
    """
    for number in _DISK_ERRNOS:
        if os.strerror(number).lower() in str(error).lower():
            return OSError(number, os.strerror(number), str(path))
    return error


def write_panorama(path: Path, panorama: Panorama, *, view: str = "equirect") -> None:
    """Write a float32 EXR with the channel Y and, if present, u, flags, R, G and B.

    Attributes: view, heading_deg, t_utc, sun and `Panorama.attributes`. view : Radiance's view
    options, for a picture that is not a panorama.
    """
    import OpenEXR

    channels = {"Y": np.ascontiguousarray(panorama.luminance_cdm2, np.float32)}
    if panorama.u_cdm2 is not None:
        channels["u"] = np.ascontiguousarray(panorama.u_cdm2, np.float32)
    if panorama.flags is not None:
        channels["flags"] = np.ascontiguousarray(panorama.flags, np.float32)
    if panorama.rgb is not None:
        channels |= {
            c: np.ascontiguousarray(panorama.rgb[..., i], np.float32) for i, c in enumerate("RGB")
        }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "view": view,
        "heading_deg": f"{panorama.heading_deg:.6g}",
        **({"t_utc": utc_text(panorama.t_utc)} if panorama.t_utc else {}),
        **({"sun": _sun_text(panorama.sun)} if panorama.sun else {}),
        **{f"fieldlum:{key}": value for key, value in panorama.attributes.items()},
    }
    try:
        OpenEXR.File(header, channels).write(str(path))
    except RuntimeError as error:
        raise _disk_error(path, error) from None


def _sun_text(sun: SunSource) -> str:
    return (
        f"{sun.altitude_deg:.4f} {sun.azimuth_deg:.4f} {sun.normal_illuminance_lx:.6g}"
        f" {sun.visible_fraction:.4f} {sun.origin or 'unknown'}"
    )


def _sun_parse(text: str) -> SunSource:
    altitude, azimuth, normal, fraction, origin = text.split(maxsplit=4)
    return SunSource(float(altitude), float(azimuth), float(normal), float(fraction), origin)


# ----------------------------------------------------------------------------------------------
# reading


def read_exr(path: Path, part: str = "") -> tuple[Panorama, str]:
    """Return a luminance picture and its view: ``equirect``, Radiance's view options, or "".

    part : name of the part, layer or stereo view to read; "" for the only one. The luminance is
    channel Y, or R, G and B weighted by the attribute chromaticities (BT.709 without it) times
    whiteLuminance (1 cd/m2 without it). For files of other programs `Panorama.attributes["note"]`
    states a missing unit, and other layers. Pixels outside of the data window are flagged as
    outside the lens.

    Raises InputError for a file that is no EXR, is broken, too large, has neither Y nor R, G, B, or
    has several pictures and `part` does not name one of them.
    """
    parts = _parts(path)
    picture, layer_note = chosen_picture(parts, part, path)
    _check_size(parts, path)
    header = parts[picture.part].header
    channels = _channels(path, picture)
    luminance, note = _luminance(channels, header, path)
    if layer_note:
        note = {"note": "; ".join([*note.values(), layer_note])}
    try:
        own = {
            str(key).removeprefix("fieldlum:"): str(value)
            for key, value in header.items()
            if str(key).startswith("fieldlum:")
        }
        heading = float(header.get("heading_deg", 180.0))
        t_utc = parse_utc(header["t_utc"]) if header.get("t_utc") else None
        sun = _sun_parse(header["sun"]) if header.get("sun") else None
        view = _view_of(header)
    except (ValueError, TypeError, AttributeError) as error:
        # OpenEXR returns a damaged attribute as bytes of unknown type.
        raise InputError(
            path,
            f"an attribute that cannot be read ({error})",
            "heading_deg, t_utc and sun as fieldlum writes them",
            "merge the panorama again, or copy the file again",
        ) from None
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1) if set("RGB") <= set(channels) else None
    flags = channels["flags"].astype(np.uint16) if "flags" in channels else None
    panorama = Panorama(luminance, heading, channels.get("u"), flags, t_utc, sun, rgb, own | note)
    return _on_display_window(panorama, header), view


def _view_of(header: Mapping[str, Any]) -> str:
    """Return the attribute view if it is a view of fieldlum or Radiance.

    OpenEXR itself names the view of a stereo picture there, such as "left".
    """
    text = str(header.get("view", ""))
    return text if text.startswith(("equirect", "-v", "VIEW=", "rvu ")) else ""


def _parts(path: Path) -> list[ExrPart]:
    """Return attributes and channels of each part. Raises InputError for a file that is no EXR."""
    import OpenEXR

    # Check the first bytes before OpenEXR reads the file, because OpenEXR prints to stderr.
    with path.open("rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise InputError(
                path, "not an OpenEXR file", "an .exr picture", "check which program wrote the file"
            )
    try:
        with OpenEXR.File(str(path), header_only=True) as exr:
            return [
                ExrPart(dict(part.header), tuple(c.name for c in part.header["channels"]))
                for part in exr.parts
            ]
    except Exception as error:
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> InputError:
    return InputError(
        path, f"broken EXR ({error})".replace("\n", " "), "a complete EXR", "copy the file again"
    )


def _window(header: Mapping[str, Any], name: str) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height of a window [px].

    None if the header has no such window.
    """
    try:
        (x0, y0), (x1, y1) = header[name]
        return int(x0), int(y0), int(x1) - int(x0) + 1, int(y1) - int(y0) + 1
    except (KeyError, TypeError, ValueError):
        return None


def _check_size(parts: Sequence[ExrPart], path: Path) -> None:
    """Raise InputError for more pixels than `MAX_PIXELS`, before anything is decoded.

    All parts count, because OpenEXR decodes all of them.
    """
    for part in parts:
        channels = max(1, len(part.channels)) * len(parts)
        for name in ("dataWindow", "displayWindow"):
            window = _window(part.header, name)
            if window is None:
                continue
            width, height = window[2:]
            pixels = width * height
            if min(width, height) < 1 or pixels > MAX_PIXELS or pixels * channels > _MAX_VALUES:
                raise InputError(
                    path,
                    f"{width} x {height} pixels of {channels} channels",
                    f"1 to {MAX_PIXELS:,} pixels, and at most {_MAX_VALUES:,} values in all "
                    "channels",
                    "reduce the picture, or copy the file again",
                )


def _channels(path: Path, picture: ExrPicture) -> dict[str, Floats32]:
    """Return channels [H, W] of a picture by their plain name."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as exr:
            channels = exr.parts[picture.part].channels
            return {
                plain_name: np.asarray(channels[name].pixels).astype(np.float32, copy=False)
                for name, plain_name in picture.channels.items()
            }
    except Exception as error:
        raise _broken(path, error) from None


def _luminance(
    channels: Mapping[str, Floats32], header: Mapping[str, Any], path: Path
) -> tuple[Floats32, dict[str, str]]:
    """Return the luminance [H, W] in cd/m2, and a note if the file does not state its unit."""
    white = header.get("whiteLuminance")
    scale = float(white) if isinstance(white, int | float) and white > 0 else _WHITE_CDM2_UNSTATED
    ours = any(str(key).startswith("fieldlum:") or key == "heading_deg" for key in header)
    note = {} if ours or scale != _WHITE_CDM2_UNSTATED or white else {"note": NO_UNIT}
    if "Y" in channels:
        luminance = channels["Y"]
        return (luminance if scale == 1.0 else luminance * np.float32(scale)), note
    try:
        stated = header.get("chromaticities")
        weights = luminance_weights(BT709_CHROMATICITIES if stated is None else tuple(stated))
    except (TypeError, ValueError) as error:
        raise InputError(
            path,
            f"attribute chromaticities ({error})",
            "x and y of R, G, B and white",
            "write the picture again with a correct attribute, or without it",
        ) from None
    luminance = np.zeros_like(channels["R"])
    for name, weight in zip("RGB", weights * scale, strict=True):
        luminance += channels[name] * np.float32(weight)
    return luminance, note


def _on_display_window(panorama: Panorama, header: Mapping[str, Any]) -> Panorama:
    """Return the picture on the display window; pixels without data are outside the lens."""
    data, display = _window(header, "dataWindow"), _window(header, "displayWindow")
    if data is None or display is None or data == display:
        return panorama
    left, top = data[0] - display[0], data[1] - display[1]
    width, height = display[2:]
    into = (slice(max(top, 0), top + data[3]), slice(max(left, 0), left + data[2]))
    out_of = (
        slice(max(-top, 0), max(-top, 0) + max(0, min(height - max(top, 0), data[3]))),
        slice(max(-left, 0), max(-left, 0) + max(0, min(width - max(left, 0), data[2]))),
    )

    def placed(values: Array | None, empty: float) -> Array | None:
        if values is None:
            return None
        out = np.full((height, width, *values.shape[2:]), empty, values.dtype)
        part = values[out_of]
        out[into][: part.shape[0], : part.shape[1]] = part
        return out

    flags = panorama.flags
    if flags is None:
        flags = np.zeros(panorama.luminance_cdm2.shape, np.uint16)
    luminance = placed(panorama.luminance_cdm2, np.nan)
    assert luminance is not None
    return replace(
        panorama,
        luminance_cdm2=luminance,
        u_cdm2=placed(panorama.u_cdm2, np.nan),
        flags=placed(flags, int(Flag.OUTSIDE_LENS)),
        rgb=placed(panorama.rgb, np.nan),
    )
