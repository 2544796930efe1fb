"""Several processes, one for each GPU, that share the worlds of one run. Started by torchrun; a single process is a group of one.

Every process holds the same policy, design and stream of goals and simulates its share of the worlds. Gradients and figures are
averaged, so that all take the same step. What is not the same everywhere belongs to the first process: files, the learning phase, the
log.

No process waits for one that has failed: what may fail in one of them stands in :meth:`Group.fail_together`.
"""

import datetime
import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

P = ParamSpec("P")
T = TypeVar("T")
LONGEST = datetime.timedelta(days=365)
"""Longest time that a process waits for another: as long as any run. PyTorch's half an hour is less than what a process with more seeds
than another may take longer. A process that has ended is noticed at once, by its connections."""


def in_full(error: BaseException | None) -> str:
    """Its message and its notes."""
    return " ".join([str(error), *getattr(error, "__notes__", ())])


def is_lost(error: BaseException) -> bool:
    """True for the error of gloo where a process that others wait for has ended: by an error of its own, or killed."""
    return isinstance(error, RuntimeError) and "gloo/transport" in str(error)


class OtherProcessError(RuntimeError):
    """Raised where nothing failed, because something did in another process; the message is the one given there."""


@dataclass(frozen=True)
class Group:
    """The processes of a run; each method but :meth:`split` and :meth:`device` is called by all of them, or waits for them."""

    rank: int = 0
    """Number of this process."""
    size: int = 1
    """Number of processes."""
    local_rank: int = 0
    """Number of this process on its machine: that of its GPU."""
    local_size: int = 1
    """Number of processes on its machine."""

    @property
    def first(self) -> bool:
        """True in the process that writes files."""
        return self.rank == 0

    def split(self, worlds: int) -> range:
        """Worlds of this process, out of ``worlds`` in all processes."""
        if worlds % self.size:
            more = worlds + self.size - worlds % self.size
            raise ValueError(
                f"train.worlds must be a multiple of the {self.size} processes that share the worlds, got {worlds}; "
                f"take train.worlds={more} or another torchrun --nproc-per-node."
            )
        share = worlds // self.size
        return range(self.rank * share, (self.rank + 1) * share)

    def device(self, name: str) -> str | None:
        """Device of this process for auto, cpu or cuda; with several processes, the GPU of its local rank. None: any."""
        if self.size == 1 or name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
            return None if name == "auto" else name
        count = torch.cuda.device_count()
        if self.local_size > count:
            raise ValueError(
                f"each process on a machine needs a GPU of its own: there are {self.local_size} processes, but PyTorch sees "
                f"{count} GPUs; take torchrun --nproc-per-node={max(count, 1)} or device=cpu."
            )
        return f"cuda:{self.local_rank}"

    def any(self, wish: bool) -> bool:
        """True if ``wish`` is True in any process."""
        return self._largest(int(wish)) > 0

    def average(self, tensors: Iterable[Tensor]) -> list[Tensor]:
        """Mean over the processes of each tensor; all of one dtype and device, and of the same shapes everywhere."""
        tensors = list(tensors)
        if self.size == 1:
            return tensors
        flat = torch.cat([tensor.detach().flatten() for tensor in tensors])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([tensor.numel() for tensor in tensors])
        return [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]

    def gather(self, tensor: Tensor, dim: int) -> Tensor | None:
        """The tensors of all processes, joined along the axis of the worlds, in the first; None in the others."""
        if self.size == 1:
            return tensor
        tensor = tensor.contiguous()
        parts = [torch.empty_like(tensor) for _ in range(self.size)] if self.first else None
        dist.gather(tensor, parts)
        return torch.cat(parts, dim) if parts else None

    def broadcast_(self, tensors: Iterable[Tensor]) -> None:
        """Copy the tensors of the first process into those of the others, in place."""
        for tensor in tensors if self.size > 1 else ():
            dist.broadcast(tensor, src=0)

    def broadcast(self, value: T, source: int = 0) -> T:
        """The value of process ``source``, in every process: plain values and tensors on the CPU."""
        values = [value]
        if self.size > 1:
            dist.broadcast_object_list(values, src=source)
        return values[0]

    def collect(self, values: Sequence[T]) -> list[T]:
        """The values of all processes, in the order of the processes, in every process: plain values, their number may differ."""
        parts = [list(values)] * self.size
        if self.size > 1:
            dist.all_gather_object(parts, list(values))
        return [value for part in parts for value in part]

    def once(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """Do ``work`` in the first process, while the others wait; gives its result there and None elsewhere.

        Raises:
            OtherProcessError: In the others, if it failed.
        """
        with self.fail_together():
            return work(*args, **kwargs) if self.first else None

    @contextmanager
    def fail_together(self, kind: type[Exception] = Exception) -> Iterator[None]:
        """The block ends well in every process or in none. Inside it, no process may wait for another.

        Where several fail, the first of them raises its error. An error of another kind leaves at once: its process ends, and
        with it the connections that the others wait on.

        Raises:
            OtherProcessError: Another process failed with an error of this kind.
        """
        if self.size == 1:
            yield
            return
        error = None
        try:
            yield
        except kind as caught:
            error = caught
        failed = self.size - self._largest(0 if error is None else self.size - self.rank)
        if failed == self.size:
            return
        message = self.broadcast(in_full(error), source=failed)
        if error is not None and failed == self.rank:
            raise error
        raise OtherProcessError(message) from error

    def _largest(self, value: int) -> int:
        number = torch.tensor(value)
        if self.size > 1:
            dist.all_reduce(number, dist.ReduceOp.MAX)
        return int(number)


@contextmanager
def joined() -> Iterator[Group]:
    """The group that torchrun started this process in, until the block ends. For applications: it is the process's only one."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Group()
        return
    # Defaults of its functions are the group that exists when they are defined. The first step of an optimizer imports it: the group
    # and its threads would then last until the interpreter is torn down, where a thread that needs Python ends the process.
    importlib.import_module("torch.distributed.nn")
    gpus = torch.cuda.is_available() and dist.is_nccl_available()
    dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=LONGEST)
    try:
        yield Group(
            rank=dist.get_rank(),
            size=dist.get_world_size(),
            local_rank=int(os.environ["LOCAL_RANK"]),
            local_size=int(os.environ["LOCAL_WORLD_SIZE"]),
        )
    finally:
        dist.destroy_process_group()
