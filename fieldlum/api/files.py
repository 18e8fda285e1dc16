"""Sessions, sites, profiles, panoramas and weather of the Python API."""

from __future__ import annotations

import os
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, Site, SiteFile
from fieldlum.optics.profiles import CameraProfile
from fieldlum.session import Session, replacing_path
from fieldlum.weather import Weather


def path_of(value: object, what: str = "file") -> Path:
    """Return a path; raises InputError for a value that is neither text nor a path."""
    if isinstance(value, str | os.PathLike):
        return Path(value)
    raise InputError(
        what, f"a value of type {type(value).__name__}", "a path, as text or Path", "pass its path"
    )


PANORAMA_SUFFIXES = (".exr", ".hdr")


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
    from fieldlum.session import site_toml

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
    from fieldlum.optics import profiles

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
    from fieldlum.session.panorama_sun import read_panorama_with_sun

    return read_panorama_with_sun(path_of(file))


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
    from fieldlum.optics import images

    path = path_of(file)
    suffix = path.suffix.lower()
    if suffix not in PANORAMA_SUFFIXES:
        raise InputError(
            path,
            f"the file has the suffix '{suffix}'",
            " or ".join(PANORAMA_SUFFIXES),
            "give the file one of these suffixes",
        )
    height, width = panorama.luminance_cdm2.shape
    if width != 2 * height:
        raise InputError(
            path,
            f"a map of {width} x {height} pixels",
            "a panorama, which is twice as wide as high",
            "resample the map to such a shape",
        )
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
    from fieldlum import weather

    return weather.read_weather(path_of(file), place(site), label_shift_min=label_shift_min)


def place(site: SiteFile | Site | Session | str | Path) -> Site:
    """Return the `Site` of a loaded SITE.toml, of a session, or of the path of a SITE.toml."""
    if isinstance(site, Session):
        site = site.site_file()
    elif not isinstance(site, SiteFile | Site):
        site = load_site(path_of(site, "site"))
    return site.site if isinstance(site, SiteFile) else site
