"""The expert that policies learn from, and what it could do with a policy's own eyes.

`reynolds` is the paper's rule as a plain function. `Reynolds` flies it over all agents; `LocalReynolds` restricts it to
what a decentralised policy can see, and is the yardstick for such policies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from modgnn_rl.cache import AgentCache, missing
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.errors import InputError
from modgnn_rl.tensors import clip_to_ball, pair_differences, squared_norm

__all__ = ["LocalReynolds", "Reynolds", "reachable", "reynolds"]

SOFTENING = 1e-6  # m^2 (and m^2/s^2): keeps the rule finite when two agents meet


def reynolds(
    position: Tensor,
    velocity: Tensor,
    *,
    cohesion: float,
    separation: float,
    alignment: float,
    max_speed: float,
    visible: Tensor | None = None,
) -> Tensor:
    """Reynolds flocking (the paper's equation of the expert), clipped to the action ball.

    With ``p = p_j - p_i``, ``v = v_j - v_i`` and ``|x| = sqrt(x . x + 1e-6)``::

        u_i = sum over visible j of  C_c p |p|  -  C_s p / |p|^3  +  C_a v |v|

    Args:
        position: m [..., N, 3].
        velocity: m/s [..., N, 3].
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        visible: entry i, j says that i sees j, bool [..., N, N]; default: everybody sees everybody.

    Returns:
        target velocity, m/s [..., N, 3].
    """
    offset, drift = pair_differences(position), pair_differences(velocity)
    square = squared_norm(offset) + SOFTENING
    distance = square.sqrt()
    pull = cohesion * distance - separation / (square * distance)
    follow = alignment * (squared_norm(drift) + SOFTENING).sqrt()
    force = [torch.addcmul(pull * p, follow, v) for p, v in zip(offset, drift, strict=True)]
    if visible is not None:
        force = [torch.where(visible, component, 0.0) for component in force]
    return clip_to_ball(torch.stack([component.sum(-1) for component in force], -1), max_speed)


def reachable(adjacency: Tensor, hops: int) -> Tensor:
    """Who hears of whom over at most ``hops`` >= 1 links; bool [..., N, N] -> bool [..., N, N], zero diagonal."""
    reached = adjacency
    for _ in range(hops - 1):
        reached = reached | ((adjacency.float() @ reached.float()) > 0)
    return reached & ~torch.eye(adjacency.shape[-1], dtype=torch.bool, device=adjacency.device)


class Reynolds(TensorDictModuleBase):
    """The expert: Reynolds flocking over all agents, as a TensorDictModule.

    Args:
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        observation: key of the observations (position, velocity) [..., N, 6].
        action: key that the expert's action [..., N, 3] is written to.
    """

    def __init__(
        self,
        cohesion: float = 0.06,
        separation: float = 0.8,
        alignment: float = 0.02,
        max_speed: float = 0.92,
        *,
        observation: NestedKey = ("agents", "observation"),
        action: NestedKey = ("agents", "expert_action"),
    ) -> None:
        super().__init__()
        self.rule: dict[str, Any] = {
            "cohesion": cohesion,
            "separation": separation,
            "alignment": alignment,
            "max_speed": max_speed,
        }
        self.in_keys: Sequence[NestedKey] = [observation]
        self.out_keys: Sequence[NestedKey] = [action]

    @classmethod
    def for_env(cls, config: FlockingConfig, **options: Any) -> Self:
        """The expert of a flocking world, with that world's gains."""
        gains = (config.cohesion_gain, config.separation_gain, config.alignment_gain)
        return cls(*gains, config.max_speed, **options)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the expert's action [..., N, 3]."""
        position, velocity = tensordict[self.in_keys[0]].split(3, -1)
        return tensordict.set(self.out_keys[0], reynolds(position, velocity, **self.rule))


class LocalReynolds(Reynolds):
    """Reynolds flocking with the eyes of a decentralised policy.

    At time t an agent sees the agents within ``hops`` links of the graph of t, as they and it were at t - 1; at the
    first step of an episode it has heard of nobody and stays where it is. It keeps the last observation under
    ``cache`` as recurrent state.

    Args:
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        hops: links over which an agent hears of others.
        observation: key of the observations (position, velocity) [..., N, 6].
        adjacency: key of the adjacency [..., N, N].
        is_init: key of the flag that an episode begins [..., 1].
        cache: key of the last observation [..., N, 6].
        action: key that the action [..., N, 3] is written to.

    Raises:
        InputError: on ``hops`` below 1 or fractional.
    """

    def __init__(
        self,
        cohesion: float = 0.06,
        separation: float = 0.8,
        alignment: float = 0.02,
        max_speed: float = 0.92,
        *,
        hops: int = 1,
        observation: NestedKey = ("agents", "observation"),
        adjacency: NestedKey = "adjacency",
        is_init: NestedKey = "is_init",
        cache: str = "last_observation",
        action: NestedKey = ("agents", "expert_action"),
    ) -> None:
        super().__init__(cohesion, separation, alignment, max_speed, observation=observation, action=action)
        if not isinstance(hops, int) or hops < 1:
            raise InputError(f"hops={hops!r} is not a number of links to hear over; expected an integer of at least 1")
        self.hops = hops
        self.cache = cache
        self.in_keys = [observation, adjacency, is_init, cache]
        self.out_keys = [action, ("next", cache)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N, 3] and the observation to remember [..., N, 6]."""
        observation, adjacency, is_init, last = (tensordict.get(key) for key in self.in_keys)
        last = missing(observation) if last is None else last
        if is_init is not None:
            last = torch.where(is_init.unsqueeze(-1), torch.nan, last)
        heard = ~last.isnan().any(-1)
        visible = reachable(adjacency, self.hops) & heard.unsqueeze(-1) & heard.unsqueeze(-2)
        position, velocity = last.split(3, -1)
        action = reynolds(position, velocity, visible=visible, **self.rule)
        return tensordict.set(self.out_keys[0], action).set(self.out_keys[1], observation)

    def make_tensordict_primer(self) -> AgentCache:
        """The transform that gives an environment this module's recurrent state."""
        return AgentCache(self, [self.cache], is_init=self.in_keys[2])
