"""The processes of torchrun: which one this is, and what all of them agree on. Alone, everything
is as it stands.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor
from torch import distributed as dist


def rank() -> int:
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def join(device: torch.device) -> None:
    if world() > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def total(tensor: Tensor) -> Tensor:
    """The sum over all ranks, in place."""
    if world() > 1:
        dist.all_reduce(tensor)
    return tensor


def agreed(value: float, device: torch.device) -> float:
    """Rank 0's clock and speed hold for all: ranks that disagree about the end would wait for
    each other for ever.
    """
    if world() == 1:
        return value
    shared = torch.tensor([value], dtype=torch.float64, device=device)
    dist.broadcast(shared, 0)
    return float(shared.item())
