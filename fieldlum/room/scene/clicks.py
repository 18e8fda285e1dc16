"""Define clicks on a panorama: their meaning, their file, and the direction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.strict_csv import read_table
from fieldlum.optics.projection import equirect_pixel

Kind = Literal["floor", "ceiling", "window", "bar", "transom"]
KINDS: tuple[Kind, ...] = ("floor", "ceiling", "window", "bar", "transom")
COLUMNS = ("kind", "window", "x_px", "y_px")


@dataclass(frozen=True, slots=True)
class Click:
    """A click on a panorama, on a corner, a bar or a transom of a room.

    kind: floor, ceiling or window (a corner), bar or transom. window: number from 1, 0 for corners
    of the room. x_px, y_px: from the panorama's upper left corner. line: of the csv, or the number
    of the click.
    """

    kind: Kind
    window: int
    x_px: float
    y_px: float
    line: int = 0


@dataclass(frozen=True, slots=True)
class ClickGrid:
    """Size and heading of the panorama on which the clicks are."""

    height_px: int
    width_px: int
    heading_deg: float

    def angles(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return altitude and azimuth [deg] of a pixel position."""
        azimuth = self.heading_deg + (x_px / self.width_px - 0.5) * 360.0
        return 90.0 - y_px / self.height_px * 180.0, azimuth % 360.0

    def pixels(self, points: Floats) -> Floats:
        """Return pixel positions (x, y) of directions [n, 3] in world axes, [n, 2]."""
        horizontal = np.hypot(points[:, 0], points[:, 1])
        altitude = np.degrees(np.arctan2(points[:, 2], horizontal))
        azimuth = np.degrees(np.arctan2(points[:, 0], points[:, 1]))
        row, column = equirect_pixel(
            altitude, azimuth, self.height_px, self.width_px, self.heading_deg
        )
        return np.stack([column, row], axis=1)


def read_clicks(path: Path) -> list[Click]:
    """Read a csv with exactly the columns kind, window, x_px, y_px, in this order.

    Raises InputError for a file that cannot be read, other columns, or a wrong cell (with its
    line).
    """
    expected, remedy = "a csv of clicks", "check the path of the csv"
    table = read_table(path, expected, remedy)
    if table.names != COLUMNS:
        raise InputError(
            path,
            f"columns {','.join(table.names)[:80]}",
            f"exactly the columns {','.join(COLUMNS)} in this order",
            "correct the first line and the order of the columns",
        )
    return [_click(f"{path}:{line}", line, row) for line, row in table.dicts()]


def clicks_from_rows(rows: Any) -> list[Click]:
    """Return the clicks of a page's list of at most 500 dicts (keys: kind, window, x_px, y_px).

    Raises InputError for anything else.
    """
    if not isinstance(rows, list) or len(rows) > 500:
        raise InputError(
            "clicks",
            "no list, or over 500 clicks",
            "a list of at most 500 clicks",
            "load the page again, and click fewer corners",
        )
    return [_click(f"click {k}", k, row) for k, row in enumerate(rows, start=1)]


def _click(where: str, line: int, row: Any) -> Click:
    if not isinstance(row, dict):
        raise InputError(
            where, "the click is no table", f"keys {', '.join(COLUMNS)}", "load the page again"
        )
    kind = str(row.get("kind", "")).strip()
    if kind not in KINDS:
        raise InputError(
            where, f"kind '{kind[:40]}'", f"one of {', '.join(KINDS)}", "correct the kind"
        )
    try:
        x, y = float(row["x_px"]), float(row["y_px"])
        window = int(row.get("window") or 0)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            where,
            f"x_px, y_px or window is no number ({error})"[:120],
            "numbers, for window an integer (the number of the window)",
            "correct the numbers",
        ) from None
    if not (np.isfinite(x) and np.isfinite(y)):
        raise InputError(where, f"x_px {x:g}, y_px {y:g}", "finite numbers", "correct the numbers")
    of_window = kind in ("window", "bar", "transom")
    if of_window != (1 <= window <= 50):
        expected = "a window number from 1 to 50" if of_window else "no window number"
        raise InputError(
            where,
            f"kind {kind} with window number {window}",
            expected,
            "correct the window's number",
        )
    return Click(kind, window, x, y, line)
