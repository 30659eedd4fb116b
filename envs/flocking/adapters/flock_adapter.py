"""What the adapters for Gymnasium and PettingZoo share: a batch of flocks with numpy arrays in and out."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv
from modgnn_rl.envs.flocking.rendering.renderer import Renderer, check_render_mode
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.visualization.recording import Frame, edge_array

__all__ = ["LARGEST", "FlockAdapter", "as_array"]

Array = NDArray[Any]
Observation = dict[str, Array]
LARGEST = float(np.finfo(np.float32).max)  # bound of observations; Gymnasium warns about unbounded spaces


class FlockAdapter:
    """A batch of flocks whose observations, actions and rewards are numpy arrays.

    Args:
        num_envs: flocks B.
        num_agents: agents N in each, including the leader.
        render_mode: ``"rgb_array"``, ``"human"``, or None for no rendering.
        size: width and height of images, pixels.
        settings: fields of `modgnn_rl.configs.schema.FlockingConfig`.

    Attributes:
        env: the environment.
        observation_space: space of one flock's observation.
        action_space: space of one flock's action.

    Raises:
        TypeError: a setting does not exist.
        InputError: a setting is out of range.
    """

    def __init__(self, num_envs: int, num_agents: int, render_mode: str | None, size: tuple[int, int], **settings: Any):
        check_render_mode(render_mode)
        known = [field.name for field in dataclasses.fields(FlockingConfig)]
        for name in settings:
            if name not in known:  # with the words that TorchRL's GymEnv expects when it tries a keyword argument
                raise TypeError(f"got an unexpected keyword argument '{name}'{suggestion(name, known)}")
        self.env = FlockingEnv(num_envs, num_agents, config=FlockingConfig(**settings))
        self.observation_space = self._observation_space()
        speed = self.env.config.max_speed
        self.action_space = spaces.Box(-speed, speed, (self.env.num_agents, 3), np.float32)
        self.render_mode, self.size = render_mode, size
        self.renderers: dict[int, Renderer] = {}
        self._adjacency = torch.zeros(0)

    def _observation_space(self) -> spaces.Space[Any]:
        agents = self.env.num_agents
        observed: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(-LARGEST, LARGEST, (agents, 6), np.float32),
            "controlled": spaces.MultiBinary(agents),
        }
        if self.env.has_mask:
            observed["mask"] = spaces.MultiBinary(agents)
        if self.env.config.graph == "links":
            edges = self.env.observation_spec["adjacency"].shape[1:]
            observed["adjacency"] = spaces.Box(-1, agents - 1, tuple(edges), np.int64)
        else:
            # TorchRL's GymEnv does not support a two-dimensional MultiBinary.
            observed["adjacency"] = spaces.Box(0, 1, (agents, agents), np.int8)
        return spaces.Dict(observed)

    def reset(self, seed: int | None, options: dict[str, Any] | None, mask: Array | None = None) -> TensorDictBase:
        """Start new episodes.

        Args:
            seed: seed of the environment; None: continue its random numbers.
            options: ``{"state": state}`` starts from positions and velocities [N, 6] or [B, N, 6].
            mask: flocks to reset, bool [B]; default: all.
        """
        if seed is not None:
            self.env.set_seed(seed)
        state = self._given_state(options)
        given = TensorDict({} if state is None else {"agents": {"state": state}}, self.env.batch_size)
        if mask is not None:
            given["_reset"] = torch.as_tensor(mask).unsqueeze(-1)
        data = self.env.reset(given, set_state=state is not None)
        self._adjacency = data["adjacency"]
        return data

    def step(self, action: Array) -> TensorDictBase:
        """Advance one control period with target velocities [B, N, 3], m/s."""
        agents = TensorDict({"action": torch.as_tensor(np.asarray(action))}, self.env.batch_size)
        data = self.env.step(TensorDict({"agents": agents}, self.env.batch_size))["next"]
        self._adjacency = data["adjacency"]
        return data

    def _given_state(self, options: dict[str, Any] | None) -> torch.Tensor | None:
        for name in options or {}:
            if name != "state":
                raise InputError(f"reset has no option {name!r}{suggestion(name, ['state'])}; it has 'state'")
        state = (options or {}).get("state")
        if state is None:
            return None
        shape = (*self.env.batch_size, self.env.num_agents, 6)
        array = np.asarray(state, np.float64)
        if array.shape not in (shape, shape[1:]):
            raise InputError(f"options['state'] has shape {array.shape}; positions and velocities have {shape[1:]}")
        return torch.as_tensor(np.broadcast_to(array, shape).copy())

    def observe(self, data: TensorDictBase) -> Observation:
        """The observations of all flocks."""
        found = {name: data["agents", name] for name in ("observation", "controlled")}
        if self.env.has_mask:
            found["mask"] = data["agents", "mask"]
        found["adjacency"] = data["adjacency"]
        return {name: as_array(value) for name, value in found.items()}

    def info(self, data: TensorDictBase) -> dict[str, Array]:
        """State [B, N, 6], target velocities [B, N, 3], and after a step the rewards of single agents [B, N]."""
        info = {
            "state": as_array(data[self.env.config.state_key]),
            "target_velocity": as_array(self.env.target_velocity),
        }
        if ("agents", "reward") in data.keys(True):
            info["agent_rewards"] = as_array(data["agents", "reward"].squeeze(-1))
        return info

    def rewards(self, data: TensorDictBase) -> Array:
        """Mean reward of the controlled agents of each flock [B]; 0 for a flock without any."""
        controlled = data["agents", "controlled"]
        total = torch.where(controlled, data["agents", "reward"].squeeze(-1), 0.0).sum(-1)
        return as_array((total / controlled.sum(-1).clamp(min=1)).double())

    def render(self, flock: int) -> Array | None:
        """Draw a flock: an image, uint8 [H, W, 3], or None where ``render_mode="human"`` draws in a window."""
        if self.render_mode is None:
            raise InputError('nothing can be rendered; create the environment with render_mode="rgb_array"')
        if flock not in self.renderers:
            self.renderers[flock] = Renderer(self.render_mode, *self.size)
        physics, exists = self.env.physics, self.env.exists[flock].cpu()
        frame = Frame(
            position=physics.position[flock].cpu().double().masked_fill(~exists.unsqueeze(-1), torch.nan).numpy(),
            arrow=as_array(self.env.target_velocity[flock]),
            leader=0,
            edges=edge_array(self._adjacency[flock]),
            present=exists.numpy(),
            quaternion=as_array(physics.quaternion[flock]),
        )
        return self.renderers[flock].draw(frame)

    def close(self) -> None:
        """Close windows and physics."""
        for renderer in self.renderers.values():
            renderer.close()
        if not self.env.is_closed:
            self.env.close()


def as_array(value: torch.Tensor) -> Array:
    """A copy as an array; bool becomes int8."""
    if value.dtype == torch.bool:
        value = value.to(torch.int8)
    return np.array(value.cpu().numpy())
