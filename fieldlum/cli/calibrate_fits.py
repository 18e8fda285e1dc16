"""What each part of `fieldlum calibrate` fits: the changed fields of the profile, and figures.

`fit_NAME` has the arguments of the command NAME. This module is imported when a command runs.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from fieldlum.calibrate import (
    colour,
    linearity,
    pictures,
    pixels,
    response,
    scale,
    shutter,
    stray,
    vignette,
)
from fieldlum.cli.calibrate_lens import FittedPart, Paths, lens_index, say_time, with_lens
from fieldlum.core.records import JsonTable
from fieldlum.optics.photometry import illuminance_verdict
from fieldlum.optics.profiles import CameraProfile, find_camera_profile
from fieldlum.session import open_session, sha256

# ----------------------------------------------------------------------------------------------
# light


def fit_response(profile: CameraProfile, sources: Paths) -> FittedPart:
    """Fit the response of a JPEG camera, and its shutter law if the frames show it."""
    say_time(sources, profile)
    brackets = response.brackets_in(sources)
    places = response.sample(brackets, profile, np.random.default_rng(1))
    fit = response.fit(places)
    figures: JsonTable = {
        "kind": fit.response.kind,
        "u_rel": fit.response.u_rel,
        "residual_rgb": list(fit.residual),
        "shutter_law": places.law.law,
        "shutter_law_by": places.law.decided_by,
        "shutter_law_misfit_percent": places.law.misfit_percent,
        "iso_seconds": [round(float(e), 6) for e in np.exp(places.log_exposure)],
        "step_deviation_percent": [round(100.0 * float(d), 2) for d in places.steps.deviation],
    }
    changed: dict[str, Any] = {"response": fit.response}
    if places.law.decided_by == "frames" or profile.shutter_law != "auto":
        changed["shutter_law"] = places.law.law
    lines = [text for text in (fit.choice.line, places.steps.text) if text]
    return FittedPart(
        changed, lines, places.frames, figures, lambda: pictures.of_response(places, fit)
    )


def fit_vignette(profile: CameraProfile, sources: Paths, lens_number: int) -> FittedPart:
    """Fit the loss of light towards the edge of a lens, for one aperture."""
    index = lens_index(profile, lens_number)
    if len(sources) == 1 and sources[0].suffix.lower() == ".csv":
        samples = vignette.from_table(sources[0], profile, index)
    else:
        say_time(sources, profile)
        samples = vignette.from_uniform(sources, profile, index)
    fit, old = vignette.fit(samples), profile.lens[samples.lens]
    new = vignette.with_curve(old, samples.f_number, fit)
    figures: JsonTable = {
        "f_number": samples.f_number,
        "coefficients": list(fit.coefficients),
        "u_rel": fit.u_rel,
    }
    changed = {"lens": with_lens(profile, samples.lens, new)}
    return FittedPart(
        changed,
        [fit.choice.line],
        samples.frames,
        figures,
        lambda: pictures.of_vignette(samples, fit, old.full_angle_deg / 2),
    )


def fit_colour(profile: CameraProfile, sources: Path, corners: str | None) -> FittedPart:
    """Fit luminance from camera R, G, B."""
    is_table = sources.suffix.lower() == ".csv"
    if is_table:
        colours = colour.from_table(sources, profile)
    else:
        colours = colour.from_chart(sources, profile, _numbers(corners, 8) if corners else ())
    fit = colour.fit(colours, profile)
    notes = []
    if is_table and abs(fit.scale - 1) > 0.03:
        notes.append(
            f"the readings would multiply k by {fit.scale:.3f}: run fieldlum calibrate scale next"
        )
    figures: JsonTable = {
        "y_from_rgb": list(fit.y_from_rgb),
        "u_rel": fit.u_rel,
        "readings": len(colours.y),
    }
    new = replace(profile.colour, y_from_rgb=fit.y_from_rgb, u_rel=round(fit.u_rel, 5))
    frames = [sources, *colours.frames]
    return FittedPart(
        {"colour": new},
        [fit.choice.line],
        frames,
        figures,
        lambda: pictures.of_colour(colours, fit),
        notes,
    )


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise click.UsageError(f"--corners needs {count} numbers, separated by commas")
    return numbers


def fit_scale(profile: CameraProfile, sources: Path, meter_u: float) -> FittedPart:
    """Fit the absolute factor k to meter readings."""
    readings, frames, notes = scale.from_table(sources, profile)
    fit = scale.fit(readings, meter_u, sources)
    doubt = scale.check_level(fit, profile, sources)
    points: list[JsonTable] = [
        {
            "reading": r.label,
            "meter": r.meter,
            "picture": r.image * fit.factor,
            "off_percent": round(100 * float(off), 2),
        }
        for r, off in zip(readings, fit.residual, strict=True)
    ]
    rows = [
        "  {reading:32} meter {meter:9.4g}  picture {picture:9.4g}  {off_percent:+6.2f} %".format(
            **point
        )
        for point in points
    ]
    gates = [
        illuminance_verdict(r.image * fit.factor, r.meter)
        for r in readings
        if r.kind == "illuminance"
    ]
    k, u = round(profile.scale.k * fit.factor, 5), round(fit.u_rel, 4)
    figures: JsonTable = {
        "k": k,
        "u_rel": u,
        "factor": fit.factor,
        "far": list(fit.far),
        "illuminance": gates,
    }
    line = f"{fit.line}; k = {k:g}, uncertainty {100 * u:.1f} % from {len(readings)} readings"
    line += "".join(f"; illuminance: {gate}" for gate in gates)
    line += f"; CAUTION: {doubt}" if doubt else ""
    return FittedPart(
        {"scale": replace(profile.scale, k=k, u_rel=u)},
        [line],
        [sources, *frames],
        figures,
        lambda: pictures.of_scale(readings, fit),
        [*notes, *scale.slips(readings, fit), *([doubt] if doubt else [])],
        rows,
        {"points": points},
    )


def fit_stray(profile: CameraProfile, sources: Path) -> FittedPart:
    """Fit the lens's stray light to readings of dark places."""
    readings = stray.from_table(sources, profile)
    fit = stray.fit(readings, sources)
    figures: JsonTable = {
        "angle_deg": list(fit.kernel.angle_deg),
        "per_sr": list(fit.kernel.per_sr),
        "u_rel": fit.kernel.u_rel,
        "total_share": round(fit.total_share, 5),
    }
    changed = {"stray": fit.kernel, "glare_floor_rel": 0.0}  # the kernel's u_rel replaces the floor
    frames = [sources, *dict.fromkeys(r.picture for r in readings)]
    return FittedPart(
        changed, [fit.choice.line], frames, figures, lambda: pictures.of_stray(readings, fit)
    )


# ----------------------------------------------------------------------------------------------
# raw cameras


def fit_shutter(profile: CameraProfile, sources: Paths, camera: str) -> FittedPart:
    """Fit the shutter's true times; camera : the text of --camera."""
    digest = sha256(find_camera_profile(camera))
    read = [shutter.from_session(open_session(path), digest) for path in sources]
    files = [file for _, sidecars in read for file in sidecars]
    profile = shutter.with_law_of(profile, files)
    fit = shutter.fit([bracket for brackets, _ in read for bracket in brackets], profile)
    notes = [f"not used: {why}; capture more brackets in steady light" for why in fit.left_out]
    times: list[JsonTable] = []
    rows = []
    for t, assumed_s, n in zip(fit.times, fit.assumed_s, fit.brackets, strict=True):
        table = {"nominal_s": t.nominal_s, "true_s": t.true_s, "u_rel": t.u_rel}
        times.append({**table, "assumed_s": assumed_s, "brackets": n})
        rows.append(
            f"  {t.nominal_s:<10.6g} s is {t.true_s:<10.6g} s: "
            f"{100 * (t.true_s / assumed_s - 1):+6.2f} % from the profile, "
            f"u {100 * t.u_rel:.2f} %, {n} brackets"
        )
    return FittedPart(
        {"shutter": shutter.with_times(profile, fit)},
        [fit.line],
        files,
        {"times": len(times)},
        lambda: pictures.of_shutter(fit),
        notes,
        rows,
        {"times": times},
        profile,
    )


def fit_pixels(profile: CameraProfile, sources: Paths, dark: bool) -> FittedPart:
    """List bad pixels; those that the profile already lists remain."""
    say_time(sources, profile)
    defects = pixels.find(sources, profile, dark=dark)
    bad_px = tuple(sorted({*profile.sensor.bad_px, *defects.bad_px}))
    figures: JsonTable = {
        "found": len(defects.bad_px),
        "new": len(bad_px) - len(profile.sensor.bad_px),
        "views": defects.views,
        "by_chance": defects.by_chance,
    }
    return FittedPart(
        {"sensor": replace(profile.sensor, bad_px=bad_px)},
        [defects.line],
        defects.frames,
        figures,
        lambda: pictures.of_pixels(defects, profile.camera.width_px, profile.camera.height_px),
        only_json={"bad_px": [list(place) for place in defects.bad_px]},
    )


def fit_linearity(profile: CameraProfile, sources: Paths) -> FittedPart:
    """Fit how far raw counts are from proportional to light, and the shutter's offset."""
    say_time(sources, profile)
    folders = {path: sorted(p for p in path.glob("*") if p.is_file()) for path in sources}
    files = [file for path in sources for file in (folders[path] if path.is_dir() else [path])]
    plain = replace(profile, sensor=replace(profile.sensor, linearity=(), exposure_offset_s=0.0))
    levels = linearity.read_levels(files, plain)
    fit = linearity.fit(levels)
    sensor = replace(
        profile.sensor,
        linearity=fit.coefficients,
        linearity_u_rel=fit.u_rel,
        exposure_offset_s=fit.offset_s,
    )
    figures: JsonTable = {
        "linearity": list(fit.coefficients),
        "u_rel": fit.u_rel,
        "exposure_offset_s": fit.offset_s,
        "u_exposure_offset_s": fit.u_offset_s,
    }
    return FittedPart(
        {"sensor": sensor},
        [fit.choice.line],
        levels.frames,
        figures,
        lambda: pictures.of_linearity(levels, fit),
    )
