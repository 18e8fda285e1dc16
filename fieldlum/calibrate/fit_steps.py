"""Provide the steps that several fits share.

They choose a model (the smallest within one standard error of the best), find gross errors, read
tables, frames and panoramas, and write profiles.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from fieldlum.core import strict_csv
from fieldlum.core.arrays import Floats, Floats32, Integers, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import Exposure, Flag, Panorama
from fieldlum.core.statistics import held_out_masks, is_no_worse, robust_sigma, standard_error
from fieldlum.optics import camera_curves, images, linear_light
from fieldlum.optics.profiles import CameraProfile, Lens, save_profile
from fieldlum.optics.projection import angle_of_radius, direction, equirect_rays, relative_radius
from fieldlum.optics.raw import Mosaic, channel_positions, is_jpeg, read_jpeg, read_mosaic
from fieldlum.session import panorama_sun, sha256
from fieldlum.version import __version__

Model = TypeVar("Model")
Parameters = TypeVar("Parameters")


@dataclass(frozen=True, slots=True)
class OrderSelection:
    """The candidate that held-out data chose, and a line for the profile with the reason.

    index: place of the candidate, from 0; rms: its held-out rms, as a share or in the unit of the
    fit; line: lists all candidates, and states why this one was chosen.
    """

    index: int
    rms: float
    line: str


def choose(
    what: str,
    candidates: Sequence[tuple[str, int, Floats]],
    unit: str = "%",
    negligible: float = 0.0,
) -> OrderSelection:
    """Return the smallest candidate within one standard error of the best, with a line of text.

    candidates: for each its name, the size (number of free parameters, or a rank by flexibility),
    and the squared errors [n] of held-out data, which are the same for every candidate. The best
    has the smallest mean of them; the smallest has the lowest size. what: name of the fit; unit: of
    the errors' root in that line, "%" of a share. negligible: a candidate whose rms is larger by at
    most this (in the unit of the errors' root) counts as equal to the best.
    """
    names, sizes, errors = zip(*candidates, strict=True)
    rms = np.sqrt([e.mean() for e in errors])
    best = int(np.argmin(rms))
    alike = [is_no_worse(e, errors[best]) for e in errors] | (rms - rms[best] <= negligible)
    chosen = int(min(np.flatnonzero(alike), key=lambda i: (sizes[i], rms[i])))
    shown = 100.0 * rms if unit == "%" else rms
    tried = ", ".join(f"{name} {r:.3g} {unit}" for name, r in zip(names, shown, strict=True))
    smaller = f"smaller than the best, {names[best]}, and not significantly worse"
    why = "the best" if chosen == best else smaller
    line = f"{what}: {names[chosen]} ({why}); held-out rms: {tried}"
    return OrderSelection(chosen, float(rms[chosen]), line)


def fit_and_choose(
    what: str,
    models: Sequence[tuple[str, int, Model]],
    groups: Integers,
    solve: Callable[[Model, Mask], Parameters],
    errors: Callable[[Model, Parameters, Mask], Floats],
    *,
    unit: str = "%",
    negligible: float = 0.0,
) -> tuple[Model, Parameters, OrderSelection]:
    """Return the model that held-out data choose, its parameters by all data, and the choice.

    models: for each its name, its size (number of free parameters) and the model. groups [n]:
    number of the group of each datum; a group is held out as one. solve: fits a model to the data
    of a mask. errors: squared errors of the data of a mask by a model's parameters, NaN for a datum
    that cannot be predicted. what: name of the fit; unit: of the root of the errors, "%" of a
    share. negligible: a model whose rms is larger by at most this counts as equal to the best.
    """
    candidates, parts = [], [*folds(groups)]
    for k, (name, size, model) in enumerate(models):
        squares = np.full(len(groups), np.nan)
        for fold, held in enumerate(parts):
            progress(k * len(parts) + fold, len(models) * len(parts), f"{what}: {name}")
            squares[held] = errors(model, solve(model, ~held), held)
        candidates.append((name, size, squares[np.isfinite(squares)]))
    choice = choose(what, candidates, unit, negligible)
    chosen = models[choice.index][2]
    return chosen, solve(chosen, np.ones(len(groups), bool)), choice


def folds(groups: Integers) -> Iterator[Mask]:
    """Yield a mask [n] for each fit of a cross-validation, True for the data to hold out.

    groups [n]: number of each datum's group, see `held_out_masks`. With up to 24 groups each is
    held out alone; with more, they are divided into eight sets.
    """
    count = len(np.unique(groups))
    return held_out_masks(groups, count if count <= 24 else 8)  # limits the time


def gross_errors(off: Floats, minimum: float) -> Mask:
    """Return a mask [n], True for the residuals that are gross errors of single readings.

    off [n]: residuals about 0. A gross error exceeds `minimum` and five robust standard deviations.
    All are False if more than a quarter would be True, because the model is then wrong and not the
    readings.
    """
    far = np.abs(off) > max(5.0 * robust_sigma(off, 0.0), minimum)
    return far if far.mean() <= 0.25 else np.zeros(len(off), bool)


# Share of the saturation above which pixels do not count. Chosen, not measured.
CLIPPED_SHARE = 0.97
# Relative u of a luminance meter's calibration, and of one reading (aim, flicker, a passing cloud)
# if none is stated; typical of data sheets.
READING_U = 0.02
SPOT_DEG = 0.5  # half of the field of a spot meter of 1 degree; data sheets of spot meters
CsvRow = dict[str, Any]
"""The cells of a line of a csv by column: numbers, and paths of files."""


def require(count: int, minimum: int, what: str, remedy: str) -> None:
    """Raise NotEnoughDataError if `count` is below `minimum`.

    what: what is counted, in the plural; remedy: what the user can do.
    """
    if count < minimum:
        raise NotEnoughDataError(f"{what}: {count}; expected at least {minimum}; {remedy}")


# ----------------------------------------------------------------------------------------------
# tables


_PATHS = ("file", "panorama", "spectrum")  # columns without numbers


def read_table(
    path: Path, required: Sequence[str], optional: Mapping[str, Any] = MappingProxyType({})
) -> list[CsvRow]:
    """Return the rows of a csv as dicts: numbers, and paths (`file`, `panorama`, `spectrum`).

    required: columns with a value in every line; optional: other columns, with the value of a
    missing column or an empty cell; a zero counts as empty unless that value is zero or None. Paths
    are relative to the csv. Separators are commas, semicolons or tabs; with the last two, decimals
    may have a comma. Empty lines and lines that begin with # are skipped. Raises InputError for a
    missing or unknown column, an invalid or empty cell, or a csv without readings.
    """
    table = _table(path)
    names = (*required, *optional)
    wrong = [f"no column {name}" for name in required if name not in table.names]
    wrong += [f"unknown column {name}" for name in table.names if name not in names]
    if wrong:
        raise InputError(path, wrong[0], f"columns {', '.join(names)}", "correct the first line")
    rows = table.dicts()
    numbers = [text for _, cells in rows for name, text in cells.items() if name not in _PATHS]
    more_points = sum(("." in text) - ("," in text) for text in numbers)
    # In a file with decimal commas a point separates thousands, which is refused.
    commas = table.separator != "," and more_points <= 0
    readings = []
    for line, cells in rows:
        row = {name: _cell(path, line, name, text, commas) for name, text in cells.items() if text}
        if empty := [name for name in required if name not in row]:
            finding = f"line {line}: an empty cell in the column {empty[0]}"
            raise InputError(path, finding, "a value in every line", "fill it in")
        stated = {name: cell for name, cell in row.items() if cell or not optional.get(name)}
        readings.append({**optional, **stated})
    if not readings:
        raise InputError(path, "no readings", "one reading on each line", "add a reading")
    return readings


def columns(rows: Sequence[CsvRow], *names: str) -> Floats:
    """Return the named columns of the rows of a table as numbers, [names, rows]."""
    return np.array([[row[name] for row in rows] for name in names], float)


def refuse_beyond_lens(widest_deg: float, lens: Lens, source: Path | str) -> None:
    """Raise InputError if the angle widest_deg from the axis is impossible for the lens.

    It may exceed half of full_angle_deg by 5 %, because data sheets round full angles. source: the
    file with the angle, for the error.
    """
    half_deg = lens.full_angle_deg / 2
    if widest_deg > 1.05 * half_deg:
        finding = f"an angle of {widest_deg:.0f} deg from the axis"
        expected = f"at most {half_deg:g} deg, half of full_angle_deg"
        remedy = "check that angles are from the axis, or correct full_angle_deg in the profile"
        raise InputError(source, finding, expected, remedy)


def columns_of(path: Path) -> tuple[str, ...]:
    """Return the column names of a csv. Raises InputError if the file cannot be read."""
    return _table(path).names


def _table(path: Path) -> strict_csv.CsvTable:
    """Read a csv of readings. Raises InputError if the file cannot be read."""
    remedy = "name the columns in its first line"
    # many spreadsheets write semicolons
    return strict_csv.read_table(path, "a csv of readings", remedy, separators=",;\t")


def _cell(path: Path, line: int, name: str, text: str, has_commas: bool) -> Any:
    """Return the value of a cell of a csv: a path for the columns `_PATHS`, else a number.

    line: number of the line, for the error; name: of the column; has_commas: whether the file has
    decimal commas. Raises InputError for a text that is no finite number.
    """
    if name in _PATHS:
        return path.parent / text
    number = text.replace(".", "?").replace(",", ".") if has_commas else text
    with suppress(ValueError):
        is_angle = name.endswith("_deg")  # -99 is a direction
        if math.isfinite(value := strict_csv.read_number(number, has_codes=not is_angle)):
            return value
    remedy = "write a number with a decimal point"
    raise InputError(path, f"line {line}: {name} is '{text}'", "a number", remedy)


# ----------------------------------------------------------------------------------------------
# frames


@dataclass(frozen=True, slots=True)
class LinearFrame:
    """A frame as linear camera colours, not corrected for vignetting or for a filter.

    path: of the frame; exposure: by its EXIF. rgb [h, w, 3]: converted to cd/m2 by the profile's
    scale k; bad [h, w]: True for pixels not to use: above 0.97 of the saturation, or outside the
    codes for which a JPEG's response is valid; step: sensor pixels along the edge of a pixel of
    rgb, 2 for raw and 1 for JPEG; colour_matrix: XYZ to camera colours [3, 3] as stored in a raw
    file, else None.
    """

    path: Path
    rgb: Floats32
    bad: Mask
    step: int
    exposure: Exposure
    colour_matrix: Floats | None = None

    def patch(self, x_px: float, y_px: float, radius_px: float) -> tuple[Floats, float]:
        """Return the mean colour [3] of a disc around x_px, y_px, and the relative u of its green.

        u is a standard uncertainty. Bad pixels do not count. The tenth of the pixels with the
        smallest and the tenth with the largest values do not count. x_px, y_px, radius_px: in
        sensor pixels. Raises InputError for a disc that is not completely in the picture, or if
        over a fifth of its pixels are bad.
        """
        from scipy.stats import trim_mean

        height, width = self.bad.shape
        x, y, r = x_px / self.step, y_px / self.step, max(radius_px / self.step, 1.0)
        name = f"the patch at x {x_px:g}, y {y_px:g} px with a radius of {radius_px:g} px"
        if not (r <= x <= width - r and r <= y <= height - r):
            inside = f"one inside the picture of {width * self.step} x {height * self.step} px"
            raise InputError(self.path, name, inside, "correct x_px, y_px or radius_px")
        cut = np.s_[int(y - r) : int(y + r) + 1, int(x - r) : int(x + r) + 1]
        yy, xx = np.mgrid[cut]
        disc = (xx + 0.5 - x) ** 2 + (yy + 0.5 - y) ** 2 <= r**2
        values, bad = self.rgb[cut][disc].astype(float), self.bad[cut][disc]
        if bad.mean() > 0.2:
            finding = f"{100 * bad.mean():.0f} % of {name} is clipped, or too dark for the response"
            raise InputError(self.path, finding, "at most 20 %", "use a frame that exposes it well")
        rgb = np.asarray(trim_mean(values[~bad], 0.1, axis=0), float)
        error = float(np.nan_to_num(standard_error(values[~bad, 1])))
        return rgb, error / max(float(rgb[1]), 1e-12)


def linear_frame(path: Path, profile: CameraProfile) -> LinearFrame:
    """Read a raw or JPEG frame as linear camera colours; a raw cell of 2 x 2 is one pixel.

    Raises InputError if the frame cannot be read or is of another camera, and for an invalid
    response in the profile.
    """
    if not is_jpeg(path):
        return _from_mosaic(path, profile)
    frame, response = read_jpeg(path, camera_pixels=profile.camera.pixels), profile.response
    linear_light.check_frame(path, frame.codes.shape, frame.model, profile)
    tables = linear_light.response_tables(profile)  # [256, 3]
    z = np.stack([tables[frame.codes[..., c], c] for c in range(3)], axis=-1)
    brightest = frame.codes.max(axis=-1)
    bad = (brightest > response.high_code) | (brightest < response.low_code)
    rgb = z / linear_light.frame_z_per_cdm2(frame.exposure, profile)
    return LinearFrame(path, rgb.astype(np.float32), bad, 1, frame.exposure)


def own_mosaic(path: Path, profile: CameraProfile) -> Mosaic:
    """Read a raw frame of the profile's camera. Raises InputError for one of another camera."""
    mosaic = read_mosaic(path, lens_f_number=profile.camera.fixed_f_number)
    linear_light.check_frame(path, mosaic.counts.shape, mosaic.model, profile)
    return mosaic


def _from_mosaic(path: Path, profile: CameraProfile) -> LinearFrame:
    """Return a raw frame at half its size, the two greens averaged, in cd/m2 at the profile's k."""
    mosaic = own_mosaic(path, profile)
    rows, columns = (count // 2 * 2 for count in mosaic.counts.shape)
    # red, both greens, blue
    planes = [mosaic.counts[i:rows:2, j:columns:2] for i, j in channel_positions(mosaic.cfa)]
    plateaus = [linear_light.saturation_plateau(plane, mosaic.white_dn) for plane in planes]
    full = linear_light.full_dn(mosaic, profile, plateaus)
    bad = np.zeros(planes[0].shape, bool)
    shares = []
    for plane, black, top in zip(planes, linear_light.black_dn(mosaic, profile), full, strict=True):
        cell = plane.astype(np.float32)
        bad |= cell > CLIPPED_SHARE * top
        share = (cell - black) / np.float32(profile.sensor.white_dn - black)
        shares.append(share * camera_curves.linearity_factor(share, profile.sensor.linearity))
    z = np.stack([shares[0], (shares[1] + shares[2]) / 2, shares[3]], axis=-1)
    rgb = z / linear_light.frame_z_per_cdm2(mosaic.exposure, profile)
    return LinearFrame(path, rgb.astype(np.float32), bad, 2, mosaic.exposure, mosaic.colour_matrix)


def nearest_lens(profile: CameraProfile, x_px: float, y_px: float) -> int:
    """Return the index of the lens whose image circle has its centre nearest to a sensor place.

    Distances are relative to the circle's radius. x_px, y_px: the place on the sensor.
    """
    return int(np.argmin([relative_radius(lens, x_px, y_px) for lens in profile.lens]))


def relative_angle(lens: Lens, x_px: float, y_px: float) -> float:
    """Return a place's angle from the lens's axis, over half of the lens's full angle.

    x_px, y_px: on the sensor. 0 on the axis, 1 at the edge of the image circle.
    """
    return float(angle_of_radius(lens, relative_radius(lens, x_px, y_px)) / lens.half_angle_rad)


def transmission(profile: CameraProfile, f_number: float, x_px: float, y_px: float) -> float:
    """Return the transmission of the nearest lens at a place on the sensor, relative to its axis.

    f_number: aperture of the frame; x_px, y_px: the place. A value divided by it is corrected for
    vignetting. It is 1 if the lens has no curve. Raises InputError if the lens only has curves for
    other apertures.
    """
    lens = profile.lens[nearest_lens(profile, x_px, y_px)]
    coefficients, _ = linear_light.vignetting_of(lens, f_number)
    return float(camera_curves.vignetting_at(coefficients, relative_angle(lens, x_px, y_px)))


# ----------------------------------------------------------------------------------------------
# panoramas


def read_panoramas(
    rows: Sequence[CsvRow], profile: CameraProfile, remedy: str = ""
) -> dict[Path, Panorama]:
    """Return the panoramas that the rows of a table name in `panorama`, by file.

    remedy: what else to do when merging again, for the error. The sun of a panorama is the one that
    `pair` computed, if any. Raises InputError for a panorama that cannot be read, or was merged
    with another calibration than the profile's.
    """
    own, pictures = images.calibration_mark(profile)["calibration"], {}
    for file in dict.fromkeys(row["panorama"] for row in rows):
        pictures[file] = panorama_sun.read_panorama_with_sun(file)
        attributes = pictures[file].attributes
        if attributes.get("calibration", own) != own:
            finding = f"merged with another calibration ({attributes.get('camera')})"
            again = f"merge it again with this profile (fieldlum merge){remedy}"
            raise InputError(file, finding, f"that of {profile.camera.name}", again)
    return pictures


def pixels_within(
    picture: Panorama, azimuth_deg: float, altitude_deg: float, radius_deg: float
) -> Mask:
    """Return a mask [h, w], True for pixels within `radius_deg` of a direction.

    azimuth_deg: clockwise from north; altitude_deg: above the horizon. The radius is at least 1.2
    pixels.
    """
    height, width = picture.luminance_cdm2.shape
    rays = equirect_rays(height, width, picture.heading_deg)
    radius_rad = np.radians(max(radius_deg, 1.2 * 180.0 / height))
    return rays @ direction(altitude_deg, azimuth_deg) >= np.cos(radius_rad)


def is_flagged(picture: Panorama, inside: Mask, flag: Flag) -> bool:
    """Return whether any pixel of the mask `inside` [H, W] has the flag; False without flags."""
    return picture.flags is not None and bool((picture.flags[inside] & flag).any())


# ----------------------------------------------------------------------------------------------
# profiles


def save_calibration(
    out: Path,
    profile: CameraProfile,
    frames: Iterable[Path],
    lines: Sequence[str],
    today: date,
    **changed: Any,
) -> CameraProfile:
    """Write the profile with its fields in `changed` replaced, to the file `out`, and return it.

    The profile's provenance gets the sha256 of `frames`, and `lines` (one about each fit), dated
    `today`; the camera's date becomes `today`. Raises OSError for a frame that cannot be read, or
    if `out` cannot be written.
    """
    hashes, before = sorted({sha256(path) for path in frames}), profile.provenance
    provenance = replace(
        before,
        fitted_by=f"fieldlum {__version__} calibrate",
        frames_sha256=tuple(dict.fromkeys((*before.frames_sha256, *hashes))),
        log=(*before.log, *(f"{today.isoformat()} {line}" for line in lines)),
    )
    camera = replace(profile.camera, date=today.isoformat())
    new = replace(profile, camera=camera, provenance=provenance, **changed)
    save_profile(out, new)
    return new
