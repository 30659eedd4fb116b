"""The scenarios of VMAS (Bettini et al. 2022) as tasks, with the heuristics that VMAS brings as their experts.

    pip install 'modgnn-rl[vmas]'
    python -m modgnn_rl.train env=vmas env.scenario=transport trainer=dagger

Robots hear each other within ``env.comm_range``. Scenarios whose agents are all of one kind are supported. VMAS is
under the GPL, and not a dependency of this library.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import VmasEnv

from modgnn_rl.configs.schema import TaskConfig
from modgnn_rl.configs.settings import setting
from modgnn_rl.envs.vmas_env import POSITION, ScenarioEnv
from modgnn_rl.errors import InputError, one_line, suggestion
from modgnn_rl.layout import Layout
from modgnn_rl.registry import TASKS
from modgnn_rl.task import EXPERT_ACTION, OBSERVATION, Task

__all__ = ["Vmas", "VmasConfig", "keep_right", "scenarios"]

# Scenarios whose episodes end when they are solved; of balance also when the package falls.
SOLVABLE = {
    *("balance", "discovery", "dispersion", "give_way", "multi_give_way", "navigation", "reverse_transport"),
    "transport",
}
# Scenarios in which only positions relative to what a robot observes matter.
TRANSLATIONS = {"navigation"}


@dataclass
class VmasConfig(TaskConfig):
    """A scenario of VMAS: robots that push, balance, spread or find their way in two dimensions."""

    name: str = setting("vmas", "task", choices=TASKS)
    scenario: str = setting("navigation", "scenario of VMAS, such as balance, discovery, flocking, transport or wheel")
    num_agents: Any = setting(4, "robots; a list trains on several numbers at once", ge=1, whole=True)
    comm_range: float = setting(1.0, "distance within which robots hear each other (m)", gt=0)
    discrete: bool = setting(False, "whether robots choose among the scenario's discrete actions")
    options: dict[str, Any] = setting({}, "settings of the scenario, as in 'env.options={n_packages: 2}'")


@TASKS.register("vmas", settings=VmasConfig)
class Vmas(Task):
    """Scenarios of VMAS; its heuristic policies are the experts."""

    config: VmasConfig

    def __init__(self, config: VmasConfig) -> None:
        super().__init__(config)
        if config.scenario not in scenarios():
            raise InputError(
                f"env.scenario={config.scenario} is not a scenario of VMAS: {', '.join(scenarios())}"
                f"{suggestion(config.scenario, scenarios())}"
            )

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> ScenarioEnv:
        """See `Task.make_env`.

        Raises:
            InputError: the scenario has another number of agents, agents of different kinds, or other options.
        """
        takes_number = '"n_agents"' in inspect.getsource(_module_of(self.config.scenario))
        options = ({"n_agents": num_agents} if takes_number else {}) | self.config.options
        where: dict[str, Any] = {"seed": seed, "device": device, "discrete": self.config.discrete}
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Scenario kwargs")  # that it does not know
            try:
                env = ScenarioEnv(self.config.scenario, num_envs, options=options, **where)
            except UserWarning as warning:
                raise InputError(f"env.options do not fit scenario '{self.config.scenario}': {warning}") from warning
        if env.n_agents != num_agents:
            raise InputError(
                f"scenario '{self.config.scenario}' has {env.n_agents} agents with these options; "
                f"set env.num_agents={env.n_agents}"
            )
        return env

    @functools.cached_property
    def _sample(self) -> ScenarioEnv:
        """A small environment, to look things up."""
        return self.make_env(4, self.sizes[0], 0, torch.device("cpu"))

    @property
    def frequency(self) -> float:  # type: ignore[override]
        """Steps a second, Hz."""
        return 1 / float(self._sample.world.dt)

    @functools.cached_property
    def layout(self) -> Layout:
        """Position and velocity first, where the scenario's observation begins with them."""
        env = self._sample
        env.reset()
        step = env.rand_step()["next", "agents"]
        width = step["observation"].shape[-1]
        velocity = torch.stack([agent.state.vel for agent in env.agents], 1)
        state = torch.cat((step["position"], velocity), -1)
        if width < 4 or not torch.equal(step["observation"][..., :4], state):
            return Layout(width)
        symmetries = ("translation",) if self.config.scenario in TRANSLATIONS else ()
        return Layout(width, dims=2, vectors=2, symmetries=symmetries)

    def expert(self) -> TensorDictModule | None:
        """VMAS' heuristic for the scenario, of navigation `keep_right`; None: there is none for these actions."""
        scenario, discrete, env = self.config.scenario, self.config.discrete, self._sample
        limit = float(env.agents[0].action.u_range)
        act: Callable[[Tensor], Tensor] | None
        if scenario == "navigation":
            act = None if discrete else functools.partial(keep_right, limit=limit)
        else:
            act = _heuristic(scenario, env.reset()[OBSERVATION], limit, discrete=discrete)
        return None if act is None else TensorDictModule(act, in_keys=[OBSERVATION], out_keys=[EXPERT_ACTION])

    def positions(self, data: TensorDictBase) -> Tensor:
        """Positions, m [*B, N, 2]."""
        return data[POSITION]

    def targets(self, data: TensorDictBase) -> Tensor | None:
        """Goals, targets and packages, m [*B, M, 2]."""
        landmarks = data.get("landmarks", None)
        return landmarks if landmarks is not None and landmarks.shape[-2] else None

    @property
    def has_success(self) -> bool:
        """Whether episodes of the scenario end when it is solved."""
        return self.config.scenario in SOLVABLE

    def success(self, data: TensorDictBase) -> Tensor:
        """Whether the episode has ended with the task solved, bool [*B]."""
        return data["success"].squeeze(-1)


def scenarios() -> list[str]:
    """Names of the scenarios of VMAS.

    Raises:
        InputError: VMAS is not installed.
    """
    if importlib.util.find_spec("vmas") is None:
        raise InputError("env=vmas needs VMAS, which is not installed: pip install 'modgnn-rl[vmas]'")
    return sorted(VmasEnv.available_envs)


def _module_of(scenario: str) -> ModuleType:
    """The module of VMAS that defines a scenario."""
    module: ModuleType = importlib.import_module("vmas.scenarios").load(f"{scenario}.py")
    return module


def _heuristic(
    scenario: str, observation: Tensor, limit: float, *, discrete: bool
) -> Callable[[Tensor], Tensor] | None:
    """VMAS' rule for a scenario, tried on observations; None if there is none for this kind of actions."""
    kind = getattr(_module_of(scenario), "HeuristicPolicy", None)
    if kind is None:
        return None
    rule = kind(continuous_action=not discrete)

    def act(observation: Tensor) -> Tensor:
        action: Tensor = rule.compute_action(observation.flatten(0, -2), u_range=limit)
        return action.unflatten(0, observation.shape[:-1])

    try:
        act(observation)
    except AssertionError:
        return None
    except Exception as error:
        raise InputError(f"env.scenario={scenario}: VMAS' heuristic cannot be used ({one_line(error)})") from error
    return act


def keep_right(observation: Tensor, limit: float = 1.0, reach: float = 0.4) -> Tensor:
    """A rule for navigation, in which robots avoid each other: to the goal, away from and to the right of near robots.

    VMAS' own heuristic solves a quadratic program for each robot with cvxpylayers, and ignores the others.

    Args:
        observation: begins with position, velocity, and offset from the goal, [*B, N, F].
        limit: largest component of a force.
        reach: distance at which robots begin to avoid each other, m.

    Returns:
        forces [*B, N, 2].
    """
    position, velocity, offset = observation[..., :6].split(2, -1)
    apart = position.unsqueeze(-2) - position.unsqueeze(-3)
    distance = apart.norm(dim=-1, keepdim=True).clamp(min=1e-3)
    away = apart / distance  # zero for the robot itself
    right = torch.stack((-away[..., 1], away[..., 0]), -1)
    evade = ((reach / distance - 1).clamp(min=0) * (away + 0.5 * right)).sum(-2)
    return (3 * evade - 3 * offset - 4 * velocity).clamp(-limit, limit)
