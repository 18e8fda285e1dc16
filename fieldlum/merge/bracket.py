"""Merge one bracket, of one or several headings, from its frames to a map."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Integers
from fieldlum.core.errors import InputError
from fieldlum.core.progress import part_of_progress
from fieldlum.core.records import Flag, JsonTable, Panorama
from fieldlum.merge.project import blend, finished_map, view_through
from fieldlum.merge.ratios import Exposures, any_beyond_prior
from fieldlum.merge.sensor_frames import Findings, SensorImage, merge_sensor
from fieldlum.merge.shots import Shot, middle_of, shots_of_files, sorted_shots
from fieldlum.merge.sun_and_sky import MEASURED, sky_cut, sun_on_sensor, take_out_disc
from fieldlum.optics.illuminance import illuminance_ahead_lx
from fieldlum.optics.images import PICTURE_SUFFIXES, write_picture
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import FULLY_SEEN_SHARE, Equirect, Fisheye, Target, signed_angle_deg
from fieldlum.optics.raw import roll_deg_of, white_balance_is_fixed
from fieldlum.session.codec import to_json
from fieldlum.session.files.sidecar import FrameQuality, MeasuredSun, MergeReport
from fieldlum.sky.sky_view.picture import SkyPicture
from fieldlum.sky.sun_disc import SunDisc


def orientation_conflict(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return a text for the verdict if the frames' EXIF roll is wrong; "" if it is not.

    The roll is wrong if it changes within the bracket, or differs by over 60 degrees from the
    profile's: a camera on its side gives a rotated map, and no other figure of the merge shows
    that. Cameras with several lenses, lenses tilted by over 45 degrees, and frames without EXIF
    orientation are not checked. Raises InputError for a file that is missing or empty.
    """
    lens = profile.lens[0]
    # Cameras with two fisheyes have no upright position, and the EXIF roll is unreliable when the
    # camera points up.
    if len(profile.lens) > 1 or abs(lens.tilt_deg) > 45.0:
        return ""
    rolls_deg = {roll for shot in shots if (roll := roll_deg_of(shot.path)) is not None}
    if len(rolls_deg) > 1:
        angles = " and ".join(f"{value:g}" for value in sorted(rolls_deg))
        return f"the camera turned within the bracket: roll angles {angles} deg; capture it again"
    off_deg = float(signed_angle_deg(rolls_deg.pop() - lens.roll_deg)) if rolls_deg else 0.0
    if abs(off_deg) <= 60.0:
        return ""
    return (
        f"by EXIF, the camera was held {abs(off_deg):.0f} deg off the profile's roll of "
        f"{lens.roll_deg:g} deg: hold it as in the calibration, or correct roll_deg of the profile"
    )


def floating_white_balance(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return the file name of the first JPEG frame without a fixed white balance; "" for none.

    With an automatic white balance the colours are unknown. "" too for a profile without weights
    for melanopic light, because nothing uses the colours, and for raw frames, whose counts no white
    balance changes. Raises InputError for a file that is missing or empty.
    """
    if profile.camera.kind == "raw" or not profile.colour.melanopic_from_rgb:
        return ""
    return next((shot.path.name for shot in shots if not white_balance_is_fixed(shot.path)), "")


def report_of(
    parts: Sequence[Findings], flags: Integers, target: Target, profile: CameraProfile
) -> MergeReport:
    """Return the figures of one merged bracket.

    parts: findings of each heading; flags [H, W]: of the result on the grid `target`. Shares of the
    view are in % of the solid angle that a lens sees; residual_percent is the largest of all
    neighbouring frames, None without any.
    """
    pairs = [n for part in parts for n in part.exposures.neighbours]
    turns = [turn for part in parts for turn in part.turns]
    surest = max(turns, key=lambda turn: turn.sure_px, default=None)
    variance_factor = max(factor for part in parts for factor in part.noise)
    return MergeReport(
        frames=tuple(frame for part in parts for frame in _frames(part)),
        neighbours=tuple(pairs),
        residual_percent=float(max(abs(n.residual_percent) for n in pairs)) if pairs else None,
        shifts=tuple(turns),
        shift_px=surest.shift_px if surest else None,
        shift_u_px=surest.u_px if surest else None,
        **_shares_percent(flags, target),
        exposure_span_percent=float(100 * max(np.ptp(p.exposures.log_deviation) for p in parts)),
        deviations=tuple(filter(None, (_deviation_text(part.exposures) for part in parts))),
        noise_over_profile=float(np.sqrt(variance_factor)),
        plateau_dn={f"{iso:g}": dn for iso, dn in parts[0].saturation.plateau_dn.items()},
        black_off_dn=max((p.saturation.black_off_dn for p in parts), key=abs),
        shutter_law=parts[0].exposures.law,
        u_ratio_percent=100 * float(np.sqrt(np.mean([p.exposures.u_rel**2 for p in parts]))),
        orientation_conflict=orientation_conflict([s for p in parts for s in p.shots], profile),
        filter_absent=tuple(name for part in parts for name in part.absent),
    )


def _shares_percent(flags: Integers, target: Target) -> dict[str, Any]:
    """Return the figures of a report that are shares of the view, in % of solid angle, by name.

    outside_percent is the share of the grid that no lens sees; the others are the shares of what a
    lens sees whose pixels have a flag. flags [H, W]: of the result on the grid `target`.
    """
    solid_sr = target.solid_angles()
    seen_sr = solid_sr * ((flags & Flag.OUTSIDE_LENS) == 0)
    flag_of = {
        "clipped_percent": Flag.CLIPPED_HIGH,
        "bloom_percent": Flag.BLOOM,
        "motion_percent": Flag.MOTION,
        "below_noise_percent": Flag.BELOW_NOISE,
    }
    total_sr = max(seen_sr.sum(), 1e-12)
    shares = {
        name: float(100 * (seen_sr * ((flags & flag) > 0)).sum() / total_sr)
        for name, flag in flag_of.items()
    }
    outside = 1 - seen_sr.sum() / max(solid_sr.sum(), 1e-12)
    return {**shares, "outside_percent": float(100 * outside)}


def _frames(part: Findings) -> list[FrameQuality]:
    """Return the report's entry of each frame of a heading, with its fitted exposure."""
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


def _deviation_text(exposures: Exposures) -> str:
    """Return by how many percent fitted exposures differ from the profile's: "-1.2 to +0.4".

    The text has the lowest and the highest of the frames; it is "" if the uncertainties of shutter,
    filter and ISO explain all differences.
    """
    log = exposures.log_deviation
    low, high = 100 * np.expm1([log.min(), log.max()])
    return f"{low:+.1f} to {high:+.1f}" if any_beyond_prior(log, exposures.u_prior) else ""


def verdict(report: MergeReport, *, only_sun: bool = False) -> str:
    """Return the verdict as one line: "good: ...", or what to check, separated by semicolons.

    only_sun: whether nothing but the sun's disc is clipped. The limits were chosen with simulated
    and real brackets (docs/merge.md, "Verdicts").
    """
    notes = [*_exposure_notes(report), *_camera_notes(report), *_view_notes(report, only_sun)]
    return "; ".join(notes) or f"good: frames agree within {report.residual_percent:.2f} %"


def _exposure_notes(report: MergeReport) -> Iterator[str]:
    """Yield cautions about exposures: single, not linked, contradicting or unlike the profile."""
    if len(report.frames) == 1:
        yield "a single frame: nothing confirms its exposure; take a bracket"
    elif report.residual_percent is None:
        yield "no two frames have common well-exposed pixels: plan smaller steps of exposure"
    elif report.residual_percent > 3.0:
        found = f"neighbouring frames disagree by {report.residual_percent:.1f} %"
        cause = "the light changed or something moved during the bracket"
        yield f"{found}: {cause}, or the response needs calibration"
    for text in report.deviations:
        cause = "the light changed during the bracket, or shutter times are wrong"
        remedy = "if every bracket shows this, write true times into the profile's [[shutter]]"
        yield f"fitted exposures differ from the profile by {text} %: {cause} ({remedy})"


def _camera_notes(report: MergeReport) -> Iterator[str]:
    """Yield cautions about filters, orientation, black level, noise and turns of the camera."""
    if report.filter_absent:
        found = "as bright as without the filter of its label, and used so"
        remedy = "put the filter on for these frames, or plan without it"
        yield f"{', '.join(report.filter_absent)}: {found}: {remedy}"
    if report.orientation_conflict:
        yield report.orientation_conflict
    if abs(off_dn := report.black_off_dn) > 1.0:
        remedy = "check that the profile belongs to this camera"
        yield f"the files' black level differs from the profile's by {off_dn:+.1f} DN: {remedy}"
    if report.noise_over_profile > 1.0:
        found = f"noise is {report.noise_over_profile:.1f} times the profile's, and u contains it"
        yield f"{found}: check gain_e_per_dn and read_noise_e of the profile"
    for turn in (turn for turn in report.shifts if turn.sure_px > 1.0):
        found = f"the camera turned by {turn.turn_deg:.2f} deg ({turn.shift_px:.1f} px) between "
        yield f"{found}{turn.long} and {turn.short}: fix the tripod and capture again"


def _view_notes(report: MergeReport, only_sun: bool) -> Iterator[str]:
    """Yield cautions about parts of the view that are clipped, in motion or below noise.

    only_sun: whether nothing but the sun's disc is clipped.
    """
    if clipped := report.clipped_percent:
        bound = "the sun's disc, whose illuminance is a lower bound until fieldlum pair"
        remedy = bound if only_sun else "add shorter exposures, unless it is the sun"
        yield f"clipped in every frame: {clipped:.3g} % of the view: {remedy}"
    if (motion := report.motion_percent or 0.0) > 2.0:
        cause = "people, leaves or clouds moved between frames"
        yield f"motion in {motion:.1f} % of the view: {cause}: capture the bracket again"
    if (below := report.below_noise_percent or 0.0) > 5.0:
        yield f"below noise: {below:.1f} % of the view in every frame: add longer exposures"


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How brackets are merged.

    height: rows of the result [px]; 230 are pixels of 0.8 degrees (docs/design.md). projection:
    "equirect" (a panorama, twice as wide as high) or "fisheye" (a square picture along the first
    lens). fit: whether exposure ratios are estimated from the frames, instead of taken from the
    profile; None: for raw frames only.
    """

    height: int = 230
    projection: str = "equirect"
    fit: bool | None = None

    def target(self, profile: CameraProfile) -> Target:
        """Return the pixel grid of the result: a panorama, or a fisheye like the first lens."""
        if self.projection == "equirect":
            return Equirect(self.height)
        return Fisheye.of_size(self.height, profile.lens[0])


@dataclass(frozen=True, slots=True)
class MergeResult:
    """A merged bracket: its map, a one-line verdict, and the figures that the verdict rests on.

    view: Radiance's view options of a fisheye picture, empty for a panorama. sun: the measured
    centre of the sun's disc; None if the disc was not searched for or is not visible. sky: the
    luminance around what can be sky; None if it was not requested or there is none.
    """

    panorama: Panorama
    report: MergeReport
    verdict: str
    view: str = ""
    sun: MeasuredSun | None = None
    sky: SkyPicture | None = None

    @property
    def quality(self) -> JsonTable:
        """Return the report with the keys of `quality` in `merge --json` (docs/merge.md)."""
        return to_json(self.report)


def merge_shots(
    shots: Sequence[Shot],
    profile: CameraProfile,
    options: MergeOptions | None = None,
    *,
    heading_deg: float = 180.0,
    sun_deg: tuple[float, float] | None = None,
    latitude_deg: float | None = None,
) -> MergeResult:
    """Merge a bracket of one or several headings.

    shots: in any order. options: None for the defaults of `MergeOptions`. heading_deg: azimuth of
    the resulting picture's centre, clockwise from true north. sun_deg: the sun's apparent altitude
    and azimuth; if the disc is visible there, it is removed from a panorama (not from a fisheye
    picture). None: the disc is not searched for. latitude_deg: of the camera, for the luminance
    around what can be sky; None: it is not cut. Raises InputError if the frames cannot be merged.
    """
    options = options or MergeOptions()
    target = options.target(profile)
    floating = floating_white_balance(shots, profile)
    if floating:
        profile = replace(profile, colour=replace(profile.colour, melanopic_from_rgb=()))
    images, findings, views = [], [], []
    groups = groupby(sorted_shots(shots, profile), key=lambda s: s.heading_deg)
    groups = [(heading, list(group)) for heading, group in groups]
    count = len(groups) * (1 + len(profile.lens))  # of steps whose progress is shown as one
    for heading, group in groups:
        turn_deg = 0.0 if heading is None else heading - heading_deg
        with part_of_progress(len(images), count):
            image, part = merge_sensor(group, profile, fit=options.fit, turn_deg=turn_deg)
        images.append(image)
        findings.append(part)
    for image, lens in product(images, profile.lens):
        with part_of_progress(len(images) + len(views), count):
            views.append(view_through(image, lens, target))
    seen = blend(views)
    panorama = finished_map(seen, profile, target, heading_deg=heading_deg, t_utc=middle_of(shots))
    flags = panorama.flags
    assert flags is not None  # by `finished_map`
    report = report_of(findings, flags, target, profile)
    sun, sky, is_sun = None, None, False
    if latitude_deg is not None and isinstance(target, Equirect):
        sky = sky_cut(views, seen, target, heading_deg, latitude_deg)
    if sun_deg is not None and isinstance(target, Equirect):
        panorama, disc = take_out_disc(panorama, *sun_deg)
        is_sun = disc is not None and not (flags & Flag.CLIPPED_HIGH)[~disc.pixels].any()
        sun = None if disc is None else _measured_sun(images, findings, panorama, disc)
    view = "" if isinstance(target, Equirect) else target.view(heading_deg)
    text = verdict(report, only_sun=is_sun)
    if floating:
        cause = f"EXIF of {floating} states no fixed white balance"
        text += f"; no melanopic colour, because {cause}: set that of the calibration"
    return MergeResult(panorama, report, text, view, sun, sky)


def _measured_sun(
    images: Sequence[SensorImage], findings: Sequence[Findings], panorama: Panorama, disc: SunDisc
) -> MeasuredSun | None:
    """Return the direction of the sun disc's centre on the sensor, and the time of its frames.

    images, findings: merged sensor and findings of each heading; disc: as found in `panorama`. None
    if no lens sees the disc. The time is the mean of the frames taken through a filter, if they
    show the disc; else of the least exposed frame of each heading.
    """
    place = sun_on_sensor(images, disc, panorama)
    if place is None:
        return None
    filtered = [s for part in findings for s in part.shots if s.exposure.nd]
    through_filter = panorama.sun is not None and panorama.sun.origin == MEASURED
    shown = filtered if through_filter else [part.shots[-1] for part in findings]
    times_s = [s.t_utc.timestamp() for s in shown if s.t_utc is not None]
    t_utc = datetime.fromtimestamp(float(np.mean(times_s)), UTC) if times_s else None
    altitude, azimuth, sigma_deg = place
    return MeasuredSun(
        altitude_deg=round(altitude, 4),
        azimuth_deg=round(azimuth, 4),
        sigma_deg=float(f"{sigma_deg:.3g}"),
        t_utc=t_utc,
    )


# ----------------------------------------------------------------------------------------------
# one picture file (`fieldlum merge --frames`)


def _axis_illuminance_lx(result: MergeResult, target: Target) -> float | None:
    """Return the illuminance [lx] at the camera on a plane that faces the picture's centre.

    target: pixel grid of the picture. This is the vertical illuminance for a camera that looks
    horizontally; None if the lens saw too little of the hemisphere in front.
    """
    panorama = result.panorama
    if isinstance(target, Equirect):
        return illuminance_ahead_lx(panorama)
    centre = np.arange(target.size) + 0.5
    cosine = np.maximum(target.rays(centre, centre) @ target.lens.axes()[2], 0.0)
    weights = cosine * target.solid_angles()  # with the sum pi in full view
    if (weights * panorama.seen).sum() < FULLY_SEEN_SHARE * np.pi:
        return None
    return float((panorama.luminance_cdm2 * weights).sum())


def files_to_picture(
    files: Sequence[Path],
    profile: CameraProfile,
    out: Path,
    options: MergeOptions | None = None,
    *,
    heading_deg: float = 180.0,
) -> tuple[MergeResult, dict[str, float | None]]:
    """Merge files of one heading and write the picture; return the result and its illuminance.

    The illuminance is a dict with the key vertical_illuminance_lx: at the camera, on a plane that
    faces the picture's centre; None if the lens saw too little of what lights the plane. Exposures
    come from the EXIF; the sun's disc is not searched for.
    options: None for the defaults. heading_deg: azimuth of the picture's centre, clockwise from
    true north. Raises InputError for a frame that cannot be merged, or if `out` ends neither in
    .exr nor in .hdr, OSError if `out` cannot be written.
    """
    if out.suffix.lower() not in PICTURE_SUFFIXES:  # before the merge, not after it
        raise InputError(out, f"the suffix '{out.suffix}'", ".exr or .hdr", "correct --out")
    options = options or MergeOptions()
    shots = shots_of_files(files, profile.camera.fixed_f_number)
    result = merge_shots(shots, profile, options, heading_deg=heading_deg)
    write_picture(out, result.panorama, result.view)
    illuminance_lx = _axis_illuminance_lx(result, options.target(profile))
    return result, {"vertical_illuminance_lx": illuminance_lx}
