"""Find captures whose light is a common factor of what the others predict, as with a blind down.

Clouds and a distant instrument make each capture deviate, so that captures with a blind are not
conspicuous by the size of their deviations, but all deviate to the same side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, product

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.learn.train.agreement import LeftOut, Process, Rows, Typical, disagreement

# Price of a day and least factor; chosen between what these sets have: nine days of
# the office and of nine rooms with a blind half down for a day and twelve other troubles gain 12 to
# 55 by it, with factors of 0.64 to 0.8; other days gain up to 9, and 12 beside such a day.
_DAY_PRICE = 10.0
_LEAST_LOG = float(np.log(1.2))
# Difference in cost between the best darker and the best brighter set, with which one is clear.
# With five days the wrong one can win by less. Chosen.
_MARGIN = 5.0
MOST_SHARE = 0.5  # of the captures: a larger set is the usual state, and the rest is the exception
_PARTS_H = (11.0, 12.0, 13.0, 14.0)  # local standard times at which a blind may be moved; chosen
_FEWEST = 3  # least number of captures of a day that show a common factor; chosen
_FEWEST_DAYS = 5  # with four, it is unclear which days are the exception; chosen
# With more days, pairs of days are not tried, because the search would take minutes. Chosen.
_MOST_DAYS_IN_PAIRS = 12
_NO_ROWS = np.empty(0, np.intp)


def days_and_pairs(days: Sequence[Rows]) -> list[Rows]:
    """Return steps of a search: each day's captures, and those of two days if there are few days.

    Of two days that differ from the rest, the first alone explains little.
    """
    if len(days) > _MOST_DAYS_IN_PAIRS:
        return list(days)
    return [*days, *(np.union1d(a, b) for a, b in combinations(days, 2))]


def cheapest_set(
    steps: Sequence[Rows], cost: Callable[[Rows], float], start: Rows = _NO_ROWS
) -> Rows:
    """Return the set of captures at which no step lowers the cost any more.

    A step adds its captures to the set, or removes those that the set has. The search begins at
    `start` and takes the cheapest step each time.
    """
    best, least = start, cost(start)
    while steps:
        tries = [np.setxor1d(best, step).astype(np.intp) for step in steps]
        costs = [cost(chosen) for chosen in tries]
        if min(costs) >= least:
            break
        best, least = tries[int(np.argmin(costs))], min(costs)
    return best


def blocks_of(days: Array, hours: Floats, rows: Rows) -> list[Rows]:
    """Return each day's captures among `rows`, and its parts before and after some hours.

    Blocks of fewer than three captures are left out. days: dates [n]; hours: local standard time
    [n] h.
    """
    at = hours[rows]
    parts = [at >= 0.0, *(at < h for h in _PARTS_H), *(at >= h for h in _PARTS_H)]
    blocks = [
        rows[(days[rows] == day) & part] for day, part in product(np.unique(days[rows]), parts)
    ]
    return [block for block in blocks if len(block) >= _FEWEST]


def captures_of_other_level(
    process: Process, rows: Rows, usual: Typical, blocks: Sequence[Rows]
) -> Rows | None:
    """Return the captures, complete days or parts of days, that a common factor explains best.

    The factor is one for each pixel, the same in all these captures. Return None with under five
    days, if it explains too little, or if it is unclear whether these captures are darker or the
    others brighter. rows: captures to search among, as indices [k]; blocks: of `blocks_of`.
    """
    out = process.left_out(rows, usual.noise)
    days = process.days[rows]
    complete = [rows[days == day] for day in np.unique(days)]
    if len(complete) < _FEWEST_DAYS:
        return None
    steps = days_and_pairs([block for block in complete if len(block) >= _FEWEST])

    def cost(chosen: Rows) -> float:
        if not len(chosen):
            return disagreement(process, rows, usual)
        return _cost(process, rows, usual, out, chosen)

    def cheapest(is_darker: bool) -> Rows:
        """Return the cheapest set of darker, or of brighter, captures."""

        def allowed(chosen: Rows) -> float:
            is_other = len(chosen) > 0 and (factor_of(process, out, chosen) < 1.0) != is_darker
            return np.inf if is_other else cost(chosen)

        return cheapest_set(blocks, allowed, cheapest_set(steps, allowed))

    # Three darker days make the others look brighter: separate searches find both sets.
    best, other = sorted((cheapest(True), cheapest(False)), key=cost)
    is_clear = not len(other) or cost(other) - cost(best) > _MARGIN
    return best if len(best) and is_clear else None


def _cost(process: Process, rows: Rows, usual: Typical, out: LeftOut, chosen: Rows) -> float:
    """Return the disagreement with a factor for `chosen`, plus the price of their days.

    It is infinite if the factor is nearly 1, and for over half of the captures.
    """
    if len(chosen) > MOST_SHARE * len(rows):
        return np.inf
    if abs(np.log(factor_of(process, out, chosen))) < _LEAST_LOG:
        return np.inf
    price = _DAY_PRICE * len(np.unique(process.days[chosen]))
    return disagreement(process.with_level(chosen), rows, usual) + price


def factor_of(process: Process, out: LeftOut, chosen: Rows) -> float:
    """Return the factor on the light of the captures `chosen`, median over the pixels.

    It is 1 if the other captures of `out` predict them.
    """
    level = process.level_of(chosen)[out.rows]  # it has the factor in it
    excess = float(np.median(level @ out.weights)) / float(level @ out.inverse @ level)
    return 1.0 / max(1.0 - excess, 1e-3)
