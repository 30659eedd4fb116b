"""All that a training run continues from, as one checkpoint, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from modgnn_rl.tracking.checkpoint import Checkpoint

__all__ = ["Part", "Tensors", "gather", "moments_of", "restore_moments", "scatter"]

Tensors = dict[str, dict[str, Tensor]]


class Part(Protocol):
    """A part of a run that has a state: a learner, a group of flocks."""

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random there, by name."""

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What a checkpoint holds of it: groups of named tensors, and plain values."""

    def restore(self, tensors: Tensors, values: dict[str, Any]) -> None:
        """Go on from what `state` gave."""


def gather(parts: Mapping[str, Part]) -> tuple[Tensors, dict[str, Any]]:
    """The states of all parts, and of their generators, as groups of tensors and values of one checkpoint.

    Args:
        parts: by name; groups and values of all but the first are called ``<part>.<name>``.
    """
    tensors: Tensors = {"generators": {}}
    values: dict[str, Any] = {}
    for own, part in _prefixed(parts):
        groups, plain = part.state()
        tensors |= {f"{own}{group}": named for group, named in groups.items()}
        values |= {f"{own}{name}": value for name, value in plain.items()}
        drawn = {f"{own}{name}": generator.get_state() for name, generator in part.generators.items()}
        tensors["generators"] |= drawn
    return tensors, values


def scatter(parts: Mapping[str, Part], checkpoint: Checkpoint, *, with_generators: bool = True) -> None:
    """Give parts their states back; the first is the one that was first in `gather`.

    Args:
        parts: by name.
        checkpoint: what `gather` gave.
        with_generators: whether to draw on as well, or anew.

    Raises:
        KeyError: the checkpoint holds no state of a part.
        RuntimeError: it does not fit.
    """
    for own, part in _prefixed(parts):
        part.restore(_under(own, checkpoint.tensors), _under(own, checkpoint.state))
        if with_generators:
            drawn = _under(own, checkpoint.tensors["generators"])
            for name, generator in part.generators.items():
                generator.set_state(drawn[name])


def _prefixed(parts: Mapping[str, Part]) -> list[tuple[str, Part]]:
    return [(f"{name}." if number else "", part) for number, (name, part) in enumerate(parts.items())]


def _under(prefix: str, named: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of one part, by the names that it gave them."""
    length = len(prefix)
    return {name[length:]: value for name, value in named.items() if name[: name.rfind(".") + 1] == prefix}


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """What an optimiser remembers of each parameter, as named tensors."""
    entries = optimizer.state_dict()["state"].items()
    return {f"{index}.{name}": value for index, entry in entries for name, value in entry.items()}


def restore_moments(optimizer: torch.optim.Optimizer, moments: Mapping[str, Tensor]) -> None:
    """Let an optimiser remember what `moments_of` gave."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in moments.items():
        index, _, name = key.partition(".")
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
