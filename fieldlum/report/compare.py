"""Compare what was measured with a simulation of the same room: where and when the model errs.

A model is a folder of pictures named by the slots of the session, an hourly table of DGP or
vertical illuminance (a csv or tab-separated text with hours of the year, as evalglare's or
raytraverse's tables), or a results folder of honeybee-radiance (sun-up-hours.txt and a matrix
GRID.dgp or GRID.ill). Pictures are compared with the captures of the same slots, hours with the
session's predicted year, which should have the model's weather file.
"""

from __future__ import annotations

import calendar
import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from fieldlum.core.arrays import Array, Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.false_colour import COLOUR_MAP, RANGE_CDM2
from fieldlum.core.plot_style import BLUE, styled
from fieldlum.core.records import Panorama, Progress, Room, quiet
from fieldlum.core.strict_csv import CsvTable, lines_of, numbered, read_text, table_of
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    direction,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
    signed_angle_deg,
)
from fieldlum.room.scene.geometry import WALLS, wall_named
from fieldlum.room.scene.view import look
from fieldlum.session import Session, replacing
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.sky.sun import standard_time
from fieldlum.year.glare.picture_view import picture_rays
from fieldlum.year.glare.pictures import Picture, read_picture
from fieldlum.year.glare.single import seen_pixels, valid_pixels
from fieldlum.year.glare.standards import DISTURBING_DGP
from fieldlum.year.predict import Annual

PICTURES = (".hdr", ".exr", ".pic")
SUN_UP_HOURS = "sun-up-hours.txt"  # honeybee-radiance
_SAME_VIEW_DEG = 6.0  # views of model and year this close are one direction; chosen
_SUN_MARGIN_DEG = 2.0  # around the sun, where one of the pictures has the disc; chosen
# A camera is right to 5 %, a Radiance rendering of a known room to about 10 % (Mardaljevic 1995).
_ALIKE_REL = 0.10
_ODD = 3.0  # a surface whose difference is this many times that of the others is named; chosen
# Surfaces this many times apart in the median, or one of them that many times, are not materials
# but another view: a reflectance of 0.9 is six times one of 0.15. Chosen.
_UNLIKE, _NO_MATERIAL = 1.5, 6.0
_LEAST_SR = 0.005  # of a surface; about 4 degrees wide; chosen
_SAME_PLANE_M = 0.02  # a point this close to a wall's plane is on the wall, not in a reveal; chosen
_GLASS_SHARE = 0.05  # of a pixel that counts as window; chosen
_HOURS = 8760
_HOUR_NAMES = ("ann_hour", "hoy", "hour of year", "hour_of_year")
_FIGURES = {  # columns of other programs, in lower case, for the figures of hourly.csv
    "dgp": "dgp",
    "daylight glare probability": "dgp",
    "ev_lx": "ev_lx",
    "ev": "ev_lx",
    "illum": "ev_lx",
    "vertical illuminance": "ev_lx",
}


@dataclass(frozen=True, slots=True)
class Surface:
    """A surface of the room over all pictures: mean luminances [cd/m2], and model over measured.

    ratio: median over the pictures; low, high: their quartiles; pictures: their number.
    """

    name: str
    measured_cdm2: float
    model_cdm2: float
    ratio: float
    low: float
    high: float
    pictures: int


@dataclass(frozen=True, slots=True)
class Direction:
    """A figure of one view direction over the hours that model and measurement share.

    azimuth_deg: clockwise from true north; figure: of hourly.csv; measured, model: means; mean_abs:
    mean absolute difference; over, model_over: hours of disturbing glare (None for Ev).
    """

    azimuth_deg: float
    figure: str
    hours: int
    measured: float
    model: float
    mean_abs: float
    over: int | None
    model_over: int | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of `compare`: tables, and sentences that say where and when the model errs."""

    surfaces: tuple[Surface, ...]
    directions: tuple[Direction, ...]
    text: tuple[str, ...]
    files: tuple[Path, ...]


def compare(
    session: Session,
    model: Path,
    out: Path,
    azimuths_deg: Sequence[float] = (),
    annual: Annual | None = None,
    progress: Progress = quiet,
) -> Comparison:
    """Compare a model's result with a session, and write compare.csv and compare.png to `out`.

    azimuths_deg: view directions of an hourly result that does not name them, in its order,
    clockwise from true north. annual: the predicted year; None: without one. Raises InputError for
    a result that cannot be read, or that shares no picture and no hour with the session.
    """
    if model.is_dir() and not (model / SUN_UP_HOURS).is_file():
        return _compare_pictures(session, model, out, progress)
    hours = read_model_hours(model, azimuths_deg)
    if annual is None:
        raise InputError(
            session.root,
            "no predicted year",
            "a year to compare hours with",
            "run fieldlum predict with the weather file of the model",
        )
    return _compare_hours(session, annual, hours, model, out)


# ----------------------------------------------------------------------------------------------
# pictures


def surface_names(room: Room, height: int, heading_deg: float) -> Array:
    """Return what each pixel of a panorama mostly shows, [H, W]: "N wall", "floor", "window" ...

    The empty name is what neither box nor opening shows.
    """
    view = look(room, height, heading_deg)
    names = np.full(2 * height**2, "", dtype=object)
    straight = slice(view.first_mirrored)
    pixel, box, axis = view.pixel[straight], view.box[straight], view.axis[straight]
    kinds = np.array([b.kind for b in view.scene.boxes], dtype=object)
    names[pixel] = np.where(kinds[box] == "wall", "reveal", kinds[box])
    for wall, (normal, side) in WALLS.items():
        plane_m = (room.width_m, room.depth_m)[normal] * side
        on = (kinds[box] == "wall") & (axis == normal)
        on &= np.abs(view.position[straight][:, normal] - plane_m) < _SAME_PLANE_M
        names[pixel[on]] = wall_named(wall, room.wall_azimuth_deg)
    named = names.reshape(height, 2 * height)
    named[(view.sky > _GLASS_SHARE) | (view.plain > _GLASS_SHARE)] = "window"
    return named


def _compare_pictures(session: Session, model: Path, out: Path, progress: Progress) -> Comparison:
    measured = {path.stem: path for path in session.panorama_files()}
    pictures = sorted(p for p in model.iterdir() if p.suffix.lower() in PICTURES)
    shared = [path for path in pictures if path.stem in measured]
    if not shared:
        raise InputError(
            model,
            f"{len(pictures)} pictures, none named as a capture of {session.root}",
            "pictures named by slots, such as 20270320T193000Z.hdr",
            "name each picture by the slot whose sun and sky it has (fieldlum status lists them)",
        )
    if twice := [path for k, path in enumerate(shared[1:]) if path.stem == shared[k].stem]:
        raise InputError(
            twice[0], f"a second picture of {twice[0].stem}", "one for each slot", "remove one"
        )
    room = session.site_file().room
    names: dict[tuple[int, float], Array] = {}
    rows: list[dict[str, Any]] = []
    worst: tuple[float, Any] = (-1.0, None)
    for number, path in enumerate(shared):
        progress(number, len(shared), "pictures")
        capture = read_panorama_with_sun(measured[path.stem])
        light, model_light, weight = _on_one_grid(capture, measured[path.stem], path)
        key = (light.shape[0], capture.heading_deg)
        if key not in names:
            names[key] = _labels(room, *key)
        of_picture = _of_surfaces(path.stem, names[key], light, model_light, weight)
        rows += of_picture
        off = abs(np.log((weight * model_light).sum() / (weight * light).sum()))
        if off > worst[0]:
            worst = (off, (path.stem, light, np.where(weight > 0, model_light, np.nan)))
    surfaces = _surfaces(rows)
    text = [*_where(surfaces), *_when(rows)]
    table, picture = out / "compare.csv", out / "compare.png"
    _write_rows(table, rows)
    _draw_pictures(picture, surfaces, *worst[1])
    return Comparison(surfaces, (), tuple(text), (table, picture))


def _labels(room: Room | None, height: int, heading_deg: float) -> Array:
    """Return the names of surfaces; without a room, of eight sectors, "above" and "below"."""
    if room is not None and room.kind == "box":
        return surface_names(room, height, heading_deg)
    altitude, azimuth = altitude_azimuth_deg(equirect_rays(height, 2 * height, heading_deg))
    sectors = np.array(["N", "NE", "E", "SE", "S", "SW", "W", "NW"], object)
    named = sectors[np.round(azimuth / 45.0).astype(int) % 8]
    return np.where(altitude > 45.0, "above", np.where(altitude < -45.0, "below", named))


def _on_one_grid(capture: Panorama, path: Path, model: Path) -> tuple[Floats, Floats, Floats]:
    """Return luminances [H, W] of a capture and of the model in its directions, and solid angles.

    The solid angle is 0 where one of the pictures has no value, and around the sun.
    """
    light, _ = valid_pixels(capture, path)
    height, width = light.shape
    rays = equirect_rays(height, width, capture.heading_deg)
    weight = equirect_solid_angles(height, width).astype(float)
    seen = seen_pixels(capture)
    if seen is not None:
        weight[~seen] = 0.0
    picture = read_picture(model)
    model_light, inside = _at_rays(picture, model, rays)
    weight[~inside] = 0.0
    if capture.sun is not None:
        sun = direction(capture.sun.altitude_deg, capture.sun.azimuth_deg)
        weight[rays @ sun > np.cos(np.radians(_SUN_MARGIN_DEG))] = 0.0
    if not (weight * light).sum() > 0.0 or not (weight * model_light).sum() > 0.0:
        raise InputError(
            model,
            "no light in the directions of the capture",
            "a picture of the same directions in cd/m2",
            "check its VIEW, its north (y axis) and its unit",
        )
    return light, model_light, weight


def _at_rays(picture: Picture, path: Path, rays: Floats) -> tuple[Floats, Array]:
    """Return the luminance of a picture in directions [H, W, 3], and where it has one."""
    pixels, _ = valid_pixels(picture.panorama, path)
    height, width = pixels.shape
    if picture.view is None:
        place = equirect_pixel(
            *altitude_azimuth_deg(rays), height, width, picture.panorama.heading_deg
        )
        row, column = (np.floor(part).astype(int) for part in place)
        return pixels[np.clip(row, 0, height - 1), column % width], np.ones(rays.shape[:2], bool)
    x, y = (np.arange(width) + 0.5) / width - 0.5, 0.5 - (np.arange(height) + 0.5) / height
    parts, density = picture_rays(picture.view, x[None, :], y[:, None])
    distance, nearest = KDTree((parts @ picture.view.frame).reshape(-1, 3)).query(rays)
    inside = (distance < np.pi / rays.shape[0]) & (density.ravel()[nearest] > 0)
    if picture.view.kind != "v":  # beyond its angle a fisheye's square has no picture
        half = np.radians(picture.view.horizontal_deg) / 2
        inside &= rays @ picture.view.forward > np.cos(half - np.pi / rays.shape[0])
    return pixels.ravel()[nearest], inside


def _of_surfaces(
    slot: str, names: Array, light: Floats, model_light: Floats, weight: Floats
) -> list[dict[str, Any]]:
    """Return a row of compare.csv for each surface that both pictures show, and for "all"."""
    rows = []
    for name in ("all", *sorted(set(names.ravel()) - {""})):
        w = weight if name == "all" else np.where(names == name, weight, 0.0)
        if w.sum() < _LEAST_SR:
            continue
        measured, model = (float((w * a).sum() / w.sum()) for a in (light, model_light))
        rows.append(
            {
                "slot": slot,
                "surface": name,
                "measured_cdm2": round(measured, 2),
                "model_cdm2": round(model, 2),
                "ratio": max(round(model / max(measured, 1e-6), 4), 1e-4),
            }
        )
    return rows


def _surfaces(rows: Iterable[dict[str, Any]]) -> tuple[Surface, ...]:
    """Return each surface over all pictures, "all" first."""
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["surface"], []).append(row)
    out = []
    for name, own in by_name.items():
        low, middle, high = np.percentile([row["ratio"] for row in own], (25, 50, 75))
        measured, model = (
            float(np.mean([row[k] for row in own])) for k in ("measured_cdm2", "model_cdm2")
        )
        out.append(Surface(name, measured, model, float(middle), float(low), float(high), len(own)))
    return tuple(out)


def _where(surfaces: Sequence[Surface]) -> list[str]:
    """Return sentences on the complete picture, and on the surface that differs most from it."""
    total = next(s for s in surfaces if s.name == "all")
    text = [f"The model is {_off(total.ratio)} in the median of {total.pictures} pictures."]
    parts = [s for s in surfaces if s.name not in ("all", "window")]
    if len(parts) < 3:
        return text
    usual = float(np.median([s.ratio for s in parts]))
    odd = max(parts, key=lambda s: abs(np.log(s.ratio / usual)))
    others = [abs(np.log(s.ratio / usual)) for s in parts if s is not odd]
    excess = abs(np.log(odd.ratio / usual))
    if float(np.median(others)) > np.log(_UNLIKE) or excess > np.log(_NO_MATERIAL):
        times = np.exp(max(excess, float(np.median(others))))
        text.append(
            f"Surfaces differ from each other by up to {times:.1f} times, more than materials "
            "explain: check VIEW, north (y axis), viewpoint and sun of the pictures first."
        )
    elif excess > np.log1p(_ALIKE_REL) and excess > _ODD * max(float(np.median(others)), 1e-3):
        word = "high" if odd.ratio > usual else "low"
        text.append(
            f"{odd.name}: the model is {_off(odd.ratio)}, other surfaces {_off(usual)}: its "
            f"reflectance in the model is probably too {word} (about {odd.ratio / usual:.2f} "
            "times the true one), or it is another material there."
        )
    elif abs(np.log(usual)) > np.log1p(_ALIKE_REL):
        text.append(
            "All surfaces differ alike: look for the glazing's transmittance, the sky or the unit."
        )
    else:
        text.append(f"No surface differs from the others by over {100 * _ALIKE_REL:.0f} %.")
    return text


def _off(ratio: float) -> str:
    percent = 100 * (ratio - 1)
    if abs(percent) < 1:
        return "right within 1 %"
    return f"{abs(percent):.0f} % too {'bright' if percent > 0 else 'dark'}"


def _when(rows: Iterable[dict[str, Any]]) -> list[str]:
    """Return a sentence that names the pictures with the largest differences."""
    totals = [row for row in rows if row["surface"] == "all"]
    totals.sort(key=lambda row: -abs(np.log(max(row["ratio"], 1e-6))))
    named = ", ".join(f"{row['slot']} ({_off(row['ratio'])})" for row in totals[:3])
    return [f"Largest differences: {named}."]


def _draw_pictures(
    path: Path, surfaces: Sequence[Surface], slot: str, light: Floats, model_light: Floats
) -> None:
    """Draw the capture that differs most, the model's picture, their ratio, and the surfaces."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    with styled():
        figure = Figure(figsize=(12.0, 6.4), dpi=120, layout="constrained")
        axes = figure.subplots(2, 2).ravel()
        ratio = model_light / np.maximum(light, 1e-3)
        shown = (
            (f"measured {slot}", light, LogNorm(*RANGE_CDM2), COLOUR_MAP, "cd/m²"),
            ("model", model_light, LogNorm(*RANGE_CDM2), COLOUR_MAP, "cd/m²"),
            ("model over measured", ratio, LogNorm(0.5, 2.0), "RdBu_r", ""),
        )
        for axis, (title, values, norm, colours, unit) in zip(axes, shown, strict=False):
            image = axis.imshow(np.maximum(values, 1e-3), norm=norm, cmap=colours)
            figure.colorbar(image, ax=axis, shrink=0.7, extend="both").set_label(unit)
            axis.set_title(title)
            axis.set_axis_off()
        parts = sorted((s for s in surfaces), key=lambda s: s.ratio)
        spread = np.array([(s.ratio - s.low, s.high - s.ratio) for s in parts]).T
        axes[3].barh(
            [s.name for s in parts],
            [s.ratio for s in parts],
            color=BLUE,
            xerr=np.maximum(spread, 0),
        )
        axes[3].axvline(1.0, color="black", linewidth=0.8)
        axes[3].set_xlabel("model over measured: median and quartiles of the pictures")
        figure.savefig(path, format="png")


# ----------------------------------------------------------------------------------------------
# hours


@dataclass(frozen=True, slots=True)
class ModelHours:
    """Figures of a model for some hours of a year, [n, d] each, NaN where there is none.

    hour_of_year: [n], from 0, standard time, of the hour's start. azimuths_deg: [d].
    """

    hour_of_year: Array
    azimuths_deg: Floats
    figures: dict[str, Floats]


def read_model_hours(path: Path, azimuths_deg: Sequence[float]) -> ModelHours:
    """Read an hourly table, or a results folder of honeybee-radiance.

    azimuths_deg: of the views, in the order of the file's columns or rows, where it does not name
    them as ``dgp@180``. Raises InputError for other content.
    """
    if path.is_dir():
        return _read_honeybee(path, azimuths_deg)
    lines = numbered(lines_of(read_text(path, "an hourly table", "export one row an hour")))
    if not lines:
        raise InputError(path, "an empty file", "an hourly table", "export one row an hour")
    table = table_of(path, lines, "\t" if "\t" in lines[0][1] else ",")
    columns = {name.lower(): k for k, name in enumerate(table.names)}
    hours = _hours_of(table, columns)
    found: dict[str, dict[float, Floats]] = {}
    for name, k in columns.items():
        word, _, place = name.partition("@")
        figure = _FIGURES.get(word.split("[")[0].split("(")[0].strip())
        if figure is not None:
            azimuth = _azimuth(place, path) if place else _sole(azimuths_deg, path)
            by_azimuth = found.setdefault(figure, {})
            if azimuth in by_azimuth:
                twice = f"two columns of {figure} facing {azimuth:g} deg"
                raise InputError(path, twice, "one", "remove one")
            by_azimuth[azimuth] = _values(path, figure, _numbers(table, k))
    if not found:
        raise InputError(
            path, f"columns {', '.join(table.names)[:80]}", "a column dgp or ev", "rename it"
        )
    azimuths = sorted({a for by_azimuth in found.values() for a in by_azimuth})
    blank = np.full(len(hours), np.nan)
    return ModelHours(
        hours,
        np.array(azimuths),
        {name: np.stack([of.get(a, blank) for a in azimuths], 1) for name, of in found.items()},
    )


def _azimuth(text: str, path: Path) -> float:
    with input_errors(path, "a view such as dgp@180", "correct that name", ValueError):
        if not np.isfinite(azimuth := float(text)):
            raise ValueError(f"a view to {text} deg")
        return azimuth % 360.0


def _values(path: Path, figure: str, values: Floats) -> Floats:
    """Return a model's figures; DGP above 1 counts as 1, as in the predicted year."""
    known = values[np.isfinite(values)]
    name = {"dgp": "DGP", "ev_lx": "Ev"}[figure]
    if (known < 0).any():
        found = f"{name} of {known.min():g}"
        raise InputError(path, found, "0 or more", "write nothing for an hour without a value")
    if figure != "dgp":
        return values
    if len(known) and np.median(known) > 1.0:
        found = f"DGP of {np.median(known):g} in the median"
        raise InputError(path, found, "0 to 1", "divide percent by 100")
    return np.minimum(values, 1.0)


def _sole(azimuths_deg: Sequence[float], path: Path) -> float:
    if len(azimuths_deg) != 1:
        raise InputError(
            path,
            "figures of a view without its direction",
            "one --view-azimuth",
            "state the direction of the view, clockwise from true north: --view-azimuth 180",
        )
    return azimuths_deg[0] % 360.0


def _hours_of(table: CsvTable, columns: dict[str, int]) -> Array:
    """Return the hour of the year at which each row's hour starts, [n]."""
    name = next((name for name in _HOUR_NAMES if name in columns), None)
    if name is not None:
        return _whole_hours(table.path, _numbers(table, columns[name]))
    if not {"month", "day", "hour"} <= columns.keys():
        raise InputError(
            table.path,
            f"columns {', '.join(table.names)[:80]}",
            "month, day and hour, or hoy",
            "export them, in standard time",
        )
    month, day, hour = (_numbers(table, columns[k]) for k in ("month", "day", "hour"))
    days = np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])
    index = np.where((month >= 1) & (month <= 12), month, 1).astype(int) - 1
    ok = (index + 1 == month) & (day >= 1) & (day <= days[index]) & (day % 1 == 0)
    ok &= (hour >= 0) & (hour < 24)
    if not ok.all():
        (line, _), k = table.rows[int(np.argmin(ok))], int(np.argmin(ok))
        raise InputError(
            table.path,
            f"line {line}: month {month[k]:g}, day {day[k]:g}, hour {hour[k]:g}",
            "days of a year without 29 February, hours 0 to 23 at which each hour begins",
            "leave out other days; subtract 1 from hours 1 to 24",
        )
    first = np.cumsum(days) - days
    return _whole_hours(table.path, (first[index] + day - 1) * 24 + hour)


def _whole_hours(path: Path, hours: Floats) -> Array:
    """Return the hour in which each time is, once each, in a year of 365 days from 0."""
    start = np.floor(hours)
    outside = ~((start >= 0) & (start < _HOURS))
    if outside.any():
        raise InputError(
            path,
            f"hour of the year {hours[outside][0]:g}",
            f"0 to {_HOURS - 1} at which each hour begins, in a year of 365 days",
            "correct the hours; subtract 1 from hours 1 to 8760",
        )
    unique, count = np.unique(start, return_counts=True)
    if (count > 1).any():
        twice = unique[count > 1][0]
        found = f"{count.max()} values in hour {twice:g} of the year"
        raise InputError(path, found, "one row an hour", "export one view, hour by hour")
    return start.astype(int)


def _numbers(table: CsvTable, column: int) -> Floats:
    remedy = "write numbers, or nothing"
    with input_errors(table.path, f"numbers in {table.names[column]}", remedy, ValueError):
        return np.array([float(cells[column] or "nan") for _, cells in table.rows])


def _read_honeybee(folder: Path, azimuths_deg: Sequence[float]) -> ModelHours:
    """Read GRID.dgp or GRID.ill (a row for each sensor, a column for each sun-up hour)."""
    files = sorted((*folder.glob("*.dgp"), *folder.glob("*.ill")))
    if len(files) != 1 or not azimuths_deg:
        raise InputError(
            folder,
            f"{len(files)} files .dgp or .ill and {len(azimuths_deg)} --view-azimuth",
            "one grid, and --view-azimuth for each of its sensors, in their order",
            "name a folder with one grid, and its view directions",
        )
    with input_errors(folder, "a matrix of numbers", "run the recipe again", ValueError):
        hours = np.loadtxt(folder / SUN_UP_HOURS, ndmin=1)
        values = np.loadtxt(files[0], ndmin=2)
    if values.shape != (len(azimuths_deg), len(hours)):
        raise InputError(
            files[0],
            f"{values.shape[0]} sensors x {values.shape[1]} hours",
            f"{len(azimuths_deg)} x {len(hours)}, by --view-azimuth and {SUN_UP_HOURS}",
            "repeat --view-azimuth for each sensor",
        )
    figure = "dgp" if files[0].suffix == ".dgp" else "ev_lx"
    azimuths = np.asarray(azimuths_deg, float) % 360.0
    by_hour = _values(files[0], figure, values.T)
    return ModelHours(_whole_hours(folder / SUN_UP_HOURS, hours), azimuths, {figure: by_hour})


def _compare_hours(
    session: Session, annual: Annual, model: ModelHours, path: Path, out: Path
) -> Comparison:
    zone = session.site_file().site.timezone
    own = [_hour_of_year(t, zone) for t in annual.t_utc]
    row_of = {hour: k for k, hour in enumerate(own)}
    pairs = [(k, row_of[h]) for k, h in enumerate(model.hour_of_year.tolist()) if h in row_of]
    if not pairs:
        raise InputError(path, "no hour of the predicted year", "daylight hours", "check hours")
    theirs, ours = (np.array(part) for part in zip(*pairs, strict=True))
    shared = []
    for d, azimuth in enumerate(model.azimuths_deg.tolist()):
        off = np.abs(signed_angle_deg(annual.azimuths_deg - azimuth))
        if off.min() > _SAME_VIEW_DEG:
            raise InputError(
                path,
                f"a view to {azimuth:.0f} deg",
                f"one of the predicted views: {', '.join(f'{a:g}' for a in annual.azimuths_deg)}",
                "predict that view: fieldlum predict --views 36",
            )
        v = int(np.argmin(off))
        for figure, values in model.figures.items():
            measured, modelled = annual.views[figure][ours, v], values[theirs, d]
            ok = np.isfinite(measured) & np.isfinite(modelled)
            hours = model.hour_of_year[theirs][ok]
            shared.append(_Shared(azimuth, figure, hours, measured[ok], modelled[ok]))
    shared = [part for part in shared if len(part.hour_of_year)]
    if not shared:
        raise InputError(path, "no value in daylight hours", "numbers in dgp or ev", "export them")
    table, picture = out / "compare.csv", out / "compare.png"
    _write_rows(table, [row for part in shared for row in part.rows()])
    _draw_hours(picture, shared)
    text = [sentence for part in shared for sentence in part.text()]
    if weather := annual.summary.inputs.get("weather"):
        text.append(f"The year has the weather of {weather}: the model needs the same.")
    directions = tuple(part.direction() for part in shared)
    return Comparison((), directions, tuple(text), (table, picture))


def _hour_of_year(t: datetime, zone: str) -> int:
    """Return the hour of a year of 365 days in which a time is, in standard time, from 0."""
    local = standard_time(t, zone)
    day = min(local.day, 28) if local.month == 2 else local.day
    return (date(2001, local.month, day) - date(2001, 1, 1)).days * 24 + local.hour


class _Shared(NamedTuple):
    """One figure of one view in the n hours that the year and the model share, [n] each."""

    azimuth_deg: float
    figure: str
    hour_of_year: Array
    measured: Floats
    model: Floats

    def direction(self) -> Direction:
        over = model_over = None
        if self.figure == "dgp":
            over, model_over = (
                int((v > DISTURBING_DGP).sum()) for v in (self.measured, self.model)
            )
        return Direction(
            self.azimuth_deg,
            self.figure,
            len(self.hour_of_year),
            float(self.measured.mean()),
            float(self.model.mean()),
            float(np.abs(self.model - self.measured).mean()),
            over,
            model_over,
        )

    def rows(self) -> list[dict[str, Any]]:
        return [
            {
                "azimuth_deg": self.azimuth_deg,
                "figure": self.figure,
                "hour_of_year": int(hour),
                "measured": round(float(own), 4),
                "model": round(float(theirs), 4),
            }
            for hour, own, theirs in zip(self.hour_of_year, self.measured, self.model, strict=True)
        ]

    def text(self) -> list[str]:
        """Return a sentence on the months and hours in which the model errs most."""
        off = self.model - self.measured
        unit = "" if self.figure == "dgp" else " lx"
        start = np.datetime64("2001-01-01T00") + self.hour_of_year.astype("timedelta64[h]")
        month = start.astype("datetime64[M]").astype(int) % 12
        worst_month = max(set(month.tolist()), key=lambda m: np.abs(off[month == m]).mean())
        of_day = self.hour_of_year % 24
        worst_hour = max(set(of_day.tolist()), key=lambda h: np.abs(off[of_day == h]).mean())
        digits = ".3f" if self.figure == "dgp" else ".0f"
        by_month, by_hour = off[month == worst_month].mean(), off[of_day == worst_hour].mean()
        return [
            f"{self.figure} facing {self.azimuth_deg:g} deg: the model is {off.mean():+{digits}}"
            f"{unit} in the mean; most in {calendar.month_name[worst_month + 1]} "
            f"({by_month:+{digits}}{unit}) and from {worst_hour}:00 to {worst_hour + 1}:00 "
            f"({by_hour:+{digits}}{unit})."
        ]


def _draw_hours(path: Path, shared: Sequence[_Shared]) -> None:
    """Draw the difference of each view over the days and hours of the year."""
    from matplotlib.figure import Figure

    with styled():
        figure = Figure(figsize=(10.0, 2.6 * len(shared)), dpi=120, layout="constrained")
        axes = figure.subplots(len(shared), 1, squeeze=False)[:, 0]
        for axis, part in zip(axes, shared, strict=True):
            grid = np.full((24, 365), np.nan)
            grid[part.hour_of_year % 24, part.hour_of_year // 24 % 365] = part.model - part.measured
            reach = float(np.nanpercentile(np.abs(grid), 98)) or 1.0
            extent = (0, 365, 0, 24)
            image = axis.imshow(
                grid,
                cmap="RdBu_r",
                vmin=-reach,
                vmax=reach,
                aspect="auto",
                origin="lower",
                extent=extent,
            )
            figure.colorbar(image, ax=axis, extend="both").set_label("model - measured")
            axis.set_title(f"{part.figure} facing {part.azimuth_deg:g} deg")
            axis.set_xlabel("day of the year")
            axis.set_ylabel("hour, standard time")
        figure.savefig(path, format="png")


def _write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, list(rows[0]))
        out.writeheader()
        out.writerows(rows)
