"""Pairs, models and years of the Python API."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from fieldlum.api.files import place
from fieldlum.core.records import Progress, Site, SiteFile, quiet

if TYPE_CHECKING:
    from fieldlum.learn.models import Fitted, Patch
    from fieldlum.learn.models.data import Dataset
    from fieldlum.session import Session
    from fieldlum.sky.light import Light
    from fieldlum.year.predict import Annual


def load_pairs(
    pairs: Session | str | Path,
    site: str | Path | None = None,
    *,
    scene: str = "",
    progress: Progress = quiet,
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
    progress
        Called as progress(done, total, text).

    Returns
    -------
    Dataset
        `luminance_cdm2` [n, H, 2H] without the sun's disc, `disc_lx` [n], `light` (irradiance and
        sun angles of the n hours), `patch_cdm2` [n, H, 2H] or None.

    Raises
    ------
    InputError
        A cell or a picture cannot be read; the error names the line.
    NotEnoughDataError
        No usable row is in the file.

    Examples
    --------
    >>> data = fieldlum.load_pairs("office-2027")
    >>> data.luminance_cdm2.shape
    (108, 230, 460)
    """
    from fieldlum.learn.models import data
    from fieldlum.room.fit.stated_box import training_captures
    from fieldlum.session import Session

    source = pairs.root if isinstance(pairs, Session) else Path(pairs)
    stated = None if site is None else Path(site)
    captures = data.load_pairs(source, stated, progress=progress)
    return training_captures(captures, source, scene, "absolute", progress=progress)[0]


def fit(
    data: Dataset,
    model: str = "auto",
    *,
    patch: Patch = "absolute",
    budget_min: float = 10.0,
    seed: int = 0,
    out: str | Path | None = None,
    progress: Progress = quiet,
) -> Fitted:
    """Fit a model of the room to captured hours.

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
        A model folder for weights.npz, config.json and scores.json; None writes nothing.
    progress
        Called as progress(done, total, text).

    Returns
    -------
    Fitted
        `predict(light)` returns maps [n, H, 2H] in cd/m2 with uncertainty; `parameters` is the
        number of values in the model. The maps have neither the sun's disc nor its images in
        mirrors, which only `predict_year` adds.

    Raises
    ------
    NotEnoughDataError
        Fewer than two usable hours.

    Examples
    --------
    >>> model = fieldlum.fit(fieldlum.load_pairs("office-2027"), out="office-2027/models/auto")
    >>> model.name
    'transport'
    """
    from fieldlum.learn import models, train

    options: dict[str, Any] = {"patch": patch, "seed": seed, "progress": progress}
    if out is None:
        return train.fit_and_score(data, model, budget_s=60.0 * budget_min, **options).fitted
    folder = Path(out)
    train.run(data, model, budget_min=budget_min, out=folder, captures=False, **options)
    return models.load(folder)


def load_model(folder: str | Path) -> Fitted:
    """Read a fitted model.

    Parameters
    ----------
    folder
        A model folder that `fit` or `fieldlum train` wrote.

    Returns
    -------
    Fitted
        `predict(light)` returns maps [n, H, 2H] in cd/m2 with uncertainty.

    Raises
    ------
    InputError
        The folder has no model, or its weights do not match its config.json.

    Examples
    --------
    >>> noon = datetime(2027, 6, 21, 20, 30, tzinfo=UTC)
    >>> light = fieldlum.light_at([noon], fieldlum.load_site("office.toml"), 800.0, 120.0)
    >>> fieldlum.load_model("office-2027/models/auto").predict(light).luminance_cdm2.shape
    (1, 230, 460)
    """
    from fieldlum.learn import models

    return models.load(Path(folder))


def light_at(
    times_utc: Sequence[datetime],
    site: SiteFile | Site | str | Path,
    dni_wm2: ArrayLike,
    dhi_wm2: ArrayLike,
) -> Light:
    """Describe the light outside at some moments, for `Fitted.predict`.

    Parameters
    ----------
    times_utc
        n moments with a time zone.
    site
        A loaded site, or the path of a SITE.toml; the sun's position is computed for it.
    dni_wm2, dhi_wm2
        Direct normal and diffuse horizontal irradiance, [n] or one value. [W/m2]

    Returns
    -------
    Light
        Irradiance and true sun angles, [n] each.

    Raises
    ------
    ValueError
        A time has no time zone.

    Examples
    --------
    >>> noon = datetime(2027, 6, 21, 20, 30, tzinfo=UTC)
    >>> fieldlum.light_at([noon], "office.toml", 800.0, 120.0).sun_altitude_deg
    array([65.5])
    """
    import numpy as np

    from fieldlum.sky import light

    return light.light_at(times_utc, place(site), np.asarray(dni_wm2), np.asarray(dhi_wm2))


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
    progress: Progress = quiet,
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
        When the room is used; None: 08:00 to 18:00 every day.
    label_shift_min
        Added to the times in the weather file, where its labels are known to be off. [min]
    force
        Predict again even if the folder has this year from the same inputs.
    progress
        Called as progress(done, total, text).

    Returns
    -------
    Annual
        `hours` [n each] and `views` [n, d each] by column name, among them `dgp` and `ev_lx`;
        `about` is predict.json.

    Raises
    ------
    InputError
        The model or the weather cannot be read, or they are of different places.
    NotEnoughDataError
        The weather has no daylight.

    Examples
    --------
    >>> year = fieldlum.predict_year("office-2027/models/auto", "seattle.epw")
    >>> year.views["dgp"].shape
    (4380, 10)
    """
    from fieldlum.year import predict

    return predict.run(
        Path(model_folder),
        Path(weather_file),
        out=None if out is None else Path(out),
        maps=maps,
        views=views,
        occupancy_path=None if occupancy_file is None else Path(occupancy_file),
        label_shift_min=label_shift_min,
        force=force,
        progress=progress,
    ).annual
