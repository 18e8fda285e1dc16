"""`fieldlum new`: ask questions about a site and write its SITE.toml, or an own camera profile."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import click

from fieldlum.cli.options import command_of
from fieldlum.core.errors import InputError, did_you_mean
from fieldlum.core.files import read_bytes, write_file
from fieldlum.core.records import CameraSetup, Site, SiteFile

if TYPE_CHECKING:
    from fieldlum.optics.profiles import CameraProfile, Lens

T = TypeVar("T")
# Relative standard uncertainties of a profile that nobody calibrated, as in the shipped
# uncalibrated profiles.
_GUESSES = {"scale": 0.5, "colour": 0.2, "vignetting": 0.15}


@command_of("new")
def command(
    site_file: Annotated[Path, "SITE.toml|CAMERA.toml"],
    camera: str | None = None,
    photo: Path | None = None,
) -> None:
    """Ask about a site and write its SITE.toml, or write a camera profile.

    Place, camera and heading give the full answer; a room is an option: docs/file-formats.md
    describes it, and capture_plans/template.toml has one to copy. An existing file is not
    overwritten. After an interruption the same command offers the answers so far.

    \b
    Example:
      fieldlum new office.toml
      fieldlum new my-z1.toml --camera ricoh-theta-z1-uncalibrated --photo R0010001.DNG

    Options:
      --camera PROFILE: Write an own camera profile instead, which starts from this one.
      --photo FRAME: With --camera: a frame of it, which states its size and model.
    """
    from fieldlum.session.site_toml import load_site

    if site_file.exists():
        raise InputError(site_file, "the file exists already", "a new file", "choose another name")
    if camera is not None:
        _write_own_camera(site_file, camera, photo)
        return
    if photo is not None:
        raise click.UsageError("--photo describes an own camera: name a profile with --camera")
    site_file.parent.mkdir(parents=True, exist_ok=True)
    dialogue = Dialogue(site_file)
    write_file(site_file, site_text(SiteFile(_site(dialogue), _camera(dialogue))))
    load_site(site_file)
    dialogue.path.unlink(missing_ok=True)
    click.echo(f"written: {site_file}")
    click.echo(f"next: fieldlum plan {site_file} --set 9-day --out {site_file.stem}-session")


# ----------------------------------------------------------------------------------------------
# asking


class Dialogue:
    """Questions at a terminal, whose answers are stored in a file.

    After an interruption the answers are offered again.
    """

    def __init__(self, site_file: Path) -> None:
        """Read earlier answers for the same SITE.toml, in the file NAME.answers next to it."""
        self.site_file, self.path = site_file, site_file.with_name(f"{site_file.name}.answers")
        self.answers: dict[str, str] = {}
        with suppress(OSError, ValueError, TypeError):
            self.answers = dict(json.loads(read_bytes(self.path)))
            click.echo(f"{self.path} has your answers so far: press Enter to keep one")

    def ask(self, question: str, reader: Callable[[str], T], default: str | None = None) -> T:
        """Ask a question until `reader` accepts the answer; return what `reader` returns.

        The answer is stored, and offered next time. question: also the name under which it is
        stored; reader: returns the value of a text, and raises ValueError, InputError or a click
        error for a wrong answer; default: answer of an empty line; None if there is none. Raises
        InputError if the input ends before the answer, KeyboardInterrupt for Ctrl-C.
        """

        def checked(text: str) -> T:
            """Return the value of an answer, and store the answer.

            Raises click.UsageError for a wrong answer, after which click asks again.
            """
            try:
                value = reader(text.strip())
            except (InputError, ValueError) as error:
                raise click.UsageError(str(error)) from None
            self.answers[question] = text
            write_file(self.path, json.dumps(self.answers, ensure_ascii=False))
            return value

        offered = self.answers.get(question, default)
        try:
            return click.prompt(question, default=offered, value_proc=checked)
        except click.Abort as error:  # the end of the input, or Ctrl-C
            click.echo()
            if isinstance(error.__context__, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            finding, expected = f"no answer to '{question}'", "an answer to each question"
            remedy = "run fieldlum new at a terminal, which offers the answers so far"
            raise InputError(self.site_file, finding, expected, remedy) from None


# Readers of answers: they return the value of a text, and raise ValueError or a click error for a
# text that is no answer.


def _name(text: str) -> str:
    """Return the name of a site."""
    if not text or not text.isprintable():
        raise ValueError("a name of printable characters")
    return text


def _number(low: float, high: float) -> Callable[[str], float]:
    """Return a reader of a number from `low` to `high`, also with a decimal comma."""

    def reader(text: str) -> float:
        """Return the number in a text; raise ValueError or a click error for another text."""
        value = click.FLOAT(text.replace(",", "."))
        if not low <= value <= high:
            raise ValueError(f"{value:g}: expected {low:g} to {high:g}")
        return value

    return reader


def _angle(limit_deg: float, letters: str) -> Callable[[str], float]:
    """Return a reader of a latitude or longitude in degrees, such as 122.33 W.

    letters: of the positive and of the negative direction, such as "EW".
    """

    def reader(text: str) -> float:
        """Return the angle in a text [deg]; errors are those of `_number`."""
        sign = -1.0 if text[-1:].upper() == letters[1] else 1.0
        return sign * _number(-limit_deg, limit_deg)(text.rstrip(f" °{letters}{letters.lower()}"))

    return reader


def _azimuths(text: str) -> tuple[float, ...]:
    """Return azimuths in degrees, of a text such as "180, NW"; empty for "-"."""
    from fieldlum.optics.projection import compass_name

    degrees_of = {compass_name(22.5 * k): f"{22.5 * k}" for k in range(16)}
    parts = [] if text == "-" else text.split(",")
    return tuple(_number(0.0, 360.0)(degrees_of.get(p.strip().upper(), p)) for p in parts)


# ----------------------------------------------------------------------------------------------
# parts


def _site(dialogue: Dialogue) -> Site:
    """Ask for the place, again until its coordinates and time zone agree; return the answers."""
    from zoneinfo import available_timezones

    from fieldlum.session.site_toml import site_from_table, wrong_sign_text

    name = dialogue.ask("Name of the site", _name)
    zones = available_timezones()

    def zone(text: str) -> str:
        """Return the name of a time zone that exists; raise ValueError for another text."""
        if text not in zones:
            raise ValueError(f"unknown time zone '{text}'{did_you_mean(text, zones)}")
        return text

    while True:
        latitude = dialogue.ask("Latitude in degrees (like 47.61, 47.61 N)", _angle(90.0, "NS"))
        question = "Longitude in degrees (like -122.33, 122.33 W)"
        longitude = dialogue.ask(question, _angle(180.0, "EW"))
        timezone = dialogue.ask("Time zone, IANA name (like Europe/Rome)", zone)
        site = Site(name, latitude, longitude, timezone)
        try:
            site_from_table({"site": asdict(site)}, "this place")
            wrong = wrong_sign_text(site)
        except InputError as error:
            wrong = str(error)
        if not wrong:
            break
        click.echo(f"Error: {wrong}; north and east are positive; press Enter to keep an answer")
    # Without a default: a wrong one changes the DNI that is derived from global irradiance.
    altitude = dialogue.ask("Altitude above the sea in m", _number(-500.0, 9000.0))
    return replace(site, altitude_m=altitude)


def _camera(dialogue: Dialogue) -> CameraSetup:
    """Ask for the camera's profile, heading and height, and headings to which it is turned.

    Return the answers; unknown values are listed in `assumed`.
    """
    from fieldlum.optics.profiles import camera_names, load_camera_profile

    names = camera_names()
    listed = [f"  {number}  {name}" for number, name in enumerate(names, start=1)]
    click.echo("\n".join(["Cameras with a profile:", *listed]))
    click.echo("Another camera: fieldlum new CAMERA.toml --camera SIMILAR --photo FRAME")

    def profile(text: str) -> str:
        """Return name or path of the profile that an answer means; "" for none.

        The answer may be a number of the list, a path, or words of one name. Raises ValueError for
        another answer, InputError for a profile that cannot be used.
        """
        if text.lower() in ("none", "none yet"):
            return ""
        if text.isdigit() and 0 < int(text) <= len(names):
            text = names[int(text) - 1]
        words = text.lower().split()
        similar = [name for name in names if text and all(word in name for word in words)]
        chosen = similar[0] if len(similar) == 1 and text not in names else text
        if not Path(chosen).is_file() and chosen not in names:
            which = f"; is it {' or '.join(similar)}?" if similar else ""
            known = f"number, name or path of a profile{which}"
            raise ValueError(f"'{text}' is no {known}; without one answer none")
        load_camera_profile(chosen)
        return chosen

    question = "Camera: a number, a name, the path of your own profile, or none"
    chosen = dialogue.ask(question, profile)
    question = "Azimuth that the camera faces: degrees from true north, or like NW (- unknown)"
    facing = dialogue.ask(question, _azimuths)
    height = dialogue.ask("Height of the lens above the floor in m", _number(0.05, 50.0), "1.2")
    question = "Headings to which a person turns the camera, with commas (- for a fixed camera)"
    headings = dialogue.ask(question, _azimuths, "-")
    missing = {"heading_deg": not facing, "profile": not chosen}
    unknown = tuple(name for name, is_missing in missing.items() if is_missing)
    heading = facing[0] if facing else CameraSetup().heading_deg
    return CameraSetup(chosen, heading, headings, height, unknown)


def site_text(setup: SiteFile) -> str:
    """Return the text of a SITE.toml, without [pyranometer].

    Values that were only assumed are comments, so that the user states them later.
    """
    import tomli_w

    from fieldlum.session.site_toml import site_table

    table = site_table(setup)
    lines = ["# Written by fieldlum new. docs/file-formats.md has every key."]
    for name in table["camera"].pop("assumed"):
        del table["camera"][name]
        lines.append(f"# [camera] {name} = ... # not known yet: state it")
    del table["pyranometer"]
    return "\n".join([*lines, tomli_w.dumps(table)])


# ----------------------------------------------------------------------------------------------
# an own camera profile


def _write_own_camera(path: Path, start: str, photo: Path | None) -> None:
    """Write a profile of an own camera, and print what to do next.

    start: the profile to start from, a name or a path; photo: a frame of the camera, which states
    its size and model; None to copy them from `start`.
    """
    from fieldlum.optics.profiles import load_camera_profile, save_profile, uncalibrated_text

    profile = started_profile(load_camera_profile(start), start)
    before = profile.camera
    if photo is not None:
        profile = _of_photo(profile, photo)
    save_profile(path, profile)
    body = profile.camera
    click.echo(f"written: {path}: {body.name}, {body.width_px} x {body.height_px} pixels")
    click.echo(f"note: {uncalibrated_text(profile)}")
    size = "scaled with the frame" if photo else "as its picture: state a frame with --photo"
    circle = f"note: image circles are those of a {before.model or before.name}, {size}"
    click.echo(f"{circle}; measure yours with fieldlum calibrate lens --circle")
    click.echo(
        f'next: fieldlum calibrate lens -h, then profile = "{path}" under [camera] in SITE.toml'
    )


def started_profile(profile: CameraProfile, start: str) -> CameraProfile:
    """Return an uncalibrated profile with the values of `profile`; start: name of that profile.

    It has no date of calibration. Its uncertainties of vignetting, colour and scale are at least
    those of a guess, because values of another camera are not measured.
    """
    from fieldlum.optics.profiles import Provenance

    def guessed(lens: Lens) -> Lens:
        """Return the lens with at least the uncertainty of a guessed vignetting."""
        u_rel = _GUESSES["vignetting"]
        vague = tuple(replace(v, u_rel=max(v.u_rel, u_rel)) for v in lens.vignetting)
        return replace(lens, vignetting=vague)

    log = f"not measured: started from {start}; replace every part by fieldlum calibrate"
    return replace(
        profile,
        camera=replace(profile.camera, date="", note=f"uncalibrated; started from {start}"),
        lens=tuple(map(guessed, profile.lens)),
        colour=replace(profile.colour, u_rel=max(profile.colour.u_rel, _GUESSES["colour"])),
        scale=replace(profile.scale, u_rel=max(profile.scale.u_rel, _GUESSES["scale"])),
        provenance=Provenance(f"started from {start}", log=(log,)),
    )


def _of_photo(profile: CameraProfile, photo: Path) -> CameraProfile:
    """Return a profile with the size, model, aperture and megabytes of a frame of another camera.

    From a raw frame it gets white level and colour filters too, and black and white level [DN] are
    printed. Image circles are scaled with the height. Raises InputError for a JPEG if the profile
    is of raw frames, and the reverse.
    """
    from fieldlum.optics.profiles import Sensor
    from fieldlum.optics.raw import is_jpeg, jpeg_size, read_exif, read_mosaic

    before, sensor = profile.camera, profile.sensor
    info = read_exif(photo, lens_f_number=before.fixed_f_number)
    f_number, iso = info.exposure.f_number, info.exposure.iso
    kind = "jpeg" if is_jpeg(photo) else "raw"
    if kind != before.kind:  # its response would be wrong by a factor of several
        start = "phone-clip-on-fisheye" if kind == "jpeg" else "canon-eos-8mm"
        found, expected = f"a {kind} frame", f"a {before.kind} frame, as {before.name} takes"
        remedy = f"name such a frame, or start from a profile such as {start}-uncalibrated"
        raise InputError(photo, found, expected, remedy)
    if kind == "jpeg":
        width, height = jpeg_size(photo)
    else:
        mosaic = read_mosaic(photo, lens_f_number=before.fixed_f_number)
        height, width = mosaic.counts.shape
        sensor = Sensor(cfa=mosaic.cfa, white_dn=mosaic.white_dn, iso=iso)
        click.echo(f"black level {mosaic.black_dn[0]:g} DN, white level {mosaic.white_dn:g} DN")
    x_scale, y_scale = width / before.width_px, height / before.height_px

    def scaled(lens: Lens) -> Lens:
        """Return a lens of the profile, changed to the frame's size and aperture."""
        x_px, y_px = lens.centre_px
        centre_px, radius_px = (x_px * x_scale, y_px * y_scale), lens.radius_px * y_scale
        curves = tuple(replace(curve, f_number=f_number) for curve in lens.vignetting)
        return replace(lens, centre_px=centre_px, radius_px=radius_px, vignetting=curves)

    name = f"{info.model or 'unnamed camera'}, started from {before.name}"
    megabytes = round(photo.stat().st_size / 1e6, 1)
    bracket = {"f_number": f_number, "iso": iso, "megabytes_per_frame": megabytes}
    size = {"width_px": width, "height_px": height, "make": info.make, "model": info.model}
    return replace(
        profile,
        camera=replace(before, name=name, **size),
        lens=tuple(map(scaled, profile.lens)),
        sensor=sensor,
        bracket=replace(profile.bracket, **bracket),
        scale=replace(profile.scale, f_numbers=(f_number,)),
    )
