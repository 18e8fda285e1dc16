"""Read which frames belong to a bracket, and the prior uncertainty of their exposures."""

import filecmp
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Exposure
from fieldlum.optics.exposure import LAWS, z_per_cdm2
from fieldlum.optics.linear_light import SAME_LABEL, nd_factors, true_shutter_s
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import frame_files, is_jpeg, read_exif
from fieldlum.session import safe_paths, sha256
from fieldlum.session.files.capture_json import CaptureFile

# Relative standard uncertainties, not measured: of a shutter time from frame to frame; of the gain
# at an ISO other than the profile's, because gains of amplifiers are not exact.
U_REPEAT = 2e-4
U_ISO = 0.03


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of a bracket: its file, nominal exposure, heading and time.

    heading_deg: azimuth of the camera, clockwise from true north; None if the camera has only the
    heading of the resulting picture. t_utc: None if unknown. sha256: of the file; "" if unknown.
    """

    path: Path
    exposure: Exposure
    heading_deg: float | None = None
    t_utc: datetime | None = None
    sha256: str = ""


def middle_of(shots: Sequence[Shot]) -> datetime | None:
    """Return the time halfway between first and last frame; None if no frame has a time."""
    times = [s.t_utc for s in shots if s.t_utc is not None]
    return min(times) + (max(times) - min(times)) / 2 if times else None


def shots_of_slot(folder: Path) -> list[Shot]:
    """Return the frames of a slot's folder raw/<slot>/.

    They are the frames that its capture.json lists, whether their files exist or not. If that file
    is missing or lists no frames, they are all frames in the folder, described by their EXIF.
    Raises InputError for an invalid capture.json and for a frame that is a link to another folder;
    without a list also for a folder without frames or a frame whose EXIF has no exposure.
    """
    capture = CaptureFile.find(folder / "capture.json")
    frames = () if capture is None else capture.frames
    shots = [Shot(folder / f.file, f.exposure, f.heading_deg, f.t_utc, f.sha256) for f in frames]
    files = [shot.path for shot in shots] or frame_files(folder)
    for path in files:
        safe_paths.refuse_link(folder, path)
    return shots or shots_of_files(files)


def verified(shots: Sequence[Shot]) -> list[Shot]:
    """Return the frames with the SHA-256 that their files have now.

    Each file is read completely for it; the merge that follows then finds it in the system's cache.
    Raises InputError, which names all such frames, if a content is not the recorded one, and for a
    frame that may not be read; OSError for one that is missing.
    """
    current = []
    for shot in shots:
        remedy = "permit that you read it, or copy it from the card again"
        with input_errors(shot.path, "a readable frame", remedy, PermissionError):
            current.append(replace(shot, sha256=sha256(shot.path)))
    pairs = zip(shots, current, strict=True)
    changed = [now.path for before, now in pairs if before.sha256 not in ("", now.sha256)]
    if changed:
        finding = f"{', '.join(path.name for path in changed)} changed after capture or import"
        remedy = "copy them from the card again, or remove them from capture.json"
        raise InputError(changed[0], finding, "the sha256 in capture.json", remedy)
    return current


def shots_of_files(files: Sequence[Path], lens_f_number: float = 0.0) -> list[Shot]:
    """Return frames described by their EXIF.

    Their headings and times are None. lens_f_number: f-number for files whose EXIF has none; with 0
    that is an error. Raises InputError for an empty list, for a file that is missing, listed twice
    or a copy of another one, and for a file without exposure time, f-number or ISO.
    """
    if not files:
        raise InputError("merge", "no frames", "raw or JPEG files of one bracket", "name them")
    shots: list[Shot] = []
    for path in files:
        exposure = read_exif(path, lens_f_number=lens_f_number).exposure
        same = [shot.path for shot in shots if filecmp.cmp(path, shot.path, shallow=False)]
        if same:
            finding = f"the same content as {same[0].name}: this frame would count twice"
            raise InputError(path, finding, "each frame once", "leave the copy out")
        shots.append(Shot(path, exposure))
    return shots


def sorted_shots(shots: Sequence[Shot], profile: CameraProfile) -> list[Shot]:
    """Return the frames sorted by heading, then by exposure, longest first, then by name.

    Raises InputError for a filter that is not in the profile, for a JPEG frame with the profile of
    a raw camera or the reverse, for an aperture for which the profile's k is not calibrated, and if
    the frames have different apertures.
    """
    _check_settings(shots, profile)

    def order(shot: Shot) -> tuple[float, float, str]:
        """Return the sort key of a frame: heading, negative exposure behind its filter, name."""
        exposure = shot.exposure
        factor = float(np.mean(nd_factors(exposure.nd, profile)))
        collected = z_per_cdm2(exposure.shutter_s, exposure.f_number, exposure.iso) / factor
        return shot.heading_deg or 0.0, -collected, shot.path.name

    return sorted(shots, key=order)


def _check_settings(shots: Sequence[Shot], profile: CameraProfile) -> None:
    """Raise InputError for a frame whose file format or aperture cannot be in the bracket."""
    kind, apertures = profile.camera.kind, profile.scale.f_numbers
    first = shots[0].exposure.f_number
    for shot in shots:
        f_number = shot.exposure.f_number
        if is_jpeg(shot.path) != (kind == "jpeg"):
            finding = "a raw frame" if kind == "jpeg" else "a JPEG frame"
            expected = f"{kind} frames, as of {profile.camera.name}"
            raise InputError(shot.path, finding, expected, "name the profile of its camera")
        if apertures and min(abs(f_number / n - 1) for n in apertures) > SAME_LABEL:
            valid = ", ".join(f"f/{n:g}" for n in apertures)
            expected = f"{valid}, because the profile's k is not calibrated for other apertures"
            remedy = "calibrate this aperture (fieldlum calibrate scale)"
            raise InputError(shot.path, f"a frame with f/{f_number:g}", expected, remedy)
        if abs(f_number / first - 1) > SAME_LABEL:
            finding = f"a frame with f/{f_number:g} in a bracket with f/{first:g}"
            remedy = "merge each by itself"
            raise InputError(shot.path, finding, "one aperture in a bracket", remedy)


def times_by_law(shots: Sequence[Shot], profile: CameraProfile) -> dict[str, Floats]:
    """Return the true shutter times [frames] in s under each shutter law, by the law's name.

    A time that the profile's table of measured shutter times contains is the same under all laws.
    """
    profiles = {law: replace(profile, shutter_law=law) for law in LAWS}
    return {
        law: np.array([true_shutter_s(shot.exposure.shutter_s, p)[0] for shot in shots])
        for law, p in profiles.items()
    }


def exposure_covariance(exposures: Sequence[Exposure], profile: CameraProfile) -> Floats:
    """Return the covariance of the natural log exposures before any fit, [frames, frames].

    The uncertainties are those of the profile, `U_ISO` and `U_REPEAT`. Frames with the same shutter
    time have the same error of time. Frames with the same filter share an error too, and so do
    frames of one ISO other than the profile's. Each frame also has its own error.
    """
    u_time = [true_shutter_s(e.shutter_s, profile)[1] for e in exposures]
    u_of_nd = {nd.name: nd.u_rel for nd in profile.nd}
    u_nd = [u_of_nd.get(e.nd, 0.0) for e in exposures]
    u_iso = [0.0 if abs(e.iso / profile.bracket.iso - 1) < 0.01 else U_ISO for e in exposures]
    settings = (
        ([e.shutter_s for e in exposures], u_time),
        ([e.nd for e in exposures], u_nd),
        ([e.iso for e in exposures], u_iso),
    )
    shared = [np.equal.outer(setting, setting) * np.outer(u, u) for setting, u in settings]
    return np.sum(shared, axis=0) + np.eye(len(exposures)) * U_REPEAT**2
