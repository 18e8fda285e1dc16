"""Compile the report of a merged bracket and its one-line verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Flag
from fieldlum.merge.ratios import any_beyond_prior
from fieldlum.merge.sensor import Findings
from fieldlum.merge.shots import Shot
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import Target, signed_angle_deg
from fieldlum.optics.raw import roll_deg_of, white_balance_is_fixed
from fieldlum.session.files.merge_report import FrameQuality, MergeReport


def orientation_conflict(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return a text for the verdict if the frames' EXIF roll is wrong; "" if it is not.

    The roll is wrong if it changes within the bracket, or differs by over 60 degrees from the
    profile's: a camera on its side gives a rotated map, and no other figure of the merge shows
    that. Cameras with several lenses, lenses tilted by over 45 degrees, and frames without EXIF
    orientation are not checked.
    """
    lens = profile.lens[0]
    # Cameras with two fisheyes have no upright position, and the EXIF roll is unreliable when the
    # camera points up.
    if len(profile.lens) > 1 or abs(lens.tilt_deg) > 45.0:
        return ""
    rolls_deg = {roll for shot in shots if (roll := roll_deg_of(shot.path)) is not None}
    if len(rolls_deg) > 1:
        angles = " and ".join(f"{value:g}" for value in sorted(rolls_deg))
        return (
            f"the camera was turned within the bracket: its EXIF has the roll angles {angles} deg; "
            "capture the bracket again with a fixed camera"
        )
    off = float(signed_angle_deg(rolls_deg.pop() - lens.roll_deg)) if rolls_deg else 0.0
    if abs(off) <= 60.0:
        return ""
    return (
        f"by EXIF, the camera was held {abs(off):.0f} deg off the profile's roll of "
        f"{lens.roll_deg:g} deg: hold it as in the calibration, or correct roll_deg of the profile"
    )


def floating_white_balance(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return the first JPEG frame without a fixed white balance; "" if there is none.

    Its colours are unknown. Only frames of a profile with a melanopic weight are examined; raw
    counts have no white balance.
    """
    if profile.camera.kind == "raw" or not profile.colour.melanopic_from_rgb:
        return ""
    names = (shot.path.name for shot in shots if not white_balance_is_fixed(shot.path))
    return next(names, "")


def report_of(
    parts: Sequence[Findings],
    flags: NDArray[np.integer],
    target: Target,
    profile: CameraProfile,
) -> MergeReport:
    """Return the figures of one merged bracket.

    parts: findings of each heading; flags [H, W]: of the result on the grid `target`. Shares of the
    view are in % of the solid angle that a lens sees; residual_percent is the largest of all
    neighbouring frames, None without any.
    """
    pairs = [n for part in parts for n in part.exposures.neighbours]
    turns = [turn for part in parts for turn in part.turns]
    surest = max(turns, key=lambda turn: turn.sure_px, default=None)
    noise = max(value for part in parts for value in (part.noise.shot, part.noise.read))
    return MergeReport(
        frames=tuple(frame for part in parts for frame in _frames(part)),
        neighbours=tuple(pairs),
        residual_percent=float(max(abs(n.residual_percent) for n in pairs)) if pairs else None,
        shifts=tuple(turns),
        shift_px=surest.shift_px if surest else None,
        shift_u_px=surest.u_px if surest else None,
        **_shares_percent(flags, target),
        exposure_span_percent=float(100 * max(np.ptp(p.exposures.log_deviation) for p in parts)),
        deviations=tuple(
            _range_text(p.exposures.log_deviation)
            for p in parts
            if any_beyond_prior(p.exposures.log_deviation, p.exposures.u_prior)
        ),
        noise_over_profile=float(np.sqrt(noise)),
        plateau_dn={f"{iso:g}": dn for iso, dn in parts[0].plateau_dn.items()},
        black_off_dn=max((p.black_off_dn for p in parts), key=abs),
        shutter_law=parts[0].exposures.law,
        u_ratio_percent=100 * float(np.sqrt(np.mean([p.exposures.u_rel**2 for p in parts]))),
        orientation_conflict=orientation_conflict([s for p in parts for s in p.shots], profile),
        filter_absent=tuple(name for part in parts for name in part.absent),
    )


def _shares_percent(flags: NDArray[np.integer], target: Target) -> dict[str, Any]:
    """Return shares of the solid angle: flagged of what a lens sees, and not seen of all, in %."""
    solid = target.solid_angles()
    seen_sr = solid * ((flags & Flag.OUTSIDE_LENS) == 0)
    named = {
        "clipped_percent": Flag.CLIPPED_HIGH,
        "bloom_percent": Flag.BLOOM,
        "motion_percent": Flag.MOTION,
        "below_noise_percent": Flag.BELOW_NOISE,
    }
    total = max(seen_sr.sum(), 1e-12)
    shares = {
        name: float(100 * (seen_sr * ((flags & flag) > 0)).sum() / total)
        for name, flag in named.items()
    }
    return {**shares, "outside_percent": float(100 * (1 - seen_sr.sum() / max(solid.sum(), 1e-12)))}


def _frames(part: Findings) -> list[FrameQuality]:
    fit = part.exposures.fit
    return [
        FrameQuality.of(
            shot.path.name,
            shot.exposure,
            round(float(correction), 6),
            u_percent=round(float(100 * u), 4),
            heading_deg=shot.heading_deg,
            t_utc=shot.t_utc,
        )
        for shot, correction, u in zip(part.shots, fit.correction, fit.u_log, strict=True)
    ]


def _range_text(log_deviation: Floats) -> str:
    """Return the smallest and the largest deviation in percent, such as "-1.2 to +0.4"."""
    low, high = 100 * np.expm1([log_deviation.min(), log_deviation.max()])
    return f"{low:+.1f} to {high:+.1f}"


def verdict(report: MergeReport) -> str:
    """Return the verdict as one line: "good: ...", or what to check, separated by semicolons.

    Its limits were chosen with simulated and real brackets (docs/merge.md, "Verdicts").
    """
    notes = [*_exposure_notes(report), *_camera_notes(report), *_view_notes(report)]
    return "; ".join(notes) or f"good: frames agree within {report.residual_percent:.2f} %"


def _exposure_notes(report: MergeReport) -> Iterator[str]:
    if report.residual_percent is None:
        yield (
            "no two frames have common well-exposed pixels, so the exposures could not be checked: "
            "plan smaller steps between exposures"
        )
    elif report.residual_percent > 3.0:
        yield (
            f"neighbouring frames disagree by {report.residual_percent:.1f} %: the light changed "
            "or something moved during the bracket, or the response needs calibration"
        )
    for text in report.deviations:
        yield (
            f"fitted exposures differ from the profile by {text} %: the light changed during the "
            "bracket, or shutter times need calibration (fieldlum calibrate shutter)"
        )


def _camera_notes(report: MergeReport) -> Iterator[str]:
    if report.filter_absent:
        yield (
            f"{', '.join(report.filter_absent)}: as bright as without the filter of its label, so "
            "it counts as a frame without it: put the filter on for these frames, or plan without "
            "filter in SITE.toml"
        )
    if report.orientation_conflict:
        yield report.orientation_conflict
    if abs(report.black_off_dn) > 1.0:
        yield (
            f"the files' black level differs from the profile's by {report.black_off_dn:+.1f} DN: "
            "check that the profile belongs to this camera"
        )
    if report.noise_over_profile > 1.0:
        yield (
            f"shot noise or read noise is {report.noise_over_profile:.1f} times the profile's, and "
            "the uncertainty u uses the larger value: check gain_e_per_dn and read_noise_e of "
            "the profile"
        )
    for turn in (turn for turn in report.shifts if turn.sure_px > 1.0):
        yield (
            f"the camera turned by {turn.turn_deg:.2f} deg ({turn.shift_px:.1f} px) between "
            f"{turn.long} and {turn.short}: fix the tripod and capture again"
        )


def _view_notes(report: MergeReport) -> Iterator[str]:
    if clipped := report.clipped_percent:
        yield (
            f"clipped in every frame: {clipped:.2g} % of the view, where luminance is a lower "
            "bound: add shorter exposures"
        )
    if (motion := report.motion_percent or 0.0) > 2.0:
        yield (
            f"motion in {motion:.1f} % of the view: people, leaves or clouds moved between frames: "
            "do not use the pixels with the flag motion, or capture the bracket again"
        )
    if (below := report.below_noise_percent or 0.0) > 5.0:
        yield (
            f"below noise: {below:.1f} % of the view is too dark in every frame: add longer "
            "exposures"
        )
