"""A flock for PettingZoo's parallel API, in which each follower is an agent; needs ``modgnn-rl[pettingzoo]``."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase

from modgnn_rl.envs.flocking.adapters.flock_adapter import LARGEST, FlockAdapter, as_array
from modgnn_rl.envs.flocking.adapters.gymnasium_env import GymnasiumFlocking
from modgnn_rl.errors import InputError

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise InputError(
        "the adapter for PettingZoo needs the package pettingzoo: pip install 'modgnn-rl[pettingzoo]'"
    ) from error

__all__ = ["PettingZooFlocking", "parallel_env"]

Array = NDArray[Any]


class PettingZooFlocking(ParallelEnv[str, dict[str, Array], Array]):
    """One flock whose followers are the agents ``agent_1`` to ``agent_<N - 1>``; the leader is part of the environment.

    Each observes a Dict: ``observation`` [6], its own position, m, and velocity, m/s; ``heard`` [N], the agents that it
    receives from at this step, the leader first; ``neighbours`` [N, 6], their observations, zero for all others. Its
    action is a target velocity [3], m/s, and it has its own reward. The episodes of all agents end together.

    What a policy for all agents at once reads, such as `modgnn_rl.ModGNN`, is in the infos of each agent:
    ``observations`` [N, 6] and ``adjacency`` [N, N], the leader first.

    Args:
        num_agents: agents N, including the leader; at least 2.
        render_mode: see `GymnasiumFlocking`.
        width: width of an image, pixels.
        height: height of an image, pixels.
        settings: fields of `modgnn_rl.configs.schema.FlockingConfig`.
    """

    metadata: ClassVar[dict[str, Any]] = {**GymnasiumFlocking.metadata, "name": "modgnn_rl/Flocking-v0"}

    def __init__(
        self,
        num_agents: int = 32,
        render_mode: str | None = None,
        *,
        width: int = 960,
        height: int = 720,
        **settings: Any,
    ) -> None:
        if num_agents < 2:
            raise InputError(
                f"num_agents={num_agents} leaves no agent to control: the leader is not an agent here; give at least 2"
            )
        if settings.get("graph", "matrix") != "matrix":
            raise InputError("this adapter needs graph='matrix'")
        self.flocks = FlockAdapter(1, num_agents, render_mode, (width, height), **settings)
        self.render_mode = render_mode
        self.possible_agents = [f"agent_{index}" for index in range(1, num_agents)]
        self.agents: list[str] = []
        speed = self.flocks.env.config.max_speed
        observed = spaces.Dict(
            {
                "observation": spaces.Box(-LARGEST, LARGEST, (6,), np.float32),
                "heard": spaces.MultiBinary(num_agents),
                "neighbours": spaces.Box(-LARGEST, LARGEST, (num_agents, 6), np.float32),
            }
        )
        self.observation_spaces = dict.fromkeys(self.possible_agents, observed)
        self.action_spaces = {name: spaces.Box(-speed, speed, (3,), np.float32) for name in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Observation space of an agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Action space of an agent."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, dict[str, Array]], dict[str, dict[str, Any]]]:
        """Start an episode; returns observations and infos. Options other than ``state`` are ignored."""
        data = self.flocks.reset(seed, {name: value for name, value in (options or {}).items() if name == "state"})
        self.agents = list(self.possible_agents)
        return self._observe(data), self._infos(data)

    def step(
        self, actions: dict[str, Array]
    ) -> tuple[
        dict[str, dict[str, Array]], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Advance one control period; agents without an action get a target velocity of zero."""
        action = np.zeros((1, len(self.possible_agents) + 1, 3), np.float32)
        for name, velocity in actions.items():
            action[0, self._index(name)] = velocity
        data = self.flocks.step(action)
        rewards = data["agents", "reward"][0, :, 0].tolist()
        agents, observations, infos = self.agents, self._observe(data), self._infos(data)
        if bool(data["done"]):
            self.agents = []
        terminated, truncated = (dict.fromkeys(agents, bool(data[name])) for name in ("terminated", "truncated"))
        return observations, {name: rewards[self._index(name)] for name in agents}, terminated, truncated, infos

    def render(self) -> Array | None:
        """An image, uint8 [H, W, 3]; None for a window."""
        return self.flocks.render(0)

    def close(self) -> None:
        """Close window and physics."""
        self.flocks.close()

    def _index(self, name: str) -> int:
        return self.possible_agents.index(name) + 1

    def _infos(self, data: TensorDictBase) -> dict[str, dict[str, Any]]:
        """Observations and graph of the whole flock, for each agent."""
        whole = {"observations": data["agents", "observation"][0], "adjacency": data["adjacency"][0]}
        return {name: {key: as_array(value) for key, value in whole.items()} for name in self.agents}

    def _observe(self, data: TensorDictBase) -> dict[str, dict[str, Array]]:
        observation, adjacency = as_array(data["agents", "observation"][0]), as_array(data["adjacency"][0])
        neighbours = observation * adjacency[..., None].astype(np.float32)
        return {
            name: {"observation": observation[index], "heard": adjacency[index], "neighbours": neighbours[index]}
            for name, index in ((name, self._index(name)) for name in self.agents)
        }


parallel_env = PettingZooFlocking
