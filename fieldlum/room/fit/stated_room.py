"""What is known of room, pose and clock before the search."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fieldlum.core.records import Room
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.parameters import SUN_DEG_PER_MIN
from fieldlum.room.fit.pose_prior import PosePrior

START_CLOCKS_MIN = (-6.0, 0.0, 6.0)  # slightly beyond the prior's 5 minutes; chosen


@dataclass(frozen=True, slots=True)
class StatedRoom:
    """What is known before the search: the stated room, and pose and clock by sun discs.

    pose: None for under three sun discs. clock_sd_min: standard uncertainty of the stated times,
    used without `pose`.
    """

    room: Room
    pose: PosePrior | None
    clock_sd_min: float

    @property
    def start_clocks_min(self) -> tuple[float, ...]:
        """Stated time less true time that each search assumes at its start [min].

        They are -6, 0 and 6 if `is_clock_open`; otherwise the clock by sun discs, or 0 without
        discs.
        """
        clock = 0.0 if self.pose is None else float(self.pose.values[3])
        return START_CLOCKS_MIN if self.is_clock_open else (clock,)

    @property
    def is_clock_open(self) -> bool:
        """Whether the clock's standard uncertainty is over a minute: that by sun discs, if any."""
        return (self.clock_sd_min if self.pose is None else self.pose.u_clock_min) > 1.0

    def at_clock(self, guess: Guess, clock_min: float) -> Guess:
        """Return the guess with stated times `clock_min` after the true ones, and a pose to match.

        With discs of the sun the pose is the most likely one for this clock; without, north
        decreases by 0.25 degrees for each minute by which `clock_min` exceeds the guess's.
        """
        if self.pose is not None:
            return self.pose.at_clock(guess, clock_min)
        moved = clock_min - guess.clock_min
        return replace(
            guess, clock_min=clock_min, north_deg=guess.north_deg - SUN_DEG_PER_MIN * moved
        )
