"""DAgger (Ross, Gordon and Bagnell 2011): learn at the states that the policy itself visits."""

from __future__ import annotations

import math

from modgnn_rl.configs.schema import DAggerConfig, TrainConfig
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.trainers.collection import flocks_of_all_sizes
from modgnn_rl.trainers.journal import Journal, flight_metrics
from modgnn_rl.trainers.mixing import expert_share
from modgnn_rl.trainers.setup import make_learner

__all__ = ["dagger"]


def dagger(config: TrainConfig, run: RunFolder, logger: GuardedLogger) -> ModGNN:
    """Train a policy with DAgger.

    The expert flies first and the policy clones it. Then, round by round, mixture and policy go on flying the same
    flocks, every visited state is labelled with the expert's action and added to all data before, and one optimiser
    goes on over all of it. What flies, and what is returned, is the moving average of the policy's weights.

    Args:
        config: the run's settings, ``config.trainer`` being a `DAggerConfig`.
        run: the folder to leave metrics and checkpoints in.
        logger: the dashboard.

    Returns:
        the trained policy.
    """
    settings: DAggerConfig = config.trainer
    sizes = config.env.sizes
    cloning = settings.cloning_updates // len(sizes)
    fitting = settings.round_updates // len(sizes)
    updates = (cloning + settings.rounds * fitting) * len(sizes)
    learner = make_learner(config, (cloning * len(sizes), updates))
    expert = Reynolds.for_env(config.env)
    flocks = flocks_of_all_sizes(config, learner.flown, expert, steps=settings.round_steps, stretch=settings.stretch)

    with Journal(run, logger, learner, flocks, updates, settings) as journal:
        for group in flocks:
            for _ in range(math.ceil(settings.cloning_steps / settings.round_steps)):
                group.keep(group.fly(expert_share=1.0))
            loss = learner.fit(group.buffer, cloning)
            journal.note(0, {f"{group.num_agents}/loss": loss}, cloning, cloned=loss)

        for index in range(settings.rounds):
            share = expert_share(
                settings.schedule,
                index,
                start=settings.expert_share,
                decay=settings.share_decay,
                last_round=settings.expert_rounds,
            )
            metrics = {"expert_share": share, "learning_rate": learner.learning_rate}
            for group in flocks:
                flights = group.fly(share)
                group.keep(flights)
                metrics |= flight_metrics(flights, config.env)
                metrics[f"{group.num_agents}/loss"] = learner.fit(group.buffer, fitting)
            error = sum(metrics[f"{size}/error"] for size in sizes) / len(sizes)
            journal.note(index + 1, metrics, fitting * len(sizes), round=f"{index + 1}/{settings.rounds}", error=error)

    return learner.flown
