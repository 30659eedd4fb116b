"""The central critic: estimates the value of each agent from the whole flock, of any size and in any order."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from modgnn_rl.models.blocks import mlp
from modgnn_rl.utils.tensors import pair_distances

__all__ = ["FlockCritic", "PooledCritic", "flock_features"]

NEAR = 0.4  # m; length scale of the crowding feature


class PooledCritic(nn.Module):
    """A value for each agent from the features of all: ``V_i = rho(x_i, mean_j phi(x_j), max_j phi(x_j))``.

    This is Deep Sets (Zaheer et al. 2017): permuting the agents permutes the values, and any number of agents will do.

    Args:
        features: width of x.
        hidden: width of phi and rho.
    """

    def __init__(self, features: int, hidden: int = 64) -> None:
        super().__init__()
        self.phi = mlp(features, hidden, hidden)
        self.rho = mlp(features + 2 * hidden, hidden, 1)

    def forward(self, features: Tensor, mask: Tensor | None = None) -> Tensor:
        """Estimate the value of each agent.

        Args:
            features: [*B, N, F].
            mask: agents that exist, bool [*B, N]; the others are not pooled. Default: all.

        Returns:
            values [*B, N, 1].
        """
        encoded = self.phi(features)
        if mask is None:
            pooled = torch.cat((encoded.mean(-2, keepdim=True), encoded.amax(-2, keepdim=True)), -1)
        else:
            exists = mask.unsqueeze(-1)
            mean = torch.where(exists, encoded, 0.0).sum(-2, keepdim=True) / exists.sum(-2, keepdim=True).clamp(min=1)
            lowest = torch.finfo(encoded.dtype).min
            largest = torch.where(exists, encoded, lowest).amax(-2, keepdim=True)
            pooled = torch.cat((mean, torch.where(mask.any(-1)[..., None, None], largest, 0.0)), -1)
        return self.rho(torch.cat((features, pooled.expand(*features.shape[:-1], -1)), -1))


def flock_features(state: Tensor, mask: Tensor | None = None) -> Tensor:
    """Features of each agent that do not depend on the flock's position, attitude and order, of magnitude one.

    Distance (scaled, and its logarithm), closing speed and velocity difference, each with respect to the leader
    (agent 0) and to the flock's mean, and of the leader with respect to that mean; distance of the nearest agent;
    crowding ``sum_j exp(-d_ij / 0.4 m)``; speed.

    Args:
        state: position (m) and velocity (m/s) [*B, N, 6].
        mask: agents that exist, bool [*B, N]. Default: all.

    Returns:
        features [*B, N, 15].
    """
    position, velocity = state.split(3, -1)
    there = None if mask is None else mask.unsqueeze(-1)
    count = state.shape[-2] if there is None else there.sum(-2, keepdim=True).clamp(min=1)
    shown = state if there is None else torch.where(there, state, 0.0)
    mean = shown.sum(-2, keepdim=True) / count
    centre, drift = mean.split(3, -1)
    leader, led = position[..., :1, :], velocity[..., :1, :]
    columns = []
    for offset, relative in (
        (leader - position, led - velocity),
        (centre - position, drift - velocity),
        ((centre - leader).expand_as(position), (drift - led).expand_as(velocity)),
    ):
        distance = _norm(offset)
        closing = (offset * relative).sum(-1, keepdim=True) / distance
        columns += [distance / 3, (distance + 0.1).log(), closing, _norm(relative)]
    distance = pair_distances(position)
    if mask is not None:
        distance = distance.masked_fill(~(mask.unsqueeze(-2) & mask.unsqueeze(-1)), torch.inf)
    nearest = distance.amin(-1, keepdim=True).clamp(max=1.0)
    crowd = torch.exp(-distance / NEAR).sum(-1, keepdim=True)
    return torch.cat([*columns, nearest, crowd, _norm(velocity)], -1)


class FlockCritic(TensorDictModuleBase):
    """`PooledCritic` over `flock_features`, as a TensorDictModule.

    Args:
        state: key of the true states [*B, N, 6].
        mask: key of the agents that exist, bool [*B, N]; optional in the data.
        value: key that the values [*B, N, 1] are written to.
        hidden: width of the networks.
    """

    def __init__(
        self,
        state: NestedKey = ("agents", "observation"),
        mask: NestedKey = ("agents", "mask"),
        value: NestedKey = ("agents", "state_value"),
        hidden: int = 64,
    ) -> None:
        super().__init__()
        self.network = PooledCritic(15, hidden)
        self.state_key, self.mask_key = state, mask
        self.in_keys: list[NestedKey] = [state, mask]  # TorchRL's estimators show it nothing else
        self.out_keys: list[NestedKey] = [value]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the values."""
        mask = tensordict.get(self.mask_key, None)
        features = flock_features(tensordict[self.state_key], mask)
        return tensordict.set(self.out_keys[0], self.network(features, mask))


def _norm(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1, keepdim=True) + 1e-8).sqrt()
