"""The flock for Gymnasium: ``gymnasium.make("modgnn_rl/Flocking-v0")`` after ``import modgnn_rl.envs``.

One agent in Gymnasium's sense flies a whole flock; ``gymnasium.make_vec`` flies many at once, in one batch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv
from modgnn_rl.envs.flocking.rendering.renderer import RENDER_MODES, Flock, Renderer, check_render_mode, has_display
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["Flocks", "GymnasiumFlocking", "GymnasiumFlocks", "as_array"]

Array = NDArray[Any]
Observation = dict[str, Array]
FRAMES_PER_SECOND = 48
FAR = float(np.finfo(np.float32).max)  # Gymnasium warns of spaces without bounds


class Flocks:
    """What the views of Gymnasium and PettingZoo share: a batch of flocks whose data are numpy arrays of their own."""

    def __init__(self, num_envs: int, num_agents: int, render_mode: str | None, size: tuple[int, int], **settings: Any):
        check_render_mode(render_mode)
        known = [field.name for field in dataclasses.fields(FlockingConfig)]
        for name in settings:
            if name not in known:  # the words that TorchRL's GymEnv looks for, which tries a setting of its own
                raise TypeError(f"got an unexpected keyword argument '{name}'{suggestion(name, known)}")
        self.env = FlockingEnv(num_envs, num_agents, config=FlockingConfig(**settings))
        agents = self.env.num_agents
        speed = self.env.config.max_speed
        seen: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(-FAR, FAR, (agents, 6), np.float32),
            "controlled": spaces.MultiBinary(agents),
        }
        if self.env.has_mask:
            seen["mask"] = spaces.MultiBinary(agents)
        if self.env.config.graph == "links":
            links = self.env.observation_spec["adjacency"].shape[1:]
            seen["adjacency"] = spaces.Box(-1, agents - 1, tuple(links), np.int64)
        else:
            # TorchRL's GymEnv cannot read a MultiBinary of two dimensions.
            seen["adjacency"] = spaces.Box(0, 1, (agents, agents), np.int8)
        self.observation_space: spaces.Space[Any] = spaces.Dict(seen)
        self.action_space = spaces.Box(-speed, speed, (agents, 3), np.float32)
        self.render_mode, self.size = render_mode, size
        self.renderers: dict[int, Renderer] = {}
        self.adjacency = torch.zeros(0)

    def reset(self, seed: int | None, options: dict[str, Any] | None, mask: Array | None = None) -> TensorDictBase:
        """Begin anew, all flocks or those of the mask."""
        if seed is not None:
            self.env.set_seed(seed)
        state = self._given_state(options)
        given = TensorDict({} if state is None else {"agents": {"state": state}}, self.env.batch_size)
        if mask is not None:
            given["_reset"] = torch.as_tensor(mask).unsqueeze(-1)
        return self._remember(self.env.reset(given, set_state=state is not None))

    def step(self, action: Array) -> TensorDictBase:
        """Fly one control period with target velocities [B, N, 3], m/s."""
        agents = TensorDict({"action": torch.as_tensor(np.asarray(action))}, self.env.batch_size)
        return self._remember(self.env.step(TensorDict({"agents": agents}, self.env.batch_size))["next"])

    def _remember(self, data: TensorDictBase) -> TensorDictBase:
        self.adjacency = data["adjacency"]
        return data

    def _given_state(self, options: dict[str, Any] | None) -> torch.Tensor | None:
        for name in options or {}:
            if name != "state":
                raise InputError(f"reset has no option {name!r}{suggestion(name, ['state'])}; it has 'state'")
        state = (options or {}).get("state")
        shape = (*self.env.batch_size, self.env.num_agents, 6)
        if state is None:
            return None
        array = np.asarray(state, np.float64)
        if array.shape not in (shape, shape[1:]):
            raise InputError(f"options['state'] has shape {array.shape}; positions and velocities have {shape[1:]}")
        return torch.as_tensor(np.broadcast_to(array, shape).copy())

    def observe(self, data: TensorDictBase) -> Observation:
        """The observations of all flocks as arrays."""
        found = {name: data["agents", name] for name in ("observation", "controlled")}
        if self.env.has_mask:
            found["mask"] = data["agents", "mask"]
        found["adjacency"] = data["adjacency"]
        return {name: as_array(value) for name, value in found.items()}

    def describe(self, data: TensorDictBase) -> dict[str, Array]:
        """What else there is to know of all flocks: state, target velocities, and rewards of single agents."""
        info = {
            "state": as_array(data[self.env.config.state_key]),
            "target_velocity": as_array(self.env.target_velocity),
        }
        if ("agents", "reward") in data.keys(True):
            info["agent_rewards"] = as_array(data["agents", "reward"].squeeze(-1))
        return info

    def rewards(self, data: TensorDictBase) -> Array:
        """Mean reward of the agents that are flown, of each flock; 0 where nobody is."""
        flown = data["agents", "controlled"]
        total = torch.where(flown, data["agents", "reward"].squeeze(-1), 0.0).sum(-1)
        return as_array((total / flown.sum(-1).clamp(min=1)).double())

    def draw(self, flock: int) -> Array | None:
        """Draw a flock as ``render_mode`` says."""
        if self.render_mode is None:
            raise InputError('there is nothing to render in; make the environment with render_mode="rgb_array"')
        if flock not in self.renderers:
            self.renderers[flock] = Renderer(self.render_mode, *self.size)
        physics, exists = self.env.physics, self.env.exists[flock].cpu()
        position = physics.position[flock].cpu().double()
        drawn = Flock(
            position.masked_fill(~exists.unsqueeze(-1), torch.nan).numpy(),
            as_array(physics.quaternion[flock]),
            as_array(self.env.target_velocity[flock]),
            self._matrix()[flock].cpu().numpy(),
        )
        return self.renderers[flock].draw(drawn)

    def _matrix(self) -> torch.Tensor:
        from modgnn_rl.nn.topology import as_matrix

        return as_matrix(self.adjacency, self.env.num_agents)

    def close(self) -> None:
        """End windows and physics."""
        for renderer in self.renderers.values():
            renderer.close()
        if not self.env.is_closed:
            self.env.close()


class GymnasiumFlocking(gymnasium.Env[Observation, Array]):
    """One flock behind a leader, see `modgnn_rl.envs.FlockingEnv`.

    Observation, a Dict: ``observation`` [N, 6], position, m, and velocity, m/s; ``adjacency`` [N, N], entry i, j says
    that i hears j; ``controlled`` [N], the agents that are flown (all but the leader); ``mask`` [N] where agents may be
    away. Action: target velocities [N, 3], m/s, the leader's being ignored. Reward: mean over the agents flown.
    ``info`` holds ``state`` [N, 6], ``target_velocity`` [N, 3] and ``agent_rewards`` [N].

    ``reset(options={"state": state})`` begins at positions and velocities [N, 6].

    Args:
        num_agents: agents N, the leader included.
        render_mode: ``rgb_array`` for pictures without a display, ``human`` for PyBullet's window.
        width: width of a picture, pixels.
        height: its height.
        settings: fields of `modgnn_rl.configs.schema.FlockingConfig`, ``physics="bullet"`` for one.

    Raises:
        TypeError: on a setting that there is not.
        InputError: on one out of range, a bad state or a bad action.
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
        self._flocks = Flocks(1, num_agents, render_mode, (width, height), **settings)
        self.render_mode = render_mode
        if not has_display():  # what works here; the class says what there is, so that a window is refused by name
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.observation_space = self._flocks.observation_space
        self.action_space = self._flocks.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin a rollout; returns observation and info."""
        super().reset(seed=seed)
        data = self._flocks.reset(seed, options)
        self._show()
        return _first(self._flocks.observe(data)), _first(self._flocks.describe(data))

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly one control period; returns observation, reward, terminated, truncated and info."""
        data = self._flocks.step(np.asarray(action)[None])
        self._show()
        return (
            _first(self._flocks.observe(data)),
            float(self._flocks.rewards(data)[0]),
            bool(data["terminated"]),
            bool(data["truncated"]),
            _first(self._flocks.describe(data)),
        )

    def render(self) -> Array | None:
        """The picture, uint8 [H, W, 3], or None for a window, which is drawn at each step by itself."""
        return self._flocks.draw(0)

    def close(self) -> None:
        """End windows and physics."""
        self._flocks.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()


class GymnasiumFlocks(VectorEnv[Observation, Array, Array]):
    """Many flocks as Gymnasium's vector environment, flown in one batch; see `GymnasiumFlocking`.

    A flock whose rollout is over begins anew in the same step; the end is in ``info["final_obs"]`` and
    ``info["final_info"]`` then. All flocks draw from one seed.

    Args:
        num_envs: flocks B.
        num_agents: agents N in each.
        render_mode: see `GymnasiumFlocking`.
        width: width of a picture, pixels.
        height: its height.
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
        self._flocks = Flocks(num_envs, num_agents, render_mode, (width, height), **settings)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = self._flocks.observation_space
        self.single_action_space = self._flocks.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin all rollouts; several seeds are made one."""
        if seed is not None and not isinstance(seed, int):
            seed = derive_seed(0, *map(str, seed))
        super().reset(seed=seed)
        data = self._flocks.reset(seed, options)
        return self._flocks.observe(data), self._flocks.describe(data)

    def step(self, actions: Array) -> tuple[Observation, Array, Array, Array, dict[str, Any]]:
        """Fly one control period; rollouts that end begin anew."""
        data = self._flocks.step(actions)
        observation, info = self._flocks.observe(data), self._flocks.describe(data)
        rewards, done = self._flocks.rewards(data), as_array(data["done"].squeeze(-1)).astype(bool)
        if done.any():
            final: dict[str, Any] = {
                "final_obs": observation,
                "final_info": info,
                "_final_obs": done,
                "_final_info": done,
            }
            fresh = self._flocks.reset(None, None, done)
            observation = _chosen(done, self._flocks.observe(fresh), observation)
            rewards_of_agents = info["agent_rewards"]
            info = {**_chosen(done, self._flocks.describe(fresh), info), "agent_rewards": rewards_of_agents, **final}
        flags = [as_array(data[name].squeeze(-1)).astype(bool) for name in ("terminated", "truncated")]
        return observation, rewards, flags[0], flags[1], info

    def render(self) -> tuple[Any, ...] | None:
        """A picture of each flock, uint8 [H, W, 3]."""
        return tuple(self._flocks.draw(flock) for flock in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """End windows and physics."""
        self._flocks.close()


def as_array(value: torch.Tensor) -> Array:
    """A copy as an array: float32 for float64 too, int8 for bool."""
    if value.dtype == torch.bool:
        value = value.to(torch.int8)
    return np.array(value.cpu().numpy())


def _first(arrays: dict[str, Array]) -> dict[str, Array]:
    return {name: value[0] for name, value in arrays.items()}


def _chosen(mask: Array, where: dict[str, Array], otherwise: dict[str, Array]) -> dict[str, Array]:
    """Rows of the one where the mask is true, of the other elsewhere."""
    return {
        name: np.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, otherwise[name])
        for name, value in where.items()
    }
