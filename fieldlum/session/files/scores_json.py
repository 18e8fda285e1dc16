"""models/NAME/scores.json: what `train --json` prints."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from fieldlum.session.files.json_file import (
    check_format,
    content_of,
    from_json,
    read_object,
    write_object,
)

FORMAT = 1
_REMEDY = "train the model again"


@dataclass(frozen=True, slots=True)
class ScoresFile:
    """One scores.json. models: one row per model, columns as in `train --json` (docs/cli.md)."""

    models: tuple[dict[str, Any], ...]
    chosen: str
    reason: str = ""
    parameters: int = 0
    final_fit_s: float = 0.0
    captures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    more: dict[str, Any] = field(default_factory=dict)  # keys that other versions add

    @property
    def judged_row(self) -> dict[str, Any] | None:
        """The chosen model's row; None if it has none, or there was no time to judge it."""
        rows = (row for row in self.models if row.get("name") == self.chosen)
        row = next(rows, None)
        return row if row is not None and row.get("median") is not None else None

    @classmethod
    def read(cls, folder: Path) -> ScoresFile:
        """Read the file. Raises InputError for a missing file or other content."""
        path = folder / "scores.json"
        table = read_object(path, "the scores of a trained model", _REMEDY)
        check_format(table, FORMAT, path)
        return cls.from_table(table, path)

    @classmethod
    def from_table(cls, table: dict[str, Any], path: Path) -> ScoresFile:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        known = {field.name for field in fields(cls)} | {"format"}
        more = {key: value for key, value in table.items() if key not in known}
        with content_of(path, "what fieldlum train wrote", _REMEDY):
            return from_json(cls, {**table, "more": more})

    @classmethod
    def find(cls, folder: Path) -> ScoresFile | None:
        """Read the file, or return None if there is none."""
        return cls.read(folder) if (folder / "scores.json").is_file() else None

    def table(self) -> dict[str, Any]:
        """Return the object that `train --json` prints."""
        return {
            "models": [dict(row) for row in self.models],
            "chosen": self.chosen,
            "reason": self.reason,
            "parameters": self.parameters,
            "final_fit_s": self.final_fit_s,
            "captures": self.captures,
            "notes": list(self.notes),
            **self.more,
        }

    def write(self, folder: Path) -> None:
        """Write scores.json."""
        write_object(folder / "scores.json", {"format": FORMAT, **self.table()})
