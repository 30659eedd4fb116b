"""The flock for PettingZoo's parallel API: each follower is an agent. Needs the extra ``pettingzoo``."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase

from modgnn_rl.envs.flocking.adapters.gymnasium_env import FAR, Flocks, GymnasiumFlocking, as_array
from modgnn_rl.errors import InputError

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise InputError(
        "the view for PettingZoo needs the package pettingzoo: pip install 'modgnn-rl[pettingzoo]'"
    ) from error

__all__ = ["PettingZooFlocking", "parallel_env"]

Array = NDArray[Any]


class PettingZooFlocking(ParallelEnv[str, dict[str, Array], Array]):
    """One flock, whose followers are the agents ``agent_1`` to ``agent_<N - 1>``; the leader is part of the world.

    Each observes a Dict: ``observation`` [6], its own position, m, and velocity, m/s; ``heard`` [N], whom it hears now,
    the leader first; ``neighbours`` [N, 6], their observations, zero where it hears nothing. It acts by a target
    velocity [3], m/s, and gets its own reward. All rollouts end together.

    Args:
        num_agents: agents N, the leader included; at least 2.
        render_mode: see `GymnasiumFlocking`.
        width: width of a picture, pixels.
        height: its height.
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
            raise InputError(f"num_agents={num_agents} leaves nobody to fly: the leader is not an agent here")
        if settings.get("graph", "matrix") != "matrix":
            raise InputError("this view tells each agent whom it hears; use graph='matrix'")
        self._flocks = Flocks(1, num_agents, render_mode, (width, height), **settings)
        self.render_mode = render_mode
        self.possible_agents = [f"agent_{index}" for index in range(1, num_agents)]
        self.agents: list[str] = []
        speed = self._flocks.env.config.max_speed
        seen = spaces.Dict(
            {
                "observation": spaces.Box(-FAR, FAR, (6,), np.float32),
                "heard": spaces.MultiBinary(num_agents),
                "neighbours": spaces.Box(-FAR, FAR, (num_agents, 6), np.float32),
            }
        )
        self.observation_spaces = dict.fromkeys(self.possible_agents, seen)
        self.action_spaces = {name: spaces.Box(-speed, speed, (3,), np.float32) for name in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """What an agent observes."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """How an agent acts."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, dict[str, Array]], dict[str, dict[str, Any]]]:
        """Begin a rollout; returns observations and infos. Of the options only ``state`` is read, as is usual there."""
        data = self._flocks.reset(seed, {name: value for name, value in (options or {}).items() if name == "state"})
        self.agents = list(self.possible_agents)
        return self._observe(data), {name: {} for name in self.agents}

    def step(
        self, actions: dict[str, Array]
    ) -> tuple[
        dict[str, dict[str, Array]], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Fly one control period; agents without an action stay where they are."""
        action = np.zeros((1, len(self.possible_agents) + 1, 3), np.float32)
        for name, velocity in actions.items():
            action[0, self._place(name)] = velocity
        data = self._flocks.step(action)
        rewards = data["agents", "reward"][0, :, 0].tolist()
        flying, observations = self.agents, self._observe(data)
        if bool(data["done"]):
            self.agents = []
        terminated, truncated = (dict.fromkeys(flying, bool(data[name])) for name in ("terminated", "truncated"))
        infos: dict[str, dict[str, Any]] = {name: {} for name in flying}
        return observations, {name: rewards[self._place(name)] for name in flying}, terminated, truncated, infos

    def render(self) -> Array | None:
        """The picture, uint8 [H, W, 3]; None for a window."""
        return self._flocks.draw(0)

    def close(self) -> None:
        """End windows and physics."""
        self._flocks.close()

    def _place(self, name: str) -> int:
        return self.possible_agents.index(name) + 1

    def _observe(self, data: TensorDictBase) -> dict[str, dict[str, Array]]:
        observation, adjacency = as_array(data["agents", "observation"][0]), as_array(data["adjacency"][0])
        neighbours = observation * adjacency[..., None].astype(np.float32)
        return {
            name: {"observation": observation[place], "heard": adjacency[place], "neighbours": neighbours[place]}
            for name, place in ((name, self._place(name)) for name in self.agents)
        }


parallel_env = PettingZooFlocking
