"""Building blocks that several models share: scaling, action head, multilayer perceptron."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from modgnn_rl.actions import ActionSpace
from modgnn_rl.layout import STATE, Layout
from modgnn_rl.nn.communication import GraphShift

__all__ = [
    "FEATURES",
    "LATENT",
    "VELOCITY_SCALE",
    "LayerSpec",
    "Relative",
    "Scale",
    "Zero",
    "is_equivariant",
    "mlp",
]

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
        layout: of the observations.
        width: numbers in an action.
    """

    hops: int
    hidden: int
    earlier: int
    head: ActionSpace | None
    num_agents: int | None
    layout: Layout
    width: int

    @property
    def inputs(self) -> int:
        """Width of the layer's input: observation and outputs of earlier layers."""
        return self.layout.width + self.earlier * FEATURES

    @property
    def outputs(self) -> int:
        """Width of the layer's output."""
        return FEATURES if self.head is None else self.width

    def end(self, *f_final: nn.Module) -> nn.Module:
        """The layer's f_final: the given modules, followed by the head in the last layer."""
        return nn.Sequential(*f_final) if self.head is None else nn.Sequential(*f_final, self.head)

    def scales(self) -> list[nn.Module]:
        """One scaling module per hop; the one of hop 0 hides the absolute position."""
        return [Scale(self.layout, self.inputs, hide_position=hop == 0) for hop in range(self.hops + 1)]


class Scale(nn.Module):
    """Scale observations to order one; optionally hide the position.

    Args:
        layout: says what the columns of the data are, if earlier layers add others after them, too.
        features: width of the data; default: that of the layout.
        hide_position: return zero positions, for data that contain absolute positions.
    """

    is_linear_map = True
    factor: Tensor

    def __init__(self, layout: Layout = STATE, features: int | None = None, *, hide_position: bool = False) -> None:
        super().__init__()
        factor = torch.ones(features or layout.width)
        factor[: len(layout.scale)] = torch.tensor(layout.scale)
        if hide_position:
            factor[: layout.hidden] = 0.0
        self.register_buffer("factor", factor, persistent=False)

    def forward(self, data: Tensor) -> Tensor:
        """Scale data [..., F]."""
        return data * self.factor


class Relative(nn.Module):
    """Features of an edge: the difference of its ends, and the receiver without its position.

    They do not change under translations if the task does not.

    Args:
        layout: says what the first columns of one end are.
        features: width of one end F.
    """

    def __init__(self, layout: Layout, features: int) -> None:
        super().__init__()
        self.scale, self.hidden = Scale(layout, features), layout.hidden

    def forward(self, ends: Tensor) -> Tensor:
        """Map [E, 2 F] to the scaled difference and the receiver without its position [E, 2 F - D]."""
        sender, receiver = self.scale(ends.unflatten(-1, (2, -1))).unbind(-2)
        return torch.cat((sender - receiver, receiver[..., self.hidden :]), -1)


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
