"""Rank coming hours by how much each reduces the model's uncertainty.

The ranking also shows whether more captures pay.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import NotEnoughDataError, input_errors
from fieldlum.core.records import JsonTable, Progress, Site, quiet, slot_id, utc_text
from fieldlum.plan import choose
from fieldlum.plan.days import DaylightHours, daylight_hours, span
from fieldlum.plan.makeup import captured_ids
from fieldlum.session import Session
from fieldlum.session.files.model_files import ModelConfig
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
MIN_VARIANCE_REDUCTION = 0.10


@dataclass(frozen=True, slots=True)
class ComingHour:
    """One coming daylight hour, and how much a capture then would reduce the model's uncertainty.

    reduction_percent: of the remaining variance over the year, as a mean over skies of the season;
    planned: whether the hour is a slot of the plan.
    """

    slot: str
    t_utc: datetime
    sun_altitude_deg: float
    sun_azimuth_deg: float
    reduction_percent: float
    planned: bool


@dataclass(frozen=True, slots=True)
class RankedHours:
    """Coming hours, the most useful first, and whether 25 more captures would pay.

    model: trained model of the kernel, None for an untrained kernel of the facades; captured:
    number of captures; variance_left_percent: share of the prior variance over the year that they
    leave; next_batch_percent: share of that variance which the best 25 hours of the year would
    remove; pays: whether this is at least 10 %.
    """

    model: str | None
    captured: int
    variance_left_percent: float
    hours: tuple[ComingHour, ...]
    next_batch_percent: float

    @property
    def pays(self) -> bool:
        """Whether a batch of captures would reduce the remaining variance by at least 10 %."""
        return self.next_batch_percent >= 100 * MIN_VARIANCE_REDUCTION


def trained_kernel(session: Session) -> tuple[Kernel, str] | None:
    """Return the kernel and the name of the session's newest transport model; None if it has none.

    A model that was trained 0.1 degrees of latitude or longitude away, or more, is skipped. Raises
    InputError for a model folder with wrong content.
    """
    folders = [path for path in session.model_folders() if (path / "weights.npz").is_file()]
    site = session.site_file().site
    here = {"latitude_deg": site.latitude_deg, "longitude_deg": site.longitude_deg}
    for folder in sorted(folders, key=lambda p: -(p / "config.json").stat().st_mtime):
        config = ModelConfig.read(folder)
        there = config.setup.get("site", {})
        off = (abs(float(there.get(name, value)) - value) for name, value in here.items())
        if config.model != "transport" or max(off) >= SAME_PLACE_DEG:
            continue
        kinds = (OSError, ValueError, KeyError, TypeError)
        remedy = "train the model again (fieldlum train)"
        with (
            input_errors(folder, "a transport model", remedy, *kinds),
            np.load(folder / "weights.npz", allow_pickle=False) as arrays,
        ):
            facades = Facades(*(np.array(arrays[f"facade_{n}"]) for n in ("azimuths", "weights")))
            return Kernel(facades, **config.state["transport"]["kernel"]), folder.name
    return None


def captured_features(session: Session, task: choose.Learning) -> Features:
    """Return the light features of the n completed captures and usable pairs, [n].

    A capture with a usable row in pairs.csv has its measured irradiance. One without has the
    irradiance of the weather year, and is omitted if that has none then.
    """
    rows = PairsFile.find(session.pairs).usable
    times, dni, dhi = ([getattr(r, n) for r in rows] for n in ("t_utc", "dni_wm2", "dhi_wm2"))
    unpaired = captured_ids(session) - {slot_id(t) for t in times}
    others = [slot.t_utc for slot in session.slots() if slot.id in unpaired]
    if others:
        typical = task.weather.at(others)
        is_known = np.isfinite(typical.dni_wm2 + typical.dhi_wm2)
        times += [t for t, ok in zip(others, is_known, strict=True) if ok]
        dni = [*dni, *typical.dni_wm2[is_known]]
        dhi = [*dhi, *typical.dhi_wm2[is_known]]
    return light_features(light_at(times, task.site, np.array(dni, float), np.array(dhi, float)))


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
    drop = 100.0 * _reductions(task, captured, hours, progress)
    planned = {slot.id for slot in session.slots()}
    best = []
    for i in np.argsort(-drop)[:SHOWN].tolist():
        t_utc, slot = hours.t_utc[i], slot_id(hours.t_utc[i])
        angles = float(hours.altitude_deg[i]), float(hours.azimuth_deg[i])
        best.append(ComingHour(slot, t_utc, *angles, float(drop[i]), slot in planned))
    more = greedy_hours(
        task.kernel,
        task.year,
        task.year,
        BATCH,
        taken=captured,
        noise=choose.NOISE,
        progress=lambda finished, total, text: progress(SKIES + finished, SKIES + total, text),
    ).variance
    left, gained = 100 * float(more[0]), 100 * float(1.0 - more[-1] / more[0])
    return RankedHours(trained[1] if trained else None, len(captured), left, tuple(best), gained)


def as_table(answer: RankedHours) -> JsonTable:
    """Return the ranking as plain values for `--json`."""
    table = asdict(answer)
    reduction_percent = table.pop("next_batch_percent")
    batch = {"captures": BATCH, "reduction_percent": reduction_percent, "pays": answer.pays}
    for hour in table["hours"]:
        hour["t_utc"] = utc_text(hour["t_utc"])
        hour |= {n: round(hour[n], 2) for n in ("sun_altitude_deg", "sun_azimuth_deg")}
    return table | {"next_batch": batch}


def sentences(answer: RankedHours, site: Site) -> list[str]:
    """Return the ranking as lines to print, with the hours in the local time of `site`."""
    zone, left = ZoneInfo(site.timezone), answer.variance_left_percent
    share_left = f"{left:.2g} %" if left < 99.5 else "all"
    model = f" (model {answer.model})" if answer.model else ""
    of_year = f"{share_left} of the model's variance over the year{model}"
    texts = [f"{answer.captured} captures leave {of_year}"]
    for hour in answer.hours:
        angles = f"altitude {hour.sun_altitude_deg:3.0f}, azimuth {hour.sun_azimuth_deg:3.0f} deg"
        texts.append(
            f"  {hour.t_utc.astimezone(zone):%a %Y-%m-%d %H:%M %Z}  sun {angles}  reduces this "
            f"variance by {hour.reduction_percent:5.1f} %{'  (planned)' if hour.planned else ''}"
        )
    verdict = "more captures are useful" if answer.pays else "more captures add little"
    texts.append(
        f"the best {BATCH} hours of a year would reduce this variance by "
        f"{answer.next_batch_percent:.0f} %: {verdict}"
    )
    return texts
