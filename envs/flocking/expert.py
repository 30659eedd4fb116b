"""The expert that policies learn from, Reynolds flocking, with global and with local information.

`reynolds` is the paper's rule as a plain function. `Reynolds` applies it to all agents. `LocalReynolds` restricts it to
the information of a decentralised policy, and is the reference for such policies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.errors import InputError
from modgnn_rl.nn.graph import Graph
from modgnn_rl.nn.primer import RecurrentStatePrimer, missing
from modgnn_rl.nn.topology import Topology, as_matrix, reachable
from modgnn_rl.utils.compile import compiled
from modgnn_rl.utils.tensors import clip_to_ball, is_transformed, pair_blocks, pair_differences, squared_norm

__all__ = ["LocalReynolds", "Reynolds", "reynolds"]

SOFTENING = 1e-6  # m^2 (and m^2/s^2): keeps the rule finite when two agents coincide


def reynolds(
    position: Tensor,
    velocity: Tensor,
    *,
    cohesion: float,
    separation: float,
    alignment: float,
    max_speed: float,
    visible: Tensor | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Reynolds flocking (the paper's equation of the expert), clipped to the action ball.

    With ``p = p_j - p_i``, ``v = v_j - v_i`` and ``|x| = sqrt(x . x + 1e-6)``::

        u_i = sum over visible j of  C_c p |p|  -  C_s p / |p|^3  +  C_a v |v|

    Pairs are processed in blocks that fit the cache, except in transformed code, where shapes must not depend on data.

    Args:
        position: m [..., N, 3].
        velocity: m/s [..., N, 3].
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        visible: which agents each agent sees: bool [..., N, N], whose entry i, j says that i sees j; or edges, int64
            [..., 2, E], with the agents seen in the first row and those that see them in the second, padded with -1.
            Default: all see all.
        mask: agents that are present, bool [..., N]; the others neither see nor are seen. Default: all. Values of
            agents that are not seen may be NaN.

    Returns:
        target velocity, m/s [..., N, 3].

    Raises:
        InputError: an edge has an agent that does not exist.
    """
    gains = (cohesion, separation, alignment)
    *batch, agents, _ = position.shape
    state = [value.reshape(-1, agents, 3) for value in (position, velocity)]
    mask = None if mask is None else mask.expand(*batch, agents).reshape(-1, agents)
    if visible is not None and visible.dtype == torch.int64:
        force = _forces_over_edges(state, Topology(visible, agents, mask=mask, form="edges").all_edges(), gains)
    else:
        seen = None if visible is None else visible.expand(*batch, agents, agents).reshape(-1, agents, agents)
        force = _forces_of_pairs(state, seen, mask, gains)
    return clip_to_ball(force.view(position.shape), max_speed)


def _forces_of_pairs(
    state: list[Tensor], visible: Tensor | None, mask: Tensor | None, gains: tuple[float, float, float]
) -> Tensor:
    """The rule summed over all pairs, or the visible ones, bool [B, N, N], of agents in the mask; [B * N, 3]."""
    everything = slice(0, state[0].shape[0]), slice(0, state[0].shape[1])
    parts = []
    for some, receivers in [everything] if is_transformed() else pair_blocks(state[0]):
        seen = None if visible is None else visible[some, receivers]
        if mask is not None:
            present = mask[some].unsqueeze(-2) & mask[some, receivers].unsqueeze(-1)
            seen = present if seen is None else seen & present
        offset, drift = (pair_differences(value[some], receivers) for value in state)
        force = _pair_forces(offset, drift, gains)
        if seen is not None:
            force = [torch.where(seen, component, 0.0) for component in force]
        parts.append(torch.stack([component.sum(-1) for component in force], -1).flatten(0, 1))
    return torch.cat(parts)


def _forces_over_edges(state: list[Tensor], edges: Graph, gains: tuple[float, float, float]) -> Tensor:
    """The rule summed over edges; [B * N, 3]."""
    nodes = [value.flatten(0, 1) for value in state]
    offset, drift = (edges.gather_senders(node) - edges.gather_receivers(node) for node in nodes)
    force = _pair_forces(offset.t().contiguous().unbind(), drift.t().contiguous().unbind(), gains)
    return edges.scatter_sum(torch.stack(force, -1))


def _pair_forces(offset: Sequence[Tensor], drift: Sequence[Tensor], gains: tuple[float, float, float]) -> list[Tensor]:
    """The terms of the sum by component, from the components of differences of positions and of velocities."""
    cohesion, separation, alignment = gains
    square = squared_norm(offset) + SOFTENING
    distance = square.sqrt()
    pull = cohesion * distance - separation / (square * distance)
    follow = alignment * (squared_norm(drift) + SOFTENING).sqrt()
    return [torch.addcmul(pull * p, follow, v) for p, v in zip(offset, drift, strict=True)]


class Reynolds(TensorDictModuleBase):
    """The expert: Reynolds flocking over all agents, as a TensorDictModule.

    Args:
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        observation: key of the states (position, velocity) [..., N, 6].
        mask: key of the agents that are present, bool [..., N], if there is one; the others are not seen.
        action: key of the expert's action [..., N, 3].
        compile: whether to compile the rule.
    """

    def __init__(
        self,
        cohesion: float = 0.06,
        separation: float = 0.8,
        alignment: float = 0.02,
        max_speed: float = 0.92,
        *,
        observation: NestedKey = ("agents", "observation"),
        mask: NestedKey = ("agents", "mask"),
        action: NestedKey = ("agents", "expert_action"),
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.gains: dict[str, float] = {
            "cohesion": cohesion,
            "separation": separation,
            "alignment": alignment,
            "max_speed": max_speed,
        }
        self._rule: Callable[..., Tensor] = compiled(reynolds, compile)
        self.in_keys: Sequence[NestedKey] = [observation, mask]
        self.out_keys: Sequence[NestedKey] = [action]

    @classmethod
    def for_env(cls, config: FlockingConfig, **options: Any) -> Self:
        """Create the expert with the gains of an environment; it reads the true states."""
        return cls(**{**_gains_of(config), "observation": config.state_key, **options})

    def rule(
        self, position: Tensor, velocity: Tensor, visible: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Target velocities, m/s [..., N, 3], see `reynolds`."""
        # The number of edges in a list depends on data, which a compiler cannot handle.
        rule = self._rule if visible is None or visible.dtype == torch.bool else reynolds
        return rule(position, velocity, visible=visible, mask=mask, **self.gains)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the expert's action [..., N, 3]."""
        state, mask = tensordict[self.in_keys[0]], tensordict.get(self.in_keys[1], None)
        return tensordict.set(self.out_keys[0], self.rule(state[..., :3], state[..., 3:], mask=mask))


class LocalReynolds(Reynolds):
    """Reynolds flocking with the information of a decentralised policy.

    At time t an agent knows the agents within ``hops`` edges in the graph of time t, with all observations, including
    its own, from t - 1. At the first step of an episode, or after a dropout, it knows no agent, and its target velocity
    is zero. The last observation is kept under ``cache`` as recurrent state.

    Args:
        cohesion: weight C_c.
        separation: weight C_s.
        alignment: weight C_a.
        max_speed: radius of the action ball, m/s.
        hops: number of edges over which information travels.
        observation: key of the observations (position, velocity) [..., N, 6].
        adjacency: key of the adjacency [..., N, N], or of edge lists, int64 [..., 2, E].
        is_init: key of the flag that an episode starts [..., 1].
        mask: key of the agents that are present, bool [..., N], if there is one.
        cache: key of the last observation [..., N, 6].
        action: key of the action [..., N, 3].
        compile: whether to compile the rule.

    Raises:
        InputError: ``hops`` is not a positive integer.
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
        mask: NestedKey = ("agents", "mask"),
        cache: str = "last_observation",
        action: NestedKey = ("agents", "expert_action"),
        compile: bool = False,
    ) -> None:
        super().__init__(
            cohesion, separation, alignment, max_speed, observation=observation, action=action, compile=compile
        )
        if not isinstance(hops, int) or hops < 1:
            raise InputError(f"hops={hops!r} is not a positive integer")
        self.hops = hops
        self.cache = cache
        self.in_keys = [observation, adjacency, is_init, cache, mask]
        self.out_keys = [action, ("next", cache)]

    @classmethod
    def for_env(cls, config: FlockingConfig, **options: Any) -> Self:
        """Create the local expert with the gains of an environment; it reads what a policy observes."""
        return cls(**{**_gains_of(config), **options})

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N, 3] and the observation for the next step [..., N, 6]."""
        observation, adjacency = (tensordict[key] for key in self.in_keys[:2])
        is_init, last, mask = (tensordict.get(key, None) for key in self.in_keys[2:])
        last = missing(observation) if last is None else last
        if is_init is not None:
            last = torch.where(is_init.unsqueeze(-1), torch.nan, last)
        known = ~last.isnan().any(-1)
        if mask is not None:
            known = known & mask
            observation = torch.where(mask.unsqueeze(-1), observation, torch.nan)
        visible = adjacency
        if adjacency.dtype != torch.int64 or self.hops > 1:
            visible = reachable(as_matrix(adjacency, observation.shape[-2]), self.hops)
        action = self.rule(last[..., :3], last[..., 3:], visible, known)
        return tensordict.set(self.out_keys[0], action).set(self.out_keys[1], observation)

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        """The transform that adds this module's recurrent state to an environment."""
        return RecurrentStatePrimer(self, [self.cache], is_init=self.in_keys[2])


def _gains_of(config: FlockingConfig) -> dict[str, Any]:
    return {
        "cohesion": config.cohesion_gain,
        "separation": config.separation_gain,
        "alignment": config.alignment_gain,
        "max_speed": config.max_speed,
        "compile": config.compile,
    }
