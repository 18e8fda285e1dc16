"""The most useful coming hours: how much each would lower the model's uncertainty, and whether
it still pays.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.light import Facades, Features, Kernel, greedy_hours, light_at, light_features
from fieldlum.plan import choose
from fieldlum.plan.days import DaylightHours, daylight_hours, span
from fieldlum.plan.makeup import captured_ids
from fieldlum.records import Progress, Site, quiet, slot_id, utc_text
from fieldlum.session import Session
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.weather import Weather

AHEAD_DAYS, SHOWN = 14, 12
SKIES = 7  # the same hour on days around, in the weather year: what the sky may be like
BATCH = 25  # captures to judge by
SAME_PLACE_DEG = 0.1
WORTH = 0.10  # a batch that takes less than this share of what is left no longer pays


@dataclass(frozen=True, slots=True)
class ComingHour:
    t_utc: datetime
    sun_altitude_deg: float
    sun_azimuth_deg: float
    reduction_percent: float  # of the variance left, expected over the skies of the season
    planned: bool


@dataclass(frozen=True, slots=True)
class RankedHours:
    model: str  # whose kernel it is; empty: of no trained model, by the room's facades
    captured: int
    variance_left_percent: float  # of the prior's, over the year
    hours: tuple[ComingHour, ...]  # best first
    next_batch_percent: float  # of the variance left, by the best BATCH hours of the whole year
    pays: bool


def trained_kernel(session: Session) -> tuple[Kernel, str] | None:
    """The kernel of the session's newest transport model, and its name; None before training.

    A model that was trained at another place is passed over.

    Raises InputError for a model folder that does not hold what it should.
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
                folder, f"{type(error).__name__}: {error}", "a transport model", "train again"
            ) from None
    return None


def _of_this_place(config: ModelConfig, site: Site) -> bool:
    place = config.setup.get("site", {})
    pairs = (("latitude_deg", site.latitude_deg), ("longitude_deg", site.longitude_deg))
    return all(abs(float(place.get(name, here)) - here) < SAME_PLACE_DEG for name, here in pairs)


def captured_features(session: Session, task: choose.Learning) -> Features:
    """Features of what was captured: by the measured irradiance of pairs.csv, else by the
    weather year's.
    """
    times, dni, dhi = _paired(session)
    known = {slot_id(t) for t in times}
    captured = captured_ids(session) - known
    others = [slot.t_utc for slot in session.slots() if slot.id in captured]
    if others:
        typical = task.weather.at(others)
        sound = np.isfinite(typical.dni_wm2 + typical.dhi_wm2)
        times += [t for t, ok in zip(others, sound, strict=True) if ok]
        dni, dhi = [*dni, *typical.dni_wm2[sound]], [*dhi, *typical.dhi_wm2[sound]]
    return light_features(light_at(times, task.site, np.array(dni, float), np.array(dhi, float)))


def _paired(session: Session) -> tuple[list[datetime], list[float], list[float]]:
    rows = PairsFile.find(session.pairs).usable
    return [r.t_utc for r in rows], [r.dni_wm2 for r in rows], [r.dhi_wm2 for r in rows]


def _reductions(
    task: choose.Learning, captured: Features, hours: DaylightHours, progress: Progress
) -> NDArray[np.float64]:
    """Expected drop of the year's variance by each hour [n], as a share of what is left, over
    its season's skies.
    """
    base = choose.variance_left(task, captured)
    total, seen = np.zeros(len(hours)), np.zeros(len(hours))
    for done, days in enumerate(np.arange(SKIES) * 3 - 3 * (SKIES // 2)):
        progress(done, SKIES + BATCH, "skies of the season")
        found = task.weather.at([t + timedelta(days=int(days)) for t in hours.t_utc])
        sound = np.isfinite(found.dni_wm2 + found.dhi_wm2) & (found.dhi_wm2 > 0)
        rows = np.flatnonzero(sound)
        if not len(rows):
            continue
        chosen = hours[rows]
        light = light_at(chosen.t_utc, task.site, found.dni_wm2[rows], found.dhi_wm2[rows])
        total[rows] += _single_gains(task, captured, light_features(light)) / base
        seen[rows] += 1
    return total / np.maximum(seen, 1)


def _single_gains(task: choose.Learning, captured: Features, pool: Features) -> NDArray[np.float64]:
    """Drop of the year's mean variance by each hour of the pool alone, as a share of the
    prior's.
    """
    kernel = task.kernel
    cross, own = kernel(task.year, pool), kernel.diagonal(pool)
    if len(captured):
        known = kernel(captured, captured) + choose.NOISE * np.eye(len(captured))
        towards = np.linalg.solve(known, kernel(captured, pool))
        cross = cross - kernel(task.year, captured) @ towards
        own = own - np.einsum("ij,ij->j", kernel(captured, pool), towards)
    gain = (cross**2).sum(axis=0) / (np.maximum(own, 0) + choose.NOISE)
    return gain / kernel.diagonal(task.year).sum()


def run(
    session: Session, weather: Weather, now_utc: datetime, progress: Progress = quiet
) -> RankedHours:
    """Rank the daylight hours of the coming two weeks. Raises NotEnoughDataError when the sun
    does not rise in them.
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
            f"polar night at {setup.site.name}: no daylight in the coming {AHEAD_DAYS} days"
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
        progress=lambda done, total, text: progress(SKIES + done, SKIES + total, text),
    ).variance
    gained = float(1.0 - more[-1] / more[0])
    model = trained[1] if trained else ""
    return RankedHours(
        model, len(captured), 100 * float(more[0]), tuple(best), 100 * gained, gained >= WORTH
    )


def as_table(answer: RankedHours) -> dict[str, Any]:
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
    zone = ZoneInfo(site.timezone)
    left = f"{answer.variance_left_percent:.2g} %" if answer.variance_left_percent < 99.5 else "all"
    said = [
        f"{answer.captured} captures leave {left} of the uncertainty about the year"
        + (f", says {answer.model}" if answer.model else "")
    ]
    for hour in answer.hours:
        when = f"{hour.t_utc.astimezone(zone):%a %Y-%m-%d %H:%M %Z}"
        where = f"sun {hour.sun_altitude_deg:3.0f} deg high at {hour.sun_azimuth_deg:3.0f}"
        planned = "  (planned)" if hour.planned else ""
        said.append(f"  {when}  {where}  takes {hour.reduction_percent:5.1f} % of it{planned}")
    verdict = "more captures pay" if answer.pays else "more captures no longer pay"
    said.append(
        f"the best {BATCH} hours of a year would take {answer.next_batch_percent:.0f} % of it: "
        f"{verdict}"
    )
    return said
