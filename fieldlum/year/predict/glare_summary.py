"""Summarise a predicted year: classes of glare protection, hours still to capture, notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import utc_text
from fieldlum.learn.models import POOR_WORDS
from fieldlum.optics.projection import NOT_SEEN, PARTLY_SEEN, SEEN, compass_name, seen_shares
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.predict_json import (
    DirectionYear,
    PredictFile,
    SkyToCapture,
    YearOccupancy,
    YearWeather,
)
from fieldlum.session.site_toml import site_table
from fieldlum.version import __version__
from fieldlum.weather import Weather
from fieldlum.year.glare.budget import Budget, year_budget
from fieldlum.year.glare.standards import (
    EXCEEDED_SHARE,
    GlareDoubt,
    Protection,
    dgp_per_scale,
    hours_to_capture,
    nearest_limits,
    protection,
)
from fieldlum.year.predict.annual import Annual
from fieldlum.year.predict.blocks import ModelRoom
from fieldlum.year.predict.occupancy import Occupancy

HOURLY_MEANS = (
    "Each hour of the year has one value of the weather. In most weather files it is a mean: under "
    "broken cloud the sun comes and goes within the hour, but the mean shows a constant, dimmed "
    "sun. In files of PVGIS it is one moment, which stands for the hour. So the number of glare "
    "hours can be too low or too high."
)
# a larger share of occupied hours outside the captures is reported; not measured
NOISY_TRUST = 0.05
HOURS_NAMED = 12  # one row of the report's table for each month
WHOLE_YEAR_DAYS = 360  # a year may lack some days in a weather file; chosen
_WIDE_DGP = 0.2  # an interval of this width spans all classes (EN 17037: 0.35 to 0.45)


def judge(
    annual: Annual,
    doubt: GlareDoubt,
    u_of_maps: Floats,
    occupied_hours: int,
    seed: int,
    u_scale: float = 0.0,
) -> Protection:
    """Return the EN 17037 glare protection of d view directions over the occupied hours.

    u_of_maps: standard uncertainty of DGP due to the model's maps, in all n daylight hours of
    `annual`, occupied or not, [n, d]. doubt: possible DGP due to the sun's disc and to unseen parts
    of views, in the same hours. occupied_hours: their number, with those in the
    dark, which have no glare. The intervals are None if an uncertainty is unknown. seed: for the
    random draws. u_scale: relative standard uncertainty of the camera's scale in all hours.
    """
    used = annual.occupied
    u_dgp = u_of_maps[used]
    u_values = u_dgp if np.isfinite(u_dgp[:, annual.judged]).all() else None
    rng = np.random.default_rng(seed)
    dgp = annual.views["dgp"][used]
    of_scale = u_scale * dgp_per_scale(dgp, annual.views["ev_lx"][used])
    doubts = doubt.hours(used)
    return protection(dgp, u_values, occupied_hours, annual.azimuths_deg, rng, doubts, of_scale)


def budget_of_year(
    annual: Annual, doubt: GlareDoubt, u_of_maps: Floats, occupied_hours: int, u_scale: float
) -> list[Budget]:
    """Return the budget of each seen direction's DGP, with arguments as for `judge`."""
    used = annual.occupied
    dgp, ev_lx = annual.views["dgp"][used], annual.views["ev_lx"][used]
    doubts, azimuths = doubt.hours(used), annual.azimuths_deg
    return year_budget(dgp, ev_lx, u_of_maps[used], doubts, occupied_hours, azimuths, u_scale)


def hours_to_settle(annual: Annual, protection: Protection, zone: str) -> list[SkyToCapture]:
    """Return up to twelve occupied hours whose uncertainty keeps a class open, most useful first.

    Each day has at most one hour. Only fully seen directions count: captures with the same lens
    cannot settle the others. The list is empty if all these are settled or the model states no
    uncertainty. protection: the result of `judge`; zone: time zone of the dates and hours.
    """
    undecided = ~protection.certain & np.array([word == SEEN for word in protection.seen])
    if protection.low is None or not undecided.any():
        return []
    used = np.flatnonzero(annual.occupied)
    dgp, u = annual.views["dgp"][used], annual.views["u_dgp"][used]
    worth = hours_to_capture(dgp, u, undecided, nearest_limits(protection))
    named, days = [], set()
    for k in np.argsort(worth)[::-1]:
        local = annual.t_utc[used[k]].astimezone(ZoneInfo(zone))
        if worth[k] <= 0.0 or len(named) == HOURS_NAMED:
            break
        if local.date() in days:
            continue
        days.add(local.date())
        named.append(
            SkyToCapture(
                local.strftime("%d %B"),
                local.strftime("%H:%M"),
                float(annual.hours["dni_wm2"][used[k]]),
                float(annual.hours["dhi_wm2"][used[k]]),
                float(worth[k]),
            )
        )
    return named


def summary_of_year(
    room: ModelRoom,
    config: ModelConfig,
    weather: Weather,
    inputs: Mapping[str, Any],
    occupancy: Occupancy,
    annual: Annual,
    protection: Protection,
    days: int,
) -> PredictFile:
    """Return the content of predict.json: settings, classes, notes and hours to capture.

    inputs: the result of `inputs_of`, and further options; protection: the result of `judge`; days:
    number of days in the weather file.
    """
    used = annual.occupied
    count = max(int(used.sum()), 1)
    untrusted, wide = (float(hours.sum()) / count for hours in unsure_hours(annual))
    return PredictFile(
        software={"fieldlum": __version__},
        inputs=inputs,
        model=config.model,
        setup=site_table(room.setup),
        height=room.height,
        width=room.width,
        heading_deg=room.heading_deg,
        azimuths_deg=tuple(annual.azimuths_deg.tolist()),
        weather=YearWeather(weather.name, weather.synthetic, tuple(weather.repairs)),
        hours=len(annual),
        days=days,
        first=utc_text(annual.t_utc[0]),
        last=utc_text(annual.t_utc[-1]),
        occupancy=YearOccupancy(
            occupancy.text,
            protection.occupied_hours,
            int(used.sum()),
            untrusted,
            untrusted + wide,
        ),
        disc_from=room.disc_from,
        seen_share=() if room.seen is None else tuple(_shares(room, annual)),
        model_warnings=tuple(config.state.get("warnings", ())),
        notes=(
            *_notes(weather, room, untrusted, wide, days),
            *_unseen_notes(protection),
        ),
        protection=protection_of(protection),
        capture_next=tuple(hours_to_settle(annual, protection, room.setup.site.timezone)),
    )


def poor(config: ModelConfig) -> bool:
    """Return whether the training warned that no single map of the model is trustworthy."""
    return any(POOR_WORDS in text for text in config.state.get("warnings", ()))


def _shares(room: ModelRoom, annual: Annual) -> list[float]:
    assert room.seen is not None
    shares = seen_shares(room.seen, room.heading_deg, annual.azimuths_deg)
    return [round(float(share), 3) for share in shares]


def _unseen_notes(protection: Protection) -> list[str]:
    """Return a note on directions without a result, and a note on directions with bounds only."""
    notes = []
    for word, meaning in (
        (
            NOT_SEEN,
            "have no result: the camera's lens saw less than half of them; turn the camera to more "
            "headings, or use a lens that sees more",
        ),
        (
            PARTLY_SEEN,
            "have bounds only: the lens saw 50 to 98 % of them, and the intervals assume that the "
            "unseen part has between 0 cd/m2 and the larger of the sky's mean luminance and the "
            "brightest hundredth of the seen pixels; turn the camera to more headings for smaller "
            "intervals",
        ),
    ):
        of = [
            a
            for a, view_word in zip(protection.azimuths_deg, protection.seen, strict=True)
            if view_word == word
        ]
        if of:
            named = ", ".join(f"{a:.0f}° ({compass_name(a)})" for a in of)
            notes.append(f"the view directions {named} {meaning}")
    return notes


def unsure_hours(annual: Annual) -> tuple[Mask, Mask]:
    """Return the lit occupied hours with an untrusted map, and the others with a wide interval.

    An interval of DGP is wide if its 95 % are wider than 0.2 in a direction that was seen. Masks
    over all hours of `annual`, [n].
    """
    untrusted = annual.occupied & (annual.hours["trusted"] < 1)
    gap = (annual.views["dgp_high"] - annual.views["dgp_low"])[:, annual.judged]
    widest = np.nan_to_num(gap).max(axis=1, initial=0.0)
    return untrusted, annual.occupied & ~untrusted & (widest > _WIDE_DGP)


def _notes(
    weather: Weather, room: ModelRoom, untrusted: float, wide: float, days: int
) -> list[str]:
    notes = [HOURLY_MEANS]
    if days < WHOLE_YEAR_DAYS:
        notes.append(
            f"the weather has {days} days, not a year: glare classes are for these days only"
        )
    if weather.synthetic:
        notes.append("the weather is synthetic: it must not be used to judge this place")
    notes += list(room.sky_view.notes) if room.sky_view else [room.disc_from]
    if untrusted + wide > NOISY_TRUST:
        mirror = "a mirrored sun may be in view, " if room.mirrors else ""
        notes.append(
            f"DGP is uncertain in {100 * (untrusted + wide):.0f} % of the occupied hours with "
            f"daylight. In {100 * untrusted:.0f} % no similar light was captured, {mirror}or the "
            f"model expects a large error. In {100 * wide:.0f} % the 95 % interval is wider than "
            f"{_WIDE_DGP:g} in some direction: often the sky view does not decide whether the "
            "sun's disc is seen; capture clear hours with the sun in a window, which also give the "
            "camera's heading"
        )
    return notes


def protection_of(protection: Protection) -> tuple[DirectionYear, ...]:
    """Return one record for each direction, in the order of `protection`.

    The DGP and the hours of an unseen direction are None, and so is an interval without
    uncertainty.
    """
    rows = []
    for i, over in enumerate(protection.hours_over):
        judged = bool(protection.judged[i])
        low, high = (
            None if ends is None else ends[i] for ends in (protection.low, protection.high)
        )
        hours = zip(("0.35", "0.40", "0.45"), over, strict=True)
        rows.append(
            DirectionYear(
                float(protection.azimuths_deg[i]),
                protection.classes[i],
                bool(protection.certain[i]),
                protection.seen[i],
                float(protection.dgp_exceeded[i]) if judged else None,
                float(low) if judged and low is not None else None,
                float(high) if judged and high is not None else None,
                EXCEEDED_SHARE,
                {name: int(count) if judged else None for name, count in hours},
                protection.sentence(i),
            )
        )
    return tuple(rows)


def best_and_worst(
    rows: Sequence[DirectionYear],
) -> tuple[DirectionYear, DirectionYear] | None:
    """Return the directions with the least and with the most glare; None if none has a class.

    The order is by the DGP exceeded in 5 % of the occupied hours, then by the hours above the
    limits. To be the best, a partly seen direction counts with the upper end of its interval (1 if
    unknown), so that an unseen part never makes a direction a recommendation.
    """
    judged = [row for row in rows if row.glare_class != NOT_SEEN]
    if not judged:
        return None

    def over(row: DirectionYear) -> int:
        return sum(count or 0 for count in row.hours_over.values())

    def as_best(row: DirectionYear) -> tuple[float, int]:
        if row.seen == SEEN:
            return _exceeded(row), over(row)
        return (1.0 if row.high is None else row.high), over(row)

    best = min(judged, key=as_best)
    worst = max(judged, key=lambda row: (_exceeded(row), over(row)))
    return best, worst


def _exceeded(row: DirectionYear) -> float:
    return 0.0 if row.dgp_exceeded is None else row.dgp_exceeded
