"""Start an own camera profile from another one and a frame of the camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fieldlum.optics.profiles import CameraProfile, Lens
    from fieldlum.optics.raw import FrameInfo, Mosaic

# Relative standard uncertainties of a profile that nobody calibrated; chosen, as in the shipped
# uncalibrated profiles.
_GUESS_U_VIGNETTING, _GUESS_U_COLOUR, _GUESS_U_SCALE = 0.15, 0.2, 0.5


def write_own_camera(path: Path, start: str, photo: Path | None) -> None:
    """Write an own profile that starts from another one, with size and camera of a photo."""
    from fieldlum.optics.profiles import load_camera_profile, save_profile, uncalibrated_text

    profile = started_profile(load_camera_profile(start), start)
    if photo is not None:
        profile = _of_photo(profile, photo)
    save_profile(path, profile)
    load_camera_profile(path)
    body = profile.camera
    click.echo(f"written: {path}: {body.name}, {body.width_px} x {body.height_px} pixels")
    click.echo(f"note: {uncalibrated_text(profile)}")
    if photo is None:
        click.echo("note: size and camera are those of the start: state a frame with --photo")
    click.echo(f"next: fieldlum calibrate lens -h, then state profile = {path} in SITE.toml")


def _of_photo(profile: CameraProfile, photo: Path) -> CameraProfile:
    """Return a profile with size, camera and aperture of a frame; print its levels if it is raw."""
    from fieldlum.optics.raw import is_jpeg, jpeg_size, read_exif, read_mosaic

    fixed = profile.camera.fixed_f_number
    info = read_exif(photo, lens_f_number=fixed)
    if is_jpeg(photo):
        return with_frame(profile, jpeg_size(photo), info)
    mosaic = read_mosaic(photo, lens_f_number=fixed)
    click.echo(f"black level {mosaic.black_dn[0]:g} DN, white level {mosaic.white_dn:g} DN")
    height, width = mosaic.counts.shape
    return with_frame(profile, (width, height), info, mosaic)


def started_profile(profile: CameraProfile, start: str) -> CameraProfile:
    """Return a profile without a date of calibration; start: the name of the given profile.

    Uncertainties become those of a guess: a value that another camera calibrated is not measured.
    """
    from fieldlum.optics.profiles import Provenance

    def guessed(lens: Lens) -> Lens:
        vague = tuple(replace(v, u_rel=_GUESS_U_VIGNETTING) for v in lens.vignetting)
        return replace(lens, vignetting=vague)

    log = f"not measured: started from {start}; replace every part by fieldlum calibrate"
    return replace(
        profile,
        camera=replace(profile.camera, date="", note=f"uncalibrated; started from {start}"),
        lens=tuple(map(guessed, profile.lens)),
        colour=replace(profile.colour, u_rel=max(profile.colour.u_rel, _GUESS_U_COLOUR)),
        scale=replace(profile.scale, u_rel=max(profile.scale.u_rel, _GUESS_U_SCALE)),
        provenance=Provenance(f"started from {start}", log=(log,)),
    )


def with_frame(
    profile: CameraProfile,
    size_px: tuple[int, int],
    info: FrameInfo,
    mosaic: Mosaic | None = None,
) -> CameraProfile:
    """Return a profile with the size, model and aperture of a frame.

    size_px : width and height of the frame; image circles are scaled with the height. info : of
    its EXIF. mosaic : of a raw frame, for its colours and white level; None for a JPEG.
    """
    from fieldlum.optics.profiles import Sensor

    (width, height), exposure = size_px, info.exposure
    name = f"{info.model or 'unnamed camera'}, started from {profile.camera.name}"
    frame = {"width_px": width, "height_px": height, "make": info.make, "model": info.model}
    kind = "jpeg" if mosaic is None else "raw"
    by, across = height / profile.camera.height_px, width / profile.camera.width_px

    def scaled(lens: Lens) -> Lens:
        centre_px = (lens.centre_px[0] * across, lens.centre_px[1] * by)
        rings = tuple(replace(v, f_number=exposure.f_number) for v in lens.vignetting)
        return replace(lens, centre_px=centre_px, radius_px=lens.radius_px * by, vignetting=rings)

    sensor = profile.sensor
    if mosaic is not None:
        sensor = Sensor(cfa=mosaic.cfa, white_dn=mosaic.white_dn, iso=exposure.iso)
    return replace(
        profile,
        camera=replace(profile.camera, kind=kind, name=name, **frame),
        lens=tuple(map(scaled, profile.lens)),
        sensor=sensor,
        bracket=replace(profile.bracket, f_number=exposure.f_number, iso=exposure.iso),
        scale=replace(profile.scale, f_numbers=(exposure.f_number,)),
    )
