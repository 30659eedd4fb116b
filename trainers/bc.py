"""Behaviour cloning: fit the expert's actions on the expert's own flights, as the paper did."""

from __future__ import annotations

import dataclasses

from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.collection import flocks_of_all_sizes
from modgnn_rl.trainers.journal import Journal, flight_metrics
from modgnn_rl.trainers.setup import make_learner

__all__ = ["bc"]

ROUNDS = 40  # parts of the training after each of which the loss is looked at
FLIGHT_ROUNDS = 20  # parts after which the policy flies


def bc(config: TrainConfig, run: RunFolder, logger: GuardedLogger) -> ModGNN:
    """Train a policy by behaviour cloning.

    The validation error is taken on the expert's flights of flocks that are not trained on. It says little of how the
    policy flies: it never meets the states that its own errors lead to.

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
    training = flocks_of_all_sizes(config, learner.flown, expert, **flown)
    held_out = dataclasses.replace(settings, num_envs=settings.held_out)
    validation = flocks_of_all_sizes(
        dataclasses.replace(config, trainer=held_out, seed=derive_seed(config.seed, "validation")),
        learner.flown,
        expert,
        **flown,
    )

    with Journal(run, logger, learner, [*training, *validation], updates, settings) as journal:
        for group in (*training, *validation):
            group.keep(group.fly(expert_share=1.0))
        for index in range(rounds):
            metrics = {"learning_rate": learner.learning_rate}
            for group, unseen in zip(training, validation, strict=True):
                metrics[f"{group.num_agents}/loss"] = learner.fit(group.buffer, fitting)
                metrics[f"{group.num_agents}/validation_loss"] = learner.validate(unseen.buffer)
                if (index + 1) % FLIGHT_ROUNDS == 0:
                    metrics |= flight_metrics(unseen.fly(expert_share=0.0), config.env)
            loss = sum(metrics[f"{size}/validation_loss"] for size in sizes) / len(sizes)
            journal.note(index + 1, metrics, fitting * len(sizes), validation_loss=loss)

    return learner.flown
