"""Rank coming hours by how much each reduces the model's uncertainty.

The ranking also shows whether more captures pay.
"""

from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.errors import NotEnoughDataError, input_errors
from fieldlum.core.records import JsonTable, Site, parse_utc, slot_id, utc_text
from fieldlum.plan import choose
from fieldlum.plan.capture_days import DaylightHours, daylight_hours, span
from fieldlum.plan.makeup import captured_ids
from fieldlum.session import Session
from fieldlum.session.codec import NPZ_ERRORS, read_arrays
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at
from fieldlum.sky.daylight_kernel import Facades, Features, Kernel, greedy_hours, light_features
from fieldlum.weather import Weather

AHEAD_DAYS = 14  # days ahead that are ranked; chosen
BATCH = 25  # number of captures in a batch, by which "pays" is decided; chosen


def trained_kernel(session: Session) -> tuple[Kernel, str] | None:
    """Return the kernel and the name of the session's newest transport model; None if it has none.

    A model that was trained 0.1 degrees of latitude or longitude away (11 km) is skipped. Raises
    InputError for a model folder with wrong content.
    """
    site = session.site_file().site
    place = {"latitude_deg": site.latitude_deg, "longitude_deg": site.longitude_deg}
    for folder in session.trained_models():
        config = ModelConfig.read(folder)
        trained_at = config.setup.get("site", {})
        off = (abs(float(trained_at.get(name, value)) - value) for name, value in place.items())
        if config.model != "transport" or max(off) >= 0.1:
            continue
        remedy = "train the model again (fieldlum train)"
        with input_errors(folder, "a transport model", remedy, *NPZ_ERRORS, TypeError):
            arrays = read_arrays(folder / "weights.npz")
            table = config.state["transport"]["kernel"]
            names, weights = table["facades"], {k: v for k, v in table.items() if k != "facades"}
            facades = Facades(*(arrays[names[n]] for n in ("azimuths_deg", "weights")))
            return Kernel(facades, **weights), folder.name
    return None


def captured_features(session: Session, task: choose.Learning) -> Features:
    """Return the light features of the completed captures and usable pairs.

    A capture with a usable row in pairs.csv has its measured irradiance. One without has the
    irradiance of the weather year of `task`, and is omitted if that has none then.
    """
    pairs = PairsFile.find(session.pairs).usable
    times, dni, dhi = ([getattr(p, n) for p in pairs] for n in ("t_utc", "dni_wm2", "dhi_wm2"))
    paired = {slot_id(t) for t in times} | {Path(p.panorama).stem for p in pairs if p.panorama}
    unpaired = captured_ids(session) - paired  # the time of a pair is the middle of its bracket
    others = [slot.t_utc for slot in session.slots() if slot.id in unpaired]
    typical, times = task.weather.at(others), [*times, *others]
    dni, dhi = np.r_[dni, typical.dni_wm2], np.r_[dhi, typical.dhi_wm2]
    rows = np.flatnonzero(np.isfinite(dni + dhi))
    return light_features(light_at([times[i] for i in rows], task.site, dni[rows], dhi[rows]))


def _season_sky(weather: Weather, hours: DaylightHours) -> sun.Irradiance:
    """Return the mean sky of seven days around each hour, three days apart, [n] each."""
    days = [timedelta(days=k) for k in range(-9, 10, 3)]
    skies = [weather.at([t + day for t in hours.t_utc]) for day in days]
    count = np.maximum(np.isfinite([sky.dhi_wm2 for sky in skies]).sum(axis=0), 1)
    return sun.Irradiance(*(np.nansum(value, axis=0) / count for value in zip(*skies, strict=True)))


def run(session: Session, weather: Weather, now_utc: datetime) -> JsonTable:
    """Rank the daylight hours (hh:30) after `now_utc`, of today and 13 days; return the best 12.

    The keys are those of `--json`. model: trained model of the kernel, None for an untrained kernel
    of the facades; captured: number of captures; variance_left_percent: share of the prior variance
    over the year that they leave; hours: slot, t_utc, sun_altitude_deg (true), sun_azimuth_deg,
    reduction_percent (of the prior variance, by a capture then, after those above it, under the
    mean sky of the season) and planned of each; next_batch: captures (25), reduction_percent by the
    best 25 hours of the year, and pays (from 10 % on).

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
    coming = f"in the coming {AHEAD_DAYS} days"
    if not len(hours):
        text = f"polar night at {setup.site.name}: no daylight {coming}; run this command again"
        raise NotEnoughDataError(f"{text} later")
    rows, pool = choose.features_at(hours, task, _season_sky(weather, hours))
    if not len(rows):
        text = f"{weather.name}: the weather has no daylight {coming}; use a typical year"
        raise NotEnoughDataError(text)
    greedy = partial(greedy_hours, task.kernel, task.year, taken=captured)
    (best, variance), (_, year) = greedy(pool, 12), greedy(task.year, BATCH)
    planned = {slot.id for slot in session.slots()}
    gained = float(100.0 * (1.0 - year[-1] / year[0]))
    drops = -100.0 * np.diff(variance) / year[0]
    return {
        "model": trained[1] if trained else None,
        "captured": len(captured),
        "variance_left_percent": 100.0 * year[0],
        "hours": [
            {
                "slot": slot_id(hours.t_utc[i]),
                "t_utc": utc_text(hours.t_utc[i]),
                "sun_altitude_deg": round(float(hours.altitude_deg[i]), 2),
                "sun_azimuth_deg": round(float(hours.azimuth_deg[i]), 2),
                "reduction_percent": drop,
                "planned": slot_id(hours.t_utc[i]) in planned,
            }
            for i, drop in zip(rows[best], drops.tolist(), strict=True)
        ],
        "next_batch": {"captures": BATCH, "reduction_percent": gained, "pays": gained >= 10.0},
    }


def sentences(answer: JsonTable, site: Site) -> list[str]:
    """Return the ranking as lines to print, with the hours in the local time of `site`."""
    zone, percent = ZoneInfo(site.timezone), answer["variance_left_percent"]
    share_left = f"{percent:.2g} %" if percent < 99.5 else "all"
    model = f" (model {answer['model']})" if answer["model"] else ""
    of_year = f"{share_left} of the model's variance over the year{model}"
    texts = [f"{answer['captured']} captures leave {of_year}"]
    for hour in answer["hours"]:
        local = parse_utc(hour["slot"]).astimezone(zone)
        texts.append(
            f"  {local:%a %Y-%m-%d %H:%M %Z}  sun altitude {hour['sun_altitude_deg']:3.0f}, "
            f"azimuth {hour['sun_azimuth_deg']:3.0f} deg  reduces this variance by "
            f"{hour['reduction_percent']:5.1f} %{'  (planned)' if hour['planned'] else ''}"
        )
    batch = answer["next_batch"]
    verdict = "more captures are useful" if batch["pays"] else "more captures add little"
    texts.append(
        f"the best {BATCH} hours of a year would reduce this variance by "
        f"{batch['reduction_percent']:.0f} %: {verdict}"
    )
    return texts
