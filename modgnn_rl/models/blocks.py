"""Building blocks that several models share: scaling, action head, multilayer perceptron."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from modgnn_rl.nn.communication import GraphShift
from modgnn_rl.utils.tensors import clip_to_ball

__all__ = [
    "FEATURES",
    "LATENT",
    "POSITION_SCALE",
    "VELOCITY_SCALE",
    "BallHead",
    "LayerSpec",
    "Relative",
    "Scale",
    "Zero",
    "is_equivariant",
    "mlp",
]

POSITION_SCALE = 0.5  # 1/m
VELOCITY_SCALE = 1.4  # s/m
LATENT = 10  # output width of f_pre and f_mid in the paper
FEATURES = 16  # output width of layers before the last


class LayerSpec(NamedTuple):
    """The layer that a model is to build.

    Attributes:
        hops: communication hops K.
        hidden: width of the hidden layers.
        earlier: number of earlier layers.
        head: final module of the last layer; None for the layers before it.
        num_agents: N, for models that depend on it.
    """

    hops: int
    hidden: int
    earlier: int
    head: nn.Module | None
    num_agents: int | None

    @property
    def inputs(self) -> int:
        """Width of the layer's input: observation and outputs of earlier layers."""
        return 6 + self.earlier * FEATURES

    @property
    def outputs(self) -> int:
        """Width of the layer's output."""
        return FEATURES if self.head is None else 3

    def end(self, *f_final: nn.Module) -> nn.Module:
        """The layer's f_final: the given modules, followed by the head in the last layer."""
        return nn.Sequential(*f_final) if self.head is None else nn.Sequential(*f_final, self.head)

    def scales(self) -> list[nn.Module]:
        """One scaling module per hop; the one of hop 0 hides the absolute position."""
        return [Scale(self.inputs, hide_position=hop == 0) for hop in range(self.hops + 1)]


class BallHead(nn.Module):
    """Projection onto the ball of allowed actions, as in the environment and the expert.

    Args:
        max_speed: radius of the ball, m/s.
    """

    is_equivariant = True

    def __init__(self, max_speed: float) -> None:
        super().__init__()
        self.max_speed = max_speed

    def forward(self, action: Tensor) -> Tensor:
        """Project actions [..., 3], m/s."""
        return clip_to_ball(action, self.max_speed)


class Scale(nn.Module):
    """Scale positions and velocities to order one; optionally hide the position.

    Args:
        features: width of the data; columns after position and velocity are not changed.
        hide_position: return zero positions, for data that contain absolute positions.
    """

    is_linear_map = True
    factor: Tensor

    def __init__(self, features: int = 6, *, hide_position: bool = False) -> None:
        super().__init__()
        factor = torch.ones(features)
        factor[:3], factor[3:6] = 0.0 if hide_position else POSITION_SCALE, VELOCITY_SCALE
        self.register_buffer("factor", factor, persistent=False)

    def forward(self, data: Tensor) -> Tensor:
        """Scale data [..., F]."""
        return data * self.factor


class Relative(nn.Module):
    """Translation-invariant features of an edge: the difference of its ends, and the receiver without its position.

    Args:
        features: width of one end F, which begins with position and velocity.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.scale = Scale(features)

    def forward(self, ends: Tensor) -> Tensor:
        """Map [E, 2 F] to the scaled difference and the receiver without its position [E, 2 F - 3]."""
        sender, receiver = self.scale(ends.unflatten(-1, (2, -1))).unbind(-2)
        return torch.cat((sender - receiver, receiver[..., 3:]), -1)


class Zero(nn.Module):
    """A hop that contributes nothing.

    Args:
        features: width of the output.
    """

    is_equivariant = True

    def __init__(self, features: int) -> None:
        super().__init__()
        self.features = features

    def forward(self, data: Tensor) -> Tensor:
        """Return zeros [..., features]."""
        return data.new_zeros(*data.shape[:-1], self.features)


def is_equivariant(module: nn.Module) -> bool:
    """Whether a policy is known to be rotation-equivariant: each part is in a module with ``is_equivariant = True``."""
    parts = [part for part in module.modules() if not list(part.children())]
    inside = {part for holder in module.modules() if _is_marked(holder) for part in holder.modules()}
    return all(part in inside or isinstance(part, (nn.Identity, GraphShift)) for part in parts)


def _is_marked(module: nn.Module) -> bool:
    return bool(getattr(module, "is_equivariant", False))


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Linear-ReLU-Linear-ReLU-Linear, the paper's three-layer network."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )
