"""Rank coming hours by how much each reduces the model's uncertainty.

The ranking also shows whether more captures pay.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, NotEnoughDataError, reason_of
from fieldlum.core.records import JsonTable, Progress, Site, quiet, slot_id, utc_text
from fieldlum.plan import choose
from fieldlum.plan.days import DaylightHours, daylight_hours, span
from fieldlum.plan.makeup import captured_ids
from fieldlum.session import Session
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.sky import sun
from fieldlum.sky.light import Facades, Features, Kernel, greedy_hours, light_at, light_features
from fieldlum.weather import Weather

AHEAD_DAYS = 14  # days ahead that are ranked; chosen
SHOWN = 12  # best hours that are printed; chosen
# Number of skies of an hour: the weather at the same hour on days around, three days apart. Chosen.
SKIES = 7
BATCH = 25  # number of captures in a batch, by which "pays" is decided; chosen
SAME_PLACE_DEG = 0.1  # a model of a place further away is not used; about 11 km
# A batch that reduces the remaining variance by a smaller share does not pay. Chosen, not measured.
WORTH = 0.10


@dataclass(frozen=True, slots=True)
class ComingHour:
    """One coming daylight hour, and how much a capture then would reduce the model's uncertainty.

    reduction_percent: of the remaining variance over the year, as a mean over skies of the season;
    planned: whether the hour is a slot of the plan.
    """

    t_utc: datetime
    sun_altitude_deg: float
    sun_azimuth_deg: float
    reduction_percent: float  # of the remaining variance, expected over the skies of the season
    planned: bool


@dataclass(frozen=True, slots=True)
class RankedHours:
    """Coming hours, the most useful first, and whether 25 more captures would pay.

    model: trained model of the kernel, "" for none; captured: number of captures;
    variance_left_percent: share of the prior variance over the year that they leave;
    next_batch_percent: share of that variance which the best 25 hours of the year would remove;
    pays: whether this is at least 10 %.
    """

    model: str  # trained model of the kernel; "" for an untrained kernel of the facades
    captured: int
    variance_left_percent: float  # of the prior variance, over the year
    hours: tuple[ComingHour, ...]  # best first
    next_batch_percent: float  # of the remaining variance, by the best BATCH hours of the year
    pays: bool


def trained_kernel(session: Session) -> tuple[Kernel, str] | None:
    """Return the kernel and the name of the session's newest transport model; None if it has none.

    A model that was trained 0.1 degrees of latitude or longitude away, or more, is skipped. Raises
    InputError for a model folder with wrong content.
    """
    folders = [path for path in session.model_folders() if (path / "weights.npz").is_file()]
    for folder in sorted(
        folders, key=lambda path: (path / "config.json").stat().st_mtime, reverse=True
    ):
        config = ModelConfig.read(folder)
        if config.model != "transport" or not _of_this_place(config, session.site_file().site):
            continue
        try:
            with np.load(folder / "weights.npz", allow_pickle=False) as arrays:
                facades = Facades(
                    np.array(arrays["facade_azimuths"]), np.array(arrays["facade_weights"])
                )
            return Kernel(facades, **config.state["transport"]["kernel"]), folder.name
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                folder,
                f"a model that cannot be read ({reason_of(error)})",
                "a transport model",
                "train the model again (fieldlum train)",
            ) from None
    return None


def _of_this_place(config: ModelConfig, site: Site) -> bool:
    place = config.setup.get("site", {})
    pairs = (("latitude_deg", site.latitude_deg), ("longitude_deg", site.longitude_deg))
    return all(abs(float(place.get(name, here)) - here) < SAME_PLACE_DEG for name, here in pairs)


def captured_features(session: Session, task: choose.Learning) -> Features:
    """Return the light features of the n completed captures and usable pairs, [n].

    A capture with a usable row in pairs.csv has its measured irradiance. One without has the
    irradiance of the weather year, and is omitted if that has none then.
    """
    times, dni, dhi = _paired(session)
    paired_ids = {slot_id(t) for t in times}
    captured = captured_ids(session) - paired_ids
    others = [slot.t_utc for slot in session.slots() if slot.id in captured]
    if others:
        typical = task.weather.at(others)
        is_known = np.isfinite(typical.dni_wm2 + typical.dhi_wm2)
        times += [t for t, ok in zip(others, is_known, strict=True) if ok]
        dni = [*dni, *typical.dni_wm2[is_known]]
        dhi = [*dhi, *typical.dhi_wm2[is_known]]
    return light_features(light_at(times, task.site, np.array(dni, float), np.array(dhi, float)))


def _paired(session: Session) -> tuple[list[datetime], list[float], list[float]]:
    rows = PairsFile.find(session.pairs).usable
    return [r.t_utc for r in rows], [r.dni_wm2 for r in rows], [r.dhi_wm2 for r in rows]


def _reductions(
    task: choose.Learning, captured: Features, hours: DaylightHours, progress: Progress
) -> Floats:
    """Return the expected reduction of the year's variance by each hour, [n].

    It is a share of the remaining variance, as a mean over skies of the season.
    """
    base = choose.variance_left(task, captured)
    total, count = np.zeros(len(hours)), np.zeros(len(hours))
    for step, days in enumerate(np.arange(SKIES) * 3 - 3 * (SKIES // 2)):
        progress(step, SKIES + BATCH, "skies of the season")
        sky = task.weather.at([t + timedelta(days=int(days)) for t in hours.t_utc])
        rows, features = choose.features_under(sky, hours, task)
        if not len(rows):
            continue
        total[rows] += _single_gains(task, captured, features) / base
        count[rows] += 1
    return total / np.maximum(count, 1)


def _single_gains(task: choose.Learning, captured: Features, pool: Features) -> Floats:
    """Return the reduction of the year's mean variance by each single hour of the pool, [n].

    It is a share of the prior variance.
    """
    kernel = task.kernel
    cross, own = kernel(task.year, pool), kernel.diagonal(pool)
    if len(captured):
        covariance = kernel(captured, captured) + choose.NOISE * np.eye(len(captured))
        towards = np.linalg.solve(covariance, kernel(captured, pool))
        cross = cross - kernel(task.year, captured) @ towards
        own = own - np.einsum("ij,ij->j", kernel(captured, pool), towards)
    gain = (cross**2).sum(axis=0) / (np.maximum(own, 0) + choose.NOISE)
    return gain / kernel.diagonal(task.year).sum()


def run(
    session: Session, weather: Weather, now_utc: datetime, progress: Progress = quiet
) -> RankedHours:
    """Rank the daylight hours (hh:30) after `now_utc`, of today and 13 days; return the best 12.

    Raises NotEnoughDataError if these days have no more daylight, InputError for a model, pairs or
    plan that cannot be read.
    """
    setup, now_utc = session.site_file(), now_utc.astimezone(UTC)
    trained = trained_kernel(session)
    task = choose.learning(setup.site, setup.room, weather, trained[0] if trained else None)
    captured = captured_features(session, task)
    days = span(sun.standard_date(now_utc, setup.site.timezone), AHEAD_DAYS)
    hours = daylight_hours(days, setup.site)
    hours = hours[[i for i, t in enumerate(hours.t_utc) if t > now_utc]]
    if not len(hours):
        raise NotEnoughDataError(
            f"polar night at {setup.site.name}: no daylight in the coming {AHEAD_DAYS} days; run "
            f"this command again later"
        )
    drop = _reductions(task, captured, hours, progress)
    planned = {slot.id for slot in session.slots()}
    best = [
        ComingHour(
            hours.t_utc[i],
            float(hours.altitude_deg[i]),
            float(hours.azimuth_deg[i]),
            100 * float(drop[i]),
            slot_id(hours.t_utc[i]) in planned,
        )
        for i in np.argsort(-drop)[:SHOWN]
    ]
    more = greedy_hours(
        task.kernel,
        task.year,
        task.year,
        BATCH,
        taken=captured,
        noise=choose.NOISE,
        progress=lambda finished, total, text: progress(SKIES + finished, SKIES + total, text),
    ).variance
    gained = float(1.0 - more[-1] / more[0])
    model = trained[1] if trained else ""
    return RankedHours(
        model, len(captured), 100 * float(more[0]), tuple(best), 100 * gained, gained >= WORTH
    )


def as_table(answer: RankedHours) -> JsonTable:
    """Return the ranking as plain values for `--json`; an empty model name becomes None."""
    return {
        "model": answer.model or None,
        "captured": answer.captured,
        "variance_left_percent": answer.variance_left_percent,
        "next_batch": {
            "captures": BATCH,
            "reduction_percent": answer.next_batch_percent,
            "pays": answer.pays,
        },
        "hours": [
            {
                "slot": slot_id(hour.t_utc),
                "t_utc": utc_text(hour.t_utc),
                "sun_altitude_deg": round(hour.sun_altitude_deg, 2),
                "sun_azimuth_deg": round(hour.sun_azimuth_deg, 2),
                "reduction_percent": hour.reduction_percent,
                "planned": hour.planned,
            }
            for hour in answer.hours
        ],
    }


def sentences(answer: RankedHours, site: Site) -> list[str]:
    """Return the ranking as lines to print, with the hours in the local time of `site`."""
    zone = ZoneInfo(site.timezone)
    share_left = (
        f"{answer.variance_left_percent:.2g} %" if answer.variance_left_percent < 99.5 else "all"
    )
    texts = [
        f"{answer.captured} captures leave {share_left} of the model's variance over the year"
        + (f" (model {answer.model})" if answer.model else "")
    ]
    for hour in answer.hours:
        when = f"{hour.t_utc.astimezone(zone):%a %Y-%m-%d %H:%M %Z}"
        where = (
            f"sun altitude {hour.sun_altitude_deg:3.0f}, azimuth {hour.sun_azimuth_deg:3.0f} deg"
        )
        planned = "  (planned)" if hour.planned else ""
        share = f"{hour.reduction_percent:5.1f} %"
        texts.append(f"  {when}  {where}  reduces this variance by {share}{planned}")
    verdict = "more captures are useful" if answer.pays else "more captures add little"
    texts.append(
        f"the best {BATCH} hours of a year would reduce this variance by "
        f"{answer.next_batch_percent:.0f} %: {verdict}"
    )
    return texts
