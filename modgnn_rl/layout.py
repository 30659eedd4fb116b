"""What the numbers of an observation are: which are vectors of space, and under what they may be transformed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from modgnn_rl.errors import InputError

__all__ = ["STATE", "SYMMETRIES", "Layout"]

SYMMETRIES = ("translation", "rotation", "reflection")


@dataclass(frozen=True)
class Layout:
    """The layout of an agent's observation, whose first columns may be vectors: a position, a velocity, and so on.

    Attributes:
        width: numbers F in an observation.
        dims: dimension D of space: 1, 2 or 3.
        vectors: number of vectors; the first ``dims * vectors`` columns. With at least one, the first is the position;
            with at least two, the second is the velocity.
        symmetries: transformations of all vectors under which the task does not change. ``translation``: models do not
            see the agent's own position, and communicate differences. ``rotation``, ``reflection``: imitation augments
            its data; expert actions are vectors, too.
        scale: factors of the first columns, so that they are of order one; the others are not scaled.

    Raises:
        InputError: the values contradict each other.
    """

    width: int
    dims: int = 2
    vectors: int = 0
    symmetries: Collection[str] = ()
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if unknown := set(self.symmetries) - set(SYMMETRIES):
            raise InputError(f"symmetries={sorted(unknown)} are unknown; expected some of {', '.join(SYMMETRIES)}")
        if self.dims * self.vectors > self.width or len(self.scale) > self.width:
            raise InputError(
                f"an observation of {self.width} numbers cannot begin with {self.vectors} vectors of {self.dims} "
                f"components and {len(self.scale)} factors"
            )
        if self.symmetries and not self.vectors:
            raise InputError(
                f"symmetries={tuple(self.symmetries)} need vectors in the observation; give vectors=1 or more"
            )

    @property
    def hidden(self) -> int:
        """Number of leading columns that an agent's own part of a model does not see: those of its position."""
        return self.dims if "translation" in self.symmetries else 0

    @property
    def is_rotatable(self) -> bool:
        """Whether imitation may rotate or reflect samples."""
        return not {"rotation", "reflection"}.isdisjoint(self.symmetries)

    @property
    def is_state(self) -> bool:
        """Whether an observation is a position and a velocity, and nothing else, symmetric as mechanics is."""
        return self.width == 2 * self.dims and self.vectors == 2 and {"translation", "rotation"} <= set(self.symmetries)


# Position, m, and velocity, m/s, of robots in space, scaled to order one.
STATE = Layout(6, dims=3, vectors=2, symmetries=("translation", "rotation"), scale=(0.5, 0.5, 0.5, 1.4, 1.4, 1.4))
