"""The imitation loss, and the augmentations of its data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import functional_call, stack_module_state, vmap
from torchrl.modules import set_recurrent_mode

from modgnn_rl.nn.modgnn import ModGNN

__all__ = [
    "hide_velocities",
    "imitation_loss",
    "random_rotations",
    "rotate",
    "stacked_losses",
]


EXPERT_ACTION = ("agents", "expert_action")


def imitation_loss(
    policy: ModGNN, batch: TensorDictBase, receivers: Tensor, *, expert_action: NestedKey = EXPERT_ACTION
) -> Tensor:
    """Mean squared error per component between the policy's and the expert's actions at the end of each window.

    Only the receivers' actions at the last step are computed.

    Args:
        policy: the policy; it is run over the window.
        batch: windows [S, W] with the policy's in-keys and the expert's action.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].

    Returns:
        the loss, [].
    """
    expert = batch[expert_action]
    counted = _at_last_step(expert, receivers)
    with set_recurrent_mode(True):
        action = policy(batch.copy(), receivers=counted)[policy.out_keys[0]]
    return (action - expert)[counted].square().mean()


def stacked_losses(
    policies: Sequence[ModGNN], batch: TensorDictBase, receivers: Tensor, *, expert_action: NestedKey = EXPERT_ACTION
) -> list[Tensor]:
    """`imitation_loss` of policies that differ only in their weights, computed at once with ``torch.func.vmap``.

    The gradients are added to those of the weights.

    Args:
        policies: P of them.
        batch: windows [S, W], see `imitation_loss`.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].

    Returns:
        the P losses, [] each, without gradient.
    """
    expert = batch[expert_action]
    counted = _at_last_step(expert, receivers)
    weights, buffers = stack_module_state(list(policies))

    def loss_of(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        result = functional_call(policies[0], (weights, buffers), (batch.copy(),), {"receivers": counted})
        difference = torch.where(counted.unsqueeze(-1), result[policies[0].out_keys[0]] - expert, 0.0)
        return difference.square().sum() / (counted.sum() * expert.shape[-1])

    with set_recurrent_mode(True):
        losses = vmap(loss_of)(weights, buffers)
    gradients = torch.autograd.grad(losses.sum(), list(weights.values()))
    for name, gradient in zip(weights, gradients, strict=True):
        for policy, part in zip(policies, gradient, strict=True):
            parameter = policy.get_parameter(name)
            parameter.grad = part.clone() if parameter.grad is None else parameter.grad + part
    return list(losses.detach())


def hide_velocities(batch: TensorDictBase, fraction: float, generator: torch.Generator) -> None:
    """Set the velocities of all agents to zero in a random fraction of the windows [S, W], in place.

    A cloned policy can read its next action off its own velocity, which remembers the last one; in closed loop such a
    policy drifts away.

    Args:
        batch: with observations (position, velocity) [S, W, N, 6], and without stored messages.
        fraction: probability that a window is chosen.
        generator: source of randomness.
    """
    observation = batch["agents", "observation"]
    chance = torch.rand(len(batch), generator=generator, device=generator.device).to(observation.device)
    hidden = (chance < fraction)[:, None, None, None] & (torch.arange(6, device=observation.device) >= 3)
    batch["agents", "observation"] = observation.masked_fill(hidden, 0.0)


def _at_last_step(actions: Tensor, receivers: Tensor) -> Tensor:
    """Receivers [S, N] at the last step of the windows of actions [S, W, N, A], as bool [S, W, N]."""
    counted = torch.zeros_like(actions[..., 0], dtype=torch.bool)
    counted[:, -1] = receivers
    return counted


def random_rotations(count: int, like: Tensor, generator: torch.Generator) -> Tensor:
    """Rotation matrices [count, 3, 3], uniform over SO(3), with the dtype and device of ``like``."""
    quaternion = torch.randn(count, 4, generator=generator, device=generator.device, dtype=like.dtype).to(like.device)
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotate(vectors: Tensor, rotations: Tensor) -> Tensor:
    """Rotate data that consist of 3-vectors, [S, ..., 3 n], by one matrix per sample, [S, 3, 3]."""
    flat = vectors.flatten(1, -2).unflatten(-1, (-1, 3)).flatten(1, 2)
    return (flat @ rotations.transpose(-1, -2)).reshape(vectors.shape)
