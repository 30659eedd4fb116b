"""Metrics of the rollouts that trainers collect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase

from modgnn_rl.metrics import compute_metrics, over_flocks
from modgnn_rl.registry import METRICS
from modgnn_rl.task import ACTION, EXPERT_ACTION, Task

__all__ = ["mean_over_sizes", "reward_metrics", "rollout_metrics"]

FRAMES = 4  # steps of a rollout at which states are measured
NOT_OF_STATES = {"difference", "reward", "success"}  # inputs of metrics that are measured elsewhere or at the end


def rollout_metrics(rollouts: TensorDictBase, task: Task) -> dict[str, float]:
    """Metrics of rollouts that a trainer has collected.

    Args:
        rollouts: [B, T]; if the expert acted in some, ``expert_acts`` [B, T, 1] tells in which.
        task: says which metrics it has, and how they are computed.

    Returns:
        by name, which begins with the number of agents: the error of the actions of the policy (NaN if the expert acted
        throughout), the fraction of steps in which the expert acted, and at a few steps, whoever acted, the metrics of
        states.
    """
    size, measured = rollouts[ACTION].shape[2], {}
    counted, expert_acts = rollouts["agents", "controlled"], rollouts.get("expert_acts", None)
    if "error" in task.metrics:
        if expert_acts is not None:
            counted = counted & ~expert_acts
        without_noise = rollouts.get(("agents", "loc"), rollouts.get(("agents", "logits"), None))
        action = rollouts[ACTION] if without_noise is None else without_noise
        difference = task.actions.difference(action, rollouts[EXPERT_ACTION])
        error = compute_metrics(["error"], task.config, {"difference": difference, "controlled": counted})["error"]
        measured["error"] = float(error.nanmean())
    frames = rollouts[:, torch.linspace(0, rollouts.shape[1] - 1, FRAMES).long()]
    names = [name for name in task.metrics if NOT_OF_STATES.isdisjoint(METRICS[name].options.get("inputs", ()))]
    values = compute_metrics(names, task.config, task.measured(frames))
    measured |= {name: over_flocks(name, value) for name, value in values.items()}
    if expert_acts is not None:
        measured["expert_fraction"] = float(expert_acts.double().mean())
    return {f"{size}/{name}": value for name, value in measured.items()}


def reward_metrics(rollouts: TensorDictBase, task: Task) -> dict[str, float]:
    """Mean reward per step and controlled agent, and what the task measures besides.

    Args:
        rollouts: [B, T].
        task: of the rollouts.

    Returns:
        by name, which begins with the number of agents.
    """
    counted = rollouts["agents", "controlled"]
    measured = {**task.training_metrics(rollouts), "reward": rollouts["next", "agents", "reward"][counted].mean()}
    return {f"{counted.shape[-1]}/{name}": float(value) for name, value in measured.items()}


def mean_over_sizes(metrics: Mapping[str, float], name: str, sizes: Sequence[int]) -> float:
    """The mean of the metrics ``<size>/<name>``."""
    return sum(metrics[f"{size}/{name}"] for size in sizes) / len(sizes)
