"""Sessions, plans, merged brackets, pictures and their glare in the Python API."""

# Signatures in help() show the names of types.
from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

from fieldlum import merge, plan, session, weather
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import JsonTable, Panorama, Site, SiteFile, SunSource
from fieldlum.merge import MergeResult
from fieldlum.optics import images, profiles
from fieldlum.optics.profiles import CameraProfile
from fieldlum.plan import Plan
from fieldlum.session import Session, panorama_sun, site_toml
from fieldlum.weather import Weather
from fieldlum.year.glare.picture_glare import panorama_glare, picture_glare


def path_of(value: object, what: str = "file") -> Path:
    """Return a value as a path.

    what: name of the value in errors. Raises InputError if it is neither a text nor a path.
    """
    if isinstance(value, str | os.PathLike):
        return Path(value)
    found = f"a value of type {type(value).__name__}"
    raise InputError(what, found, "a path, as text or Path", "pass its path")


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
    return session.open_session(path_of(folder, "folder"))


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
    return site_toml.load_site(path_of(file))


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
    return profiles.load_camera_profile(path_of(name, "camera"))


def read_panorama(file: str | Path) -> Panorama:
    """Read a luminance panorama.

    Parameters
    ----------
    file
        An .exr of fieldlum, or a Radiance .hdr that is twice as wide as high.

    Returns
    -------
    Panorama
        `luminance_cdm2` [H, 2H] with the zenith in row 0 and `heading_deg` in the centre column (in
        an .exr of fieldlum without the sun's disc); `u_cdm2` (standard uncertainty), `flags` and
        `sun` where the file has them. In a session the sun is that of suns.csv, as `pair` completed
        it; where it is only a lower bound, `attributes["note"]` reports that.

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
    return panorama_sun.read_panorama_with_sun(path_of(file))


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
    images.write_picture(path_of(file), _checked(panorama))


def _checked(panorama: object) -> Panorama:
    """Return a panorama with arrays of floats, in which masked values are NaN.

    Raises InputError for another object, for arrays of other shapes, and for a heading, a time or a
    sun that cannot be.
    """
    what = "panorama"
    if not isinstance(panorama, Panorama):
        found = f"a value of type {type(panorama).__name__}"
        raise InputError(what, found, "a Panorama", "pass fieldlum.Panorama(map, heading_deg)")
    sun, flags, t_utc = panorama.sun, panorama.flags, panorama.t_utc
    expected, remedy = "what help(fieldlum.Panorama) describes", "correct the value"
    with input_errors(what, expected, remedy, TypeError, ValueError):
        light, u_cdm2, rgb = (
            None if part is None else np.ma.filled(np.ma.asarray(part, dtype=float), np.nan)
            for part in (panorama.luminance_cdm2, panorama.u_cdm2, panorama.rgb)
        )
        if light is None:
            raise ValueError("no luminance_cdm2")
        if light.ndim != 2 or not light.size:
            raise ValueError(f"luminance_cdm2 of shape {light.shape}")
        if np.isinf(light).any():
            raise ValueError("an infinite luminance")
        for name in ("u_cdm2", "flags", "rgb"):
            part, shape = getattr(panorama, name), light.shape + (3,) * (name == "rgb")
            if part is not None and np.shape(part) != shape:
                raise ValueError(f"{name} of shape {np.shape(part)}")
        if flags is not None and (flags := np.asarray(flags)).dtype.kind not in "iu":
            raise ValueError("flags that are no integers")
        if not np.isfinite(heading_deg := float(panorama.heading_deg)):
            raise ValueError("a heading_deg that is not finite")
        if t_utc is not None and (not isinstance(t_utc, datetime) or t_utc.utcoffset() is None):
            raise ValueError("a t_utc that is no datetime with a time zone")
        if sun is not None and not (
            isinstance(sun, SunSource)
            and abs(sun.altitude_deg) <= 90.0
            and np.isfinite(sun.azimuth_deg)
            and 0.0 <= sun.normal_illuminance_lx < np.inf
            and 0.0 <= sun.visible_fraction <= 1.0
        ):
            raise ValueError(f"an impossible sun, {sun}")
    values = {"luminance_cdm2": light, "u_cdm2": u_cdm2, "rgb": rgb}
    panorama = replace(panorama, **values, heading_deg=heading_deg, flags=flags)
    images.require_panorama(panorama, what)
    return panorama


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
        has one sentence for each kind of correction.

    Raises
    ------
    InputError
        A line cannot be read, the station is over 300 km from the site, or the values contradict
        the sun's position (wrong units, wrong time zone).
    NotEnoughDataError
        No hour of the file has both direct and diffuse irradiance.

    Examples
    --------
    >>> weather = fieldlum.read_weather("seattle.epw", "office.toml")
    >>> len(weather), weather.dni_wm2.max()
    (8760, 978.0)
    """
    return weather.read_weather(path_of(file), place(site), label_shift_min=label_shift_min)


def place(site: SiteFile | Site | Session | str | Path) -> Site:
    """Return the place that any of the API's ways to name a site describes.

    site: a place, a loaded SITE.toml, a session, or the path of a SITE.toml. Raises InputError for
    a SITE.toml that cannot be read.
    """
    if isinstance(site, Session):
        site = site.site_file()
    elif not isinstance(site, SiteFile | Site):
        site = load_site(path_of(site, "site"))
    return site.site if isinstance(site, SiteFile) else site


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
        ``month``, ``9-day``, ``12-day``, ``4-day`` or ``even`` (docs/planning.md).
    out
        A new session folder for the plan; None writes nothing.
    start, year, days
        First local date; year of the equinoxes and solstices, or of a first date on 1 January;
        number of days, for ``month`` and ``even``.
    count
        Number of hours of ``even`` (default 200).
    weather
        The site's weather year.
    today
        Local date from which the next event is counted; default: today.

    Returns
    -------
    Plan
        `slots` with times [UTC], sun angles [deg] and exposures; `coverage` of the year.

    Raises
    ------
    NotEnoughDataError
        The sun does not rise in the window, or the weather is of other dates.
    InputError
        `out` is a session already, or the site or its camera profile cannot be used.

    Examples
    --------
    >>> plan = fieldlum.plan_captures("office.toml", "9-day", year=2027, out="office-2027")
    >>> len(plan.slots)
    108
    """
    for name, day in (("start", start), ("today", today)):
        if not isinstance(day, date | None):
            raise InputError(name, repr(day), "a datetime.date", "pass date(2027, 3, 20)")
    if not isinstance(weather, Weather | None):
        raise InputError("weather", f"{weather!r:.60}", "a weather year", "call read_weather first")
    setup = site if isinstance(site, SiteFile) else load_site(site)
    counted_from = today or plan.today_at(setup.site, datetime.now(UTC))
    request = plan.Request(capture_set, counted_from, start, year, days, count)
    if out is None:
        return plan.make_plan(setup, request, weather)
    return plan.run(setup, request, path_of(out, "out"), weather)[1]


def merge_frames(
    files: Sequence[str | Path],
    camera: CameraProfile | str | Path,
    *,
    height: int = 230,
    heading_deg: float = 180.0,
    fit: bool | None = None,
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
    if not isinstance(camera, CameraProfile):
        camera = load_camera_profile(camera)
    files = [files] if isinstance(files, str | Path) else files
    shots = merge.shots_of_files([path_of(f) for f in files], camera.camera.fixed_f_number)
    options = merge.MergeOptions(height=height, fit=fit)
    return merge.merge_shots(shots, camera, options, heading_deg=heading_deg)


def evaluate_glare(
    picture: Panorama | str | Path, view_azimuths_deg: Sequence[float] = ()
) -> JsonTable:
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
    expected, remedy = "azimuths in degrees, such as [180.0]", "pass numbers"
    with input_errors("view_azimuths_deg", expected, remedy, TypeError, ValueError):
        if isinstance(view_azimuths_deg, str | bytes):
            raise ValueError(f"the text {view_azimuths_deg!r}")
        azimuths = [float(azimuth) for azimuth in view_azimuths_deg]
        if not np.isfinite(azimuths).all():
            raise ValueError("an azimuth that is not finite")
    if isinstance(picture, Panorama):
        return panorama_glare(_checked(picture), azimuths)
    return picture_glare(path_of(picture, "picture"), azimuths)
