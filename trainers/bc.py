"""Behaviour cloning: fit the expert's actions on the expert's own rollouts, as Kortvelesy and Prorok (2021) did."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.task import Task
from modgnn_rl.trainers.collectors.windows import window_length
from modgnn_rl.trainers.imitation.demonstrations import DART_PARTS, make_demonstrations
from modgnn_rl.trainers.imitation.learner import fit_together, validate_together
from modgnn_rl.trainers.imitation.side_by_side import by_policy, member_configs, member_folders
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.setup import check_imitation, check_steps, check_updates, make_learner
from modgnn_rl.trainers.loop.training_loop import TrainingLoop
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["bc"]

MIN_ROUNDS = 40  # the training is split into at least as many rounds, each with its losses in the metrics
MAX_UPDATES = 150  # updates in a round: a signal waits for its end
ROLLOUT_ROUNDS = 20  # every so many rounds the policies are rolled out
MAX_ROLLOUT_STEPS = 250  # steps of these rollouts


def check_bc(config: TrainConfig, policies: Sequence[ModGNN], task: Task) -> None:
    """Refuse too few updates, rollouts that are too short, and a dataset that is damaged or does not fit."""
    settings: BCConfig = config.trainer
    check_imitation(config, task)
    check_updates(config, "cloning_updates")
    if settings.dataset is None:
        parts = DART_PARTS if settings.dart else 1
        check_steps(config, "cloning_steps", parts * window_length(policies, settings))
        return
    if task.has_other_expert:
        raise InputError("trainer.dataset holds the labels of the task's own expert, not those of yours; leave one out")
    dataset = EpisodeDataset.open(settings.dataset)
    dataset.check_env_config(config.env)
    if dataset.episodes <= settings.num_val_envs:
        raise InputError(
            f"trainer.num_val_envs={settings.num_val_envs} leaves nothing to train on of the {dataset.episodes} "
            f"episodes in {settings.dataset}; lower it, or collect more"
        )


@TRAINERS.register(
    "bc",
    settings=BCConfig,
    objective="validation_loss",
    members=member_configs,
    check=check_bc,
    fixed=("models", "hops", "seeds"),
)
def bc(context: TrainContext) -> dict[str, ModGNN]:
    """Train policies by behaviour cloning, one or several side by side on the same batches.

    The validation loss is on rollouts of the expert, too. It says little about closed loop, where a policy visits
    states that its own errors lead to; hence the error on short rollouts of the policies every few rounds.

    Args:
        context: the run, ``context.config.trainer`` being a `BCConfig`. With several policies, each gets a run folder
            inside the run's.

    Returns:
        the trained policies, the moving averages of the weights, by name.
    """
    config, settings, sizes = context.config, context.config.trainer, context.config.env.sizes
    rounds, updates = split_updates(settings.cloning_updates // len(sizes))
    total = rounds * updates * len(sizes)
    members = member_configs(config)
    by_name = {name: make_learner(member, context.task, (total, total)) for name, member in members.items()}
    names, learners = list(by_name), list(by_name.values())
    policies = {name: learner.ema_policy for name, learner in by_name.items()}
    data = make_demonstrations(context, list(policies.values()), rounds)

    with (
        member_folders(context.run, members, by_name),
        TrainingLoop(context, by_name, data.training, data.validation, total=total) as loop,
    ):
        for index in loop.rounds(1, rounds):
            metrics = {"learning_rate": learners[0].learning_rate} | data.collect(loop)
            validation_losses = []
            for size in sizes:
                loss = fit_together(learners, data.training[size].buffer, updates)
                validation_loss = validate_together(learners, data.validation[size].buffer)
                validation_losses.append(validation_loss)
                metrics |= by_policy(names, f"{size}/loss", loss)
                metrics |= by_policy(names, f"{size}/validation_loss", validation_loss)
                metrics[f"{size}/states"] = len(data.training[size].buffer)
                if index % ROLLOUT_ROUNDS == 0:
                    errors = closed_loop_errors(context, policies, size)
                    metrics |= by_policy(names, f"{size}/error", errors)
            scores = {name: sum(losses) / len(sizes) for name, *losses in zip(names, *validation_losses, strict=True)}
            metrics["gradient_norm"] = learners[0].gradient_norm
            metrics["validation_loss"] = loop.state["validation_loss"] = sum(scores.values()) / len(scores)
            loop.log(metrics, updates * len(sizes), scores, validation_loss=metrics["validation_loss"])

    return policies


def split_updates(updates: int) -> tuple[int, int]:
    """Split updates into rounds: number of rounds, and updates in each; what is left over is not done."""
    rounds = min(updates, max(MIN_ROUNDS, math.ceil(updates / MAX_UPDATES)))
    return rounds, updates // rounds


def closed_loop_errors(context: TrainContext, policies: Mapping[str, ModGNN], size: int) -> list[float]:
    """The error of each policy on short rollouts of its own, all from the same initial states."""
    config, settings = context.config, context.config.trainer
    rollouts = [
        rollout(
            policy,
            context.task,
            num_agents=size,
            num_flocks=settings.num_val_envs,
            steps=min(MAX_ROLLOUT_STEPS, settings.cloning_steps),
            seed=derive_seed(config.seed, "validation"),
            device=config.device,
        )
        for policy in policies.values()
    ]
    return [float(metrics["error"].mean()) for metrics in rollouts]
