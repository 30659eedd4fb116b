"""Kinds of actions: how a policy's last layer ends, what imitation minimises, and how actions differ from the expert's.

Inside the library an action is a tensor of ``width`` real numbers for each agent. For discrete actions these are
scores, of which the environment executes the highest; an expert's choice is a one-hot vector.
"""

from __future__ import annotations

import abc
from collections.abc import Collection

import torch
from torch import Tensor, nn
from torch.nn import functional

from modgnn_rl.utils.tensors import clip_to_ball

__all__ = ["ActionSpace", "Ball", "Box", "Discrete", "squared_error"]


def squared_error(action: Tensor, expert_action: Tensor) -> Tensor:
    """Squared difference of each component, [..., A]."""
    return (action - expert_action).square()


class ActionSpace(nn.Module, abc.ABC):
    """What an agent can do, for actions [..., A]. As a module, it is the last step of a policy: it makes actions legal.

    Attributes:
        width: numbers in an action, A.
        idle_name: what the action `idle` is called in tables.
        is_equivariant: whether `forward` commutes with rotations of the action.
    """

    width: int
    idle_name = "zero action"
    is_equivariant = False

    def is_symmetric(self, symmetries: Collection[str], dims: int) -> bool:
        """Whether actions are vectors of space whose legal set does not change under some transformations.

        Args:
            symmetries: names of the transformations, see `modgnn_rl.layout.Layout`.
            dims: dimension of space.
        """
        return False

    @abc.abstractmethod
    def forward(self, output: Tensor) -> Tensor:
        """Map the output of a network [..., A] to a legal action."""

    def idle(self, like: Tensor) -> Tensor:
        """The action of an agent that does nothing, for observations [..., F]: zeros [..., A]."""
        return torch.zeros(*like.shape[:-1], self.width, dtype=like.dtype, device=like.device)

    def loss(self, action: Tensor, expert_action: Tensor) -> Tensor:
        """What imitation minimises the mean of, [..., A] or [..., 1]."""
        return squared_error(action, expert_action)

    def difference(self, action: Tensor, expert_action: Tensor) -> Tensor:
        """Squared difference between actions, mean over their components, [...]; the metric ``error``."""
        return squared_error(action, expert_action).mean(-1)


class Ball(ActionSpace):
    """Vectors within a ball: outputs are projected onto it.

    Args:
        radius: of the ball, in the unit of the action.
        width: components of the vector.
    """

    is_equivariant = True

    def __init__(self, radius: float, width: int) -> None:
        super().__init__()
        self.radius, self.width = radius, width

    def is_symmetric(self, symmetries: Collection[str], dims: int) -> bool:
        """See `ActionSpace.is_symmetric`."""
        return self.width == dims

    def forward(self, output: Tensor) -> Tensor:
        """Project onto the ball."""
        return clip_to_ball(output, self.radius)


class Box(ActionSpace):
    """Numbers between bounds: outputs are clipped to them, but have the gradient of the output itself.

    So a policy whose outputs lie beyond the bounds can learn to return; tanh would leave it without gradient.

    Args:
        low: lower bounds [A].
        high: upper bounds [A].
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.width = len(low)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    def is_symmetric(self, symmetries: Collection[str], dims: int) -> bool:
        """See `ActionSpace.is_symmetric`; the corners of a box are not where they were after a rotation."""
        return self.width == dims and "rotation" not in symmetries and bool((self.low == -self.high).all())

    def forward(self, output: Tensor) -> Tensor:
        """Clip each component to its bounds."""
        clipped = output.clamp(self.low.to(output), self.high.to(output))
        return output + (clipped - output).detach() if output.requires_grad else clipped

    def idle(self, like: Tensor) -> Tensor:
        """Zeros, or the nearest legal action [..., A]."""
        return super().idle(like).clamp(self.low.to(like), self.high.to(like))


class Discrete(ActionSpace):
    """One of several choices: a policy outputs scores, and the highest is executed.

    Args:
        width: number of choices.
    """

    idle_name = "first action"

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    def forward(self, output: Tensor) -> Tensor:
        """Scores are any numbers."""
        return output

    def idle(self, like: Tensor) -> Tensor:
        """The first choice, one-hot [..., A]."""
        idle = super().idle(like)
        idle[..., 0] = 1.0
        return idle

    def loss(self, action: Tensor, expert_action: Tensor) -> Tensor:
        """Cross-entropy of the expert's choice, [..., 1]."""
        chosen = functional.log_softmax(action, -1).gather(-1, expert_action.argmax(-1, keepdim=True))
        return -chosen

    def difference(self, action: Tensor, expert_action: Tensor) -> Tensor:
        """1 where the choices differ, else 0, [...]."""
        return (action.argmax(-1) != expert_action.argmax(-1)).to(action.dtype)
