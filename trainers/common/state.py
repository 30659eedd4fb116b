"""The state of a training run: collected from its parts for a checkpoint, and given back to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.checkpoint import Checkpoint

__all__ = [
    "Checkpointable",
    "Learner",
    "TensorGroups",
    "collect_state",
    "optimizer_state",
    "restore_optimizer",
    "restore_state",
]

TensorGroups = dict[str, dict[str, Tensor]]


class Checkpointable(Protocol):
    """A part of a run whose state goes into checkpoints: a learner, a group of environments and its data."""

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random number generators of this part, by name; their states are saved with it."""

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state: groups of named tensors, and values that JSON can hold."""

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Return to a state that `state` returned."""


class Learner(Checkpointable, Protocol):
    """What a training loop needs to know of a learner."""

    updates_done: int

    @property
    def ema_policy(self) -> ModGNN:
        """The policy to act with, to evaluate and to save: the moving average of the weights."""


def collect_state(parts: Mapping[str, Checkpointable]) -> tuple[TensorGroups, dict[str, Any]]:
    """The states of all parts and of their generators, as the tensors and values of one checkpoint.

    Args:
        parts: by name. Groups and values of the first keep their names; those of the others become ``<part>.<name>``.
    """
    tensors: TensorGroups = {"generators": {}}
    values: dict[str, Any] = {}
    for prefix, part in _prefixed(parts):
        groups, plain = part.state()
        tensors |= {f"{prefix}{group}": named for group, named in groups.items()}
        values |= {f"{prefix}{name}": value for name, value in plain.items()}
        states = {f"{prefix}{name}": generator.get_state() for name, generator in part.generators.items()}
        tensors["generators"] |= states
    return tensors, values


def restore_state(parts: Mapping[str, Checkpointable], checkpoint: Checkpoint, *, with_generators: bool = True) -> None:
    """Give all parts the states that `collect_state` has collected.

    Args:
        parts: by the names used there, the same one first.
        checkpoint: the checkpoint.
        with_generators: whether to restore the states of the generators too.

    Raises:
        KeyError: the checkpoint has no state of a part.
        RuntimeError: the state of a part does not fit it.
    """
    for prefix, part in _prefixed(parts):
        part.restore(_without_prefix(prefix, checkpoint.tensors), _without_prefix(prefix, checkpoint.state))
        if with_generators:
            states = _without_prefix(prefix, checkpoint.tensors["generators"])
            for name, generator in part.generators.items():
                generator.set_state(states[name])


def _prefixed(parts: Mapping[str, Checkpointable]) -> list[tuple[str, Checkpointable]]:
    return [(f"{name}." if number else "", part) for number, (name, part) in enumerate(parts.items())]


def _without_prefix(prefix: str, named: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of one part, under the names that it gave them."""
    length = len(prefix)
    return {name[length:]: value for name, value in named.items() if name[: name.rfind(".") + 1] == prefix}


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The state of an optimiser (step counts, moments) as named tensors, ``<parameter's index>.<name>``."""
    entries = optimizer.state_dict()["state"].items()
    return {f"{index}.{name}": value for index, entry in entries for name, value in entry.items()}


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Load what `optimizer_state` returned; learning rates and other options stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, _, name = key.partition(".")
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
