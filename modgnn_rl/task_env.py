"""The environment of a task under the keys that the library uses, whatever the task calls them.

The environment that `modgnn_rl.task.Task.make_env` returns may have its group of agents, done flags and rewards where
TorchRL allows; `TaskEnv` wraps it, adds what is missing, and says in one sentence what does not fit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, OneHot, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from modgnn_rl.actions import ActionSpace, Box, Discrete
from modgnn_rl.errors import InputError, one_line
from modgnn_rl.nn.keys import dotted
from modgnn_rl.utils.tensors import pair_distances

if TYPE_CHECKING:
    from modgnn_rl.task import Task

__all__ = ["ACTION", "EXPERT_ACTION", "OBSERVATION", "REWARD", "Probe", "TaskEnv", "group_of", "probe"]

OBSERVATION, ACTION, EXPERT_ACTION = ("agents", "observation"), ("agents", "action"), ("agents", "expert_action")
CONTROLLED, REWARD = ("agents", "controlled"), ("agents", "reward")


def group_of(task: Task, env: EnvBase) -> str | None:
    """The group of agents of an environment; None if its entries are at the root.

    Raises:
        InputError: there are several, and the task names none.
    """
    nested = {key[0] for key in map(unravel_key, env.action_keys) if isinstance(key, tuple)}
    if len(nested) > 1 or (task.group is not None and nested != {task.group}):
        raise InputError(
            f"task '{task.name}': the environment has the groups {', '.join(sorted(nested)) or 'none'}, and one policy "
            "acts for one group; put all agents into one group, as in TorchRL's MarlGroupMapType.ALL_IN_ONE_GROUP"
        )
    return next(iter(nested), None)


class Probe(NamedTuple):
    """What the specs of an environment say.

    Attributes:
        group: name of the group of agents; None: the entries are at the root.
        width: numbers in an agent's observation.
        actions: what an agent can do.
    """

    group: str | None
    width: int
    actions: ActionSpace


def probe(task: Task, env: EnvBase) -> Probe:
    """Read the specs of a task's environment.

    Raises:
        InputError: the specs are not of agents that all act alike, or actions are of a kind that is not supported.
    """
    group = group_of(task, env)
    spec, key = env.full_observation_spec, _in_group(group, "observation")
    if key not in spec.keys(True, True):
        raise InputError(
            f"task '{task.name}': the environment has no '{dotted(key)}', only {_listed(spec)}; rename the observation"
        )
    shape = spec[key].shape
    if len(shape) != 3:
        raise InputError(
            f"task '{task.name}': '{dotted(key)}' has shape {tuple(shape)}; expected [environments, agents, features]"
        )
    (action_key,) = env.action_keys
    action = env.full_action_spec_unbatched[action_key]
    if isinstance(action, OneHot):
        return Probe(group, shape[-1], Discrete(action.shape[-1]))
    if isinstance(action, Categorical):
        return Probe(group, shape[-1], Discrete(int(action.space.n)))
    if isinstance(action, (Bounded, Unbounded)) and action.dtype.is_floating_point and action.ndim == 2:
        if isinstance(action, Unbounded):
            infinite = torch.full(action.shape[-1:], torch.inf)
            return Probe(group, shape[-1], Box(-infinite, infinite))
        return Probe(group, shape[-1], Box(action.space.low[0].float().cpu(), action.space.high[0].float().cpu()))
    raise InputError(
        f"task '{task.name}': actions of the kind {type(action).__name__} with shape {tuple(action.shape)} are not "
        "supported; expected a box [agents, A], OneHot or Categorical"
    )


class TaskEnv(EnvBase):
    """A task's environment with the library's keys, for B environments and N agents.

    - ``("agents", "observation")`` [B, N, F], and all else that the environment observes of its group;
    - ``("agents", "action")`` [B, N, A]: see `modgnn_rl.actions`;
    - ``("agents", "controlled")`` [B, N] bool: agents that the policy controls, by default all;
    - ``("agents", "reward")`` [B, N, 1];
    - ``adjacency``: the environment's, or bool [B, N, N] of agents within range of each other;
    - ``done``, ``terminated``, ``truncated`` [B, 1] bool: an episode ends when it does for all agents, and is truncated
      after ``config.max_steps``.

    Args:
        task: makes the environment.
        num_envs: B.
        num_agents: N.
        seed: of the environment.
        device: of the environment.
        max_steps: default: the task's setting.
        stagger: whether each environment's first episode ends at a random step.

    Raises:
        InputError: the environment does not fit; the message names task, key and shapes.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        num_agents: int,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        max_steps: int | None = None,
        stagger: bool = False,
    ) -> None:
        try:
            base = task.make_env(num_envs, num_agents, seed, torch.device(device))
        except InputError:
            raise
        except Exception as error:
            raise InputError(
                f"task '{task.name}' cannot make {num_envs} environments of {num_agents} agents: {one_line(error)}"
            ) from error
        if tuple(base.batch_size) != (num_envs,):
            raise InputError(
                f"task '{task.name}': make_env(num_envs={num_envs}, ...) returned an environment with batch size "
                f"{tuple(base.batch_size)}; expected ({num_envs},)"
            )
        super().__init__(device=torch.device(device), batch_size=base.batch_size)
        self.base, self.task = base, task
        self.num_agents = num_agents
        self.max_steps = task.config.max_steps if max_steps is None else max_steps
        self.generator = torch.Generator().manual_seed(seed)
        self.step_count = torch.zeros(num_envs, 1, dtype=torch.long, device=self.device)
        self._stagger_next_reset = stagger
        self._state: TensorDictBase | None = None  # what the environment's next step reads
        self._group = group_of(task, base)
        self._group_keys = list(base.full_observation_spec.keys(True, True))
        self._make_specs()

    def _make_specs(self) -> None:
        observed = self.base.full_observation_spec.clone()
        name = "observation" if self._group is None else self._group
        given = {name: observed[name]} if self._group is None else dict(observed[name].items())
        agents = Composite(given, shape=self.batch_size)
        del observed[name]
        actions = probe(self.task, self.base).actions
        shape = (*self.batch_size, self.num_agents)
        found = tuple(agents["observation"].shape)
        if found[:2] != shape:
            raise InputError(
                f"task '{self.task.name}': the observations have shape {found}; expected {shape} and the features"
            )
        if actions.width != self.task.actions.width:
            raise InputError(
                f"task '{self.task.name}': actions have width {self.task.actions.width}, but those of the environment "
                f"{actions.width}"
            )
        flag: dict[str, Any] = {"device": self.device, "dtype": torch.bool}
        if "controlled" not in agents:
            agents["controlled"] = Binary(shape=shape, **flag)
        observed["agents"] = agents
        if "adjacency" not in observed:
            observed["adjacency"] = Binary(shape=(*shape, self.num_agents), **flag)
        self.observation_spec = observed.to(self.device)
        dtype = agents["observation"].dtype
        action = Unbounded((*shape, self.task.actions.width), device=self.device, dtype=dtype)
        reward = Unbounded((*shape, 1), device=self.device, dtype=torch.float32)
        batch = self.batch_size
        self.full_action_spec = Composite(agents=Composite(action=action, shape=batch), shape=batch)
        self.full_reward_spec = Composite(agents=Composite(reward=reward, shape=batch), shape=batch)
        done = {name: Binary(shape=(*batch, 1), **flag) for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**done, shape=batch)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
            self.base.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or bool(mask.all()) or self._state is None:
            mask = torch.ones(*self.batch_size, 1, dtype=torch.bool, device=self.device)
            self._state = self._call("reset", self.base.reset)
        else:
            request = self._state.copy()
            for key in self.base.reset_keys:
                done = self.base.full_done_spec[_done_key(key)]
                request[key] = mask.view(-1, *[1] * (done.ndim - 1)).expand(done.shape)
            self._state = self._call("reset", self.base.reset, request).exclude(*self.base.reset_keys)
        self.step_count = self.step_count.masked_fill(mask, 0)
        if self._stagger_next_reset:
            self._stagger_next_reset = False
            first = torch.randint(self.max_steps, self.step_count.shape, generator=self.generator)
            self.step_count = first.to(self.device)
        return self._emit(self._state).update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self._state is not None
        (key,) = self.base.action_keys
        self._state[key] = self._base_action(tensordict[ACTION])
        result = self._call("step", self.base.step, self._state)["next"]
        self._state = self.base.step_mdp(self._state)
        self.step_count = self.step_count + 1
        reward = self._per_agent(result[self.base.reward_keys[0]])
        terminated = self._of_all_agents(result, "terminated", "done")
        truncated = self._of_all_agents(result, "truncated") | (self.step_count >= self.max_steps)
        return self._emit(result).update(
            {
                "agents": {"reward": reward},
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def _call(self, what: str, function: Any, *arguments: Any) -> TensorDictBase:
        """Call the environment; an exception becomes one sentence."""
        try:
            return function(*arguments)
        except InputError:
            raise
        except Exception as error:
            raise InputError(
                f"task '{self.task.name}': the {what} of its environment failed at step {int(self.step_count.max())} "
                f"of an episode ({type(error).__name__}: {one_line(error)})"
            ) from error

    def _base_action(self, action: Tensor) -> Tensor:
        """The action as the environment expects it."""
        (key,) = self.base.action_keys
        spec = self.base.full_action_spec[key]
        expected = (*self.batch_size, self.num_agents, self.task.actions.width)
        if tuple(action.shape) != expected:
            raise InputError(
                f"task '{self.task.name}': the action has shape {tuple(action.shape)}; expected {expected}"
            )
        if isinstance(self.task.actions, Discrete):
            chosen = action.argmax(-1)
            if isinstance(spec, OneHot):
                return torch.nn.functional.one_hot(chosen, action.shape[-1]).to(spec.dtype)
            return chosen.view(spec.shape).to(spec.dtype)
        action = action.to(spec.dtype)
        return action.clamp(spec.space.low, spec.space.high) if isinstance(spec, Bounded) else action

    def _per_agent(self, reward: Tensor) -> Tensor:
        """Rewards of the agents [B, N, 1]; one for all is given to each."""
        if reward.ndim == 2 and reward.shape[-1] == self.num_agents:
            reward = reward.unsqueeze(-1)
        elif reward.ndim < 3:
            reward = reward.view(-1, 1, 1)
        return reward.expand(*self.batch_size, self.num_agents, 1).to(torch.float32)

    def _of_all_agents(self, result: TensorDictBase, *names: str) -> Tensor:
        """A flag [B, 1] of the environment, or of all its agents; the first name that it has, else false."""
        for name in names:
            for key in (name, *((group, name) for group in [self._group] if group is not None)):
                flag = result.get(key, None)
                if flag is not None:
                    return flag.flatten(1).all(-1, keepdim=True)
        return torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)

    def _emit(self, data: TensorDictBase) -> TensorDict:
        """What the environment observes, under the library's keys."""
        observed = data.select(*self._group_keys).copy()
        found = TensorDict({}, self.batch_size, device=self.device)
        agents = observed.pop(self._group) if self._group is not None else observed.select("observation")
        agents = TensorDict(dict(agents.items()), self.batch_size, device=self.device)
        for key, value in observed.items():
            if self._group is not None or key != "observation":
                found[key] = value
        if "controlled" not in agents:
            mask = agents.get("mask", None)
            shape = (*self.batch_size, self.num_agents)
            agents["controlled"] = torch.ones(shape, dtype=torch.bool, device=self.device) if mask is None else mask
        found["agents"] = agents
        expected = self.observation_spec[OBSERVATION]
        value = agents["observation"]
        if value.shape != expected.shape or value.dtype != expected.dtype:
            raise InputError(
                f"task '{self.task.name}': '{dotted(_in_group(self._group, 'observation'))}' has shape "
                f"{tuple(value.shape)} and dtype {value.dtype}, but the environment's spec says "
                f"{tuple(expected.shape)} and {expected.dtype}"
            )
        if "adjacency" not in found:
            found["adjacency"] = self._graph(found)
        return found

    def _graph(self, data: TensorDictBase) -> Tensor:
        """Agents within range of each other, bool [B, N, N]."""
        position = self.task.positions(data)
        if position is None:
            raise InputError(
                f"task '{self.task.name}': the environment emits no 'adjacency' and the task no positions, of which a "
                "graph could be made; add one of them"
            )
        return pair_distances(position) <= self.task.comm_range

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random generators of the environment, by name; those that it does not name are not stored."""
        return {"env": self.generator, **getattr(self.base, "generators", {})}

    @property
    def has_snapshots(self) -> bool:
        """Whether the environment has ``snapshot`` and ``restore``."""
        return hasattr(self.base, "snapshot") and hasattr(self.base, "restore")

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state, except for generators, as tensors by name."""
        assert self._state is not None
        state = self._state.flatten_keys("/").clone()
        own = {f"state/{key}": value for key, value in state.items()}
        return {"step_count": self.step_count.clone(), **own, **self.base.snapshot()}

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Return to what `snapshot` returned."""
        state = {key.removeprefix("state/"): value for key, value in snapshot.items() if key.startswith("state/")}
        flat = TensorDict(state, self.batch_size, device=self.device)
        self._state = flat.unflatten_keys("/")
        self.step_count = snapshot["step_count"].to(self.device, copy=True)
        rest = {key: value for key, value in snapshot.items() if key != "step_count" and not key.startswith("state/")}
        self.base.restore(rest)
        self._stagger_next_reset = False

    def close(self, **kwargs: Any) -> None:
        """Close the environment."""
        if not self.base.is_closed:
            self.base.close()
        super().close(**kwargs)


def _in_group(group: str | None, name: str) -> NestedKey:
    return name if group is None else (group, name)


def _done_key(reset_key: NestedKey) -> NestedKey:
    return "done" if isinstance(reset_key, str) else (*reset_key[:-1], "done")


def _listed(spec: Composite | Iterable[TensorSpec]) -> str:
    keys = spec.keys(True, True) if isinstance(spec, Composite) else spec
    return ", ".join(dotted(key) for key in keys)
