"""The flocking task, as `modgnn_rl.task` describes tasks: quadcopters that follow a leader."""

from __future__ import annotations

import dataclasses
import functools

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from modgnn_rl.actions import Ball
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.envs.flocking.features import FEATURES, flock_features
from modgnn_rl.envs.flocking.recording import flock_frame
from modgnn_rl.envs.flocking.rewards import flocking_costs
from modgnn_rl.layout import STATE
from modgnn_rl.registry import TASKS
from modgnn_rl.task import ACTION, CriticInput, Task
from modgnn_rl.utils.tensors import pair_distances
from modgnn_rl.visualization.recording import Frame

__all__ = ["FlockingTask"]


@TASKS.register("flocking", settings=FlockingConfig, units={"error": "m²/s²"})
class FlockingTask(Task):
    """Flocks of quadcopters that follow a leader, with Reynolds flocking as the expert."""

    config: FlockingConfig
    default_model = "moment_force"
    group_name = "agents"
    bootstraps_at_termination = True
    min_agents = 2  # the leader is not trained
    leader = 0
    arrow_name = "target velocity"
    yardstick = "local expert (1 hop)"
    layout = STATE

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> FlockingEnv:
        """See `Task.make_env`."""
        return FlockingEnv(num_envs, num_agents, config=self.config, seed=seed, device=device)

    def training_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> FlockingEnv:
        """See `Task.training_env`."""
        return FlockingEnv(num_envs, num_agents, config=self.config, seed=seed, device=device, stagger=True)

    def evaluation_env(
        self, num_envs: int, num_agents: int, seed: int, device: torch.device | str, *, steps: int
    ) -> FlockingEnv:
        """An environment in which no episode ends early, not even that of a flock that has diverged."""
        config = dataclasses.replace(self.config, max_distance=torch.inf, max_colliding=1.0, max_steps=steps)
        return FlockingEnv(num_envs, num_agents, config=config, seed=seed, device=device)

    def expert(self) -> TensorDictModuleBase:
        """Reynolds flocking with global information."""
        return Reynolds.for_env(self.config)

    def references(self) -> dict[str, TensorDictModuleBase]:
        """The local experts of 2 hops and of 1 hop, which see what a policy sees."""
        return {
            f"local expert ({hops} hop{'s' * (hops > 1)})": LocalReynolds.for_env(self.config, hops=hops, action=ACTION)
            for hops in (2, 1)
        }

    @functools.cached_property
    def actions(self) -> Ball:
        """Target velocities within the ball of ``max_speed``, m/s."""
        return Ball(self.config.max_speed, 3)

    @property
    def frequency(self) -> float:  # type: ignore[override]
        """Control frequency, Hz."""
        return self.config.control_frequency

    @property
    def max_arrow(self) -> float:  # type: ignore[override]
        """Largest target velocity, m/s."""
        return self.config.max_speed

    def positions(self, data: TensorDictBase) -> Tensor:
        """True positions, m [*B, N, 3]."""
        return data[self.config.state_key][..., :3]

    def stored(self, data: TensorDictBase) -> Tensor:
        """Position, m, and velocity, m/s: graphs and the expert's actions follow from them."""
        return data["agents", "observation"]

    def restored(self, stored: Tensor) -> TensorDict:
        """See `Task.restored`."""
        controlled = torch.ones(stored.shape[:-1], dtype=torch.bool, device=stored.device)
        controlled[..., 0] = False
        agents = TensorDict({"observation": stored, "controlled": controlled}, stored.shape[:-2])
        adjacency = pair_distances(stored[..., :3]) <= self.config.comm_range
        labelled: TensorDict = self._labels(TensorDict({"agents": agents, "adjacency": adjacency}, stored.shape[:-2]))
        return labelled

    @functools.cached_property
    def _labels(self) -> Reynolds:
        return Reynolds.for_env(dataclasses.replace(self.config, compile=False))

    def stored_width(self, num_agents: int) -> int:
        """See `Task.stored_width`."""
        return 6

    def training_metrics(self, rollouts: TensorDictBase) -> dict[str, Tensor]:
        """The costs that the reward is made of, unweighted means over the agents that the policy controls."""
        position, velocity = rollouts["next", *self.config.state_key].split(3, -1)
        costs = flocking_costs(
            position,
            velocity,
            rollouts[ACTION],
            pair_distances(position.flatten(0, 1)).amin(-1).view(position.shape[:-1]),
            crowding_distance=self.config.crowding_distance,
            collision_distance=self.config.collision_distance,
            exists=rollouts.get(("agents", "mask"), None),
        )
        counted = rollouts["agents", "controlled"]
        return {f"cost/{name}": cost[counted].mean() for name, cost in costs.items()}

    def critic_input(self) -> CriticInput:
        """Features of the true states that do not depend on the flock's position, attitude and order."""
        key = self.config.state_key
        return CriticInput([key], lambda data: flock_features(data[key], data.get(("agents", "mask"), None)), FEATURES)

    def frame(self, data: TensorDictBase) -> Frame:
        """See `Task.frame`."""
        return flock_frame(data, self.config)
