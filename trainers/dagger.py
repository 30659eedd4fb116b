"""DAgger (Ross, Gordon and Bagnell 2011): learn in the states that the policy itself visits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from modgnn_rl.configs.schema import DAggerConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.task import Task
from modgnn_rl.trainers.collectors.behaviour import SafetyGate, beta_schedule, disagreement, ensemble_std
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffers, make_validation_buffers
from modgnn_rl.trainers.collectors.windows import window_length
from modgnn_rl.trainers.imitation.demonstrations import collect_validation
from modgnn_rl.trainers.imitation.learner import fit_together, validate_together
from modgnn_rl.trainers.loop.callbacks import StopOnPlateau
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.metrics import mean_over_sizes, rollout_metrics
from modgnn_rl.trainers.loop.setup import check_imitation, check_steps, check_updates, make_learner
from modgnn_rl.trainers.loop.training_loop import TrainingLoop

__all__ = ["dagger"]

GATES = {"disagreement": disagreement, "ensemble": ensemble_std}


def ensemble_configs(config: TrainConfig) -> dict[str, TrainConfig]:
    """The settings of each policy that DAgger trains, by name: one, or with ``gate=ensemble`` several."""
    settings: DAggerConfig = config.trainer
    others = range(1, settings.ensemble if settings.gate == "ensemble" else 1)
    return dict.fromkeys([config.model.name, *(f"ensemble_{number}" for number in others)], config)


def check_dagger(config: TrainConfig, policies: Sequence[ModGNN], task: Task) -> None:
    """Refuse tasks without an expert, too few updates, and rollouts that are too short."""
    check_imitation(config, task)
    check_updates(config, "cloning_updates")
    check_updates(config, "updates_per_round")
    check_steps(config, "steps_per_round", window_length(policies, config.trainer))


@TRAINERS.register(
    "dagger",
    settings=DAggerConfig,
    objective="error",
    members=ensemble_configs,
    check=check_dagger,
    fixed=("gate", "ensemble"),
)
def dagger(context: TrainContext) -> dict[str, ModGNN]:
    """Train a policy with DAgger.

    In round 0 the expert acts and the policy clones it. In every later round the mixture of policy and expert acts, the
    expert labels all states that are visited, these are added to the data, and the policy is fitted to all data so far.
    The environments are not reset between rounds, and the optimiser keeps its state. The policy that acts, and that is
    returned, has the moving average of the weights.

    Args:
        context: the run, ``context.config.trainer`` being a `DAggerConfig`.

    Returns:
        the trained policy, by the name of its model.
    """
    config, settings, sizes = context.config, context.config.trainer, context.config.env.sizes
    cloning_rollouts = math.ceil(settings.cloning_steps / settings.steps_per_round)
    cloning_updates, updates = settings.cloning_updates // len(sizes), settings.updates_per_round // len(sizes)
    total = (cloning_updates + settings.rounds * updates) * len(sizes)
    names = list(ensemble_configs(config))
    learners = [
        make_learner(config, context.task, (cloning_updates * len(sizes), total), member)
        for member in range(len(names))
    ]
    policies, task = [learner.ema_policy for learner in learners], context.task
    options: dict[str, Any] = {"steps": settings.steps_per_round, "hold_steps": settings.hold_steps}
    gate = None if settings.gate == "none" else SafetyGate(GATES[settings.gate], settings.gate_threshold)
    training = make_buffers(config, task, policies, **options, gate=gate)
    validation = make_validation_buffers(config, task, policies, **options)

    by_name = dict(zip(names, learners, strict=True))
    with TrainingLoop(with_early_stopping(context), by_name, training, validation, total=total) as loop:
        for index in loop.rounds(0, settings.rounds):
            repeats, steps = (cloning_rollouts, cloning_updates) if index == 0 else (1, updates)
            beta = 1.0 if index == 0 else beta_of_round(settings, index)
            metrics = {"learning_rate": learners[0].learning_rate, "beta": beta}
            collect_validation(validation, cloning_rollouts)
            for size, buffer in training.items():
                for _ in range(repeats):
                    rollouts = loop.on_collect(buffer.collect(beta))  # the expert labels every state
                    buffer.extend(rollouts)  # aggregate
                if index == 0:
                    buffer.collector.mixture.restart()
                metrics |= rollout_metrics(rollouts, task)
                metrics[f"{size}/loss"], *_ = fit_together(learners, buffer.buffer, steps)
                metrics[f"{size}/validation_loss"], *_ = validate_together(learners, validation[size].buffer)
                metrics[f"{size}/states"] = len(buffer.buffer)
            metrics["error"] = error = mean_over_sizes(metrics, "error", sizes)
            metrics["gradient_norm"] = learners[0].gradient_norm
            round_ = f"{index}/{settings.rounds}"
            loop.log(metrics, steps * len(sizes), {names[0]: error}, round=round_, error=error)

    return {names[0]: policies[0]}


def beta_of_round(settings: DAggerConfig, index: int) -> float:
    """The probability that the expert acts in a round, counted from 1."""
    return beta_schedule(
        settings.schedule, index - 1, start=settings.beta, decay=settings.beta_decay, last_round=settings.beta_rounds
    )


def with_early_stopping(context: TrainContext) -> TrainContext:
    """The context with a callback that stops on a plateau of the error, if the settings ask for it."""
    settings: DAggerConfig = context.config.trainer
    if settings.plateau_rounds == 0:
        return context
    stop = StopOnPlateau(settings.plateau_rounds, settings.plateau_gain, after=settings.beta_rounds)
    return dataclasses.replace(context, callbacks=[*context.callbacks, stop])
