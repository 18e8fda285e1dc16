"""Write and read the files of a predicted year.

annual/<name>/hourly.csv      one row per daylight hour: t_utc, t_local, light, trust, and
                              `metric@azimuth` for each direction
              predict.json     settings, versions, repairs, and the glare protection of each
                               direction
              pictures.npz     the maps of some typical hours
              maps.zarr        all maps, with --maps (Zarr v3; dims time, y, x)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.records import JsonTable
from fieldlum.session import codec, replacing
from fieldlum.session.files.hourly_csv import HourlyFile
from fieldlum.session.files.predict_json import PredictFile

if TYPE_CHECKING:
    import xarray as xr

# Units by the end of a name, as CF writes them; other figures have no unit.
_UNITS = {"_wm2": "W m-2", "_lx": "lx", "_cdm2": "cd m-2", "_deg": "degree"}


def unit_of(name: str) -> str:
    """Return the unit of a column of hourly.csv or pairs.csv as CF writes it; "1" without a unit.

    name: of the column, of which the end decides, such as ``_wm2``; without ``@azimuth``.
    """
    name = name.removesuffix("_estimate")
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), "1")


def time_coordinate(t_utc: Sequence[datetime]) -> tuple[str, Any, dict[str, str]]:
    """Return the xarray coordinate `time` of n hours: dimension, values [n], and attributes.

    t_utc: aware times [n]. Values are datetime64 in UTC, which has no time zone. The only attribute
    is long_name.
    """
    times = np.array([t.astimezone(UTC).replace(tzinfo=None) for t in t_utc], "datetime64[ns]")
    return "time", times, {"long_name": "UTC"}


def dataset_of(
    t_utc: Sequence[datetime],
    azimuths_deg: Floats,
    hours: Mapping[str, Any],
    views: Mapping[str, Any],
) -> xr.Dataset:
    """Return the figures of n hours in d view directions as a dataset of xarray.

    t_utc: aware times [n]; azimuths_deg: the directions [d], clockwise from true north; hours:
    figures without a direction by name, [n] each; views: those of each direction by name, [n, d]
    each. The coordinates are time, and azimuth in ascending order; each figure has its unit as the
    attribute `units`, by the end of its name (`unit_of`).
    """
    import xarray as xr

    about = {"units": "degree", "long_name": "view direction, clockwise from true north"}
    azimuth = ("azimuth", np.asarray(azimuths_deg, float), about)
    figures = {
        name: (dimensions, values, {"units": unit_of(name)})
        for dimensions, table in (("time", hours), (("time", "azimuth"), views))
        for name, values in table.items()
    }
    coordinates = {"time": time_coordinate(t_utc), "azimuth": azimuth}
    return xr.Dataset(figures, coordinates).sortby("azimuth")  # which xarray's plots need


@dataclass(frozen=True, slots=True)
class Annual(HourlyFile):
    """A predicted year: its n daylight hours in d view directions, with the summary of them.

    Times, directions and figures are fields of `HourlyFile`. folder: that of the year's files;
    summary: the content of predict.json.
    """

    folder: Path
    summary: PredictFile

    def __len__(self) -> int:
        return len(self.t_utc)

    def to_xarray(self) -> xr.Dataset:
        """Return `hours` [time] and `views` [time, azimuth] as one dataset with units.

        Each key is a variable. Units are attributes, as CF writes them; coordinates: UTC, and
        degrees clockwise from north in ascending order.
        """
        return dataset_of(self.t_utc, self.azimuths_deg, self.hours, self.views)

    @property
    def about(self) -> JsonTable:
        """The content of predict.json as plain values, without the key `format`."""
        return self.summary.table()

    @property
    def occupied(self) -> Mask:
        """Mask [n], True for hours in which the room is used."""
        return self.hours["occupied"] > 0

    @property
    def judged(self) -> Mask:
        """Mask [d], True for directions with a DGP: those of which lenses saw at least half."""
        return np.asarray(np.isfinite(self.views["dgp"]).any(axis=0))


class Pictures(NamedTuple):
    """Maps of k hours for the report.

    kinds: why each hour was chosen [k]: "typical", "p95" or "highest", then "of worst view" or "of
    best view" and its azimuth, such as "p95 of best view 180"; rows: index of each hour in
    hourly.csv, from 0 [k]; luminance_cdm2: the maps without the sun's disc [k, H, W]; disc_lx:
    illuminance of the visible disc on a plane normal to the sun [k]; heading_deg: azimuth of the
    maps' centre column, clockwise from true north.
    """

    kinds: tuple[str, ...]
    rows: NDArray[np.int64]
    luminance_cdm2: Floats32
    disc_lx: Floats
    heading_deg: float


def write_pictures(path: Path, pictures: Pictures) -> None:
    """Write `pictures` to the npz file `path`, with luminances rounded to 0.01 %.

    The arrays have the names of the fields of `Pictures`. An earlier file is replaced. Raises
    OSError if the file cannot be written.
    """
    maps = rounded(pictures.luminance_cdm2)
    with replacing(path) as file:
        np.savez_compressed(file, **pictures._replace(luminance_cdm2=maps)._asdict())


def rounded(values: Floats32) -> Floats32:
    """Return float32 values [...] rounded to 12 bits of mantissa (0.01 %), which compress better.

    The bits that are lost are noise.
    """
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 10)) & np.uint32(0xFFFFF800)).view(np.float32)


# ----------------------------------------------------------------------------------------------
# reading


def read_annual(folder: Path) -> Annual:
    """Read predict.json and hourly.csv of the predicted year in `folder`.

    Warns of a file that was changed after it was written. Raises InputError if one of them is
    missing, damaged, or of a newer format.
    """
    summary = PredictFile.read(folder)
    year = HourlyFile.read(folder, np.array(summary.azimuths_deg), summary.hours)
    return Annual(year.t_utc, year.azimuths_deg, year.hours, year.views, folder, summary)


def read_pictures(folder: Path) -> Pictures:
    """Read pictures.npz in `folder`. Raises InputError if the file is missing or damaged."""
    path = folder / "pictures.npz"
    expected, remedy = "pictures of a predicted year", "run fieldlum predict again"
    with codec.open_arrays(path, expected, remedy) as stored:
        table: dict[str, Any] = {name: stored[name] for name in Pictures._fields}
    kinds, heading_deg = tuple(table["kinds"].tolist()), float(table["heading_deg"])
    return Pictures(**table)._replace(kinds=kinds, heading_deg=heading_deg)
