"""The flocking environment: quadcopters that follow a leader, batched over flocks, for TorchRL."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, MarlGroupMapType

from modgnn_rl.configs.schema import REFERENCE_SIZE, FlockingConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.envs.flocking.perturbations import Perturbations
from modgnn_rl.envs.flocking.leader import make_leader
from modgnn_rl.envs.flocking.nonfinite import complaint, lost_flocks, unusable
from modgnn_rl.envs.flocking.physics.engine import TorchPhysics, make_physics
from modgnn_rl.envs.flocking.radio import hear_all_pairs, hear_near_pairs
from modgnn_rl.envs.flocking.rewards import LIMITS, judge, reward_weights
from modgnn_rl.envs.flocking.snapshots import refuse_foreign
from modgnn_rl.envs.flocking.starts import start_positions
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.utils.compile import compiled
from modgnn_rl.utils.seeds import derive_seed
from modgnn_rl.utils.tensors import clip_to_ball

__all__ = ["FlockingEnv", "checked_config"]

PARTS = ("physics", "leader", "perturbations")  # what has a state of its own
AWAY = 1e4  # m; where agents that do not exist are kept, as far from each other


class FlockingEnv(EnvBase):
    """Flocks of quadcopters behind a leader, as a batch-locked TorchRL environment.

    Agent 0 is the leader: whatever the policy says, it flies as `modgnn_rl.envs.flocking.leader` tells it. Nothing in
    its observation marks it. The others fly at the policy's target velocities, projected onto the ball of
    ``max_speed``.

    Keys, with B flocks and N agents:

    - ``("agents", "observation")`` [B, N, 6]: position, m, and velocity, m/s, in the world frame;
    - ``("agents", "action")`` [B, N, 3]: target velocity, m/s, world frame;
    - ``("agents", "controlled")`` [B, N] bool: the agents that the policy flies; losses and errors count only these;
    - ``("agents", "reward")`` [B, N, 1]: see `modgnn_rl.envs.flocking.rewards`;
    - ``adjacency`` [B, N, N] bool: entry i, j says that i receives from j; zero diagonal. With ``graph="links"``
      a list of links, int64 [B, 2, E]: senders, below them receivers, filled up with -1; E is ``max_links`` N;
    - ``done``, ``terminated``, ``truncated`` [B, 1] bool. A flock is truncated after ``max_steps``. It is terminated
      when it has diverged (an agent is farther than ``max_distance`` from the centre of mass) or has collided beyond
      use (more than the share ``max_colliding`` of its agents are within ``collision_distance`` of another);
    - ``("agents", "state")`` [B, N, 6]: the true position and velocity, where sensors are noisy or late;
    - ``("agents", "mask")`` [B, N] bool: the agents that are there, where agents drop out or flocks differ in size.

    ``reset(tensordict, set_state=True)`` begins the rollouts at the positions and velocities under
    ``("agents", "state")``, or else under ``("agents", "observation")``.

    Args:
        num_envs: number of flocks B.
        num_agents: agents N in each flock; default: the configuration's. With several numbers, flocks take them in
            turns, N is the largest, and the rows that are left over are masked and zero.
        config: all other settings; default: ``FlockingConfig(**settings)``.
        seed: seed of the environment's own generators; equal seeds give equal rollouts, bit for bit.
        device: where the environment lives.
        dtype: floating-point type of the physics and of everything emitted.
        stagger: let each flock's first episode end at a random step, so that a batch of long-lived flocks holds all
            phases of the rollout at once.
        settings: fields of `FlockingConfig`, when no ``config`` is given.

    Attributes:
        physics: the engine.
        target_velocity: what the agents were told last, the leader included, m/s [B, N, 3].
        generator, faults.generator: where starts and leaders come from; where faults come from.

    Raises:
        InputError: on a setting out of range, an action of another shape, or a given state that is not finite.
        NotFinite: on an action or a state that is not finite, with ``on_nonfinite="stop"``. With ``"restart"`` there
            is a RuntimeWarning instead; the step of such a flock ends where it began, and the flock is terminated.
    """

    group_map: dict[str, list[str]]
    _supports_set_state = True

    def __init__(
        self,
        num_envs: int,
        num_agents: int | Sequence[int] | None = None,
        *,
        config: FlockingConfig | None = None,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        stagger: bool = False,
        **settings: Any,
    ) -> None:
        self.config = checked_config(config, settings)
        sizes = as_list(self.config.num_agents if num_agents is None else num_agents)
        for name, counts in (("num_envs", [num_envs]), ("num_agents", sizes)):
            wrong: list[Any] = [count for count in counts if not isinstance(count, int) or count < 1]
            if wrong or not counts:
                raise InputError(f"{name}={wrong[0] if wrong else counts} is not a positive integer")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.dtype = dtype
        self.num_agents = max(sizes)
        self.sizes = torch.tensor([sizes[index % len(sizes)] for index in range(num_envs)], device=self.device)
        self.exists = torch.arange(self.num_agents, device=self.device) < self.sizes.unsqueeze(-1)
        self.is_mixed = not bool(self.exists.all())
        self.physics = make_physics(self.config, num_envs, self.num_agents, self.device, dtype)
        self.leader = make_leader(self.config, num_envs, self.device, dtype)
        self.perturbations = Perturbations(self.config, num_envs, self.num_agents, self.device, dtype)
        self.target_velocity = torch.zeros(num_envs, self.num_agents, 3, device=self.device, dtype=dtype)
        self.step_count = torch.zeros(num_envs, 1, device=self.device, dtype=torch.long)
        self._hear_all_pairs, self._judge = hear_all_pairs, judge
        self._weights = reward_weights(self.config)
        self._limits = {name: float(getattr(self.config, name)) for name in LIMITS}
        self._stagger_next_reset = stagger
        self._make_specs()
        self.group_map = MarlGroupMapType.ALL_IN_ONE_GROUP.get_group_map(
            [f"agent_{index}" for index in range(self.num_agents)]
        )
        self.generator = torch.Generator(device=self.device)
        self._set_seed(self.generator.seed() if seed is None else seed)
        if self.config.compile:
            self.compile()

    @property
    def has_mask(self) -> bool:
        """Whether agents may be absent, so that ``("agents", "mask")`` is emitted."""
        return self.is_mixed or self.config.dropout_rate > 0

    def _make_specs(self) -> None:
        batch, agents = self.batch_size, (*self.batch_size, self.num_agents)
        real = {"device": self.device, "dtype": self.dtype}
        flag = {"device": self.device, "dtype": torch.bool}
        seen: dict[str, Any] = {
            "observation": Unbounded((*agents, 6), **real),
            "controlled": Binary(shape=agents, **flag),
        }
        if self.config.hides_state:
            seen["state"] = Unbounded((*agents, 6), **real)
        if self.has_mask:
            seen["mask"] = Binary(shape=agents, **flag)
        adjacency: Any = Binary(shape=(*agents, self.num_agents), **flag)
        if self.config.graph == "links":
            adjacency = Bounded(-1, self.num_agents - 1, (*batch, 2, self._room), device=self.device, dtype=torch.int64)
        self.observation_spec = Composite(agents=Composite(**seen, shape=batch), adjacency=adjacency, shape=batch)
        speed = self.config.max_speed
        action = Bounded(-speed, speed, (*agents, 3), **real)
        self.full_action_spec = Composite(agents=Composite(action=action, shape=batch), shape=batch)
        reward = Unbounded((*agents, 1), **real)
        self.full_reward_spec = Composite(agents=Composite(reward=reward, shape=batch), shape=batch)
        done = {name: Binary(shape=(*batch, 1), **flag) for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**done, shape=batch)

    @property
    def _nearby(self) -> float:
        """Distance up to which the nearest agent matters, m."""
        return max(self.config.collision_distance, self.config.crowding_distance)

    @property
    def _room(self) -> int:
        return self.num_agents * min(self.config.max_links, max(1, self.num_agents - 1))

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
            self.perturbations.generator.manual_seed(derive_seed(seed, "faults"))

    def _reset(self, tensordict: TensorDictBase | None, *, set_state: bool = False, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = self.done_spec["done"].one() if mask is None else mask
        rows = mask.view(-1).nonzero().view(-1)
        if set_state and tensordict is not None:
            position, velocity = self._given_state(tensordict)[rows].split(3, -1)
        else:
            position = self._start(rows)
            velocity = torch.zeros_like(position)
        self.physics.reset(rows, position, velocity)
        self.leader.reset(mask, self.generator)
        self.target_velocity = self.target_velocity.masked_fill(mask.unsqueeze(-1), 0.0)
        self.step_count = self.step_count.masked_fill(mask, 0)
        if self._stagger_next_reset:
            self._stagger_next_reset = False
            self.step_count = torch.randint(
                self.config.max_steps, self.step_count.shape, generator=self.generator, device=self.device
            )
        position, velocity = self.physics.position, self.physics.velocity
        state = torch.cat((position, velocity), -1)
        self.perturbations.reset(mask, state)
        return self._emit(state, self._hear(position)[0], is_new=False).update(self.full_done_spec.zero())

    def _start(self, rows: Tensor) -> Tensor:
        """Where the agents of the flocks ``rows`` [R] start, m [R, N, 3]."""
        config = self.config
        radius = config.start_radius * (self.sizes[rows] / REFERENCE_SIZE).to(self.dtype) ** (1 / 3)
        position = start_positions(
            config.start,
            len(rows),
            self.num_agents,
            radius if self.is_mixed else config.start_radius * (self.num_agents / REFERENCE_SIZE) ** (1 / 3),
            config.start_distance,
            config.start_clusters,
            generator=self.generator,
            dtype=self.dtype,
            exists=self.exists[rows] if self.is_mixed else None,
        )
        return self._send_away(position, self.exists[rows])

    def _send_away(self, position: Tensor, exists: Tensor) -> Tensor:
        """Positions [R, N, 3] with those of agents that do not exist where they meet nobody."""
        if not self.is_mixed:
            return position
        away = torch.arange(1, self.num_agents + 1, device=self.device, dtype=self.dtype) * AWAY
        return torch.where(exists.unsqueeze(-1), position, away.unsqueeze(-1))

    def _given_state(self, tensordict: TensorDictBase) -> Tensor:
        """The state to begin from, [B, N, 6]."""
        agents = tensordict.get("agents", TensorDict())
        state = agents.get("state", agents.get("observation", None))
        expected = (*self.batch_size, self.num_agents, 6)
        if state is None or tuple(state.shape) != expected:
            found = "nothing" if state is None else f"shape {tuple(state.shape)}"
            raise InputError(
                f"reset(..., set_state=True) needs positions and velocities of shape {expected} under "
                f"('agents', 'state'); there is {found}"
            )
        state = state.to(self.dtype)
        bad = unusable(state, self.exists)
        if bad is not None:
            reason = complaint("state", state, bad, self.step_count)
            raise InputError(f"{reason}; give finite positions, m, and velocities, m/s")
        state = state.masked_fill(~self.exists.unsqueeze(-1), 0.0)
        return torch.cat((self._send_away(state[..., :3], self.exists), state[..., 3:]), -1)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        config = self.config
        push = self.perturbations.step()
        flown = self._controlled()
        before = self.physics.position, self.physics.velocity
        action = self._checked_action(tensordict["agents", "action"])
        lost = lost_flocks("action", action, self.step_count, config.on_nonfinite, flown)
        if lost:
            action = action.index_fill(0, torch.tensor(lost, device=self.device), 0.0)
        target = torch.where(flown.unsqueeze(-1), clip_to_ball(action, config.max_speed), 0.0)
        target[:, 0] = self.leader.step(before[0][:, 0], self.generator)
        self.target_velocity = target
        self.physics.step(target, push)
        position, velocity = self.physics.position, self.physics.velocity
        # Rows that do not exist are looked at too: what is NaN there would reach the distances of the others.
        lost += lost_flocks("state", torch.cat((position, velocity), -1), self.step_count, config.on_nonfinite)
        if lost:
            rows = torch.tensor(sorted(set(lost)), device=self.device)
            self.physics.reset(rows, *(part[rows] for part in before))
            position, velocity = self.physics.position, self.physics.velocity
            target[lost] = 0.0
        self.step_count = self.step_count + 1

        adjacency, nearest = self._hear(position)
        exists = self.exists if self.is_mixed else None
        state, reward, terminated = self._judge(
            position, velocity, target, nearest, self.sizes, exists, self._limits, self._weights
        )
        if lost:
            terminated[lost] = True
        truncated = self.step_count >= config.max_steps
        return self._emit(state, adjacency).update(
            {
                "agents": {"reward": reward},
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def _controlled(self) -> Tensor:
        """The agents that the policy flies now, bool [B, N]."""
        controlled = self.exists & self.perturbations.running
        controlled[:, 0] = False
        return controlled

    def _hear(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """The graph, and the distance of the nearest other agent, m [B, N]."""
        config, perturbations = self.config, self.perturbations
        taking_part = self.exists & perturbations.running if self.has_mask else None
        if config.graph == "links":
            if self.is_mixed:
                position = position.masked_fill(~self.exists.unsqueeze(-1), torch.nan)
            return hear_near_pairs(position, perturbations, taking_part, self._nearby, self._room)
        reach = config.comm_range if perturbations.reach is None else perturbations.reach
        adjacency, nearest = self._hear_all_pairs(position, reach)
        if taking_part is not None:
            adjacency &= taking_part.unsqueeze(-1) & taking_part.unsqueeze(-2)
        arrived = perturbations.arrived(*adjacency.shape)
        return adjacency if arrived is None else adjacency & arrived, nearest

    def _emit(self, state: Tensor, adjacency: Tensor, *, is_new: bool = True) -> TensorDict:
        if self.is_mixed:
            state = state.masked_fill(~self.exists.unsqueeze(-1), 0.0)
        agents = {"observation": self.perturbations.observe(state, is_new=is_new), "controlled": self._controlled()}
        if self.config.hides_state:
            agents["state"] = state
        if self.has_mask:
            agents["mask"] = self.exists & self.perturbations.running
        return TensorDict(
            {"agents": TensorDict(agents, self.batch_size, device=self.device), "adjacency": adjacency},
            self.batch_size,
            device=self.device,
        )

    def _checked_action(self, action: Tensor) -> Tensor:
        expected = (*self.batch_size, self.num_agents, 3)
        if tuple(action.shape) != expected:
            raise InputError(
                f"the action has shape {tuple(action.shape)}; this environment expects {expected}: a target velocity, "
                "m/s, for each agent of each flock"
            )
        return action.to(self.dtype)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of all that the rollouts continue from, but for `generator` and ``perturbations.generator``.

        Returns:
            by name, such as ``"physics.position"`` [B, N, 3] or ``"step_count"`` [B, 1].
        """
        own = {name: getattr(self, name).clone() for name in ("sizes", "step_count", "target_velocity")}
        states = {part: getattr(self, part).snapshot() for part in PARTS}
        return own | {f"{part}.{name}": value for part, state in states.items() for name, value in state.items()}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Go on from a copy of what `snapshot` gave; with the generators and the last tensordict, bit for bit.

        `modgnn_rl.envs.flocking.physics.bullet.BulletPhysics.restore` says where PyBullet is only almost as exact.

        Raises:
            InputError: it is of other flocks, agents or settings.
        """
        refuse_foreign(snapshot, self.snapshot())
        for part in PARTS:
            named = {name.removeprefix(f"{part}."): value for name, value in snapshot.items() if name.startswith(part)}
            getattr(self, part).restore(named)
        for name in ("step_count", "target_velocity"):
            setattr(self, name, snapshot[name].to(self.device, copy=True))
        self._stagger_next_reset = False

    def compile(self, **kwargs: Any) -> FlockingEnv:
        """Compile physics, graph and reward, also when built with ``compile=True``, and return the environment.

        TorchRL's own way of compiling a whole step is slower on a CPU; its arguments have no effect.
        """
        if isinstance(self.physics, TorchPhysics):
            self.physics.compile()
        self._hear_all_pairs, self._judge = compiled(hear_all_pairs), compiled(judge)
        return self

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

    def close(self, **kwargs: Any) -> None:
        """End the physics engine; the environment cannot be used any more."""
        self.physics.close()
        super().close(**kwargs)


def checked_config(config: FlockingConfig | None, settings: dict[str, Any]) -> FlockingConfig:
    """The configuration of an environment, from one of the two."""
    if config is not None and settings:
        raise InputError(f"give either a config or settings, not both: {', '.join(settings)}")
    known = [field.name for field in dataclasses.fields(FlockingConfig)]
    for name in settings:
        if name not in known:
            raise InputError(f"FlockingEnv has no setting {name}{suggestion(name, known)}")
    config = config if config is not None else FlockingConfig(**settings)
    check(config, "env")
    return config
