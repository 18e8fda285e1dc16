"""The sun of each panorama: suns.csv, which `pair` completes, and reading a picture with its sun.

Panoramas are not rewritten.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from fieldlum.core.records import CLIPPED_SUN, Panorama, SunSource
from fieldlum.core.strict_csv import read_table
from fieldlum.optics.images import read_panorama
from fieldlum.session.codec import check_format, read_row, sealed, warn_if_changed, write_csv
from fieldlum.session.files.sidecar import warn_if_picture_changed

FORMAT = 1  # of suns.csv; docs/file-formats.md

# origins with which the picture itself measured the disc
MEASURED_ORIGINS = ("nd-frames", "merge", "rendering")
SUN_FROM = {
    "nd-frames": "measured through a filter",
    "merge": "measured",
    "rendering": "as rendered",
    "picture": "found in the pixels",
    "meter": "computed from the illuminance meter",
    "sky-view": "computed from DNI and the sky view, because no exposure reached it",
    "dni": "computed from DNI, because no exposure reached it",
    CLIPPED_SUN: "only a lower bound, because no exposure reached it",
}
"""How the illuminance of a picture's sun is known, in words, by its origin."""
_SAME_BOUND_REL = 1e-4  # the EXR attribute has six digits


@dataclass(frozen=True, slots=True)
class SunRow:
    """The sun of one panorama.

    panorama: path relative to the csv. altitude_deg: apparent; azimuth_deg: clockwise from true
    north; normal_illuminance_lx: of the visible part of the disc, on a plane normal to the sun;
    visible_fraction: of its area, 0 to 1; origin: source of the illuminance, such as meter.
    bound_lx: illuminance that the panorama's own file records; if the file records another one now,
    by over 0.01 %, the row is not used. format: version of the file.
    """

    panorama: str
    altitude_deg: float
    azimuth_deg: float
    normal_illuminance_lx: float
    visible_fraction: float
    origin: str
    bound_lx: float
    format: int = FORMAT

    @property
    def source(self) -> SunSource:
        """The sun as a `SunSource`."""
        return SunSource(**{f.name: getattr(self, f.name) for f in fields(SunSource)})


def write_suns(path: Path, rows: Sequence[SunRow]) -> None:
    """Write a suns.csv, a header and all rows, with its SHA-256 in NAME.sha256."""
    with sealed(path):
        write_csv(path, (asdict(row) for row in rows), [field.name for field in fields(SunRow)])


def read_suns(path: Path) -> dict[str, SunRow]:
    """Return the rows by panorama, such as "panoramas/20270320T193000Z.exr"; empty without a file.

    Warn if the file changed after it was written. Raises InputError, with the line, for other
    content.
    """
    if not path.is_file():
        return {}
    remedy = "run fieldlum pair again"
    table = read_table(path, "a suns.csv written by pair", remedy)
    warn_if_changed(path)
    rows = [read_row(SunRow, f"{path}: line {n}", cells, remedy) for n, cells in table.dicts()]
    check_format(path, max((row.format for row in rows), default=FORMAT), FORMAT)
    return {row.panorama: row for row in rows}


def read_panorama_with_sun(
    path: Path, suns: dict[str, SunRow] | None = None, part: str = ""
) -> Panorama:
    """Return the panorama in a file, with the sun that `pair` computed for it.

    suns: result of `suns_of`, for a caller that reads many pictures of one session; None: read
    suns.csv from the folder above the picture's. part: name of the part, layer or stereo view of an
    .exr; "" for the only one. The computed sun replaces only one whose illuminance the picture did
    not measure. If the sun remains a lower bound, because every frame is clipped there,
    `attributes["note"]` reports it. Raises InputError for a picture or table that cannot be used.
    """
    warn_if_picture_changed(path)
    panorama = read_panorama(path, part)
    sun = panorama.sun
    if sun is None or sun.origin in MEASURED_ORIGINS:
        return panorama
    remedy = "run fieldlum pair, which computes the sun from DNI or a meter"
    place = path.absolute()  # not resolved, because panoramas/ can be a link to another disk
    rows = suns_of(path) if suns is None else suns
    if row := rows.get(f"{place.parent.name}/{place.name}"):
        limit_lx = _SAME_BOUND_REL * max(sun.normal_illuminance_lx, 1.0)
        if abs(row.bound_lx - sun.normal_illuminance_lx) <= limit_lx:
            sun = row.source
            remedy = "fieldlum pair found no stronger sun: see the column why of pairs.csv"
    if sun.origin != CLIPPED_SUN:
        return replace(panorama, sun=sun)
    lx = sun.normal_illuminance_lx
    note = f"every frame is clipped at the sun, so the sun's {lx:.0f} lx, Ev and DGP are lower "
    note += f"bounds; {remedy}"
    return replace(panorama, sun=sun, attributes={**panorama.attributes, "note": note})


def suns_of(panorama: Path) -> dict[str, SunRow]:
    """Return the rows of the suns.csv of a panorama's session, by panorama.

    panorama: a file; suns.csv is in the folder above its folder. Keys are paths such as
    "panoramas/20270320T193000Z.exr"; it is empty without a file. Raises InputError for other
    content.
    """
    return read_suns(panorama.absolute().parent.parent / "suns.csv")
