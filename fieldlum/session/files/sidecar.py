"""panoramas/SLOT.json: how a panorama was merged, its quality, and its inputs."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Self

from msgspec import Meta, Struct, field

from fieldlum.core.errors import ChangedFileWarning, InputError
from fieldlum.core.files import sha256
from fieldlum.core.records import Exposure, JsonTable, require_known_year
from fieldlum.optics.exposure import ShutterLaw
from fieldlum.optics.profiles import find_camera_profile
from fieldlum.session.codec import JsonFile, Utc, convert, read_object
from fieldlum.session.folder import Session
from fieldlum.session.plan_file import exposure_text, parse_exposure

# ----------------------------------------------------------------------------------------------
# the key `quality`, which `merge --json` prints too; its keys are a contract: keys are only added


class FrameQuality(Struct, frozen=True):
    """How one frame fits into its bracket.

    file: name of the frame; text: its exposure in words; shutter_s, f_number, iso, nd: the same as
    numbers, and the filter's name. correction: fitted over assumed exposure; u_percent: standard
    uncertainty of the correction. heading_deg: clockwise from true north; None without a turning
    head. t_utc: when the frame was requested; None if unknown.
    """

    file: str
    text: str = field(name="exposure")
    shutter_s: float
    f_number: float
    iso: float
    nd: str
    correction: Annotated[float, Meta(gt=0.0)]
    u_percent: float = math.nan  # version 0.1.0 did not write it
    heading_deg: float | None = None
    t_utc: Utc | None = None

    @classmethod
    def of(cls, file: str, exposure: Exposure, correction: float, **more: Any) -> Self:
        """Return the quality of a frame, with the text and the numbers of its exposure.

        file: name of the frame; correction: fitted over assumed exposure; more: u_percent,
        heading_deg and t_utc, if they are known.
        """
        return cls(file, exposure_text(exposure), **asdict(exposure), correction=correction, **more)


class NeighbourQuality(Struct, frozen=True):
    """Disagreement [%] of two neighbouring frames in exposure, after all corrections.

    long, short: the more and the less exposed frame, numbered from 0 within their heading;
    residual_percent: their disagreement, positive if the less exposed frame is brighter than
    expected; u_percent: its standard uncertainty; pixels: number of pixels compared.
    """

    long: int
    short: int
    residual_percent: float
    u_percent: float
    pixels: int = 0


class ShiftQuality(Struct, frozen=True):
    """Turn of the camera between two frames.

    long, short: files of the more and the less exposed frame; turn_deg: angle of the turn;
    shift_px: the same in sensor pixels at the lens's axis; u_px: its standard uncertainty; sure_px:
    the shift minus three standard uncertainties, at least 0.
    """

    long: str
    short: str
    turn_deg: float
    shift_px: float
    u_px: float
    sure_px: float


class MergeReport(Struct, frozen=True):
    """The figures of one merged bracket; shares are percent of the solid angle seen.

    None or empty: not determined, or not written by the version of the sidecar. frames, neighbours,
    shifts: one for each frame, pair of neighbouring frames, and turn. residual_percent: largest
    disagreement of neighbouring frames; shift_px, shift_u_px: of the surest turn, and its standard
    uncertainty; clipped_percent, bloom_percent, motion_percent, below_noise_percent: share with
    this `Flag`; outside_percent: share of all directions that no lens sees; exposure_span_percent:
    range of fitted over stated exposures; deviations: a text for each heading whose exposures
    differ from the profile's; noise_over_profile: standard deviation of the raw noise over the
    profile's, 1 if not larger; plateau_dn: saturation of R, G1, G2, B [DN] by ISO, None where none
    was found; black_off_dn: the files' black level minus the profile's [DN]; shutter_law: see
    `ShutterLaw`; u_ratio_percent: standard uncertainty from the exposures; orientation_conflict:
    how EXIF contradicts the profile's roll; vertical_illuminance_lx: at the camera, on a plane that
    faces its heading; lost: frames that could not be read; filter_absent: frames that were taken
    without the filter of their label.
    """

    frames: tuple[FrameQuality, ...] = ()
    neighbours: tuple[NeighbourQuality, ...] = ()
    residual_percent: float | None = None
    shifts: tuple[ShiftQuality, ...] = ()
    shift_px: float | None = None
    shift_u_px: float | None = None
    clipped_percent: float | None = None
    bloom_percent: float | None = None
    motion_percent: float | None = None
    below_noise_percent: float | None = None
    outside_percent: float | None = None
    exposure_span_percent: float | None = None
    deviations: tuple[str, ...] = field(default=(), name="exposure_told")
    noise_over_profile: float = field(default=1.0, name="noise_over_said")
    plateau_dn: Mapping[str, tuple[float | None, ...]] = {}
    black_off_dn: float = 0.0
    shutter_law: ShutterLaw | None = None
    u_ratio_percent: float | None = None
    orientation_conflict: str = field(default="", name="held_otherwise")
    vertical_illuminance_lx: float | None = None
    lost: tuple[str, ...] = ()
    filter_absent: tuple[str, ...] = ()

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Return the report in the key `quality` of a sidecar; unknown keys are ignored.

        Raises KeyError, TypeError or ValueError for other content.
        """
        # Version 0.1.0 wrote the exposures of frames as text alone.
        frames = [
            {**asdict(parse_exposure(row["exposure"])), "file": "", **row}
            for row in table.get("frames", ())
        ]
        stated = {key: value for key, value in table.items() if value is not None}
        return convert({**stated, "frames": frames}, cls)


# ----------------------------------------------------------------------------------------------
# the whole file


class MeasuredSun(Struct, frozen=True):
    """The sun's centre in the pictures, by the profile's lens and the camera's heading.

    altitude_deg, azimuth_deg: apparent, clockwise from north. sigma_deg: standard uncertainty of
    the centre along each axis, without that of lens and pose. t_utc: mean time of the frames that
    show it; None where their times are unknown.
    """

    altitude_deg: float
    azimuth_deg: float
    sigma_deg: float
    t_utc: Utc | None = None


class SidecarSun(Struct, frozen=True):
    """The sun's disc that was removed from a panorama.

    Angles are apparent ones, by the ephemeris; azimuth_deg: clockwise from true north.
    normal_illuminance_lx: at the lens, on a plane normal to the sun; u_mosaic_percent: its standard
    uncertainty because few pixels are under the disc. origin: how it was measured; lower_bound:
    every frame is clipped at the disc; measured: where the pictures show it, or None.
    """

    altitude_deg: float | None = None
    azimuth_deg: float | None = None
    normal_illuminance_lx: float | None = None
    u_mosaic_percent: float = 0.0
    origin: str = ""
    lower_bound: bool = False
    measured: MeasuredSun | None = None


class Sidecar(JsonFile, frozen=True):
    """The content of panoramas/SLOT.json, the sidecar of a merged panorama.

    t_utc: middle of the bracket; verdict: "good", or what to check; report: the key `quality`; sun:
    None without a disc; profile: its name, and the sha256 of its file; factors: k, y_from_rgb and
    u_percent (of k, colour, glare_floor) of the merge; inputs: what the result depends on; sha256:
    of the panorama, "" in a file of 0.1.0; software: versions.
    """

    SEALED = True
    EXPECTED = "the sidecar of a merged panorama"
    REMEDY = "merge the bracket again (fieldlum merge)"

    slot: str
    t_utc: Utc | None = None
    verdict: str = ""
    report: MergeReport = field(default=MergeReport(), name="quality")
    sun: SidecarSun | None = None
    factors: JsonTable = field(default_factory=dict)
    profile: Mapping[str, str] = {}
    inputs: JsonTable = field(default_factory=dict)
    sha256: str = ""
    software: Mapping[str, Any] = {}

    def __post_init__(self) -> None:
        """Raise ValueError for a time outside the years of the ephemeris."""
        measured = self.sun.measured if self.sun is not None else None
        frames = (frame.t_utc for frame in self.report.frames)
        require_known_year(self.t_utc, measured.t_utc if measured else None, *frames)

    def fits(self, panorama: Path) -> bool:
        """Return whether a panorama has the recorded SHA-256, or none is recorded.

        Raises OSError if the panorama cannot be read.
        """
        return self.sha256 in ("", sha256(panorama))

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the JSON object with the keys of the present version.

        The slot follows from the name of `path`; the key report is a `MergeReport`.
        """
        report = MergeReport.from_table(table.get("quality") or {})
        return {"slot": path.stem, **table, "quality": report}


def warn_if_picture_changed(picture: Path, stage: str = "merge") -> None:
    """Warn with ChangedFileWarning if a picture changed after its stage wrote it.

    A picture changed if its SHA-256 is not the one that the sidecar (the JSON file of the same
    name) records; a picture without a readable sidecar counts as unchanged. stage: the command that
    writes it. Raises OSError if the picture cannot be read.
    """
    with suppress(InputError):
        sidecar = read_object(picture.with_suffix(".json"), "", "")
        if sidecar.get("sha256", "") not in ("", sha256(picture)):
            text = f"{picture}: the content changed after {stage} wrote it; expected the sha256 in "
            text += f"{picture.stem}.json; write it again: fieldlum {stage}"
            warnings.warn(text, ChangedFileWarning, stacklevel=2)


def readable_sidecars(paths: Iterable[Path]) -> Iterator[Sidecar]:
    """Yield the sidecars in some files, in their order; skip files that cannot be read.

    These are damaged, or were not written by a merge.
    """
    for path in paths:
        with suppress(InputError):
            yield Sidecar.read(path)


def of_other_profile(session: Session) -> list[Sidecar]:
    """Return the sidecars of panoramas that merge would write again, with the present profile.

    These were merged with a camera profile of another content than session.toml now names. The list
    is empty if that profile is missing, or wrong in session.toml.
    """
    with suppress(InputError, OSError):
        now = sha256(find_camera_profile(session.site_file().camera.profile))
        sidecars = readable_sidecars(session.sidecar_files())
        return [sidecar for sidecar in sidecars if sidecar.profile.get("sha256", now) != now]
    return []


def newest_sidecar(session: Session) -> Sidecar | None:
    """Return the sidecar of the latest panorama with a readable sidecar; None if there is none."""
    return next(readable_sidecars(reversed(session.sidecar_files())), None)
