"""Summarise a predicted year: classes of glare protection, notes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from fieldlum.core.arrays import Mask
from fieldlum.core.records import utc_text
from fieldlum.learn.models import POOR_WORDS
from fieldlum.optics.projection import NOT_SEEN, PARTLY_SEEN, SEEN, compass_name, seen_shares
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.predict_json import (
    DirectionYear,
    PredictFile,
    YearOccupancy,
    YearWeather,
)
from fieldlum.session.site_toml import site_table
from fieldlum.version import __version__
from fieldlum.weather import Weather
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
_WIDE_DGP = 0.2  # an interval of this width spans all classes (EN 17037: 0.35 to 0.45)


def summary_of_year(
    room: ModelRoom,
    config: ModelConfig,
    weather: Weather,
    inputs: Mapping[str, Any],
    occupancy: Occupancy,
    annual: Annual,
    rows: tuple[DirectionYear, ...],
    occupied_hours: int,
    days: int,
) -> PredictFile:
    """Return the content of predict.json: settings, classes and notes.

    inputs: the result of `inputs_of`, and further options; rows: protection by direction;
    occupied_hours: lit and dark ones; days: number of days in the weather file.
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
            occupancy.text, occupied_hours, int(used.sum()), untrusted, untrusted + wide
        ),
        disc_from=room.disc_from,
        seen_share=_shares(room, annual),
        model_warnings=tuple(config.state.get("warnings", ())),
        notes=(*_notes(weather, room, untrusted, wide, days), *_unseen_notes(rows)),
        protection=rows,
    )


def poor(config: ModelConfig) -> bool:
    """Return whether the training warned that no single map of the model is trustworthy."""
    return any(POOR_WORDS in text for text in config.state.get("warnings", ()))


def _shares(room: ModelRoom, annual: Annual) -> tuple[float, ...]:
    if room.seen is None:
        return ()
    shares = seen_shares(room.seen, room.heading_deg, annual.azimuths_deg)
    return tuple(round(float(share), 3) for share in shares)


_UNSEEN_NOTES = {
    NOT_SEEN: "have no result: the camera's lens saw less than half of them; turn the camera to "
    "more headings, or use a lens that sees more",
    PARTLY_SEEN: "have bounds only: the lens saw 50 to 98 % of them, and the intervals assume that "
    "the unseen part has between 0 cd/m2 and the larger of the sky's mean luminance and the "
    "brightest hundredth of the seen pixels; turn the camera to more headings for smaller "
    "intervals",
}


def _unseen_notes(rows: Sequence[DirectionYear]) -> Iterator[str]:
    """Yield a note on directions without a result, and a note on directions with bounds only."""
    for word, meaning in _UNSEEN_NOTES.items():
        of = [row.azimuth_deg for row in rows if row.seen == word]
        if of:
            named = ", ".join(f"{a:.0f}° ({compass_name(a)})" for a in of)
            yield f"the view directions {named} {meaning}"


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
    # a weather file of a year may lack some days
    if days < 360:
        notes.append(
            f"the weather has {days} days, not a year: glare classes are for these days only"
        )
    if weather.synthetic:
        notes.append("the weather is synthetic: it must not be used to judge this place")
    notes += list(room.sky_view.notes) if room.sky_view else [room.disc_from]
    if untrusted + wide > 0.05:
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


def best_and_worst(rows: Sequence[DirectionYear]) -> tuple[DirectionYear, DirectionYear] | None:
    """Return the directions with the least and with the most glare; None if none has a class.

    The order is by the DGP exceeded in 5 % of the occupied hours, then by the hours above the
    limits. To be the best, a partly seen direction counts with the upper end of its interval (1 if
    unknown), so that an unseen part never makes a direction a recommendation.
    """
    judged = [row for row in rows if row.glare_class != NOT_SEEN]
    if not judged:
        return None

    def glare(row: DirectionYear) -> tuple[float, int]:
        return row.dgp_exceeded or 0.0, sum(count or 0 for count in row.hours_over.values())

    def as_best(row: DirectionYear) -> tuple[float, int]:
        upper = 1.0 if row.high is None else row.high
        return glare(row) if row.seen == SEEN else (upper, glare(row)[1])

    return min(judged, key=as_best), max(judged, key=glare)
