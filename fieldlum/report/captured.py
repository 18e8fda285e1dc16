"""The report's section on the captures: sampled sun and sky, quality of brackets, irradiance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.report.figures import captured_svg
from fieldlum.report.page import Figure, Row, Section, Table
from fieldlum.session import Session, read_journal
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.quality_csv import read_quality
from fieldlum.session.files.suns_csv import read_suns
from fieldlum.session.panorama_sun import SUN_FROM
from fieldlum.sky import sun


def column(rows: Sequence[PairRow], name: str) -> Floats:
    """Return the numeric field `name` of each row, in their order, [n]."""
    return np.array([getattr(row, name) for row in rows], float)


def year_of_sun(site: Site, year: int) -> sun.SunPosition:
    """Return the sun's positions in the middle of the hours of a UTC year in which it is up."""
    from datetime import UTC, datetime, timedelta

    start = datetime(year, 1, 1, 0, 30, tzinfo=UTC)
    position = sun.position([start + timedelta(hours=h) for h in range(8760)], site)
    up = position.altitude_deg > 0
    return sun.SunPosition(*(column[up] for column in position))


def section(
    session: Session, site: Site, pairs: PairsFile, year_dni: NDArray, year_dhi: NDArray
) -> Section:
    """Return the section on suns, skies, quality and refusals of the captures.

    year_dni, year_dhi: irradiance [W/m2] of the predicted year's hours; empty without one.
    """
    used = pairs.usable
    year = used[0].t_utc.year if used else 2027
    sky = year_of_sun(site, year)
    suns = column(used, "sun_azimuth_deg"), column(used, "sun_altitude_deg")
    skies = column(used, "dni_wm2"), column(used, "dhi_wm2")
    path = captured_svg(
        (sky.azimuth_deg, sky.altitude_deg),
        suns,
        "hours of the year",
        xlabel="sun azimuth, ° from north",
        ylabel="sun altitude, °",
        ylim=(0, None),
    )
    irradiances = captured_svg(
        (year_dni, year_dhi),
        skies,
        "weather file",
        xlabel="direct normal irradiance, W/m²",
        ylabel="diffuse horizontal irradiance, W/m²",
    )
    domain = Row(
        (
            Figure(
                path,
                f"Sun positions of a year in grey and of the {len(used)} captured hours in red.",
                "Sun positions of the year and of the captures. Hours far from every red point are "
                "extrapolated.",
            ),
            Figure(
                irradiances,
                "Direct against diffuse irradiance of the weather year in grey and of the "
                "captures in red.",
                "Skies of the weather file and of the captures.",
            ),
        ),
        "The light that was sampled",
    )
    text = _sentence(session, site, pairs)
    return Section("captured", "What was captured", text, (domain,), _tables(session, pairs))


def _sentence(session: Session, site: Site, pairs: PairsFile) -> str:
    used = pairs.usable
    days = sorted({sun.standard_date(row.t_utc, site.timezone).isoformat() for row in used})
    span = f" between {days[0]} and {days[-1]}" if days else ""
    planned = len(session.slots()) if session.plan.is_file() else len(used)
    text = (
        f"{len(used)} usable of {planned} planned brackets, on {counted(len(days), 'day')}{span}."
    )
    if not used:
        return text
    measured = sum(row.source == "measured" for row in used)
    kind = (
        "measured"
        if measured == len(used)
        else f"measured in {measured} brackets and derived in the others"
    )
    return f"{text} Direct and diffuse irradiance were {kind}.{_sun_sentence(session)}"


def _sun_sentence(session: Session) -> str:
    """Return where the illuminance of the sun's disc comes from; "" if no picture shows it."""
    origins = Counter(row.origin for row in read_suns(session.suns).values())
    if not origins:
        return ""
    parts = [f"{SUN_FROM.get(origin, origin)} in {n}" for origin, n in origins.most_common()]
    count = counted(origins.total(), "picture")
    return f" {count} show the sun's disc, whose illuminance was {', '.join(parts)}."


def _tables(session: Session, pairs: PairsFile) -> tuple[Table, ...]:
    refused = Counter(row.why or "no reason recorded" for row in pairs.refused)
    events = sorted(Counter(event["event"] for event in read_journal(session)).items())
    columns, quality = read_quality(session.quality)
    title = f"Quality of each bracket ({len(quality)})"
    tables = (
        Table(("reason", "brackets"), tuple(refused.items()), "Brackets that are not used"),
        Table(("event", "times"), tuple(events), "Events of the journal", folded=True),
        Table(columns, quality, title, folded=True),
    )
    return tuple(table for table in tables if table.rows)
