"""The flocking environment: quadcopters that follow a leader, batched over flocks, for TorchRL."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, MarlGroupMapType

from modgnn_rl.configs.schema import REFERENCE_SIZE, FlockingConfig
from modgnn_rl.envs.physics import Physics, TorchPhysics
from modgnn_rl.envs.rewards import flocking_reward
from modgnn_rl.envs.starts import uniform_ball
from modgnn_rl.errors import InputError
from modgnn_rl.metrics import is_diverged
from modgnn_rl.settings import check, suggestion
from modgnn_rl.tensors import clip_to_ball, pair_distances

__all__ = ["FlockingEnv", "make_physics"]


class FlockingEnv(EnvBase):
    """Flocks of quadcopters behind a leader, as a batch-locked TorchRL environment.

    Agent 0 is the leader: whatever the policy says, its target velocity is integrated Gaussian noise. Nothing in its
    observation marks it. The others fly at the policy's target velocities, projected onto the ball of ``max_speed``.

    Keys, with B flocks and N agents:

    - ``("agents", "observation")`` [B, N, 6]: position, m, and velocity, m/s, in the world frame;
    - ``("agents", "action")`` [B, N, 3]: target velocity, m/s, world frame;
    - ``("agents", "controlled")`` [B, N] bool: the agents that the policy flies; losses and errors count only these;
    - ``("agents", "reward")`` [B, N, 1]: see `modgnn_rl.envs.rewards`;
    - ``adjacency`` [B, N, N] bool: entry i, j says that i receives from j; zero diagonal;
    - ``done``, ``terminated``, ``truncated`` [B, 1] bool. A flock is truncated after ``max_steps``. It is terminated
      when it has diverged (an agent is farther than ``max_distance`` from the centre of mass) or has collided beyond
      use (more than the share ``max_colliding`` of its agents are within ``collision_distance`` of another).

    Args:
        num_envs: number of flocks B.
        num_agents: agents N in each flock; default: the configuration's.
        config: all other settings; default: ``FlockingConfig(**settings)``.
        seed: seed of the environment's own generator; equal seeds give equal flights, bit for bit.
        device: where the environment lives.
        dtype: floating-point type of the physics and of everything emitted.
        stagger: let each flock's first episode end at a random step, so that a batch of long-lived flocks holds all
            phases of the flight at once.
        settings: fields of `FlockingConfig`, when no ``config`` is given.

    Raises:
        InputError: on a setting out of range, or an action that is not finite.
    """

    group_map: dict[str, list[str]]

    def __init__(
        self,
        num_envs: int,
        num_agents: int | None = None,
        *,
        config: FlockingConfig | None = None,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        stagger: bool = False,
        **settings: Any,
    ) -> None:
        if config is not None and settings:
            raise InputError(f"give either a config or settings, not both: {', '.join(settings)}")
        known = [field.name for field in dataclasses.fields(FlockingConfig)]
        for name in settings:
            if name not in known:
                raise InputError(f"FlockingEnv has no setting {name}{suggestion(name, known)}")
        self.config = config if config is not None else FlockingConfig(**settings)
        self.num_agents = self.config.num_agents if num_agents is None else num_agents
        check(self.config, "env")
        for name, count in (("num_envs", num_envs), ("num_agents", self.num_agents)):
            if not isinstance(count, int) or count < 1:
                raise InputError(
                    f"{name}={count!r} is not a positive integer; one environment holds flocks of one size"
                )
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.dtype = dtype
        self.physics = make_physics(self.config, num_envs, self.num_agents, self.device, dtype)
        self.leader_velocity = torch.zeros(num_envs, 3, device=self.device, dtype=dtype)
        self.step_count = torch.zeros(num_envs, 1, device=self.device, dtype=torch.long)
        self.controlled = torch.ones(num_envs, self.num_agents, device=self.device, dtype=torch.bool)
        self.controlled[:, 0] = False
        self._stagger_next_reset = stagger
        self._make_specs()
        self.group_map = MarlGroupMapType.ALL_IN_ONE_GROUP.get_group_map(
            [f"agent_{index}" for index in range(self.num_agents)]
        )
        self.generator = torch.Generator(device=self.device)
        self.generator.manual_seed(self.generator.seed() if seed is None else seed)

    def _make_specs(self) -> None:
        batch, agents = self.batch_size, (*self.batch_size, self.num_agents)
        real = {"device": self.device, "dtype": self.dtype}
        flag = {"device": self.device, "dtype": torch.bool}
        group = Composite(
            observation=Unbounded((*agents, 6), **real),
            controlled=Binary(shape=agents, **flag),
            shape=batch,
        )
        self.observation_spec = Composite(
            agents=group, adjacency=Binary(shape=(*agents, self.num_agents), **flag), shape=batch
        )
        speed = self.config.max_speed
        action = Bounded(-speed, speed, (*agents, 3), **real)
        self.full_action_spec = Composite(agents=Composite(action=action, shape=batch), shape=batch)
        reward = Unbounded((*agents, 1), **real)
        self.full_reward_spec = Composite(agents=Composite(reward=reward, shape=batch), shape=batch)
        done = {name: Binary(shape=(*batch, 1), **flag) for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**done, shape=batch)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = self.done_spec["done"].one() if mask is None else mask
        rows = mask.view(-1).nonzero().view(-1)
        config, size = self.config, self.num_agents
        radius = config.start_radius * (size / REFERENCE_SIZE) ** (1 / 3)
        start = uniform_ball(len(rows), size, radius, config.start_distance, generator=self.generator, dtype=self.dtype)
        self.physics.reset(rows, start, torch.zeros_like(start))
        self.leader_velocity = self.leader_velocity.masked_fill(mask, 0.0)
        self.step_count = self.step_count.masked_fill(mask, 0)
        if self._stagger_next_reset:
            self._stagger_next_reset = False
            self.step_count = torch.randint(
                config.max_steps, self.step_count.shape, generator=self.generator, device=self.device
            )
        position, velocity = self.physics.position, self.physics.velocity
        return self._emit(position, velocity, pair_distances(position)).update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        config = self.config
        action = tensordict["agents", "action"]
        self._refuse_nonfinite(action)
        step = config.leader_noise * config.control_frequency**-0.5
        noise = torch.randn(self.leader_velocity.shape, generator=self.generator, device=self.device, dtype=self.dtype)
        self.leader_velocity = clip_to_ball(self.leader_velocity + step * noise, config.leader_max_speed)
        target = torch.where(
            self.controlled.unsqueeze(-1),
            clip_to_ball(action.to(self.dtype), config.max_speed),
            self.leader_velocity.unsqueeze(-2),
        )
        self.physics.step(target)
        self.step_count = self.step_count + 1

        position, velocity = self.physics.position, self.physics.velocity
        distances = pair_distances(position)
        touching = distances < config.collision_distance
        colliding = touching.any(-1).to(self.dtype).mean(-1) > config.max_colliding
        terminated = (is_diverged(position, config.max_distance) | colliding).unsqueeze(-1)
        truncated = self.step_count >= config.max_steps
        reward = flocking_reward(position, velocity, touching)
        return self._emit(position, velocity, distances).update(
            {
                "agents": {"reward": reward},
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def _emit(self, position: Tensor, velocity: Tensor, distances: Tensor) -> TensorDict:
        agents = TensorDict(
            {"observation": torch.cat((position, velocity), -1), "controlled": self.controlled.clone()},
            self.batch_size,
            device=self.device,
        )
        return TensorDict(
            {"agents": agents, "adjacency": distances <= self.config.comm_range}, self.batch_size, device=self.device
        )

    def _refuse_nonfinite(self, action: Tensor) -> None:
        bad = ~action.isfinite().all(-1) & self.controlled
        if bad.any():
            flock, agent = bad.nonzero()[0].tolist()
            step = int(self.step_count[flock])
            raise InputError(
                f"the action of agent {agent} in flock {flock} at step {step} is not finite "
                f"({action[flock, agent].tolist()}); a policy must give three finite numbers, m/s"
            )

    def to(self, device: torch.device | str) -> FlockingEnv:
        """Return the environment itself when it lives on ``device`` already; the state does not move.

        Raises:
            InputError: for another device; build the environment there.
        """
        wanted = torch.device(device)
        if wanted.type != self.device.type or wanted.index not in (None, self.device.index):
            raise InputError(
                f"this environment lives on {self.device} and does not move; build it with device={str(device)!r}"
            )
        return self


def make_physics(
    config: FlockingConfig, num_envs: int, num_agents: int, device: torch.device, dtype: torch.dtype
) -> Physics:
    """Build the engine that ``config.physics`` names for B flocks of N agents."""
    return TorchPhysics(
        num_envs,
        num_agents,
        control_frequency=config.control_frequency,
        substeps=config.physics_substeps,
        velocity_gain=config.velocity_gain,
        device=device,
        dtype=dtype,
    )
