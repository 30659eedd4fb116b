"""The imitation loss and what is done to its data: random receivers, random rotations."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from modgnn_rl.modgnn import ModGNN

__all__ = ["imitation_loss", "random_receivers", "random_rotations", "rotate"]


def imitation_loss(policy: ModGNN, batch: TensorDictBase, receivers: Tensor) -> Tensor:
    """Mean squared error per component between the policy's and the expert's actions at the end of each window.

    Only the receivers' actions at the last step are computed.

    Args:
        policy: the policy; run over the window.
        batch: windows [S, W] with the policy's in-keys and ``("agents", "expert_action")`` [S, W, N, 3].
        receivers: the agents whose error counts, bool [S, N].
    """
    wanted = torch.zeros_like(batch["agents", "controlled"])
    wanted[:, -1] = receivers
    with set_recurrent_mode(True):
        action = policy(batch.copy(), receivers=wanted)["agents", "action"]
    return (action - batch["agents", "expert_action"])[wanted].square().mean()


def random_receivers(controlled: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Choose ``count`` of the controlled agents of each flock, or all where there are fewer; bool [S, N] -> [S, N]."""
    lot = torch.rand(controlled.shape, generator=generator, device=generator.device).to(controlled.device)
    lot = lot.masked_fill(~controlled, 2.0)
    chosen = torch.zeros_like(controlled)
    chosen.scatter_(-1, lot.topk(min(count, controlled.shape[-1]), largest=False).indices, True)
    return chosen & controlled


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
