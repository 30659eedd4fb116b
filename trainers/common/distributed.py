"""Several processes that train one policy, as ``torchrun`` starts them: each flies flocks of its own, all step alike.

Whoever trains in one process need not know of this: all functions are then about that one process alone.
Processes are numbered from 0. The first writes, prints and evaluates; the others fly and learn.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "any_of",
    "average",
    "broadcast",
    "check_alike",
    "is_first",
    "leave",
    "mean",
    "mean_and_std",
    "own_device",
    "own_part",
    "print_rank0",
    "process_group",
    "rank",
    "reduce_gradients",
    "size",
    "texts",
]

PATIENCE = 50.0  # s; longest wait for the other processes
TEXT_BYTES = 4096

Key = TypeVar("Key")
_met: list[bool] = []  # not empty once this process has trained with others: they part before the evaluation


def rank() -> int:
    """The number of this process."""
    if dist.is_initialized():
        return dist.get_rank()
    return int(os.environ["RANK"]) if dist.is_torchelastic_launched() else 0


def size() -> int:
    """How many processes train together now."""
    return dist.get_world_size() if dist.is_initialized() else 1


def is_first() -> bool:
    """Whether this process is the one that writes, prints and evaluates."""
    return rank() == 0


def print_rank0(text: str) -> None:
    """Print a line, in the first process only."""
    if is_first():
        print(text, flush=True)


@contextlib.contextmanager
def process_group(device: str) -> Iterator[None]:
    """Train together with the other processes that ``torchrun`` has started, until `leave` or the end.

    Args:
        device: the run's.

    Raises:
        InputError: the others do not come, or these processes have trained together before.
    """
    if dist.is_initialized() or not dist.is_torchelastic_launched() or os.environ["WORLD_SIZE"] == "1":
        yield
        return
    if _met:
        raise InputError("these processes have trained together already; start torchrun once for each run")
    _met.append(True)
    own = torch.device(own_device(device))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    with _others("did not meet"):
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo", timeout=datetime.timedelta(seconds=PATIENCE)
        )
    try:
        yield
    finally:
        leave()


def leave() -> None:
    """Train together no longer; each process may take its time from now on."""
    if dist.is_initialized():
        dist.destroy_process_group()


def own_device(device: str) -> str:
    """Where this process trains: with ``cuda``, on the GPU of its number among the processes of its machine.

    Raises:
        InputError: several processes of one machine would share the GPU that was named.
    """
    if not device.startswith("cuda") or not dist.is_torchelastic_launched():
        return device
    if device == "cuda":
        return f"cuda:{os.environ['LOCAL_RANK']}"
    if os.environ["LOCAL_WORLD_SIZE"] == "1":
        return device
    raise InputError(f"device={device} would put all processes on one GPU; device=cuda gives each its own")


def own_part(config: TrainConfig, begins_at: int = 0) -> TrainConfig:
    """The settings of a run as this process follows them: its share of flocks, data and batches, and its own seed.

    What cannot be shared equally is rounded up, so that all have equally much to do.

    Args:
        config: the settings of the run.
        begins_at: round from which a run goes on, so that the flocks that begin anew then are others.
    """
    if size() == 1:
        return config
    shared = ("num_envs", "batch_size", "capacity")
    trainer = config.trainer
    shares = {name: -(-getattr(trainer, name) // size()) for name in shared if hasattr(trainer, name)}
    seed = config.seed if is_first() else derive_seed(config.seed, "process", rank(), begins_at)
    return dataclasses.replace(
        config, seed=seed, device=own_device(config.device), trainer=dataclasses.replace(trainer, **shares)
    )


def reduce_gradients(parameters: Iterable[Tensor], loss: Tensor, weight: Tensor) -> Tensor:
    """Make the gradients that parameters hold those of the mean loss over all processes.

    Args:
        parameters: with or without gradient, in all processes the same.
        loss: the mean over what counts in this process, [].
        weight: how much counts in this process, []; with 0 neither loss nor gradients matter.

    Returns:
        the mean over what counts anywhere, [].
    """
    loss = loss.detach()
    if size() == 1:
        return loss
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), loss.view(1), torch.ones_like(loss).view(1)])
    flat = torch.where(weight > 0, flat * weight, torch.zeros_like(flat))
    _sum(flat)
    flat = flat[:-1] / flat[-1]
    for gradient, part in zip(gradients, flat[:-1].split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))
    return flat[-1]


def mean(values: Mapping[Key, float]) -> dict[Key, float]:
    """Mean over all processes of each of some numbers, NaN left out; all must have the same names in one order."""
    if size() == 1:
        return dict(values)
    own = torch.tensor([float(value) for value in values.values()], dtype=torch.float64)
    known = ~own.isnan()
    both = torch.stack([torch.where(known, own, 0.0), known.double()])
    _sum(both)
    return dict(zip(values, (both[0] / both[1]).tolist(), strict=True))


def mean_and_std(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the numbers [M] of all processes, M may differ; [] each."""
    if size() == 1:
        return values.mean(), values.std()
    sums = torch.stack([values.sum(), torch.full_like(values.sum(), len(values))])
    _sum(sums)
    total, count = sums
    center = total / count
    squares = (values - center).square().sum()
    _sum(squares)
    return center, (squares / (count - 1)).sqrt()


def average(*tensors: Tensor) -> None:
    """Replace tensors by their means over all processes, in place."""
    if size() > 1:
        for tensor in tensors:
            _sum(tensor)
            tensor /= size()


def any_of(*flags: bool) -> list[bool]:
    """For each flag, whether it is true in any process."""
    if size() == 1:
        return list(flags)
    counts = torch.tensor(flags, dtype=torch.int64)
    _sum(counts)
    return (counts > 0).tolist()


def texts(text: str) -> list[str]:
    """The texts of all processes, in their order, of up to 4,096 bytes each."""
    if size() == 1:
        return [text]
    content = text.encode()[:TEXT_BYTES]
    own = torch.tensor(list(content.ljust(TEXT_BYTES, b"\0")), dtype=torch.uint8)
    found = [torch.empty_like(own) for _ in range(size())]
    with _others():
        dist.all_gather(found, own)
    return [bytes(each.tolist()).rstrip(b"\0").decode(errors="ignore") for each in found]


def broadcast(tensors: Iterable[Tensor]) -> None:
    """Replace tensors by those of the first process, in place."""
    if size() > 1:
        with _others():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


def check_alike(tensors: Iterable[Tensor], when: str) -> None:
    """Make sure that all processes hold the same tensors, to the last bit.

    Args:
        tensors: what they should share.
        when: for the message.

    Raises:
        InputError: they do not.
    """
    if size() == 1:
        return
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().flatten().view(torch.uint8).numpy().tobytes())
    found = texts(digest.hexdigest())
    if len(set(found)) > 1:
        others = [str(number) for number, each in enumerate(found) if each != found[0]]
        raise InputError(
            f"the weights of process {', '.join(others)} are no longer those of process 0 {when}: all processes must "
            "run on the same kind of machine with the same versions; go on from the last checkpoint with resume="
        )


def _sum(tensor: Tensor) -> None:
    """Replace a tensor by its sum over all processes, in place."""
    with _others():
        dist.all_reduce(tensor)


@contextlib.contextmanager
def _others(what: str = "lost the others") -> Iterator[None]:
    """Say it in one sentence if the other processes do not answer."""
    try:
        yield
    except RuntimeError as error:
        reason = re.sub(r"^(\[[^\]]*\]\s*)+", "", str(error).strip().splitlines()[0]).split(". ")[0].rstrip(".")
        raise InputError(
            f"process {rank()} of {os.environ.get('WORLD_SIZE', size())} {what} ({reason}): another has ended, as its "
            f"own message says, or did not answer within {PATIENCE:g} s; go on from the last checkpoint with resume="
        ) from error
