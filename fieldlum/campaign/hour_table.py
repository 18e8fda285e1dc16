"""Write all hourly figures of a campaign as one table: a row for each room, hour and direction."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.arrays import Array
from fieldlum.campaign.campaign_file import CampaignFile
from fieldlum.errors import FieldlumError, InputError, install_text
from fieldlum.predict import Annual, read_annual
from fieldlum.records import utc_text
from fieldlum.session import open_session, replacing, replacing_path


def years(campaign: CampaignFile) -> Iterator[tuple[str, Annual]]:
    """Yield (session, predicted year) of each room that has a predicted year of its model.

    session: as CAMPAIGN.toml names it. Rooms that cannot be read are skipped.
    """
    for room in campaign.rooms:
        try:
            session = open_session(campaign.session_folder(room))
            folder = session.annual / room.model
            if (folder / "predict.json").is_file():
                yield room.session, read_annual(folder)
        except (FieldlumError, OSError):
            continue


def _columns(name: str, annual: Annual) -> Mapping[str, Sequence[str] | Array]:
    """Return columns of length hours x directions; the directions of one hour are consecutive."""
    hours, directions = len(annual), len(annual.azimuths_deg)
    columns: dict[str, Sequence[str] | Array] = {
        "room": [name] * (hours * directions),
        "t_utc": [utc_text(t) for t in annual.t_utc for _ in range(directions)],
        "azimuth_deg": np.tile(annual.azimuths_deg, hours),
    }
    columns |= {key: np.repeat(values, directions) for key, values in annual.hours.items()}
    return columns | {key: values.ravel() for key, values in annual.views.items()}


def write_csv(campaign: CampaignFile, path: Path) -> int:
    """Write a csv row for each room, hour and view direction; return the number of rows.

    Only one room is in memory at a time. Without a predicted year the file has no bytes, not even a
    header.
    """
    count = 0
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        for name, annual in years(campaign):
            columns = _columns(name, annual)
            if not count:
                writer.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                writer.writerow([_cell(value) for value in row])
                count += 1
    return count


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.7g}" if np.isfinite(value) else ""


def write_parquet(campaign: CampaignFile, path: Path) -> int:
    """Write a Parquet row for each room, hour and view direction; return the number of rows.

    Each room is a row group. Raises InputError without pyarrow, or without a predicted year.
    """
    try:
        import pyarrow as pa  # pyright: ignore[reportMissingImports]
        import pyarrow.parquet as pq  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            path,
            "pyarrow is not installed",
            remedy=f"{install_text('parquet')}, or name a .csv file",
        ) from None
    count, writer = 0, None
    with replacing_path(path) as temporary:
        for name, annual in years(campaign):
            table = pa.table(_columns(name, annual))
            writer = writer or pq.ParquetWriter(temporary, table.schema)
            writer.write_table(table)
            count += table.num_rows
        if writer is None:
            raise InputError(
                campaign.path,
                f"no room has a predicted year that can be read, so {path} was not written",
                remedy="run fieldlum campaign predict",
            )
        writer.close()
    return count
