"""Plans, merged brackets and glare of the Python API."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path

from fieldlum.api.files import load_camera_profile, load_site, path_of
from fieldlum.core.records import JsonTable, Panorama, Progress, SiteFile, quiet
from fieldlum.merge import MergeResult
from fieldlum.optics.profiles import CameraProfile
from fieldlum.plan import Plan
from fieldlum.weather import Weather


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
        The sun does not rise in the window, ``best`` has no weather, or the weather is of other
        dates.
    InputError
        `out` is a session already, or the site or its camera profile cannot be used.

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
    return plan.run(setup, request, path_of(out, "out"), weather)[1]


def merge_frames(
    files: Sequence[str | Path],
    camera: CameraProfile | str | Path,
    *,
    height: int = 230,
    heading_deg: float = 180.0,
    fit: bool | None = None,
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

    if not isinstance(camera, CameraProfile):
        camera = load_camera_profile(camera)
    return merge.merge_frames(
        [path_of(file) for file in files],
        camera,
        merge.MergeOptions(height=height, fit=fit),
        heading_deg=heading_deg,
        progress=progress,
    )


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
    from fieldlum.year.glare.single import panorama_glare, picture_glare

    if isinstance(picture, Panorama):
        return panorama_glare(picture, view_azimuths_deg)
    return picture_glare(path_of(picture, "picture"), view_azimuths_deg)
