"""Train the dense network: by the paper's schedule if there is time, else by a short one.

The loss of a batch is ``sum(w e^2) / b + 10 sqrt(sum(w e^2) / sum(w t^2))``. Both parts depend on
the network through S = sum(w e^2) alone. So micro-batches (and the ranks of torchrun) add up the
gradient of S, and one factor at the end makes it the exact gradient of the batch's loss. Memory is
that of one micro-batch.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fieldlum.models import distributed
from fieldlum.models.dense_network import (
    Canvas,
    HourInputs,
    Net,
    Shape,
    bfloat16_pays,
    canvas,
    encode,
    hours,
    pick_device,
    scene_inputs,
)
from fieldlum.models.dense_state import (
    STAGE_EPOCHS,
    STAGES,
    Run,
    TrainingPlan,
    keep,
    restore,
)
from fieldlum.records import Progress, quiet
from fieldlum.session.provenance import data_digest

if TYPE_CHECKING:
    from fieldlum.models import Patch
    from fieldlum.models.data import Dataset

RER_SHARE = 10.0  # weight of the relative error in the loss (paper)
VALIDATION_SHARE = 0.1  # of the images
PATIENCE_EPOCHS = 2  # paper
LEAST_RATE = 1e-10  # below it the next stage begins; not measured
SHORT_EPOCHS = 25  # validations of the short schedule; not measured
SHORT_VALIDATION_PIXELS = 60_000  # not measured
SHORT_STEPS = 3000  # target of a short schedule before its batches grow; not measured
SHORT_BATCH = (512, 8192)  # smallest and largest batch of the short schedule [px]; not measured


# ----------------------------------------------------------------------------------------------
# pixels


@dataclass(frozen=True, slots=True)
class PixelSampler:
    """All (hour, seen pixel) pairs of some hours, on the device.

    The number of a pair is hour * P + index in `seen`.
    """

    canvas: Canvas
    hours: HourInputs
    target: Tensor  # [n, P]
    patch: Tensor | None  # [n, P]
    weight: Tensor  # [P]
    seen: Tensor  # [P] pixel numbers

    def __len__(self) -> int:
        return self.target.numel()

    def batch(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return scene inputs, patch, target and weight of numbered pairs."""
        hour = numbers // len(self.seen)
        place = numbers - hour * len(self.seen)
        scene = scene_inputs(self.canvas, self.hours, hour, self.seen[place])
        direct = torch.zeros_like(scene[:, 0]) if self.patch is None else self.patch[hour, place]
        return scene, direct.unsqueeze(1), self.target[hour, place], self.weight[place]


def _pixels(
    data: Dataset, base: Canvas, shape: Shape, patch: Patch, device: torch.device
) -> PixelSampler:
    seen = np.flatnonzero(data.seen)

    def flat(maps: NDArray[np.float32]) -> Tensor:
        rows = [torch.from_numpy(encode(m.reshape(-1)[seen], shape.curve)) for m in maps]
        return torch.stack(rows).to(device)

    use_patch = patch != "none" and data.patch_cdm2 is not None
    weight = torch.from_numpy(data.weights.reshape(-1)[seen].astype(np.float32))
    return PixelSampler(
        base.to(device),
        hours(data.light, shape).to(device),
        flat(data.luminance_cdm2),
        flat(data.patch_cdm2) if use_patch and data.patch_cdm2 is not None else None,
        weight.to(device),
        torch.from_numpy(seen).to(device),
    )


# ----------------------------------------------------------------------------------------------
# one batch


def _loss_parts(
    net: Net, pixels: PixelSampler, numbers: Tensor, micro: int, half: bool, learn: bool
) -> Tensor:
    """Return [S_error, S_target, count] summed over the batch and all ranks.

    With `learn`, also add the gradients of S_error.
    """
    parts = torch.zeros(3, dtype=torch.float64)
    for mine in numbers[distributed.rank() :: distributed.world()].split(micro):
        scene, direct, target, weight = pixels.batch(mine)
        with torch.set_grad_enabled(learn):
            with torch.autocast(scene.device.type, torch.bfloat16, enabled=half):
                error = net(scene, direct) - target
            squares = (weight * error.square()).sum()
        if learn:
            squares.backward()
        target2 = (weight * target.square()).sum()
        parts += torch.tensor([squares.item(), target2.item(), len(mine)], dtype=torch.float64)
    return distributed.total(parts.to(pixels.target.device)).cpu()


def loss_value(parts: Tensor) -> float:
    """Return MSE + 10 RER from [S_error, S_target, count]."""
    error, target, count = parts.tolist()
    return error / count + RER_SHARE * math.sqrt(error / max(target, 1e-12))


def _step(
    net: Net,
    optimiser: torch.optim.Optimizer,
    pixels: PixelSampler,
    numbers: Tensor,
    micro: int,
    half: bool,
) -> float:
    """Update once with the exact gradient of the batch's loss; return the loss.

    A loss of NaN means that there was no update.
    """
    optimiser.zero_grad(set_to_none=False)
    parts = _loss_parts(net, pixels, numbers, micro, half, learn=True)
    error, target, count = parts.tolist()
    if not math.isfinite(error):
        return math.nan
    factor = 1.0 / count + 0.5 * RER_SHARE / math.sqrt(max(error * target, 1e-24))
    for parameter in net.parameters():
        if parameter.grad is not None:
            distributed.total(parameter.grad).mul_(factor)
    optimiser.step()
    return loss_value(parts)


# ----------------------------------------------------------------------------------------------
# the loop


def _epoch_batches(
    pixels: PixelSampler, plan: TrainingPlan, run: Run, shape: Shape, seed: int
) -> Iterator[Tensor]:
    """Yield the epoch's batches of pair numbers.

    They depend on (seed, epoch) alone, so that a resumed training repeats nothing.
    """
    generator = torch.Generator().manual_seed(seed * 1_000_003 + run.epoch)
    device, per_image = pixels.target.device, len(pixels.seen)
    if plan.schedule == "short":
        images = max(1, round(plan.batch_pixels / per_image))
        for _ in range(-(-plan.steps // SHORT_EPOCHS)):
            if shape.form == "cnn":
                group = torch.randint(pixels.target.shape[0], (images,), generator=generator)
                yield _whole_images(group, per_image).to(device)
            else:
                yield torch.randint(len(pixels), (plan.batch_pixels,), generator=generator).to(
                    device
                )
        return
    images = STAGES[run.stage]
    if shape.form == "cnn":
        for group in torch.randperm(pixels.target.shape[0], generator=generator).split(images):
            yield _whole_images(group, per_image).to(device)
        return
    for numbers in torch.randperm(len(pixels), generator=generator).split(images * per_image):
        yield numbers.to(device)


def _whole_images(group: Tensor, per_image: int) -> Tensor:
    """Return the numbers of all pixels of a group of images."""
    return (group[:, None] * per_image + torch.arange(per_image)).reshape(-1)


def _short_rate(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the rate: a short warm-up, then a cosine to zero over the steps or the time.

    The time counts if it ends first.
    """
    done = run.step / max(plan.steps, 1)
    if budget_s:
        done = max(done, run.elapsed_s / budget_s)
    warm = min(1.0, (run.step + 1) / (0.03 * plan.steps + 1))
    return run.rate * warm * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0)))


def _paper_rate(run: Run, improved: bool) -> None:
    """Halve the rate after two epochs without gain.

    Halve the batch after 30 epochs, or when the rate is below `LEAST_RATE`.
    """
    run.stale = 0 if improved else run.stale + 1
    run.stage_epoch += 1
    if run.stale >= PATIENCE_EPOCHS:
        run.rate, run.stale = run.rate / 2.0, 0
    if run.stage_epoch >= STAGE_EPOCHS or run.rate < LEAST_RATE:
        run.stage, run.stage_epoch, run.stale = run.stage + 1, 0, 0
        run.rate = max(run.rate, LEAST_RATE)


def train(
    data: Dataset,
    shape: Shape,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    plan: TrainingPlan | None = None,
    checkpoint: Path | None = None,
    stop_after_epochs: int | None = None,
    bfloat16: bool | None = None,
    progress: Progress = quiet,
) -> tuple[Net, NDArray[np.float64], dict[str, Any]]:
    """Train; return the network with the best validation weights, the average image, and a record.

    plan: None uses the paper's schedule if it fits in the budget, else a short one measured to fit.
    checkpoint: written after each epoch; an existing one is continued. stop_after_epochs: end
    early, as a kill would.
    """
    clock = _Clock(time.monotonic(), time.process_time())
    device = pick_device()
    distributed.join(device)
    half = bfloat16_pays(device) if bfloat16 is None else bfloat16
    if shape.form == "cnn":
        shape = replace(shape, patch_width=200)
    torch.manual_seed(seed)
    net = Net(shape).to(device)
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3, fused=True)
    teach, check = _validation_split(len(data), seed)
    average = np.log10(np.maximum(data.luminance_cdm2[teach], 1.0)).mean(axis=0, dtype=np.float64)
    base = canvas(average, data.heading_deg)
    pixels, exam = (_pixels(data.take(rows), base, shape, patch, device) for rows in (teach, check))
    if plan is None:
        plan = _make_plan(net, pixels, budget_s, half)
    best = {name: value.clone() for name, value in net.state_dict().items()}
    run, mark = Run(rate=plan.rate), data_digest(data.digest(), patch, seed)
    if checkpoint is not None and checkpoint.is_file():
        plan, best = restore(checkpoint, net, optimiser, run, shape, mark)
    loop = _Loop(
        net, optimiser, pixels, plan, run, shape, seed, half, budget_s, clock.resumed(run), progress
    )
    numbers = _exam_numbers(len(exam), plan, seed).to(device)
    first_epoch = run.epoch
    while not _finished(run, plan, budget_s):
        loop.epoch(best)
        score = loss_value(
            _loss_parts(net, exam, numbers, 4 * plan.micro_pixels, half, learn=False)
        )
        if improved := math.isfinite(score) and score < run.best:
            run.best = score
            best = {name: value.clone() for name, value in net.state_dict().items()}
        run.epoch += 1
        run.cpu_s = loop.clock.cpu_s()
        if plan.schedule == "paper":
            _paper_rate(run, improved)
        if checkpoint is not None and distributed.rank() == 0:
            keep(checkpoint, net, optimiser, run, plan, shape, mark, best)
        if stop_after_epochs is not None and run.epoch - first_epoch >= stop_after_epochs:
            break
    net.load_state_dict(best)
    return net, average, _record(loop, [data.slots[i] for i in check])


def _record(loop: _Loop, validation_slots: list[str]) -> dict[str, Any]:
    """Return what config.json records of a training."""
    run, plan = loop.run, loop.plan
    return {
        "schedule": plan.schedule,
        "epochs": run.epoch,
        "steps": run.step,
        "seconds": round(run.elapsed_s, 1),
        "cpu_seconds": round(run.cpu_s, 1),
        "pixels_seen_per_pixel": round(_passes(run, plan, loop.pixels), 2),
        "best_validation_loss": run.best,
        "skipped_updates": run.skipped,
        "seed": loop.seed,
        "device": loop.pixels.target.device.type,
        "bfloat16": loop.half,
        "plan": asdict(plan),
        "validation_slots": validation_slots,
    }


@dataclass(frozen=True, slots=True)
class _Clock:
    """Seconds of this training, including those before an interruption."""

    wall_s: float
    process_s: float
    wall_before_s: float = 0.0
    cpu_before_s: float = 0.0

    def resumed(self, run: Run) -> _Clock:
        return replace(self, wall_before_s=run.elapsed_s, cpu_before_s=run.cpu_s)

    def elapsed_s(self) -> float:
        return self.wall_before_s + time.monotonic() - self.wall_s

    def cpu_s(self) -> float:
        return self.cpu_before_s + time.process_time() - self.process_s


@dataclass(frozen=True, slots=True)
class _Loop:
    """Everything that the batches of an epoch need."""

    net: Net
    optimiser: torch.optim.Optimizer
    pixels: PixelSampler
    plan: TrainingPlan
    run: Run
    shape: Shape
    seed: int
    half: bool
    budget_s: float | None
    clock: _Clock
    progress: Progress

    def epoch(self, best: dict[str, Tensor]) -> None:
        """Run one epoch's updates, or as many as the budget allows.

        After a loss that is not finite, restore `best`.
        """
        run, plan = self.run, self.plan
        for batch in _epoch_batches(self.pixels, plan, run, self.shape, self.seed):
            rate = _short_rate(plan, run, self.budget_s) if plan.schedule == "short" else run.rate
            self.optimiser.param_groups[0]["lr"] = rate
            loss = _step(self.net, self.optimiser, self.pixels, batch, plan.micro_pixels, self.half)
            run.step += 1
            run.elapsed_s = distributed.agreed(self.clock.elapsed_s(), self.pixels.target.device)
            self.progress(
                *_how_far(run, plan, self.budget_s), f"loss {loss:.4f}  best {run.best:.4f}"
            )
            if not math.isfinite(loss):
                run.skipped += 1
                self.net.load_state_dict(best)
                run.rate /= 2.0
            if self.budget_s and run.elapsed_s > self.budget_s:
                break


def _passes(run: Run, plan: TrainingPlan, pixels: PixelSampler) -> float:
    """Return how often each training pixel was used on average: epochs in the paper's sense."""
    return (
        run.step * plan.batch_pixels / len(pixels) if plan.schedule == "short" else float(run.epoch)
    )


def _validation_split(n: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split off a tenth of the images for validation, at least one; one image validates itself."""
    order = np.random.default_rng(seed).permutation(n)
    cut = max(1, round(VALIDATION_SHARE * n))
    return (np.sort(order[cut:]), np.sort(order[:cut])) if n > 1 else (order, order)


def _exam_numbers(total: int, plan: TrainingPlan, seed: int) -> Tensor:
    """Return all validation pixels; in the short schedule a fixed random part of them."""
    numbers = torch.arange(total)
    if plan.schedule == "short" and total > SHORT_VALIDATION_PIXELS:
        numbers = torch.randperm(total, generator=torch.Generator().manual_seed(seed))[
            :SHORT_VALIDATION_PIXELS
        ]
    return numbers


def _finished(run: Run, plan: TrainingPlan, budget_s: float | None) -> bool:
    if budget_s and run.elapsed_s >= budget_s:
        return True
    if plan.schedule == "short":
        return run.step >= plan.steps
    return run.epoch >= plan.epochs or run.stage >= len(STAGES)


def _how_far(run: Run, plan: TrainingPlan, budget_s: float | None) -> tuple[int, int]:
    """Return thousandths of the training: by steps or epochs, or by time if that ends it."""
    done = (
        run.step / max(plan.steps, 1)
        if plan.schedule == "short"
        else run.epoch / max(plan.epochs, 1)
    )
    if budget_s:
        done = max(done, run.elapsed_s / budget_s)
    return min(1000, int(1000 * done)), 1000


def _make_plan(net: Net, pixels: PixelSampler, budget_s: float | None, half: bool) -> TrainingPlan:
    """Return the paper's schedule if there is no budget or it fits in, else a short one.

    The short one has as many steps as the measured speed allows.
    """
    micro = 8192 if pixels.target.device.type == "cpu" else 131_072
    if budget_s is None:
        return TrainingPlan(micro_pixels=micro)
    speed = distributed.agreed(_pixels_per_second(net, pixels, micro, half), pixels.target.device)
    affordable = speed * budget_s
    if affordable >= TrainingPlan().epochs * len(pixels):
        return TrainingPlan(micro_pixels=micro)
    batch = int(np.clip(affordable / SHORT_STEPS, *SHORT_BATCH))
    steps = max(SHORT_EPOCHS, int(affordable / batch))
    return TrainingPlan("short", steps=steps, batch_pixels=batch, micro_pixels=micro)


def _pixels_per_second(net: Net, pixels: PixelSampler, micro: int, half: bool) -> float:
    numbers = torch.arange(min(micro, len(pixels)), device=pixels.target.device).repeat(
        distributed.world()
    )
    _loss_parts(
        net, pixels, numbers, micro, half, learn=True
    )  # the first call also compiles and allocates
    start = time.monotonic()
    for _ in range(3):
        _loss_parts(net, pixels, numbers, micro, half, learn=True)
    return 3 * len(numbers) / max(time.monotonic() - start, 1e-6)
