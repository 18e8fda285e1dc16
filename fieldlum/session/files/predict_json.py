"""annual/NAME/predict.json: how a year was predicted, and its glare classes."""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct, field

from fieldlum.session.codec import JsonFile


class DirectionYear(Struct, frozen=True):
    """Glare of one view direction over the occupied hours.

    azimuth_deg: clockwise from north. glare_class: of EN 17037, high to none, or not seen; called
    `class` in predict.json. certain: whether the 95 % interval is within one class. seen: "seen",
    "partly seen" or "not seen", by the lenses. dgp_exceeded: DGP that is exceeded in the share
    `share` of the hours, with its 95 % interval low to high; None: unknown. hours_over: number of
    hours above each limit of DGP ("0.35", "0.40", "0.45"); None: unknown. sentence: the class in
    words.
    """

    azimuth_deg: float
    glare_class: str = field(name="class")
    certain: bool = False
    seen: str = "seen"  # 0.1.0 had no such key, because every direction was fully seen
    dgp_exceeded: float | None = None
    low: float | None = None
    high: float | None = None
    share: float = 0.05
    hours_over: Mapping[str, int | None] = {}
    sentence: str = ""


class YearOccupancy(Struct, frozen=True):
    """The occupied hours of a year.

    text: which hours these are, in words; hours: their number; lit: number of those with daylight;
    untrusted_share: share (0 to 1) of the lit hours in which the model does not trust its maps;
    wide_share: share of the lit hours with a wide interval of DGP, None if the model states no
    uncertainty, and in files of earlier versions.
    """

    text: str = ""
    hours: int = 0
    lit: int = 0
    untrusted_share: float = 0.0
    wide_share: float | None = None


class YearWeather(Struct, frozen=True):
    """The weather of a year.

    name: of its file, or of the seed; synthetic: whether it was computed without a file; repairs: a
    text on each repair of the file.
    """

    name: str = ""
    synthetic: bool = False
    repairs: tuple[str, ...] = ()


class PredictFile(JsonFile, frozen=True):
    """The content of one predict.json.

    software: versions by name; inputs: what the result depends on, to detect a change; model: name
    of its kind, such as transport; setup: SITE.toml as a table; height, width: of the maps [px];
    heading_deg: azimuth of their centre column; azimuths_deg: of the d view directions; azimuths
    are clockwise from true north; hours: number of rows of hourly.csv, one for each daylight hour;
    days: number of days of the weather; known: numbers of the hours from 06:00 to 19:00 and of the
    days whose hours from 09:00 to 13:00 have weather or are dark, in local standard time, zeros in
    files of earlier versions; first, last: UTC times of the first and the last row;
    disc_from: how the visibility of the sun's disc is known; seen_share [d]: share (0 to 1) of a
    uniform field's vertical illuminance that comes from where the lenses saw, empty if they saw
    everything; u_scale_rel: relative standard uncertainty of the captures' scale; model_warnings,
    notes: sentences; protection: glare by direction, [d].
    """

    NAME, SEALED = "predict.json", True
    EXPECTED, REMEDY = "a predicted year", "predict one with: fieldlum predict"

    software: Mapping[str, str] = {}
    inputs: Mapping[str, Any] = {}
    model: str = ""
    setup: Mapping[str, Any] = {}
    height: int = 0
    width: int = 0
    heading_deg: float = 0.0
    azimuths_deg: tuple[float, ...] = ()
    weather: YearWeather = YearWeather()
    hours: int = 0
    days: int = 0
    known: tuple[int, int] = (0, 0)
    first: str = ""
    last: str = ""
    occupancy: YearOccupancy = YearOccupancy()
    disc_from: str = ""
    seen_share: tuple[float, ...] = ()
    u_scale_rel: float = 0.0
    model_warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    protection: tuple[DirectionYear, ...] = ()
