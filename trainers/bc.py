"""Behaviour cloning: fit the expert's actions on the expert's own rollouts, as the paper did."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.data import ReplayBuffer

from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.trainers.collectors.flocks import FlockBuffer, make_buffers, make_validation_buffers, named_buffers
from modgnn_rl.trainers.collectors.windows import window_of
from modgnn_rl.trainers.imitation.learner import fit_together, validate_together
from modgnn_rl.trainers.imitation.side_by_side import by_policy, member_configs, member_folders
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.setup import check_steps, check_updates, make_learner
from modgnn_rl.trainers.loop.training_loop import TrainingLoop
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["bc"]

ROUNDS = 40  # parts of the training at least, after each of which the loss is looked at
ROUND_UPDATES = 150  # updates of such a part at most: what a signal may have to wait for
FLIGHT_ROUNDS = 20  # parts after which the policies fly
FLIGHT_STEPS = 250  # how long
DART_PARTS = 4  # parts of the rollouts between which the noise is set anew


def check_bc(config: TrainConfig, policies: Sequence[ModGNN], expert: TensorDictModuleBase | None) -> None:
    """Refuse too few updates, rollouts that are too short, and a dataset that is damaged or does not fit."""
    settings: BCConfig = config.trainer
    check_updates(config, "cloning_updates")
    if settings.dataset is None:
        parts = DART_PARTS if settings.dart else 1
        check_steps(config, "cloning_steps", parts * window_of(policies, settings))
        return
    if expert is not None:
        raise InputError(
            "trainer.dataset holds the labels of Reynolds flocking, not those of your expert; leave one out"
        )
    dataset = EpisodeDataset.open(settings.dataset)
    dataset.check_world(config.env)
    if dataset.episodes <= settings.num_val_envs:
        raise InputError(
            f"trainer.num_val_envs={settings.num_val_envs} leaves nothing to train on of the {dataset.episodes} "
            f"episodes in {settings.dataset}; lower it, or collect more"
        )


@TRAINERS.register("bc", settings=BCConfig, objective="validation_loss", members=member_configs, check=check_bc)
def bc(context: TrainContext) -> dict[str, ModGNN]:
    """Train policies by behaviour cloning, one or several side by side on the same batches.

    The expert's rollouts come from a dataset, or are flown first. The validation error is taken on rollouts that are
    not trained on. It says little of how a policy flies: it never meets the states that its own errors lead to.

    Args:
        context: the run, ``context.config.trainer`` being a `BCConfig`; with several policies, a run folder of each
            lies in the run's.

    Returns:
        the trained policies, the moving averages of the weights, by name.
    """
    config, expert = context.config, context.expert
    settings: BCConfig = config.trainer
    sizes = config.env.sizes
    each = settings.cloning_updates // len(sizes)
    rounds = min(each, max(ROUNDS, math.ceil(settings.cloning_updates / ROUND_UPDATES)))
    fitting = each // rounds
    updates = rounds * fitting * len(sizes)
    members = member_configs(config)
    by_name = {name: make_learner(member, (updates, updates)) for name, member in members.items()}
    learners, policies = list(by_name.values()), [learner.ema_policy for learner in by_name.values()]
    parts = DART_PARTS if settings.dart else 1
    flown: dict[str, Any] = {"steps": max(1, settings.cloning_steps // parts), "hold_steps": settings.cloning_steps}
    held_out = make_validation_buffers(config, policies, expert, **flown)
    training = {} if settings.dataset else make_buffers(config, policies, expert, **flown)
    flights_at = [part * rounds // parts for part in range(parts)]

    with (
        member_folders(context.run, members, by_name),
        TrainingLoop(context, by_name, named_buffers(training, held_out), updates) as loop,
    ):
        buffers = {size: group.buffer for size, group in training.items()}
        if settings.dataset:
            buffers = {sizes[0]: _share(settings, held_out[sizes[0]], max(policy.window for policy in policies))}
        for index in loop.rounds(1, rounds):
            for size, group in training.items():
                for _ in range(max(flights_at.count(index - 1), not group.seen)):
                    learned = settings.dart and index > 1
                    group.action_noise.scale = loop.state["validation_loss"] ** 0.5 if learned else settings.noise
                    group.keep(loop.on_collect(group.fly(beta=1.0)))
                for _ in range(parts if not held_out[size].seen else 0):
                    held_out[size].keep(held_out[size].fly(beta=1.0))
            metrics = {"learning_rate": learners[0].learning_rate}
            for group in training.values():
                metrics["noise"] = group.action_noise.scale
            losses: dict[str, list[float]] = {name: [] for name in by_name}
            for size, buffer in buffers.items():
                unseen = held_out[size].buffer
                found = {
                    "loss": fit_together(learners, buffer, fitting),
                    "validation_loss": validate_together(learners, unseen),
                }
                for name, values in found.items():
                    metrics |= by_policy(list(by_name), f"{size}/{name}", values)
                for name, value in zip(by_name, found["validation_loss"], strict=True):
                    losses[name].append(value)
                metrics[f"{size}/states"] = len(buffer)
                if index % FLIGHT_ROUNDS == 0:
                    metrics |= _errors_in_flight(config, by_name, size, expert)
            metrics["gradient_norm"] = learners[0].gradient_norm
            scores = {name: sum(values) / len(values) for name, values in losses.items()}
            metrics["validation_loss"] = loop.state["validation_loss"] = sum(scores.values()) / len(scores)
            loop.log(metrics, fitting * len(sizes), scores, validation_loss=metrics["validation_loss"])

    return dict(zip(by_name, policies, strict=True))


def _errors_in_flight(
    config: TrainConfig, by_name: dict[str, Any], size: int, expert: TensorDictModuleBase
) -> dict[str, float]:
    """The error of each policy on short rollouts of its own, from the same starts."""
    settings: BCConfig = config.trainer
    rollouts = [
        rollout(
            learner.ema_policy,
            config.env,
            num_agents=size,
            num_flocks=settings.num_val_envs,
            steps=min(FLIGHT_STEPS, settings.cloning_steps),
            seed=derive_seed(config.seed, "validation"),
            device=config.device,
            expert=expert,
        )
        for learner in by_name.values()
    ]
    return by_policy(list(by_name), f"{size}/error", [float(rollout.error.mean()) for rollout in rollouts])


def _share(settings: BCConfig, unseen: FlockBuffer, window: int) -> ReplayBuffer:
    """Share a dataset's rollouts: the last ``held_out`` become the data of ``unseen``, the others are returned.

    A dataset holds no messages: windows make them anew.
    """
    # `check_training` has verified it.
    dataset = EpisodeDataset.open(str(settings.dataset), verify=False, device=unseen.device)
    seen = dataset.episodes - settings.num_val_envs
    draws: dict[str, Any] = {
        "length": window,
        "batch_size": settings.batch_size,
        "generator": unseen.buffer._rng,  # checkpoints hold it
    }
    unseen.borrow(dataset.buffer(episodes=range(seen, dataset.episodes), **draws))
    return dataset.buffer(episodes=range(seen), **draws)
