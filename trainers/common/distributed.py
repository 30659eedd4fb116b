"""Distributed training: several processes, started by ``torchrun``, train one policy.

Each process collects from its own environments, and all take the same optimiser steps. The first process, rank 0, also
writes, prints and evaluates. With a single process all functions here do nothing, or what a single process needs.
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

TIMEOUT = 50.0  # s; longest wait for the other processes
TEXT_BYTES = 4096

Key = TypeVar("Key")
_joined: list[bool] = []  # not empty once this process was in a process group, which ends before the evaluation


def rank() -> int:
    """The rank of this process."""
    if dist.is_initialized():
        return dist.get_rank()
    return int(os.environ["RANK"]) if dist.is_torchelastic_launched() else 0


def size() -> int:
    """Number of processes that train together now."""
    return dist.get_world_size() if dist.is_initialized() else 1


def is_first() -> bool:
    """Whether this is the process that writes, prints and evaluates, rank 0."""
    return rank() == 0


def print_rank0(text: str) -> None:
    """Print a line in the first process."""
    if is_first():
        print(text, flush=True)


@contextlib.contextmanager
def process_group(device: str) -> Iterator[None]:
    """Join the other processes that ``torchrun`` has started, until `leave` or the end of the block.

    Args:
        device: of the run.

    Raises:
        InputError: the others do not answer, or these processes have trained together before.
    """
    if dist.is_initialized() or not dist.is_torchelastic_launched() or os.environ["WORLD_SIZE"] == "1":
        yield
        return
    if _joined:
        raise InputError("these processes have trained together already; start torchrun once for each run")
    _joined.append(True)
    own = torch.device(own_device(device))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    with _other_processes("could not reach the others"):
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo", timeout=datetime.timedelta(seconds=TIMEOUT)
        )
    try:
        yield
    finally:
        leave()


def leave() -> None:
    """Leave the process group: from now on processes need not wait for each other."""
    if dist.is_initialized():
        dist.destroy_process_group()


def own_device(device: str) -> str:
    """The device of this process: with ``cuda``, the GPU of its local rank.

    Raises:
        InputError: several processes of one machine would share a GPU.
    """
    if not device.startswith("cuda") or not dist.is_torchelastic_launched():
        return device
    if device == "cuda":
        return f"cuda:{os.environ['LOCAL_RANK']}"
    if os.environ["LOCAL_WORLD_SIZE"] == "1":
        return device
    raise InputError(f"device={device} would put all processes on one GPU; device=cuda gives each its own")


def own_part(config: TrainConfig, begins_at: int = 0) -> TrainConfig:
    """The settings of a run for this process: its part of the environments, data and batches, and its own seed.

    Parts are rounded up, so that all processes have the same.

    Args:
        config: the settings of the run.
        begins_at: round from which a run resumes; environments that start afresh there get other seeds.
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
    """Replace the gradients of parameters by their mean over all processes, in place.

    Args:
        parameters: with or without gradient, the same in all processes.
        loss: the loss of this process, a mean over agents, [].
        weight: number of these agents, []; with 0 the loss and the gradients of this process are ignored.

    Returns:
        the mean loss over the agents of all processes, [].
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
    """The mean of each value over all processes, without NaN; all must give the same names in the same order."""
    if size() == 1:
        return dict(values)
    own = torch.tensor([float(value) for value in values.values()], dtype=torch.float64)
    known = ~own.isnan()
    both = torch.stack([torch.where(known, own, 0.0), known.double()])
    _sum(both)
    return dict(zip(values, (both[0] / both[1]).tolist(), strict=True))


def mean_and_std(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation, [] each, of the values [M] of all processes; M may differ between them."""
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
    """Replace each tensor by its mean over all processes, in place."""
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
    """The texts of all processes by rank, each cut to 4,096 bytes."""
    if size() == 1:
        return [text]
    content = text.encode()[:TEXT_BYTES]
    own = torch.tensor(list(content.ljust(TEXT_BYTES, b"\0")), dtype=torch.uint8)
    found = [torch.empty_like(own) for _ in range(size())]
    with _other_processes():
        dist.all_gather(found, own)
    return [bytes(each.tolist()).rstrip(b"\0").decode(errors="ignore") for each in found]


def broadcast(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by that of the first process, in place."""
    if size() > 1:
        with _other_processes():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)


def check_alike(tensors: Iterable[Tensor], when: str) -> None:
    """Check that all processes hold bitwise equal tensors.

    Args:
        tensors: the tensors.
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
            f"the weights of process {', '.join(others)} differ from those of process 0 {when}: all processes must run "
            "on the same kind of machine with the same versions; continue from the last checkpoint with resume="
        )


def _sum(tensor: Tensor) -> None:
    """Replace a tensor by its sum over all processes, in place."""
    with _other_processes():
        dist.all_reduce(tensor)


@contextlib.contextmanager
def _other_processes(what: str = "lost the others") -> Iterator[None]:
    """Raise an `InputError` of one sentence if the other processes do not answer."""
    try:
        yield
    except RuntimeError as error:
        reason = re.sub(r"^(\[[^\]]*\]\s*)+", "", str(error).strip().splitlines()[0]).split(". ")[0].rstrip(".")
        raise InputError(
            f"process {rank()} of {os.environ.get('WORLD_SIZE', size())} {what} ({reason}): another one has ended (see "
            f"its own message) or did not answer within {TIMEOUT:g} s; continue from the last checkpoint with resume="
        ) from error
