"""Define the table `quality` of a panorama's sidecar: how well the frames of a bracket agreed.

`fieldlum merge --json` prints the same table. Its keys are a contract: keys are only added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any

from fieldlum.core.records import Exposure, JsonTable, utc_text
from fieldlum.optics.photometry import ShutterLaw
from fieldlum.session.files.json_file import from_json, to_json
from fieldlum.session.plan_file import exposure_text, parse_exposure

# Fields whose keys in the file are older names.
_KEYS = {
    "deviations": "exposure_told",
    "noise_over_profile": "noise_over_said",
    "orientation_conflict": "held_otherwise",
}


@dataclass(frozen=True, slots=True)
class FrameQuality:
    """How one frame fits into its bracket.

    correction: fitted over assumed exposure; u_percent: its standard uncertainty. heading_deg:
    clockwise from north; None without a turning head. dropped_percent: share of its pixels that
    were excluded because something moved; None if this was not requested.
    """

    file: str
    exposure: Exposure
    correction: float
    u_percent: float
    heading_deg: float | None = None
    t_utc: datetime | None = None
    dropped_percent: float | None = None

    def table(self) -> JsonTable:
        """Return the frame as the sidecar's JSON stores it."""
        row = {
            "file": self.file,
            "heading_deg": self.heading_deg,
            "t_utc": utc_text(self.t_utc) if self.t_utc else "",
            "exposure": exposure_text(self.exposure),
            **asdict(self.exposure),
            "correction": self.correction,
            "u_percent": self.u_percent,
        }
        if self.dropped_percent is not None:
            row["dropped_percent"] = self.dropped_percent
        return row

    @classmethod
    def from_table(cls, row: Mapping[str, Any]) -> FrameQuality:
        """Build from the JSON that `table` returns; texts alone, as in version 0.1.0, are read too.

        Raises KeyError, TypeError or ValueError for other content and for a correction not above 0.
        """
        stated = parse_exposure(row["exposure"])
        exposure = {**asdict(stated), **row} if "shutter_s" in row else asdict(stated)
        quality = from_json(cls, {"file": "", "u_percent": "nan", **row, "exposure": exposure})
        if quality.correction <= 0.0:
            raise ValueError(f"correction {quality.correction}, which must be above 0")
        return quality


@dataclass(frozen=True, slots=True)
class NeighbourQuality:
    """Disagreement [%] of two neighbouring frames in exposure, after all corrections.

    long, short: the more and the less exposed frame, numbered within their heading;
    residual_percent, u_percent: their disagreement and its standard uncertainty; pixels: number of
    pixels compared.
    """

    long: int
    short: int
    residual_percent: float
    u_percent: float
    pixels: int = 0


@dataclass(frozen=True, slots=True)
class ShiftQuality:
    """Turn of the camera between two frames, which are named by their files.

    long, short: the more and the less exposed one; shift_px: in sensor pixels at the lens's axis;
    u_px: its standard uncertainty; sure_px: the shift minus three of these, at least 0.
    """

    long: str
    short: str
    turn_deg: float
    shift_px: float
    u_px: float
    sure_px: float


@dataclass(frozen=True, slots=True)
class DarkRim:
    """The dark edge of a lens's image.

    width_deg: of the dark part; share: luminance at the edge over that a few degrees further in.
    """

    lens: str
    width_deg: float
    share: float


@dataclass(frozen=True, slots=True)
class MergeReport:
    """The figures of one merged bracket; shares are percent of the solid angle seen.

    None or empty: not determined, or not written by the version of the sidecar. residual_percent:
    largest disagreement of neighbouring frames; shift_px: of the surest turn; outside_percent: of
    all directions; exposure_span_percent: range of fitted over stated exposures; deviations: a text
    for each heading whose exposures differ from the profile's; noise_over_profile: 1 if not larger;
    plateau_dn: saturation of R, G1, G2, B by ISO; black_off_dn: the files' black level minus the
    profile's; u_ratio_percent: standard uncertainty from the exposures; lost: frames that could not
    be read.
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
    deviations: tuple[str, ...] = ()
    noise_over_profile: float = 1.0
    plateau_dn: Mapping[str, tuple[float | None, ...]] = field(default_factory=dict)
    black_off_dn: float = 0.0
    shutter_law: ShutterLaw | None = None
    u_ratio_percent: float | None = None
    orientation_conflict: str = ""
    vertical_illuminance_lx: float | None = None
    lost: tuple[str, ...] = ()
    dark_rims: tuple[DarkRim, ...] = ()

    def table(self) -> JsonTable:
        """Return the key `quality` of the sidecar, without optional keys that have no value."""
        optional = ("shutter_law", "vertical_illuminance_lx", "lost", "dark_rims")
        return {
            _KEYS.get(name, name): value
            for name, value in to_json(self).items()
            if value or name not in optional
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> MergeReport:
        """Build from the key `quality` of a sidecar; unknown keys are ignored.

        Raises KeyError, TypeError or ValueError for other content.
        """
        renamed = {field: table[key] for field, key in _KEYS.items() if key in table}
        return from_json(cls, {**table, **renamed})
