"""The imitation loss, and the augmentations of its data."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import functional_call, stack_module_state, vmap
from torchrl.modules import set_recurrent_mode

from modgnn_rl.actions import squared_error
from modgnn_rl.layout import Layout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.task import EXPERT_ACTION

__all__ = [
    "hide_velocities",
    "imitation_loss",
    "random_rotations",
    "rotate",
    "stacked_losses",
]

Loss = Callable[[Tensor, Tensor], Tensor]


def imitation_loss(
    policy: ModGNN,
    batch: TensorDictBase,
    receivers: Tensor,
    *,
    expert_action: NestedKey = EXPERT_ACTION,
    loss: Loss = squared_error,
) -> Tensor:
    """Mean difference between the policy's and the expert's actions at the end of each window.

    Only the receivers' actions at the last step are computed.

    Args:
        policy: the policy; it is run over the window.
        batch: windows [S, W] with the policy's in-keys and the expert's action.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].
        loss: difference of two actions [R, A], whose mean is minimised; default: the square of each component.

    Returns:
        the loss, [].
    """
    expert = batch[expert_action]
    counted = _at_last_step(expert, receivers)
    with set_recurrent_mode(True):
        action = policy(batch.copy(), receivers=counted)[policy.out_keys[0]]
    return loss(action[counted], expert[counted]).mean()


def stacked_losses(
    policies: Sequence[ModGNN],
    batch: TensorDictBase,
    receivers: Tensor,
    *,
    expert_action: NestedKey = EXPERT_ACTION,
    loss: Loss = squared_error,
) -> list[Tensor]:
    """`imitation_loss` of policies that differ only in their weights, computed at once with ``torch.func.vmap``.

    The gradients are added to those of the weights.

    Args:
        policies: P of them.
        batch: windows [S, W], see `imitation_loss`.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].
        loss: see `imitation_loss`.

    Returns:
        the P losses, [] each, without gradient.
    """
    expert = batch[expert_action]
    counted = _at_last_step(expert, receivers)
    weights, buffers = stack_module_state(list(policies))

    def loss_of(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        result = functional_call(policies[0], (weights, buffers), (batch.copy(),), {"receivers": counted})
        difference = loss(result[policies[0].out_keys[0]], expert)
        return torch.where(counted.unsqueeze(-1), difference, 0.0).sum() / (counted.sum() * difference.shape[-1])

    with set_recurrent_mode(True):
        losses = vmap(loss_of)(weights, buffers)
    gradients = torch.autograd.grad(losses.sum(), list(weights.values()))
    for name, gradient in zip(weights, gradients, strict=True):
        for policy, part in zip(policies, gradient, strict=True):
            parameter = policy.get_parameter(name)
            parameter.grad = part.clone() if parameter.grad is None else parameter.grad + part
    return list(losses.detach())


def hide_velocities(batch: TensorDictBase, layout: Layout, fraction: float, generator: torch.Generator) -> None:
    """Set the velocities of all agents to zero in a random fraction of the windows [S, W], in place.

    A cloned policy can read its next action off its own velocity, which remembers the last one; in closed loop such a
    policy drifts away.

    Args:
        batch: with observations [S, W, N, F], and without stored messages.
        layout: says which columns are the velocity.
        fraction: probability that a window is chosen.
        generator: source of randomness.
    """
    observation = batch["agents", "observation"]
    chance = torch.rand(len(batch), generator=generator, device=generator.device).to(observation.device)
    column = torch.arange(observation.shape[-1], device=observation.device)
    is_velocity = (column >= layout.dims) & (column < 2 * layout.dims)
    hidden = (chance < fraction)[:, None, None, None] & is_velocity
    batch["agents", "observation"] = observation.masked_fill(hidden, 0.0)


def _at_last_step(actions: Tensor, receivers: Tensor) -> Tensor:
    """Receivers [S, N] at the last step of the windows of actions [S, W, N, A], as bool [S, W, N]."""
    counted = torch.zeros_like(actions[..., 0], dtype=torch.bool)
    counted[:, -1] = receivers
    return counted


def random_rotations(count: int, layout: Layout, like: Tensor, generator: torch.Generator) -> Tensor:
    """Random rotations and reflections, as far as the task is symmetric under them.

    Args:
        count: number of matrices.
        layout: of the observations, for the dimension D of space and the symmetries.
        like: tensor with the dtype and device of the result.
        generator: source of randomness.

    Returns:
        orthogonal matrices [count, D, D], uniform over SO(D), with reflections over O(D).
    """
    matrices = torch.eye(layout.dims, dtype=like.dtype, device=like.device).expand(count, -1, -1)
    if "rotation" in layout.symmetries and layout.dims == 3:
        quaternion = torch.randn(count, 4, generator=generator, device=generator.device, dtype=like.dtype)
        w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).to(like.device).unbind(-1)
        rows = (
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        matrices = torch.stack(rows, -1).unflatten(-1, (3, 3))
    elif "rotation" in layout.symmetries and layout.dims == 2:
        turn = torch.rand(count, generator=generator, device=generator.device, dtype=like.dtype).to(like.device)
        cos, sin = torch.cos(2 * torch.pi * turn), torch.sin(2 * torch.pi * turn)
        matrices = torch.stack((cos, -sin, sin, cos), -1).unflatten(-1, (2, 2))
    if "reflection" in layout.symmetries:
        coin = torch.rand(count, generator=generator, device=generator.device).to(like.device)
        sign = torch.ones(count, layout.dims, dtype=like.dtype, device=like.device)
        sign[:, 0] = torch.where(coin < 0.5, -1.0, 1.0)
        matrices = matrices * sign.unsqueeze(-1)
    return matrices


def rotate(data: Tensor, rotations: Tensor, vectors: int) -> Tensor:
    """Rotate the vectors that data [S, ..., F] begin with, by one matrix per sample [S, D, D]; the rest stays."""
    end = vectors * rotations.shape[-1]
    flat = data[..., :end].flatten(1, -2).unflatten(-1, (vectors, -1)).flatten(1, 2)
    rotated = (flat @ rotations.transpose(-1, -2)).reshape(*data.shape[:-1], end)
    return rotated if end == data.shape[-1] else torch.cat((rotated, data[..., end:]), -1)
