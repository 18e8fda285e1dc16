"""Luminance images on disk: float32 EXR and Radiance .hdr, with the headers other programs need."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.profiles import CameraProfile, plain
from fieldlum.records import Float, Panorama, SunSource, parse_utc, utc_text

RADIANCE_LM_PER_W = 179.0  # Radiance's own white; not 683 and not a luminous efficacy of daylight
RADIANCE_Y = (
    0.265,
    0.670,
    0.065,
)  # luminance of Radiance's primaries (Ward Larson and Shakespeare 1998)
_BRIGHTEST = (
    2e30  # W/sr/m2; what is written for infinite is 1e30, and single precision ends at 3e38
)
PANORAMA_LINE = "FIELDLUM_VIEW= equirect heading_deg="


# ----------------------------------------------------------------------------------------------
# Radiance .hdr


@dataclass(frozen=True, slots=True)
class RadianceImage:
    """rgb : [H, W, 3] W/sr/m2 with EXPOSURE undone; header lines as they stood; view is the text
    after VIEW=, or "".
    """

    rgb: NDArray[np.float32]
    header: tuple[str, ...] = ()
    view: str = ""
    heading_deg: float | None = None  # set when a header line says that this is a panorama

    @property
    def luminance_cdm2(self) -> NDArray[np.float32]:
        return luminance_from_radiance(self.rgb)


def luminance_from_radiance(rgb: Float) -> NDArray[np.float32]:
    """179 (.265 R + .670 G + .065 B), [..., 3] to [...]. [cd/m2]"""
    weights = (RADIANCE_LM_PER_W * np.asarray(RADIANCE_Y)).astype(np.float32)
    return np.asarray(rgb, np.float32) @ weights


def encode_rgbe(rgb: Float) -> NDArray[np.uint8]:
    """Shared-exponent pixels, [..., 3] to [..., 4]. Mantissas are cut, as Radiance decodes
    (mantissa + .5) / 256.
    """
    values = np.maximum(np.nan_to_num(np.asarray(rgb, np.float64), posinf=1e30), 0.0)
    largest = values.max(axis=-1)
    fraction, exponent = np.frexp(largest)
    alive = largest > 1e-32
    scale = np.divide(fraction * 256.0, largest, out=np.zeros_like(largest), where=alive)
    out = np.zeros((*largest.shape, 4), np.uint8)
    out[..., :3] = np.minimum(values * scale[..., None], 255.0)
    out[..., 3] = np.where(alive, np.clip(exponent + 128, 1, 255), 0)
    return out


def write_radiance_hdr(
    path: Path,
    pixels: Float,
    *,
    view: str = "",
    heading_deg: float | None = None,
    header: tuple[str, ...] = (),
) -> None:
    """Write cd/m2 [H, W] or radiance RGB [H, W, 3] as flat RGBE with one EXPOSURE and one VIEW.

    view: Radiance view options, such as "-vta -vh 180 -vv 180"; heading_deg instead marks a
    panorama.
    """
    values = np.asarray(pixels)
    rgb = (
        np.repeat(values[..., None] / RADIANCE_LM_PER_W, 3, axis=-1) if values.ndim == 2 else values
    )
    lines = ["#?RADIANCE", *header]
    if heading_deg is not None:
        lines.append(f"{PANORAMA_LINE}{heading_deg:.6g}")
    if view:
        lines.append(f"VIEW= {view}")
    lines += ["EXPOSURE=1", "FORMAT=32-bit_rle_rgbe", ""]
    height, width = rgb.shape[:2]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + f"\n-Y {height} +X {width}\n").encode())
        file.write(encode_rgbe(rgb).tobytes())


def _read_scanlines(data: bytes, height: int, width: int, path: Path) -> NDArray[np.uint8]:
    """Flat or new run-length RGBE. Raises InputError when the data end early."""
    flat = height * width * 4
    if len(data) >= 4 and (data[:2] != b"\x02\x02" or not 8 <= width <= 0x7FFF):
        if len(data) < flat:
            raise InputError(
                path,
                f"{len(data)} bytes of pixels",
                f"{flat}",
                "the file is cut short: copy it again",
            )
        return np.frombuffer(data[:flat], np.uint8).reshape(height, width, 4)
    out = np.empty((height, 4, width), np.uint8)
    at = 0
    try:
        for row in range(height):
            if data[at : at + 2] != b"\x02\x02" or data[at + 2] * 256 + data[at + 3] != width:
                raise InputError(
                    path, f"row {row} is no RGBE scanline", "run-length RGBE", "copy the file again"
                )
            at += 4
            for channel in range(4):
                line, x = out[row, channel], 0
                while x < width:
                    count = data[at]
                    if count > 128:
                        count -= 128
                        line[x : x + count] = data[at + 1]
                        at += 2
                    else:
                        line[x : x + count] = np.frombuffer(data, np.uint8, count, at + 1)
                        at += 1 + count
                    if count == 0 or x + count > width:
                        raise InputError(
                            path, f"row {row} runs over its end", "run-length RGBE", "copy it again"
                        )
                    x += count
    except (IndexError, ValueError):
        raise InputError(
            path, "the pixels end early", f"{height} rows", "the file is cut short: copy it again"
        ) from None
    return out.transpose(0, 2, 1)


def read_radiance_hdr(path: Path) -> RadianceImage:
    """Raises InputError for anything that is no Radiance picture. EXPOSURE lines (they multiply)
    are undone.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, error.strerror or str(error), "a readable file") from None
    head, blank, rest = data.partition(b"\n\n")
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")) or not blank:
        raise InputError(
            path, "no Radiance header", "a Radiance .hdr picture", "check what wrote it"
        )
    lines = tuple(head.decode("latin-1").splitlines()[1:])
    size, _, pixels = rest.partition(b"\n")
    found = re.fullmatch(rb"-Y (\d+) \+X (\d+)", size.strip())
    if not found or "FORMAT=32-bit_rle_xyze" in lines:
        raise InputError(
            path,
            f"resolution {size[:40]!r}",
            "-Y H +X W of RGBE",
            "convert it with Radiance's pfilt -1",
        )
    height, width = int(found[1]), int(found[2])
    if not 0 < height * width <= 400_000_000:
        raise InputError(
            path,
            f"{width} x {height} pixels",
            "a picture of a sensible size",
            "copy the file again",
        )
    rgbe = _read_scanlines(pixels, height, width, path)
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(1.0, exponent - 136), 0.0)
    rgb = (rgbe[..., :3] + 0.5) * scale[..., None]
    exposure = 1.0
    for line in lines:
        if line.startswith("EXPOSURE="):
            try:
                exposure *= float(line[9:])
            except ValueError:
                raise InputError(
                    path, line, "EXPOSURE= and a number", "mend the header line"
                ) from None
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(path, f"EXPOSURE {exposure:g}", "a number above 0", "mend the header line")
    brightest = float(rgb.max(initial=0.0)) / exposure
    if brightest > _BRIGHTEST:
        raise InputError(
            path, f"a pixel of {brightest:.3g} W/sr/m2", "light", "copy the file again"
        )
    view = next((line[5:].strip() for line in reversed(lines) if line.startswith("VIEW=")), "")
    marks = [line for line in lines if line.startswith(PANORAMA_LINE)]
    heading = _heading(marks[-1], path) if marks else None
    return RadianceImage((rgb / exposure).astype(np.float32), lines, view, heading)


def _heading(line: str, path: Path) -> float:
    try:
        heading = float((line.removeprefix(PANORAMA_LINE).split() or [""])[0])
    except ValueError:
        heading = np.nan
    if not np.isfinite(heading):
        raise InputError(
            path, repr(line)[:80], f"{PANORAMA_LINE} and a number", "mend the header line"
        )
    return heading


# ----------------------------------------------------------------------------------------------
# panoramas


def calibration_mark(profile: CameraProfile) -> dict[str, str]:
    """Attributes of a picture that tell which camera and calibration it was merged with, its k by
    itself.

    A new k is the old one times what meters say: without the old one the same readings would move k
    twice.
    """
    p = profile
    parts = plain([p.lens, p.sensor, p.shutter, p.response, p.colour, p.nd])
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return {"camera": p.camera.name, "k": f"{p.scale.k:.8g}", "calibration": digest[:16]}


def write_panorama(path: Path, panorama: Panorama, *, view: str = "equirect") -> None:
    """Float32 EXR with channels Y, u, flags (and R, G, B) and attributes view, heading_deg, t_utc,
    sun.

    view: for a picture that is no panorama its Radiance view options.
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
    OpenEXR.File(header, channels).write(str(path))


def _sun_text(sun: SunSource) -> str:
    return (
        f"{sun.altitude_deg:.4f} {sun.azimuth_deg:.4f} {sun.normal_illuminance_lx:.6g}"
        f" {sun.visible_fraction:.4f} {sun.origin or 'unknown'}"
    )


def _sun_parse(text: str) -> SunSource:
    altitude, azimuth, normal, fraction, origin = text.split(maxsplit=4)
    return SunSource(float(altitude), float(azimuth), float(normal), float(fraction), origin)


def read_panorama(path: Path) -> Panorama:
    """A panorama from .exr (ours) or .hdr (W = 2H). A .hdr without a heading line takes heading 180
    (south).

    Raises InputError for a missing, broken or other kind of file.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "a panorama .exr or .hdr")
    panorama = read_exr(path)[0] if path.suffix.lower() == ".exr" else _read_hdr_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(path, f"{width} x {height} pixels", "a panorama twice as wide as high")
    return panorama


def _read_hdr_panorama(path: Path) -> Panorama:
    image = read_radiance_hdr(path)
    heading = 180.0 if image.heading_deg is None else image.heading_deg
    return Panorama(image.luminance_cdm2, heading, rgb=image.rgb)


def read_exr(path: Path) -> tuple[Panorama, str]:
    """Any luminance .exr of ours, a fisheye too, and its view: ``equirect``, Radiance's view
    options, or "".

    Raises InputError for what is no EXR, is broken, or has no channel Y.
    """
    import OpenEXR

    with path.open(
        "rb"
    ) as file:  # OpenEXR prints to stderr by itself: keep it from seeing what is no EXR at all
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise InputError(path, "no OpenEXR file", "a panorama .exr", "check what wrote it")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as exr:
            pixels = {name: np.array(channel.pixels) for name, channel in exr.channels().items()}
            header = dict(exr.header())
    except Exception as error:
        raise InputError(
            path, f"broken EXR ({error})".replace("\n", " "), "a whole file", "copy it again"
        ) from None
    if "Y" not in pixels:
        raise InputError(
            path,
            f"channels {', '.join(pixels)}",
            "a channel Y in cd/m2",
            "write it with fieldlum merge",
        )
    try:
        heading = float(header.get("heading_deg", 180.0))
        t_utc = parse_utc(header["t_utc"]) if header.get("t_utc") else None
        sun = _sun_parse(header["sun"]) if header.get("sun") else None
        own = {
            k.removeprefix("fieldlum:"): str(v)
            for k, v in header.items()
            if k.startswith("fieldlum:")
        }
        view = str(header.get("view", ""))
    except (
        ValueError,
        TypeError,
        AttributeError,
    ) as error:  # a damaged attribute comes as bytes of no known type
        raise InputError(
            path, f"attribute {error}", "heading_deg, t_utc and sun as fieldlum writes them"
        ) from None
    rgb = np.stack([pixels[c] for c in "RGB"], axis=-1) if all(c in pixels for c in "RGB") else None
    flags = pixels["flags"].astype(np.uint16) if "flags" in pixels else None
    panorama = Panorama(pixels["Y"], heading, pixels.get("u"), flags, t_utc, sun, rgb, own)
    return panorama, view
