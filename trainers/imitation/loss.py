"""The imitation loss and what is done to its data: random receivers, random rotations."""

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
        policy: the policy; run over the window.
        batch: windows [S, W] with the policy's in-keys and the expert's action.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].
    """
    expert = batch[expert_action]
    wanted = _at_the_end(expert, receivers)
    with set_recurrent_mode(True):
        action = policy(batch.copy(), receivers=wanted)[policy.out_keys[0]]
    return (action - expert)[wanted].square().mean()


def stacked_losses(
    policies: Sequence[ModGNN], batch: TensorDictBase, receivers: Tensor, *, expert_action: NestedKey = EXPERT_ACTION
) -> list[Tensor]:
    """`imitation_loss` of policies that differ in their weights only, computed at once (``torch.func.vmap``).

    The gradients are added to those that the weights hold.

    Args:
        policies: P of them.
        batch: windows [S, W], see `imitation_loss`.
        receivers: the agents whose error counts, bool [S, N].
        expert_action: key of the expert's action [S, W, N, A].

    Returns:
        the P losses, without gradient.
    """
    expert = batch[expert_action]
    wanted = _at_the_end(expert, receivers)
    weights, buffers = stack_module_state(list(policies))

    def loss_of(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        result = functional_call(policies[0], (weights, buffers), (batch.copy(),), {"receivers": wanted})
        difference = torch.where(wanted.unsqueeze(-1), result[policies[0].out_keys[0]] - expert, 0.0)
        return difference.square().sum() / (wanted.sum() * expert.shape[-1])

    with set_recurrent_mode(True):
        losses = vmap(loss_of)(weights, buffers)
    gradients = torch.autograd.grad(losses.sum(), list(weights.values()))
    for name, gradient in zip(weights, gradients, strict=True):
        for policy, part in zip(policies, gradient, strict=True):
            parameter = policy.get_parameter(name)
            parameter.grad = part.clone() if parameter.grad is None else parameter.grad + part
    return list(losses.detach())


def hide_velocities(batch: TensorDictBase, share: float, generator: torch.Generator) -> None:
    """Zero the velocities of all agents in a random share of the windows [S, W], in place.

    A cloned policy that reads its next action off its own velocity, a memory of the last one, runs away in rollout.

    Args:
        batch: with observations (position, velocity) [S, W, N, 6], and without stored messages.
        share: probability that a window is chosen.
        generator: source of randomness.
    """
    observation = batch["agents", "observation"]
    lot = torch.rand(len(batch), generator=generator, device=generator.device).to(observation.device)
    hidden = (lot < share)[:, None, None, None] & (torch.arange(6, device=observation.device) >= 3)
    batch["agents", "observation"] = observation.masked_fill(hidden, 0.0)


def _at_the_end(actions: Tensor, receivers: Tensor) -> Tensor:
    """The receivers [S, N] at the last step of windows, which actions [S, W, N, A] are of; bool [S, W, N]."""
    wanted = torch.zeros_like(actions[..., 0], dtype=torch.bool)
    wanted[:, -1] = receivers
    return wanted


def random_rotations(count: int, like: Tensor, generator: torch.Generator) -> Tensor:
    """Rotation matrices [count, 3, 3], uniform over SO(3), of the type and device of ``like``."""
    quaternion = torch.randn(count, 4, generator=generator, device=generator.device, dtype=like.dtype).to(like.device)
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotate(vectors: Tensor, rotations: Tensor) -> Tensor:
    """Rotate data made of 3-vectors [S, ..., 3 n] by one matrix a sample [S, 3, 3]."""
    flat = vectors.flatten(1, -2).unflatten(-1, (-1, 3)).flatten(1, 2)
    return (flat @ rotations.transpose(-1, -2)).reshape(vectors.shape)
