"""Read training data: pairs.csv and its pictures, with the sun's disc separated."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldlum.core import room_states
from fieldlum.core.arrays import Array, Dates, Floats, Floats16, Floats32, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.progress import progress
from fieldlum.core.records import CLIPPED_SUN, Flag, Panorama, Site, SiteFile, counted, slot_id
from fieldlum.learn.models.camera_turns import align, camera_turns, shown_place, turn_notes
from fieldlum.learn.models.held_out_choice import weight_of_variance
from fieldlum.optics.images import read_panorama, stated_heading_deg
from fieldlum.optics.projection import equirect_solid_angles, signed_angle_deg
from fieldlum.pair.camera_sky_view import is_outdated
from fieldlum.room.scene.sun_patches import sun_patches
from fieldlum.session import Session, codec, marks, open_session, site_toml
from fieldlum.session.files.model_files import UsedScene
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import warn_if_picture_changed
from fieldlum.session.panorama_sun import read_panorama_with_sun, suns_of
from fieldlum.sky import picture_axes, sun, sun_disc
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.estimate_from_captures import Captured, sky_view_of
from fieldlum.sky.sky_view.measured_discs import NO_DISCS, MeasuredDiscs
from fieldlum.sky.sky_view.picture import SkyPicture, cut_panorama
from fieldlum.sky.sky_view.sky_directions import BEAM_LX
from fieldlum.sky.sky_view.view import SKY_VIEW, SkyView

_SLOT_ID = re.compile(r"\d{8}T\d{6}Z")


@dataclass(frozen=True, slots=True)
class Dataset:
    """Captured hours with their light. The maps have no sun disc: disc_lx has its illuminance.

    light: light outside in the n hours; luminance_cdm2: [n, H, W]; patch_cdm2: luminance by direct
    sun on surfaces (sun patches) [n, H, W], None without them; disc_lx: illuminance of the visible
    disc at the lens, on a plane normal to the sun [n]; heading_deg: azimuth of the maps' centre
    column, clockwise from north; days: local dates without daylight saving time [n]; slots: UTC
    start times as ids, such as 20270320T153000Z [n]; setup: content of SITE.toml; seen: True for
    pixels that the camera saw [H, W]; steadiness: range of the irradiance during the bracket,
    divided by the mean (0 if unknown) [n]; source: path or URL of the pairs; notes: sentences for
    the user; counts: weight of each value in training [n, H, W], None if all are 1; scene: what was
    used of a fitted scene, None without one; sky_view: where the camera sees the sky, None if it
    was not estimated (`with_sky_view`); disc_deg: altitude and azimuth of the disc in the map
    [n, 2], NaN or None where not measured; uncertain: True for hours whose irradiance `pair` marked
    [n], None without any.
    """

    light: Light
    luminance_cdm2: Floats32
    patch_cdm2: Floats32 | None
    disc_lx: Floats
    heading_deg: float
    days: Dates
    slots: tuple[str, ...]
    setup: SiteFile
    seen: Mask
    steadiness: Floats
    source: str = ""
    notes: tuple[str, ...] = ()
    counts: Floats16 | None = None
    scene: UsedScene | None = None
    sky_view: SkyView | None = None
    disc_deg: Floats | None = None
    uncertain: Mask | None = None

    def __len__(self) -> int:
        return len(self.slots)

    @property
    def shape(self) -> tuple[int, int]:
        """Height H and width W of the maps [px]."""
        return self.luminance_cdm2.shape[1], self.luminance_cdm2.shape[2]

    @property
    def weights(self) -> Floats:
        """Solid angle of a pixel over the mean of the seen pixels, [H, W]; 0 for unseen ones."""
        weights = np.where(self.seen, equirect_solid_angles(*self.shape), 0.0)
        return weights / weights[self.seen].mean()

    def digest(self) -> str:
        """Return the SHA-256 of all fields but `source`, `sky_view` and `disc_deg`, in hex."""
        return codec.data_digest(replace(self, source="", sky_view=None, disc_deg=None))

    def take(self, index: Array | Sequence[int]) -> Dataset:
        """Return some of the n hours, selected by `index`.

        index: indices from 0 [k], whose order is followed, or a mask [n], True for hours to take.
        """
        rows = np.arange(len(self))[np.asarray(index)]
        names = ("luminance_cdm2", "patch_cdm2", "disc_lx", "disc_deg", "days", "steadiness")
        arrays = {name: getattr(self, name) for name in (*names, "counts", "uncertain")}
        selected = {name: value[rows] for name, value in arrays.items() if value is not None}
        slots = tuple(self.slots[i] for i in rows)
        return replace(self, light=self.light[rows], slots=slots, **selected)

    def thin(self, height: int) -> Dataset:
        """Return the same hours at every k-th pixel in both directions, with `height` rows or more.

        k is the largest odd divisor of the rows that allows this, or 1. Pixels are not averaged, so
        that noise and sharp edges remain.
        """
        rows = self.shape[0]
        divisors = [k for k in range(1, rows + 1, 2) if rows % k == 0 and rows // k >= height]
        step = divisors[-1] if divisors else 1
        pick = slice(step // 2, None, step)  # centres of blocks are centres of pixels
        arrays = {n: getattr(self, n) for n in ("luminance_cdm2", "patch_cdm2", "seen", "counts")}
        return replace(self, **{n: v[..., pick, pick] for n, v in arrays.items() if v is not None})

    def patches(self, light: Light) -> Floats32:
        """Return the luminance of sun patches in the hours of `light`, [n, H, W] cd/m2.

        They are computed from the room of `setup`, which must have one. Raises InputError for an
        impossible room.
        """
        room, suns, lx = self.setup.room, light.apparent_sun_direction, light.direct_lx
        assert room is not None
        height, heading = self.shape[0], self.heading_deg
        return sun_patches(room, suns, lx, height=height, heading_deg=heading)

    def about(self) -> dict[str, object]:
        """Return what a model's config.json records about its training data.

        setup: SITE.toml as a table; heading_deg, height, width [px]: of the maps; scene: only if
        one was used; training: {"source", "slots", "days"} of the captures.
        """
        return {
            "setup": site_toml.site_table(self.setup),
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


def sun_of_rows(path: Path, rows: Sequence[PairRow], site: Site) -> tuple[Floats, Floats]:
    """Return the sun's true altitude and azimuth [deg], [n] each: those of the csv, else by SPA.

    Azimuths are clockwise from north.
    Raises InputError, naming the line, for rows that contradict each other or the sun: a repeated
    time or picture, a sun position in the csv more than 2.5 degrees from that computed for `site`,
    and irradiance that is too large or too small for any sky, such as values in kW/m2. path: of
    the csv, in whose folder the pictures are.
    """
    times = [row.t_utc for row in rows]
    pictures = [(path.parent / row.panorama).resolve() for row in rows]
    for values, kind in ((times, "t_utc"), (pictures, "panorama")):
        first: dict[object, int] = {}
        for row, value in zip(rows, values, strict=True):
            if (line := first.setdefault(value, row.line)) != row.line:
                finding = f"lines {line} and {row.line} have the same {kind}"
                remedy = "remove one, or set its ok = 0"
                raise InputError(path, finding, "each bracket once", remedy)
    position = sun.position(times, site)
    altitude, azimuth = position.altitude_deg, position.azimuth_deg
    stated = np.array([(row.sun_altitude_deg, row.sun_azimuth_deg) for row in rows]).T  # [2, n]
    cosine = (sun.direction(*stated) * sun.direction(altitude, azimuth)).sum(axis=1)
    # Radiance's own sun differs from SPA by up to 1.1 degrees; half an hour moves the sun by 7.
    # Angles absent from the csv are NaN and compare False.
    if (wrong := cosine < np.cos(np.radians(2.5))).any():
        k = int(np.argmax(wrong))
        in_csv, computed = (
            f"altitude {sun_deg[0][k]:.1f}, azimuth {sun_deg[1][k]:.1f} deg"
            for sun_deg in (stated, (altitude, azimuth))
        )
        expected = f"{computed}, computed from t_utc and the place of {site.name}"
        remedy = "check t_utc, the longitude's sign, the order of rows, or empty both sun columns"
        raise InputError(path, f"line {rows[k].line}: sun at {in_csv}", expected, remedy)
    _check_irradiance(path, rows, altitude)
    return tuple(np.where(np.isnan(stated).any(axis=0), (altitude, azimuth), stated))


_MIN_SUNNY_ROWS = 3  # a median of fewer rows can be chance; chosen
# Global irradiance over diffuse plus direct, or its inverse, that exchanged columns exceed: three
# times BSRN's limit of 8 %. A wrong clock, which changes it too, is reported elsewhere. Chosen.
_MAX_CLOSURE = 1.25
# A capture is without light if under 1 % of its pixels exceed 0.1 cd/m2, although 5 W/m2 of diffuse
# irradiance (about 600 lx) come from the sky. Chosen: a tenth of a percent of it is 0.2 cd/m2.
_DARK_CDM2, _DAY_WM2 = 0.1, 5.0


def _check_irradiance(path: Path, rows: Sequence[PairRow], altitude_deg: Floats) -> None:
    """Raise InputError for irradiance that is impossible with a sun over `CLEAR_SUN_DEG`.

    Each row is compared with BSRN's limits and with `sun.too_weak`, and the median of the rows with
    direct sun, if there are three or more, shows exchanged columns. altitude_deg: of the sun [n].
    """
    top = sun.extraterrestrial_wm2([row.t_utc for row in rows])
    dni, dhi = np.array([(row.dni_wm2, row.dhi_wm2) for row in rows]).T
    beam = sun.horizontal_beam(dni, altitude_deg)
    limits, high = sun.bsrn_limits(altitude_deg, top), altitude_deg > sun.CLEAR_SUN_DEG
    weak = sun.too_weak(dhi + beam, altitude_deg, top)
    for wrong, finding, remedy in (
        (dhi > limits.dhi_wm2[1], "more diffuse light than any sky gives", "global irradiance"),
        (dni > limits.dni_wm2[1], "more direct light than above the atmosphere", "other units"),
        (weak, "less light than under the darkest clouds", "kW/m2"),
    ):
        if (wrong & high).any():
            k = int(np.argmax(wrong & high))
            light = f"DNI {dni[k]:g}, DHI {dhi[k]:g} W/m2 with the sun at {altitude_deg[k]:.0f} deg"
            finding = f"line {rows[k].line} has {finding}: {light}"
            remedy = f"check whether the column contains {remedy}; otherwise set ok = 0"
            raise InputError(path, finding, "possible irradiance in W/m2", remedy)
    sunny = (beam > 0.2 * (dhi + beam)) & high
    if sunny.sum() < _MIN_SUNNY_ROWS:
        return
    of_top = float(np.median(((dhi + beam) / sun.horizontal_beam(top, altitude_deg))[sunny]))
    closure = sun.closure_ratio([row.ghi_wm2 for row in rows], dhi, dni, altitude_deg)[sunny]
    closure = float(np.nanmedian(closure)) if np.isfinite(closure).any() else 1.0
    median = f"in the median of {counted(int(sunny.sum()), 'capture')} with direct sun"
    remedy = "check which columns contain global, direct normal and diffuse irradiance"
    if of_top > 1.0:
        finding = f"diffuse plus direct are {of_top:.2f} times the light above the atmosphere"
        raise InputError(path, f"{finding} {median}", "0.2 to 0.9 times", remedy)
    if not 1.0 / _MAX_CLOSURE < closure < _MAX_CLOSURE:
        finding = f"global is {closure:.2f} times diffuse plus direct on the horizontal"
        raise InputError(path, f"{finding} {median}", "1, within 8 % (BSRN)", remedy)


def _usable_rows(pairs: PairsFile) -> list[PairRow]:
    """Return the rows with ok = 1, in the order of time.

    Raises InputError for a missing picture.
    """
    for row in pairs.usable:
        for name in (row.panorama, row.sunpatch):
            picture = pairs.path.parent / name
            if name and not picture.is_file():
                finding, remedy = f"line {row.line}: no file {picture}", "copy it, or set ok = 0"
                raise InputError(pairs.path, finding, "an existing picture", remedy)
    return sorted(pairs.usable, key=lambda row: row.t_utc)


def _find_setup(path: Path, site: Path | None) -> SiteFile:
    """Return the site of the captures: `site`, else the session's, else site.toml next to the csv.

    path: of the csv. Raises InputError if there is no site.
    """
    if site is not None:
        return site_toml.load_site(site)
    # The folder "truth" of a simulated session has the csv of the true maps.
    of_truth = (path.parent.parent,) if path.parent.name == "truth" else ()
    for folder in (path.parent, *of_truth):
        if (folder / "session.toml").is_file():
            return open_session(folder).site_file()
    if (path.parent / "site.toml").is_file():
        return site_toml.load_site(path.parent / "site.toml")
    finding, remedy = "no site file belongs to this csv", "write SITE.toml with: fieldlum new"
    raise InputError(path, finding, "site.toml next to the csv, or --site SITE.toml", remedy)


def load_pairs(where: Path | Session, site: Path | None = None) -> Dataset:
    """Read the captures of a pairs.csv with their pictures, in the order of time.

    where: path of the csv, a session or its folder; site: path of SITE.toml, None for that of the
    session or site.toml next to the csv. Rows with ok = 0, without irradiance, or from a camera
    that cannot be aligned are not used. The sun's position is that of the csv; where its cells are
    empty, it is computed.

    Raises InputError for a folder that is no session, a missing csv, site file or picture, an
    unreadable cell, picture or sky_view.exr, pictures that differ in size or heading, or
    implausible rows; NotEnoughDataError for a session without pairs.csv, or if no row or no pixel
    is usable.
    """
    path = where.pairs if isinstance(where, Session) else Path(where)
    if path.is_dir():
        path = open_session(path).pairs
    if not path.is_file():
        remedy = "write one with: fieldlum pair SESSION"
        if isinstance(where, Session) or Path(where).is_dir():
            raise NotEnoughDataError(f"{path}: no such file; {remedy}")
        raise InputError(path, "no such file", "a pairs.csv", remedy)
    setup = _find_setup(path, site)
    pairs = PairsFile.read(path)
    rows, notes = _usable_rows(pairs), [*pairs.warnings, *pairs.pair_again]
    if pairs.refused:
        notes.append(f"left out: {counted(len(pairs.refused), 'row')} with ok = 0")
    dark = [row for row in rows if row.dni_wm2 + row.dhi_wm2 <= 0.0]
    if dark:
        named = ", ".join(Path(row.panorama).stem for row in dark)
        notes.append(f"captures without irradiance are not used: {named}")
        rows = [row for row in rows if row.dni_wm2 + row.dhi_wm2 > 0.0]
    if not rows:
        finding = "no usable row; expected a row with ok = 1 and irradiance above 0"
        remedy = "see the column 'why', correct the cause and run fieldlum pair again"
        raise NotEnoughDataError(f"{path}: {finding}; {remedy}")
    return _assemble(path, rows, setup, notes)


def _assemble(path: Path, rows: list[PairRow], setup: SiteFile, notes: list[str]) -> Dataset:
    """Read the captures of usable rows, align the pictures, remove the sun disc and fill gaps.

    Captures whose camera turned too far to be aligned, and those by day without light, as with the
    lens cap on, are left out. path: of the csv; notes: those on its rows, to which notes on the
    pictures are added. Raises InputError, as `load_pairs`.
    """
    altitude, azimuth = sun_of_rows(path, rows, setup.site)
    light = Light(
        t_utc=tuple(row.t_utc for row in rows),
        dni_wm2=np.array([row.dni_wm2 for row in rows]),
        dhi_wm2=np.array([row.dhi_wm2 for row in rows]),
        sun_altitude_deg=altitude,
        sun_azimuth_deg=azimuth,
        states=states_of(path, rows),
        refraction=_refraction(path, rows),
    )
    data, has_value = read_pictures(path, rows, setup, light)
    is_lit = (data.luminance_cdm2 > _DARK_CDM2).mean(axis=(1, 2)) > 0.01
    remedy = "check lens cap, blinds, exposures and unit, and capture again"
    if not is_lit.any():
        raise InputError(path, f"no light in {counted(len(rows), 'picture')}", "daylight", remedy)
    covered = [bool(room_states.cover_state(text)) for text in light.states or [""] * len(rows)]
    if not (is_lit := is_lit | (light.dhi_wm2 < _DAY_WM2) | covered).all():
        named = ", ".join(data.take(~is_lit).slots)
        notes.append(f"WARNING: not used, because they are dark by day: {named}: {remedy}")
        return _assemble(path, [rows[k] for k in np.flatnonzero(is_lit)], setup, notes)
    heading, days = data.heading_deg, data.days
    sun_deg = np.where(light.direct_lx > 1000.0, altitude, np.nan)  # 10 W/m2 of DNI
    turns = camera_turns(np.nan_to_num(data.luminance_cdm2), data.seen, heading, sun_deg)
    progress(1, 1, "")
    if not turns.aligned.any():
        raise InputError(path, "no two pictures have the same edges", "one view", remedy)
    for k in (k for k, row in enumerate(rows) if row.sun_in_map):
        at = (float(light.apparent_altitude_deg[k]), float(azimuth[k]))
        take_disc_out(data, k, at, shown_place(*at, heading, turns.angles_deg[k]))
    notes += _notes_on_discs(path, data)
    assert data.counts is not None
    align(data.luminance_cdm2, has_value, data.counts, heading, turns)
    counts = joined_counts(data.counts, has_value)
    notes += [*data.notes, *turn_notes(turns, days)]
    seen_mask, filled = fill_gaps(data.luminance_cdm2, has_value)
    if filled:
        notes.append(f"{counted(filled, 'missing value')}: each the median of its pixel")
    if not seen_mask.all():
        notes.append(f"{1.0 - seen_mask.mean():.0%} of the pixels were not seen by the camera")
    view = SkyView.find(path.parent / SKY_VIEW)
    if view is not None and is_outdated(Session(path.parent), view):
        notes.append(f"WARNING: {SKY_VIEW} is of earlier pictures: run fieldlum pair again")
    if view is None and Session(path.parent).toml.is_file():
        notes.append(f"no {SKY_VIEW}: coarse maps decide the sun's disc; run fieldlum pair again")
    data = replace(data, seen=seen_mask, notes=tuple(notes), counts=counts, sky_view=view)
    return data if turns.aligned.all() else data.take(turns.aligned)


# Least share of the beam in a spot at the sun's place that is the disc, not a cloud next to it.
# Chosen: 2 700 captures with a beam, in rooms by Mitsuba whose maps have no disc, show no such
# spot; discs behind clear glass have 0.6 to 0.9.
_DISC_LEFT = 0.1


def _notes_on_discs(path: Path, data: Dataset) -> list[str]:
    """Return warnings of discs that were not taken out, and of axes that are not as stated.

    The sun discs show which axes the pictures probably have; InputError is raised if these
    certainly are not the stated ones. path: of the csv; data: its captures, without the discs at
    the sun's place in pictures that are stated to have them.
    """
    light, suns, shown, left = data.light, [], [], 0
    for k in np.flatnonzero(light.direct_lx > BEAM_LX):
        position = (float(light.apparent_altitude_deg[k]), float(light.sun_azimuth_deg[k]))
        beam_lx, dni_wm2 = float(light.direct_lx[k]), float(light.dni_wm2[k])
        picture = data.luminance_cdm2[k]
        disc = sun_disc.find_disc(picture, data.heading_deg, near_deg=position, dni_wm2=dni_wm2)
        left += disc is not None and disc.normal_lx > _DISC_LEFT * beam_lx
        place = picture_axes.sun_elsewhere(picture, data.heading_deg, beam_lx)
        if place is None and data.disc_lx[k] > picture_axes.DISC_SHARE * beam_lx:
            place = position
        if place is not None:
            suns.append(position)
            shown.append(place)
    wrong = picture_axes.wrong_axes(suns, shown, data.heading_deg, data.shape[0])
    found = f"the sun's disc is learnt as sky in {counted(left, 'picture')}"
    notes = [f"WARNING: {found}: write sun_in_map = 1 into the csv and train again"] if left else []
    if wrong is None:
        return notes
    if wrong.sure:
        expected = "the zenith on top, azimuth clockwise to the right, heading_deg in the middle"
        raise InputError(path, wrong.found, expected, wrong.remedy)
    return [*notes, f"WARNING: {wrong.found}: {wrong.remedy}"]


def _slots(rows: Sequence[PairRow]) -> tuple[str, ...]:
    """Return the slot id of each row: the name of its picture if all are ids, else from its UTC."""
    names = tuple(Path(row.panorama).stem for row in rows)
    if all(_SLOT_ID.fullmatch(name) for name in names) and len(set(names)) == len(names):
        return names
    return tuple(slot_id(row.t_utc) for row in rows)


def states_of(path: Path, rows: list[PairRow]) -> tuple[str, ...] | None:
    """Return the room's state in each row, such as "lamp=on"; None if all rows have no state.

    Texts are those of `fieldlum.core.room_states`. States are from the csv's column `state` and
    from the marks in the session's journal; a mark replaces a part of the cell with the same word.
    path: of the csv. Raises InputError for an unknown word.
    """
    marked = marks(Session(path.parent))
    states = []
    for row in rows:
        with input_errors(
            f"{path}: line {row.line}", room_states.USAGE, "correct that cell", ValueError
        ):
            states.append(
                room_states.merged_state(row.state, marked.get(Path(row.panorama).stem, ""))
            )
    return tuple(states) if any(states) else None


def _refraction(path: Path, rows: list[PairRow]) -> bool:
    """Return whether the pictures show the sun as raised by the atmosphere's refraction.

    Raises InputError if only some rows state so. path: of the csv.
    """
    other = [row.line for row in rows if row.refraction != rows[0].refraction]
    if other:
        finding = f"line {other[0]}: another value of the column refraction than in the first row"
        expected = "1 in all rows (camera pictures) or 0 in all rows (renderings with the true sun)"
        remedy = "write camera pictures and renderings into separate csv files"
        raise InputError(path, finding, expected, remedy)
    return rows[0].refraction


# ----------------------------------------------------------------------------------------------
# pictures


# A clipped value is a bound; a moving object has different values in each frame; a filled value is
# from the pixel's neighbours. Bloom and noise are part of u_cdm2.
NO_TRAINING = Flag.CLIPPED_HIGH | Flag.MOTION | Flag.FILLED


def take_disc_out(
    data: Dataset, k: int, at: tuple[float, float], shown: tuple[float, float]
) -> None:
    """Remove the sun's disc from map k and sun patch k of `data`, in place.

    `disc_lx` of hour k is set too: from its sun patch, which has no sky around the disc, or from
    the map if `data` has no patches; 0 if that picture shows no disc. `disc_deg` is set if the map
    or the patch shows a disc. at: altitude and azimuth (clockwise from north) of the sun [deg],
    where the patch shows it; shown: altitude and azimuth at which the map, of a turned camera,
    shows it [deg].
    """
    assert data.disc_deg is not None
    dni_wm2 = float(data.light.dni_wm2[k])
    for pictures, place in ((data.luminance_cdm2, shown), (data.patch_cdm2, at)):
        if pictures is None:
            continue
        disc = sun_disc.find_disc(pictures[k], data.heading_deg, near_deg=place, dni_wm2=dni_wm2)
        data.disc_lx[k] = 0.0 if disc is None else disc.normal_lx
        if disc is not None:
            pictures[k] = sun_disc.without_disc(pictures[k], disc)
            azimuth_off_deg = float(signed_angle_deg(disc.azimuth_deg - place[1]))
            data.disc_deg[k] = at[0] + disc.altitude_deg - place[0], at[1] + azimuth_off_deg


def read_pictures(
    path: Path, rows: list[PairRow], setup: SiteFile, light: Light
) -> tuple[Dataset, Mask]:
    """Read maps and sun patches of the n rows of a pairs.csv; return them with a mask [n, H, W].

    The mask is False where no lens saw the pixel or its value is not finite: the maps have the
    file's value there, to be filled later. A map whose row has sun_in_map still contains the disc.
    path: of the pairs.csv, to whose folder the names of pictures are relative. light: of the rows.
    disc_lx is from the sun that is stated with a picture (header, or suns.csv), else with its sun
    patch, 0 without one. Raises InputError for an unreadable picture, if sizes or headings differ
    from those of the first picture, or if only some rows have a sun patch.
    """
    pictures = [path.parent / row.panorama for row in rows]
    suns = {folder: suns_of(picture) for folder, picture in {p.parent: p for p in pictures}.items()}
    first = read_panorama(pictures[0])
    shape, heading = first.luminance_cdm2.shape, _heading_deg(first, pictures[0], setup)
    size_and_heading = (shape, heading)  # of all pictures
    maps = np.empty((len(rows), *shape), np.float32)
    without = [row.line for row in rows if not row.sunpatch]
    if 0 < len(without) < len(rows):
        finding = f"line {without[0]}: the cell of column sunpatch is empty, but not in other rows"
        raise InputError(path, finding, "a sunpatch in all rows or in none", "correct the column")
    patches = None if without else np.empty_like(maps)
    disc_lx, clipped_count = np.zeros(len(rows)), 0
    masks, counts = np.empty(maps.shape, bool), np.empty(maps.shape, np.float16)
    for k, row in enumerate(rows):
        progress(k, len(rows), pictures[k].name)
        panorama = read_panorama_with_sun(pictures[k], suns[pictures[k].parent])
        panorama = _checked(panorama, pictures[k], size_and_heading, setup)
        clipped_count += panorama.sun is not None and panorama.sun.origin == CLIPPED_SUN
        maps[k], masks[k] = panorama.luminance_cdm2, np.isfinite(panorama.seen_cdm2)
        counts[k] = pixel_counts(panorama)
        disc_lx[k] = panorama.sun.normal_illuminance_lx if panorama.sun else 0.0
        if patches is not None:
            source = path.parent / row.sunpatch
            warn_if_picture_changed(source, "pair")
            patch = _checked(read_panorama(source), source, size_and_heading, setup)
            patches[k] = np.maximum(np.nan_to_num(patch.luminance_cdm2), 0.0)
            if patch.sun and not panorama.sun and not row.sun_in_map:
                disc_lx[k] = patch.sun.normal_illuminance_lx
    progress(len(rows), len(rows), "")
    bound = (
        f"the sun is clipped in {counted(clipped_count, 'map')}: its illuminance is a lower bound"
    )
    uncertain = np.array([row.doubtful for row in rows])
    data = Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=patches,
        disc_lx=disc_lx,
        heading_deg=heading,
        days=np.array([sun.standard_date(t, setup.site.timezone) for t in light.t_utc], "M8[D]"),
        slots=_slots(rows),
        setup=setup,
        seen=masks.mean(axis=0) > 0.8,  # of the captures, before the camera's turns
        steadiness=np.array([row.steadiness for row in rows]),
        source=str(path),
        notes=(f"{bound} (column why of pairs.csv)",) if clipped_count else (),
        counts=counts,
        disc_deg=np.full((len(rows), 2), np.nan),
        uncertain=uncertain if uncertain.any() else None,
    )
    return data, masks


def _heading_deg(panorama: Panorama, path: Path, setup: SiteFile) -> float:
    """Return the heading that the picture's file states, else the site's.

    path: of the picture; its heading is the azimuth of the centre column.
    """
    if stated_heading_deg(path) is None:
        return setup.camera.heading_deg
    return panorama.heading_deg


def _checked(
    panorama: Panorama, path: Path, first: tuple[tuple[int, ...], float], setup: SiteFile
) -> Panorama:
    """Return a picture if its size and heading are those of the first row, else raise InputError.

    path: of the picture; first: size (rows, columns) and heading [deg] of the first row's picture.
    """
    heading = _heading_deg(panorama, path, setup)
    size, (first_size, first_heading) = panorama.luminance_cdm2.shape, first
    if size != first_size:
        finding, expected = (f"{columns} x {rows} pixels" for rows, columns in (size, first_size))
    elif abs(signed_angle_deg(heading - first_heading)) > 0.01:
        finding, expected = f"a heading of {heading:g} deg", f"{first_heading:g} deg"
    else:
        return panorama
    remedy = "merge all brackets at one size and heading, then run fieldlum pair again"
    raise InputError(path, finding, f"{expected}, as the panorama of the first row", remedy)


def fill_gaps(maps: Floats32, has_value: Mask) -> tuple[Mask, int]:
    """Fill missing values in `maps`, in place; return the used pixels and how many were filled.

    maps: of n captures [n, H, W]; has_value: mask [n, H, W], False where a value is missing. A
    missing value gets the pixel's median over the maps. A pixel that is missing in a fifth of the
    maps or more is not used: it is False in the returned mask [H, W] and 0 in all maps. Negative
    values become 0. Raises NotEnoughDataError if no pixel is used.
    """
    seen_mask = has_value.mean(axis=0) > 0.8
    if not seen_mask.any():
        finding = "no pixel has a value in over 80 % of the panoramas"
        remedy = "check that all panoramas are from one camera position"
        raise NotEnoughDataError(f"{finding}; {remedy}")
    gaps = ~has_value & seen_mask
    for i, j in np.argwhere(gaps.any(axis=0)):
        maps[gaps[:, i, j], i, j] = np.median(maps[has_value[:, i, j], i, j])
    maps[:, ~seen_mask] = 0.0
    np.maximum(maps, 0.0, out=maps)
    return seen_mask, int(gaps.sum())


def pixel_counts(panorama: Panorama) -> Floats16:
    """Return the weight of each pixel of a panorama in training, 0 to 1, [H, W].

    It is 0 where `flags` mark a clipped, moving or filled pixel. Elsewhere it is 1 for a value
    without uncertainty, and decreases with the relative uncertainty (`weight_of_variance`).
    """
    counts = np.ones(panorama.luminance_cdm2.shape)
    if panorama.u_cdm2 is not None:
        light = np.maximum(np.nan_to_num(panorama.luminance_cdm2), 1e-6)
        relative = np.nan_to_num(np.asarray(panorama.u_cdm2, float) / light, posinf=1e3)
        counts = weight_of_variance(relative**2)
    if panorama.flags is not None:
        counts = np.where((panorama.flags & NO_TRAINING) != 0, 0.0, counts)
    return counts.astype(np.float16)


def joined_counts(counts: Floats16, has_value: Mask) -> Floats16 | None:
    """Return the weights of the pixels in n captures, [n, H, W]; None if all weights are 1.

    counts: result of `pixel_counts` for each capture [n, H, W], which is changed in place;
    has_value: mask [n, H, W], False where a value is missing, whose weight is 0. The weights of
    each pixel are divided by their maximum: an uncertainty that is common to all captures (the
    camera's scale) does not make one capture better than another. A pixel without weight in most
    captures gets at least 0.1.
    """
    counts[~has_value] = 0.0
    largest = counts.max(axis=0)
    counts /= np.where(largest > 0.0, largest, np.float16(1.0))
    mostly = (counts == 0.0).mean(axis=0) > 0.5  # a lamp that is always clipped
    counts[:, mostly] = np.maximum(counts[:, mostly], np.float16(0.1))
    return None if (counts == 1.0).all() else counts


# ----------------------------------------------------------------------------------------------
# sky view of a csv of panoramas; that of a session is by `pair`


def with_sky_view(data: Dataset, file: Path | None = None) -> Dataset:
    """Return the captures with a sky view: of `file`, else their own, else estimated from the maps.

    file: a sky_view.exr. Captures with snow count only if all by daylight have it; those of a blind
    or tint give a view of their own. Raises InputError for another file, NotEnoughDataError without
    a capture by daylight.
    """
    if file is not None:
        return replace(data, sky_view=SkyView.read(file))
    if data.sky_view is not None:
        return data
    light = data.light

    def read(k: int) -> SkyPicture:
        """Return the rows of map k that can show the sky."""
        shown = np.where(data.seen, data.luminance_cdm2[k], np.nan)
        return cut_panorama(Panorama(shown, data.heading_deg))

    captured = Captured(light, read, data.disc_lx / np.maximum(light.direct_lx, 1.0))
    view = sky_view_of(captured, _discs(data), data.setup.site, data.heading_deg)
    notes = (*data.notes, *(note for note in view.notes if note.startswith("WARNING")))
    return replace(data, sky_view=view, notes=notes)


def in_usual_room(data: Dataset) -> Dataset:
    """Return the captures without those marked with blind, tint, snow or use=no, and name these.

    A predicted year is of the usual room. In a classroom of which a blind covers the window in 15
    to 40 % of the captures, learning these too made DGP of the other hours 3 to 16 times as wrong
    as leaving them out (scratch; four patterns of days, rendered by `room.simulate`). Without a
    usual capture the most frequent state is the usual one. Raises NotEnoughDataError if under three
    of more captures are usual.
    """
    texts = data.light.states or ("",) * len(data)
    states = [room_states.without_lamps(text) for text in texts]
    usual = "" if "" in states else max(states, key=states.count, default="")
    kept = np.array([state == usual for state in states], bool)
    if kept.all():
        return data
    others = " and ".join(sorted({*states} - {usual}))
    found = f"not learnt: {counted(int((~kept).sum()), 'capture')} marked {others}"
    if (count := int(kept.sum())) < 3 <= len(data):
        few = f"{counted(count, 'capture')} without such a mark: capture more hours"
        raise NotEnoughDataError(f"{data.source}: {found}; {few}")
    found = f"WARNING: {found}" if count < len(data) / 2 else found
    note = f"{found}; the year is of the room in its {usual or 'usual state'}"
    return replace(data.take(kept), notes=(*data.notes, note))


def _discs(data: Dataset) -> MeasuredDiscs:
    """Return the places of the sun discs that were measured in the maps, with their uncertainty."""
    if data.disc_deg is None or not (rows := np.flatnonzero(np.isfinite(data.disc_deg[:, 0]))).size:
        return NO_DISCS
    altitude, azimuth = data.disc_deg[rows].T
    pixel_deg = 180.0 / data.shape[0]
    # The sun of the next days is in the same pixel, with the same error: these count as one disc.
    level_deg = signed_angle_deg(azimuth[:, None] - azimuth) * np.cos(np.radians(altitude))
    off_deg = np.hypot(altitude[:, None] - altitude, level_deg)
    same = (off_deg < 0.5 * pixel_deg).sum(axis=1)
    sigma = pixel_deg * np.sqrt(same / 12.0)
    return MeasuredDiscs(altitude, azimuth, sigma, tuple(data.light.t_utc[k] for k in rows))
