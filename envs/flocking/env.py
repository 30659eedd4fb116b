"""The flocking environment for TorchRL: batches of flocks of quadcopters that follow a leader.

For example, a rollout of two flocks of eight agents with the expert::

    from modgnn_rl.envs import FlockingEnv
    from modgnn_rl.envs.flocking.expert import Reynolds

    env = FlockingEnv(2, 8, seed=0)
    expert = Reynolds.for_env(env.config, action=("agents", "action"))
    rollout = env.rollout(100, expert)  # a TensorDict of batch size [2, 100]
    rewards = rollout["next", "agents", "reward"]  # [2, 100, 8, 1]
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, MarlGroupMapType

from modgnn_rl.configs.schema import FlockingConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.envs.flocking.initial_states import given_states, initial_positions, move_padding_away
from modgnn_rl.envs.flocking.leader import make_leader
from modgnn_rl.envs.flocking.nonfinite import check_finite
from modgnn_rl.envs.flocking.perturbations import Perturbations
from modgnn_rl.envs.flocking.physics.engine import TorchPhysics, make_physics
from modgnn_rl.envs.flocking.radio import adjacency_matrix, edge_list
from modgnn_rl.envs.flocking.rewards import LIMITS, reward_weights, step_outcome
from modgnn_rl.envs.flocking.snapshots import check_snapshot
from modgnn_rl.envs.flocking.specs import edge_capacity, make_specs
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.utils.compile import compiled
from modgnn_rl.utils.seeds import derive_seed
from modgnn_rl.utils.tensors import clip_to_ball

__all__ = ["FlockingEnv", "checked_config"]

PARTS = ("physics", "leader", "perturbations")  # attributes with a state of their own


class FlockingEnv(EnvBase):
    """Flocks of quadcopters that follow a leader, as a batch-locked TorchRL environment.

    Agent 0 is the leader. It follows the trajectory of `modgnn_rl.envs.flocking.leader` whatever the policy's action,
    and nothing in the observations marks it. The others follow the policy's target velocities, projected onto the ball
    of radius ``max_speed``.

    Keys, for B flocks and N agents:

    - ``("agents", "observation")`` [B, N, 6]: position, m, and velocity, m/s, in the world frame;
    - ``("agents", "action")`` [B, N, 3]: target velocity, m/s, in the world frame;
    - ``("agents", "controlled")`` [B, N] bool: agents that the policy controls; losses and errors are over these;
    - ``("agents", "reward")`` [B, N, 1]: see `modgnn_rl.envs.flocking.rewards`;
    - ``adjacency`` [B, N, N] bool: entry i, j says that i receives from j; zero diagonal. With ``graph="links"``, an
      edge list, int64 [B, 2, E]: senders in the first row, receivers in the second, padded with -1, with
      E = ``max_links`` N;
    - ``done``, ``terminated``, ``truncated`` [B, 1] bool. An episode is truncated after ``max_steps``. It terminates
      when the flock has diverged (an agent is farther than ``max_distance`` from the centre of mass), or when more than
      the fraction ``max_colliding`` of its agents are in collision (within ``collision_distance`` of another);
    - ``("agents", "state")`` [B, N, 6]: true position and velocity, only with sensor noise or delay;
    - ``("agents", "mask")`` [B, N] bool: agents that are present, only with dropout or with flocks of different sizes.

    ``reset(tensordict, set_state=True)`` starts the episodes from the positions and velocities under
    ``("agents", "state")``, or else under ``("agents", "observation")``.

    Args:
        num_envs: number of flocks B.
        num_agents: agents N in each flock, including the leader; default: the configuration's. With several numbers,
            flocks get these sizes in turn, N is the largest, and the remaining rows are masked and zero.
        config: all other settings; default: ``FlockingConfig(**settings)``.
        seed: seed of the environment's generators; equal seeds give equal rollouts, bit for bit.
        device: device of the environment.
        dtype: floating-point type of the physics and of all outputs.
        stagger: whether each flock's first episode ends at a random step, so that a batch of long episodes contains all
            phases of an episode.
        settings: fields of `FlockingConfig`, if no ``config`` is given.

    Attributes:
        physics: the physics engine.
        target_velocity: the target velocities of the last step, including the leader's, m/s [B, N, 3].
        generator: random generator of initial positions and leaders; ``perturbations.generator`` is that of
            perturbations.

    Raises:
        InputError: a setting is out of range, an action has a wrong shape, or a given state is NaN or infinite.
        NotFinite: an action or a state is NaN or infinite, with ``on_nonfinite="stop"``. With ``"restart"`` there is a
            RuntimeWarning instead; the step leaves the state of such a flock unchanged, and its episode terminates.
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
        _check_counts("num_envs", [num_envs])
        _check_counts("num_agents", sizes)
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
        self._adjacency_matrix, self._step_outcome = adjacency_matrix, step_outcome
        self._weights = reward_weights(self.config)
        self._limits = {name: float(getattr(self.config, name)) for name in LIMITS}
        self._stagger_next_reset = stagger
        specs = make_specs(
            self.config, num_envs, self.num_agents, has_mask=self.has_mask, device=self.device, dtype=dtype
        )
        for name, spec in specs.items():
            setattr(self, name, spec)
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

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
            self.perturbations.generator.manual_seed(derive_seed(seed, "faults"))

    def _reset(self, tensordict: TensorDictBase | None, *, set_state: bool = False, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = self.done_spec["done"].one() if mask is None else mask
        rows = mask.view(-1).nonzero().view(-1)
        if set_state and tensordict is not None:
            position, velocity = given_states(tensordict, self.exists, self.dtype)[rows].split(3, -1)
        else:
            position = initial_positions(
                self.config, self.exists[rows], is_mixed=self.is_mixed, generator=self.generator, dtype=self.dtype
            )
            velocity = torch.zeros_like(position)
        self.physics.reset(rows, move_padding_away(position, self.exists[rows]), velocity)
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
        adjacency, _ = self.communication_graph(position)
        return self._emit(state, adjacency, is_new=False).update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        push = self.perturbations.step()
        before = self.physics.position, self.physics.velocity
        target, failed = self._targets(tensordict["agents", "action"], before[0][:, 0])
        self.target_velocity = target
        self.physics.step(target, push)
        position, velocity = self.physics.position, self.physics.velocity
        # Rows that do not exist are checked too: a NaN there would reach the distances of the others.
        state = torch.cat((position, velocity), -1)
        failed += check_finite("state", state, self.step_count, self.config.on_nonfinite)
        if failed:
            rows = torch.tensor(sorted(set(failed)), device=self.device)
            self.physics.reset(rows, *(part[rows] for part in before))
            position, velocity = self.physics.position, self.physics.velocity
            target[failed] = 0.0
        self.step_count = self.step_count + 1

        adjacency, nearest = self.communication_graph(position)
        exists = self.exists if self.is_mixed else None
        state, reward, terminated = self._step_outcome(
            position, velocity, target, nearest, self.sizes, exists, self._limits, self._weights
        )
        if failed:
            terminated[failed] = True
        truncated = self.step_count >= self.config.max_steps
        return self._emit(state, adjacency).update(
            {
                "agents": {"reward": reward},
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def _targets(self, action: Tensor, leader_position: Tensor) -> tuple[Tensor, list[int]]:
        """Target velocities of all agents, m/s [B, N, 3], and the flocks with an action that is NaN or infinite."""
        expected = (*self.batch_size, self.num_agents, 3)
        if tuple(action.shape) != expected:
            raise InputError(
                f"the action has shape {tuple(action.shape)}; this environment expects {expected}: a target velocity "
                "(m/s) for each agent of each flock"
            )
        action, controlled = action.to(self.dtype), self._controlled()
        failed = check_finite("action", action, self.step_count, self.config.on_nonfinite, controlled)
        if failed:
            action = action.index_fill(0, torch.tensor(failed, device=self.device), 0.0)
        target = torch.where(controlled.unsqueeze(-1), clip_to_ball(action, self.config.max_speed), 0.0)
        target[:, 0] = self.leader.step(leader_position, self.generator)
        return target, failed

    def _controlled(self) -> Tensor:
        """The agents that the policy controls at this step, bool [B, N]."""
        controlled = self.exists & self.perturbations.active
        controlled[:, 0] = False
        return controlled

    def communication_graph(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """The graph of a step, with packet loss sampled, and the distance to the nearest other agent.

        Args:
            position: m [B, N, 3].

        Returns:
            what ``adjacency`` holds, see the class; distance, m [B, N].
        """
        config, perturbations = self.config, self.perturbations
        present = self.exists & perturbations.active if self.has_mask else None
        if config.graph == "links":
            if self.is_mixed:
                position = position.masked_fill(~self.exists.unsqueeze(-1), torch.nan)
            nearest_range = max(config.collision_distance, config.crowding_distance)
            return edge_list(position, perturbations, present, nearest_range, edge_capacity(config, self.num_agents))
        send_range = config.comm_range if perturbations.send_range is None else perturbations.send_range
        adjacency, nearest = self._adjacency_matrix(position, send_range)
        if present is not None:
            adjacency &= present.unsqueeze(-1) & present.unsqueeze(-2)
        delivered = perturbations.sample_delivered(*adjacency.shape)
        return adjacency if delivered is None else adjacency & delivered, nearest

    def _emit(self, state: Tensor, adjacency: Tensor, *, is_new: bool = True) -> TensorDict:
        if self.is_mixed:
            state = state.masked_fill(~self.exists.unsqueeze(-1), 0.0)
        agents = {"observation": self.perturbations.observe(state, is_new=is_new), "controlled": self._controlled()}
        if self.config.hides_state:
            agents["state"] = state
        if self.has_mask:
            agents["mask"] = self.exists & self.perturbations.active
        return TensorDict(
            {"agents": TensorDict(agents, self.batch_size, device=self.device), "adjacency": adjacency},
            self.batch_size,
            device=self.device,
        )

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random generators of the environment, by name."""
        return {"env": self.generator, "faults": self.perturbations.generator}

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the complete state, except for `generator` and ``perturbations.generator``.

        Returns:
            tensors by name, such as ``"physics.position"`` [B, N, 3] or ``"step_count"`` [B, 1].
        """
        own = {name: getattr(self, name).clone() for name in ("sizes", "step_count", "target_velocity")}
        states = {part: getattr(self, part).snapshot() for part in PARTS}
        return own | {f"{part}.{name}": value for part, state in states.items() for name, value in state.items()}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Continue from a snapshot; bit for bit, if generators and last tensordict are restored too.

        `modgnn_rl.envs.flocking.physics.bullet.BulletPhysics.restore` names the exception with PyBullet.

        Raises:
            InputError: the snapshot is of other flocks, agents or settings.
        """
        check_snapshot(snapshot, self.snapshot())
        for part in PARTS:
            named = {name.removeprefix(f"{part}."): value for name, value in snapshot.items() if name.startswith(part)}
            getattr(self, part).restore(named)
        for name in ("step_count", "target_velocity"):
            setattr(self, name, snapshot[name].to(self.device, copy=True))
        self._stagger_next_reset = False

    def compile(self, **kwargs: Any) -> FlockingEnv:
        """Compile physics, graph and reward, as ``compile=True`` does, and return the environment.

        TorchRL's way of compiling a whole step is slower on a CPU; its arguments have no effect.
        """
        if isinstance(self.physics, TorchPhysics):
            self.physics.compile()
        self._adjacency_matrix, self._step_outcome = compiled(adjacency_matrix), compiled(step_outcome)
        return self

    def to(self, device: torch.device | str | torch.dtype) -> FlockingEnv:
        """Return the environment itself if it is on ``device`` already; its state cannot be moved.

        Raises:
            InputError: for another device.
        """
        if isinstance(device, torch.dtype):
            raise InputError(
                f"this environment computes in {self.dtype}; create it with dtype={device} for another type"
            )
        wanted = torch.device(device)
        if wanted.type != self.device.type or wanted.index not in (None, self.device.index):
            raise InputError(
                f"this environment is on {self.device} and cannot be moved; create it with device={str(device)!r}"
            )
        return self

    def close(self, **kwargs: Any) -> None:
        """Close the physics engine; the environment can no longer be used."""
        self.physics.close()
        super().close(**kwargs)


def checked_config(config: FlockingConfig | None, settings: dict[str, Any]) -> FlockingConfig:
    """The configuration of an environment, given as a whole or as single settings, with all values checked.

    Raises:
        InputError: both are given, a setting does not exist, or a value is out of range.
    """
    if config is not None and settings:
        raise InputError(f"give either config or settings, not both: {', '.join(settings)}")
    known = [field.name for field in dataclasses.fields(FlockingConfig)]
    for name in settings:
        if name not in known:
            raise InputError(f"FlockingEnv has no setting {name}{suggestion(name, known)}")
    config = config if config is not None else FlockingConfig(**settings)
    check(config, "env")
    return config


def _check_counts(name: str, counts: Sequence[Any]) -> None:
    """Check that there is a number, and that all are positive integers."""
    wrong = [count for count in counts if not isinstance(count, int) or count < 1]
    if wrong or not counts:
        raise InputError(f"{name}={wrong[0] if wrong else counts} is not a positive integer")
