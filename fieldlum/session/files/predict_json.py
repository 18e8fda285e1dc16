"""annual/NAME/predict.json: how a year was predicted, and its glare classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from fieldlum.errors import InputError
from fieldlum.session.files.json_file import check_format, read_object, write_object

FORMAT = 1
NAME = "predict.json"


@dataclass(frozen=True, slots=True)
class DirectionYear:
    """Glare of one view direction over the occupied hours; the key `class` is `glare_class`.

    seen: how much of the view the lens saw, in the words of `predict`. dgp_exceeded: DGP that
    `share` of the hours exceed, with its 95 % interval low to high; None: unknown. hours_over:
    count of hours above each limit of DGP.
    """

    azimuth_deg: float
    glare_class: str
    certain: bool
    seen: str
    dgp_exceeded: float | None
    low: float | None
    high: float | None
    share: float
    hours_over: Mapping[str, int | None]
    sentence: str

    def table(self) -> dict[str, Any]:
        """Return the row of `protection`."""
        return {("class" if k == "glare_class" else k): v for k, v in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class SkyToCapture:
    """An hour whose sky would decide an open class, in local time; worth: relative gain."""

    date: str
    hour: str
    dni_wm2: float
    dhi_wm2: float
    worth: float


@dataclass(frozen=True, slots=True)
class YearOccupancy:
    """The occupied hours: their rule in words, count, lit ones, and the share of untrusted."""

    text: str = ""
    hours: int = 0
    lit: int = 0
    untrusted_share: float = 0.0


@dataclass(frozen=True, slots=True)
class YearWeather:
    """The weather of a year and its repairs."""

    name: str = ""
    synthetic: bool = False
    repairs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PredictFile:
    """One predict.json, as `predict --json` prints it. hours: rows of hourly.csv."""

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

    def table(self) -> dict[str, Any]:
        """Return the JSON object, without its format."""
        table = {name: getattr(self, name) for name in self.__dataclass_fields__}
        for name, value in table.items():
            if isinstance(value, tuple):
                table[name] = list(value)
        weather = asdict(self.weather)
        return {
            **table,
            "software": dict(self.software),
            "inputs": dict(self.inputs),
            "setup": dict(self.setup),
            "weather": {**weather, "repairs": list(self.weather.repairs)},
            "occupancy": asdict(self.occupancy),
            "protection": [row.table() for row in self.protection],
            "capture_next": [asdict(hour) for hour in self.capture_next],
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any], path: Path) -> PredictFile:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        try:
            weather, occupancy = table.get("weather") or {}, table.get("occupancy") or {}
            return cls(
                dict(table.get("software") or {}),
                dict(table.get("inputs") or {}),
                str(table.get("model", "")),
                dict(table.get("setup") or {}),
                int(table.get("height", 0)),
                int(table.get("width", 0)),
                float(table.get("heading_deg", 0.0)),
                tuple(float(azimuth) for azimuth in table["azimuths_deg"]),
                YearWeather(
                    str(weather.get("name", "")),
                    bool(weather.get("synthetic", False)),
                    _texts(weather.get("repairs")),
                ),
                int(table["hours"]),
                int(table.get("days", 0)),
                str(table.get("first", "")),
                str(table.get("last", "")),
                YearOccupancy(
                    str(occupancy.get("text", "")),
                    int(occupancy.get("hours", 0)),
                    int(occupancy.get("lit", 0)),
                    float(occupancy.get("untrusted_share", 0.0)),
                ),
                str(table.get("disc_from", "")),
                tuple(float(share) for share in table.get("seen_share") or ()),
                _texts(table.get("model_warnings")),
                _texts(table.get("notes")),
                tuple(_direction(row) for row in table.get("protection") or ()),
                tuple(_sky(row) for row in table.get("capture_next") or ()),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            found = f"{type(error).__name__}: {error}"
            raise InputError(path, found, "what fieldlum predict wrote", "predict again") from None

    @classmethod
    def read(cls, folder: Path) -> PredictFile:
        """Read predict.json. Raises InputError if `folder` has no complete year."""
        path = folder / NAME
        if not path.is_file():
            expected, remedy = "a predicted year", "predict one: fieldlum predict"
            raise InputError(folder, f"no {NAME} in it", expected, remedy)
        table = read_object(path, "what fieldlum predict wrote", "predict again")
        check_format(table, FORMAT, path)
        return cls.from_table(table, path)

    def write(self, folder: Path) -> None:
        """Write predict.json."""
        write_object(folder / NAME, {"format": FORMAT, **self.table()})


def _texts(values: Any) -> tuple[str, ...]:
    return tuple(str(value) for value in values or ())


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _direction(row: Mapping[str, Any]) -> DirectionYear:
    """Version 0.1.0 had no key `seen`: every direction was fully seen."""
    over = row.get("hours_over") or {}
    return DirectionYear(
        float(row["azimuth_deg"]),
        str(row["class"]),
        bool(row.get("certain", False)),
        str(row.get("seen", "seen")),
        _number(row.get("dgp_exceeded")),
        _number(row.get("low")),
        _number(row.get("high")),
        float(row.get("share", 0.05)),
        {str(limit): None if count is None else int(count) for limit, count in over.items()},
        str(row.get("sentence", "")),
    )


def _sky(row: Mapping[str, Any]) -> SkyToCapture:
    dni_wm2, dhi_wm2 = float(row["dni_wm2"]), float(row["dhi_wm2"])
    return SkyToCapture(
        str(row["date"]), str(row["hour"]), dni_wm2, dhi_wm2, float(row.get("worth", 0.0))
    )
