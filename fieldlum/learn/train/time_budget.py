"""Divide the time that one training may take among its parts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from fieldlum.core.records import Progress

# Shares of the budget. The quick models' held-out days come first. A slow model (the dense network)
# gets half of the rest for its held-out days and half for the stored model. The reserve is for the
# scan of north and clock and for the learning curve: together about a fifth of the time of a
# training with the default budget (108 captures at 230 x 115). Chosen.
QUICK_SHARE = 0.4
KEPT_BACK_SHARE = 0.2
_LEAST_S = 1e-3  # a slow model without time still takes one step, and is then not judged; chosen


class OutOfTime(Exception):
    """The budget was used up within a step, which therefore has no result."""


@dataclass(frozen=True, slots=True)
class TimeBudget:
    """The time that all parts of one training together may take.

    total_s: the complete budget; clock: function that returns seconds since any start, so that
    tests can simulate time; started_s: value of the clock when the budget began.
    """

    total_s: float
    clock: Callable[[], float]
    started_s: float

    @classmethod
    def starting(cls, total_s: float, clock: Callable[[], float] = time.monotonic) -> TimeBudget:
        """Return a budget of `total_s` seconds that starts now."""
        return cls(total_s, clock, clock())

    @property
    def left_s(self) -> float:
        """Seconds that remain; negative once the budget is used up."""
        return self.total_s - (self.clock() - self.started_s)

    @property
    def quick_s(self) -> float:
        """Seconds that remain for held-out days of quick models: at the start 40 % of the total.

        It is 0 once they are used.
        """
        return max(self.left_s - (1.0 - QUICK_SHARE) * self.total_s, 0.0)

    @property
    def slow_s(self) -> float:
        """Seconds that remain for a slow model: `left_s` less a reserve of 20 % of the total.

        It is never below 0.001 s.
        """
        return max(self.left_s - KEPT_BACK_SHARE * self.total_s, _LEAST_S)

    def watched(self, progress: Progress) -> Progress:
        """Return `progress` such that it raises OutOfTime once the budget is used up.

        Every long step reports its progress, so that it ends within a part of itself.
        """

        def report(finished: int, total: int, text: str) -> None:
            if self.left_s <= 0.0:
                raise OutOfTime
            progress(finished, total, text)

        return report
