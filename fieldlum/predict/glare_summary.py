"""What a predicted year means: classes of glare protection, what is open, what to capture, what
to be told.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum import __version__
from fieldlum.glare.standards import (
    EXCEEDED_SHARE,
    Protection,
    hours_to_capture,
    nearest_limits,
    protection,
)
from fieldlum.predict.annual import Annual
from fieldlum.predict.blocks import ModelRoom
from fieldlum.predict.occupancy import Occupancy
from fieldlum.profiles import site_table
from fieldlum.records import utc_text

if TYPE_CHECKING:
    from fieldlum.weather import Weather

HOURLY_MEANS = (
    "Weather files hold hourly means. Under broken cloud the sun comes and goes within the hour: "
    "the mean shows it "
    "dimmed all the time, so that single moments are brighter and darker than any hour here, and "
    "hours of glare are "
    "shorter or longer than counted."
)
NOISY_TRUST = 0.05  # a larger share of occupied hours outside what was seen is said aloud
HOURS_NAMED = 12
WHOLE_YEAR_DAYS = 360


def judge(annual: Annual, occupied_hours: int, seed: int) -> Protection:
    """EN 17037 for each direction over the occupied hours."""
    used = annual.occupied
    u_dgp = annual.views["u_dgp"][used]
    known = u_dgp if np.isfinite(u_dgp).all() else None
    rng = np.random.default_rng(seed)
    return protection(annual.views["dgp"][used], known, occupied_hours, annual.azimuths_deg, rng)


def hours_to_settle(annual: Annual, found: Protection, zone: str) -> list[dict[str, Any]]:
    """The occupied hours whose uncertainty keeps a class open, most first, at most one a day."""
    if found.low is None or found.certain.all():
        return []
    used = np.flatnonzero(annual.occupied)
    dgp, u = annual.views["dgp"][used], annual.views["u_dgp"][used]
    worth = hours_to_capture(dgp, u, ~found.certain, nearest_limits(found))
    named, days = [], set()
    for k in np.argsort(worth)[::-1]:
        local = annual.t_utc[used[k]].astimezone(ZoneInfo(zone))
        if worth[k] <= 0.0 or len(named) == HOURS_NAMED:
            break
        if local.date() in days:
            continue
        days.add(local.date())
        named.append(
            {
                "date": local.strftime("%d %B"),
                "hour": local.strftime("%H:%M"),
                "dni_wm2": float(annual.hours["dni_wm2"][used[k]]),
                "dhi_wm2": float(annual.hours["dhi_wm2"][used[k]]),
                "worth": float(worth[k]),
            }
        )
    return named


def about_year(
    room: ModelRoom,
    config: dict[str, Any],
    weather: Weather,
    inputs: dict[str, Any],
    occupancy: Occupancy,
    annual: Annual,
    found: Protection,
    days: int,
) -> dict[str, Any]:
    used = annual.occupied
    untrusted = float((annual.hours["trusted"][used] < 1).mean()) if used.any() else 0.0
    return {
        "software": {"fieldlum": __version__},
        "inputs": inputs,
        "model": config["model"],
        "setup": site_table(room.setup),
        "height": room.height,
        "width": room.width,
        "heading_deg": room.heading_deg,
        "azimuths_deg": annual.azimuths_deg.tolist(),
        "weather": {
            "name": weather.name,
            "synthetic": weather.synthetic,
            "repairs": list(weather.repairs),
        },
        "hours": len(annual),
        "days": days,
        "first": utc_text(annual.t_utc[0]),
        "last": utc_text(annual.t_utc[-1]),
        "occupancy": {
            "text": occupancy.text,
            "hours": found.occupied_hours,
            "lit": int(used.sum()),
            "untrusted_share": untrusted,
        },
        "disc_from": room.disc_from,
        "notes": _notes(weather, room, untrusted, days),
        "protection": protection_table(found),
        "capture_next": hours_to_settle(annual, found, room.setup.site.timezone),
    }


def _notes(weather: Weather, room: ModelRoom, untrusted: float, days: int) -> list[str]:
    notes = [HOURLY_MEANS]
    if days < WHOLE_YEAR_DAYS:
        notes.append(f"the weather holds {days} days, not a year: classes are for these days only")
    if weather.synthetic:
        notes.append("the weather is synthetic: it must not be used to judge this place")
    if not room.setup.room:
        notes.append(f"whether the sun's disc is in view is {room.disc_from}")
    if untrusted > NOISY_TRUST:
        notes.append(
            f"{100 * untrusted:.0f} % of the lit occupied hours have a sun or a sky unlike any "
            f"that was captured: "
            "their figures, and the intervals, rest on extrapolation"
        )
    return notes


def protection_table(found: Protection) -> list[dict[str, Any]]:
    """One plain dict a direction."""
    return [
        {
            "azimuth_deg": float(found.azimuths_deg[i]),
            "class": found.classes[i],
            "certain": bool(found.certain[i]),
            "dgp_exceeded": float(found.dgp_exceeded[i]),
            "low": None if found.low is None else float(found.low[i]),
            "high": None if found.high is None else float(found.high[i]),
            "share": EXCEEDED_SHARE,
            "hours_over": {"0.35": int(over[0]), "0.40": int(over[1]), "0.45": int(over[2])},
            "sentence": found.sentence(i),
        }
        for i, over in enumerate(found.hours_over)
    ]
