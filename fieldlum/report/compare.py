"""Compare what was measured with a simulation of the same room: where and when the model errs.

A model is a folder of pictures named by the slots of the session, an hourly table of DGP or
vertical illuminance (a csv or tab-separated text with hours of the year, as raytraverse's tables),
a file of DAYSIM, a results folder of honeybee-radiance (`_read_matrix`), or lines of evalglare
below the names of pictures. Pictures and evalglare's lines are compared with the captures of the
same slots, hours with the session's predicted year, which should have the model's weather file.
"""

from __future__ import annotations

import calendar
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from fieldlum.core import strict_csv
from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.files import open_to_read, read_bytes
from fieldlum.core.plot_style import new_figure, styled
from fieldlum.core.progress import progress
from fieldlum.core.records import JsonTable, Panorama, Room, parse_utc
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    direction,
    equirect_pixel,
    equirect_rays,
    signed_angle_deg,
)
from fieldlum.report.page import comparison_png, png
from fieldlum.room.scene.box_room import WALLS, wall_named
from fieldlum.room.scene.view import traced_view
from fieldlum.session import Session, write_file
from fieldlum.session.codec import write_csv
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.sky.sun import hour_of_year
from fieldlum.year.glare.picture_glare import picture_glare, valid_pixels
from fieldlum.year.glare.pictures import picture_directions, read_picture
from fieldlum.year.glare.standards import DISTURBING_DGP
from fieldlum.year.predict import Annual

if TYPE_CHECKING:
    import pandas as pd

PICTURES = (".hdr", ".exr", ".pic")
SUN_UP_HOURS = "sun-up-hours.txt"  # honeybee-radiance
# A camera is right to 5 %, a Radiance rendering of a known room to about 10 % (Mardaljevic 1995).
_ALIKE_REL = 0.10
# Surfaces that differ this many times are not materials but another view: a reflectance of 0.9 is
# six times one of 0.15.
_NO_MATERIAL = 6.0
_NOT_JUDGED = ("all", "window", "reveal", "frame")
_DAYS = np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])
_HOUR_NAMES = ("ann_hour", "hoy", "hour of year", "hour_of_year")
# Columns of other programs, in lower case, for the figures of hourly.csv; e_v is of evalglare -d,
# ev_calc of evalglare -D.
_EV = ("ev_lx", "ev", "e_v", "ev_calc", "illum", "vertical illuminance")
_FIGURES = {"dgp": "dgp", "daylight glare probability": "dgp", **dict.fromkeys(_EV, "ev_lx")}
# The name of a picture by its slot, maybe with a view; and the result of evalglare for the last.
_EVALGLARE = re.compile(
    r"(?P<slot>\d{8}T\d{6}Z)(?:[-@](?P<view>\d+(?:\.\d+)?))?|(?P<names>dgp,[\w,]+):(?P<values>.*)"
)


class Comparison(NamedTuple):
    """The result of `compare`: tables, and sentences that say where and when the model errs.

    surfaces: name, mean luminances measured_cdm2 and model_cdm2, and the median ratio of model over
    measured (of the median pixel) with its quartiles low and high, over a number of pictures.
    directions: azimuth_deg (clockwise from true north), figure (of hourly.csv), number of shared
    hours, means measured and model, mean_abs difference; over, model_over: hours of disturbing
    glare (None for Ev).
    """

    surfaces: list[JsonTable]
    directions: list[JsonTable]
    text: list[str]
    files: tuple[Path, Path]


def compare(
    session: Session,
    model: Path,
    out: Path,
    azimuths_deg: Sequence[float] = (),
    annual: Annual | None = None,
) -> Comparison:
    """Compare a model's result with a session, and write compare.csv and compare.png to `out`.

    azimuths_deg: view directions of an hourly result that does not name them, in its order,
    clockwise from true north. annual: the predicted year; None: without one. Raises InputError for
    a result that cannot be read, or that shares no picture and no hour with the session,
    NotEnoughDataError without a year for a table of hours.
    """
    if model.is_dir() and _sun_up_hours(model) is None:
        return _compare_pictures(session, model, out)
    if model.is_file() and (shared := _of_evalglare(session, model, azimuths_deg)):
        return _of_hours(shared, [], out)
    hours = read_model_hours(model, azimuths_deg)
    if annual is None:
        remedy = "run fieldlum predict with the weather file of the model"
        raise NotEnoughDataError(f"{session.root}: no predicted year; {remedy}")
    return _compare_hours(annual, hours, session.site_file().site.timezone, model, out)


def _write(out: Path, rows: Sequence[JsonTable], picture: bytes) -> tuple[Path, Path]:
    files = (out / "compare.csv", out / "compare.png")
    write_csv(files[0], rows)
    write_file(files[1], picture)
    return files


# ----------------------------------------------------------------------------------------------
# pictures


def surface_names(room: Room, height: int, heading_deg: float) -> Array:
    """Return what each pixel of a panorama mostly shows, [H, W]: "N wall", "floor", "window" ...

    height: rows H, W = 2H; heading_deg: azimuth of the centre column. The name is empty where
    neither box nor opening is, and within two pixels of an opening.
    """
    view = traced_view(room, height, heading_deg)
    names = np.full(2 * height**2, "", dtype=object)
    s, straight = view.samples, ~view.samples.mirrored
    pixel, box, axis = s.pixel[straight], s.box[straight], s.axis[straight]
    kinds = np.array([b.kind for b in view.scene.boxes], dtype=object)
    names[pixel] = np.where(kinds[box] == "wall", "reveal", kinds[box])
    for wall, (normal, side) in WALLS.items():
        plane_m = (room.width_m, room.depth_m)[normal] * side
        on = (kinds[box] == "wall") & (axis == normal)
        on &= np.abs(s.position[straight][:, normal] - plane_m) < 0.02
        names[pixel[on]] = wall_named(wall, room.wall_azimuth_deg)
    named = names.reshape(height, 2 * height)
    window = (view.sky > 0.05) | (view.plain > 0.05)
    near: Mask = np.asarray(binary_dilation(window, iterations=2), bool)
    named[near] = ""  # edges mix the window with what is next to it
    named[window] = "window"
    return named


def _compare_pictures(session: Session, model: Path, out: Path) -> Comparison:
    """Return ratios of a model's pictures to captures of the same slots; draw the three worst."""
    measured = {path.stem: path for path in session.panorama_files()}
    pictures = sorted(p for p in model.iterdir() if p.suffix.lower() in PICTURES)
    shared = [path for path in pictures if path.stem in measured]
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
        capture = read_panorama_with_sun(measured[path.stem])
        names, light, model_light, weight = _on_one_grid(capture, measured[path.stem], path, room)
        own = _of_surfaces(path.stem, names, light, model_light, weight)
        rows += own
        ratio = own[0]["ratio"]
        shown = [np.where(weight > 0, part, np.nan) for part in (light, model_light)]
        worst.append((abs(np.log(ratio)), f"{path.stem}, model {_off(ratio)}", *shown))
        worst = sorted(worst, key=lambda item: -item[0])[:3]
    surfaces = _surfaces(rows)
    _, titles, light, model_light = zip(*worst, strict=True)
    text = [*_where(surfaces), f"Largest differences: {'; '.join(titles)}."]
    picture = comparison_png(light, model_light, titles, "model")
    return Comparison(surfaces, [], text, _write(out, rows, picture))


def _labels(room: Room | None, height: int, heading_deg: float) -> Array:
    """Return the names of surfaces; without a room, of eight sectors, "above" and "below"."""
    if room is not None and room.kind == "box":
        return surface_names(room, height, heading_deg)
    altitude, azimuth = altitude_azimuth_deg(equirect_rays(height, 2 * height, heading_deg))
    sectors = np.array(["N", "NE", "E", "SE", "S", "SW", "W", "NW"], object)
    named = sectors[np.round(azimuth / 45.0).astype(int) % 8]
    return np.where(altitude > 45.0, "above", np.where(altitude < -45.0, "below", named))


def _on_one_grid(
    capture: Panorama, path: Path, model: Path, room: Room | None
) -> tuple[Array, Floats, Floats, Floats]:
    """Return, for each pixel of the model's picture [H, W]: surface, luminances, solid angle.

    path, model: of the capture and of the model's picture; room: for the names of surfaces, None
    for no names. The luminances are those of the capture and of the model. The solid angle is 0
    where one of the pictures has no value, and around the sun.
    """
    picture = read_picture(model)
    model_light, _ = valid_pixels(picture.panorama, model)
    rays, weight = picture_directions(picture)
    light, _ = valid_pixels(capture, path)
    height, width = light.shape
    place = equirect_pixel(*altitude_azimuth_deg(rays), height, width, capture.heading_deg)
    row, column = (np.floor(part).astype(int) for part in place)
    at = (np.minimum(row, height - 1), column % width)
    weight = np.where(capture.seen[at], weight, 0.0)
    if picture.view is not None and picture.view.kind != "v":
        # beyond its angle a fisheye's square has no picture
        ahead = rays @ picture.view.forward
        weight = np.where(ahead > np.cos(np.radians(picture.view.horizontal_deg) / 2), weight, 0.0)
    if capture.sun is not None:
        sun = direction(capture.sun.altitude_deg, capture.sun.azimuth_deg)
        # within 2 degrees of the sun, one of the pictures may have the disc
        weight = np.where(rays @ sun > np.cos(np.radians(2.0)), 0.0, weight)
    if not (weight * light[at]).sum() > 0.0 or not (weight * model_light).sum() > 0.0:
        found, expected = "no light in the capture's directions", "the same directions in cd/m2"
        raise InputError(model, found, expected, "check VIEW, north (y axis) and unit")
    names = _labels(room, height, capture.heading_deg)
    return names[at], light[at], model_light, weight


def _of_surfaces(
    slot: str, names: Array, light: Floats, model_light: Floats, weight: Floats
) -> list[JsonTable]:
    """Return a row of compare.csv for "all", and for each surface that both pictures show.

    names, light, model_light, weight: of each pixel [H, W], the result of `_on_one_grid`. The ratio
    of a surface is that of its median pixel: a material changes it, light that leaks through a
    coarse ambient cache near a window does not.
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


def _surfaces(rows: Sequence[JsonTable]) -> list[JsonTable]:
    """Return each surface over all pictures, "all" first."""
    surfaces = []
    for name in dict.fromkeys(row["surface"] for row in rows):
        keys = ("measured_cdm2", "model_cdm2", "ratio")
        own = np.array([[row[key] for key in keys] for row in rows if row["surface"] == name])
        ratio, low, high = np.percentile(own[:, 2], (50, 25, 75)).tolist()
        means = dict(zip(keys, own.mean(axis=0).tolist(), strict=True))
        spread = {"ratio": ratio, "low": low, "high": high, "pictures": len(own)}
        surfaces.append({"name": name, **means, **spread})
    return surfaces


def _where(surfaces: Sequence[JsonTable]) -> list[str]:
    """Return sentences on the complete picture, and on the surface that differs most from it.

    A surface is named if it differs from the others by over 10 %, and three times as much as they
    do from each other. Pixels of reveals and frames mix light and dark: they are not named.
    """
    total = surfaces[0]
    text = [f"The model is {_off(total['ratio'])} in the median of {total['pictures']} pictures."]
    parts = [s for s in surfaces if s["name"] not in _NOT_JUDGED]
    if len(parts) < 3:
        return text
    ratios = np.array([s["ratio"] for s in parts])
    usual = float(np.median(ratios))
    off = np.abs(np.log(ratios / usual))
    k = int(off.argmax())
    others, name, ratio = float(np.median(np.delete(off, k))), parts[k]["name"], ratios[k]
    if others > np.log(_NO_MATERIAL) / 4 or off[k] > np.log(_NO_MATERIAL):
        text.append(
            f"Surfaces differ from each other by up to {np.exp(off[k]):.1f} times, more than "
            "materials explain: check VIEW, north (y axis), viewpoint and sun of the pictures."
        )
    elif off[k] > np.log1p(_ALIKE_REL) and off[k] > 3.0 * others:
        text.append(
            f"{name}: the model is {_off(ratio)}, other surfaces {_off(usual)}: its reflectance in "
            f"the model is probably too {'high' if ratio > usual else 'low'} (about "
            f"{ratio / usual:.2f} times the true one), or it is another material there; or, of a "
            "wall with the window, too few bounces (-ab)."
        )
    elif abs(np.log(usual)) > np.log1p(_ALIKE_REL):
        text.append("All surfaces differ alike: check the glazing's transmittance, sky and unit.")
    else:
        text.append(f"No surface differs from the others by over {100 * _ALIKE_REL:.0f} %.")
    return text


def _off(ratio: float) -> str:
    percent = 100 * (ratio - 1)
    if abs(percent) < 1:
        return "right within 1 %"
    return f"{abs(percent):.0f} % too {'bright' if percent > 0 else 'dark'}"


# ----------------------------------------------------------------------------------------------
# hours


def read_model_hours(path: Path, azimuths_deg: Sequence[float]) -> pd.DataFrame:
    """Return figures of a model: a row for each time, columns (figure, azimuth in degrees).

    The index is the stated hour of the year, a fraction within the hour or one of its ends.
    azimuths_deg: of the views, in the order of the file's columns or rows, where it does not name
    them as ``dgp@180``. Raises InputError for other content.
    """
    import pandas as pd

    if path.is_dir() or path.suffix.lower() in (".dgp", ".ill"):
        return _read_matrix(path, azimuths_deg)
    expected, remedy = "an hourly table", "export one row an hour"
    table = strict_csv.read_table(path, expected, remedy, separators="\t,")
    names = [name.lower() for name in table.names]
    strict_csv.check_names(path, names)
    columns = {name: k for k, name in enumerate(names)}
    figures: dict[tuple[str, float], Floats] = {}
    for name, k in columns.items():
        word, _, place = name.partition("@")
        word, _, unit = word.replace("[", "(").partition("(")
        if (figure := _FIGURES.get(word.strip())) is None:
            continue
        key = (figure, _azimuth(place, azimuths_deg, path))
        if unit.strip(" )]") not in ("", "lx", "lux", "-"):
            raise InputError(path, f"the column {name}", "Ev in lx, DGP 0 to 1", "convert it")
        if key in figures:
            found = f"two columns of {figure} facing {key[1]:g} deg"
            raise InputError(path, found, "one", "remove one")
        figures[key] = _values(path, figure, _numbers(table, k))
    if not figures:
        found, expected = f"columns {', '.join(table.names)[:80]}", "a column dgp or ev"
        raise InputError(path, found, expected, "rename it")
    return pd.DataFrame(figures, _times_of(table, columns))


def _azimuth(place: str, azimuths_deg: Sequence[float], path: Path) -> float:
    """Return the direction of a column: that in its name, else the only one of `azimuths_deg`."""
    if not place and len(azimuths_deg) != 1:
        found, remedy = "figures of a view without its direction", "state --view-azimuth 180"
        raise InputError(path, found, "one --view-azimuth, clockwise from true north", remedy)
    with input_errors(path, "a view such as dgp@180", "correct that name", ValueError):
        if not np.isfinite(azimuth := float(place or azimuths_deg[0])):
            raise ValueError(f"a view to {place} deg")
        return azimuth % 360.0


def _values(path: Path, figure: str, values: Floats) -> Floats:
    """Return a model's figures; DGP above 1 counts as 1, as in the predicted year."""
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
    """Return a column as numbers [n], NaN where empty. Raises InputError for another text."""
    remedy = "write numbers, or nothing"
    numbers: list[float] = []
    for line, cells in table.rows:
        where, expected = f"{table.path}: line {line}", f"numbers in {table.names[column]}"
        with input_errors(where, expected, remedy, ValueError):
            numbers.append(strict_csv.read_number(cells[column], has_codes=False))
    return np.array(numbers)


def _times_of(table: strict_csv.CsvTable, columns: dict[str, int]) -> Floats:
    """Return the hour of the year that each row states, [n]: 0 to 8760, maybe with a fraction.

    columns: the number of each column by its name in small letters. Without a column of times the
    rows must be the 8760 hours of a year.
    """
    if {"month", "day", "hour"} <= columns.keys():
        parts = np.stack([_numbers(table, columns[k]) for k in ("month", "day", "hour")])
        return _hours_of_dates(table.path, parts, [line for line, _ in table.rows])
    name = next((name for name in _HOUR_NAMES if name in columns), None)
    if name is not None:
        return _centred(table.path, _numbers(table, columns[name]), 8760)
    found = f"{len(table.rows)} rows of columns {', '.join(table.names)[:80]}"
    for cell in table.rows[0][1]:
        with suppress(ValueError):
            if (t := strict_csv.read_time(cell)) and (t.month, t.day) != (1, 1):
                found = f"rows from {cell}"
    if not found.startswith("8760"):
        expected = "month, day and hour, or hoy, or a row for each of 8760 hours from 1 January"
        raise InputError(table.path, found, expected, "export them, in standard time")
    return np.arange(8760) + 0.5


def _centred(path: Path, hours: Floats, last: int) -> Floats:
    """Return integer hours as their middles, if 0 or `last` states whether they begin or end."""
    if (hours % 1).any() or not {0, last} & set(hours.tolist()):
        return hours
    if {0, last} <= set(hours.tolist()):
        expected = f"0 to {last - 1} for hours that begin, or 1 to {last}"
        raise InputError(path, f"hours 0 and {last}", expected, "write one of the two")
    return hours + (0.5 if 0 in hours else -0.5)


def _hours_of_dates(path: Path, dates: Floats, lines: Sequence[int]) -> Floats:
    """Return the hour of the year of months, days and hours [3, n]; lines: their numbers [n]."""
    month, day, hour = dates
    index = np.isin(month, range(1, 13)) * np.nan_to_num(month).astype(int) - 1
    ok = (index >= 0) & (day >= 1) & (day <= _DAYS[index]) & (day % 1 == 0)
    ok &= (hour >= 0) & (hour <= 24)
    if not ok.all():
        k = int(np.argmin(ok))
        found = f"line {lines[k]}: month {month[k]:g}, day {day[k]:g}, hour {hour[k]:g}"
        expected = "days of a year without 29 February, hours 0 to 24"
        raise InputError(path, found, expected, "leave out other days")
    return ((np.cumsum(_DAYS) - _DAYS)[index] + day - 1) * 24 + _centred(path, hour, 24)


def _sun_up_hours(folder: Path) -> Path | None:
    """Return honeybee's file of the hours of a results folder, in it or above it; None without."""
    files = (folder / SUN_UP_HOURS, folder.absolute().parent / SUN_UP_HOURS)
    return next((file for file in files if file.is_file()), None)


def _read_matrix(path: Path, azimuths_deg: Sequence[float]) -> pd.DataFrame:
    """Read DGP or Ev of views from a file of DAYSIM (DIVA), or a folder of honeybee-radiance.

    azimuths_deg: of the views, in the file's order. DAYSIM's .dgp or .ill: lines of month, day,
    hour, and a value for each view. Of honeybee: GRID.dgp, GRID.ill or GRID.npy, a row for each
    sensor and a column for each sun-up hour.
    """
    import pandas as pd

    hours_file, files = _sun_up_hours(path) if path.is_dir() else None, [path]
    if hours_file is not None:
        names = ("*.dgp", "*.ill", "*.npy", "dgp/*.dgp")
        files = sorted(file for name in names for file in path.glob(name))
    if len(files) != 1 or not azimuths_deg:
        found = f"{len(files)} grids and {len(azimuths_deg)} --view-azimuth"
        expected = "one grid (.dgp, .ill, .npy), and --view-azimuth for each view, in their order"
        raise InputError(path, found, expected, "name a folder with one grid")
    (file,) = files
    with input_errors(path, "a matrix of numbers", "run the simulation again", OSError, ValueError):
        with open_to_read(file) as opened:
            values = np.load(opened) if file.suffix == ".npy" else np.loadtxt(opened, ndmin=2)
        if hours_file is None:
            hours = _hours_of_dates(path, np.asarray(values.T[:3]), range(1, len(values) + 1))
            values = values.T[3:]
        else:
            hours = np.loadtxt(read_bytes(hours_file).decode().splitlines(), ndmin=1)
    if values.shape != (len(azimuths_deg), len(hours)):
        found = f"values of {' x '.join(map(str, values.shape))} views and hours"
        expected = f"{len(azimuths_deg)} x {len(hours)}, by --view-azimuth and the hours"
        raise InputError(file, found, expected, "repeat --view-azimuth for each sensor")
    figure = "dgp" if file.suffix.lower() == ".dgp" else "ev_lx"
    columns = pd.MultiIndex.from_tuples([(figure, azimuth % 360.0) for azimuth in azimuths_deg])
    return pd.DataFrame(_values(file, figure, values.T), hours, columns)


def hours_begun(path: Path, times: Floats, daylight: Mask) -> tuple[Array, list[str]]:
    """Return the hour of the year, from 0, in which each stated time is, and notes on it.

    path: the table, for errors; times [n]: hours since the year began, such as 9.5 or 10.
    Integers name an hour by its beginning or its end. Both readings are compared with the hours of
    `daylight` [8760] of the predicted year, on the days of the table. The better reading is used if
    the other has three times as many wrong hours. Raises InputError otherwise, and for a repeated
    hour.
    """
    outside = ~((times >= 0) & (times < len(daylight)))
    if outside.any():
        found = f"hour of the year {times[outside][0]:g}"
        raise InputError(path, found, "0 to 8760, in a year of 365 days", "correct the hours")
    hours, note = np.floor(times).astype(int), []
    if not (times % 1).any():
        stated = np.zeros((2, len(daylight)), bool)
        stated[0, hours] = stated[1, hours - 1] = True
        days = np.unique(hours // 24)
        off_begin, off_end = (stated ^ daylight).reshape(2, -1, 24)[:, days].sum(axis=(1, 2))
        if max(off_begin, off_end) < 3 * min(off_begin, off_end) + 1:
            found = "integer hours that may be the beginning or the end of each hour"
            remedy = "add 0.5 to hours at which each begins, subtract 0.5 where it ends"
            raise InputError(path, found, "hours with a fraction, such as 9.5", remedy)
        word = "begins" if off_begin < off_end else "ends"
        hours = hours if off_begin < off_end else hours - 1
        note = [f"Integer hours in the table: each {word} then, by the daylight of the year."]
    unique, count = np.unique(hours, return_counts=True)
    if (count > 1).any():
        found = f"{count.max()} values in hour {unique[count > 1][0]} of the year"
        raise InputError(path, found, "one row an hour", "export one view, hour by hour")
    return hours, note


def _compare_hours(
    annual: Annual, model: pd.DataFrame, zone: str, path: Path, out: Path
) -> Comparison:
    """Return the differences of a model's hourly figures and those of the predicted year.

    model: a column for each (figure, azimuth [deg]), rows by hour of the year; zone: of the year's
    standard time; path: the model's file, for errors; out: the folder of the answer. Raises
    InputError without common hours, and for hours of another clock.
    """
    row_of = np.full(8760, -1)
    row_of[[hour_of_year(t, zone) for t in annual.t_utc]] = np.arange(len(annual))
    hours, note = hours_begun(path, model.index.to_numpy(float), row_of >= 0)
    both = row_of[hours] >= 0
    if not both.any():
        raise InputError(path, "no hour of the predicted year", "daylight hours", "check hours")
    # simplified DGP has 0.184 in the dark
    lit = (model > model.min() + 0.005).any(axis=1).to_numpy()
    in_year = np.isin(hours // 24, np.unique(np.flatnonzero(row_of >= 0) // 24))
    at_night = lit & in_year & ~both
    # hours of dawn and dusk are two of a day's twelve
    if at_night.sum() > 0.25 * (lit & in_year).sum():
        found = f"light at night in {at_night.sum()} of {(lit & in_year).sum()} hours"
        remedy = "shift its hours if they are UTC, or predict the place of the model"
        raise InputError(path, found, f"hours of standard time in {zone}", remedy)
    shared, columns = [], model.loc[both]
    for figure, azimuth in columns:
        off_deg = np.abs(signed_angle_deg(annual.azimuths_deg - azimuth))
        if off_deg.min() > 6.0:
            expected = f"one of the views {', '.join(f'{a:g}' for a in annual.azimuths_deg)}"
            remedy = "predict that view: fieldlum predict --views 36"
            raise InputError(path, f"a view to {azimuth:.0f} deg", expected, remedy)
        of_year = annual.views[figure][:, int(np.argmin(off_deg))]
        measured = of_year[row_of[hours[both]]]
        modelled = columns[figure, azimuth].to_numpy(float)
        by_hour = np.where(row_of < 0, np.nan, of_year[row_of])
        note += () if shared else _other_clock(by_hour, hours[both], modelled)
        ok = np.isfinite(measured) & np.isfinite(modelled)
        if ok.any():
            shared.append(_Shared(azimuth, figure, hours[both][ok], measured[ok], modelled[ok]))
    if not shared:
        raise InputError(path, "no value in daylight hours", "numbers in dgp or ev", "export them")
    if weather := annual.summary.inputs.get("weather"):
        note.append(f"The year has the weather of {weather}: the model needs the same.")
    return _of_hours(shared, note, out)


def _other_clock(measured: Floats, hours: Array, modelled: Floats) -> Iterator[str]:
    """Yield a note for each season in which a model agrees twice as well if moved by an hour.

    measured [8760], NaN in the dark; modelled [n] at `hours` of the year [n].
    """
    is_summer = np.isin(hours // 24, range(90, 300))  # within summer time of Europe and America
    for season, rows in (("April to October", is_summer), ("November to March", ~is_summer)):
        moved = np.array([0, -1, 1])
        error = np.abs(measured[(hours[rows] + moved[:, None]) % 8760] - modelled[rows])
        off = error[:, np.isfinite(error).all(axis=0)].sum(axis=1)
        if off.min() < 0.5 * off[0]:
            by = f"{moved[off.argmin()]:+d} h (summer time?)"
            yield f"From {season} the table agrees twice as well if moved by {by}"


def _of_evalglare(session: Session, path: Path, azimuths_deg: Sequence[float]) -> list[_Shared]:
    """Return DGP and Ev of captures with evalglare's; empty for a file without its results.

    path: evalglare's output for several pictures; azimuths_deg: for pictures whose view is unknown.
    """
    results = list(_EVALGLARE.finditer(strict_csv.read_text(path, "a model's table")))
    files = {file.stem: file for file in session.panorama_files()}
    rows: dict[tuple[float, str], list[tuple[float, ...]]] = {}
    slot, view, zone = "", "", session.site_file().site.timezone
    for result in results:
        slot, view = result["slot"] or slot, (result["view"] or "") if result["slot"] else view
        if not result["names"] or slot not in files:
            continue
        azimuth = _azimuth(view, azimuths_deg, path)
        (own,) = picture_glare(files[slot], [azimuth])["views"]
        hour = hour_of_year(parse_utc(slot), zone)
        with input_errors(path, "a number for each name", "run evalglare again", ValueError):
            numbers = map(float, result["values"].split())
            values = dict(zip(result["names"].lower().split(","), numbers, strict=True))
        for name in filter(_FIGURES.get, values):
            row = (hour, own[_FIGURES[name]], values[name])
            if row[1] is not None and np.isfinite(values[name]):  # None where no lens saw the view
                rows.setdefault((azimuth, _FIGURES[name]), []).append(row)
    if not rows and any(result["names"] for result in results):
        found = f"no result below the name of a capture of {session.root} that saw the view"
        remedy = "for f in *.hdr; do echo $f; evalglare -d $f; done"
        raise InputError(path, found, "20270320T193000Z-180.hdr, then its result", remedy)
    shared = []
    for (azimuth, figure), values in rows.items():
        hours, own, other = np.array(values, float).T
        other = _values(path, figure, other)
        shared.append(_Shared(azimuth, figure, hours.astype(int), own, other))
    return shared


def _of_hours(shared: Sequence[_Shared], note: Sequence[str], out: Path) -> Comparison:
    files = _write(out, [row for part in shared for row in part.rows()], _hours_png(shared))
    text = [*(part.text() for part in shared), *note]
    return Comparison([], [part.direction() for part in shared], text, files)


class _Shared(NamedTuple):
    """One figure of one view in the n hours that the year and the model share, [n] each."""

    azimuth_deg: float
    figure: str
    hour_of_year: Array
    measured: Floats
    model: Floats

    def direction(self) -> JsonTable:
        pair = (self.measured, self.model)
        over = [int((v > DISTURBING_DGP).sum()) if self.figure == "dgp" else None for v in pair]
        means = (float(v.mean()) for v in (*pair, np.abs(self.model - self.measured)))
        names = ("azimuth_deg", "figure", "hours", "measured", "model", "mean_abs")
        row = (self.azimuth_deg, self.figure, len(self.model), *means, *over)
        return dict(zip((*names, "over", "model_over"), row, strict=True))

    def rows(self) -> list[JsonTable]:
        head, hours = (self.azimuth_deg, self.figure), self.hour_of_year.tolist()
        rows = zip(hours, self.measured.round(4), self.model.round(4), strict=True)
        return [dict(zip(_Shared._fields, (*head, *row), strict=True)) for row in rows]

    def text(self) -> str:
        """Return a sentence on the month and the hour of the day in which the model errs most."""
        off = self.model - self.measured
        number, unit = ("+.3f", "") if self.figure == "dgp" else ("+.0f", " lx")

        def worst(group: Array) -> tuple[int, str]:
            """Return the group with the largest mean absolute error, and the error as a text."""
            errors = {k: float(np.abs(off[group == k]).mean()) for k in set(group.tolist())}
            k = max(errors, key=errors.__getitem__)
            return k, f"{errors[k]:{number[1:]}}{unit}"

        month, by_month = worst(np.searchsorted(np.cumsum(_DAYS), self.hour_of_year // 24, "right"))
        hour, by_hour = worst(self.hour_of_year % 24)
        return (
            f"{self.figure} facing {self.azimuth_deg:g} deg: the model is {off.mean():{number}}"
            f"{unit} in the mean; its mean absolute error is largest in "
            f"{calendar.month_name[month + 1]} ({by_month}) and from {hour}:00 to {hour + 1}:00 "
            f"({by_hour})."
        )


def _hours_png(shared: Sequence[_Shared]) -> bytes:
    """Return a picture of the difference of each view over the days and hours of the year."""
    with styled():
        figure = new_figure(10.0, 2.6 * len(shared))
        axes = figure.subplots(len(shared), 1, squeeze=False)[:, 0]
        for axis, part in zip(axes, shared, strict=True):
            grid = np.full(8760, np.nan)
            grid[part.hour_of_year] = part.model - part.measured
            reach = float(np.nanpercentile(np.abs(grid), 98)) or 1.0
            image = axis.pcolormesh(grid.reshape(-1, 24).T, cmap="RdBu_r", vmin=-reach, vmax=reach)
            figure.colorbar(image, ax=axis, extend="both", label="model - measured")
            axis.set_title(f"{part.figure} facing {part.azimuth_deg:g} deg")
            axis.set(xlabel="day of the year", ylabel="hour, standard time")
        return png(figure)
