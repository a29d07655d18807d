"""The processes that train together (data-parallel, ``torchrun``), or this one alone.

A step's batch has a fixed number of shards, each with randomness of its own, and the processes share the
shards. So what a run computes does not depend on how many processes compute it.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Processes:
    """Who this process is among those that train together."""

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes files and shows progress."""
        return self.rank == 0

    def share_of(self, shards: int) -> range:
        """The shards of a step's batch that this process computes.

        Raises:
            ValueError: If they cannot be shared evenly.
        """
        if shards % self.count:
            raise ValueError(
                f"`shards` must be a multiple of the {self.count} processes, got {shards}. "
                "Every process computes the same number of a step's shards."
            )
        own = shards // self.count
        return range(self.rank * own, (self.rank + 1) * own)

    def sum_(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the processes, in one message."""
        if self.count == 1 or not tensors:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        for tensor, summed in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
            tensor.copy_(summed.view_as(tensor))

    def copy_from_first_(self, tensor: Tensor, *, has_one: bool) -> None:
        """Give every process the tensor of the first process that ``has_one``; nothing if none has."""
        if self.count == 1:
            return
        holders = torch.zeros(self.count, device=tensor.device)
        holders[self.rank] = float(has_one)
        torch.distributed.all_reduce(holders)
        if holders.any():
            torch.distributed.broadcast(tensor, src=int(holders.argmax()))

    @contextmanager
    def first_goes_ahead(self) -> Iterator[None]:
        """The block runs in the first process, then in the others, which find the files that it wrote."""
        if self.count > 1 and not self.is_first:
            torch.distributed.barrier()
        yield
        if self.count > 1 and self.is_first:
            torch.distributed.barrier()

    def agree(self, values: list[float]) -> list[float]:
        """The first process's numbers, in every process."""
        if self.count == 1:
            return values
        shared = torch.tensor(values, dtype=torch.float64)
        torch.distributed.broadcast(shared, src=0)
        agreed: list[float] = shared.tolist()
        return agreed


def device_of_process(name: str) -> torch.device:
    """The device ``name`` for this process; plain ``cuda`` means the process's own GPU.

    Raises:
        ValueError: If there is no such device here.
    """
    if name == "cuda":
        name = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"`device` must be one that torch can use here, such as 'cpu', got {name!r}: {reason}"
        ) from error
    return device


@contextmanager
def joined_processes() -> Iterator[Processes]:
    """The processes that ``torchrun`` started, or this one alone when it did not.

    They talk through gloo, which needs no GPU; NCCL is used where each process has its own CUDA device.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Processes()
        return
    # Imported later, as optimizers do, it would keep the group as a default argument. Threads of gloo that
    # are still there when the interpreter ends can take the process down.
    importlib.import_module("torch.distributed.nn")
    on_gpus = torch.cuda.is_available() and torch.cuda.device_count() >= int(
        os.environ.get("LOCAL_WORLD_SIZE", "1")
    )
    torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if on_gpus else "gloo")
    try:
        yield Processes(torch.distributed.get_rank(), torch.distributed.get_world_size())
    finally:
        torch.distributed.destroy_process_group()
