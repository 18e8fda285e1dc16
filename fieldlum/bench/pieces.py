"""Define pieces of a benchmark that can run on any worker: scores, learning curves, stress tests.

Each piece reads the pairs where it runs, and returns rows of a table. A worker reads the pairs
once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fieldlum.bench import stress, year
from fieldlum.bench.cost import radiance_row
from fieldlum.bench.rows import Spec, parse_specs, score_row, without_training_hours
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.core.scheduler import WorkUnit
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models.data import Dataset, load_pairs
from fieldlum.learn.models.estimated_view import with_sky_view
from fieldlum.learn.models.scores import Truth, truth
from fieldlum.learn.train.folds import day_folds
from fieldlum.room.fit.apply import in_scene
from fieldlum.room.fit.stated_box import training_captures, with_same_box

PieceKind = Literal["score", "random", "greedy", "periods", "stress", "rendering"]


@dataclass(frozen=True, slots=True)
class BenchFiles:
    """The files of a benchmark, relative to `folder`; "" for files that were not stated.

    pairs, test, pool: sessions or csv files with the hours to train on, to test on, and to draw
    seasons from. models: names, or folders of trained models. site: SITE.toml. scene: "", "none" or
    the folder of a scene, as in the option --scene. sky_view: a sky_view.exr, "" for that of the
    pairs.
    """

    folder: Path
    pairs: str
    models: tuple[str, ...]
    test: str = ""
    pool: str = ""
    site: str = ""
    scene: str = ""
    sky_view: str = ""

    def hashed(self) -> tuple[str, ...]:
        """Return the pairs.csv files that a worker must have with the same content.

        They are paths relative to `folder`, each once.
        """
        paths = [name for name in (self.pairs, self.test, self.pool) if name]
        tables = [f"{name}/pairs.csv" if (self.folder / name).is_dir() else name for name in paths]
        return tuple(dict.fromkeys(os.path.normpath(table) for table in tables))


def bench_files(
    pairs: Path,
    models: Sequence[str],
    *,
    test: Path | None = None,
    pool: Path | None = None,
    site: Path | None = None,
    scene: str = "",
    sky_view: Path | None = None,
) -> BenchFiles:
    """Return the files of a benchmark, relative to the deepest folder that contains all of them."""
    texts = [text.strip() for text in models if text.strip()]
    trained = [Path(text) for text in texts if (Path(text) / "config.json").is_file()]
    scene_folder = Path(scene) if scene not in ("", "none") else None
    stated = (pairs, test, pool, site, scene_folder, sky_view, *trained)
    paths = [p for p in stated if p is not None]
    full = [path.resolve() for path in paths]
    common = os.path.commonpath([p if p.is_dir() else p.parent for p in full])
    shown = os.path.relpath(common)  # tables name the pairs as the user stated them
    folder = Path(common if shown.startswith("..") else shown)

    def name(path: Path | None) -> str:
        return "" if path is None else path.resolve().relative_to(common).as_posix()

    return BenchFiles(
        folder,
        name(pairs),
        tuple(name(Path(text)) if Path(text) in trained else text for text in texts),
        name(test),
        name(pool),
        name(site),
        name(scene_folder) if scene_folder is not None else scene,
        name(sky_view),
    )


@dataclass(frozen=True)
class BenchData:
    """The pairs of a benchmark.

    data: hours to train on. test: hours that no model was trained on; None to use held-out days.
    pool: hours from which seasons are drawn. folder: the folder to which paths of trained models
    are relative.
    """

    data: Dataset
    test: Dataset | None
    pool: Dataset | None
    folder: Path = field(default_factory=Path)

    @cached_property
    def asked(self) -> Truth | None:
        """The test hours with their true maps and glare; None without test hours."""
        return None if self.test is None else truth(self.test)

    def spec(self, text: str) -> Spec:
        """Parse the text that names one model, as `rows.parse_specs` does."""
        return parse_specs([text], self.folder)[0]


def load(files: BenchFiles, progress: Progress = quiet) -> BenchData:
    """Read the pairs with their sun patches or their scene, as `train` learns them.

    Without a scene, pairs with few clear hours choose between the stated box and no patch
    (`training_captures`), also for `test` and `pool`. Test hours that a model was trained on are
    omitted. Raises InputError for files that cannot be used, NotEnoughDataError if no test hour is
    left.
    """
    at = files.folder
    scene = files.scene if files.scene in ("", "none") else str(at / files.scene)
    site = at / files.site if files.site else None

    pairs = at / files.pairs
    captures = load_pairs(pairs, site, progress=progress)
    data, _ = training_captures(captures, pairs, scene, "absolute", progress=progress)
    data = with_sky_view(data, at / files.sky_view if files.sky_view else None, progress=progress)

    def read(name: str) -> Dataset:
        others = load_pairs(at / name, site, progress=progress)
        others, _ = in_scene(others, pairs, scene, "absolute", progress=progress)
        others = with_same_box(others, data, progress=progress)
        return replace(others, sky_view=data.sky_view)

    test = read(files.test) if files.test else None
    pool = read(files.pool) if files.pool else None
    specs = parse_specs(files.models, at)
    if test is not None:
        folders = (spec.folder for spec in specs if spec.folder is not None)
        test = without_training_hours(test, data, *folders)
    return BenchData(data, test, pool, at)


# ----------------------------------------------------------------------------------------------
# pieces


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece of a benchmark: a kind of test, for one model and seed.

    kind "random" and "greedy": learning curves over captures chosen in that way; "rendering": the
    time of Radiance for `hours` hours.
    """

    kind: PieceKind
    model: str = ""
    seed: int = 0
    budget_s: float = 0.0
    hours: int = 0  # number of hours to render

    @property
    def name(self) -> str:
        """Return a unique name of the piece."""
        return f"{self.kind} {self.model} {self.seed}".strip()


def pieces_of(
    loaded: BenchData,
    models: Sequence[str],
    *,
    seeds: int,
    budget_s: float,
    with_curve: bool,
    with_stress: bool,
    render_hours: int,
) -> list[Piece]:
    """Return the pieces that the data allow: scores, rendering, periods, and requested ones."""
    pieces = score_pieces(models, seeds, budget_s, loaded.folder)
    quick = [
        model
        for model in models
        if (spec := loaded.spec(model)).name == "transport" and spec.folder is None
    ]
    room = loaded.data.setup.room
    if room is not None and room.kind == "box" and render_hours:
        pieces.append(Piece("rendering", hours=render_hours))
    for model in quick:
        if with_curve and curve_data(loaded) is not None:
            pieces += [Piece("random", model), Piece("greedy", model)]
        if year.is_year(loaded.data):
            pieces.append(Piece("periods", model))
    if with_stress and models:
        first = next((m for m in models if loaded.spec(m).name == "transport"), models[0])
        pieces.append(Piece("stress", first))
    return pieces


def score_pieces(
    models: Sequence[str], seeds: int, budget_s: float, folder: Path = Path()
) -> list[Piece]:
    """Return one piece of kind "score" for each model and seed.

    A model without randomness, or a trained one, has only seed 0. folder: the folder to which paths
    of trained models are relative.
    """
    pieces: list[Piece] = []
    for model in models:
        (spec,) = parse_specs([model], folder)
        once = spec.folder is not None or MODELS[spec.name].baseline
        pieces += [Piece("score", model, seed, budget_s) for seed in range(1 if once else seeds)]
    return pieces


def curve_data(loaded: BenchData) -> tuple[Dataset, Dataset] | None:
    """Return training hours and test hours of the learning curve, in this order.

    Without stated test hours, a year of data is divided at random. Return None with test hours but
    under 50 captures, and without test hours if the data are no year.
    """
    data, test = loaded.data, loaded.test
    if test is None and year.is_year(data):
        order = np.random.default_rng(0).permutation(len(data))
        held = data.take(np.sort(order[: year.TEST_HOURS]))
        return data.take(np.sort(order[year.TEST_HOURS :])), held
    if test is None or len(data) < 2 * year.COUNTS[0]:
        return None
    return data, test


def work(piece: Piece, loaded: BenchData, progress: Progress = quiet) -> Any:
    """Run one piece in this process; return its table rows.

    For kind "score", return (row, trial); for "rendering", one row, or None without a box room.
    """
    if piece.kind == "rendering":
        asked = loaded.data if loaded.test is None else loaded.test
        return radiance_row(asked, piece.hours, progress=progress)
    spec = loaded.spec(piece.model)
    if piece.kind == "score":
        return score_row(
            spec,
            loaded.data,
            loaded.asked,
            seed=piece.seed,
            budget_s=piece.budget_s,
            progress=progress,
        )
    if piece.kind == "periods":
        return year.compare_periods(spec, loaded.data, progress=progress)
    if piece.kind == "stress":
        return _stress(spec, loaded, progress)
    chosen = curve_data(loaded)
    assert chosen is not None
    return year.learning_curve(spec, *chosen, piece.kind, progress=progress)


def _stress(spec: Spec, loaded: BenchData, progress: Progress) -> list[stress.StressRow]:
    teach, check = (loaded.data, loaded.test) if loaded.test is not None else _split(loaded.data)
    everything, asked = loaded.data if loaded.pool is None else loaded.pool, set(check.slots)
    pool = everything.take(np.array([slot not in asked for slot in everything.slots]))
    return stress.run(spec, teach, check, pool, progress=progress)


def _split(data: Dataset) -> tuple[Dataset, Dataset]:
    """Return training data, and a fifth of the days, which is held out.

    If there is only one day, a fifth of its hours is held out.
    """
    folds = day_folds(data)
    if not folds:
        raise NotEnoughDataError(
            f"{data.source}: {counted(len(data), 'usable hour')}; expected at least 2, to train "
            "and to test; capture more hours"
        )
    return data.take(folds[0].teach), data.take(folds[0].check)


# ----------------------------------------------------------------------------------------------
# units


def unit_of(piece: Piece, files: BenchFiles) -> WorkUnit:
    """Return a unit of work that runs a piece on any worker, which reads the pairs itself."""
    argument = (piece, replace(files, folder=Path()))
    return WorkUnit(piece.name, perform, files.folder, argument, files=files.hashed())


def local_unit_of(piece: Piece, loaded: BenchData, progress: Progress) -> WorkUnit:
    """Return a unit of work that runs a piece in this process with the pairs already read."""
    call: Callable[[Path, Any], Any] = partial(_perform_here, loaded=loaded, progress=progress)
    return WorkUnit(piece.name, call, loaded.folder, piece)


def _perform_here(folder: Path, piece: Piece, *, loaded: BenchData, progress: Progress) -> Any:
    return work(piece, loaded, progress)


def perform(folder: Path, argument: tuple[Piece, BenchFiles]) -> Any:
    """Run a piece on any worker; return the result of `work`.

    folder: the folder on this worker to which the files in `argument` are relative. The pairs are
    read once in each process.
    """
    piece, files = argument
    return work(piece, _loaded(replace(files, folder=folder)))


@lru_cache(maxsize=1)
def _loaded(files: BenchFiles) -> BenchData:
    """Return the pairs, read once in each process for the pieces of one room."""
    return load(files)
