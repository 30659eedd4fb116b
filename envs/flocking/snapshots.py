"""What rollouts continue from, as named tensors: taken apart, and put back where it fits.

Rollouts that are interrupted and restored go on bit for bit when the generators of the environment are set too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["Stateful", "refuse_foreign"]


class Stateful:
    """Something whose state is the attributes that its class names in `STATE`: tensors, or None where not needed."""

    STATE: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state, by name."""
        state = {name: getattr(self, name) for name in self.STATE}
        return {name: value.clone() for name, value in state.items() if value is not None}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Go on from a copy of what `snapshot` gave, whatever device it is on."""
        for name, value in snapshot.items():
            setattr(self, name, value.to(getattr(self, name).device, copy=True))


def refuse_foreign(snapshot: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> None:
    """Refuse a snapshot that is not of the kind of one's own, or of flocks of other sizes.

    Raises:
        InputError: with the first difference.
    """
    for name in sorted(own.keys() | snapshot.keys()):
        theirs, ours = _described(snapshot.get(name)), _described(own.get(name))
        if name == "sizes" and theirs == ours:
            theirs, ours = (str(kept[name].tolist()) for kept in (snapshot, own))
        if theirs != ours:
            raise InputError(
                f"the snapshot is of other flocks, agents or settings: its {name} is {theirs}, that of this "
                f"environment is {ours}; build the environment as the one that it was taken of"
            )


def _described(value: Tensor | None) -> str:
    return "absent" if value is None else f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
