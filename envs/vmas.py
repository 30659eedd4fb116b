"""The scenarios of VMAS (Bettini et al. 2022) as tasks, with the heuristics that VMAS brings as their experts.

    pip install 'modgnn-rl[vmas]'
    python -m modgnn_rl.train env=vmas env.scenario=transport trainer=dagger

Robots hear each other within ``env.comm_range``. Scenarios whose agents are all of one kind are supported.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, MarlGroupMapType, Transform, TransformedEnv, VmasEnv

from modgnn_rl.configs.schema import TaskConfig
from modgnn_rl.configs.settings import setting
from modgnn_rl.errors import InputError, one_line, suggestion
from modgnn_rl.registry import TASKS
from modgnn_rl.task import EXPERT_ACTION, OBSERVATION, Task
from modgnn_rl.utils.seeds import seeded

__all__ = ["Vmas", "VmasConfig", "scenarios"]

SOLVED = (
    "discovery",
    "give_way",
    "multi_give_way",
    "navigation",
    "reverse_transport",
    "transport",
)  # done means solved


@dataclass
class VmasConfig(TaskConfig):
    """A scenario of VMAS: robots that push, balance, spread or find their way in two dimensions."""

    name: str = setting("vmas", "task", choices=TASKS)
    scenario: str = setting("navigation", "scenario of VMAS, such as balance, discovery, flocking, transport or wheel")
    num_agents: Any = setting(4, "robots; a list trains on several numbers at once", ge=1, whole=True)
    comm_range: float = setting(1.0, "distance within which robots hear each other (m)", gt=0)
    discrete: bool = setting(False, "whether robots choose among the scenario's discrete actions")
    options: dict[str, Any] = setting({}, "settings of the scenario, as in env.options={n_packages: 2}")


@TASKS.register("vmas", settings=VmasConfig)
class Vmas(Task):
    """A scenario of VMAS, with VMAS' own heuristic as the expert where it has one."""

    config: VmasConfig

    def __init__(self, config: VmasConfig) -> None:
        super().__init__(config)
        if config.scenario not in scenarios():
            raise InputError(
                f"env.scenario={config.scenario} is not a scenario of VMAS: {', '.join(scenarios())}"
                f"{suggestion(config.scenario, scenarios())}"
            )

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> EnvBase:
        """See `Task.make_env`; the robots' positions are under ``("agents", "position")``."""
        with seeded(seed):  # VMAS draws from torch's global generator
            env = VmasEnv(
                self.config.scenario,
                num_envs=num_envs,
                continuous_actions=not self.config.discrete,
                device=device,
                seed=seed,
                group_map=MarlGroupMapType.ALL_IN_ONE_GROUP,
                n_agents=num_agents,
                **self.config.options,
            )
        if env.het_specs:
            raise InputError(
                f"env.scenario={self.config.scenario} has agents of different kinds, and one policy acts for all; use "
                "a scenario whose agents have equal observations and actions"
            )
        return TransformedEnv(env, _Places(has_landmarks=bool(env.world.landmarks)))

    def expert(self) -> TensorDictModuleBase | None:
        """VMAS' heuristic, if there is one; of navigation a rule of ours."""
        rule = _heuristic(self.config.scenario, discrete=self.config.discrete)
        return None if rule is None else TensorDictModule(rule, [OBSERVATION], [EXPERT_ACTION])

    def positions(self, data: TensorDictBase) -> Tensor:
        """See `Task.positions`."""
        return data["agents", "position"]

    def targets(self, data: TensorDictBase) -> Tensor | None:
        """Goals and landmarks of the scenario."""
        return data.get("landmarks", None)

    @property
    def has_success(self) -> bool:
        """Whether the scenario ends when it is solved."""
        return self.config.scenario in SOLVED

    def success(self, data: TensorDictBase) -> Tensor:
        """Whether the scenario has ended."""
        return data["terminated"].squeeze(-1)


class _Places(Transform):
    """Adds the positions of robots and landmarks, which VMAS' observations need not contain."""

    def __init__(self, *, has_landmarks: bool) -> None:
        super().__init__(in_keys=[], out_keys=[("agents", "position"), *(["landmarks"] if has_landmarks else [])])

    def _places(self) -> dict[Any, Tensor]:
        world = self.parent.base_env.world
        entities = (world.policy_agents, world.landmarks)
        return {
            key: torch.stack([entity.state.pos for entity in kind], -2)
            for key, kind in zip(self.out_keys, entities, strict=False)
        }

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, value in self._places().items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the positions to the spec."""
        for key, value in self._places().items():
            observation_spec[key] = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        return observation_spec


@functools.cache
def scenarios() -> list[str]:
    """Names of the scenarios of VMAS.

    Raises:
        InputError: VMAS is not installed.
    """
    if importlib.util.find_spec("vmas") is None:
        raise InputError("env=vmas needs VMAS, which is not installed: pip install 'modgnn-rl[vmas]'")
    folders = importlib.import_module("vmas.scenarios").__path__
    return sorted(module.name for module in pkgutil.iter_modules(folders) if not module.ispkg)


def _heuristic(scenario: str, *, discrete: bool) -> Callable[[Tensor], Tensor] | None:
    """A rule for a scenario, observations [*B, N, F] to actions; None if there is none."""
    if scenario == "navigation":
        return None if discrete else _keep_right
    kind = getattr(importlib.import_module(f"vmas.scenarios.{scenario}"), "HeuristicPolicy", None)
    if kind is None:
        return None
    rule = kind(continuous_action=not discrete)
    try:
        rule.compute_action(torch.zeros(1, 128), u_range=1.0)
    except AssertionError:  # a rule for the other kind of actions
        return None
    except Exception as error:
        raise InputError(f"env.scenario={scenario}: VMAS' heuristic cannot be used ({one_line(error)})") from error
    return functools.partial(_compute, rule)


def _compute(rule: Any, observation: Tensor) -> Tensor:
    """Apply a heuristic of VMAS to each robot."""
    action: Tensor = rule.compute_action(observation.flatten(0, -2), u_range=1.0)
    return action.unflatten(0, observation.shape[:-1])


def _keep_right(observation: Tensor, reach: float = 0.4) -> Tensor:
    """A rule for navigation, in which robots avoid each other: to the goal, away from and to the right of near robots.

    VMAS' own heuristic solves a quadratic program for each robot with cvxpylayers, and ignores the others.

    Args:
        observation: position, velocity, offset from the goal, and more [*B, N, F].
        reach: distance at which robots begin to avoid each other, m.

    Returns:
        accelerations [*B, N, 2].
    """
    position, velocity, offset = observation[..., :6].split(2, -1)
    apart = position.unsqueeze(-2) - position.unsqueeze(-3)
    distance = apart.norm(dim=-1, keepdim=True).clamp(min=1e-3)
    away = apart / distance
    right = torch.stack((-away[..., 1], away[..., 0]), -1)
    others = ~torch.eye(position.shape[-2], dtype=torch.bool, device=position.device).unsqueeze(-1)
    force = (others * (reach / distance - 1).clamp(min=0) * (away + 0.5 * right)).sum(-2)
    return (3 * force - 3 * offset - 4 * velocity).clamp(-1, 1)
