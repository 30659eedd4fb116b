"""Rollouts of policies and of reference policies from the same starts, and their metrics."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.metrics import compute_metrics
from modgnn_rl.registry import METRICS
from modgnn_rl.utils.progress import Progress

__all__ = ["EpisodeMetrics", "evaluate", "make_eval_env", "reference_policies", "rollout"]

QUARTERS = 4
ACTION = ("agents", "action")
FOLDS = {"min": torch.minimum, "any": torch.logical_or}


@dataclasses.dataclass
class EpisodeMetrics:
    """Metrics of F episodes, one flock each.

    Attributes:
        values: by name of the metric, its value over the steps (and agents) of each episode [F]: float64 for a mean or
            a sum, the dtype of the positions for a minimum, bool for what holds or does not.
        mean_squares: by name, the mean over the steps and agents of the squares of each metric that is a mean [F], for
            standard deviations over time.
        error_by_quarter: the error in the four quarters of each episode [F, 4].
    """

    values: dict[str, Tensor]
    mean_squares: dict[str, Tensor]
    error_by_quarter: Tensor

    def __getitem__(self, name: str) -> Tensor:
        """The values of a metric [F]."""
        return self.values[name]


def reference_policies(
    config: FlockingConfig, expert: TensorDictModuleBase | None = None
) -> dict[str, TensorDictModuleBase]:
    """The policies that every table is compared with, by name.

    Args:
        config: environment config.
        expert: writes ``("agents", "expert_action")``; default: Reynolds flocking.

    Returns:
        the expert, the local experts of 2 hops and of 1 hop, which see what a policy sees (Reynolds flocking only), and
        the zero action.
    """
    idle = TensorDictModule(_zero_action, in_keys=[("agents", "observation")], out_keys=[ACTION])
    if expert is not None:
        act = TensorDictModule(torch.clone, in_keys=expert.out_keys[:1], out_keys=[ACTION])
        return {"expert": TensorDictSequential(expert, act), "zero action": idle}
    return {
        "expert": Reynolds.for_env(config, action=ACTION),
        "local expert (2 hops)": LocalReynolds.for_env(config, hops=2, action=ACTION),
        "local expert (1 hop)": LocalReynolds.for_env(config, hops=1, action=ACTION),
        "zero action": idle,
    }


def _zero_action(observation: Tensor) -> Tensor:
    return torch.zeros_like(observation[..., :3])


def make_eval_env(
    policy: TensorDictModuleBase,
    config: FlockingConfig,
    num_flocks: int,
    num_agents: int,
    *,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """An environment in which every episode lasts ``steps`` steps, with the policy's recurrent state."""
    env_config = dataclasses.replace(config, max_distance=torch.inf, max_colliding=1.0, max_steps=steps)
    base = FlockingEnv(num_flocks, num_agents, config=env_config, seed=seed, device=device)
    primers = get_primers_from_module(policy, warn=False)
    return TransformedEnv(base, Compose(InitTracker(), *([primers] if primers is not None else [])))


@torch.no_grad()
def rollout(
    policy: TensorDictModuleBase,
    config: FlockingConfig,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    expert: TensorDictModuleBase | None = None,
    watch: Callable[[TensorDictBase], None] | None = None,
) -> EpisodeMetrics:
    """Roll out a policy for one episode per flock and compute its metrics.

    No episode ends early, not even that of a flock that has diverged, so all count in the averages. Equal seeds give
    equal starts and leaders, whatever the policy.

    Args:
        policy: reads the environment's keys, writes ``("agents", "action")``; its recurrent state is added to them.
        config: environment config.
        num_agents: agents per flock, N.
        num_flocks: flocks, F.
        steps: steps per episode.
        seed: seed of starts and leaders.
        device: of the environment.
        progress: counts steps of flocks.
        expert: reference of the error, writes ``("agents", "expert_action")``; default: Reynolds flocking.
        watch: called before each step with all flocks and both actions; see
            `modgnn_rl.envs.flocking.recording.FlockRecorder`.
    """
    env = make_eval_env(policy, config, num_flocks, num_agents, steps=steps, seed=seed, device=device)
    expert = expert or Reynolds.for_env(config)
    episodes = _Accumulator(num_flocks, steps, device)
    tensordict = env.reset()
    with contextlib.closing(env), set_recurrent_mode(False):
        for step in range(steps):
            tensordict = expert(policy(tensordict))
            if watch is not None:
                watch(tensordict)
            tensordict = env.step(tensordict)
            episodes.add(step, _step_metrics(tensordict, config, step))
            tensordict = env.step_mdp(tensordict)
            if progress is not None:
                progress.update(num_flocks)
    return episodes.result(_end_metrics(tensordict, config))


def _step_metrics(tensordict: TensorDictBase, config: FlockingConfig, step: int) -> dict[str, Tensor]:
    """Metrics of a step [F] or [F, N] by name, except those of the end; the tensordict comes from ``env.step``."""
    agents = tensordict["agents"]
    quantities = {
        "position": tensordict[config.state_key][..., :3],
        "reward": tensordict["next", "agents", "reward"].squeeze(-1),
        **{name: agents[name] for name in ("action", "expert_action", "controlled")},
    }
    due = [
        name
        for name, entry in METRICS.items()
        if entry.options["over_time"] != "last" and step % entry.options.get("every", 1) == 0
    ]
    return compute_metrics(due, config, quantities)


def _end_metrics(tensordict: TensorDictBase, config: FlockingConfig) -> dict[str, Tensor]:
    """Metrics of the state after the last step [F], by name."""
    names = [name for name, entry in METRICS.items() if entry.options["over_time"] == "last"]
    return compute_metrics(names, config, {"position": tensordict[config.state_key][..., :3]})


class _Accumulator:
    """Metrics of F episodes, added up step by step; means in float64."""

    def __init__(self, num_flocks: int, steps: int, device: torch.device | str) -> None:
        self.quarter_of = (torch.arange(steps) * QUARTERS // steps).tolist()
        self.quarters = torch.zeros(num_flocks, QUARTERS, device=device)
        self.sums: dict[str, Tensor] = {}
        self.squares: dict[str, Tensor] = {}
        self.counts: Counter[str] = Counter()
        self.folded: dict[str, Tensor] = {}

    def add(self, step: int, values: Mapping[str, Tensor]) -> None:
        """Add the metrics of a step, each [F] or [F, N]."""
        self.quarters[:, self.quarter_of[step]] += values["error"]
        for name, value in values.items():
            if fold := FOLDS.get(METRICS[name].options["over_time"]):
                self.folded[name] = fold(self.folded[name], value) if name in self.folded else value
                continue
            value = value.double().reshape(len(value), -1)
            self.sums[name] = self.sums.get(name, 0.0) + value.mean(-1)
            self.squares[name] = self.squares.get(name, 0.0) + value.square().mean(-1)
            self.counts[name] += 1

    def result(self, end: Mapping[str, Tensor]) -> EpisodeMetrics:
        """The metrics of the episodes, with those of the state after the last step."""
        means = {name: total / self.counts[name] for name, total in self.sums.items()}
        is_sum = {name for name in means if METRICS[name].options["over_time"] == "sum"}
        found = {name: mean * len(self.quarter_of) if name in is_sum else mean for name, mean in means.items()}
        found |= {**self.folded, **end}
        lengths = torch.bincount(torch.tensor(self.quarter_of), minlength=QUARTERS).to(self.quarters.device)
        return EpisodeMetrics(
            values={name: found[name] for name in METRICS},
            mean_squares={name: self.squares[name] / self.counts[name] for name in means if name not in is_sum},
            error_by_quarter=self.quarters / lengths,
        )


def evaluate(
    policies: Mapping[str, TensorDictModuleBase],
    config: FlockingConfig,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    expert: TensorDictModuleBase | None = None,
    watches: Mapping[str, Callable[[TensorDictBase], None]] | None = None,
) -> dict[str, EpisodeMetrics]:
    """Roll out policies and the reference policies from the same starts, and show the progress.

    Args:
        policies: by name.
        config: environment config.
        num_agents: agents per flock, N.
        num_flocks: flocks, F.
        steps: steps per episode.
        seed: seed of starts and leaders.
        device: of the environments.
        expert: see `reference_policies`.
        watches: by name of the policy, what is called before each of its steps, see `rollout`.

    Returns:
        the metrics by name of the policy.
    """
    policies = {**policies, **reference_policies(config, expert)}
    total = len(policies) * num_flocks * steps
    rollouts = {}
    with Progress(f"evaluate, {num_agents} agents", total) as progress:
        for name, policy in policies.items():
            progress.update(policy=name)
            rollouts[name] = rollout(
                policy,
                config,
                num_agents=num_agents,
                num_flocks=num_flocks,
                steps=steps,
                seed=seed,
                device=device,
                progress=progress,
                expert=expert,
                watch=(watches or {}).get(name),
            )
    return rollouts
