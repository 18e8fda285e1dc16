"""Count hours with the sun's disc in view, and wrong glare classes: what `judge.py` adds to bench.

    python bench/outside_rooms/discs.py TRAIN.csv TEST.csv SITE.toml SCENE MODEL

prints JSON. disc_hours: sunny test hours with the disc in view by the picture; disc_shown,
disc_missed: how many of them the tool shows and misses; disc_absent: the other sunny hours;
disc_phantom: in how many of them the tool shows a disc; disc_share_rms: error of the disc's share;
class_wrong: share of views in another class of DGP than the true map, with the true disc;
class_wrong_own_disc: the same with the tool's disc.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.bench.score_rows import load
from fieldlum.learn.models.scores import Truth, truth
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import fit_timed, patch_mode
from fieldlum.year.glare.metrics import glare_directions

Array = NDArray[Any]

SUNNY_LX = 1000.0  # on a plane normal to the sun, about 10 W/m2: less does not count as a sun
IN_VIEW = 0.05  # share of the sun's light that counts as a disc in view
CLASSES = (0.35, 0.40, 0.45)  # EN 17037 and Wienold 2009
_CHUNK = 24


def disc_counts(true_lx: Array, own_lx: Array, direct_lx: Array) -> dict[str, Any]:
    """Return how many sunny hours have a disc in view, by the pictures and by the tool."""
    sunny = direct_lx > SUNNY_LX
    true, own = true_lx[sunny] / direct_lx[sunny], own_lx[sunny] / direct_lx[sunny]
    view, shown = true > IN_VIEW, own > IN_VIEW
    return {
        "disc_hours": int(view.sum()),
        "disc_shown": int((view & shown).sum()),
        "disc_missed": int((view & ~shown).sum()),
        "disc_absent": int((~view).sum()),
        "disc_phantom": int((~view & shown).sum()),
        "disc_share_rms": float(np.sqrt(((own - true)[view] ** 2).mean())) if view.any() else None,
    }


def own_disc_lx(asked: Truth) -> Array:
    """Return the disc by the sky view, or by the stated room where fieldlum has no sky view yet."""
    for name in ("own_disc_lx", "room_disc_lx"):
        if (lux := getattr(asked, name, None)) is not None:
            return lux
    raise SystemExit("discs.py: this fieldlum guesses the disc from maps; state a [room]")


def dgp(maps: Array, part: Dataset, asked: Truth, disc_lx: Array) -> Array:
    """Return the DGP [n, views] of maps with a sun's disc."""
    sun = part.light.apparent_sun_direction
    return glare_directions(maps, asked.views, sun, disc_lx)["dgp"]


def wrong_classes(fitted: Any, asked: Truth, own_lx: Array) -> dict[str, Any]:
    """Return the share of views in a wrong class, with the true disc and with the own one."""
    wrong = np.zeros(2)
    views = 0
    rows = np.flatnonzero(asked.glare_maps)
    for k in range(0, len(rows), _CHUNK):
        some = rows[k : k + _CHUNK]
        part = asked.data.take(some)
        maps = fitted.predict(part.light, part.patch_cdm2).luminance_cdm2
        true = np.digitize(asked.dgp[some], CLASSES)
        views += true.size
        for j, disc in enumerate((part.disc_lx, own_lx[some])):
            wrong[j] += (np.digitize(dgp(maps, part, asked, disc), CLASSES) != true).sum()
    return {"class_wrong": wrong[0] / views, "class_wrong_own_disc": wrong[1] / views}


def main() -> None:
    train, test, site, scene, model = sys.argv[1:6]
    loaded = load(Path(train), [model], test=Path(test), site=Path(site), scene=scene)
    assert loaded.test is not None
    asked, data, spec = truth(loaded.test), loaded.data, loaded.specs[0]
    fitted, _ = fit_timed(
        spec.name, data, patch=patch_mode(data, spec.patch), seed=0, budget_s=None
    )
    own_lx = own_disc_lx(asked)
    counts = disc_counts(asked.data.disc_lx, own_lx, asked.data.light.direct_lx)
    print(json.dumps({**counts, **wrong_classes(fitted, asked, own_lx)}))


if __name__ == "__main__":
    main()
