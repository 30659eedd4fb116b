"""DAgger (Ross, Gordon and Bagnell 2011): learn at the states that the policy itself visits."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import DAggerConfig, TrainConfig
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.trainers.callbacks import Callback, StopOnPlateau
from modgnn_rl.trainers.collection import flocks_of_all_sizes
from modgnn_rl.trainers.journal import Journal, flight_metrics
from modgnn_rl.trainers.learner import fit_together
from modgnn_rl.trainers.mixing import SafetyGate, disagreement, expert_share, spread
from modgnn_rl.trainers.setup import make_learner

__all__ = ["dagger"]

GATES = {"disagreement": disagreement, "ensemble": spread}


def dagger(
    config: TrainConfig,
    run: RunFolder,
    logger: GuardedLogger,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
) -> dict[str, ModGNN]:
    """Train a policy with DAgger.

    The expert flies first and the policy clones it. Then, round by round, mixture and policy go on flying the same
    flocks, every visited state is labelled with the expert's action and added to all data before, and one optimiser
    goes on over all of it. What flies, and what is returned, is the moving average of the policy's weights.

    Args:
        config: the run's settings, ``config.trainer`` being a `DAggerConfig`.
        run: the folder to leave metrics and checkpoints in.
        logger: the dashboard.
        expert: writes ``("agents", "expert_action")``; default: Reynolds flocking.
        callbacks: people's own code.

    Returns:
        the trained policy, by the name of its model.
    """
    settings: DAggerConfig = config.trainer
    sizes = config.env.sizes
    cloning = settings.cloning_updates // len(sizes)
    fitting = settings.round_updates // len(sizes)
    updates = (cloning + settings.rounds * fitting) * len(sizes)
    expert = expert or Reynolds.for_env(config.env)
    members = settings.ensemble if settings.gate == "ensemble" else 1
    learners = [make_learner(config, (cloning * len(sizes), updates), member) for member in range(members)]
    gate = None if settings.gate == "none" else SafetyGate(GATES[settings.gate], settings.gate_threshold)
    flocks = flocks_of_all_sizes(
        config,
        [learner.flown for learner in learners],
        expert,
        steps=settings.round_steps,
        stretch=settings.stretch,
        gate=gate,
    )
    names = [config.model.name, *(f"ensemble_{member}" for member in range(1, members))]
    if settings.plateau_rounds:
        plateau = StopOnPlateau(settings.plateau_rounds, settings.plateau_gain, after=settings.expert_rounds)
        callbacks = [*callbacks, plateau]

    by_name = dict(zip(names, learners, strict=True))
    with Journal(run, logger, by_name, flocks, updates, settings, callbacks) as journal:
        for group in flocks:
            for _ in range(math.ceil(settings.cloning_steps / settings.round_steps)):
                group.keep(journal.show(0, group.fly(expert_share=1.0)))
            loss, *_ = fit_together(learners, group.buffer, cloning)
            journal.note(0, {f"{group.num_agents}/loss": loss}, cloning, cloned=loss)
            group.mixture.restart()

        for index in range(settings.rounds):
            share = expert_share(
                settings.schedule,
                index,
                start=settings.expert_share,
                decay=settings.share_decay,
                last_round=settings.expert_rounds,
            )
            metrics = {"expert_share": share, "learning_rate": learners[0].learning_rate}
            for group in flocks:
                flights = journal.show(index + 1, group.fly(share))
                group.keep(flights)
                metrics |= flight_metrics(flights, config.env)
                metrics[f"{group.num_agents}/loss"], *_ = fit_together(learners, group.buffer, fitting)
            metrics["error"] = error = sum(metrics[f"{size}/error"] for size in sizes) / len(sizes)
            round_ = f"{index + 1}/{settings.rounds}"
            if journal.note(index + 1, metrics, fitting * len(sizes), round=round_, error=error):
                break

    return {config.model.name: learners[0].flown}
