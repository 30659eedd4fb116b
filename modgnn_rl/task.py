"""A task: all that trainers, evaluation, replays and reports need to know of a swarm, in one class.

To bring a task of your own, derive a class from `Task` in a file of yours and say how its environment is made. What
else you define, the library uses: an expert makes ``trainer=bc`` and ``trainer=dagger`` possible, positions give
replays, symmetries give augmentation::

    @dataclass
    class RendezvousConfig(TaskConfig):
        comm_range: float = setting(1.0, "distance within which robots hear each other (m)", gt=0)


    @TASKS.register("rendezvous", settings=RendezvousConfig)
    class Rendezvous(Task):
        \"\"\"Robots that gather at one place.\"\"\"

        def make_env(self, num_envs, num_agents, seed, device):
            return RendezvousEnv(num_envs, num_agents, seed=seed, device=device)

        def expert(self):
            return TensorDictModule(to_the_mean, [OBSERVATION], [EXPERT_ACTION])

        def positions(self, data):
            return data[OBSERVATION][..., :2]

Then ``python -m modgnn_rl.train env=my_module:Rendezvous`` trains, evaluates and records it, with its settings under
``env.``. In all methods below, ``data`` is a TensorDict with the keys of `modgnn_rl.task_env.TaskEnv`, whatever the
environment calls its group of agents: ``("agents", "observation")`` and so on, with any leading dimensions ``*B``.
"""

from __future__ import annotations

import contextlib
import copy
import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from modgnn_rl.actions import ActionSpace, Ball, Box
from modgnn_rl.configs.schema import TaskConfig
from modgnn_rl.errors import InputError
from modgnn_rl.layout import Layout
from modgnn_rl.nn.topology import as_matrix
from modgnn_rl.registry import METRICS, TASKS
from modgnn_rl.task_env import ACTION, EXPERT_ACTION, OBSERVATION, REWARD, Probe, TaskEnv, probe
from modgnn_rl.task_expert import ExpertLabels
from modgnn_rl.visualization.recording import NO_MARKS, Frame, edge_array

__all__ = ["ACTION", "EXPERT_ACTION", "OBSERVATION", "REWARD", "CriticInput", "Task", "make_task"]


class CriticInput(NamedTuple):
    """What the critic of MAPPO sees of a flock.

    Attributes:
        keys: what `features` reads.
        features: maps data with these keys, and ``("agents", "mask")`` if there are masks, to [*B, N, F].
        width: F.
    """

    keys: list[NestedKey]
    features: Any
    width: int


class Task:
    """A task; see the module's docstring for a whole one.

    Only `make_env` must be defined. The methods up to `frame` are yours to define, the others are what the library
    calls.

    Args:
        config: the task's settings.

    Attributes:
        default_model: model that is trained unless ``model=`` names another.
        bootstraps_at_termination: whether MAPPO estimates the value of a state in which an episode terminates like any
            other. If each step is costly, agents would else gain from whatever ends an episode.
        min_agents: smallest number of agents.
        group: group of agents that the policy controls, of an environment with several; None: the only one.
        frequency: steps a second, for replays and exported agents, Hz.
        leader: index of an agent that replays mark; None: none.
        yardstick: name of the reference policy that evaluations compare errors with; None: none.
        arrow_name: what the arrows of replays are.
        max_arrow: length of the longest arrow that replays draw; None: the longest of the recording.
    """

    default_model = "modgnn_mlp"
    bootstraps_at_termination = False
    min_agents = 1
    group: str | None = None
    frequency = 10.0
    leader: int | None = None
    yardstick: str | None = None
    arrow_name = "action"
    max_arrow: float | None = None

    def __init__(self, config: Any) -> None:
        self.config = config
        self._expert: TensorDictModuleBase | None = None

    # What a task defines

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> EnvBase:
        """Make the environment: any TorchRL `EnvBase` with a batch of environments.

        It emits the observations of a group of agents [B, N, F] and a graph under ``adjacency``, in any form that
        `modgnn_rl.nn.topology.Topology` reads; without it the graph is made of `positions` and ``config.comm_range``.
        Rewards and done flags may be of the group, of each agent, or at the root.

        Args:
            num_envs: B.
            num_agents: N.
            seed: determines the environment's random numbers.
            device: of the tensors.
        """
        raise NotImplementedError(f"{type(self).__name__} must define make_env(num_envs, num_agents, seed, device)")

    def expert(self) -> TensorDictModuleBase | None:
        """The policy to imitate: a TensorDictModule that reads ``data`` and writes `EXPERT_ACTION` or `ACTION`.

        Discrete actions are indices [*B, N] or one-hot [*B, N, A]. None: the task has no expert; it is for MAPPO alone.
        """
        return None

    def references(self) -> dict[str, TensorDictModuleBase]:
        """Further policies to compare with, by the name of their row; they write `ACTION`."""
        return {}

    def positions(self, data: TensorDictBase) -> Tensor | None:
        """Positions of the agents [*B, N, D], in 1, 2 or 3 dimensions; None: there are none, hence no replay.

        Default: the first vector of the observation, if `layout` says that there is one.
        """
        layout = self.layout
        return data[OBSERVATION][..., : layout.dims] if layout.vectors else None

    def arrows(self, data: TensorDictBase) -> Tensor | None:
        """Vectors that replays draw at the agents [*B, N, D]; default: actions that have as many components."""
        position = self.positions(data)
        fits = position is not None and ACTION in data.keys(True) and data[ACTION].shape == position.shape
        return self.actions(data[ACTION]) if fits and isinstance(self.actions, (Ball, Box)) else None

    def targets(self, data: TensorDictBase) -> Tensor | None:
        """Places that replays mark, such as goals [*B, M, D]; default: none."""
        return None

    def success(self, data: TensorDictBase) -> Tensor:
        """Whether the task is solved in a state, bool [*B]; not defined: the task has no such state."""
        raise NotImplementedError(f"{type(self).__name__} has no success(data)")

    def quantities(self, data: TensorDictBase) -> dict[str, Tensor]:
        """Further inputs of the task's own metrics, by name, with leading dimensions [*B]."""
        return {}

    def training_metrics(self, rollouts: TensorDictBase) -> dict[str, Tensor]:
        """Further metrics of the rollouts [B, T] that a trainer collects, by name, [] each."""
        return {}

    def stored(self, data: TensorDictBase) -> Tensor:
        """What a dataset keeps of each agent in a step, float32 [*B, N, S].

        Default: observation, the expert's action, whether the policy controls the agent, whether an episode begins, and
        from whom it receives.

        Args:
            data: with the expert's action, ``adjacency`` and ``is_init``.
        """
        agents = data[OBSERVATION].shape[:-1]
        flags = [data["agents", "controlled"].unsqueeze(-1), data["is_init"].unsqueeze(-1).expand(*agents, 1)]
        graph = as_matrix(data["adjacency"], agents[-1])
        return torch.cat([part.float() for part in (data[OBSERVATION], data[EXPERT_ACTION], *flags, graph)], -1)

    def restored(self, stored: Tensor) -> TensorDict:
        """The keys of the environment and the expert's actions, from what `stored` kept [*B, N, S]."""
        widths = [self.layout.width, self.actions.width, 1, 1, stored.shape[-2]]
        observation, action, controlled, begins, graph = stored.split(widths, -1)
        agents = {"observation": observation, "expert_action": action, "controlled": controlled.squeeze(-1) > 0}
        batch = stored.shape[:-2]
        data = {"agents": TensorDict(agents, batch), "adjacency": graph > 0, "is_init": begins[..., 0, :] > 0}
        return TensorDict(data, batch, device=stored.device)

    def stored_width(self, num_agents: int) -> int:
        """Numbers that `stored` keeps of an agent, S."""
        return self.layout.width + self.actions.width + 2 + num_agents

    @functools.cached_property
    def layout(self) -> Layout:
        """What the numbers of an observation are; default: nothing is known but their number."""
        return Layout(self._probe.width)

    @functools.cached_property
    def actions(self) -> ActionSpace:
        """What an agent can do; default: as the environment's action spec says, a box or one of several choices."""
        return self._probe.actions

    @property
    def comm_range(self) -> float:
        """Distance within which agents hear each other, for environments without a graph; default: the setting."""
        return float(getattr(self.config, "comm_range", torch.inf))

    def critic_input(self) -> CriticInput:
        """What the critic sees; default: the observations of all agents."""
        return CriticInput([OBSERVATION], lambda data: data[OBSERVATION], self.layout.width)

    # What the library calls

    @property
    def evaluation_steps(self) -> int:
        """Steps of an evaluation episode unless settings say otherwise."""
        return int(self.config.max_steps)

    @property
    def name(self) -> str:
        """The task's name."""
        return str(self.config.name)

    @property
    def group_name(self) -> str | None:
        """The environment's own name of the group of agents."""
        return self._probe.group

    @property
    def dims(self) -> int:
        """Dimension of the space that replays show."""
        return self.layout.dims

    @property
    def sizes(self) -> list[int]:
        """The numbers of agents to train with."""
        return list(self.config.sizes)

    def training_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> EnvBase:
        """An environment to train in; its episodes do not all end at the same step.

        Tasks whose environment has all keys of `TaskEnv` already may return it as it is, here and in `evaluation_env`.
        """
        return TaskEnv(self, num_envs, num_agents, seed=seed, device=device, stagger=True)

    def evaluation_env(
        self, num_envs: int, num_agents: int, seed: int, device: torch.device | str, *, steps: int
    ) -> EnvBase:
        """An environment whose episodes begin together and last ``steps`` steps, unless the task ends them earlier."""
        return TaskEnv(self, num_envs, num_agents, seed=seed, device=device, max_steps=steps)

    def with_expert(self, expert: TensorDictModuleBase | None) -> Task:
        """The same task with another expert; with None, the task itself."""
        if expert is None:
            return self
        changed = copy.copy(self)
        changed._expert = expert
        return changed

    @property
    def can_rotate(self) -> bool:
        """Whether imitation may rotate or reflect observations and actions, as `layout` says."""
        return self.layout.is_rotatable and self.actions.is_symmetric(self.layout.symmetries, self.layout.dims)

    @property
    def has_positions(self) -> bool:
        """Whether there are positions, so that replays can be drawn."""
        return bool(self.layout.vectors) or type(self).positions is not Task.positions

    @property
    def has_success(self) -> bool:
        """Whether `success` is defined."""
        return type(self).success is not Task.success

    @property
    def has_other_expert(self) -> bool:
        """Whether the expert is not the task's own, but that of `with_expert`."""
        return self._expert is not None

    @functools.cached_property
    def teacher(self) -> TensorDictModuleBase | None:
        """The expert, which writes `EXPERT_ACTION` as numbers of the policy's action."""
        expert = self.expert() if self._expert is None else self._expert
        return None if expert is None else ExpertLabels(expert, self)

    def reference_policies(self) -> dict[str, TensorDictModuleBase]:
        """The policies that every table is compared with, by name: expert, `references`, and doing nothing."""
        idle = TensorDictModule(self.actions.idle, in_keys=[OBSERVATION], out_keys=[ACTION])
        rows: dict[str, TensorDictModuleBase] = {}
        if self.teacher is not None:
            act = TensorDictModule(torch.clone, in_keys=[EXPERT_ACTION], out_keys=[ACTION])
            rows["expert"] = TensorDictSequential(self.teacher, act)
        references = self.references() if self._expert is None else {}
        return rows | references | {self.actions.idle_name: idle}

    @functools.cached_property
    def metrics(self) -> list[str]:
        """Names of the registered metrics of this task: the error first, then its own, then those of all tasks."""
        given = {"controlled", "reward", "action"} | ({"position"} if self.has_positions else set())
        given |= {"expert_action", "difference"} if self.teacher is not None else set()
        given |= {"success"} if self.has_success else set()
        own, shared = [], []
        for name, entry in METRICS.items():
            task = entry.options.get("task")
            if task == self.name:
                own.append(name)
            elif task is None and given.issuperset(entry.options.get("inputs", ("position",))):
                shared.append(name)
        return sorted([*own, *shared], key=lambda name: name != "error")

    def measured(self, data: TensorDictBase) -> dict[str, Tensor]:
        """What metrics are computed from, by the name of the input.

        Args:
            data: the result of a step, or a state; what it lacks is left out.
        """
        found = {"controlled": data["agents", "controlled"]}
        action, expert_action = data.get(ACTION, None), data.get(EXPERT_ACTION, None)
        if action is not None:
            found["action"] = action
            if expert_action is not None:
                found["expert_action"] = expert_action
                found["difference"] = self.actions.difference(action, expert_action)
        if (reward := data.get(("next", *REWARD), None)) is not None:
            found["reward"] = reward.squeeze(-1)
        if (position := self.positions(data)) is not None:
            found["position"] = position
        if self.has_success:
            found["success"] = self.success(data["next"] if ("next", "done") in data.keys(True) else data)
        return found | self.quantities(data)

    def frame(self, data: TensorDictBase) -> Frame:
        """What replays draw of one environment.

        Args:
            data: of one environment, without batch dimension.

        Raises:
            InputError: the task has no positions.
        """
        position = self.positions(data)
        if position is None:
            raise InputError(f"task '{self.name}' has no positions to draw; define positions(data) in {type(self)}")
        arrows, targets, controlled = self.arrows(data), self.targets(data), data["agents", "controlled"]
        return Frame(
            position=_in_space(position),
            arrow=_in_space(torch.zeros_like(position) if arrows is None else arrows).astype(np.float32),
            edges=edge_array(data["adjacency"]),
            present=data.get(("agents", "mask"), torch.ones_like(controlled)).cpu().numpy(),
            marks=NO_MARKS if targets is None else _in_space(targets),
            leader=self.leader,
        )

    @functools.cached_property
    def _probe(self) -> Probe:
        """What the specs of the task's environment say."""
        with contextlib.closing(self.make_env(1, self.sizes[0], 0, torch.device("cpu"))) as env:
            return probe(self, env)

    def __getstate__(self) -> dict[str, Any]:
        """What copies and other processes get: all but what follows from the expert."""
        return {name: value for name, value in vars(self).items() if name not in ("teacher", "metrics")}


def _in_space(vectors: Tensor) -> np.ndarray[Any, Any]:
    """Vectors [N, D] with zeros as missing components, float64 [N, 3]."""
    missing = 3 - vectors.shape[-1]
    return torch.nn.functional.pad(vectors.double(), (0, missing)).cpu().numpy()


def make_task(config: TaskConfig) -> Any:
    """The task that settings are of.

    Raises:
        InputError: there is no such task.
    """
    kind = TASKS[config.name].load()
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise InputError(f"env={config.name} is {kind!r}, not a class derived from modgnn_rl.Task")
    return kind(config)
