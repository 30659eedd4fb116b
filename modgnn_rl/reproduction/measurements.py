"""Measurements of a study's models: validation error on expert episodes, and closed-loop rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from modgnn_rl.configs.schema import ReproduceConfig
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.evaluation.metrics import action_error
from modgnn_rl.evaluation.rollout import EpisodeMetrics, rollout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.reproduction.jobs import JobResults, Result
from modgnn_rl.reproduction.studies import EvalSetting, ModelVariant, Study
from modgnn_rl.task import ACTION, EXPERT_ACTION, Task, make_task
from modgnn_rl.tracking.loading import load_policy
from modgnn_rl.trainers.imitation.loss import imitation_loss
from modgnn_rl.utils.progress import Progress
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "VALIDATION",
    "Results",
    "evaluate_references",
    "evaluate_variant",
    "evaluation_job",
    "validate_references",
    "validate_variant",
]

REFERENCES = "references"  # jobs of the reference policies
VALIDATION = "validation"  # the evaluation on expert episodes that are not trained on
STATES = 50  # states of each of these episodes on which the validation error is measured
SPREADS = ("leader_distance", "cohesion", "separation")  # metrics whose standard deviation over time is kept, too


def evaluation_job(config: ReproduceConfig, variant: ModelVariant, seed: int, study: Study, setting: str) -> str:
    """The name of the job that evaluates a variant in a setting."""
    return f"{study.family}-{config.after}-{variant.key}-seed{seed}-{setting}"


def _policy(config: ReproduceConfig, folder: Path, variant: ModelVariant, done: Mapping[str, Result]) -> ModGNN:
    made = next(result for result in done.values() if "policies" in result)
    return load_policy(folder / made["policies"][variant.key], device=config.device)


def evaluate_variant(
    config: ReproduceConfig, folder: Path, variant: ModelVariant, setting: EvalSetting, done: Mapping[str, Result]
) -> Result:
    """Roll out a variant's policy in an evaluation setting; metrics by name, one value per episode."""
    policy = _policy(config, folder, variant, done)
    with Progress(f"{variant.key} in {setting.name}", setting.flocks * setting.steps) as progress:
        return _evaluate(policy, config, setting, progress)


def evaluate_references(config: ReproduceConfig, setting: EvalSetting, done: Mapping[str, Result]) -> Result:
    """Roll out the reference policies in an evaluation setting; their metrics by name of the policy."""
    policies = _task(config, setting).reference_policies()
    with Progress(f"references in {setting.name}", len(policies) * setting.flocks * setting.steps) as progress:
        return {name: _evaluate(policy, config, setting, progress) for name, policy in policies.items()}


def _task(config: ReproduceConfig, setting: EvalSetting) -> Task:
    task: Task = make_task(dataclasses.replace(config.env, num_agents=setting.num_agents, **setting.changes))
    return task


def _evaluate(
    policy: TensorDictModuleBase, config: ReproduceConfig, setting: EvalSetting, progress: Progress
) -> Result:
    """Metrics of rollouts from the same initial states for all policies and seeds."""
    rollouts = rollout(
        policy,
        _task(config, setting),
        num_agents=setting.num_agents,
        num_flocks=setting.flocks,
        steps=setting.steps,
        seed=derive_seed(config.seed, "rollouts"),
        device=config.device,
        progress=progress,
    )
    return _figures(rollouts)


def _figures(rollouts: EpisodeMetrics) -> Result:
    figures = {name: rollouts[name].double() for name in rollouts.values}
    for name in SPREADS if set(SPREADS) <= set(rollouts.mean_squares) else ():
        squares = rollouts.mean_squares[name]
        figures[f"{name}_square"] = squares
        figures[f"{name}_spread"] = (squares - figures[name].square()).clamp(min=0).sqrt()
    return {name: _rounded(values.tolist()) for name, values in figures.items()}


def _rounded(values: Sequence[float]) -> list[float]:
    """Six significant digits, to keep the stored results small."""
    return [float(f"{value:.6g}") for value in values]


def _validation_windows(config: ReproduceConfig, folder: Path, length: int) -> Iterator[TensorDict]:
    """Yield windows [T, W] of each validation episode, evenly spaced in time."""
    dataset = EpisodeDataset.open(folder / "dataset", verify=False, device=config.device)
    for episode in range(dataset.episodes - config.scale.val_episodes, dataset.episodes):
        steps = torch.linspace(0, dataset.steps - 1, min(STATES, dataset.steps)).round().long()
        yield dataset.windows(episode * dataset.steps + steps, length)


@torch.no_grad()
def validate_variant(
    config: ReproduceConfig, folder: Path, variant: ModelVariant, done: Mapping[str, Result]
) -> Result:
    """The error of a policy at the states of expert episodes, one value per episode."""
    policy = _policy(config, folder, variant, done)
    errors = []
    for windows in _validation_windows(config, folder, policy.window):
        errors.append(float(imitation_loss(policy, windows, windows["agents", "controlled"][:, -1])))
    return {"error": _rounded(errors)}


@torch.no_grad()
def validate_references(config: ReproduceConfig, folder: Path, done: Mapping[str, Result]) -> Result:
    """The error of each reference policy at the states of expert episodes, one value per episode."""
    task = make_task(config.env)
    policies = task.reference_policies()
    errors: dict[str, list[float]] = {name: [] for name in policies}
    for windows in _validation_windows(config, folder, 2):
        now = windows[:, -1]
        for name, policy in policies.items():
            action = _last_action(policy, windows)
            difference = task.actions.difference(action, now[EXPERT_ACTION])
            errors[name].append(float(action_error(difference, now["agents", "controlled"]).mean()))
    return {name: {"error": _rounded(values)} for name, values in errors.items()}


def _last_action(policy: TensorDictModuleBase, windows: TensorDict) -> Tensor:
    """The action of a policy, whose state begins empty, at the end of windows [S, W]."""
    state = TensorDict({}, [len(windows)])
    for step in range(windows.shape[1]):
        now = policy(windows[:, step].copy().update(state))
        state = now.get("next", state)
    return now[ACTION]


class Results:
    """Measurements by row of a table and evaluation setting.

    Args:
        outcome: results of the jobs of a study.
        config: settings of the reproduction.
        study: the study.
    """

    def __init__(self, outcome: JobResults, config: ReproduceConfig, study: Study) -> None:
        self.outcome, self.config, self.study = outcome, config, study
        self.task = make_task(config.env)
        self.references = list(self.task.reference_policies())

    def values(self, row: ModelVariant | str, setting: str, metric: str) -> NDArray[np.float64] | None:
        """Values of a metric [S, F] over seeds that did not fail and episodes; None where all failed.

        Args:
            row: a variant, or the name of a reference policy.
            setting: name of the evaluation setting.
            metric: name of the metric; NaN counts as infinite.
        """
        results = self.outcome.results
        if isinstance(row, str):
            found = [results.get(f"{REFERENCES}-{setting}", {}).get(row)]
        else:
            seeds = range(self.config.seeds)
            found = [results.get(evaluation_job(self.config, row, seed, self.study, setting)) for seed in seeds]
        rows = [entry[metric] for entry in found if entry]
        return np.nan_to_num(np.array(rows, dtype=float), nan=np.inf, posinf=np.inf) if rows else None
