"""annual/NAME/predict.json: how a year was predicted, and its glare classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable
from fieldlum.session.files.json_file import (
    content_of,
    from_json,
    read_object,
    to_json,
    write_sealed,
)

FORMAT = 1  # of the file; docs/file-formats.md
NAME = "predict.json"


@dataclass(frozen=True, slots=True)
class DirectionYear:
    """Glare of one view direction over the occupied hours.

    azimuth_deg: clockwise from north. glare_class: called `class` in predict.json. certain: whether
    it is decided. seen: "seen", "partly seen" or "not seen", by the lenses. dgp_exceeded: DGP that
    is exceeded in the share `share` of the hours, with its 95 % interval low to high; None:
    unknown. hours_over: number of hours above each limit of DGP ("0.35", "0.40", "0.45"); None:
    unknown. sentence: the class in words.
    """

    azimuth_deg: float
    glare_class: str
    certain: bool = False
    seen: str = "seen"  # 0.1.0 had no such key, because every direction was fully seen
    dgp_exceeded: float | None = None
    low: float | None = None
    high: float | None = None
    share: float = 0.05
    hours_over: Mapping[str, int | None] = field(default_factory=dict)
    sentence: str = ""

    def table(self) -> JsonTable:
        """Return the direction as predict.json stores it in its list `protection`."""
        return {("class" if k == "glare_class" else k): v for k, v in to_json(self).items()}

    @classmethod
    def from_table(cls, row: Mapping[str, Any]) -> DirectionYear:
        """Build from what `table` returns.

        Raises KeyError, TypeError or ValueError for other content.
        """
        return from_json(cls, {**row, "glare_class": row["class"]})


@dataclass(frozen=True, slots=True)
class SkyToCapture:
    """An hour of the year whose capture would help to settle an undecided glare class.

    date, hour: local, such as 05 March and 14:00; worth: expected use of such a sky, relative to
    the other hours listed.
    """

    date: str
    hour: str
    dni_wm2: float
    dhi_wm2: float
    worth: float = 0.0


@dataclass(frozen=True, slots=True)
class YearOccupancy:
    """The occupied hours of a year.

    text: their rule; hours: their number; lit: number of those with daylight; untrusted_share:
    share (0 to 1) of the lit hours in which the model does not trust its maps.
    """

    text: str = ""
    hours: int = 0
    lit: int = 0
    untrusted_share: float = 0.0


@dataclass(frozen=True, slots=True)
class YearWeather:
    """The weather of a year; repairs: a text for each repair of its file."""

    name: str = ""
    synthetic: bool = False
    repairs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PredictFile:
    """The content of one predict.json.

    inputs: what the result depends on; setup: SITE.toml; height, width: of the maps [px];
    heading_deg: of their centre column; hours: number of rows of hourly.csv; first, last: their UTC
    times; disc_from: how the visibility of the sun's disc is known; seen_share: share of each view
    direction that the lenses saw, empty if all of it; protection: glare by direction; capture_next:
    hours worth a capture.
    """

    software: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, Any] = field(default_factory=dict)
    model: str = ""
    setup: Mapping[str, Any] = field(default_factory=dict)
    height: int = 0
    width: int = 0
    heading_deg: float = 0.0
    azimuths_deg: tuple[float, ...] = ()
    weather: YearWeather = field(default_factory=YearWeather)
    hours: int = 0
    days: int = 0
    first: str = ""
    last: str = ""
    occupancy: YearOccupancy = field(default_factory=YearOccupancy)
    disc_from: str = ""
    seen_share: tuple[float, ...] = ()
    model_warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    protection: tuple[DirectionYear, ...] = ()
    capture_next: tuple[SkyToCapture, ...] = ()

    def table(self) -> JsonTable:
        """Return the JSON object, without its key `format`."""
        return to_json(self)

    @classmethod
    def read(cls, folder: Path) -> PredictFile:
        """Read predict.json.

        Raises InputError if it is missing from `folder` or has other content.
        """
        path = folder / NAME
        if not path.is_file():
            raise InputError(
                folder,
                f"no {NAME} in this folder",
                "a predicted year",
                "predict one with: fieldlum predict",
            )
        expected, remedy = "what fieldlum predict wrote", "predict again"
        table = read_object(path, expected, remedy)
        with content_of(table, FORMAT, path, expected, remedy):
            needed = {name: table[name] for name in ("azimuths_deg", "hours")}
            return from_json(cls, {**table, **needed})

    def write(self, folder: Path) -> None:
        """Write predict.json into a folder."""
        write_sealed(folder / NAME, {"format": FORMAT, **self.table()})
