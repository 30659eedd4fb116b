"""Snapshots: the complete state of running rollouts as named tensors.

Rollouts that are restored from a snapshot continue bit for bit if the random generators are restored too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["Stateful", "check_snapshot"]


class Stateful:
    """Base of classes whose state is the attributes named in `STATE`: tensors, or None where a feature is off."""

    STATE: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state, by name."""
        state = {name: getattr(self, name) for name in self.STATE}
        return {name: value.clone() for name, value in state.items() if value is not None}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Continue from a snapshot, whatever device it is on."""
        for name, value in snapshot.items():
            setattr(self, name, value.to(getattr(self, name).device, copy=True))


def check_snapshot(snapshot: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    """Check that a snapshot has the same tensors, shapes and flock sizes as the environment's own.

    Raises:
        InputError: with the first difference.
    """
    for name in sorted(own.keys() | snapshot.keys()):
        theirs, ours = _description(snapshot.get(name)), _description(own.get(name))
        if name == "sizes" and theirs == ours:
            theirs, ours = (str(kept[name].tolist()) for kept in (snapshot, own))
        if theirs != ours:
            raise InputError(
                f"the snapshot is of other flocks, agents or settings: its {name} is {theirs}, that of this "
                f"environment is {ours}; create the environment with the arguments of the one that was saved"
            )


def _description(value: Tensor | None) -> str:
    return "absent" if value is None else f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
