"""annual/NAME/predict.json: how a year was predicted, and its glare classes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldlum.errors import InputError
from fieldlum.session.files.json_file import check_format, read_object, write_object

FORMAT = 1
NAME = "predict.json"


@dataclass(frozen=True, slots=True)
class PredictFile:
    """One predict.json. hours: rows of hourly.csv; table: all keys, as `predict --json` prints."""

    hours: int
    azimuths_deg: tuple[float, ...]
    inputs: dict[str, Any] = field(default_factory=dict)
    table: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def from_table(cls, table: dict[str, Any], path: Path) -> PredictFile:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        try:
            azimuths = tuple(float(azimuth) for azimuth in table["azimuths_deg"])
            return cls(int(table["hours"]), azimuths, dict(table.get("inputs") or {}), table)
        except (KeyError, TypeError, ValueError) as error:
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
        write_object(folder / NAME, {"format": FORMAT, **self.table})
