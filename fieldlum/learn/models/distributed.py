"""Connect the processes that torchrun starts: rank, count, sums, and values on which they agree.

Without torchrun there is one process, and sums and values are returned unchanged.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor
from torch import distributed as dist


def rank() -> int:
    """Return the number of this process among torchrun's processes, from 0; 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """Return the number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def join(device: torch.device) -> None:
    """Join the group of torchrun's processes, once; do nothing if there is only one process."""
    if world() > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def total(tensor: Tensor) -> Tensor:
    """Return `tensor` after each value in it was replaced by its sum over all processes.

    Without torchrun it is unchanged.
    """
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
