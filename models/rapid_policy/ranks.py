"""The processes of a training that torchrun started: one alone, or several that learn from parts of each batch."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel


@dataclass(frozen=True)
class Ranks:
    """This process among all."""

    rank: int = 0
    world: int = 1
    device: torch.device = torch.device("cpu")

    @property
    def first(self) -> bool:
        """Whether this process is the one that writes and reports."""
        return self.rank == 0

    def wait(self) -> None:
        """Waits until all processes are here."""
        if self.world > 1:
            dist.barrier()

    def agree(self, *values: float) -> list[float]:
        """The values of the first process, except for the last, which is the largest of all processes: the clock is
        the first one's, but a signal may reach any."""
        if self.world == 1:
            return list(values)
        shared = torch.tensor(values[:-1], dtype=torch.float64, device=self.device)
        largest = torch.tensor(values[-1:], dtype=torch.float64, device=self.device)
        dist.broadcast(shared, 0)
        dist.all_reduce(largest, dist.ReduceOp.MAX)
        return [*shared.tolist(), *largest.tolist()]

    def mean(self, value: torch.Tensor) -> float:
        """The mean over all processes."""
        value = value.detach().clone()
        if self.world > 1:
            dist.all_reduce(value)
        return value.item() / self.world

    def rows(self, size: int) -> slice:
        """The part of a batch that this process learns from."""
        if size % self.world:
            raise ValueError(f"training.windows: {size} do not divide among {self.world} processes: write a multiple")
        share = size // self.world
        return slice(self.rank * share, (self.rank + 1) * share)

    def together(self, module: nn.Module) -> nn.Module:
        """The module, with gradients averaged over all processes."""
        return DistributedDataParallel(module) if self.world > 1 else module

    def end(self) -> None:
        """Leaves the other processes."""
        if self.world > 1:
            dist.destroy_process_group()


def join(device: str) -> Ranks:
    """This process, by torchrun's environment; `device` is auto, cpu or cuda."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if world == 1:
        return Ranks(device=torch.device(device))
    picked = torch.device(device, int(os.environ.get("LOCAL_RANK", "0"))) if device == "cuda" else torch.device(device)
    if picked.type == "cuda":
        torch.cuda.set_device(picked)
    dist.init_process_group("nccl" if picked.type == "cuda" else "gloo")
    return Ranks(dist.get_rank(), world, picked)
