"""Camera profiles: calibration/NAME.toml, everything between sensor counts and cd/m2."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Exposure, Slot
from fieldlum.core.strict_toml import build, plain, read_toml
from fieldlum.optics.profiles.tables import (
    Bracket,
    CameraBody,
    CameraProfile,
    Colour,
    Lens,
    NeutralDensity,
    Provenance,
    Response,
    Scale,
    Sensor,
    ShutterTime,
    StrayLight,
    Vignetting,
    check_camera,
)
from fieldlum.optics.projection import judged_text, seen_by_lenses

_PACKAGE = Path(__file__).parents[2]


def shipped(kind: Literal["calibration", "capture_plans"]) -> Path:
    """Return the folder of the files that fieldlum ships, in a wheel or in a checkout."""
    in_wheel = _PACKAGE / "_shipped" / kind
    return in_wheel if in_wheel.is_dir() else _PACKAGE.parent / kind


def coverage_text(profile: CameraProfile, setup: CameraSetup) -> str:
    """Return one sentence on the view directions that lenses and headings see; "" if all.

    If the heading and its opposite would see all directions, the text names these two.
    """
    headings = setup.headings or (setup.heading_deg,)
    turns = [heading - setup.heading_deg for heading in headings]
    text = judged_text(seen_by_lenses(profile.lens, turns), setup.heading_deg)
    if not text:
        return ""
    opposite = [setup.heading_deg % 360.0, (setup.heading_deg + 180.0) % 360.0]
    shares_seen = seen_by_lenses(
        profile.lens, [heading - setup.heading_deg for heading in opposite]
    )
    if judged_text(shares_seen, setup.heading_deg):
        return f"{text}; use a lens that sees more, or turn the camera to several headings"
    named = ", ".join(f"{heading:g}" for heading in opposite)
    return f"{text}; for all directions write headings = [{named}] under [camera] in SITE.toml"


DEFAULT_CAMERA = "sim-dual-fisheye"


def camera_names() -> list[str]:
    """Return the names of the shipped camera profiles, simulated cameras last."""
    names = (path.stem for path in shipped("calibration").glob("*.toml"))
    return sorted(names, key=lambda name: (name.startswith("sim-"), name))


def assumed_texts(setup: CameraSetup) -> list[str]:
    """Return a sentence for the heading and one for the camera that SITE.toml does not state."""
    texts = []
    if "heading_deg" in setup.assumed:
        texts.append(
            f"no heading of the camera is stated: {setup.heading_deg:g} deg is assumed, and a "
            "wrong heading turns every result; measure it and state heading_deg under [camera]"
        )
    if "profile" in setup.assumed:
        texts.append(
            f"no camera is stated: times, exposures and directions are those of the simulated "
            f"{DEFAULT_CAMERA}, and the size of the files is unknown; state profile under "
            "[camera] (fieldlum new lists cameras)"
        )
    return texts


def uncalibrated_text(profile: CameraProfile) -> str:
    """Return one sentence on what a profile without a date of calibration costs; "" with a date."""
    if profile.camera.date:
        return ""
    vignetting = max((v.u_rel for lens in profile.lens for v in lens.vignetting), default=0.0)
    parts = (("scale", profile.scale.u_rel), ("colour", profile.colour.u_rel))
    shares = [f"{name} {100 * u:.0f} %" for name, u in (*parts, ("vignetting", vignetting)) if u]
    return (
        f"{profile.camera.name} has no date of calibration: standard uncertainties are "
        f"{', '.join(shares)}, and directions may be wrong by some degrees; calibrate lens, "
        "vignette, colour and scale (fieldlum calibrate -h)"
    )


def find_camera_profile(name: str) -> Path:
    """Return the path of a profile: `name` as a path, or else a file that is shipped.

    A shipped name may omit .toml; "" means sim-dual-fisheye. Raises InputError, with the shipped
    names, if no file fits.
    """
    path = Path(name or DEFAULT_CAMERA)
    for candidate in (
        path,
        shipped("calibration") / path.name,
        shipped("calibration") / f"{path.name}.toml",
    ):
        if candidate.is_file():
            return candidate
    raise InputError(
        name,
        "no such camera profile",
        f"the path of a TOML file, or one of: {', '.join(camera_names())}",
        "correct --camera, or profile under [camera] in SITE.toml ([setup.camera] in the "
        "session.toml of a planned session)",
    )


def load_camera_profile(name: str | Path) -> CameraProfile:
    """Read a profile: a shipped one by name, or any by path; "" is sim-dual-fisheye.

    Raises InputError for a missing file, one that is not a profile, or impossible values.
    """
    path = find_camera_profile(str(name))
    profile = build(CameraProfile, read_toml(path), str(path))
    check_camera(profile, str(path))
    return profile


def save_profile(path: Path, profile: CameraProfile) -> None:
    """Write a profile as TOML, over an existing file; the file appears complete or not at all."""
    import tomli_w

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(tomli_w.dumps(plain(profile)), encoding="utf-8")
    temporary.replace(path)


def bracket_exposures(bracket: Bracket, filter_name: str = "") -> tuple[Exposure, ...]:
    """Return exposures without a filter, then those with a filter; each longest time first."""

    def group(times_s: Sequence[float], name: str) -> list[Exposure]:
        exposures = (bracket.f_number, bracket.iso, name)
        return [Exposure(t, *exposures) for t in sorted(times_s, reverse=True)]

    filtered = group(bracket.nd_shutter_s, filter_name) if filter_name else []
    return (*group(bracket.shutter_s, ""), *filtered)


def planned_exposures(profile: CameraProfile, setup: CameraSetup) -> tuple[Exposure, ...]:
    """Return the exposures of each slot; frames through a filter only if `setup` names one.

    Raises InputError for a filter that the profile does not have, or without times for it.
    """
    names = [nd.name for nd in profile.nd]
    if setup.filter and not (setup.filter in names and profile.bracket.nd_shutter_s):
        finding = f"no filter '{setup.filter}'"
        if setup.filter in names:
            finding = f"no shutter times through '{setup.filter}'"
        raise InputError(
            profile.camera.name,
            finding,
            f"one of its filters ({', '.join(names) or 'none'}), with nd_shutter_s under [bracket]",
            "correct filter under [camera] in SITE.toml, or add [[nd]] to the profile",
        )
    return bracket_exposures(profile.bracket, setup.filter)


def sun_text(slots: Sequence[Slot]) -> str:
    """Return how the sun's disc is measured in those slots whose camera sees it; "" for none."""
    in_view = [slot for slot in slots if "sun-in-view" in slot.tags]
    if not in_view:
        return ""
    text = f"the sun is in view of the lens in {len(in_view)} slots"
    names = sorted({exposure.nd for slot in in_view for exposure in slot.exposures if exposure.nd})
    if names:
        return (
            f"{text}, with frames through the filter {', '.join(names)}: a person must put it on "
            "and take it off in each bracket, because no driver moves one; without a person plan "
            "without a filter"
        )
    return (
        f"{text}, which no exposure reaches: the illuminance of its disc is computed from DNI; "
        "a person at the camera can use a filter instead (filter in SITE.toml)"
    )
