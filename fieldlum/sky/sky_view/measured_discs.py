"""Read the centres of the sun's disc that merge measured in a session's captures."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.session import Session
from fieldlum.session.files.sidecar import Sidecar

# Allowance for the lens model and the mount, which the sidecar's sigma_deg does not include
# (docs/merge.md): discs are found to 0.03 degrees there, and no lens profile is better.
MIN_U_DEG = 0.02


@dataclass(frozen=True, slots=True)
class MeasuredDiscs:
    """Centres of n sun discs in panoramas, by the stated heading, with their recorded times.

    altitude_deg: apparent [n]; azimuth_deg: clockwise from north [n]; sigma_deg: standard
    uncertainty along each axis [n].
    """

    altitude_deg: Floats
    azimuth_deg: Floats
    sigma_deg: Floats
    t_utc: tuple[datetime, ...]

    def __len__(self) -> int:
        return len(self.t_utc)


NO_DISCS = MeasuredDiscs(np.zeros(0), np.zeros(0), np.zeros(0), ())


def read_discs(session: Session) -> MeasuredDiscs:
    """Return the sun discs in the sidecars (json files) of a session's panoramas, or an empty set.

    Sidecars without a measured disc or without a time are skipped. sigma_deg is at least 0.02.
    Raises InputError for a damaged sidecar.
    """
    read = map(_measured, session.sidecar_files())
    rows = [row for row in read if row is not None]
    numbers = np.array([row[:3] for row in rows], float).reshape(-1, 3)
    altitude, azimuth, sigma = numbers.T
    return MeasuredDiscs(altitude, azimuth, sigma, tuple(row[3] for row in rows))


def _measured(path: Path) -> tuple[float, float, float, datetime] | None:
    sidecar = Sidecar.read(path)
    measured = sidecar.sun.measured if sidecar.sun else None
    if measured is None or (when := measured.t_utc or sidecar.t_utc) is None:
        return None
    return measured.altitude_deg, measured.azimuth_deg, max(measured.sigma_deg, MIN_U_DEG), when
