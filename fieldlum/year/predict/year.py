"""Run `predict`: from a model and weather to a year of figures."""

import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import Caution, InputError, NotEnoughDataError
from fieldlum.core.records import listed, utc_text
from fieldlum.core.room_states import LAMP_OFF
from fieldlum.core.scheduler import LOCAL, Scheduler
from fieldlum.learn.models import Fitted, load, read_config
from fieldlum.optics import projection
from fieldlum.optics.images import read_panorama
from fieldlum.pair.camera_sky_view import is_outdated
from fieldlum.session import Session, check_writable, open_session, sha256
from fieldlum.session.codec import current_note, data_digest, sealed
from fieldlum.session.files import predict_json
from fieldlum.session.files.hourly_csv import COLOUR_COLUMNS, VIEW_COLUMNS
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.session.files.predict_json import DirectionYear, PredictFile, YearOccupancy
from fieldlum.session.files.sidecar import newest_sidecar
from fieldlum.session.site_toml import site_table
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.sky_view.view import SKY_VIEW, SkyView
from fieldlum.version import __version__
from fieldlum.weather import SYNTHETIC, Weather, read_weather
from fieldlum.year.glare import uncertainty_budget as budget
from fieldlum.year.glare.metrics import METRICS
from fieldlum.year.glare.sources import view_azimuths_deg
from fieldlum.year.glare.standards import DgpUncertainty, dgp_per_scale, protection
from fieldlum.year.predict import hour_blocks, melanopic
from fieldlum.year.predict.annual import Annual, Pictures, read_annual, write_pictures
from fieldlum.year.predict.hour_blocks import HourFigures, ModelRoom
from fieldlum.year.predict.occupancy import Occupancy, occupied_hours, read_occupancy


class PredictedYear(NamedTuple):
    """The result of `run`.

    annual: the predicted year; new: False if it already existed in the output folder.
    """

    annual: Annual
    new: bool


def run(
    model_folder: Path,
    weather_path: Path,
    *,
    out: Path | None = None,
    maps: bool = False,
    views: int = 10,
    occupancy_path: Path | None = None,
    lamps: str = "",
    sky_view: Path | None = None,
    force: bool = False,
    label_shift_min: float = 0.0,
    scheduler: Scheduler = LOCAL,
) -> PredictedYear:
    """Predict all daylight hours of a weather file with a trained model, and write the year.

    A year with the same inputs that exists in the output folder is returned instead, unless
    `force`, and becomes the newest (`newest_annual`). Otherwise an earlier year there is replaced;
    after an interruption the folder has no predict.json, and so no year.

    weather_path: a file as for `read_weather`, or "synthetic". out: output folder; None:
    `default_folder`. views: number of horizontal view directions at equal steps, from the maps'
    heading. maps: also write all maps. occupancy_path: csv of the occupied hours
    (`read_occupancy`); None: EN 17037's. lamps: "" as in the captures;
    "off"; or the path of a csv as for occupancy, with the hours in which lamps that are marked in
    the captures are on. sky_view: a sky_view.exr in place of the model's. label_shift_min: minutes
    added to the times of the weather file. scheduler: runs the units of work, of 64 hours each.

    Raises InputError for a file, folder or model that cannot be used, or if place, camera, room or
    pictures of model and session differ; NotEnoughDataError for weather without daylight or without
    occupied hours, or if the first picture has melanopic colour but none that can be used has it;
    FloatingPointError if a map is not finite.
    """
    config, session = read_config(model_folder), session_of(model_folder)
    room = hour_blocks.room_of(config, model_folder)
    for of_model, of_session in () if session is None else _differences(session, room, config):
        expected = f"{of_session}, as in this session"
        remedy = "merge, pair and train again, or use the model that was trained on this session"
        raise InputError(model_folder, f"a model {of_model}", expected, remedy)
    folder = out or default_folder(model_folder)
    occupancy, lit = read_occupancy(occupancy_path), None
    if lamps:
        lit = Occupancy("off") if lamps == "off" else read_occupancy(Path(lamps))
    of_captures = {"camera_u_rel": {}, "colour": {}} if session is None else _of_captures(session)
    options = {"views": views, "occupancy": occupancy.text, "maps": maps, "seed": 0}
    options |= {"label_shift_min": label_shift_min, "lamps": lit.text if lit else ""}
    options |= {"hours_sha256": data_digest(occupancy, lit)}
    inputs = _files(model_folder, weather_path, sky_view) | options | of_captures
    if not force and (existing := _already(folder, inputs)) is not None:
        with suppress(OSError):  # of another user, or on a read-only disk
            (folder / "predict.json").touch()
        return PredictedYear(existing, new=False)
    check_writable(folder)
    if sky_view is not None:
        view = SkyView.read(sky_view)
        room = replace(room, sky_view=view, sky_view_file=sky_view.name, pose=view.pose)
    weather = read_weather(weather_path, room.setup.site, label_shift_min=label_shift_min)
    light = _daylight(weather, weather_path, lit)
    azimuths = view_azimuths_deg(room.heading_deg, views)
    hours_used, days = occupied_hours(occupancy, weather.t_utc, weather.site)
    camera = {} if session is None else camera_u_rel(session)
    colours = None
    if session is not None and of_captures["colour"]:
        colours = melanopic.year_of_captures(session.pairs, room, azimuths, camera)
    # an interruption must not leave the hours of one weather file with the classes of another
    (folder / "predict.json").unlink(missing_ok=True)
    for name in (hour_blocks.MAPS_FOLDER, hour_blocks.DRAFT_FOLDER):
        shutil.rmtree(folder / name, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    store = hour_blocks.begin_maps(folder, len(light), room) if maps else None
    how = {"store": store, "melanopic": colours, "scheduler": scheduler}
    figures = hour_blocks.predict_figures(model_folder, room, light, azimuths, **how)
    figures.hours["occupied"][:] = occupancy.at(light.t_utc, weather.site.timezone)
    about = _about(room, config, weather, light, azimuths)
    summary = structs.replace(about, inputs=inputs, days=days, known=melanopic.known(weather))
    annual = Annual(light.t_utc, azimuths, figures.hours, _columns(figures), folder, summary)
    annual, budgets = _judged(annual, figures.uncertainty, hours_used, room, camera)
    if colours is not None:
        hours = melanopic.YearHours.of(light.t_utc, weather.site.timezone, summary)
        budgets += melanopic.edi_budget(colours, figures.views, hours, azimuths)
    if store:
        hour_blocks.finish_maps(folder, annual, room)
    pictures = report_pictures(load(model_folder), room, light, annual)
    _write(annual, budgets, pictures, weather.site.timezone)
    return PredictedYear(annual, new=True)


def _about(
    room: ModelRoom, config: ModelConfig, weather: Weather, light: Light, azimuths: Floats
) -> PredictFile:
    """Return a predict.json with what is known of model, weather and hours before the prediction.

    azimuths: the view directions [d], degrees clockwise from north.
    """
    return PredictFile(
        software={"fieldlum": __version__},
        model=config.model,
        setup=site_table(room.setup),
        height=room.height,
        width=room.width,
        heading_deg=room.heading_deg,
        azimuths_deg=tuple(azimuths.tolist()),
        weather=predict_json.YearWeather(weather.name, weather.synthetic, tuple(weather.repairs)),
        hours=len(light),
        first=utc_text(light.t_utc[0]),
        last=utc_text(light.t_utc[-1]),
        disc_from=room.disc_from,
        model_warnings=tuple(config.state.get("warnings", ())),
    )


def _columns(figures: HourFigures) -> dict[str, np.ndarray]:
    """Return the figures of n hours and d views that hourly.csv has, by column, [n, d] each.

    Melanopic columns without colour are NaN.
    """
    empty = {name: np.full(figures.uncertainty.u_maps.shape, np.nan) for name in COLOUR_COLUMNS}
    columns = {*VIEW_COLUMNS, *(name for name, metric in METRICS.items() if metric.in_year)}
    return {name: values for name, values in (empty | figures.views).items() if name in columns}


def _judged(
    annual: Annual,
    uncertainty: DgpUncertainty,
    hours_used: int,
    room: ModelRoom,
    camera: Mapping[str, float],
) -> tuple[Annual, list[budget.Budget]]:
    """Return the year with the classes of its directions, and the budgets of their exceeded DGP.

    annual: n daylight hours in d directions; uncertainty: of DGP in these hours; hours_used: number
    of occupied hours, daylight and dark ones; room: that of the model; camera: result of
    `camera_u_rel`.
    """
    used, azimuths, summary = annual.occupied, annual.azimuths_deg, annual.summary
    # of the k occupied daylight hours: DGP and vertical illuminance, [k, d] each
    dgp, ev_lx, u = annual.views["dgp"][used], annual.views["ev_lx"][used], uncertainty.hours(used)
    u_rel, rng = float(np.linalg.norm(list(camera.values()))), np.random.default_rng(0)
    rows = protection(dgp, u, hours_used, azimuths, rng, u_rel * dgp_per_scale(dgp, ev_lx))
    budgets = budget.year_budget(dgp, ev_lx, u, hours_used, azimuths, camera)
    count = int(used.sum())
    # shares of the k hours: map not trusted; interval of DGP spans the classes
    is_open = all(row.low is None for row in rows)  # the model states no uncertainty
    untrusted, wide = (float(hours.sum()) / max(count, 1) for hours in unsure_hours(annual, rows))
    shares: Floats | tuple[()] = ()
    if room.seen is not None:
        shares = projection.seen_shares(room.seen, room.heading_deg, azimuths)
    rule = summary.inputs["occupancy"]
    summary = structs.replace(
        summary,
        occupancy=YearOccupancy(rule, hours_used, count, untrusted, None if is_open else wide),
        seen_share=tuple(round(float(share), 3) for share in shares),
        u_scale_rel=u_rel,
        protection=rows,
    )
    notes = tuple(_notes(summary, room, budgets))
    return replace(annual, summary=structs.replace(summary, notes=notes)), budgets


def _write(annual: Annual, budgets: list[budget.Budget], pictures: Pictures, zone: str) -> None:
    """Write all files of a year but its maps into its folder; zone: IANA name."""
    folder = annual.folder
    annual.write(folder, zone)
    write_pictures(folder / "pictures.npz", pictures)
    with sealed(folder / budget.BUDGET_FILE):
        budget.write_budgets(folder / budget.BUDGET_FILE, ((folder.name, each) for each in budgets))
    annual.summary.write(folder)  # the last file, so that a folder with it is complete


def camera_u_rel(session: Session) -> dict[str, float]:
    """Return the relative standard uncertainties that all captures share, by part of the camera.

    The names of parts and the values are those of `Panorama.shared_u_rel` of the newest, without
    "exposures", whose error each bracket has for itself. If that panorama (of 0.1.0) states none,
    "scale" is from the newest sidecar that can be read; empty if that states none either. Raises
    InputError for a damaged panorama.
    """
    files, sidecar = session.panorama_files(), newest_sidecar(session)
    stated = read_panorama(files[-1]).shared_u_rel if files else {}
    if not stated and sidecar is not None:  # a panorama of 0.1.0
        percents = sidecar.factors.get("u_percent", {})
        stated = {"scale": float(np.hypot(percents.get("k", 0), percents.get("colour", 0))) / 100}
    return {name: u_rel for name, u_rel in stated.items() if name != "exposures"}


# ----------------------------------------------------------------------------------------------
# light


def light_of(weather: Weather) -> Light:
    """Return the sun's position and the light of all hours of `weather`, in their order."""
    return light_at(weather.t_utc, weather.site, weather.dni_wm2, weather.dhi_wm2)


def _daylight(weather: Weather, path: Path, lamps: Occupancy | None) -> Light:
    """Return the light of the hours in which the sun is up.

    path: the weather file, for the error; lamps: hours in which lamps are on; None: lamps are those
    of unmarked captures. Raises NotEnoughDataError if there is no such hour.
    """
    hours = weather.daylight()
    if len(hours) == 0:
        remedy = "check the file's irradiance and time zone"
        raise NotEnoughDataError(f"{path}: no hour with irradiance while the sun is up; {remedy}")
    light = light_of(hours)
    if lamps is None:
        return light
    on = lamps.at(light.t_utc, weather.site.timezone)
    return replace(light, states=tuple("lamp=on" if lit else LAMP_OFF for lit in on))


# ----------------------------------------------------------------------------------------------
# pictures


def report_hours(annual: Annual) -> Iterator[tuple[str, int]]:
    """Yield the name of each hour to show in the report, and its index in the year, from 0.

    A name is such as "p95 of worst view 180" (`Pictures.kinds`). These are the hours with the
    median, the 95th percentile and the highest DGP of the occupied hours (all hours if none is
    occupied), first for the direction with the most glare, then for that with the least
    (`best_and_worst`). An hour can occur twice. There is none if no direction was seen.
    """
    used = np.flatnonzero(annual.occupied) if annual.occupied.any() else np.arange(len(annual))
    dgp = annual.views["dgp"][used]
    ends = best_and_worst(annual.summary.protection) or ()
    for name, row in zip(("worst", "best"), ends[::-1], strict=False):
        direction = int(np.argmin(np.abs(annual.azimuths_deg - row.azimuth_deg)))
        order = used[np.argsort(dgp[:, direction], kind="stable")]
        for share, kind in ((0.5, "typical"), (0.95, "p95"), (1.0, "highest")):
            hour = order[min(int(share * len(order)), len(order) - 1)]
            yield f"{kind} of {name} view {annual.azimuths_deg[direction]:g}", int(hour)


def report_pictures(fitted: Fitted, room: ModelRoom, light: Light, annual: Annual) -> Pictures:
    """Predict the luminance maps of the k hours to show in the report, and return them.

    The hours are those with the median, the 95th percentile and the highest DGP in the directions
    with most and with least glare (`report_hours`), in that order: k is 6, or 0 if no direction was
    seen. The maps [k, H, W] cd/m2 contain images of the sun in mirrors, not the sun's disc. They
    are predicted again because all maps of a year would need a gigabyte of memory. fitted, room:
    the model and its room; light, annual: the light of all n hours of the year, and their results.
    Raises the errors of `hour_blocks.blocks`.
    """
    kinds, hours = [list(part) for part in zip(*report_hours(annual), strict=True)] or ([], [])
    rows, at = np.unique(np.array(hours, np.int64), return_inverse=True)
    maps = np.zeros((0, room.height, room.width), np.float32)  # if no direction was seen
    disc_lx = annual.hours["disc_lx"][rows]
    for block in hour_blocks.blocks(fitted, room, light[rows], disc_lx):  # one or none
        maps = block.pictures_cdm2(room.heading_deg)
    return Pictures(tuple(kinds), rows[at], maps[at], disc_lx[at], room.heading_deg)


# ----------------------------------------------------------------------------------------------
# folders and inputs


def session_of(model_folder: Path) -> Session | None:
    """Return the session of a model in its folder models/; None for a model elsewhere.

    Raises InputError if the session cannot be opened.
    """
    models = model_folder.resolve().parent
    in_session = models.name == "models" and (models.parent / "session.toml").is_file()
    return open_session(models.parent) if in_session else None


def default_folder(model_folder: Path) -> Path:
    """Return where a model's predicted year is stored by default.

    This is SESSION/annual/NAME for a model in SESSION/models/NAME, else `annual` in the model's
    folder. The path is relative if `model_folder` is. Raises InputError as `session_of` does.
    """
    if session_of(model_folder) is None:
        return model_folder / "annual"
    return model_folder.parent.parent / "annual" / model_folder.resolve().name


def _differences(
    session: Session, room: ModelRoom, config: ModelConfig
) -> Iterator[tuple[str, str]]:
    """Yield a text on the model and one on its session, for each difference between them.

    The place may differ by 0.01 degrees, the heading of the first panorama by 0.1 degrees; its size
    in pixels must be equal. With a fitted scene in the model's config.json, the room and heading as
    stated before the fit are compared.
    """
    setup, scene = session.site_file(), config.scene
    mine, site = room.setup.site, setup.site
    north_deg = abs(mine.latitude_deg - site.latitude_deg)
    if max(north_deg, abs(mine.longitude_deg - site.longitude_deg)) > 0.01:
        texts = [f"{s.name} ({s.latitude_deg:g}, {s.longitude_deg:g} deg)" for s in (mine, site)]
        yield f"of the site {texts[0]}", texts[1]
    if mine.timezone != site.timezone:
        yield f"of the time zone {mine.timezone}", site.timezone
    stated, actual = scene["stated"] if scene else site_table(room.setup), site_table(setup)
    for table in ("camera", "room"):  # both affect every map
        of_model, of_session = stated.get(table) or {}, actual.get(table) or {}
        for name in sorted({*of_model, *of_session} - {"profile"}):
            if of_model.get(name) != of_session.get(name):
                of_file = f"with [{table}] {name} = {of_model.get(name, 'none')}"
                yield of_file, str(of_session.get(name, "none"))
    heading_deg = float(scene["stated_heading_deg"]) if scene else room.heading_deg
    for path in session.panorama_files()[:1]:
        first = read_panorama(path)
        height, width = first.luminance_cdm2.shape
        if (height, width) != (room.height, room.width):
            found = f"with pictures of {room.width} x {room.height} pixels"
            yield found, f"{width} x {height} pixels"
        if abs(projection.signed_angle_deg(first.heading_deg - heading_deg)) > 0.1:
            yield f"with a heading of {heading_deg:g} deg", f"{first.heading_deg:g} deg"
    if is_model_outdated(session, config, room.sky_view):
        yield "of other pictures, irradiance or times", "those that were paired last"


def is_model_outdated(session: Session, config: ModelConfig, view: SkyView | None) -> bool:
    """Return whether a session's pictures, irradiance or times are not those of a model's training.

    It compares the inputs that the session's sky view and the model's sky view state. config: of
    the model. view: the sky view in the model's folder. Captures that were added to the session
    since do not count. The answer is False if the inputs cannot be compared: without one of the sky
    views, or if that of the model was computed from other captures (train --sky-view). Raises
    InputError for a damaged sky view of the session.
    """
    own = SkyView.find(session.sky_view)
    if own is None or view is None or not view.inputs:
        return False
    known = set(view.inputs.get("captures", ()))
    if not set(config.training.slots) <= known:
        return False
    added = set(own.inputs.get("captures", ())) - known
    return is_outdated(session, view) or (not added and own.inputs != view.inputs)


def _of_captures(session: Session) -> dict[str, Any]:
    """Return the inputs of a year that are from its session's captures, not from the model.

    camera_u_rel: result of that function, without "vignetting", which depends on where a capture is
    bright; colour: result of `melanopic.digests`. Raises InputError for a damaged session.
    """
    u_rel = {name: u for name, u in camera_u_rel(session).items() if name != "vignetting"}
    return {"camera_u_rel": u_rel, "colour": melanopic.digests(session.pairs)}


def newest_annual(session: Session) -> Annual | None:
    """Return the session's newest predicted year in annual/; None if it has no year.

    The newest is the one whose predict.json was modified last, by the time of the file. Warns with
    `Caution` of a year that is not of the present session (`outdated_text`). Raises InputError as
    `read_annual` and `outdated_text` do.
    """
    folders = sorted(session.annual_folders(), key=lambda f: -(f / "predict.json").stat().st_mtime)
    annual = next(map(read_annual, folders), None)
    if annual is not None and (text := outdated_text(session, annual)):
        warnings.warn(f"{session.root}: {text}", Caution, stacklevel=2)
    return annual


def outdated_text(session: Session, annual: Annual) -> str:
    """Return a sentence if a year is not of the present model and session, else "".

    It is not if the model in models/ was trained again since; if place, camera, room or pictures of
    the session are now others than those of the model; or if the camera's stated uncertainty or
    captures that gave the year's colour are others now. Captures that were added since do not
    count. The text is "" too if the session does not have the model any more, because then nothing
    can be compared. Raises InputError for a damaged model or session.
    """
    used = annual.summary.inputs
    folder = session.models / str(used.get("model", ""))
    if not (folder / "config.json").is_file():
        return ""
    config, colour, now = read_config(folder), used.get("colour"), _of_captures(session)
    same = used.get("model_sha256") in (None, sha256(folder / "config.json"))
    same &= used.get("camera_u_rel", now["camera_u_rel"]) == now["camera_u_rel"]
    # in earlier versions colour is True or False
    same &= not isinstance(colour, dict) or colour.items() <= now["colour"].items()
    same = same and not any(_differences(session, hour_blocks.room_of(config, folder), config))
    text = f"Year {annual.folder.name} is of another model, calibration or place, or other captures"
    return "" if same else f"{text}, than the session has now: run fieldlum predict again"


def _files(model: Path, weather: Path, sky_view: Path | None) -> dict[str, object]:
    """Return the names and digests of the files that a predicted year depends on.

    model: its folder; weather: a file, or "synthetic". Raises InputError for a missing file.
    sky_view: None for that of the model.
    """
    synthetic = str(weather) == SYNTHETIC
    if not synthetic and not weather.is_file():
        expected = "a weather file, or the word synthetic"
        found = "a folder" if weather.is_dir() else "no such file"
        raise InputError(weather, found, expected, "name a weather file, or the word synthetic")
    weights, view = model / "weights.npz", sky_view or model / SKY_VIEW
    return {
        "model": model.resolve().name,
        "model_sha256": sha256(model / "config.json"),
        "weights_sha256": sha256(weights) if weights.is_file() else "",
        "sky_view_sha256": sha256(view) if sky_view or view.is_file() else "",
        "weather": weather.name,
        "weather_sha256": "" if synthetic else sha256(weather),
    }


def _already(folder: Path, inputs: Mapping[str, object]) -> Annual | None:
    """Return the year in `folder` if this version computed it from the same inputs, else None.

    A damaged year counts as missing. A stored year with maps also answers a request without maps.
    """
    note, files, needs_maps = folder / "predict.json", [folder / "hourly.csv"], inputs["maps"]
    table = current_note(note, {**inputs, "maps": True}, files)
    table = table or (None if needs_maps else current_note(note, inputs, files))
    same = table is not None and table.get("software", {}).get("fieldlum") == __version__
    with suppress(InputError):
        if same and ((folder / hour_blocks.MAPS_FOLDER).is_dir() or not needs_maps):
            return read_annual(folder)
    return None


# ----------------------------------------------------------------------------------------------
# summary: classes of glare protection, notes

_WIDE_DGP = 0.2  # an interval of this width spans all classes (EN 17037: 0.35 to 0.45)
_UNSEEN_NOTES = {
    projection.NOT_SEEN: "have no result: the camera's lens saw less than half of them; turn the "
    "camera to more headings, or use a lens that sees more",
    projection.PARTLY_SEEN: "have bounds only: the lens saw 50 to 98 % of them, and the intervals "
    "assume that the unseen part has between 0 cd/m2 and the larger of the sky's mean luminance "
    "and the brightest hundredth of the seen pixels; turn the camera to more headings for smaller "
    "intervals",
}


def unsure_hours(annual: Annual, rows: Sequence[DirectionYear]) -> tuple[Mask, Mask]:
    """Return masks [n] of the occupied hours with an untrusted map, and of those with a wide DGP.

    annual: n daylight hours in d directions. rows: one for each direction, of which `seen` is used.
    An hour has a wide DGP if its 95 % interval is over 0.2 wide in a direction that lenses saw
    fully; if they saw none fully, in one that has a DGP (at least half seen). An interval that is
    NaN, because bounds are unknown, is not wide. The limit of 0.2 is chosen: such an interval spans
    all classes (EN 17037: 0.35 to 0.45).
    """
    untrusted = annual.occupied & (annual.hours["trusted"] < 1)
    full = [row.seen == projection.SEEN for row in rows]
    full = full if any(full) else annual.judged  # [d], the directions that decide
    gap = (annual.views["dgp_high"] - annual.views["dgp_low"])[:, full]  # [n, at most d]
    widest = np.nan_to_num(gap).max(axis=1, initial=0.0)
    return untrusted, annual.occupied & (widest > _WIDE_DGP)


def are_full_years(days: int) -> bool:
    """Return whether a number of days is within 6 days of one or more full years of 365.25 days.

    The margin is chosen, for files that lack some days. With half a year more, its season would
    count twice in the classes.
    """
    return days > 300 and (days + 6) % 365.25 < 12.0


def _notes(
    summary: PredictFile, room: ModelRoom, budgets: Sequence[budget.Budget]
) -> Iterator[str]:
    """Yield the notes and warnings that a reader of the predicted year needs.

    summary: the year's, with occupancy and protection; room: that of the model; budgets: those of
    the exceeded DGP.
    """
    occupancy, untrusted = summary.occupancy, summary.occupancy.untrusted_share
    yield (
        "Each hour of the year has one value of the weather. In most weather files it is a mean: "
        "under broken cloud the sun comes and goes within the hour, but the mean shows a constant, "
        "dimmed sun. In files of PVGIS it is one moment, which stands for the hour. So the number "
        "of glare hours can be too low or too high."
    )
    if not are_full_years(days := summary.days):
        yield f"the weather has {days} days, not a year (or full years): classes are for these only"
    if days > 371:
        yield f"hours are counted over all {days} days; heat map and compare show the last year"
    if summary.weather.synthetic:
        yield "the weather is synthetic: it must not be used to judge this place"
    yield from room.sky_view.notes if room.sky_view else [room.disc_from]
    marked = sorted({view.state for view in room.sky_view.others} - {""} if room.sky_view else ())
    if marked:
        yield f"all hours are predicted in the usual state of the room, not with {listed(marked)}"
    if untrusted > 0.05:
        mirror = "a mirrored sun may be in view, " if room.mirrors else ""
        yield (
            f"In {100 * untrusted:.0f} % of the occupied daylight hours the maps are not trusted: "
            f"no similar light was captured, {mirror}or pixels may be wrong by more than 20 %. "
            "Intervals of DGP and classes include it; capture more days and seasons"
        )
    if (wide := occupancy.wide_share or 0.0) > 0.05:
        cause = "the sky view does not decide whether the sun's disc is seen; capture clear hours "
        cause += "with the sun in a window, which also give the camera's heading"
        of_disc, of_model = (
            budget.share_of(source.name, budgets) for source in (budget.DISC_SEEN, budget.MODEL)
        )
        if of_model > of_disc:
            cause = "mostly by the model's own error (budget.csv); capture more days and seasons"
        yield (
            f"In {100 * wide:.0f} % of the occupied daylight hours the 95 % interval of DGP is "
            f"wider than {_WIDE_DGP:g} in a fully seen direction: {cause}"
        )
    if (share := budget.share_of(budget.CAMERA, budgets)) > 0.5:
        yield (
            f"{100 * share:.0f} % of the variance behind the classes' intervals is the camera's "
            "calibration (budget.csv): fieldlum calibrate makes them smaller"
        )
    for word, meaning in _UNSEEN_NOTES.items():
        if azimuths := [row.azimuth_deg for row in summary.protection if row.seen == word]:
            named = ", ".join(f"{a:.0f}° ({projection.compass_name(a)})" for a in azimuths)
            yield f"the view directions {named} {meaning}"


def best_and_worst(rows: Sequence[DirectionYear]) -> tuple[DirectionYear, DirectionYear] | None:
    """Return the directions with the least and with the most glare; None if none has a class.

    rows: one for each direction. The order is by the DGP exceeded in 5 % of the occupied hours,
    then by the sum of the hours above the three limits. To be the best, a partly seen direction
    counts with the upper end of its interval (1 if unknown), so that an unseen part never makes a
    direction a recommendation.
    """
    judged = [row for row in rows if row.glare_class != projection.NOT_SEEN]
    if not judged:
        return None

    def glare(row: DirectionYear) -> tuple[float, int]:
        """Return the exceeded DGP of a direction, and the sum of its hours above the limits."""
        return row.dgp_exceeded or 0.0, sum(count or 0 for count in row.hours_over.values())

    def as_best(row: DirectionYear) -> tuple[float, int]:
        """Return `glare`; for a partly seen direction with the upper end of its interval as DGP."""
        upper = 1.0 if row.high is None else row.high
        return glare(row) if row.seen == projection.SEEN else (upper, glare(row)[1])

    return min(judged, key=as_best), max(judged, key=glare)
