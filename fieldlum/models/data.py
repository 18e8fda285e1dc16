"""Training data: pairs.csv and its pictures, read strictly, with the sun's disc separated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.images import PANORAMA_LINE, read_panorama
from fieldlum.models.alignment import align, find_turns, shown_place, turn_notes
from fieldlum.models.check_pairs import Stated, check_plausible
from fieldlum.models.teaching import joined_counts, pixel_counts
from fieldlum.projection import equirect_solid_angles, signed_angle_deg
from fieldlum.records import CLIPPED_SUN, Flag, Panorama, Progress, SiteFile, quiet, slot_id
from fieldlum.room_states import USAGE, merged_state
from fieldlum.session import Session, marks, open_session
from fieldlum.session.files.alignment_csv import alignment_path
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.panorama_sun import read_panorama_with_sun, suns_of
from fieldlum.session.provenance import data_digest
from fieldlum.site_toml import load_site, site_table
from fieldlum.sun_disc import split_disc

if TYPE_CHECKING:
    from fieldlum.light import Light

_MERGE_ALIKE = "render or merge all brackets at one size and heading"
_PAIR_AGAIN = "the sun patches belong to other pictures: run fieldlum pair again"
_NAMED = 3  # slots in a note


@dataclass(frozen=True, slots=True)
class Dataset:
    """Captured hours with their light. Maps have no sun disc; its energy is in disc_lx.

    luminance_cdm2: [n, H, W]; patch_cdm2: direct sun only [n, H, W], or None; disc_lx: illuminance
    of the visible disc at the lens, normal to the sun [n]; days: local standard dates [n]; slots:
    ids [n]; seen: pixels that the camera saw [H, W]; steadiness: relative change of the light
    during the bracket (0 if unknown) [n]; notes: for the user.
    """

    light: Light
    luminance_cdm2: NDArray[np.float32]
    patch_cdm2: NDArray[np.float32] | None
    disc_lx: NDArray[np.float64]
    heading_deg: float
    days: NDArray[np.datetime64]
    slots: tuple[str, ...]
    setup: SiteFile
    seen: NDArray[np.bool_]
    steadiness: NDArray[np.float64]
    source: str = ""
    notes: tuple[str, ...] = field(default=())
    counts: NDArray[np.float16] | None = None
    scene: dict[str, Any] | None = None  # of `scene_fit.with_scene`: the stated and the used room

    def __len__(self) -> int:
        return len(self.slots)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the maps [px]."""
        return self.luminance_cdm2.shape[1], self.luminance_cdm2.shape[2]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Solid angle of the seen pixels, of mean 1 over them; 0 where nothing was seen, [H, W]."""
        weights = np.where(self.seen, equirect_solid_angles(*self.shape), 0.0)
        return weights / weights[self.seen].mean()

    def digest(self) -> str:
        """Return the SHA-256 of everything a model can learn from, without the csv's path."""
        return data_digest(replace(self, source=""))

    def take(self, index: NDArray[Any] | Sequence[int]) -> Dataset:
        """Return the rows of an index or boolean array."""
        rows = np.asarray(index)
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows.astype(int)
        return replace(
            self,
            light=self.light[rows],
            luminance_cdm2=self.luminance_cdm2[rows],
            patch_cdm2=None if self.patch_cdm2 is None else self.patch_cdm2[rows],
            disc_lx=self.disc_lx[rows],
            days=self.days[rows],
            slots=tuple(self.slots[i] for i in rows),
            steadiness=self.steadiness[rows],
            counts=None if self.counts is None else self.counts[rows],
        )

    def thin(self, height: int) -> Dataset:
        """Return the same hours at every f-th pixel, f odd, with at least `height` rows.

        Noise and sharp edges stay.
        """
        odd = [
            f
            for f in range(1, self.shape[0] + 1, 2)
            if self.shape[0] % f == 0 and self.shape[0] // f >= height
        ]
        pick = slice(
            (odd[-1] if odd else 1) // 2, None, odd[-1] if odd else 1
        )  # centres of blocks are centres of pixels
        return replace(
            self,
            luminance_cdm2=self.luminance_cdm2[:, pick, pick],
            patch_cdm2=None if self.patch_cdm2 is None else self.patch_cdm2[:, pick, pick],
            seen=self.seen[pick, pick],
            counts=None if self.counts is None else self.counts[:, pick, pick],
        )

    def about(self) -> dict[str, Any]:
        """Return what a model's config.json records about its training data."""
        return {
            "setup": site_table(self.setup),
            "heading_deg": self.heading_deg,
            "height": self.shape[0],
            "width": self.shape[1],
            **({"scene": self.scene} if self.scene else {}),
            "training": {
                "source": self.source,
                "slots": list(self.slots),
                "days": sorted({str(d) for d in self.days}),
            },
        }


# ----------------------------------------------------------------------------------------------
# pairs.csv


def _usable_rows(pairs: PairsFile) -> list[PairRow]:
    """Return rows with ok, in the order of time. Raises InputError for a missing picture."""
    for row in pairs.usable:
        for name in (row.panorama, row.sunpatch):
            picture = pairs.path.parent / name
            if name and not picture.is_file():
                found = f"line {row.line}: no file {picture}"
                raise InputError(pairs.path, found, "an existing picture", "copy it, or set ok = 0")
    return sorted(pairs.usable, key=lambda row: row.t_utc)


def _find_setup(path: Path, site: Path | None) -> SiteFile:
    """Return place and heading: of --site, else of the session, else of site.toml with the csv."""
    if site is not None:
        return load_site(site)
    if (path.parent / "session.toml").is_file():
        return open_session(path.parent).site_file()
    if path.parent.name == "truth" and (path.parent.parent / "session.toml").is_file():
        return open_session(path.parent.parent).site_file()
    if (path.parent / "site.toml").is_file():
        return load_site(path.parent / "site.toml")
    raise InputError(
        path,
        "no site for it",
        "site.toml next to it or --site SITE.toml",
        "write one with [site]",
    )


def load_pairs(
    where: Path | Session, site: Path | None = None, *, progress: Progress = quiet
) -> Dataset:
    """Read a pairs.csv (or a session's) with all its pictures, in the order of time.

    Rows with ok = 0 are not used; a cell that cannot be read raises InputError with its line. Sun
    columns are used as recorded. Raises NotEnoughDataError if no row is usable.
    """
    path = where.pairs if isinstance(where, Session) else Path(where)
    if path.is_dir():
        path = open_session(path).pairs
    if not path.is_file():
        raise InputError(
            path, "no such file", "a pairs.csv", "write one with: fieldlum pair SESSION"
        )
    setup = _find_setup(path, site)
    pairs = PairsFile.read(path)
    rows, refused, notes = _usable_rows(pairs), len(pairs.refused), list(pairs.warnings)
    if refused:
        notes.append(f"{refused} rows with ok = 0 are not used")
    dark = [row for row in rows if row.dni_wm2 + row.dhi_wm2 <= 0.0]
    if dark:
        more = f" and {len(dark) - _NAMED} more" if len(dark) > _NAMED else ""
        named = ", ".join(Path(row.panorama).stem for row in dark[:_NAMED])
        notes.append(f"not used, no irradiance: {named}{more}")
        rows = [row for row in rows if row.dni_wm2 + row.dhi_wm2 > 0.0]
    if not rows:
        raise NotEnoughDataError(f"{path}: no usable row")
    return _assemble(path, rows, setup, notes, progress)


def _assemble(
    path: Path, rows: list[PairRow], setup: SiteFile, notes: list[str], progress: Progress
) -> Dataset:
    from fieldlum.light import Light

    check_plausible(path, _stated(path, rows), setup.site)
    altitude, azimuth = _sun_columns(rows, setup)
    refraction = _refraction(path, rows)
    shown_altitude = sun.shown_altitude_deg(altitude) if refraction else altitude
    pictures = _read_pictures(path, rows, setup, progress)
    if pictures.bounds:
        notes.append(
            f"the sun of {pictures.bounds} maps clipped and is only a lower bound: "
            "run fieldlum pair, and read its cautions"
        )
    heading = pictures.heading_deg
    names = [row.panorama for row in rows]
    turns = find_turns(path, names, pictures.maps, pictures.has_value, heading, progress)
    dni = np.array([row.dni_wm2 for row in rows])
    for k in (k for k, row in enumerate(rows) if row.sun_in_map):
        at = float(shown_altitude[k]), float(azimuth[k])
        shown = shown_place(*at, heading, turns.angles_deg[k])
        pictures.take_disc_out(k, at, shown, float(dni[k]))
    align(pictures.maps, pictures.has_value, pictures.counts, heading, turns)
    counts = joined_counts(pictures.counts, pictures.has_value)
    days = [sun.standard_date(row.t_utc, setup.site.timezone) for row in rows]
    days = np.array(days, "datetime64[D]")
    notes += turn_notes(turns, days, alignment_path(path).name)
    seen, filled = _fill_gaps(pictures.maps, pictures.has_value)
    if filled:
        notes.append(f"{filled} single pixels without a value were set to their own median")
    if not seen.all():
        notes.append(f"{100 * (1 - seen.mean()):.0f} % of the pixels were not seen by the camera")
    times = [row.t_utc for row in rows]
    data = Dataset(
        light=Light(
            t_utc=tuple(times),
            dni_wm2=dni,
            dhi_wm2=np.array([row.dhi_wm2 for row in rows]),
            sun_altitude_deg=altitude,
            sun_azimuth_deg=azimuth,
            states=_states(path, rows),
            refraction=refraction,
        ),
        luminance_cdm2=pictures.maps,
        patch_cdm2=pictures.patches,
        disc_lx=pictures.disc_lx,
        heading_deg=heading,
        days=days,
        slots=tuple(slot_id(t) for t in times),
        setup=setup,
        seen=seen,
        steadiness=np.array([row.steadiness for row in rows]),
        source=str(path),
        notes=tuple(notes),
        counts=counts,
    )
    return data if turns.aligned.all() else data.take(turns.aligned)


def _stated(path: Path, rows: list[PairRow]) -> Stated:
    numbers = np.array(
        [(row.dni_wm2, row.dhi_wm2, row.sun_altitude_deg, row.sun_azimuth_deg) for row in rows]
    ).T
    return Stated(
        [row.line for row in rows],
        [row.t_utc for row in rows],
        [path.parent / row.panorama for row in rows],
        *numbers,
    )


def _states(path: Path, rows: list[PairRow]) -> tuple[str, ...] | None:
    """Return the room's state of each row, from the csv's column and the marks in the journal.

    Return None if the room is as usual in all rows. Raises InputError for an unknown word.
    """
    marked = marks(Session(path.parent))
    states = []
    for row in rows:
        try:
            state = merged_state(row.state, marked.get(Path(row.panorama).stem, ""))
        except ValueError as error:
            raise InputError(
                path, f"line {row.line}: {error}", USAGE, "correct that cell"
            ) from None
        states.append(state)
    return tuple(states) if any(states) else None


def _refraction(path: Path, rows: list[PairRow]) -> bool:
    """Return whether pictures show the sun raised by the atmosphere.

    Raises InputError for a csv that mixes such pictures with others.
    """
    other = [row.line for row in rows if row.refraction != rows[0].refraction]
    if other:
        found = f"line {other[0]}: another refraction than the rows before"
        raise InputError(path, found, "one value in all rows", "use a csv for each kind")
    return rows[0].refraction


def _sun_columns(
    rows: list[PairRow], setup: SiteFile
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return altitude and azimuth [deg] of the csv; computed by SPA where it has none."""
    altitude = np.array([row.sun_altitude_deg for row in rows])
    azimuth = np.array([row.sun_azimuth_deg for row in rows])
    blank = np.isnan(altitude) | np.isnan(azimuth)
    if blank.any():
        found = sun.position(
            [row.t_utc for row, b in zip(rows, blank, strict=True) if b], setup.site
        )
        altitude[blank], azimuth[blank] = found.altitude_deg, found.azimuth_deg
    return altitude, azimuth


@dataclass(frozen=True, slots=True)
class _Pictures:
    """Maps, patches and has_value [n, H, W], and disc_lx [n]; later steps change them in place.

    bounds: number of clipped suns.
    """

    maps: NDArray[np.float32]
    patches: NDArray[np.float32] | None
    disc_lx: NDArray[np.float64]
    has_value: NDArray[np.bool_]
    counts: list[NDArray[np.float16] | None]
    heading_deg: float
    bounds: int

    def take_disc_out(
        self, k: int, at: tuple[float, float], shown: tuple[float, float], dni_wm2: float
    ) -> None:
        """Split the disc from map and patch k.

        at: altitude and azimuth of the sun [deg]; shown: where the picture of a turned camera shows
        it [deg]. A patch has the disc alone, without the sky around it, so it measures the disc
        better.
        """
        self.maps[k], self.disc_lx[k] = split_disc(self.maps[k], self.heading_deg, shown, dni_wm2)
        if self.patches is not None:
            patch, self.disc_lx[k] = split_disc(self.patches[k], self.heading_deg, at, dni_wm2)
            self.patches[k] = patch


def _read_pictures(
    path: Path, rows: list[PairRow], setup: SiteFile, progress: Progress
) -> _Pictures:
    """Read maps and patches as stored; the disc separately where a picture stores it so."""
    pictures = [path.parent / row.panorama for row in rows]
    suns = {folder: suns_of(picture) for folder, picture in {p.parent: p for p in pictures}.items()}
    first = read_panorama(pictures[0])
    shape, heading = first.luminance_cdm2.shape, _heading(first, pictures[0], setup)
    with_patch = sum(bool(row.sunpatch) for row in rows)
    if 0 < with_patch < len(rows):
        bare = next(row.line for row in rows if not row.sunpatch)
        raise InputError(
            path,
            f"line {bare}: no sunpatch, but other rows have one",
            "all rows or none with a sunpatch",
        )
    maps = np.empty((len(rows), *shape), np.float32)
    patches = np.empty_like(maps) if with_patch else None
    disc, bounds = np.zeros(len(rows)), 0
    masks, counts = np.empty(maps.shape, bool), []
    for k, row in enumerate(rows):
        progress(k, len(rows), pictures[k].name)
        panorama = read_panorama_with_sun(pictures[k], suns[pictures[k].parent])
        panorama = _checked(panorama, pictures[k], shape, heading, setup, _MERGE_ALIKE)
        bounds += panorama.sun is not None and panorama.sun.origin == CLIPPED_SUN
        maps[k], masks[k] = panorama.luminance_cdm2, _has_value(panorama)
        counts.append(pixel_counts(panorama))
        disc[k] = panorama.sun.normal_illuminance_lx if panorama.sun else 0.0
        if patches is not None:
            source = path.parent / row.sunpatch
            patch = _checked(read_panorama(source), source, shape, heading, setup, _PAIR_AGAIN)
            patches[k] = np.maximum(np.nan_to_num(patch.luminance_cdm2), 0.0)
            if patch.sun and not panorama.sun and not row.sun_in_map:
                disc[k] = patch.sun.normal_illuminance_lx
    progress(len(rows), len(rows), "")
    return _Pictures(maps, patches, disc, masks, counts, heading, bounds)


def _heading(panorama: Panorama, path: Path, setup: SiteFile) -> float:
    """Return the heading of the picture (.exr, or a .hdr with a heading line), else the site's."""
    return (
        panorama.heading_deg
        if path.suffix.lower() == ".exr" or _says_heading(path)
        else setup.camera.heading_deg
    )


def _says_heading(path: Path) -> bool:
    with path.open("rb") as file:
        return PANORAMA_LINE.encode() in file.read(4096).partition(b"\n\n")[0]


def _checked(
    panorama: Panorama,
    path: Path,
    shape: tuple[int, ...],
    heading: float,
    setup: SiteFile,
    remedy: str,
) -> Panorama:
    found = panorama.luminance_cdm2.shape
    if found != shape:
        said = f"{found[1]} x {found[0]} pixels", f"{shape[1]} x {shape[0]} as in the first row"
        raise InputError(path, *said, remedy)
    if abs(signed_angle_deg(_heading(panorama, path, setup) - heading)) > 0.01:
        found = f"heading {_heading(panorama, path, setup):g}"
        raise InputError(path, found, f"{heading:g} as in the first row", remedy)
    return panorama


def _has_value(panorama: Panorama) -> NDArray[np.bool_]:
    good = np.isfinite(panorama.luminance_cdm2)
    return good if panorama.flags is None else good & ((panorama.flags & Flag.OUTSIDE_LENS) == 0)


def _fill_gaps(
    maps: NDArray[np.float32], has_value: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Fill single missing values in place with the pixel's median; return seen pixels and a count.

    A pixel that is missing in a fifth of the maps counts as not seen.
    """
    seen = has_value.mean(axis=0) > 0.8
    if not seen.any():
        raise NotEnoughDataError("no pixel has a value in most of the panoramas")
    gaps = ~has_value & seen
    for i, j in np.argwhere(gaps.any(axis=0)):
        maps[gaps[:, i, j], i, j] = np.median(maps[has_value[:, i, j], i, j])
    maps[:, ~seen] = 0.0
    np.maximum(maps, 0.0, out=maps)
    return seen, int(gaps.sum())
