"""What computed light is worth to the transport model when captures are few.

    python bench/transport_few_days.py ROOMS [NAME ...]

prints, for rooms of `scene_rooms.py`, the error on the test hours and what the model expected, with
and without computed light, for two days (the clearest and the most overcast), four (the same, and
those of another season) and all nine. Geometry: the true room's boxes, or a user's box of
`scene_judge.py` (draw 1).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scene_generators import ROOMS
from scene_judge import draw_pixels, exact_pair, user_of
from scene_rooms import with_box

from fieldlum.learn import transport
from fieldlum.learn.models.training_data import Dataset

COUNTS = (2, 4, 9)
SCORED = 300  # pixels
SEASON_MONTHS = 2  # days are of another season if at least as many months are between them


def days_of(data: Dataset, count: int) -> NDArray[Any]:
    """Return the rows of the clearest and the most overcast days of one or two seasons, or all."""
    days = np.unique(data.days)
    if count == len(days):
        return np.arange(len(data))
    direct = [float(data.light.direct_lx[data.days == day].sum()) for day in days]
    order = [int(k) for k in np.argsort(direct)]
    month = days.astype("datetime64[M]").astype(int)

    def apart(a: int, b: int) -> bool:
        return min((month[a] - month[b]) % 12, (month[b] - month[a]) % 12) >= SEASON_MONTHS

    chosen = [order[-1], order[0]]
    if count == 4:
        clear = next(k for k in order[::-1] if apart(k, order[-1]))
        chosen += [clear, next(k for k in order if apart(k, order[0]) and k != clear)]
    return np.flatnonzero(np.isin(data.days, days[chosen]))


def judged(train: Dataset, test: Dataset, seen: NDArray[Any], *, computed: bool) -> str:
    """Return error, expected error and the share of pixels in the 90 % interval."""
    physics = transport.physics_of if computed else lambda setup, heading_deg: None
    with patch.object(transport, "physics_of", physics):
        model = transport.fit(replace(train, seen=seen))
    made = model.predict(test.light, test.patch_cdm2)
    assert made.log10_sd is not None
    ratio = np.maximum(made.luminance_cdm2, 1.0) / np.maximum(test.luminance_cdm2, 1.0)
    error = np.log10(ratio)[:, seen]
    within = np.mean(np.abs(error) < 1.645 * made.log10_sd[:, seen])
    mse, expected = (error**2).mean(), made.expected_mse.mean()
    one = model.fitted if isinstance(model, transport.MeanTransport) else model
    used = "" if one.pixels.computed_gain.any() or not computed else " (off)"
    return f"{mse:.1e}{used} | {expected / mse:.1f} | {within:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("rooms", type=Path)
    parser.add_argument("names", nargs="*")
    wanted = parser.parse_args()
    columns = ("log10 MSE", "expected / error", "within 90 %")
    head = [f"{name}, {which}" for which in ("without", "with") for name in columns]
    print("| room | geometry | days | " + " | ".join(head) + " |\n" + "|---" * 9 + "|")
    for name in wanted.names or ROOMS:
        path = wanted.rooms / f"{name}.npz"
        user, test, exact, _, clock = user_of(path, 1)
        box = user.setup.room
        pairs = {
            "exact": exact_pair(path, *exact, clock),
            "box": (with_box(user, box), with_box(test, box)),
        }
        seen = draw_pixels(user, np.random.default_rng(9), SCORED)
        for geometry, (train, year) in pairs.items():
            for count in COUNTS:
                few = train.take(days_of(train, count))
                cells = [judged(few, year, seen, computed=c) for c in (False, True)]
                print(f"| {name} | {geometry} | {count} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
