"""What was captured and how good it was: the sampled light domain, the brackets' quality, the
irradiance.
"""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.records import Site, parse_utc
from fieldlum.report.figures import sky_domain_svg, sun_path_svg
from fieldlum.report.page import Row, Section, Table, svg_figure
from fieldlum.session import Session, read_journal


@dataclass(frozen=True, slots=True)
class PairTable:
    """The columns of pairs.csv that the report shows, [n] each; only rows with ok = 1."""

    t_utc: tuple[str, ...]
    panorama: tuple[Path, ...]
    dni_wm2: NDArray[np.float64]
    dhi_wm2: NDArray[np.float64]
    altitude_deg: NDArray[np.float64]
    azimuth_deg: NDArray[np.float64]
    source: tuple[str, ...]
    refused: tuple[str, ...]  # why, of the rows with ok = 0


def read_csv(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read_pair_table(path: Path) -> PairTable:
    rows = read_csv(path)
    good = [r for r in rows if float(r.get("ok") or 1) != 0]

    def column(name: str) -> NDArray[np.float64]:
        return np.array([float(r.get(name) or "nan") for r in good])

    return PairTable(
        tuple(r["t_utc"] for r in good),
        tuple(path.parent / r["panorama"] for r in good),
        column("dni_wm2"),
        column("dhi_wm2"),
        column("sun_altitude_deg"),
        column("sun_azimuth_deg"),
        tuple(r.get("source") or "" for r in good),
        tuple(r.get("why") or "no reason given" for r in rows if r not in good),
    )


def year_of_sun(site: Site, year: int) -> sun.SunPosition:
    """Hour centres of a year with the sun's centre up."""
    from datetime import UTC, datetime, timedelta

    start = datetime(year, 1, 1, 0, 30, tzinfo=UTC)
    found = sun.position([start + timedelta(hours=h) for h in range(8760)], site)
    up = found.altitude_deg > 0
    return sun.SunPosition(*(column[up] for column in found))


def section(
    session: Session, site: Site, pairs: PairTable, year_dni: NDArray, year_dhi: NDArray
) -> Section:
    year = parse_utc(pairs.t_utc[0]).year if pairs.t_utc else 2027
    sky = year_of_sun(site, year)
    domain = Row(
        (
            svg_figure(
                sun_path_svg(
                    sky.azimuth_deg, sky.altitude_deg, pairs.azimuth_deg, pairs.altitude_deg
                ),
                f"Sun positions of a year in grey and of the {len(pairs.t_utc)} captured hours in "
                f"red.",
                "Sun positions of the year and of the captures. Hours far from a red point are "
                "predicted from afar.",
            ),
            svg_figure(
                sky_domain_svg(year_dni, year_dhi, pairs.dni_wm2, pairs.dhi_wm2),
                "Direct against diffuse irradiance of the weather year in grey and of the "
                "captures in red.",
                "Skies of the weather file and of the captures.",
            ),
        ),
        "The light that was sampled",
    )
    text = _sentence(session, site, pairs)
    return Section("captured", "What was captured", text, (domain,), _tables(session, pairs))


def _sentence(session: Session, site: Site, pairs: PairTable) -> str:
    days = sorted({sun.standard_date(parse_utc(t), site.timezone).isoformat() for t in pairs.t_utc})
    span = f" between {days[0]} and {days[-1]}" if days else ""
    planned = len(session.slots()) if session.plan.is_file() else len(pairs.t_utc)
    measured = sum(s == "measured" for s in pairs.source)
    kind = (
        "measured"
        if measured == len(pairs.source)
        else f"measured in {measured} and derived in the others"
    )
    return (
        f"{len(pairs.t_utc)} usable brackets of {planned} planned, on {len(days)} days{span}. "
        f"Direct and diffuse irradiance were {kind}."
    )


def _tables(session: Session, pairs: PairTable) -> tuple[Table, ...]:
    tables = []
    refused = Counter(pairs.refused)
    if refused:
        tables.append(
            Table(("left out because", "brackets"), tuple(refused.items()), "Brackets left out")
        )
    events = (
        Counter(str(event.get("event", "?")) for event in read_journal(session))
        if session.journal.exists()
        else {}
    )
    if events:
        tables.append(
            Table(
                ("event", "times"),
                tuple(sorted(events.items())),
                "The journal, counted",
                folded=True,
            )
        )
    quality = read_csv(session.panoramas / "quality.csv")
    if quality:
        head = tuple(quality[0])
        rows = tuple(tuple(r[h] for h in head) for r in quality)
        tables.append(Table(head, rows, f"Quality of each bracket ({len(rows)})", folded=True))
    return tuple(tables)
