"""Write the pairs of a simulated session: truth/pairs.csv of the rendered panoramas, and a copy.

The copy is pairs.csv, until `pair` replaces it.
"""

from __future__ import annotations

from dataclasses import replace

from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.folder import Session


def write_simulated_pairs(session: Session, rows: tuple[PairRow, ...]) -> None:
    """Write truth/pairs.csv; also write pairs.csv, unless it has pairs of merged panoramas.

    rows: with paths relative to the session's folder.
    """
    in_truth = tuple(
        replace(row, panorama=_from_truth(row.panorama), sunpatch=_from_truth(row.sunpatch))
        for row in rows
    )
    PairsFile(session.truth_pairs, in_truth).write()
    if not session.pairs.is_file() or _is_simulated(PairsFile.read(session.pairs)):
        PairsFile(session.pairs, rows).write()


def keep_simulated_pairs(session: Session) -> None:
    """Copy pairs.csv to truth/pairs.csv if it is the simulator's and truth/pairs.csv is missing.

    Version 0.1.0 did not write truth/pairs.csv.
    """
    if session.truth.is_dir() and not session.truth_pairs.is_file():
        pairs = PairsFile.find(session.pairs)
        if pairs.rows and _is_simulated(pairs):
            write_simulated_pairs(session, pairs.rows)


def _is_simulated(pairs: PairsFile) -> bool:
    return all(row.panorama.startswith("truth/") for row in pairs.rows if row.panorama)


def _from_truth(name: str) -> str:
    """Convert a path relative to the session to one relative to its folder truth/."""
    if not name:
        return ""
    return name.removeprefix("truth/") if name.startswith("truth/") else f"../{name}"
