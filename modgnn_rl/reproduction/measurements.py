"""What is measured of a study's models: their errors on the expert's rollouts, and rollouts of their own."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import FlockingConfig, ReproduceConfig
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.envs.flocking.expert import LocalReynolds
from modgnn_rl.envs.flocking.metrics import action_error
from modgnn_rl.evaluation.rollout import EpisodeMetrics, reference_policies, rollout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import METRICS
from modgnn_rl.reproduction.studies import Study, Subject, World
from modgnn_rl.reproduction.tasks import Outcome, Result
from modgnn_rl.tracking.loading import load_policy
from modgnn_rl.trainers.imitation.loss import imitation_loss
from modgnn_rl.utils.progress import Progress
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["VALIDATION", "Measurements", "flight_cell", "fly_references", "fly_subject", "look_on", "validate"]

VALIDATION = "validation"  # the world of the expert's held-out rollouts
STATES = 50  # of each held-out rollout that the validation error is taken on
SPREADS = ("leader_distance", "cohesion", "separation")  # of which the spread over time and agents is kept, too


def flight_cell(config: ReproduceConfig, subject: Subject, seed: int, study: Study, env_config: str) -> str:
    """The name of the cell in which a subject flies in a world."""
    return f"{study.family}-{config.after}-{subject.key}-seed{seed}-{env_config}"


def _policy(config: ReproduceConfig, folder: Path, subject: Subject, done: Mapping[str, Result]) -> ModGNN:
    made = next(result for result in done.values() if "policies" in result)
    return load_policy(folder / made["policies"][subject.key], device=config.device)


def fly_subject(
    config: ReproduceConfig, folder: Path, subject: Subject, env_config: World, done: Mapping[str, Result]
) -> Result:
    """Fly a subject's policy in a world; its figures by name, one a flock."""
    policy = _policy(config, folder, subject, done)
    with Progress(f"{subject.key} flies in {env_config.name}", env_config.flocks * env_config.steps) as progress:
        return _fly_in(policy, config, env_config, progress)


def fly_references(config: ReproduceConfig, env_config: World, done: Mapping[str, Result]) -> Result:
    """Fly the expert, the local experts and doing nothing in a world; their figures by name of the row."""
    policies = reference_policies(_changed(config, env_config))
    with Progress(
        f"references fly in {env_config.name}", len(policies) * env_config.flocks * env_config.steps
    ) as progress:
        return {name: _fly_in(policy, config, env_config, progress) for name, policy in policies.items()}


def _changed(config: ReproduceConfig, env_config: World) -> FlockingConfig:
    return dataclasses.replace(config.env, num_agents=env_config.num_agents, **env_config.changes)


def _fly_in(policy: TensorDictModuleBase, config: ReproduceConfig, env_config: World, progress: Progress) -> Result:
    """The figures of rollouts from the same starts for all policies and seeds."""
    rollouts = rollout(
        policy,
        _changed(config, env_config),
        num_agents=env_config.num_agents,
        num_flocks=env_config.flocks,
        steps=env_config.steps,
        seed=derive_seed(config.seed, "rollouts"),
        device=config.device,
        progress=progress,
    )
    return _figures(rollouts)


def _figures(rollouts: EpisodeMetrics) -> Result:
    figures = {name: rollouts[name].double() for name in METRICS}
    for name in SPREADS:
        squares = rollouts.mean_squares[name]
        figures[f"{name}_square"] = squares
        figures[f"{name}_spread"] = (squares - figures[name].square()).clamp(min=0).sqrt()
    return {name: _rounded(values.tolist()) for name, values in figures.items()}


def _rounded(values: Sequence[float]) -> list[float]:
    """Six digits of each: results are kept for good, and much is flown."""
    return [float(f"{value:.6g}") for value in values]


def _held_out(config: ReproduceConfig, folder: Path, length: int) -> Iterator[TensorDict]:
    """Windows [T, W] of each of the expert's held-out rollouts, evenly over the rollout."""
    dataset = EpisodeDataset.open(folder / "dataset", verify=False, device=config.device)
    for episode in range(dataset.episodes - config.scale.val_episodes, dataset.episodes):
        steps = torch.linspace(0, dataset.steps - 1, min(STATES, dataset.steps)).round().long()
        yield dataset.windows(episode * dataset.steps + steps, length)


@torch.no_grad()
def validate(config: ReproduceConfig, folder: Path, subject: Subject, done: Mapping[str, Result]) -> Result:
    """The error of a policy that looks on while the expert flies, one a rollout."""
    policy = _policy(config, folder, subject, done)
    errors = []
    for windows in _held_out(config, folder, policy.window):
        errors.append(float(imitation_loss(policy, windows, windows["agents", "controlled"][:, -1])))
    return {"error": _rounded(errors)}


@torch.no_grad()
def look_on(config: ReproduceConfig, folder: Path, done: Mapping[str, Result]) -> Result:
    """The error of each reference that looks on while the expert flies, one a rollout."""
    policies = reference_policies(config.env)
    errors: dict[str, list[float]] = {name: [] for name in policies}
    for windows in _held_out(config, folder, 2):
        now = windows[:, -1]
        for name, policy in policies.items():
            seen = now.copy()
            if isinstance(policy, LocalReynolds):
                seen[policy.cache] = windows["agents", "observation"][:, 0]
            agents = policy(seen)["agents"]
            error = action_error(agents["action"], now["agents", "expert_action"], now["agents", "controlled"])
            errors[name].append(float(error.mean()))
    return {name: {"error": _rounded(values)} for name, values in errors.items()}


class Measurements:
    """What was measured, by row of a table and world.

    Args:
        outcome: of the cells of a study.
        config: its settings.
        study: the study.
    """

    def __init__(self, outcome: Outcome, config: ReproduceConfig, study: Study) -> None:
        self.outcome, self.config, self.study = outcome, config, study

    def values(self, row: Subject | str, env_config: str, figure: str) -> NDArray[np.float64] | None:
        """A figure of all rollouts [S, F] of each seed that did not fail; None where all did.

        Args:
            row: a subject, or the name of a reference.
            env_config: name of the world.
            figure: its name. What is no number counts as infinite: a rollout that ended nowhere.
        """
        results = self.outcome.results
        if isinstance(row, str):
            found = [results.get(f"references-{env_config}", {}).get(row)]
        else:
            seeds = range(self.config.seeds)
            found = [results.get(flight_cell(self.config, row, seed, self.study, env_config)) for seed in seeds]
        rows = [entry[figure] for entry in found if entry]
        return np.nan_to_num(np.array(rows, dtype=float), nan=np.inf, posinf=np.inf) if rows else None
