"""One clear test hour as every model sees it, and where each is wrong: the figure of
docs/models.md.

python bench/model_pictures.py TRAIN.csv TEST.csv OUT.png [--dense MODELDIR]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fieldlum.learn import models
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.sky.sun_disc import add_disc


def main() -> None:
    from matplotlib.figure import Figure

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("train", type=Path)
    parser.add_argument("test", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--dense", type=Path)
    asked = parser.parse_args()
    data, test = load_pairs(asked.train), load_pairs(asked.test)
    assert test.patch_cdm2 is not None
    lit = (test.patch_cdm2 > 100).mean(axis=(1, 2))
    hour = test.take(
        [int(np.argsort(lit)[-len(lit) // 20])]
    )  # more sun in the room than in 95 % of the hours
    fitted = {name: models.fit(name, data) for name in ("nearest", "transport")}
    if asked.dense:
        fitted["dense"] = models.load(asked.dense)
    shown = {"truth": hour.luminance_cdm2}
    shown |= {
        name: model.predict(hour.light, hour.patch_cdm2).luminance_cdm2
        for name, model in fitted.items()
    }
    logs = {
        k: np.log10(np.maximum(add_disc(v, hour.light, hour.disc_lx, hour.heading_deg)[0], 1))
        for k, v in shown.items()
    }
    figure = Figure(figsize=(3.4 * len(logs), 4.2), layout="constrained", dpi=130)
    axes = figure.subplots(2, len(logs))
    for column, (name, image) in enumerate(logs.items()):
        error = image - logs["truth"]
        above, below = axes[0, column], axes[1, column]
        luminance = above.imshow(image, cmap="inferno", vmin=0, vmax=4)
        above.set_title(
            name if name == "truth" else f"{name}: log10 MSE {np.mean(error**2):.1e}", fontsize=9
        )
        if name == "truth":
            below.set_title(hour.slots[0], fontsize=8, y=0.4)
            below.axis("off")
        else:
            wrong = below.imshow(error, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        for axis in (above, below):
            axis.set_xticks([])
            axis.set_yticks([])
    figure.colorbar(luminance, ax=axes[0], label="log10 cd/m2", shrink=0.8)
    figure.colorbar(wrong, ax=axes[1], label="log10 error", shrink=0.8)
    figure.savefig(asked.out)


if __name__ == "__main__":
    main()
