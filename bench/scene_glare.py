"""Glare of a year in rooms of `scene_rooms.py`, by the sun's disc of a fitted scene.

    python bench/scene_glare.py ROOMS [NAME ...] [--draw 7] [--few two-days,four-days,all]

fits a scene to all captures of a user, or those of some days (errors and names as in
`scene_judge.py`), trains light transport with it and with the stated box, and predicts the test
hours of each room as `fieldlum predict` does. DGP in ten directions is compared with that of the
true pictures and discs: its mean squared error; the share of occupied hours inside the stated 95 %
interval; and whether the DGP that 5 % of the occupied hours exceed is inside its interval, and its
class of EN 17037 stated and right.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from predicted_glare import Year, predicted_year
from scene_generators import ROOMS
from scene_judge import DAYS, user_of
from scene_judge import fitted as with_fitted
from scene_rooms import with_box

from fieldlum.learn.models import fit
from fieldlum.learn.models.scores import evaluate, summary, truth
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import with_scene
from fieldlum.room.fit.evidence import PIXELS
from fieldlum.room.fit.fit import fit_scene
from fieldlum.room.fit.stage import judged_scene


def glare_of(data: Dataset, test: Dataset) -> tuple[float, Year]:
    """Train on captures, predict the test hours; return the MSE of DGP, and both compared."""
    patch = "none" if data.patch_cdm2 is None else "absolute"
    model = fit("transport", data, patch=patch, seed=0)
    known = truth(test)
    mse = summary(evaluate(model, known))["dgp_mse_own_disc"]
    assert mse is not None
    with tempfile.TemporaryDirectory() as name:
        return mse, predicted_year(model, data, test, known.dgp, Path(name), patch=patch)


def true_disc_lx(path: Path) -> NDArray[np.float64]:
    """Illuminance of the disc at the lens in the test hours, lx [n]."""
    with np.load(path) as stored:
        return stored["disc_lx"][stored["test"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("rooms", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--draw", type=int, default=7)
    parser.add_argument("--few", default="all", help="two-days, four-days, all")
    parser.add_argument("--pixels", type=int, default=PIXELS)
    wanted = parser.parse_args()
    head = ["room", "captures", "disc of", "DGP MSE", "hours inside 95 %", "directions inside 95 %"]
    print("| " + " | ".join([*head, "classes stated", "wrong"]) + " |\n" + "|---" * 8 + "|")
    for name, few in product(wanted.names or ROOMS, wanted.few.split(",")):
        path = wanted.rooms / f"{name}.npz"
        user, test, _, _, _ = user_of(path, wanted.draw)
        user = user if few == "all" else user.take(DAYS[few](path, wanted.draw))
        test = replace(test, disc_lx=true_disc_lx(path))
        stated = user.setup.room
        assert stated is not None
        found = fit_scene(user, stated, pixels=wanted.pixels)
        scene = judged_scene(user, found)
        chosen = with_scene(user, scene)
        assert scene.chosen == "fitted", scene.verdict
        cases = {
            "stated box": (with_box(user, stated), with_box(test, stated)),
            "fitted scene": (chosen, with_fitted(test, found, captures=False)),
        }
        for label, (data, hours) in cases.items():
            mse, year = glare_of(data, hours)
            cells = [f"{mse:.1e}", f"{100.0 * year.inside:.0f} %"]
            cells += [f"{year.year_inside} of 10", f"{year.decided} of 10"]
            print("| " + " | ".join([name, few, label, *cells, str(year.wrong)]) + " |", flush=True)


if __name__ == "__main__":
    main()
