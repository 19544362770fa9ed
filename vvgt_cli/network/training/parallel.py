"""Processes that train together under torchrun, with gradients summed after every step."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed, nn


@dataclass(frozen=True)
class World:
    """A process of a group.

    Attributes:
        rank: its number, from 0.
        size: number of processes.
        device: of its network.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Return whether this process writes and prints."""
        return self.rank == 0

    def total(self, values: Iterable[float]) -> list[float]:
        """Return the sums over all processes."""
        tensor = torch.tensor(list(values), dtype=torch.float64, device=self.device)
        if self.size > 1:
            distributed.all_reduce(tensor)
        return [float(value) for value in tensor.cpu()]

    def add_gradients(self, network: nn.Module) -> None:
        """Replace every parameter's gradient by the sum over all processes; a missing one counts as zero.

        One sum per step replaces torch's DistributedDataParallel: scenes come one at a time, several per step, and a
        skipped scene must not leave the others waiting.
        """
        grads: list[Tensor] = []
        for parameter in network.parameters():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            grads.append(parameter.grad)
        if self.size == 1:
            return
        flat = torch.cat([grad.reshape(-1) for grad in grads])
        distributed.all_reduce(flat)
        for grad, part in zip(grads, flat.split([grad.numel() for grad in grads]), strict=True):
            grad.copy_(part.view_as(grad))

    def wait(self) -> None:
        """Wait until all processes arrive."""
        if self.size > 1:
            distributed.barrier()


@contextmanager
def world() -> Iterator[World]:
    """Yield the group of torchrun's environment, one process without it; gloo on CPUs, NCCL on GPUs."""
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if cuda else torch.device("cpu")
    if size == 1:
        yield World(0, 1, device)
        return
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield World(rank, size, device)
    finally:
        distributed.destroy_process_group()
