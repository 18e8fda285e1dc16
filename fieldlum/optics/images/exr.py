"""Write panoramas as OpenEXR; read them, and RGB or luminance of other programs."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Array, Floats32
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Flag, Panorama, SunSource, parse_utc, utc_text
from fieldlum.core.strict_toml import plain
from fieldlum.optics.images.radiance import MAX_PIXELS, luminance_weights, read_radiance_hdr
from fieldlum.optics.profiles import CameraProfile

# ITU-R BT.709, which OpenEXR assumes where a file has no attribute `chromaticities`.
_BT709_CHROMATICITIES = (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, 0.3127, 0.3290)
# Values of all channels together, 2.6 GB: limits the memory that decoding may take.
_MAX_VALUES = 4 * MAX_PIXELS
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
    if path.suffix.lower() == ".exr":
        panorama = read_exr(path, part)[0]
    else:
        image = read_radiance_hdr(path)
        heading = 180.0 if image.header.heading_deg is None else image.header.heading_deg
        panorama = Panorama(image.luminance_cdm2, heading, rgb=image.rgb)
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        expected = "a panorama twice as wide as high"
        remedy = "use a picture of all directions (equirectangular)"
        raise InputError(path, f"{width} x {height} pixels", expected, remedy)
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
    # OpenEXR returns a damaged attribute as bytes of unknown type.
    expected = "attributes as fieldlum writes them"
    remedy = "merge the panorama again, or copy the file again"
    with input_errors(path, expected, remedy, ValueError, TypeError, AttributeError):
        own = {
            str(key).removeprefix("fieldlum:"): str(value)
            for key, value in header.items()
            if str(key).startswith("fieldlum:")
        }
        heading = float(header.get("heading_deg", 180.0))
        t_utc = parse_utc(header["t_utc"]) if header.get("t_utc") else None
        sun = _sun_parse(header["sun"]) if header.get("sun") else None
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
    remedy = "check the path of the picture, and which program wrote it"
    with input_errors(path, "an .exr picture", remedy, OSError), path.open("rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise InputError(path, "not an OpenEXR file", "an .exr picture", remedy)
    try:
        with OpenEXR.File(str(path), header_only=True) as exr:
            return [
                {**part.header, "channels": [c.name for c in part.header["channels"]]}
                for part in exr.parts
            ]
    except Exception as error:
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> InputError:
    finding = f"broken EXR ({error})".replace("\n", " ")
    return InputError(path, finding, "a complete EXR", "copy the file again")


def _window(header: Mapping[str, Any], name: str) -> tuple[int, int, int, int]:
    """Return top, left, and the row and column after the last [px]."""
    (x0, y0), (x1, y1) = header[name]
    return int(y0), int(x0), int(y1) + 1, int(x1) + 1


def _check_size(headers: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Raise InputError for more values than `_MAX_VALUES`, before anything is decoded.

    All parts count, because OpenEXR decodes all of them.
    """
    for header, name in ((h, name) for h in headers for name in ("dataWindow", "displayWindow")):
        try:
            top, left, bottom, right = _window(header, name)
        except (KeyError, TypeError, ValueError) as error:
            raise _broken(path, error) from None
        count = max(1, len(header["channels"])) * len(headers)
        height, width = bottom - top, right - left
        if min(width, height) < 1 or width * height * count > _MAX_VALUES:
            finding = f"{width} x {height} pixels of {count} channels"
            expected = f"at most {_MAX_VALUES:,} values in all channels"
            raise InputError(path, finding, expected, "reduce the picture, or copy the file again")


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
    scale = float(white) if isinstance(white, int | float) and white > 0 else 1.0
    ours = any(str(key).startswith("fieldlum:") or key == "heading_deg" for key in header)
    note = "" if ours or white else NO_UNIT
    if "Y" in channels:
        return (channels["Y"] if scale == 1.0 else channels["Y"] * np.float32(scale)), note
    expected = "chromaticities as x and y of R, G, B and white"
    remedy = "write the picture again with a correct attribute, or without it"
    with input_errors(path, expected, remedy, TypeError, ValueError):
        weights = luminance_weights(tuple(header.get("chromaticities", _BT709_CHROMATICITIES)))
    luminance = np.zeros_like(channels["R"])
    for name, weight in zip("RGB", weights * scale, strict=True):
        luminance += channels[name] * np.float32(weight)
    return luminance, note


def _on_display_window(panorama: Panorama, header: Mapping[str, Any]) -> Panorama:
    """Return the picture on the display window; pixels without data are outside the lens."""
    data, display = (np.array(_window(header, name)) for name in ("dataWindow", "displayWindow"))
    if (data == display).all():
        return panorama
    before, after = (data - display)[:2], (display - data)[2:]  # rows, columns to add; < 0: to cut

    def placed(values: Array | None, empty: float) -> Any:
        if values is None:
            return None
        added = [*np.maximum(np.stack([before, after], axis=1), 0), *[(0, 0)] * (values.ndim - 2)]
        wide = np.pad(values, added, constant_values=empty)
        (top, left), (bottom, right) = np.maximum(-before, 0), np.maximum(-after, 0)
        return wide[top : wide.shape[0] - bottom, left : wide.shape[1] - right]

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


class _Picture(NamedTuple):
    """A flat picture in an EXR file: its name, the index of its part, and its channels.

    name : of its part, layer or view; "" for plain channels of a file with one part without a name.
    channels : plain name, such as R, by the name in the file.
    """

    name: str
    part: int
    channels: Mapping[str, str]


def _chosen(headers: Sequence[Mapping[str, Any]], name: str, path: Path) -> tuple[_Picture, str]:
    """Return the picture with this name, or the only one if `name` is "", and a note.

    Plain channels are the picture of a file with one part: a note names layers next to them. Raises
    InputError, with the names, if several parts, layers or views could be meant, if there is no
    such name, and for a file without a flat picture with Y or R, G, B.
    """
    pictures = list(_pictures(headers))
    remedy = "name one with --part NAME (glare, view, info), or write only that picture"
    if not pictures:
        deep = "an EXR with deep data, or with the "
        shown = ", ".join(sorted({c for header in headers for c in header["channels"]}))[:120]
        finding = f"{deep if any(map(_is_deep, headers)) else ''}channels {shown}"
        expected = "a channel Y in cd/m2, or R, G and B, of one flat layer"
        raise InputError(path, finding, expected, "write only that layer")
    first = pictures[0]
    listed = ", ".join(picture.name or "(plain channels)" for picture in pictures)[:200]
    if name:
        chosen = next((picture for picture in pictures if picture.name == name), None)
        if chosen is None:
            raise InputError(path, f"no part {name[:80]}", f"one of {listed}", remedy)
        return chosen, ""
    if len(headers) > 1:
        every = ", ".join(str(header.get("name", "")) for header in headers)[:200]
        expected = f"the name of the picture to read: {listed}"
        raise InputError(path, f"{len(headers)} parts: {every}", expected, remedy)
    if len(pictures) == 1:
        return first, ""
    if len(_views(headers[0])) > 1 or "." in next(iter(first.channels)):
        what = "views" if _views(headers[0]) else "layers"
        raise InputError(path, f"{len(pictures)} {what}: {listed}", "one picture", remedy)
    others = ", ".join(picture.name for picture in pictures[1:])[:200]
    return first, f"the plain channels are read; the EXR has further layers: {others}"


def _views(header: Mapping[str, Any]) -> list[str]:
    """Return the names of the views of a stereo part; the plain channels are the first one."""
    stated = header.get("multiView")
    return [str(view) for view in stated] if isinstance(stated, list | tuple) else []


def _is_deep(header: Mapping[str, Any]) -> bool:
    """Return whether a part's pixels have several samples at several depths."""
    return "deep" in str(header.get("type", "")).lower()


def _pictures(headers: Sequence[Mapping[str, Any]]) -> Iterator[_Picture]:
    """Yield the flat pictures of all parts, in each that of its plain channels first."""
    several = len(headers) > 1
    for part, header in enumerate(headers):
        names = [] if _is_deep(header) else header["channels"]
        prefixes = sorted({name[: name.rfind(".") + 1] for name in names})
        layers = [prefix for prefix in prefixes if _is_picture(prefix, names)]
        for prefix in layers:
            layer = prefix.rstrip(".") or next(iter(_views(header)), "")
            own = str(header.get("name", "")) if several or not layer else ""
            if several and len(layers) == 1:
                layer = ""
            wanted = ("Y", "R", "G", "B") if prefix else ("Y", "R", "G", "B", "u", "flags")
            channels = {f"{prefix}{c}": c for c in wanted if f"{prefix}{c}" in names}
            yield _Picture(".".join(filter(None, (own, layer))), part, channels)


def _is_picture(prefix: str, names: Sequence[str]) -> bool:
    """Return whether a layer has R, G, B, or a luminance Y.

    X, Y, Z of a layer are a position or a normal; without a layer they are CIE XYZ.
    """
    if all(f"{prefix}{c}" in names for c in "RGB"):
        return True
    return f"{prefix}Y" in names and (not prefix or f"{prefix}X" not in names)
