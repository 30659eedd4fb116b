"""The central critic: estimates the value of each agent from all agents, of any size and in any order."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from modgnn_rl.models.blocks import mlp
from modgnn_rl.task import CriticInput

__all__ = ["CentralCritic", "PooledCritic"]


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


class CentralCritic(TensorDictModuleBase):
    """`PooledCritic` over what a task shows the critic, as a TensorDictModule.

    Args:
        given: keys and features, see `modgnn_rl.task.CriticInput`.
        mask: key of the agents that exist, bool [*B, N]; optional in the data.
        value: key that the values [*B, N, 1] are written to.
        hidden: width of the networks.
    """

    def __init__(
        self,
        given: CriticInput,
        mask: NestedKey = ("agents", "mask"),
        value: NestedKey = ("agents", "state_value"),
        hidden: int = 64,
    ) -> None:
        super().__init__()
        self.network = PooledCritic(given.width, hidden)
        self.features, self.mask_key = given.features, mask
        self.in_keys: list[NestedKey] = [*given.keys, mask]  # TorchRL's estimators show it nothing else
        self.out_keys: list[NestedKey] = [value]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the values."""
        values = self.network(self.features(tensordict), tensordict.get(self.mask_key, None))
        return tensordict.set(self.out_keys[0], values)
