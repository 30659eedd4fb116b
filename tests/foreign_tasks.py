"""Small tasks that the library does not know: other groups, other done flags, other dimensions, discrete actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

from modgnn_rl import OBSERVATION, TASKS, Layout, Task, TaskConfig, setting

__all__ = ["MOVES", "Gather", "GatherConfig", "GatherEnv"]

MOVES = torch.tensor([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])


@dataclass
class GatherConfig(TaskConfig):
    """Robots that gather at one place."""

    name: str = "gather"
    num_agents: Any = setting(4, "robots", ge=1, whole=True)
    max_steps: int = setting(12, "steps", ge=1)
    comm_range: float = setting(1.0, "distance within which robots hear each other (m)", gt=0)
    dims: int = setting(2, "dimension of space", ge=1, le=3)
    actions: str = setting("box", "kind of actions", choices=("box", "categorical", "one_hot"))
    done: str = setting("agents", "where done flags are", choices=("root", "agents"))
    group: str = setting("robots", "name of the group of agents")


class GatherEnv(EnvBase):
    """Robots with observations (position, velocity) [B, N, 2 D] that choose a velocity, or one of five moves."""

    def __init__(self, config: GatherConfig, num_envs: int, num_agents: int, seed: int, device: Any) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.config, self.random = config, torch.Generator().manual_seed(seed)
        shape, batch = (num_envs, num_agents), [num_envs]
        self.position = self.velocity = torch.zeros(*shape, config.dims)
        observed = Composite(observation=Unbounded((*shape, 2 * config.dims)), shape=batch)
        self.observation_spec = Composite({config.group: observed}, shape=batch)
        action: Any = Bounded(-1, 1, (*shape, config.dims))
        if config.actions == "categorical":
            action = Categorical(len(MOVES), shape=shape)
        if config.actions == "one_hot":
            action = OneHot(len(MOVES), shape=(*shape, len(MOVES)))
        self.action_spec = Composite({config.group: Composite(action=action, shape=batch)}, shape=batch)
        reward = Composite(reward=Unbounded((*shape, 1)), shape=batch)
        self.reward_spec = Composite({config.group: reward}, shape=batch)
        flags = {name: Binary(shape=(*self._done_shape, 1), dtype=torch.bool) for name in ("done", "terminated")}
        done: Any = Composite(**flags, shape=batch)
        self.done_spec = done if config.done == "root" else Composite({config.group: done}, shape=batch)

    @property
    def _done_shape(self) -> tuple[int, ...]:
        return tuple(self.position.shape[: 1 if self.config.done == "root" else 2])

    def _set_seed(self, seed: int | None) -> None:
        self.random.manual_seed(seed or 0)

    def _observe(self) -> TensorDict:
        observation = torch.cat((self.position, self.velocity), -1)
        return TensorDict({self.config.group: {"observation": observation}}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        key = "_reset" if self.config.done == "root" else (self.config.group, "_reset")
        mask = None if tensordict is None else tensordict.get(key, None)
        start = 2 * torch.rand(self.position.shape, generator=self.random) - 1
        begins = torch.ones(len(start), dtype=torch.bool) if mask is None else mask.flatten(1).any(-1)
        self.position = torch.where(begins[:, None, None], start, self.position)
        self.velocity = torch.where(begins[:, None, None], 0.0, self.velocity)
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[self.config.group, "action"]
        if self.config.actions != "box":
            action = MOVES[action if self.config.actions == "categorical" else action.long().argmax(-1)]
        self.velocity = action.float()
        self.position = self.position + 0.2 * self.velocity
        spread = (self.position - self.position.mean(1, keepdim=True)).norm(dim=-1, keepdim=True)
        over = (spread.amax(1) < 0.2).view(-1, *[1] * len(self._done_shape)).expand(*self._done_shape, 1)
        flags = {"done": over, "terminated": over.clone()}
        data = self._observe()
        data[self.config.group, "reward"] = -spread
        return data.update(flags if self.config.done == "root" else {self.config.group: flags})


@TASKS.register("gather", settings=GatherConfig)
class Gather(Task):
    """Robots that gather at one place, with an expert that sees all of them."""

    config: GatherConfig

    def __init__(self, config: GatherConfig) -> None:
        super().__init__(config)
        symmetries = ("translation", "rotation", "reflection") if config.dims > 1 else ("translation", "reflection")
        self.layout = Layout(2 * config.dims, dims=config.dims, vectors=2, symmetries=symmetries)

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> EnvBase:
        """See `Task.make_env`."""
        return GatherEnv(self.config, num_envs, num_agents, seed, device)

    def expert(self) -> TensorDictModule:
        """See `Task.expert`."""
        return TensorDictModule(self.rule, [(self.config.group, "observation")], [(self.config.group, "action")])

    def rule(self, observation: Tensor) -> Tensor:
        """Move to the mean position, or along the axis on which it is farther."""
        position = observation[..., : self.config.dims]
        offset = position.mean(-2, keepdim=True) - position
        if self.config.actions == "box":
            return (2 * offset).clamp(-1, 1)
        chosen = (offset @ MOVES.T - 0.1 * MOVES.norm(dim=-1)).argmax(-1)
        return chosen if self.config.actions == "categorical" else torch.nn.functional.one_hot(chosen, len(MOVES))

    def success(self, data: TensorDictBase) -> Tensor:
        """See `Task.success`."""
        return data["terminated"].squeeze(-1)

    def targets(self, data: TensorDictBase) -> Tensor:
        """See `Task.targets`."""
        return data[OBSERVATION][..., : self.config.dims].mean(-2, keepdim=True)
