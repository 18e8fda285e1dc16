"""Models against the annual glare truth of raytraverse's validation set, next to its own errors.

    python bench/annual_truth.py FOLDER OUT [--scenes 01_glz] [--models mean,nearest,transport] \
        [--sets 9-day,even] [--views 1,2,3]

FOLDER and OUT as for bench/annual_truth_render.py, which must have run. Each model is fitted to the
panoramas of the 9-day or the even set and predicts the 2 022 reference hours; the disc is the one
that Radiance sees from the view point (as `[room] kind = "radiance"` gives it). Images of the sun
in a mirror are found in the captures and predicted as by `train` and `predict`. Errors of Ev and
DGP are over hours with a reference DGP of 0.25 to 0.75, the rule of the set's check.py. "hours in
class" is the share of all hours in the same class of 0.35, 0.40 and 0.45.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from annual_truth_hours import Hours, chosen_hours, read_hours
from annual_truth_office import Array
from numpy.typing import NDArray

from fieldlum.core.records import CameraSetup, Site, SiteFile
from fieldlum.learn.models import trusted_hours
from fieldlum.learn.models.mirrors import split_images
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import fit_timed
from fieldlum.sky.sun_disc import add_disc
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views

# raytraverse 1.4.4, validations/base1compdv, its own check.py: mean absolute errors.
OF_RAYTRAVERSE = {"01_glz": (4.2, 0.0109), "03_shd": (3.1, 0.0038), "05_ngl": (6.5, 0.0070)}
CLASSES = (0.35, 0.40, 0.45)
SITE = Site("Geneva", 46.25, 6.13, "Europe/Zurich", 416.0)


@dataclass(frozen=True)
class Reference:
    """One view: Ev [n] lx and DGP [n] of the set's reference, and where the view looks."""

    name: str
    heading_deg: float
    ev_lx: Array
    dgp: Array


def read_reference(folder: Path, scene: str, view: int) -> Reference:
    sensors = "sensors_n.txt" if scene == "05_ngl" else "sensors.txt"
    x, y = np.loadtxt(folder / "POINTS" / sensors)[view - 1, 3:5]
    with (folder / "refrt" / f"{scene}_v{view}_refrt.tsv").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    ev, dgp = (np.array([float(row[key]) for row in rows]) for key in ("illum", "dgp"))
    return Reference(f"{scene} v{view}", float(np.degrees(np.arctan2(x, y)) % 360.0), ev, dgp)


def errors(reference: Reference, ev: Array, dgp: Array) -> str:
    """Cells: MAE of Ev in percent, MAE and bias of DGP, hours in class, annual share over 0.45."""
    inside = (reference.dgp >= 0.25) & (reference.dgp <= 0.75)
    relative = 100.0 * np.abs(ev / reference.ev_lx - 1.0)[inside].mean()
    error = (dgp - reference.dgp)[inside]
    same = np.digitize(dgp, CLASSES) == np.digitize(reference.dgp, CLASSES)
    exceeded = [100.0 * float((values > CLASSES[-1]).mean()) for values in (dgp, reference.dgp)]
    annual = [
        int(np.digitize(np.quantile(values, 0.95), CLASSES)) for values in (dgp, reference.dgp)
    ]
    return (
        f"{relative:.1f} | {np.abs(error).mean():.4f} | {error.mean():+.4f} | "
        f"{100.0 * same.mean():.1f} | {exceeded[0]:.1f} ({exceeded[1]:.1f}) | "
        f"{'same' if annual[0] == annual[1] else 'other'}"
    )


def of_trusted(reference: Reference, dgp: Array, trusted: NDArray[np.bool_]) -> str:
    """Cell: MAE of DGP in the trusted of the judged hours, and their share."""
    inside = (reference.dgp >= 0.25) & (reference.dgp <= 0.75)
    error = np.abs(dgp - reference.dgp)[inside & trusted]
    mean = f"{error.mean():.4f}" if error.size else "-"
    return f"{mean} ({100.0 * trusted[inside].mean():.0f} %)"


def glare(
    maps: NDArray[np.float32], heading: float, suns: Array, disc: Array
) -> tuple[Array, Array]:
    views = panorama_views(maps.shape[1], maps.shape[2], heading, [heading])
    found = glare_directions(maps, views, suns, disc)
    return found["ev_lx"][:, 0], found["dgp"][:, 0]


def dataset(stored: dict[str, NDArray[np.float32]], hours: Hours, heading: float) -> Dataset:
    """All rendered hours of a view as training data; an image of the sun in the facade opposite is
    a bright pixel, as a camera would see it."""
    rows = stored["rows"]
    light, maps, image = hours.light[rows], stored["maps"], stored["image_lx"].astype(float)
    if image.any():
        mirrored = replace(light, sun_azimuth_deg=(180.0 - light.sun_azimuth_deg) % 360.0)
        maps = add_disc(maps, mirrored, image, heading)
    return Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=stored["patch"],
        disc_lx=stored["disc_lx"].astype(float),
        heading_deg=heading,
        days=np.array([t.date() for t in light.t_utc], "datetime64[D]"),
        slots=tuple(f"{t:%Y%m%dT%H%M%SZ}" for t in light.t_utc),
        setup=SiteFile(SITE, CameraSetup(heading_deg=heading)),
        seen=np.ones(maps.shape[1:], bool),
        steadiness=np.zeros(len(rows)),
    )


def score_view(
    folder: Path,
    out: Path,
    scene: str,
    view: int,
    models: list[str],
    sets: list[str],
    budget_s: float,
) -> None:
    reference, hours = read_reference(folder, scene, view), read_hours(folder)
    with np.load(out / f"{scene}_v{view}.npz") as file:
        stored = {name: file[name] for name in file.files}
    data, n = dataset(stored, hours, reference.heading_deg), hours.reference
    test = data.take(np.arange(n))  # rows of the reference come first
    suns, image = hours.suns[:n].copy(), stored["image_lx"][:n].astype(float)
    mirrored = np.where((image > 0)[:, None], suns * np.array([1.0, -1.0, 1.0]), suns)
    seen = np.where(image > 0, image, test.disc_lx)
    ev, dgp = glare(stored["maps"][:n], reference.heading_deg, mirrored, seen)
    name, count = reference.name, f"{len(reference.dgp)}"
    print(
        f"| {name} | own rendering | - | {count} | {errors(reference, ev, dgp)} | - |", flush=True
    )
    for which, chosen in chosen_hours(hours).items():
        if which not in sets:
            continue
        rows = np.flatnonzero(np.isin(stored["rows"], chosen))
        taught, mirrors = split_images(data.take(rows))
        images = [mirror.images(test.light, reference.heading_deg) for mirror in mirrors]
        sources = np.stack([suns, *(i.towards for i in images)])
        sources_lx = np.stack([test.disc_lx, *(i.shown_lx for i in images)])
        for mirror in mirrors:
            print(f"{name}, {which}: {mirror.captures} {mirror.warning}", file=sys.stderr)
        unseen = np.flatnonzero(~np.isin(np.arange(n), chosen))
        for model in models:
            fitted, _ = fit_timed(model, taught, patch="absolute", seed=0, budget_s=budget_s)
            parts = [
                fitted.predict(test.light[part], test.patch_cdm2[part])
                for part in np.array_split(np.arange(n), 20)
            ]
            maps = np.concatenate([part.luminance_cdm2 for part in parts])
            trusted = np.concatenate([trusted_hours(part) for part in parts])
            for image in images:
                trusted &= ~image.uncertain
            ev, dgp = glare(maps, reference.heading_deg, sources, sources_lx)
            asked = replace(reference, ev_lx=reference.ev_lx[unseen], dgp=reference.dgp[unseen])
            cells = errors(asked, ev[unseen], dgp[unseen])
            cells = f"{cells} | {of_trusted(asked, dgp[unseen], trusted[unseen])}"
            epochs = getattr(fitted, "training", {}).get("pixels_seen_per_pixel")
            label = model if epochs is None else f"{model}, {epochs:.1f} epochs"
            print(f"| {name} | {label} | {which} | {len(rows)} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default="01_glz,03_shd,05_ngl")
    parser.add_argument("--models", default="mean,nearest,transport,dense")
    parser.add_argument("--views", default="1,2,3")
    parser.add_argument("--sets", default="9-day,even")
    parser.add_argument("--budget-s", type=float, default=90.0)
    options = parser.parse_args()
    print(
        "| view | model | set | hours | Ev MAE, % | DGP MAE | DGP bias | hours in class, % | "
        "hours over 0.45, % (reference) | annual class | DGP MAE of trusted hours |"
    )
    print(f"|{'---|' * 11}")
    for scene in options.scenes.split(","):
        ev, dgp = OF_RAYTRAVERSE[scene]
        blank = " - |" * 5
        print(f"| {scene}, all | raytraverse 1.4.4 | 3D model | 2022 | {ev} | {dgp} |{blank}")
        for view in map(int, options.views.split(",")):
            if (options.out / f"{scene}_v{view}.npz").is_file():
                score_view(
                    options.folder,
                    options.out,
                    scene,
                    view,
                    [m for m in options.models.split(",") if m],
                    options.sets.split(","),
                    options.budget_s,
                )


if __name__ == "__main__":
    main()
