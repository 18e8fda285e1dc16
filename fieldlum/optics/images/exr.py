"""Write panoramas as OpenEXR; read them, and RGB or luminance of other programs."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama, SunSource, parse_utc, utc_text
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images.primaries import BT709_CHROMATICITIES, luminance_weights
from fieldlum.optics.images.radiance import MAX_PIXELS, read_radiance_hdr
from fieldlum.optics.profiles import CameraProfile

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


def write_panorama(path: Path, panorama: Panorama, *, view: str = "equirect") -> None:
    """Write a float32 EXR with the channel Y and, if present, u, flags, R, G and B.

    Attributes: view, heading_deg, t_utc, sun and `Panorama.attributes`. view : Radiance's view
    options, for a picture that is not a panorama.
    """
    import OpenEXR

    layers = {"Y": panorama.luminance_cdm2, "u": panorama.u_cdm2, "flags": panorama.flags}
    if panorama.rgb is not None:
        layers |= {c: panorama.rgb[..., i] for i, c in enumerate("RGB")}
    channels = {
        name: np.ascontiguousarray(values, np.float32)
        for name, values in layers.items()
        if values is not None
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
        for number in errno.errorcode:  # of a full disk, for example
            if os.strerror(number).lower() in str(error).lower():
                raise OSError(number, os.strerror(number), str(path)) from None
        raise


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


def read_panorama(path: Path, part: str = "") -> Panorama:
    """Read a panorama: an .exr or a Radiance .hdr that is twice as wide as high.

    part : of an .exr, as for `read_exr`. A file without a heading gets 180 (south). The file's view
    is not checked. Raises InputError for a missing or broken file, and for other shapes.
    """
    if not path.is_file():
        remedy = "check the path of the panorama"
        raise InputError(path, "no such file", "a panorama .exr or .hdr", remedy)
    if path.suffix.lower() == ".exr":
        panorama = read_exr(path, part)[0]
    else:
        image = read_radiance_hdr(path)
        heading = 180.0 if image.header.heading_deg is None else image.header.heading_deg
        panorama = Panorama(image.luminance_cdm2, heading, rgb=image.rgb)
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(
            path,
            f"{width} x {height} pixels",
            "a panorama twice as wide as high",
            "use a picture of all directions (equirectangular)",
        )
    return panorama


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
    headers = _headers(path)
    picture, layer_note = _chosen(headers, part, path)
    _check_size(headers, path)
    header = headers[picture.part]
    channels = _channels(path, picture)
    luminance, unit_note = _luminance(channels, header, path)
    try:
        own = {
            str(key).removeprefix("fieldlum:"): str(value)
            for key, value in header.items()
            if str(key).startswith("fieldlum:")
        }
        heading = float(header.get("heading_deg", 180.0))
        t_utc = parse_utc(header["t_utc"]) if header.get("t_utc") else None
        sun = _sun_parse(header["sun"]) if header.get("sun") else None
    except (ValueError, TypeError, AttributeError) as error:
        # OpenEXR returns a damaged attribute as bytes of unknown type.
        raise InputError(
            path,
            f"an attribute that cannot be read ({error})",
            "heading_deg, t_utc and sun as fieldlum writes them",
            "merge the panorama again, or copy the file again",
        ) from None
    if note := "; ".join(filter(None, (unit_note, layer_note))):
        own["note"] = note
    rgb = np.stack([channels[c] for c in "RGB"], axis=-1) if set("RGB") <= set(channels) else None
    flags = channels["flags"].astype(np.uint16) if "flags" in channels else None
    panorama = Panorama(luminance, heading, channels.get("u"), flags, t_utc, sun, rgb, own)
    # OpenEXR itself names the view of a stereo picture in this attribute, such as "left".
    view = str(header.get("view", ""))
    known = view.startswith(("equirect", "-v", "VIEW=", "rvu "))
    return _on_display_window(panorama, header), view if known else ""


def _headers(path: Path) -> list[dict[str, Any]]:
    """Return the attributes of each part. Raises InputError for a file that is no EXR."""
    import OpenEXR

    # Check the first bytes before OpenEXR reads the file, because OpenEXR prints to stderr.
    with path.open("rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            remedy = "check which program wrote the file"
            raise InputError(path, "not an OpenEXR file", "an .exr picture", remedy)
    try:
        with OpenEXR.File(str(path), header_only=True) as exr:
            return [
                {**part.header, "channels": list(part.header["channels"])} for part in exr.parts
            ]
    except Exception as error:
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> InputError:
    finding = f"broken EXR ({error})".replace("\n", " ")
    return InputError(path, finding, "a complete EXR", "copy the file again")


def _window(header: Mapping[str, Any], name: str) -> tuple[int, int, int, int] | None:
    """Return left, top, and the column and row after the last [px]; None without such a window."""
    try:
        (x0, y0), (x1, y1) = header[name]
        return int(x0), int(y0), int(x1) + 1, int(y1) + 1
    except (KeyError, TypeError, ValueError):
        return None


def _check_size(headers: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Raise InputError for more pixels than `MAX_PIXELS`, before anything is decoded.

    All parts count, because OpenEXR decodes all of them.
    """
    for header in headers:
        count = max(1, len(header["channels"])) * len(headers)
        for window in (_window(header, "dataWindow"), _window(header, "displayWindow")):
            left, top, right, bottom = window or (0, 0, 1, 1)
            width, height = right - left, bottom - top
            if min(width, height) < 1 or width * height > min(MAX_PIXELS, _MAX_VALUES // count):
                raise InputError(
                    path,
                    f"{width} x {height} pixels of {count} channels",
                    f"1 to {MAX_PIXELS:,} pixels, and at most {_MAX_VALUES:,} values in all "
                    "channels",
                    "reduce the picture, or copy the file again",
                )


def _channels(path: Path, picture: _Picture) -> dict[str, Floats32]:
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
) -> tuple[Floats32, str]:
    """Return the luminance [H, W] in cd/m2, and a note if the file does not state its unit."""
    white = header.get("whiteLuminance")
    scale = float(white) if isinstance(white, int | float) and white > 0 else _WHITE_CDM2_UNSTATED
    ours = any(str(key).startswith("fieldlum:") or key == "heading_deg" for key in header)
    note = "" if ours or white else NO_UNIT
    if "Y" in channels:
        return (channels["Y"] if scale == 1.0 else channels["Y"] * np.float32(scale)), note
    try:
        stated = header.get("chromaticities")
        weights = luminance_weights(BT709_CHROMATICITIES if stated is None else tuple(stated))
    except (TypeError, ValueError) as error:
        expected = "x and y of R, G, B and white"
        remedy = "write the picture again with a correct attribute, or without it"
        raise InputError(path, f"attribute chromaticities ({error})", expected, remedy) from None
    luminance = np.zeros_like(channels["R"])
    for name, weight in zip("RGB", weights * scale, strict=True):
        luminance += channels[name] * np.float32(weight)
    return luminance, note


def _on_display_window(panorama: Panorama, header: Mapping[str, Any]) -> Panorama:
    """Return the picture on the display window; pixels without data are outside the lens."""
    data, display = _window(header, "dataWindow"), _window(header, "displayWindow")
    if data is None or display is None or data == display:
        return panorama
    box = (*np.maximum(data[:2], display[:2]), *np.minimum(data[2:], display[2:]))

    def part(window: tuple[int, ...]) -> tuple[slice, slice]:
        """Return the rows and columns of a window that are in both windows."""
        left, top = box[0] - window[0], box[1] - window[1]
        return (
            slice(top, top + max(box[3] - box[1], 0)),
            slice(left, left + max(box[2] - box[0], 0)),
        )

    def placed(values: Array | None, empty: float) -> Any:
        if values is None:
            return None
        shape = (display[3] - display[1], display[2] - display[0], *values.shape[2:])
        out = np.full(shape, empty, values.dtype)
        out[part(display)] = values[part(data)]
        return out

    flags = panorama.flags
    if flags is None:
        flags = np.zeros(panorama.luminance_cdm2.shape, np.uint16)
    return replace(
        panorama,
        luminance_cdm2=placed(panorama.luminance_cdm2, np.nan),
        u_cdm2=placed(panorama.u_cdm2, np.nan),
        flags=placed(flags, int(Flag.OUTSIDE_LENS)),
        rgb=placed(panorama.rgb, np.nan),
    )


# ----------------------------------------------------------------------------------------------
# one picture of an EXR file that has several parts, layers or views


_OWN_CHANNELS = ("Y", "R", "G", "B", "u", "flags")
_REMEDY = "name one with --part NAME (glare, view, info), or write only that picture"


@dataclass(frozen=True, slots=True)
class _Picture:
    """A flat picture in an EXR file: the index of its part, and its channels.

    name : of its part, layer or view; "" for plain channels of a file with one part without a name.
    layered : whether its channels belong to a layer. channels : plain name, such as R, by the name
    in the file.
    """

    name: str
    part: int
    layered: bool
    channels: Mapping[str, str]


def _chosen(headers: Sequence[Mapping[str, Any]], name: str, path: Path) -> tuple[_Picture, str]:
    """Return the picture with this name, or the only one if `name` is "", and a note.

    Plain channels are the picture of a file with one part: a note names layers next to them. Raises
    InputError, with the names, if several parts, layers or views could be meant, if there is no
    such name, and for a file without a flat picture with Y or R, G, B.
    """
    pictures = [p for i, header in enumerate(headers) for p in _pictures(headers, i, header)]
    listed = ", ".join(picture.name or "(plain channels)" for picture in pictures)[:200]
    if not pictures:
        raise _no_picture(headers, path)
    if name:
        for picture in pictures:
            if name == picture.name:
                return picture, ""
        raise InputError(path, f"no part {name[:80]}", f"one of {listed}", _REMEDY)
    if len(headers) > 1:
        every = ", ".join(str(header.get("name", "")) for header in headers)[:200]
        expected = f"the name of the picture to read: {listed}"
        raise InputError(path, f"{len(headers)} parts: {every}", expected, _REMEDY)
    if len(pictures) == 1:
        return pictures[0], ""
    if pictures[0].layered or len(_views(headers[0])) > 1:
        what = "views" if len(_views(headers[0])) > 1 else "layers"
        raise InputError(path, f"{len(pictures)} {what}: {listed}", "one picture", _REMEDY)
    others = ", ".join(picture.name for picture in pictures[1:])[:200]
    return pictures[0], f"the plain channels are read; the EXR has further layers: {others}"


def _no_picture(headers: Sequence[Mapping[str, Any]], path: Path) -> InputError:
    if all(_deep(header) for header in headers):
        remedy = "flatten it with the program that wrote it"
        return InputError(path, "an EXR with deep data", "a flat picture", remedy)
    shown = ", ".join(sorted({c.name for header in headers for c in header["channels"]}))[:120]
    expected = "a channel Y in cd/m2, or R, G and B, of one layer"
    return InputError(path, f"channels {shown}", expected, "write only that layer")


def _deep(header: Mapping[str, Any]) -> bool:
    """Return whether a part's pixels have several samples at several depths."""
    return "deep" in str(header.get("type", "")).lower()


def _views(header: Mapping[str, Any]) -> list[str]:
    """Return the names of the views of a stereo part; the plain channels are the first one."""
    stated = header.get("multiView")
    return [str(view) for view in stated] if isinstance(stated, list | tuple) else []


def _pictures(
    headers: Sequence[Mapping[str, Any]], part: int, header: Mapping[str, Any]
) -> Iterator[_Picture]:
    """Yield the flat pictures of a part, that of its plain channels first."""
    names = () if _deep(header) else [channel.name for channel in header["channels"]]
    prefixes = sorted({name[: name.rfind(".") + 1] for name in names})
    layers = [prefix for prefix in prefixes if _is_picture(prefix, names)]
    for prefix in layers:
        own, layer = str(header.get("name", "")), prefix.rstrip(".")
        if not prefix and len(_views(header)) > 1:
            layer = _views(header)[0]
        elif not prefix or (len(headers) > 1 and len(layers) == 1):
            layer = own
        elif len(headers) > 1:
            layer = f"{own}.{layer}"
        wanted = _OWN_CHANNELS[:4] if prefix else _OWN_CHANNELS
        channels = {f"{prefix}{c}": c for c in wanted if f"{prefix}{c}" in names}
        yield _Picture(layer, part, bool(prefix), channels)


def _is_picture(prefix: str, names: Sequence[str]) -> bool:
    """Return whether a layer has R, G, B, or a luminance Y.

    X, Y, Z of a layer are a position or a normal; without a layer they are CIE XYZ.
    """
    if all(f"{prefix}{c}" in names for c in "RGB"):
        return True
    return f"{prefix}Y" in names and (not prefix or f"{prefix}X" not in names)
