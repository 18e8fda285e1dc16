"""Decide whether an element of a scene stays: bar, shade or piece of furniture.

It must lower the cost in the hours that the search uses. Held-out hours must agree, because an
element that only explains noise lowers the cost of the searched hours alone.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldlum.scene_fit.guess import Guess

Cost = Callable[[Guess], float]

# Chosen, not varied: shares by which an element must lower the cost. A bar shades few pixels. A
# solid that only explains noise gains less. A wrong shade moves north, clock and edges.
BAR_GAIN = 0.002
SOLID_GAIN = 0.004
SHADE_GAIN = 0.02
# The same in held-out hours: it exceeds rounding. The sun may light an object in no held-out hour;
# with a gain of `UNSEEN_GAIN` in the others these need only not contradict.
KEPT_OUT_GAIN = 0.001
UNSEEN_GAIN = 0.02


def pays(fitted: Cost, kept_out: Cost, without: Guess, with_it: Guess, least: float) -> bool:
    """Return whether an element lowers the cost by enough.

    fitted, kept_out: costs in searched and in held-out hours. without, with_it: guesses without and
    with the element. It must lower the cost by the share `least` in searched hours and by 0.1 % in
    held-out ones. If it lowers the former by 2 % or more, the latter may rise by up to 0.1 %.
    """
    gain = 1.0 - fitted(with_it) / fitted(without)
    if gain < least:
        return False
    kept_out_gain = 1.0 - kept_out(with_it) / kept_out(without)
    return kept_out_gain >= (KEPT_OUT_GAIN if gain < UNSEEN_GAIN else -KEPT_OUT_GAIN)
