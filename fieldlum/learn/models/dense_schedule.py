"""Define two schedules of the dense network's training: the paper's, and a short one for a budget.

The schedule of the paper (Liu, Colburn and Inanici 2020) has three stages of batches, and its
learning rate falls when the validation error does not. The short schedule has as many steps as the
time allows, with a learning rate that falls to zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fieldlum.learn.models.dense_network import Shape
from fieldlum.learn.models.dense_pixels import PixelSampler

STAGES = (6, 3, 1)  # batch in images' worth of pixels (paper)
STAGE_EPOCHS = 30  # paper
PATIENCE_EPOCHS = 2  # paper
LEAST_RATE = 1e-10  # at a lower rate the next stage begins; not measured
VALIDATION_SHARE = 0.1  # of the images; not measured
SHORT_EPOCHS = 25  # number of validations in the short schedule; not measured
SHORT_VALIDATION_PIXELS = 60_000  # pixels that are validated in the short schedule; not measured
SHORT_STEPS = 3000  # steps to reach before the short schedule enlarges its batches; not measured
SHORT_BATCH = (512, 8192)  # smallest and largest batch of the short schedule [px]; not measured
_WARM_SHARE = 0.03  # share of the short schedule in which the rate rises; not measured


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """The length and the learning rate of a training.

    schedule "paper": at most `epochs` passes over all training pixels, fewer if its three stages
    end earlier; steps and batch_pixels are not used. "short": `steps` updates with `batch_pixels`
    pixels each; after a warm-up the learning rate falls to 0; epochs is not used. A time budget can
    end both earlier. rate: highest learning rate; micro_pixels: pixels whose gradient is computed
    at once, which limits the memory.
    """

    schedule: Literal["paper", "short"] = "paper"
    epochs: int = STAGE_EPOCHS * len(STAGES)
    steps: int = 0
    batch_pixels: int = 0
    rate: float = 1e-3
    micro_pixels: int = 8192


@dataclass(slots=True)
class Run:
    """The progress of a training, which is stored in its checkpoint.

    epoch, step: number of completed epochs and batches; stage (from 0), stage_epoch: stage of the
    paper's schedule, and completed epochs in it; stale: consecutive epochs without improvement at
    this learning rate; rate: learning rate, in the short schedule its highest value; best: least
    validation loss so far; elapsed_s, cpu_s: time used; skipped: number of updates omitted because
    the loss was not finite.
    """

    epoch: int = 0
    step: int = 0
    stage: int = 0
    stage_epoch: int = 0
    stale: int = 0
    rate: float = 1e-3
    best: float = math.inf
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    skipped: int = 0


def affordable_plan(
    pixels_per_s: float, count: int, budget_s: float, micro_pixels: int
) -> TrainingPlan:
    """Return the paper's schedule if its 90 passes fit in the budget, else a short one.

    pixels_per_s: measured speed of training; count: training pixels of all hours; budget_s:
    available time; micro_pixels: see `TrainingPlan`. The short schedule has as many steps of 512 to
    8192 pixels as the time allows, but at least 25.
    """
    affordable = pixels_per_s * budget_s
    if affordable >= TrainingPlan().epochs * count:
        return TrainingPlan(micro_pixels=micro_pixels)
    batch = int(np.clip(affordable / SHORT_STEPS, *SHORT_BATCH))
    steps = max(SHORT_EPOCHS, int(affordable / batch))
    return TrainingPlan("short", steps=steps, batch_pixels=batch, micro_pixels=micro_pixels)


# ----------------------------------------------------------------------------------------------
# pixels of a batch


def validation_split(n: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices from 0 of images for training [k] and for validation [n - k], each sorted.

    A tenth of the n images, but at least one, is drawn by `seed` for validation; a single image is
    used for both.
    """
    order = np.random.default_rng(seed).permutation(n)
    cut = max(1, round(VALIDATION_SHARE * n))
    return (np.sort(order[cut:]), np.sort(order[:cut])) if n > 1 else (order, order)


def validation_numbers(total: int, plan: TrainingPlan, seed: int) -> Tensor:
    """Return the indices, below `total`, of the pairs of hour and pixel that validate, [b].

    total: number of pairs in the validation images. The paper's schedule uses all of them, the
    short one at most 60 000, which `seed` draws.
    """
    if plan.schedule == "paper" or total <= SHORT_VALIDATION_PIXELS:
        return torch.arange(total)
    order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
    return order[:SHORT_VALIDATION_PIXELS]


def epoch_batches(
    pixels: PixelSampler, plan: TrainingPlan, run: Run, shape: Shape, seed: int
) -> Iterator[Tensor]:
    """Yield the training pairs of each batch of the next epoch, as indices [b] of `PixelSampler`.

    run: progress; its epoch and stage are used. The random order depends only on `seed` and the
    epoch, so that a resumed training continues with the same batches. In the short schedule an
    epoch has a 25th of all steps. In the form "cnn" (of `shape`) a batch consists of complete
    images.
    """
    generator = torch.Generator().manual_seed(seed * 1_000_003 + run.epoch)
    images, per_image = pixels.target.shape
    device, complete = pixels.target.device, shape.form == "cnn"
    if plan.schedule == "short":
        total, size = len(pixels), plan.batch_pixels
        if complete:
            total, size = images, max(1, round(size / per_image))
        draws = range(-(-plan.steps // SHORT_EPOCHS))
        groups = (torch.randint(total, (size,), generator=generator) for _ in draws)
    else:
        total, size = len(pixels), STAGES[run.stage] * per_image
        if complete:
            total, size = images, STAGES[run.stage]
        groups = torch.randperm(total, generator=generator).split(size)
    for group in groups:
        yield (_all_pixels(group, per_image) if complete else group).to(device)


def _all_pixels(group: Tensor, per_image: int) -> Tensor:
    """Return the indices of the pairs of all pixels in a group of images."""
    return (group[:, None] * per_image + torch.arange(per_image)).reshape(-1)


# ----------------------------------------------------------------------------------------------
# rate and end


def short_rate(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the learning rate of the next step of the short schedule.

    After a warm-up it falls along a cosine to 0, by the share of steps or of `budget_s` that is
    used, whichever is larger; budget_s None: no limit.
    """
    warm = min(1.0, (run.step + 1) / (_WARM_SHARE * plan.steps + 1))
    share = min(_done_share(plan, run, budget_s), 1.0)
    return run.rate * warm * 0.5 * (1.0 + math.cos(math.pi * share))


def update_paper_rate(run: Run, improved: bool) -> None:
    """Update `run` in place after an epoch of the paper's schedule.

    Halve the rate after two epochs without improvement. Begin the next stage after 30 epochs of a
    stage, or when the rate is below 1e-10. improved: whether this epoch lowered the validation
    loss.
    """
    run.stale = 0 if improved else run.stale + 1
    run.stage_epoch += 1
    if run.stale >= PATIENCE_EPOCHS:
        run.rate, run.stale = run.rate / 2.0, 0
    if run.stage_epoch >= STAGE_EPOCHS or run.rate < LEAST_RATE:
        run.stage, run.stage_epoch, run.stale = run.stage + 1, 0, 0
        run.rate = max(run.rate, LEAST_RATE)


def passes(plan: TrainingPlan, run: Run, count: int) -> float:
    """Return how often, on average, each training pixel was used.

    count: number of training pixels, which are pairs of an hour and a pixel.
    """
    return run.step * plan.batch_pixels / count if plan.schedule == "short" else float(run.epoch)


def finished(plan: TrainingPlan, run: Run, budget_s: float | None) -> bool:
    """Return whether the training must end: budget, steps, epochs or stages are used up.

    budget_s: time limit [s] for run.elapsed_s; None: no limit.
    """
    if budget_s and run.elapsed_s >= budget_s:
        return True
    if plan.schedule == "short":
        return run.step >= plan.steps
    return run.epoch >= plan.epochs or run.stage >= len(STAGES)


def thousandths(plan: TrainingPlan, run: Run, budget_s: float | None) -> int:
    """Return the progress of the training from 0 to 1000.

    It is the share of steps or epochs, or of budget_s [s] if that is larger; budget_s None: no
    limit.
    """
    return min(1000, int(1000 * _done_share(plan, run, budget_s)))


def _done_share(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the completed share of steps or epochs, or of the time if it ends first.

    May exceed 1.
    """
    short = plan.schedule == "short"
    share = run.step / max(plan.steps, 1) if short else run.epoch / max(plan.epochs, 1)
    return max(share, run.elapsed_s / budget_s) if budget_s else share
