"""Write and read checkpoints of a training: weights, optimiser, plan and progress."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from fieldlum.core.errors import InputError
from fieldlum.learn.models.dense_network import Net, Shape, pick_device
from fieldlum.learn.models.dense_schedule import Run, TrainingPlan
from fieldlum.session import replacing


def keep(
    path: Path,
    net: Net,
    optimiser: torch.optim.Optimizer,
    run: Run,
    plan: TrainingPlan,
    shape: Shape,
    mark: str,
    best: dict[str, Tensor],
) -> None:
    """Write a checkpoint to `path` atomically: progress, plan, optimiser, current and best weights.

    best: weights with the least validation loss; mark: digest of training data, patch mode and
    seed, which `restore` compares.
    """
    state = {
        "net": net.state_dict(),
        "best": best,
        "optimiser": optimiser.state_dict(),
        "run": asdict(run),
        "plan": asdict(plan),
        "shape": asdict(shape),
        "data": mark,
    }
    with replacing(path) as file:
        torch.save(state, file)


def restore(
    path: Path, net: Net, optimiser: torch.optim.Optimizer, run: Run, shape: Shape, mark: str
) -> tuple[TrainingPlan, dict[str, Tensor]]:
    """Load a checkpoint into net, optimiser and run; return its plan and its best weights.

    shape, mark: the form of this network, and the digest of this training's data, patch mode and
    seed. Raises InputError if those of the checkpoint differ, and for a checkpoint that cannot be
    read or contains other objects than tensors, numbers and texts.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns before it rejects files of other programs
            state = torch.load(path, map_location=pick_device(), weights_only=True)
        if state["shape"] != asdict(shape):
            raise KeyError("the checkpoint of another network")
        if state.get("data", mark) != mark:
            raise KeyError("a checkpoint of other pictures, other irradiance or another seed")
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
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
