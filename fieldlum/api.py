"""The Python API: the functions of `import fieldlum`, for scripts and notebooks.

Every function takes paths as text or `Path`, and returns arrays in frozen dataclasses. The command
line and this module call the same stages; `docs/python.md` shows both in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from fieldlum.errors import FieldlumError, InputError
from fieldlum.records import Panorama, Progress, Site, SiteFile, SunSource, quiet

if TYPE_CHECKING:
    from fieldlum.light import Light
    from fieldlum.merge import MergeResult
    from fieldlum.models import Fitted, Patch
    from fieldlum.models.data import Dataset
    from fieldlum.plan import Plan
    from fieldlum.predict import Annual
    from fieldlum.profiles import CameraProfile
    from fieldlum.session import Session
    from fieldlum.weather import Weather

__all__ = [
    "FieldlumError",
    "Panorama",
    "SunSource",
    "evaluate_glare",
    "fit",
    "light_at",
    "load_camera_profile",
    "load_model",
    "load_pairs",
    "load_site",
    "merge_frames",
    "open_session",
    "plan_captures",
    "predict_year",
    "read_panorama",
    "read_weather",
    "write_panorama",
]

PANORAMA_SUFFIXES = (".exr", ".hdr")


# ----------------------------------------------------------------------------------------------
# files


def open_session(folder: str | Path) -> Session:
    """Open a session folder.

    Parameters
    ----------
    folder
        A folder that `fieldlum plan` or `plan_captures` wrote.

    Returns
    -------
    Session
        Paths of everything in the folder; `slots()` reads the plan, `site_file()` the site.

    Raises
    ------
    InputError
        The folder has no readable session.toml.

    Examples
    --------
    >>> session = fieldlum.open_session("office-2027")
    >>> len(session.slots()), session.pairs
    (108, PosixPath('office-2027/pairs.csv'))
    """
    from fieldlum import session

    return session.open_session(Path(folder))


def load_site(file: str | Path) -> SiteFile:
    """Read a site file: place, camera set-up, room and pyranometer.

    Parameters
    ----------
    file
        A SITE.toml; only the table [site] is required.

    Returns
    -------
    SiteFile
        `site` has latitude and longitude [deg, east positive]; `room` is None without [room].

    Raises
    ------
    InputError
        A key is unknown or missing, or a value is out of range.

    Examples
    --------
    >>> fieldlum.load_site("office.toml").site.latitude_deg
    47.6
    """
    from fieldlum import profiles

    return profiles.load_site(Path(file))


def load_camera_profile(name: str | Path) -> CameraProfile:
    """Read a camera profile: sensor, lenses, response and scale with their uncertainties.

    Parameters
    ----------
    name
        The name of a shipped profile, such as ``sim-fisheye``, or the path of a .toml file.

    Returns
    -------
    CameraProfile
        Everything between sensor counts and cd/m2.

    Raises
    ------
    InputError
        No such profile, or a value that no camera can have.

    Examples
    --------
    >>> fieldlum.load_camera_profile("sim-fisheye").bracket.f_number
    5.6
    """
    from fieldlum import profiles

    return profiles.load_camera_profile(name)


def read_panorama(file: str | Path) -> Panorama:
    """Read a luminance panorama.

    Parameters
    ----------
    file
        An .exr of fieldlum, or a Radiance .hdr that is twice as wide as high.

    Returns
    -------
    Panorama
        `luminance_cdm2` [H, 2H] with the zenith in row 0 and `heading_deg` in the centre column,
        without the sun's disc; `u_cdm2` (standard uncertainty), `flags` and `sun` where the file
        has them. In a session the sun is that of suns.csv, as `pair` completed it; where it is only
        a lower bound, `attributes["note"]` reports that.

    Raises
    ------
    InputError
        The file is missing, broken, or not a panorama.

    Examples
    --------
    >>> panorama = fieldlum.read_panorama("office-2027/panoramas/20270320T193000Z.exr")
    >>> panorama.luminance_cdm2.shape, panorama.heading_deg
    ((230, 460), 180.0)
    """
    from fieldlum.session.panorama_sun import read_panorama_with_sun

    return read_panorama_with_sun(Path(file))


def write_panorama(file: str | Path, panorama: Panorama) -> None:
    """Write a luminance panorama.

    Parameters
    ----------
    file
        Ends in .exr (float32, with uncertainty, flags and sun) or .hdr (Radiance RGBE, luminance
        or colour only, with a heading line).
    panorama
        Luminance [H, 2H] in cd/m2.

    Raises
    ------
    InputError
        The file's suffix is neither, or the map is not twice as wide as high.

    Examples
    --------
    >>> grey = fieldlum.Panorama(np.full((115, 230), 500.0, np.float32), heading_deg=180.0)
    >>> fieldlum.write_panorama("grey.hdr", grey)
    """
    from fieldlum import images
    from fieldlum.session import replacing_path

    path = Path(file)
    suffix = path.suffix.lower()
    if suffix not in PANORAMA_SUFFIXES:
        raise InputError(path, f"suffix '{suffix}'", " or ".join(PANORAMA_SUFFIXES))
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(path, f"a map of {width} x {height} pixels", "twice as wide as high")
    with replacing_path(path) as temporary:
        if suffix == ".exr":
            images.write_panorama(temporary, panorama)
        else:
            pixels = panorama.luminance_cdm2 if panorama.rgb is None else panorama.rgb
            images.write_radiance_hdr(temporary, pixels, heading_deg=panorama.heading_deg)


def read_weather(
    file: str | Path, site: SiteFile | Site | str | Path, *, label_shift_min: float = 0.0
) -> Weather:
    """Read a weather year.

    Parameters
    ----------
    file
        A weather year in any format of docs/file-formats.md (EPW, TMY3, CSV and others), or
        ``synthetic``.
    site
        Where the room is: a loaded site, or the path of a SITE.toml. Times and distances are
        checked against it.
    label_shift_min
        Added to the times in the file, where its labels are known to be off. [min]

    Returns
    -------
    Weather
        `dni_wm2`, `dhi_wm2`, `ghi_wm2` [n] at `t_utc` [n], the middle of each hour; `repairs`
        has one sentence for every value that was corrected.

    Raises
    ------
    InputError
        A line cannot be read, the station is over 300 km from the site, or the values contradict
        the sun's position (wrong units, wrong time zone).
    NotEnoughDataError
        The file has no hours.

    Examples
    --------
    >>> weather = fieldlum.read_weather("seattle.epw", "office.toml")
    >>> len(weather), weather.dni_wm2.max()
    (8760, 978.0)
    """
    from fieldlum import weather

    return weather.read_weather(Path(file), _place(site), label_shift_min=label_shift_min)


def _place(site: SiteFile | Site | str | Path) -> Site:
    if isinstance(site, str | Path):
        site = load_site(site)
    return site.site if isinstance(site, SiteFile) else site


# ----------------------------------------------------------------------------------------------
# plan, merge, glare


def plan_captures(
    site: SiteFile | str | Path,
    capture_set: str = "9-day",
    *,
    out: str | Path | None = None,
    start: date | None = None,
    year: int | None = None,
    days: int | None = None,
    count: int | None = None,
    weather: Weather | None = None,
    today: date | None = None,
) -> Plan:
    """Choose the hours to capture.

    Parameters
    ----------
    site
        A loaded site, or the path of a SITE.toml.
    capture_set
        ``month``, ``9-day``, ``12-day``, ``4-day``, ``even`` or ``best`` (docs/planning.md).
    out
        A new session folder for the plan; None writes nothing.
    start, year, days
        First local date; year of the event dates; length of a month or of the window.
    count
        Number of hours of ``even`` (default 200) and ``best`` (default 50).
    weather
        The site's weather year; ``best`` requires it.
    today
        Local date from which the next event is counted; default: today.

    Returns
    -------
    Plan
        `slots` with times [UTC], sun angles [deg] and exposures; `coverage` of the year.

    Raises
    ------
    NotEnoughDataError
        The sun does not rise in the window, or ``best`` has no weather.
    InputError
        `out` is a session already.

    Examples
    --------
    >>> plan = fieldlum.plan_captures("office.toml", "9-day", year=2027, out="office-2027")
    >>> len(plan.slots)
    108
    """
    from fieldlum import plan

    setup = site if isinstance(site, SiteFile) else load_site(site)
    counted_from = today or plan.today_at(setup.site, datetime.now(UTC))
    request = plan.Request(capture_set, counted_from, start, year, days, count)
    if out is None:
        return plan.make_plan(setup, request, weather)
    return plan.run(setup, request, Path(out), weather).plan


def merge_frames(
    files: Sequence[str | Path],
    camera: CameraProfile | str | Path,
    *,
    height: int = 230,
    heading_deg: float = 180.0,
    fit: bool | None = None,
    drop_moved: bool = False,
    progress: Progress = quiet,
) -> MergeResult:
    """Merge one bracket of raw or JPEG files to a luminance panorama.

    Parameters
    ----------
    files
        Frames of one bracket, in any order; exposures and times come from their EXIF.
    camera
        A loaded profile, the name of a shipped one, or the path of a .toml file.
    height
        Rows of the panorama; it is twice as wide. [px]
    heading_deg
        Where the camera faced, clockwise from true north; the panorama's centre column.
    fit
        Estimate the exposure ratios from the frames; None: for raw frames only.
    drop_moved
        Exclude frames from pixels where something moved.
    progress
        Called as progress(done, total, text).

    Returns
    -------
    MergeResult
        `panorama` (luminance [H, 2H] in cd/m2, standard uncertainty, flags), `report` (a record of
        the figures; `quality` has them as `merge --json` prints them) and `verdict` (one line).

    Raises
    ------
    InputError
        A frame cannot be read, or does not belong to the camera or the bracket.

    Examples
    --------
    >>> frames = sorted(Path("office-2027/raw/20270320T193000Z").glob("*.dng"))
    >>> result = fieldlum.merge_frames(frames, "sim-fisheye", heading_deg=180.0)
    >>> result.verdict
    'good'
    """
    from fieldlum import merge

    if isinstance(camera, str | Path):
        camera = load_camera_profile(camera)
    return merge.merge_frames(
        [Path(file) for file in files],
        camera,
        merge.MergeOptions(height=height, fit=fit, drop_moved=drop_moved),
        heading_deg=heading_deg,
        progress=progress,
    )


def evaluate_glare(
    picture: Panorama | str | Path, view_azimuths_deg: Sequence[float] = ()
) -> dict[str, Any]:
    """Evaluate glare of a luminance map in one or several view directions.

    Parameters
    ----------
    picture
        A panorama, or the path of an .exr or .hdr file, panorama or fisheye with a VIEW.
    view_azimuths_deg
        View directions, clockwise from true north; empty: ten around a panorama, a fisheye's own.

    Returns
    -------
    dict
        The object that `fieldlum glare --json` prints. `views` has one dict per direction with
        `azimuth_deg`, `dgp`, `dgps` (0 to 1), `ev_lx`, `ugr`, `dgi`, `verdict`; `warnings` lists
        what makes the figures lower bounds.

    Raises
    ------
    InputError
        A pixel is not finite, or the file has no true VIEW.

    Examples
    --------
    >>> glare = fieldlum.evaluate_glare(panorama, [180.0])
    >>> glare["views"][0]["dgp"], glare["views"][0]["verdict"]
    (0.31, 'imperceptible')
    """
    from fieldlum.glare.single import panorama_glare, picture_glare

    if isinstance(picture, Panorama):
        return panorama_glare(picture, view_azimuths_deg)
    return picture_glare(Path(picture), view_azimuths_deg)


# ----------------------------------------------------------------------------------------------
# learn and predict


def load_pairs(
    pairs: Session | str | Path, site: str | Path | None = None, *, progress: Progress = quiet
) -> Dataset:
    """Read captured hours with their irradiance for training.

    Parameters
    ----------
    pairs
        A session, its folder, or a pairs.csv with its pictures (docs/file-formats.md).
    site
        A SITE.toml; None: the session's, or site.toml in the folder of the csv.
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
    from fieldlum.models import data

    source = Path(pairs) if isinstance(pairs, str) else pairs
    return data.load_pairs(source, None if site is None else Path(site), progress=progress)


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
        number of values in the model.

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
    from fieldlum import models, train

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
    from fieldlum import models

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

    from fieldlum import light

    return light.light_at(times_utc, _place(site), np.asarray(dni_wm2), np.asarray(dhi_wm2))


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
        next to the model folder.
    views
        Number of view directions, evenly around from the model's heading.
    maps
        Also store every map, as maps.zarr in the folder (0.7 GB for a year at 460 x 230).
    occupancy_file
        When the room is used; None: 08:00 to 18:00.
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
    from fieldlum import predict

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
