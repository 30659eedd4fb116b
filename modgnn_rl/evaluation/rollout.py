"""Rollouts of policies and of reference policies from the same starts, and their metrics."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from modgnn_rl.metrics import compute_metrics
from modgnn_rl.registry import METRICS
from modgnn_rl.task import Task
from modgnn_rl.utils.progress import Progress

__all__ = ["EpisodeMetrics", "evaluate", "make_eval_env", "rollout"]

QUARTERS = 4
FOLDS = {"min": torch.minimum, "any": torch.logical_or}


@dataclasses.dataclass
class EpisodeMetrics:
    """Metrics of F episodes, one flock each.

    Attributes:
        values: by name of the metric, its value over the steps (and agents) of each episode [F]: float64 for a mean or
            a sum, the dtype of the positions for a minimum, bool for what holds or does not.
        mean_squares: by name, the mean over the steps and agents of the squares of each metric that is a mean [F], for
            standard deviations over time.
        error_by_quarter: the error in the four quarters of each episode [F, 4]; NaN in those that it does not reach.
        lengths: steps of each episode, int64 [F].
    """

    values: dict[str, Tensor]
    mean_squares: dict[str, Tensor]
    error_by_quarter: Tensor
    lengths: Tensor

    def __getitem__(self, name: str) -> Tensor:
        """The values of a metric [F]."""
        return self.values[name]


def make_eval_env(
    policy: TensorDictModuleBase,
    task: Task,
    num_flocks: int,
    num_agents: int,
    *,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """An environment in which every episode lasts at most ``steps`` steps, with the policy's recurrent state."""
    base = task.evaluation_env(num_flocks, num_agents, seed, device, steps=steps)
    primers = get_primers_from_module(policy, warn=False)
    return TransformedEnv(base, Compose(InitTracker(), *([primers] if primers is not None else [])))


@torch.no_grad()
def rollout(
    policy: TensorDictModuleBase,
    task: Task,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    watch: Callable[[TensorDictBase], None] | None = None,
) -> EpisodeMetrics:
    """Roll out a policy for one episode per flock and compute its metrics.

    An episode that the task ends early counts with the steps that it has. Equal seeds give equal starts, whatever the
    policy.

    Args:
        policy: reads the environment's keys, writes ``("agents", "action")``; its recurrent state is added to them.
        task: makes the environment; its expert is the reference of the error.
        num_agents: agents per flock, N.
        num_flocks: flocks, F.
        steps: steps per episode.
        seed: seed of the initial states.
        device: of the environment.
        progress: counts steps of flocks.
        watch: called before each step with all flocks and both actions; see `modgnn_rl.evaluation.recording.Recorder`.
    """
    env = make_eval_env(policy, task, num_flocks, num_agents, steps=steps, seed=seed, device=device)
    episodes = _Accumulator(task, num_flocks, steps, device)
    with contextlib.closing(env), set_recurrent_mode(False):
        tensordict = env.reset()
        for step in range(steps):
            tensordict = policy(tensordict)
            if task.teacher is not None:
                tensordict = task.teacher(tensordict)
            if watch is not None:
                watch(tensordict)
            tensordict = env.step(tensordict)
            episodes.add(step, tensordict)
            if progress is not None:
                progress.update(num_flocks)
            if episodes.are_over:
                break
            tensordict = env.maybe_reset(env.step_mdp(tensordict))
    return episodes.result()


class _Accumulator:
    """Metrics of F episodes, added up step by step while an episode runs; means in float64.

    Args:
        task: says which metrics it has, and how they are computed.
        num_flocks: episodes F.
        steps: longest episode.
        device: of the data.
    """

    def __init__(self, task: Task, num_flocks: int, steps: int, device: torch.device | str) -> None:
        self.task, self.steps = task, steps
        self.running = torch.ones(num_flocks, dtype=torch.bool, device=device)
        self.lengths = torch.zeros(num_flocks, dtype=torch.long, device=device)
        self.quarter_of = (torch.arange(steps) * QUARTERS // steps).tolist()
        self.quarters = torch.zeros(num_flocks, QUARTERS, device=device)
        self.in_quarter = torch.zeros(num_flocks, QUARTERS, dtype=torch.long, device=device)
        self.sums: dict[str, Tensor] = {}
        self.squares: dict[str, Tensor] = {}
        self.counts: dict[str, Tensor] = {}
        self.folded: dict[str, Tensor] = {}
        self.last: dict[str, Tensor] = {}

    @property
    def are_over(self) -> bool:
        """Whether all episodes are over."""
        return not bool(self.running.any())

    def add(self, step: int, tensordict: TensorDictBase) -> None:
        """Add the metrics of a step; the tensordict comes from ``env.step``."""
        running, over_time = self.running, {name: METRICS[name].options["over_time"] for name in self.task.metrics}
        due = [name for name, kind in over_time.items() if kind != "last" and step % _every(name) == 0]
        values = compute_metrics(due, self.task.config, self.task.measured(tensordict))
        quarter = self.quarter_of[step]
        if "error" in values:
            self.quarters[:, quarter] += torch.where(running, values["error"], 0.0)
        self.in_quarter[:, quarter] += running
        for name, value in values.items():
            if fold := FOLDS.get(over_time[name]):
                folded = fold(self.folded[name], value) if name in self.folded else value
                self.folded[name] = torch.where(running, folded, self.folded.get(name, value))
                continue
            value = value.double().reshape(len(value), -1)
            self.sums[name] = self.sums.get(name, 0.0) + torch.where(running, value.mean(-1), 0.0)
            self.squares[name] = self.squares.get(name, 0.0) + torch.where(running, value.square().mean(-1), 0.0)
            self.counts[name] = self.counts.get(name, 0) + running
        self.lengths += running
        ends = running & (tensordict["next", "done"].view(-1) | (step == self.steps - 1))
        if ends.any():
            names = [name for name, kind in over_time.items() if kind == "last"]
            for name, value in compute_metrics(names, self.task.config, self.task.measured(tensordict["next"])).items():
                self.last[name] = torch.where(ends, value, self.last.get(name, value))
        self.running = running & ~ends

    def result(self) -> EpisodeMetrics:
        """The metrics of the episodes."""
        means = {name: total / self.counts[name] for name, total in self.sums.items()}
        is_sum = {name for name in means if METRICS[name].options["over_time"] == "sum"}
        found = {name: mean * self.lengths if name in is_sum else mean for name, mean in means.items()}
        found |= {**self.folded, **self.last}
        return EpisodeMetrics(
            values={name: found[name] for name in self.task.metrics},
            mean_squares={name: self.squares[name] / self.counts[name] for name in means if name not in is_sum},
            error_by_quarter=self.quarters / self.in_quarter,
            lengths=self.lengths,
        )


def _every(name: str) -> int:
    """Steps between two evaluations of a metric."""
    return int(METRICS[name].options.get("every", 1))


def evaluate(
    policies: Mapping[str, TensorDictModuleBase],
    task: Task,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    watches: Mapping[str, Callable[[TensorDictBase], None]] | None = None,
) -> dict[str, EpisodeMetrics]:
    """Roll out policies and the reference policies from the same starts, and show the progress.

    Args:
        policies: by name.
        task: of the policies.
        num_agents: agents per flock, N.
        num_flocks: flocks, F.
        steps: steps per episode.
        seed: seed of the initial states.
        device: of the environments.
        watches: by name of the policy, what is called before each of its steps, see `rollout`.

    Returns:
        the metrics by name of the policy.
    """
    policies = {**policies, **task.reference_policies()}
    total = len(policies) * num_flocks * steps
    rollouts = {}
    with Progress(f"evaluate, {num_agents} agents", total) as progress:
        for name, policy in policies.items():
            progress.update(policy=name)
            rollouts[name] = rollout(
                policy,
                task,
                num_agents=num_agents,
                num_flocks=num_flocks,
                steps=steps,
                seed=seed,
                device=device,
                progress=progress,
                watch=(watches or {}).get(name),
            )
    return rollouts
