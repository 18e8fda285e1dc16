"""Pairs, models and years of the Python API."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.api.measurement import path_of, place
from fieldlum.core.errors import Caution, InputError, input_errors, require_name
from fieldlum.core.records import Site, SiteFile, parse_utc
from fieldlum.core.strict_csv import IRRADIANCE_LIMITS_WM2
from fieldlum.session import Session
from fieldlum.sky import daylight, sun
from fieldlum.sky.daylight import Light
from fieldlum.year.glare.sources import view_azimuths_deg

if TYPE_CHECKING:
    import xarray as xr

    from fieldlum.learn.models import Fitted, Patch
    from fieldlum.learn.models.training_data import Dataset
    from fieldlum.year.predict import Annual
    from fieldlum.year.predict.hour_blocks import ModelRoom


@dataclass(frozen=True, slots=True, repr=False)
class RoomModel:
    """A fitted model of a room: `predict` returns its maps, `glare` the figures of glare.

    Both give what `fieldlum predict` gives. fitted: the model itself; room: its site, mirrors and
    sky view.
    """

    fitted: Fitted
    room: ModelRoom

    @property
    def name(self) -> str:
        """Name of the kind of model, such as "transport"."""
        return self.fitted.name

    @property
    def parameters(self) -> int:
        """Number of fitted values."""
        return self.fitted.parameters

    def __repr__(self) -> str:
        """Return name, site, number of parameters, map size and heading as a text."""
        room = self.room
        return (
            f"<model {self.name} of {room.setup.site.name}: {self.parameters:,} parameters, maps "
            f"of {room.width} x {room.height} px, heading {room.heading_deg:g} deg>"
        )

    def predict(self, light: Light) -> xr.Dataset:
        """Return maps over (time, y, x), with altitude y and azimuth x in degrees.

        light: of the hours, from `light_at`. Variables: luminance_cdm2 without the sun's disc;
        log10_sd, the standard deviation of its log10, only if the model states it. Over time:
        disc_lx (illuminance of the visible disc on a plane normal to the sun), sun_altitude_deg
        (apparent, as in pictures), sun_azimuth_deg, trusted, and expected_log10_mse (NaN if the
        model does not state it). Memory grows with the number of hours: 0.4 MB for one at 460 x
        230. Raises InputError if `light` is not from `light_at`.
        """
        import xarray as xr

        from fieldlum.year.predict.annual import unit_of
        from fieldlum.year.predict.hour_blocks import blocks, map_coordinates

        parts = list(blocks(self.fitted, self.room, self._checked(light)))
        heading_deg = self.room.heading_deg
        maps = {"luminance_cdm2": [part.pictures_cdm2(heading_deg) for part in parts]}
        spreads = [part.prediction.log10_sd for part in parts]  # all None, or none is
        if not any(spread is None for spread in spreads):
            maps["log10_sd"] = [spread for spread in spreads if spread is not None]
        hours = {
            "disc_lx": [part.disc_lx for part in parts],
            "sun_altitude_deg": [light.apparent_altitude_deg],
            "sun_azimuth_deg": [light.sun_azimuth_deg],
            "trusted": [part.trusted for part in parts],
            "expected_log10_mse": [part.prediction.expected_mse for part in parts],
        }
        dimensions = dict.fromkeys(maps, ("time", "y", "x")) | dict.fromkeys(hours, ("time",))
        variables = {
            name: (dimensions[name], np.concatenate(values), {"units": unit_of(name)})
            for name, values in (maps | hours).items()
        }
        return xr.Dataset(
            variables,
            coords=map_coordinates(light.t_utc, self.room.height, heading_deg),
            attrs={"heading_deg": heading_deg, "site": self.room.setup.site.name},
        )

    def glare(self, light: Light, views: int = 10) -> xr.Dataset:
        """Return figures of the hours, and of glare over (time, azimuth), with the sun's disc.

        light: of the hours, from `light_at`. views: number of view directions, at equal steps from
        the model's heading. Variables: `HOUR_COLUMNS` and `VIEW_COLUMNS` of
        `fieldlum.session.files.hourly_csv`, among them dgp and ev_lx, with units as attributes; the
        azimuth is clockwise from true north. dgp_low and dgp_high are the 95 % interval by the
        model's error, by unseen parts of the view, and by what the sky view leaves open about the
        disc; u_dgp is the standard uncertainty. Raises InputError if `light` is not from
        `light_at`.
        """
        from fieldlum.year.predict.annual import dataset_of
        from fieldlum.year.predict.hour_blocks import room_figures

        azimuths_deg = view_azimuths_deg(self.room.heading_deg, views)
        figures = room_figures(self.fitted, self.room, self._checked(light), azimuths_deg)
        hours = {name: v for name, v in figures.hours.items() if name != "occupied"}
        terms = ("contrast", "sun_contrast", "sun_ev_lx")  # of the sum in DGP; no metrics
        metrics = {name: v for name, v in figures.views.items() if name not in terms}
        return dataset_of(light.t_utc, azimuths_deg, hours, metrics)

    @staticmethod
    def _checked(light: Light) -> Light:
        """Return the light; raise InputError if it is of another type or has no hour."""
        if not isinstance(light, Light) or not len(light):
            expected = "one hour or more from fieldlum.light_at"
            raise InputError("light", f"{light!r:.60}", expected, "call it first")
        return light


def load_pairs(
    pairs: Session | str | Path, site: str | Path | None = None, *, scene: str = ""
) -> Dataset:
    """Read captured hours with their irradiance for training, as `fieldlum train` does.

    Parameters
    ----------
    pairs
        A session, its folder, or a pairs.csv with its pictures (docs/file-formats.md).
    site
        A SITE.toml; None: the session's, or site.toml in the folder of the csv.
    scene
        A folder that `fieldlum scene fit` wrote; "none" ignores any scene; "" uses scene/ next to
        the pairs, if it exists.

    Returns
    -------
    Dataset
        `luminance_cdm2` [n, H, 2H] without the sun's disc, `disc_lx` [n] (illuminance of the disc
        at the lens, on a plane normal to the sun), `light` (irradiance and sun angles of the n
        hours), `patch_cdm2` [n, H, 2H] (luminance by direct sun on surfaces) or None.

    Raises
    ------
    InputError
        A file is missing, a cell (the error names its line), a picture or a scene cannot be read,
        or the scene was fitted to captures of another heading or room.
    NotEnoughDataError
        No usable row is in the file, or the session has no pairs.csv.

    Examples
    --------
    >>> data = fieldlum.load_pairs("office-2027")
    >>> data.luminance_cdm2.shape
    (108, 230, 460)
    """
    from fieldlum.learn.models import training_data
    from fieldlum.room.fit.apply_scene import apply_scene

    source = pairs.root if isinstance(pairs, Session) else path_of(pairs, "pairs")
    stated = None if site is None else path_of(site, "site")
    captures = training_data.with_sky_view(training_data.load_pairs(source, stated))
    return apply_scene(captures, source, scene, "absolute")[0]


def fit(
    data: Dataset,
    model: str = "auto",
    *,
    patch: Patch = "absolute",
    budget_min: float = 10.0,
    seed: int = 0,
    out: str | Path | None = None,
) -> RoomModel:
    """Fit a model of the room to captured hours; its warnings are `Caution`.

    Parameters
    ----------
    data
        From `load_pairs`.
    model
        ``auto`` chooses on held-out days; or the name of one: ``transport``, ``dense``,
        ``nearest`` or ``mean``.
    patch
        Sun patches in cd/m2 (``absolute``), up to an unknown factor (``gain``), or not used
        (``none``).
    budget_min
        Time for the dense network. [min]
    seed
        Seed of everything random; it is stored in the model folder.
    out
        A model folder for weights.npz, config.json and scores.json; None keeps nothing. If it has a
        model of the same data and options, this is read again and nothing is trained.

    Returns
    -------
    RoomModel
        As from `load_model`; `parameters` is the number of values in the model.

    Raises
    ------
    NotEnoughDataError
        Fewer than two usable hours, or too few hours or too little time for the named model.
    InputError
        `data` is not the result of `load_pairs`, its room is impossible, `out` cannot be written,
        or `model` or `patch` is not one of the names that the error lists.

    Examples
    --------
    >>> model = fieldlum.fit(fieldlum.load_pairs("office-2027"), out="office-2027/models/auto")
    >>> model.name
    'transport'
    """
    from fieldlum.learn import train
    from fieldlum.learn.model_kinds import MODELS
    from fieldlum.learn.models import Patch
    from fieldlum.learn.models.training_data import Dataset

    if not isinstance(data, Dataset):
        raise InputError("data", f"{data!r:.60}", "pairs from fieldlum.load_pairs", "call it first")
    require_name("model", model, ("auto", *MODELS))
    require_name("patch", patch, get_args(Patch))
    with nullcontext(out) if out is not None else TemporaryDirectory() as where:
        folder = path_of(where, "out")
        told = train.run(data, model, budget_min=budget_min, patch=patch, seed=seed, out=folder)
        for note in told["notes"]:
            if note.startswith("WARNING"):
                warnings.warn(note.removeprefix("WARNING: "), Caution, stacklevel=2)
        return load_model(folder)


def load_model(folder: str | Path) -> RoomModel:
    """Read a fitted model, with its room.

    Parameters
    ----------
    folder
        A model folder that `fit` or `fieldlum train` wrote.

    Returns
    -------
    RoomModel
        `predict(light)` returns maps over (time, y, x) in cd/m2 with uncertainty, and the sun's
        disc; `glare(light)` DGP, Ev and more over (time, azimuth). Both are xarray.Datasets with
        coordinates and units, and give what `fieldlum predict` gives.

    Raises
    ------
    InputError
        The folder has no model, or its weights do not match its config.json.

    Examples
    --------
    >>> model = fieldlum.load_model("office-2027/models/auto")
    >>> light = fieldlum.light_at("2027-06-21T20:30Z", "office.toml", 800.0, 120.0)
    >>> model.predict(light).luminance_cdm2.isel(time=0).plot()
    >>> model.glare(light).dgp.sel(azimuth=180.0).item()
    0.31
    """
    from fieldlum.learn.models import load, read_config
    from fieldlum.year.predict.hour_blocks import room_of

    path = path_of(folder, "folder")
    return RoomModel(load(path), room_of(read_config(path), path))


def light_at(
    times_utc: datetime | str | Iterable[datetime | str],
    site: SiteFile | Site | Session | str | Path,
    dni_wm2: ArrayLike,
    dhi_wm2: ArrayLike,
) -> Light:
    """Describe the light outside at some moments, for the model's `predict` and `glare`.

    Parameters
    ----------
    times_utc
        One moment or n: datetimes with a time zone, ISO texts such as ``2027-06-21T20:30Z``, or a
        pandas.DatetimeIndex with a time zone.
    site
        A loaded site, a session, or the path of a SITE.toml; the sun's position is computed for it.
    dni_wm2, dhi_wm2
        Direct normal and diffuse horizontal irradiance, [n] or one value. [W/m2]

    Returns
    -------
    Light
        Irradiance and true sun angles, [n] each.

    Raises
    ------
    InputError
        A time is unreadable or has no time zone, or an irradiance is no number, has another length
        than the times, or is more than any sky gives (BSRN's rare limits, half an hour around).

    Examples
    --------
    >>> fieldlum.light_at("2027-06-21T20:30Z", "office.toml", 800.0, 120.0).sun_altitude_deg
    array([65.5])
    """
    if isinstance(times_utc, str | datetime) or not isinstance(times_utc, Iterable):
        times_utc = [times_utc]
    expected = "a datetime with a time zone, or a text such as 2027-06-21T20:30Z"
    with input_errors("times_utc", expected, "add the zone, for example tzinfo=UTC", ValueError):
        times = [parse_utc(str(t)) for t in times_utc]
    values = []
    for name, given in (("dni_wm2", dni_wm2), ("dhi_wm2", dhi_wm2)):
        remedy = "pass one value for each time"
        with input_errors(name, "numbers in W/m2", remedy, TypeError, ValueError):
            masked = np.ma.asarray(given, dtype=float)
            numbers = np.broadcast_to(np.ma.filled(masked, np.nan), len(times))
        highest = IRRADIANCE_LIMITS_WM2[1]
        if not (np.isfinite(numbers).all() and ((numbers >= 0) & (numbers <= highest)).all()):
            found = f"values {numbers.min():g} to {numbers.max():g}"
            raise InputError(name, found, f"0 to {highest:g} W/m2", "correct it")
        values.append(numbers)
    light = daylight.light_at(times, place(site), *values)
    # the mean of an hour has the sun of up to half an hour earlier or later, 7.5 degrees away
    top = (light.sun_altitude_deg + 7.5, sun.extraterrestrial_wm2(times))
    limits = sun.bsrn_limits(*top, extreme=True)
    for name in ("dni_wm2", "dhi_wm2"):
        numbers, highest = getattr(light, name), getattr(limits, name)[1]
        for k in np.flatnonzero(numbers > highest)[:1]:
            sun_deg = f"the sun at {light.sun_altitude_deg[k]:.1f} degrees"
            found = f"{numbers[k]:g} at {times[k]:%Y-%m-%dT%H:%M%z}, with {sun_deg}"
            remedy = "correct the times' zone, the site, or the order of DNI and DHI"
            raise InputError(name, found, f"at most {highest[k]:.0f} W/m2", remedy)
    return light


def predict_year(
    model_folder: str | Path,
    weather_file: str | Path,
    *,
    out: str | Path | None = None,
    views: int = 10,
    maps: bool = False,
    occupancy_file: str | Path | None = None,
    label_shift_min: float = 0.0,
    force: bool = False,
) -> Annual:
    """Predict every daylight hour of a weather year, with glare in directions all around.

    Parameters
    ----------
    model_folder
        A model folder that `fit` or `fieldlum train` wrote.
    weather_file
        A weather year in any format of docs/file-formats.md, or ``synthetic``.
    out
        Folder for hourly.csv, predict.json and pictures.npz; None: annual/NAME in the session, or
        annual in a model folder outside a session.
    views
        Number of view directions, evenly around from the model's heading.
    maps
        Also store every map, as maps.zarr in the folder (0.7 GB for a year at 460 x 230).
    occupancy_file
        A csv with columns days, start, end (``mon-fri,08:00,18:00``), or with a column occupied of
        8760 hours, 0 or 1; None: 08:00 to 18:00 every day.
    label_shift_min
        Added to the times in the weather file, where its labels are known to be off. [min]
    force
        Predict again even if the folder has this year from the same inputs.

    Returns
    -------
    Annual
        `to_xarray()` has all columns over time and azimuth, among them `dgp` and `ev_lx`; `about`
        is predict.json.

    Raises
    ------
    InputError
        The model or the weather cannot be read, or they are of different places.
    NotEnoughDataError
        The weather has no daylight, or none in the occupied hours.

    Examples
    --------
    >>> year = fieldlum.predict_year("office-2027/models/auto", "seattle.epw")
    >>> year.to_xarray().dgp.sel(azimuth=180.0).max().item()
    0.62
    """
    from fieldlum.year import predict

    return predict.run(
        path_of(model_folder, "model_folder"),
        path_of(weather_file),
        out=None if out is None else path_of(out, "out"),
        maps=maps,
        views=views,
        occupancy_path=None if occupancy_file is None else path_of(occupancy_file),
        label_shift_min=label_shift_min,
        force=force,
    ).annual
