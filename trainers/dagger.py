"""DAgger (Ross, Gordon and Bagnell 2011): learn at the states that the policy itself visits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import DAggerConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.trainers.collectors.behaviour import SafetyGate, beta_schedule, disagreement, ensemble_std
from modgnn_rl.trainers.collectors.flocks import make_buffers, make_validation_buffers, named_buffers
from modgnn_rl.trainers.collectors.windows import window_of
from modgnn_rl.trainers.imitation.learner import fit_together, validate_together
from modgnn_rl.trainers.loop.callbacks import StopOnPlateau
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.metrics import rollout_metrics
from modgnn_rl.trainers.loop.setup import check_steps, check_updates, make_learner
from modgnn_rl.trainers.loop.training_loop import TrainingLoop

__all__ = ["dagger"]

GATES = {"disagreement": disagreement, "ensemble": ensemble_std}


def ensemble(config: TrainConfig) -> dict[str, TrainConfig]:
    """The settings of each policy that DAgger trains, by name: one, or with ``gate=ensemble`` several."""
    settings: DAggerConfig = config.trainer
    others = range(1, settings.ensemble if settings.gate == "ensemble" else 1)
    return dict.fromkeys([config.model.name, *(f"ensemble_{number}" for number in others)], config)


def check_dagger(config: TrainConfig, policies: Sequence[ModGNN], expert: TensorDictModuleBase | None) -> None:
    """Refuse too few updates and rollouts that are too short."""
    check_updates(config, "cloning_updates")
    check_updates(config, "updates_per_round")
    check_steps(config, "steps_per_round", window_of(policies, config.trainer))


@TRAINERS.register("dagger", settings=DAggerConfig, objective="error", members=ensemble, check=check_dagger)
def dagger(context: TrainContext) -> dict[str, ModGNN]:
    """Train a policy with DAgger.

    The expert flies first and the policy clones it. Then, round by round, mixture and policy go on flying the same
    flocks, every visited state is labelled with the expert's action and added to all data before, and one optimiser
    goes on over all of it. What flies, and what is returned, is the moving average of the policy's weights.

    Args:
        context: the run, ``context.config.trainer`` being a `DAggerConfig`.

    Returns:
        the trained policy, by the name of its model.
    """
    config = context.config
    settings: DAggerConfig = config.trainer
    sizes = config.env.sizes
    cloning = settings.cloning_updates // len(sizes)
    fitting = settings.updates_per_round // len(sizes)
    updates = (cloning + settings.rounds * fitting) * len(sizes)
    names = list(ensemble(config))
    learners = [make_learner(config, (cloning * len(sizes), updates), member) for member in range(len(names))]
    cloning_stretches = math.ceil(settings.cloning_steps / settings.steps_per_round)
    gate = None if settings.gate == "none" else SafetyGate(GATES[settings.gate], settings.gate_threshold)
    policies, expert = [learner.ema_policy for learner in learners], context.expert
    flown: dict[str, Any] = {"steps": settings.steps_per_round, "hold_steps": settings.hold_steps}
    flocks = make_buffers(config, policies, expert, **flown, gate=gate)
    held_out = make_validation_buffers(config, policies, expert, **flown)
    if settings.plateau_rounds:
        plateau = StopOnPlateau(settings.plateau_rounds, settings.plateau_gain, after=settings.beta_rounds)
        context = dataclasses.replace(context, callbacks=[*context.callbacks, plateau])

    by_name = dict(zip(names, learners, strict=True))
    with TrainingLoop(context, by_name, named_buffers(flocks, held_out), updates) as loop:
        for index in loop.rounds(0, settings.rounds):
            share = 1.0 if index == 0 else beta_of_round(settings, index - 1)
            stretches, count = (cloning_stretches, cloning) if index == 0 else (1, fitting)
            metrics = {"learning_rate": learners[0].learning_rate, "beta": share}
            for size, group in flocks.items():
                for _ in range(stretches):
                    rollouts = loop.on_collect(group.fly(share))
                    group.keep(rollouts)
                for _ in range(cloning_stretches if not held_out[size].seen else 0):
                    held_out[size].keep(held_out[size].fly(beta=1.0))
                if index == 0:
                    group.mixture.restart()
                metrics |= rollout_metrics(rollouts, config.env)
                metrics[f"{size}/loss"], *_ = fit_together(learners, group.buffer, count)
                metrics[f"{size}/validation_loss"], *_ = validate_together(learners, held_out[size].buffer)
                metrics[f"{size}/states"] = len(group.buffer)
            metrics["error"] = error = sum(metrics[f"{size}/error"] for size in sizes) / len(sizes)
            metrics["gradient_norm"] = learners[0].gradient_norm
            round_ = f"{index}/{settings.rounds}"
            loop.log(metrics, count * len(sizes), {names[0]: error}, round=round_, error=error)

    return {names[0]: learners[0].ema_policy}


def beta_of_round(settings: DAggerConfig, index: int) -> float:
    """The expert's share of the flying time in a round, counted from 0 after the cloning."""
    return beta_schedule(
        settings.schedule,
        index,
        start=settings.beta,
        decay=settings.beta_decay,
        last_round=settings.beta_rounds,
    )
