"""Train the dense network: by the paper's schedule if there is time, else by a short one.

The loss of a batch is ``sum(w e^2) / b + 10 sqrt(sum(w e^2) / sum(w t^2))``. Both parts depend on
the network only through S = sum(w e^2), where b is the number of pixels, w their weight, e the
error and t the target. Therefore micro-batches (and the processes of torchrun) add up the gradient
of S, and one factor at the end makes it the exact gradient of the batch's loss. A batch needs the
memory of one micro-batch.

The schedule of the paper (Liu, Colburn and Inanici 2020) has three stages of batches, and its
learning rate falls when the validation error does not. The short schedule has as many steps as the
time allows, with a learning rate that falls to zero.
"""

from __future__ import annotations

import math
import os
import pickle
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch import distributed as dist

from fieldlum.core.arrays import Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Patch
from fieldlum.learn.models.baselines import captured
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.dense import (
    DenseFitted,
    Inputs,
    Net,
    Shape,
    bfloat16_pays,
    encode,
    from_state,
    inputs_of,
    pick_device,
)
from fieldlum.session import replacing
from fieldlum.session.provenance import data_digest

__all__ = ["fit", "from_state"]  # what `model_registry` promises of a model's module

RER_SHARE = 10.0  # weight of the relative error in the loss (paper)
STAGES = (6, 3, 1)  # batch in images' worth of pixels (paper)
STAGE_EPOCHS = 30  # paper
PATIENCE_EPOCHS = 2  # paper
MIN_RATE = 1e-10  # at a lower rate the next stage begins; not measured
VALIDATION_SHARE = 0.1  # of the images; not measured
SHORT_EPOCHS = 25  # number of validations in the short schedule; not measured
SHORT_VALIDATION_PIXELS = 60_000  # pixels that are validated in the short schedule; not measured
SHORT_STEPS = 3000  # steps to reach before the short schedule enlarges its batches; not measured
SHORT_BATCH = (512, 8192)  # smallest and largest batch of the short schedule [px]; not measured
_WARM_SHARE = 0.03  # share of the short schedule in which the rate rises; not measured
_MICRO_PIXELS = {"cpu": 8192, "cuda": 131_072}  # pixels of a micro-batch; not measured
_TIMED_BATCHES = 3  # micro-batches whose time decides between the schedules; not measured
_ONE_UPDATE_S = 1e-3  # a budget that ends after one update


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


@dataclass(frozen=True, slots=True)
class TrainingRecord:
    """What config.json records of a training, under the key dense_training.

    schedule: "paper" or "short"; epochs, steps: number of completed epochs and batches; seconds,
    cpu_seconds: time used; pixels_seen_per_pixel: average number of uses of a training pixel;
    best_validation_loss: see `loss_value`; skipped_updates: number of updates omitted because the
    loss was not finite; seed: of all random numbers; device: "cpu" or "cuda"; bfloat16: whether
    products were computed in that precision; plan: length and learning rate; validation_slots:
    slots of the images for validation.
    """

    schedule: str
    epochs: int
    steps: int
    seconds: float
    cpu_seconds: float
    pixels_seen_per_pixel: float
    best_validation_loss: float
    skipped_updates: int
    seed: int
    device: str
    bfloat16: bool
    plan: TrainingPlan
    validation_slots: list[str]


# ----------------------------------------------------------------------------------------------
# processes of torchrun; without it there is one


def rank() -> int:
    """Return the number of this process among torchrun's processes, from 0; 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """Return the number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def total(tensor: Tensor) -> Tensor:
    """Return `tensor` after each value in it was replaced by its sum over all processes."""
    if world() > 1:
        dist.all_reduce(tensor)
    return tensor


def agreed(value: float, device: torch.device) -> float:
    """Return in every process the value that the process with rank 0 passed.

    Processes that disagree about the end of a training would wait for each other without end.
    """
    if world() == 1:
        return value
    shared = torch.tensor([value], dtype=torch.float64, device=device)
    dist.broadcast(shared, 0)
    return float(shared.item())


# ----------------------------------------------------------------------------------------------
# pixels


@dataclass(frozen=True, slots=True)
class PixelSampler:
    """All pairs of one of n hours and one of P seen pixels, as tensors on one device.

    The index of a pair is hour times P plus the pixel's index in `seen`. inputs: of all pixels in
    the n hours; target: encoded luminance of the map [n, P]; patch: that of the sun patch [n, P],
    None without patches; weight: solid angle of the pixel over the mean of the seen pixels [P];
    seen: flat index of the pixel in the map [P]; counts: further weight of a pixel in an hour [n,
    P], None for 1. The length is n times P.
    """

    inputs: Inputs
    target: Tensor
    patch: Tensor | None
    weight: Tensor
    seen: Tensor
    counts: Tensor | None = None

    def __len__(self) -> int:
        return self.target.numel()

    def batch(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return inputs, targets and weights of b pairs of an hour and a pixel.

        numbers: indices of the pairs [b]. The results are the scene inputs [b, 7 or 8], the encoded
        luminance of the sun patch [b, 1] (0 without patches), the encoded target [b] and the weight
        in the loss [b].
        """
        hour = numbers // len(self.seen)
        place = numbers - hour * len(self.seen)
        scene = self.inputs.scene(hour, self.seen[place])
        direct = torch.zeros_like(scene[:, 0]) if self.patch is None else self.patch[hour, place]
        weight = self.weight[place]
        if self.counts is not None:
            weight = weight * self.counts[hour, place]
        return scene, direct.unsqueeze(1), self.target[hour, place], weight


def pixels_of(
    data: Dataset, pixels: Inputs, shape: Shape, patch: Patch, device: torch.device
) -> PixelSampler:
    """Return all pairs of an hour of `data` and a seen pixel, encoded, on the device.

    pixels: result of `inputs_of`. shape: its curve and sky_map are used. patch: with "none" sun
    patches are left out, otherwise they are used in cd/m2.
    """
    seen_index = np.flatnonzero(data.seen)

    def flat(maps: Floats32) -> Tensor:
        rows = [torch.from_numpy(encode(m.reshape(-1)[seen_index], shape.curve)) for m in maps]
        return torch.stack(rows).to(device)

    patches = None if patch == "none" else data.patch_cdm2
    weight = data.weights.reshape(-1)[seen_index].astype(np.float32)
    counts = None
    if data.counts is not None:
        counts = torch.from_numpy(data.counts.reshape(len(data), -1)[:, seen_index]).to(device)
    return PixelSampler(
        pixels.at(data.light, shape),
        flat(data.luminance_cdm2),
        None if patches is None else flat(patches),
        torch.from_numpy(weight).to(device),
        torch.from_numpy(seen_index).to(device),
        counts,
    )


def validation_split(n: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices from 0 of images for training [k] and for validation [n - k], each sorted.

    A tenth of the n images, but at least one, is drawn by `seed` for validation; a single image is
    used for both.
    """
    order = np.random.default_rng(seed).permutation(n)
    cut = max(1, round(VALIDATION_SHARE * n))
    return (np.sort(order[cut:]), np.sort(order[:cut])) if n > 1 else (order, order)


def _validation_numbers(count: int, plan: TrainingPlan, seed: int) -> Tensor:
    """Return the pairs that validate: all in the paper's schedule, else at most 60 000."""
    if plan.schedule == "paper" or count <= SHORT_VALIDATION_PIXELS:
        return torch.arange(count)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
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
    complete = shape.form == "cnn"
    count, unit = (images, 1) if complete else (len(pixels), per_image)
    if plan.schedule == "short":
        size = max(1, round(plan.batch_pixels * unit / per_image))
        draws = range(-(-plan.steps // SHORT_EPOCHS))
        groups = (torch.randint(count, (size,), generator=generator) for _ in draws)
    else:
        groups = torch.randperm(count, generator=generator).split(STAGES[run.stage] * unit)
    for group in groups:
        if complete:
            group = (group[:, None] * per_image + torch.arange(per_image)).reshape(-1)
        yield group.to(pixels.target.device)


# ----------------------------------------------------------------------------------------------
# schedule


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


def completed_share(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the completed share of steps, epochs or stages, or of the time if that is larger.

    The training ends at 1. budget_s: time limit [s] for run.elapsed_s; None: no limit.
    """
    if plan.schedule == "short":
        share = run.step / max(plan.steps, 1)
    else:
        share = max(run.epoch / max(plan.epochs, 1), float(run.stage >= len(STAGES)))
    return max(share, run.elapsed_s / budget_s) if budget_s else share


def short_rate(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the learning rate of the next step of the short schedule.

    After a warm-up it falls along a cosine to 0, by `completed_share`.
    """
    warm = min(1.0, (run.step + 1) / (_WARM_SHARE * plan.steps + 1))
    share = min(completed_share(plan, run, budget_s), 1.0)
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
    if run.stage_epoch >= STAGE_EPOCHS or run.rate < MIN_RATE:
        run.stage, run.stage_epoch, run.stale = run.stage + 1, 0, 0
        run.rate = max(run.rate, MIN_RATE)


# ----------------------------------------------------------------------------------------------
# one batch


@dataclass(slots=True)
class Trainer:
    """A network in training, with its optimiser and its training pixels.

    half: whether products are computed in bfloat16; micro: pixels whose gradient is computed at
    once.
    """

    net: Net
    pixels: PixelSampler
    half: bool
    micro: int
    optimiser: torch.optim.Optimizer = field(init=False)

    def __post_init__(self) -> None:
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=1e-3, fused=True)

    def loss_parts(self, pixels: PixelSampler, numbers: Tensor, micro: int, learn: bool) -> Tensor:
        """Return [S_error, S_target, count] summed over the batch and all processes.

        With `learn`, also add the gradients of S_error.
        """
        parts = torch.zeros(3, dtype=torch.float64)
        for mine in numbers[rank() :: world()].split(micro):
            scene, direct, target, weight = pixels.batch(mine)
            with torch.set_grad_enabled(learn):
                with torch.autocast(scene.device.type, torch.bfloat16, enabled=self.half):
                    error = self.net(scene, direct) - target
                squares = (weight * error.square()).sum()
            if learn:
                squares.backward()
            target2 = (weight * target.square()).sum()
            parts += torch.tensor([squares.item(), target2.item(), len(mine)], dtype=torch.float64)
        return total(parts.to(pixels.target.device)).cpu()

    def step(self, numbers: Tensor, rate: float) -> float:
        """Update the weights once by the exact gradient of the batch's loss; return the loss.

        rate: learning rate. If the loss is NaN, the weights did not change.
        """
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.zero_grad(set_to_none=False)
        parts = self.loss_parts(self.pixels, numbers, self.micro, learn=True)
        error, target, count = parts.tolist()
        if not math.isfinite(error):
            return math.nan
        factor = 1.0 / count + 0.5 * RER_SHARE / math.sqrt(max(error * target, 1e-24))
        for parameter in self.net.parameters():
            if parameter.grad is not None:
                total(parameter.grad).mul_(factor)
        self.optimiser.step()
        return loss_value(parts)

    def pixels_per_s(self, batch: int) -> float:
        """Return the measured speed of training with batches of `batch` pixels.

        As many pixels as in three micro-batches are timed; the batch before is not, because it also
        compiles.
        """
        device = self.pixels.target.device
        numbers = torch.arange(min(batch, len(self.pixels)), device=device).repeat(world())
        batches, start_s = _TIMED_BATCHES * (self.micro // batch), 0.0
        for k in range(1 + batches):
            start_s = time.monotonic() if k == 1 else start_s
            self.loss_parts(self.pixels, numbers, self.micro, learn=True)
        seconds = max(time.monotonic() - start_s, 1e-6)
        return agreed(batches * len(numbers) / seconds, device)

    def weights(self) -> dict[str, Tensor]:
        """Return a copy of the network's weights."""
        return {name: value.clone() for name, value in self.net.state_dict().items()}


def loss_value(parts: Tensor) -> float:
    """Return the loss MSE + 10 RER of a batch; parts: [S_error, S_target, count].

    S_error, S_target: weighted sums of squared errors and of squared targets (encoded luminance)
    over `count` pixels. MSE is S_error / count; RER (relative error) is the root of S_error /
    S_target.
    """
    error, target, count = parts.tolist()
    return error / count + RER_SHARE * math.sqrt(error / max(target, 1e-12))


# ----------------------------------------------------------------------------------------------
# the loop


def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    min_passes: float = 0.0,
    plan: TrainingPlan | None = None,
    checkpoint: Path | None = None,
    stop_after_epochs: int | None = None,
    bfloat16: bool | None = None,
    progress: Progress = quiet,
    **form: Any,
) -> DenseFitted:
    """Train the network on `data`; return it with the weights of the least validation loss.

    patch: with "none" sun patches are not an input, otherwise they are one in cd/m2; seed: of all
    random numbers. plan: length and learning rate. None uses the paper's schedule if there is no
    budget_s [s] or it fits in it, else a short one by measured speed. min_passes: without a plan,
    end after one update if the budget does not allow this number of passes over the training
    pixels. checkpoint: path, written after each epoch; an existing one is continued, with its plan;
    None for none. stop_after_epochs: number of epochs after which this call ends early, as an
    interruption would. bfloat16: compute products in this precision; None does so where it is fast.
    form: fields of `Shape`. Raises InputError for a checkpoint that cannot be used.
    """
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    device = pick_device()
    if world() > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    shape = Shape(**form)
    shape = replace(shape, patch_width=200) if shape.form == "cnn" else shape
    torch.manual_seed(seed)
    net = Net(shape).to(device)
    teach, check = validation_split(len(data), seed)
    average = np.log10(np.maximum(data.luminance_cdm2[teach], 1.0)).mean(axis=0, dtype=np.float64)
    base = inputs_of(average, data.heading_deg, device)
    exam = pixels_of(data.take(check), base, shape, patch, device)
    half = bfloat16_pays(device) if bfloat16 is None else bfloat16
    pixels = pixels_of(data.take(teach), base, shape, patch, device)
    trainer = Trainer(net, pixels, half, _MICRO_PIXELS[device.type])
    if plan is None:
        spent_s = agreed(time.monotonic() - start_s, device)
        plan, budget_s = _make_plan(trainer, budget_s, spent_s, min_passes, len(exam))
    trainer.micro = plan.micro_pixels
    run, mark = Run(rate=plan.rate), data_digest(data.digest(), patch, seed)
    best = trainer.weights()
    if checkpoint is not None and checkpoint.is_file():
        plan, best = _restore(checkpoint, trainer, run, shape, mark)
        start_s, start_cpu_s = start_s - run.elapsed_s, start_cpu_s - run.cpu_s
    numbers = _validation_numbers(len(exam), plan, seed).to(device)
    first_epoch = run.epoch
    while completed_share(plan, run, budget_s) < 1.0:
        for batch in epoch_batches(pixels, plan, run, shape, seed):
            rate = short_rate(plan, run, budget_s) if plan.schedule == "short" else run.rate
            loss = trainer.step(batch, rate)
            run.step += 1
            run.elapsed_s = agreed(time.monotonic() - start_s, device)
            share = min(completed_share(plan, run, budget_s), 1.0)
            progress(int(1000 * share), 1000, f"loss {loss:.4f}  best {run.best:.4f}")
            if not math.isfinite(loss):
                run.skipped += 1
                net.load_state_dict(best)
                run.rate /= 2.0
            if budget_s and run.elapsed_s > budget_s:
                break
        score = loss_value(trainer.loss_parts(exam, numbers, 4 * plan.micro_pixels, learn=False))
        if improved := math.isfinite(score) and score < run.best:
            run.best, best = score, trainer.weights()
        run.epoch += 1
        run.cpu_s = time.process_time() - start_cpu_s
        if plan.schedule == "paper":
            update_paper_rate(run, improved)
        if checkpoint is not None and rank() == 0:
            _store(checkpoint, trainer, run, plan, shape, mark, best)
        if stop_after_epochs is not None and run.epoch - first_epoch >= stop_after_epochs:
            break
    net.load_state_dict(best)
    slots = [data.slots[i] for i in check]
    about = _record(plan, run, len(pixels), seed, device, half, slots)
    domain, heading_deg = captured(data.light), data.heading_deg
    return DenseFitted(net, shape, average, heading_deg, patch, domain, asdict(about))


def _record(
    plan: TrainingPlan,
    run: Run,
    count: int,
    seed: int,
    device: torch.device,
    half: bool,
    validation_slots: list[str],
) -> TrainingRecord:
    """Return what config.json records; count: number of training pixels of all hours."""
    passes = run.step * plan.batch_pixels / count if plan.schedule == "short" else run.epoch
    return TrainingRecord(
        schedule=plan.schedule,
        epochs=run.epoch,
        steps=run.step,
        seconds=round(run.elapsed_s, 1),
        cpu_seconds=round(run.cpu_s, 1),
        pixels_seen_per_pixel=round(passes, 2),
        best_validation_loss=run.best,
        skipped_updates=run.skipped,
        seed=seed,
        device=device.type,
        bfloat16=half,
        plan=plan,
        validation_slots=validation_slots,
    )


def _make_plan(
    trainer: Trainer, budget_s: float | None, spent_s: float, min_passes: float, exam: int
) -> tuple[TrainingPlan, float | None]:
    """Return a plan and the time for it [s]; see `train`.

    spent_s: part of the budget that is used already; exam: number of validation pixels. The speed
    with full micro-batches decides on the schedule. The short schedule can have smaller, slower
    batches: their speed decides whether the rest of the budget is enough.
    """
    micro, count = trainer.micro, len(trainer.pixels)
    if budget_s is None:
        return TrainingPlan(micro_pixels=micro), None
    speed = trainer.pixels_per_s(micro)
    plan = affordable_plan(speed, count, budget_s, micro)
    if plan.schedule == "paper" or not min_passes:
        return plan, budget_s
    if plan.batch_pixels < micro:
        speed = min(speed, trainer.pixels_per_s(plan.batch_pixels))
    # A validation has no gradient, which is two thirds of a use (one matrix product of three).
    validation = SHORT_EPOCHS * min(exam, SHORT_VALIDATION_PIXELS) / 3.0
    enough = speed * (budget_s - spent_s) >= min_passes * count + validation
    return plan, budget_s if enough else _ONE_UPDATE_S


# ----------------------------------------------------------------------------------------------
# checkpoints


def _store(
    path: Path,
    trainer: Trainer,
    run: Run,
    plan: TrainingPlan,
    shape: Shape,
    mark: str,
    best: dict[str, Tensor],
) -> None:
    """Write a checkpoint atomically.

    best: weights with the least validation loss; mark: digest of training data, patch mode and
    seed, which `_restore` compares.
    """
    state = {
        "net": trainer.net.state_dict(),
        "best": best,
        "optimiser": trainer.optimiser.state_dict(),
        "run": asdict(run),
        "plan": asdict(plan),
        "shape": asdict(shape),
        "data": mark,
    }
    with replacing(path) as file:
        torch.save(state, file)


def _restore(
    path: Path, trainer: Trainer, run: Run, shape: Shape, mark: str
) -> tuple[TrainingPlan, dict[str, Tensor]]:
    """Load a checkpoint into trainer and run; return its plan and its best weights.

    Raises InputError if its shape or mark differ, and for a checkpoint that cannot be read or
    contains other objects than tensors, numbers and texts.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns before it rejects files of other programs
            state = torch.load(path, map_location=pick_device(), weights_only=True)
        if state["shape"] != asdict(shape):
            raise KeyError("the checkpoint of another network")
        if state.get("data", mark) != mark:
            raise KeyError("a checkpoint of other pictures, other irradiance or another seed")
        trainer.net.load_state_dict(state["net"])
        trainer.optimiser.load_state_dict(state["optimiser"])
        for name, value in state["run"].items():
            setattr(run, name, value)
        return TrainingPlan(**state["plan"]), state["best"]
    except (
        pickle.UnpicklingError,
        Warning,
        RuntimeError,
        KeyError,
        TypeError,
        EOFError,
        AttributeError,
    ) as error:
        raise InputError(
            path,
            f"a checkpoint that cannot be used ({str(error).splitlines()[0][:120]})",
            "a checkpoint of this training",
            "delete the file to start the training again",
        ) from None
