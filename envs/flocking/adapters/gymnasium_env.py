"""Flocks for Gymnasium: ``gymnasium.make("modgnn_rl/Flocking-v0")`` after ``import modgnn_rl.envs``.

One agent in Gymnasium's sense controls a whole flock; ``gymnasium.make_vec`` steps many flocks in one batch. For
example::

    import gymnasium
    import modgnn_rl.envs

    env = gymnasium.make("modgnn_rl/Flocking-v0", num_agents=8)
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from modgnn_rl.envs.flocking.adapters.flock_adapter import FlockAdapter, Observation, as_array
from modgnn_rl.envs.flocking.rendering.renderer import RENDER_MODES, has_display
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["GymnasiumFlocking", "GymnasiumVectorFlocking"]

Array = NDArray[Any]
FRAMES_PER_SECOND = 48


class GymnasiumFlocking(gymnasium.Env[Observation, Array]):
    """One flock that follows a leader, see `modgnn_rl.envs.FlockingEnv`.

    Observation, a Dict: ``observation`` [N, 6], position, m, and velocity, m/s; ``adjacency`` [N, N], entry i, j says
    that i receives from j; ``controlled`` [N], the agents that the action controls (all but the leader); ``mask`` [N],
    the agents that are present, only with dropout. Action: target velocities [N, 3], m/s; the leader's is ignored.
    Reward: mean over the controlled agents. ``info`` holds ``state`` [N, 6], ``target_velocity`` [N, 3] and
    ``agent_rewards`` [N].

    ``reset(options={"state": state})`` starts from positions and velocities [N, 6].

    Args:
        num_agents: agents N, including the leader.
        render_mode: ``rgb_array`` for images without a display, ``human`` for PyBullet's window.
        width: width of an image, pixels.
        height: height of an image, pixels.
        settings: fields of `modgnn_rl.configs.schema.FlockingConfig`, such as ``physics="bullet"``.

    Raises:
        TypeError: a setting does not exist.
        InputError: a setting is out of range, or a state or an action is invalid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        num_agents: int = 32,
        render_mode: str | None = None,
        *,
        width: int = 960,
        height: int = 720,
        **settings: Any,
    ) -> None:
        self.flocks = FlockAdapter(1, num_agents, render_mode, (width, height), **settings)
        self.render_mode = render_mode
        if not has_display():  # the instance lists what works here; the class lists all, for clear errors
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.observation_space = self.flocks.observation_space
        self.action_space = self.flocks.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; returns observation and info."""
        super().reset(seed=seed)
        data = self.flocks.reset(seed, options)
        self._show()
        return _first(self.flocks.observe(data)), _first(self.flocks.info(data))

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one control period; returns observation, reward, terminated, truncated and info."""
        data = self.flocks.step(np.asarray(action)[None])
        self._show()
        return (
            _first(self.flocks.observe(data)),
            float(self.flocks.rewards(data)[0]),
            bool(data["terminated"]),
            bool(data["truncated"]),
            _first(self.flocks.info(data)),
        )

    def render(self) -> Array | None:
        """An image, uint8 [H, W, 3], or None for a window, which each step redraws."""
        return self.flocks.render(0)

    def close(self) -> None:
        """Close window and physics."""
        self.flocks.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()


class GymnasiumVectorFlocking(VectorEnv[Observation, Array, Array]):
    """Many flocks as Gymnasium's vector environment, stepped in one batch; see `GymnasiumFlocking`.

    A flock whose episode ends is reset in the same step; its last observation and info are then in
    ``info["final_obs"]`` and ``info["final_info"]``. All flocks share one random generator.

    Args:
        num_envs: flocks B.
        num_agents: agents N in each.
        render_mode: see `GymnasiumFlocking`.
        width: width of an image, pixels.
        height: height of an image, pixels.
        settings: fields of `modgnn_rl.configs.schema.FlockingConfig`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as above
        **GymnasiumFlocking.metadata,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        num_agents: int = 32,
        render_mode: str | None = None,
        *,
        width: int = 960,
        height: int = 720,
        **settings: Any,
    ) -> None:
        self.flocks = FlockAdapter(num_envs, num_agents, render_mode, (width, height), **settings)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = self.flocks.observation_space
        self.single_action_space = self.flocks.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes; several seeds are combined into one."""
        if seed is not None and not isinstance(seed, int):
            seed = derive_seed(0, *map(str, seed))
        super().reset(seed=seed)
        data = self.flocks.reset(seed, options)
        return self.flocks.observe(data), self.flocks.info(data)

    def step(self, actions: Array) -> tuple[Observation, Array, Array, Array, dict[str, Any]]:
        """Advance one control period, and reset flocks whose episode ends."""
        data = self.flocks.step(actions)
        observation, info = self.flocks.observe(data), self.flocks.info(data)
        rewards = self.flocks.rewards(data)
        terminated, truncated, done = (
            as_array(data[name].squeeze(-1)).astype(bool) for name in ("terminated", "truncated", "done")
        )
        if done.any():
            final: dict[str, Any] = {
                "final_obs": observation,
                "final_info": info,
                "_final_obs": done,
                "_final_info": done,
            }
            after_reset = self.flocks.reset(None, None, done)
            observation = _where(done, self.flocks.observe(after_reset), observation)
            agent_rewards = info["agent_rewards"]
            info = {**_where(done, self.flocks.info(after_reset), info), "agent_rewards": agent_rewards, **final}
        return observation, rewards, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """An image of each flock, uint8 [H, W, 3]."""
        return tuple(self.flocks.render(flock) for flock in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close windows and physics."""
        self.flocks.close()


def _first(arrays: dict[str, Array]) -> dict[str, Array]:
    return {name: value[0] for name, value in arrays.items()}


def _where(mask: Array, chosen: dict[str, Array], otherwise: dict[str, Array]) -> dict[str, Array]:
    """Rows of ``chosen`` where the mask is true, of ``otherwise`` elsewhere."""
    return {
        name: np.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, otherwise[name])
        for name, value in chosen.items()
    }
