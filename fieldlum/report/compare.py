"""Compare what was measured with a simulation of the same room: where and when the model errs.

A model is a folder of pictures named by the slots of the session, an hourly table of DGP or
vertical illuminance (a csv or tab-separated text with hours of the year, as raytraverse's tables),
or a results folder of honeybee-radiance (`_read_grid`). Pictures are compared with the captures of
the same slots, hours with the session's predicted year, which should have the model's weather file.
"""

import calendar
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.ndimage import binary_dilation

from fieldlum.core import plot_style, strict_csv
from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.files import open_to_read, read_bytes
from fieldlum.core.progress import progress
from fieldlum.core.records import JsonTable, Room, counted
from fieldlum.optics import projection
from fieldlum.report.page import comparison_png, png
from fieldlum.room.scene.box_room import WALLS, wall_named
from fieldlum.room.scene.view import traced_view
from fieldlum.session import Session, codec, panorama_sun, write_file
from fieldlum.sky.sun import hour_of_year
from fieldlum.year.glare.picture_glare import valid_pixels
from fieldlum.year.glare.pictures import picture_directions, read_picture
from fieldlum.year.glare.standards import DISTURBING_DGP
from fieldlum.year.predict import Annual

PICTURE_SUFFIXES = (".hdr", ".exr", ".pic")
SUN_UP_HOURS = "sun-up-hours.txt"  # honeybee-radiance
# Smaller relative differences are no errors of the model: a camera is right to 5 %, a Radiance
# rendering of a known room to about 10 % (Mardaljevic 1995).
_MODEL_ERROR_REL = 0.10
# Surfaces that differ by a larger factor are not of other materials but in another view: a
# reflectance of 0.9 is six times one of 0.15.
_MAX_MATERIAL_FACTOR = 6.0
_NOT_JUDGED = ("all", "window", "reveal", "frame")
_DAYS_OF_MONTH = np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])
_HOUR_NAMES = ("ann_hour", "hoy", "hour of year", "hour_of_year")
# Columns of other programs, in lower case, for the figures of hourly.csv; e_v is of evalglare.
_EV = ("ev_lx", "ev", "e_v", "illum", "vertical illuminance")
_FIGURES = {"dgp": "dgp", "daylight glare probability": "dgp", **dict.fromkeys(_EV, "ev_lx")}


class Comparison(NamedTuple):
    """The result of `compare`: tables, and sentences on where and when the model errs.

    surfaces: of pictures, else empty; rows with the keys name; measured_cdm2, model_cdm2: mean
    luminances; pictures: their number; ratio, low, high: median and quartiles over the pictures of
    the ratio of model to measured (see `surface_rows`). directions: of hourly figures, else empty;
    rows with the keys azimuth_deg: clockwise from true north; figure: dgp or ev_lx, which decides
    the unit of the means (none or lx); hours: number of shared ones; measured, model: means over
    them; mean_abs: mean absolute difference; over, model_over: hours of disturbing glare, measured
    and by the model (None for ev_lx). text: the sentences. files: paths of compare.csv and
    compare.png.
    """

    surfaces: list[JsonTable]
    directions: list[JsonTable]
    text: list[str]
    files: tuple[Path, Path]


class SharedHours(NamedTuple):
    """A figure of one view in the n hours that the measurement and the model share.

    azimuth_deg: view direction, clockwise from true north; figure: dgp or ev_lx; hour_of_year [n]:
    0 to 8759, in local standard time; measured, model [n]: values of the figure, ev_lx in lx. The
    names of the fields are columns of compare.csv.
    """

    azimuth_deg: float
    figure: str
    hour_of_year: Array
    measured: Floats
    model: Floats

    def direction(self) -> JsonTable:
        """Return the row of `Comparison.directions`: means, and hours of disturbing glare.

        Glare is disturbing if DGP is above 0.40.
        """
        error, over = self.model - self.measured, [None, None]
        if self.figure == "dgp":
            over = [int((dgp > DISTURBING_DGP).sum()) for dgp in (self.measured, self.model)]
        row: JsonTable = {"azimuth_deg": self.azimuth_deg, "figure": self.figure}
        row |= {"hours": len(self.model), "measured": float(self.measured.mean())}
        row |= {"model": float(self.model.mean()), "mean_abs": float(np.abs(error).mean())}
        return row | dict(zip(("over", "model_over"), over, strict=True))

    def rows(self) -> list[JsonTable]:
        """Return the rows of compare.csv, one for each hour, with the fields' names as keys."""
        view, hours = (self.azimuth_deg, self.figure), self.hour_of_year.tolist()
        rows = zip(hours, self.measured.round(4), self.model.round(4), strict=True)
        return [dict(zip(SharedHours._fields, (*view, *row), strict=True)) for row in rows]

    def text(self) -> str:
        """Return a sentence on the month and the hour of the day in which the model errs most."""
        error = self.model - self.measured
        number, unit = ("+.3f", "") if self.figure == "dgp" else ("+.0f", " lx")

        def worst(group: Array) -> tuple[int, str]:
            """Return the number of the group with the largest mean absolute error, and this error.

            The error is a text with its unit. group: number of the group of each hour, [n].
            """
            errors = {k: float(np.abs(error[group == k]).mean()) for k in set(group.tolist())}
            k = max(errors, key=errors.__getitem__)
            return k, f"{errors[k]:{number[1:]}}{unit}"

        month_ends = np.cumsum(_DAYS_OF_MONTH)
        month, by_month = worst(np.searchsorted(month_ends, self.hour_of_year // 24, "right"))
        hour, by_hour = worst(self.hour_of_year % 24)
        return (
            f"{self.figure} facing {self.azimuth_deg:g} deg: the model is {error.mean():{number}}"
            f"{unit} in the mean; its mean absolute error is largest in "
            f"{calendar.month_name[month + 1]} ({by_month}) and from {hour}:00 to {hour + 1}:00 "
            f"({by_hour})."
        )


def compare(
    session: Session,
    model: Path,
    out: Path,
    azimuths_deg: Sequence[float] = (),
    annual: Annual | None = None,
) -> Comparison:
    """Compare a model's result with a session, and write compare.csv and compare.png to `out`.

    model: a folder of pictures that are named by the session's slots, or a file or folder for
    `read_model_hours`. azimuths_deg: view directions of an hourly result that does not name them,
    in its order, clockwise from true north. annual: the session's predicted year, None without one;
    only tables of hours need it. Raises InputError for a result that cannot be read, or that shares
    no picture and no hour with the session, NotEnoughDataError without a year for a table of hours.
    """
    if model.is_dir() and _sun_up_hours_file(model) is None:
        return _compare_pictures(session, model, out)
    hours = read_model_hours(model, azimuths_deg)
    if annual is None:
        remedy = "run fieldlum predict with the weather file of the model"
        raise NotEnoughDataError(f"{session.root}: no predicted year; {remedy}")
    return _compare_hours(annual, hours, session.site_file().site.timezone, model, out)


def _write(out: Path, rows: Sequence[JsonTable], picture: bytes) -> tuple[Path, Path]:
    """Write compare.csv and compare.png to the folder `out`; return their paths."""
    files = (out / "compare.csv", out / "compare.png")
    codec.write_csv(files[0], rows)
    write_file(files[1], picture)
    return files


# ----------------------------------------------------------------------------------------------
# pictures


def surface_names(room: Room, height: int, heading_deg: float) -> Array:
    """Return what each pixel of a panorama mostly shows, [H, W] texts.

    They are floor, ceiling, window, reveal, frame, obstruction or ground, and of a wall its name by
    `wall_named`, such as ``N wall ("south")``. The text is empty where none of them is, and within
    two pixels of a window. room: a box room; height: rows H, W = 2H; heading_deg: azimuth of the
    centre column, clockwise from true north. Raises InputError for an impossible room.
    """
    view = traced_view(room, height, heading_deg)
    names = np.full(2 * height**2, "", dtype=object)
    samples, is_direct = view.samples, ~view.samples.mirrored
    pixel, box, axis = samples.pixel[is_direct], samples.box[is_direct], samples.axis[is_direct]
    kinds = np.array([element.kind for element in view.scene.boxes], dtype=object)
    names[pixel] = np.where(kinds[box] == "wall", "reveal", kinds[box])
    for wall, (normal_axis, side) in WALLS.items():
        plane_m = (room.width_m, room.depth_m)[normal_axis] * side
        # a wall's box shows its inner face there, and elsewhere the reveal of an opening
        is_face = (kinds[box] == "wall") & (axis == normal_axis)
        is_face &= np.abs(samples.position[is_direct][:, normal_axis] - plane_m) < 0.02
        names[pixel[is_face]] = wall_named(wall, room.wall_azimuth_deg)
    names = names.reshape(height, 2 * height)
    is_window = (view.sky > 0.05) | (view.plain > 0.05)
    near: Mask = np.asarray(binary_dilation(is_window, iterations=2), bool)
    names[near] = ""  # edges mix the window with what is next to it
    names[is_window] = "window"
    return names


def _compare_pictures(session: Session, model: Path, out: Path) -> Comparison:
    """Compare the pictures in a folder with the captures of the same slots.

    model: the folder; out: where compare.csv and compare.png, with the three pictures that differ
    most, are written. Raises InputError for a folder without a picture of a captured slot, and for
    two pictures of one slot.
    """
    captures = {path.stem: path for path in session.panorama_files()}  # by slot
    pictures = sorted(p for p in model.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
    shared = [path for path in pictures if path.stem in captures]
    if not shared:
        found = f"pictures: {len(pictures)}, none named as a capture of {session.root}"
        expected = "pictures named by slots, such as 20270320T193000Z.hdr"
        raise InputError(model, found, expected, "name each by the slot whose sun and sky it has")
    for first, second in pairwise(shared):
        if first.stem == second.stem:
            raise InputError(second, f"a second picture of {second.stem}", "one", "remove one")
    room, rows, worst = session.site_file().room, [], []
    for number, path in enumerate(shared):
        progress(number, len(shared), "pictures")
        names, light, model_light, weight = _on_one_grid(captures[path.stem], path, room)
        of_picture = surface_rows(path.stem, names, light, model_light, weight)
        rows += of_picture
        ratio = of_picture[0]["ratio"]  # of the complete picture
        shown = [np.where(weight > 0, part, np.nan) for part in (light, model_light)]
        worst.append((abs(np.log(ratio)), f"{path.stem}, model {_error_text(ratio)}", *shown))
        worst = sorted(worst, key=lambda item: -item[0])[:3]
    surfaces = _over_all_pictures(rows)
    _, titles, light, model_light = zip(*worst, strict=True)
    text = [*surface_sentences(surfaces), f"Largest differences: {'; '.join(titles)}."]
    picture = comparison_png(light, model_light, titles, "model")
    return Comparison(surfaces, [], text, _write(out, rows, picture))


def _on_one_grid(
    capture_file: Path, model_file: Path, room: Room | None
) -> tuple[Array, Floats, Floats, Floats]:
    """Return four values of each pixel of a model's picture, [H, W] each.

    They are the name of its surface, the luminance in the capture and in the model [cd/m2], and its
    solid angle [sr], which is 0 where one of the pictures has no value, and around the sun.
    capture_file: panorama of the same slot; room: for the names of surfaces, None if it is unknown.
    Raises InputError for pictures that cannot be read or that share no direction with light.
    """
    capture, picture = panorama_sun.read_panorama_with_sun(capture_file), read_picture(model_file)
    model_light, _ = valid_pixels(picture.panorama, model_file)
    rays, weight = picture_directions(picture)
    light, _ = valid_pixels(capture, capture_file)
    height, heading_deg = len(light), capture.heading_deg
    # the capture's pixel in each direction
    at = np.unravel_index(projection.flat_pixels(rays, light.shape, heading_deg), light.shape)
    weight = np.where(capture.seen[at], weight, 0.0)
    if picture.view is not None and picture.view.kind != "v":
        # beyond its angle a fisheye's square has no picture
        edge_cosine = np.cos(np.radians(picture.view.horizontal_deg) / 2)
        weight = np.where(rays @ picture.view.forward > edge_cosine, weight, 0.0)
    if capture.sun is not None:
        sun = projection.direction(capture.sun.altitude_deg, capture.sun.azimuth_deg)
        # within 2 degrees of the sun, one of the pictures may have the disc
        weight = np.where(rays @ sun > np.cos(np.radians(2.0)), 0.0, weight)
    if not (weight * light[at]).sum() > 0.0 or not (weight * model_light).sum() > 0.0:
        found, expected = "no light in the capture's directions", "the same directions in cd/m2"
        raise InputError(model_file, found, expected, "check VIEW, north (y axis) and unit")
    if room is not None and room.kind == "box":
        names = surface_names(room, height, heading_deg)
    else:  # sectors of the sky's directions, above and below 45 degrees of altitude one name each
        pixels = projection.equirect_rays(height, 2 * height, heading_deg)
        altitude_deg, azimuth_deg = projection.altitude_azimuth_deg(pixels)
        sectors = np.array(["N", "NE", "E", "SE", "S", "SW", "W", "NW"], object)
        names = sectors[np.round(azimuth_deg / 45.0).astype(int) % 8]
        names = np.where(altitude_deg < -45.0, "below", names)
        names = np.where(altitude_deg > 45.0, "above", names)
    return names[at], light[at], model_light, weight


def surface_rows(
    slot: str, names: Array, light: Floats, model_light: Floats, weight: Floats
) -> list[JsonTable]:
    """Return the rows of compare.csv for one slot: "all", then each surface that is shown.

    names, light, model_light, weight: surface ("" is not used), luminance in the capture and in the
    model [cd/m2], and solid angle [sr] of each pixel, [H, W]. Keys of a row: slot; surface; mean
    luminances measured_cdm2 and model_cdm2; ratio, of model over measured: for "all" that of the
    means, for a surface that of its median pixel. A material changes the median, light that leaks
    through a coarse ambient cache near a window does not. Surfaces below 0.005 sr (chosen: about 4
    degrees wide) have no row.
    """
    rows, ratios = [], model_light / np.maximum(light, 0.01)
    for name in ("all", *sorted(set(names.ravel()) - {""})):
        used = weight if name == "all" else np.where(names == name, weight, 0.0)
        if used.sum() < 0.005:  # sr; about 4 degrees wide
            continue
        measured = round(float((used * light).sum() / used.sum()), 2)
        model = round(float((used * model_light).sum() / used.sum()), 2)
        median = np.quantile(ratios, 0.5, weights=used, method="inverted_cdf")
        ratio = round(model / max(measured, 0.01) if name == "all" else float(median), 4)
        row = {"slot": slot, "surface": name, "measured_cdm2": measured, "model_cdm2": model}
        rows.append(row | {"ratio": max(ratio, 1e-4)})
    return rows


def _over_all_pictures(rows: Sequence[JsonTable]) -> list[JsonTable]:
    """Return a row of `Comparison.surfaces` for each surface, "all" first.

    rows: of compare.csv, for each picture and surface.
    """
    surfaces = []
    for name in dict.fromkeys(row["surface"] for row in rows):
        keys = ("measured_cdm2", "model_cdm2", "ratio")
        values = np.array([[row[key] for key in keys] for row in rows if row["surface"] == name])
        ratio, low, high = np.percentile(values[:, 2], (50, 25, 75)).tolist()
        means = dict(zip(keys, values.mean(axis=0).tolist(), strict=True))
        spread = {"ratio": ratio, "low": low, "high": high, "pictures": len(values)}
        surfaces.append({"name": name, **means, **spread})
    return surfaces


def surface_sentences(surfaces: Sequence[JsonTable]) -> list[str]:
    """Return sentences on the complete picture, and on the surface that differs most from others.

    surfaces: rows of `Comparison.surfaces`, "all" first. A surface is named if it differs from the
    others by over 10 %, the error of a Radiance rendering of a known room (Mardaljevic 1995), and
    by over three times as much as they do from each other (chosen). Pixels of reveals and frames
    mix light and dark: they are not named.
    """
    total = surfaces[0]
    median = f"in the median of {counted(total['pictures'], 'picture')}"
    text = [f"The model is {_error_text(total['ratio'])} {median}."]
    parts = [surface for surface in surfaces if surface["name"] not in _NOT_JUDGED]
    if len(parts) < 3:
        return text
    ratios = np.array([surface["ratio"] for surface in parts])
    usual = float(np.median(ratios))
    ln_off = np.abs(np.log(ratios / usual))  # difference of each surface from the median one
    k = int(ln_off.argmax())
    largest, ln_others = ln_off[k], float(np.median(np.delete(ln_off, k)))
    name, ratio, ln_material = parts[k]["name"], ratios[k], np.log(_MAX_MATERIAL_FACTOR)
    if ln_others > ln_material / 4 or largest > ln_material:
        text.append(
            f"Surfaces differ from each other by up to {np.exp(largest):.1f} times, more than "
            "materials explain: check VIEW, north (y axis), viewpoint and sun of the pictures."
        )
    elif largest > np.log1p(_MODEL_ERROR_REL) and largest > 3.0 * ln_others:
        errors = f"the model is {_error_text(ratio)}, other surfaces {_error_text(usual)}"
        text.append(
            f"{name}: {errors}: its reflectance in the model is probably too "
            f"{'high' if ratio > usual else 'low'} (about {ratio / usual:.2f} times the true one), "
            "or it is another material there; or, of a wall with the window, too few bounces (-ab)."
        )
    elif abs(np.log(usual)) > np.log1p(_MODEL_ERROR_REL):
        text.append("All surfaces differ alike: check the glazing's transmittance, sky and unit.")
    else:
        text.append(f"No surface differs from the others by over {100 * _MODEL_ERROR_REL:.0f} %.")
    return text


def _error_text(ratio: float) -> str:
    """Return how far the model is from right, in percent; ratio: of model over measured."""
    percent = 100 * (ratio - 1)
    if abs(percent) < 1:
        return "right within 1 %"
    return f"{abs(percent):.0f} % too {'bright' if percent > 0 else 'dark'}"


# ----------------------------------------------------------------------------------------------
# hours


def read_model_hours(path: Path, azimuths_deg: Sequence[float]) -> pd.DataFrame:
    """Read a year of DGP or Ev [lx] that another program computed.

    Return a row for each time, with columns (figure, azimuth_deg); figure is dgp or ev_lx. The
    index is the stated hour of the year, 0 to 8760: a fraction within the hour, or one of its ends.

    path: a csv or tab-separated table with a column dgp or ev for each view, such as ``dgp@180`` or
    ``ev [lx]@180``, and the time as columns month, day and hour, as a column hoy, or as 8760 rows
    from 1 January; or a results folder of honeybee-radiance. A table of one view may omit ``@180``.
    azimuths_deg: of the views that the file does not name so, in its order, clockwise from true
    north. Raises InputError for other content.
    """
    if path.is_dir():
        return _read_grid(path, azimuths_deg)
    expected, remedy = "an hourly table", "export one row an hour"
    table = strict_csv.read_table(path, expected, remedy, separators="\t,")
    names = [name.lower() for name in table.names]
    strict_csv.check_names(path, names)
    columns = {name: k for k, name in enumerate(names)}
    figures: dict[tuple[str, float], Floats] = {}
    for name, k in columns.items():  # such as "ev [lx]@180"
        word, _, azimuth = name.partition("@")
        word, _, unit = word.replace("[", "(").partition("(")
        if (figure := _FIGURES.get(word.strip())) is None:
            continue
        key = (figure, _azimuth_of(azimuth, azimuths_deg, path))
        if unit.strip(" )]") not in ("", "lx", "lux", "-"):
            raise InputError(path, f"the column {name}", "Ev in lx, DGP 0 to 1", "convert it")
        if key in figures:
            found = f"two columns of {figure} facing {key[1]:g} deg"
            raise InputError(path, found, "one", "remove one")
        figures[key] = _valid_figures(path, figure, _numbers(table, k))
    if not figures:
        found, expected = f"columns {', '.join(table.names)[:80]}", "a column dgp or ev"
        raise InputError(path, found, expected, "rename it")
    return pd.DataFrame(figures, _hours_of_rows(table, columns))


def _azimuth_of(text: str, azimuths_deg: Sequence[float], path: Path) -> float:
    """Return the view direction of a column or picture, in degrees, 0 to 360.

    text: the direction in its name; if it is empty, the only one of `azimuths_deg` is returned.
    path: for errors. Raises InputError if there is no direction, or several.
    """
    if not text and len(azimuths_deg) != 1:
        found, remedy = "figures of a view without its direction", "state --view-azimuth 180"
        raise InputError(path, found, "one --view-azimuth, clockwise from true north", remedy)
    with input_errors(path, "a view such as dgp@180", "correct that name", ValueError):
        if not np.isfinite(azimuth_deg := float(text or azimuths_deg[0])):
            raise ValueError(f"a view to {text} deg")
        return azimuth_deg % 360.0


def _valid_figures(path: Path, figure: str, values: Floats) -> Floats:
    """Return DGP or Ev [lx] of a model; DGP above 1 counts as 1, as in the predicted year.

    figure: dgp or ev_lx; path: for errors. Raises InputError for negative values, and for DGP in
    percent.
    """
    finite = values[np.isfinite(values)]
    if (finite < 0).any():
        found = f"{'DGP' if figure == 'dgp' else 'Ev'} of {finite.min():g}"
        raise InputError(path, found, "0 or more", "write nothing for an hour without a value")
    light = finite[finite > 0]  # tables of a year have zeros at night
    if figure == "dgp" and len(light) and np.median(light) > 1.0:
        found = f"DGP of {np.median(light):g} in the median"
        raise InputError(path, found, "0 to 1", "divide percent by 100")
    return np.minimum(values, 1.0) if figure == "dgp" else values


def _numbers(table: strict_csv.CsvTable, column: int) -> Floats:
    """Return a column as numbers [n], NaN where a cell is empty.

    column: its index. Raises InputError for a cell with another text.
    """
    numbers: list[float] = []
    for line, cells in table.rows:
        where, expected = f"{table.path}: line {line}", f"numbers in {table.names[column]}"
        with input_errors(where, expected, "write numbers, or nothing", ValueError):
            numbers.append(strict_csv.read_number(cells[column], has_codes=False))
    return np.array(numbers)


def _hours_of_rows(table: strict_csv.CsvTable, columns: dict[str, int]) -> Floats:
    """Return the hour of the year that each row states, [n]: 0 to 8760, maybe with a fraction.

    columns: index of each column by its name in lower case. Raises InputError for times that cannot
    be read, and for a table without times whose rows are not the 8760 hours from 1 January.
    """
    if {"month", "day", "hour"} <= columns.keys():
        parts = np.stack([_numbers(table, columns[k]) for k in ("month", "day", "hour")])
        return _hours_of_dates(table.path, parts, [line for line, _ in table.rows])
    name = next((name for name in _HOUR_NAMES if name in columns), None)
    if name is not None:
        return _middles_of_hours(table.path, _numbers(table, columns[name]), 8760)
    found = f"{len(table.rows)} rows of columns {', '.join(table.names)[:80]}"
    for cell in table.rows[0][1]:  # of the first row
        with suppress(ValueError):
            if (t := strict_csv.read_time(cell)) and (t.month, t.day) != (1, 1):
                found = f"rows from {cell}"
    if not found.startswith("8760"):
        expected = "month, day and hour, or hoy, or a row for each of 8760 hours from 1 January"
        raise InputError(table.path, found, expected, "export them, in standard time")
    return np.arange(8760) + 0.5


def _middles_of_hours(path: Path, hours: Floats, last: int) -> Floats:
    """Return the middles of hours that integers name, by their beginnings or by their ends.

    hours: [n], from 0 to `last`. If 0 is among them they are beginnings, if `last` is they are
    ends. Hours with fractions, and those that do not show which they are, do not change. path: for
    errors. Raises InputError if both are among them.
    """
    if (hours % 1).any() or not {0, last} & set(hours.tolist()):
        return hours
    if {0, last} <= set(hours.tolist()):
        expected = f"0 to {last - 1} for hours that begin, or 1 to {last}"
        raise InputError(path, f"hours 0 and {last}", expected, "write one of the two")
    return hours + (0.5 if 0 in hours else -0.5)


def _hours_of_dates(path: Path, dates: Floats, lines: Sequence[int]) -> Floats:
    """Return the hour of the year [n] of dates; dates: months, days and hours [3, n].

    path, lines: file and line numbers [n], for errors. Raises InputError for dates that no year of
    365 days has.
    """
    month, day, hour = dates
    # index of the month, -1 for a number that is no month
    index = np.isin(month, range(1, 13)) * np.nan_to_num(month).astype(int) - 1
    is_date = (index >= 0) & (day >= 1) & (day <= _DAYS_OF_MONTH[index]) & (day % 1 == 0)
    is_date &= (hour >= 0) & (hour <= 24)
    if not is_date.all():
        k = int(np.argmin(is_date))
        found = f"line {lines[k]}: month {month[k]:g}, day {day[k]:g}, hour {hour[k]:g}"
        expected = "days of a year without 29 February, hours 0 to 24"
        raise InputError(path, found, expected, "leave out other days")
    days_before = (np.cumsum(_DAYS_OF_MONTH) - _DAYS_OF_MONTH)[index] + day - 1
    return days_before * 24 + _middles_of_hours(path, hour, 24)


def _sun_up_hours_file(folder: Path) -> Path | None:
    """Return honeybee's file with the hours of a results folder; None if there is none.

    The file is in the folder or in the one above it.
    """
    files = (folder / SUN_UP_HOURS, folder.absolute().parent / SUN_UP_HOURS)
    return next((file for file in files if file.is_file()), None)


def _read_grid(folder: Path, azimuths_deg: Sequence[float]) -> pd.DataFrame:
    """Read DGP or Ev of views from a results folder of honeybee-radiance.

    Return a table as `read_model_hours` does. azimuths_deg: of the views, in the file's order.
    GRID.dgp, GRID.ill or GRID.npy has a row for each sensor and a column for each sun-up hour.
    Raises InputError for other content, and if the number of views differs.
    """
    hours_file, names = _sun_up_hours_file(folder), ("*.dgp", "*.ill", "*.npy", "dgp/*.dgp")
    files = [file for name in names for file in folder.glob(name)]
    if hours_file is None or len(files) != 1 or not azimuths_deg:
        found = f"{len(files)} grids and {len(azimuths_deg)} --view-azimuth"
        expected = "one grid (.dgp, .ill, .npy), and --view-azimuth for each view, in their order"
        raise InputError(folder, found, expected, "name a folder with one grid")
    (file,) = files
    remedy = "run the simulation again"
    with input_errors(folder, "a matrix of numbers", remedy, OSError, ValueError):
        with open_to_read(file) as opened:
            values = np.load(opened) if file.suffix == ".npy" else np.loadtxt(opened, ndmin=2)
        hours = np.loadtxt(read_bytes(hours_file).decode().splitlines(), ndmin=1)
    if values.shape != (len(azimuths_deg), len(hours)):
        found = f"values of {' x '.join(map(str, values.shape))} views and hours"
        expected = f"{len(azimuths_deg)} x {len(hours)}, by --view-azimuth and the hours"
        raise InputError(file, found, expected, "repeat --view-azimuth for each sensor")
    figure = "dgp" if file.suffix.lower() == ".dgp" else "ev_lx"
    columns = pd.MultiIndex.from_tuples([(figure, azimuth % 360.0) for azimuth in azimuths_deg])
    return pd.DataFrame(_valid_figures(file, figure, values.T), hours, columns)


def hours_begun(path: Path, times: Floats, daylight: Mask) -> tuple[Array, list[str]]:
    """Return the hour of the year, 0 to 8759, in which each stated time is, [n], and notes on it.

    path: the table, for errors; times [n]: hours since the year began, such as 9.5 or 10. daylight
    [8760]: True for hours of the predicted year. If all times are integers, each names an hour by
    its beginning or its end. Both readings are compared with the daylight on the days of the table.
    The better reading is used if the other has over three times as many wrong hours (chosen).
    Raises InputError otherwise, for a time outside the year, and for a repeated hour. The notes are
    sentences.
    """
    outside = ~((times >= 0) & (times < len(daylight)))
    if outside.any():
        found = f"hour of the year {times[outside][0]:g}"
        raise InputError(path, found, "0 to 8760, in a year of 365 days", "correct the hours")
    hours, notes = np.floor(times).astype(int), []
    if not (times % 1).any():
        stated = np.zeros((2, len(daylight)), bool)  # as beginnings, as ends
        stated[0, hours] = stated[1, hours - 1] = True
        days = np.unique(hours // 24)
        wrong = (stated ^ daylight).reshape(2, -1, 24)[:, days].sum(axis=(1, 2))
        if wrong.max() < 3 * wrong.min() + 1:
            found = "integer hours that may be the beginning or the end of each hour"
            remedy = "add 0.5 to hours at which each begins, subtract 0.5 where it ends"
            raise InputError(path, found, "hours with a fraction, such as 9.5", remedy)
        is_end = int(wrong.argmin())
        hours = hours - is_end
        word = ("begins", "ends")[is_end]
        notes = [f"Integer hours in the table: each {word} then, by the daylight of the year."]
    unique, count = np.unique(hours, return_counts=True)
    if (count > 1).any():
        found = f"{count.max()} values in hour {unique[count > 1][0]} of the year"
        raise InputError(path, found, "one row an hour", "export one view, hour by hour")
    return hours, notes


def _compare_hours(
    annual: Annual, model: pd.DataFrame, zone: str, path: Path, out: Path
) -> Comparison:
    """Compare a model's hourly figures with those of the predicted year.

    model: a column for each (figure, azimuth_deg), rows by hour of the year; zone: of the year's
    standard time; path: the model's file, for errors; out: the folder of the answer. Raises
    InputError without common hours, for hours of another clock, and for a view that the year does
    not have.
    """
    row_of_hour = np.full(8760, -1)  # in the predicted year; -1: none
    row_of_hour[[hour_of_year(t, zone) for t in annual.t_utc]] = np.arange(len(annual))
    hours, notes = hours_begun(path, model.index.to_numpy(float), row_of_hour >= 0)
    is_shared = row_of_hour[hours] >= 0
    if not is_shared.any():
        raise InputError(path, "no hour of the predicted year", "daylight hours", "check hours")
    _check_night(path, model, hours, row_of_hour >= 0, zone)
    shared, columns, hours = [], model.loc[is_shared], hours[is_shared]
    for figure, azimuth_deg in columns:
        off_deg = np.abs(projection.signed_angle_deg(annual.azimuths_deg - azimuth_deg))
        if off_deg.min() > 6.0:
            expected = f"one of the views {', '.join(f'{a:g}' for a in annual.azimuths_deg)}"
            remedy = "predict that view: fieldlum predict --views 36"
            raise InputError(path, f"a view to {azimuth_deg:.0f} deg", expected, remedy)
        if off_deg[k := int(np.argmin(off_deg))] > 0.05:
            notes.append(f"View {azimuth_deg:g} deg compares with {annual.azimuths_deg[k]:g} deg.")
        of_year = annual.views[figure][:, k]
        by_hour = np.where(row_of_hour < 0, np.nan, of_year[row_of_hour])  # [8760]
        measured, modelled = by_hour[hours], columns[figure, azimuth_deg].to_numpy(float)
        notes += () if shared else _other_clock(by_hour, hours, modelled)
        ok = np.isfinite(measured) & np.isfinite(modelled)
        if ok.any():
            shared.append(SharedHours(azimuth_deg, figure, hours[ok], measured[ok], modelled[ok]))
    if not shared:
        raise InputError(path, "no value in daylight hours", "numbers in dgp or ev", "export them")
    if weather := annual.summary.inputs.get("weather"):
        notes.append(f"The year has the weather of {weather}: the model needs the same.")
    files = _write(out, [row for part in shared for row in part.rows()], _hours_png(shared))
    text = [*(part.text() for part in shared), *notes]
    return Comparison([], [part.direction() for part in shared], text, files)


def _check_night(path: Path, model: pd.DataFrame, hours: Array, daylight: Mask, zone: str) -> None:
    """Raise InputError if a model has light in many hours of the night, as with another clock.

    model, hours: its figures, and the hour of the year of its rows [n]; daylight [8760]: True for
    hours of the predicted year, in standard time of the zone.
    """
    # simplified DGP has 0.184 in the dark
    is_lit = (model > model.min() + 0.005).any(axis=1).to_numpy()
    is_lit = is_lit & np.isin(hours // 24, np.flatnonzero(daylight) // 24)
    count, at_night = is_lit.sum(), (is_lit & ~daylight[hours]).sum()
    # hours of dawn and dusk are two of a day's twelve
    if at_night > 0.25 * count:
        found = f"light at night in {at_night} of {count} hours"
        remedy = "shift its hours if they are UTC, or predict the place of the model"
        raise InputError(path, found, f"hours of standard time in {zone}", remedy)


def _other_clock(measured: Floats, hours: Array, modelled: Floats) -> Iterator[str]:
    """Yield a note for each season in which a model agrees twice as well if moved by an hour.

    measured [8760]: figures of the predicted year by hour, NaN in the dark; modelled [n]: those of
    the model, at `hours` of the year [n].
    """
    is_summer = np.isin(hours // 24, range(90, 300))  # within summer time of Europe and America
    for season, rows in (("April to October", is_summer), ("November to March", ~is_summer)):
        moved_h = np.array([0, -1, 1])
        error = np.abs(measured[(hours[rows] + moved_h[:, None]) % 8760] - modelled[rows])
        sums = error[:, np.isfinite(error).all(axis=0)].sum(axis=1)  # for each of `moved_h`
        if sums.min() < 0.5 * sums[0]:
            by = f"{moved_h[sums.argmin()]:+d} h (summer time?)"
            yield f"From {season} the table agrees twice as well if moved by {by}"


def _hours_png(shared: Sequence[SharedHours]) -> bytes:
    """Return a PNG with the difference of each view over the days and hours of the year."""
    with plot_style.styled():
        figure = plot_style.new_figure(10.0, 2.6 * len(shared))
        axes = figure.subplots(len(shared), 1, squeeze=False)[:, 0]
        for axis, part in zip(axes, shared, strict=True):
            errors = np.full(8760, np.nan)
            errors[part.hour_of_year] = part.model - part.measured
            # ends of the colour scale; a few larger errors are cut off
            top = float(np.nanpercentile(np.abs(errors), 98)) or 1.0
            image = axis.pcolormesh(errors.reshape(-1, 24).T, cmap="RdBu_r", vmin=-top, vmax=top)
            figure.colorbar(image, ax=axis, extend="both", label="model - measured")
            axis.set_title(f"{part.figure} facing {part.azimuth_deg:g} deg")
            axis.set(xlabel="day of the year", ylabel="hour, standard time")
        return png(figure)
