"""Behaviour cloning: fit the expert's actions on the expert's own flights, as the paper did."""

from __future__ import annotations

import dataclasses
from typing import Any

from torchrl.data import ReplayBuffer

from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.dataset import FlightDataset
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.collection import Flocks, flocks_of_all_sizes
from modgnn_rl.trainers.journal import Journal, flight_metrics
from modgnn_rl.trainers.setup import make_learner

__all__ = ["bc"]

ROUNDS = 40  # parts of the training after each of which the loss is looked at
FLIGHT_ROUNDS = 20  # parts after which the policy flies


def bc(config: TrainConfig, run: RunFolder, logger: GuardedLogger) -> ModGNN:
    """Train a policy by behaviour cloning.

    The expert's flights come from a dataset, or are flown first. The validation error is taken on flights that are not
    trained on. It says little of how the policy flies: it never meets the states that its own errors lead to.

    Args:
        config: the run's settings, ``config.trainer`` being a `BCConfig`.
        run: the folder to leave metrics and checkpoints in.
        logger: the dashboard.

    Returns:
        the trained policy: the moving average of the weights.
    """
    settings: BCConfig = config.trainer
    sizes = config.env.sizes
    rounds = min(ROUNDS, settings.cloning_updates // len(sizes))
    fitting = settings.cloning_updates // (rounds * len(sizes))
    updates = rounds * fitting * len(sizes)
    learner = make_learner(config, (updates, updates))
    expert = Reynolds.for_env(config.env)
    flown = {"steps": settings.cloning_steps, "stretch": settings.cloning_steps}
    held_out = dataclasses.replace(settings, num_envs=settings.held_out)
    validation = flocks_of_all_sizes(
        dataclasses.replace(config, trainer=held_out, seed=derive_seed(config.seed, "validation")),
        learner.flown,
        expert,
        **flown,
    )
    training = [] if settings.dataset else flocks_of_all_sizes(config, learner.flown, expert, **flown)

    with Journal(run, logger, learner, [*training, *validation], updates, settings) as journal:
        if settings.dataset:
            buffers = [_share(settings.dataset, settings, validation[0], learner.flown.window)]
        else:
            for group in (*training, *validation):
                group.keep(group.fly(expert_share=1.0))
            buffers = [group.buffer for group in training]
        for index in range(rounds):
            metrics = {"learning_rate": learner.learning_rate}
            for buffer, unseen in zip(buffers, validation, strict=True):
                metrics[f"{unseen.num_agents}/loss"] = learner.fit(buffer, fitting)
                metrics[f"{unseen.num_agents}/validation_loss"] = learner.validate(unseen.buffer)
                if (index + 1) % FLIGHT_ROUNDS == 0:
                    metrics |= flight_metrics(unseen.fly(expert_share=0.0), config.env)
            loss = sum(metrics[f"{size}/validation_loss"] for size in sizes) / len(sizes)
            journal.note(index + 1, metrics, fitting * len(sizes), validation_loss=loss)

    return learner.flown


def _share(path: str, settings: BCConfig, unseen: Flocks, window: int) -> ReplayBuffer:
    """Share a dataset's flights: the last ``held_out`` become the data of ``unseen``, the others are returned."""
    dataset = FlightDataset.open(path, verify=False, device=unseen.env.device)  # `check_training` has verified it
    seen = dataset.episodes - settings.held_out
    draws: dict[str, Any] = {
        "length": window,
        "batch_size": settings.batch_size,
        "generator": unseen.buffer._rng,  # checkpoints hold it
    }
    unseen.buffer = dataset.buffer(episodes=range(seen, dataset.episodes), **draws)
    return dataset.buffer(episodes=range(seen), **draws)
