"""Compute the irradiance during a bracket, and whether the bracket may be used."""

from datetime import datetime
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.session.files.irradiance_csv import MEASURED, CleanIrradiance


class BracketIrradiance(NamedTuple):
    """Outdoor irradiance during a bracket; NaN is unknown.

    ghi_wm2, dhi_wm2, dni_wm2: means of global and diffuse horizontal and direct normal irradiance.
    steadiness: (max - min) / mean of the global; 0 is perfectly steady. source: instrument or model
    of the values. rows: number of irradiance rows in the means. why: the reason that this
    irradiance must not be used, or ""; caution: a doubt about it, or ""; doubtful: whether it is
    too uncertain to judge pictures by.
    """

    ghi_wm2: float = np.nan
    dhi_wm2: float = np.nan
    dni_wm2: float = np.nan
    steadiness: float = 0.0
    source: str = ""
    rows: int = 0
    why: str = ""
    caution: str = ""
    doubtful: bool = False


def irradiance_during(
    log: CleanIrradiance, opened: datetime, closed: datetime
) -> BracketIrradiance:
    """Return the mean irradiance and its steadiness during a bracket, from `opened` to `closed`.

    For a bracket with fewer than three rows, those within one row interval before and after the
    bracket are included. `why` is set if rows are over 15 minutes apart, if any time of the bracket
    is more than two row intervals plus one second from a usable row, if diffuse is above global, or
    if global changed by over 50 % (and over 10 W/m2), so that its frames saw different light; from
    10 % on this is a caution.
    """
    start_s, end_s = opened.timestamp(), closed.timestamp()
    every_s = max(log.every_s(start_s), 1.0)
    usable = np.isfinite(log.dni_wm2) & np.isfinite(log.dhi_wm2)
    first, last = np.searchsorted(log.t_unix_s, (start_s - 2.0 * every_s, end_s + 2.0 * every_s))
    near = slice(max(int(first) - 1, 0), int(last) + 1)
    distance_s = _worst_distance_s(log.t_unix_s[near][usable[near]], start_s, end_s)
    if every_s > 900.0:
        return BracketIrradiance(why=f"irradiance was logged only every {every_s:.0f} s")
    if distance_s > 2.0 * every_s + 1.0:
        return BracketIrradiance(why=_missing_text(log, near, start_s, end_s, distance_s))
    inside = usable & (log.t_unix_s >= start_s) & (log.t_unix_s <= end_s)
    if inside.sum() < 3:
        inside = usable & (log.t_unix_s >= start_s - every_s) & (log.t_unix_s <= end_s + every_s)
    return _statistics(log, inside)


def _worst_distance_s(t_unix_s: Floats, start_s: float, end_s: float) -> float:
    """Return the distance [s] of the nearest row, at the time of a bracket where it is largest.

    t_unix_s: of the rows [n]; start_s, end_s: of the bracket, unix time. Infinite without rows.
    """
    # the distance is largest at an end of the bracket, or half way between two rows
    middles = (t_unix_s[1:] + t_unix_s[:-1]) / 2.0
    moments = np.r_[start_s, end_s, middles[(middles > start_s) & (middles < end_s)]]
    return float(np.abs(moments[:, None] - t_unix_s).min(axis=1, initial=np.inf).max())


def _missing_text(
    log: CleanIrradiance, near: slice, start_s: float, end_s: float, distance_s: float
) -> str:
    """Return why a bracket has no irradiance: the marks of its rows, or that there are none.

    near: rows around it; start_s, end_s: of the bracket, unix time; distance_s: by
    `_worst_distance_s`, of usable rows.
    """
    within = (log.t_unix_s[near] >= start_s - 60.0) & (log.t_unix_s[near] <= end_s + 60.0)
    words = {word for text in log.flags[near][within] for word in str(text).split()}
    if flags := sorted(words - {"gap", "low-sun"}):
        return f"irradiance unusable: {' '.join(flags)}"
    if not np.isfinite(distance_s):
        return "no irradiance"
    return f"no irradiance at that time, the nearest row is {distance_s:.0f} s away"


def _statistics(log: CleanIrradiance, rows: Mask) -> BracketIrradiance:
    """Return the means of the masked rows, at least one, with their steadiness and cautions.

    The source is "measured", or the model of the first row in which one was derived.
    """
    ghi, dhi, dni = log.ghi_wm2[rows], log.dhi_wm2[rows], log.dni_wm2[rows]
    mean, spread = float(ghi.mean()), float(np.ptp(ghi))
    steadiness = spread / mean if mean > 1.0 else 0.0
    caution, why = [], ""
    if dhi.mean() > 1.05 * mean + 10.0:
        why = "diffuse irradiance is above global: the two columns may be exchanged"
    elif steadiness > 0.50 and spread > 10.0:
        why = "light changed by over 50 % during the bracket"
    elif steadiness > 0.10 and spread > 10.0:
        caution.append("light changed by over 10 %")
    words = {word for text in log.flags[rows] for word in str(text).split()}
    caution += [text for word, text in _CAUTIONS.items() if word in words]
    derived = [text for text in log.source[rows] if text != MEASURED]
    return BracketIrradiance(
        ghi_wm2=mean,
        dhi_wm2=max(float(dhi.mean()), 0.0),
        dni_wm2=max(float(dni.mean()), 0.0),
        steadiness=steadiness,
        source=derived[0] if derived else MEASURED,
        rows=int(rows.sum()),
        why=why,
        caution="; ".join(caution),
        # A low sun is not counted: it matters only with a beam.
        doubtful=bool(why) or any(text != _CAUTIONS["low-sun"] for text in caution),
    )


_CAUTIONS = {  # by the flags of clean.csv
    "low-sun": "sun under 5 degrees: DNI from horizontal readings is inaccurate",
    "closure": "global is not diffuse + direct",
    "diffuse": "diffuse above global",
    "extreme": "irradiance outside BSRN's extremely rare limits",
    "spike": "one reading differs strongly from its neighbours",
    "k-index": "an impossible ratio of global, diffuse and direct",
    "horizon": "something may hide the sun from the instrument",
    "double": "two rows of one moment differ",
}
