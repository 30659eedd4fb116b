"""MAPPO (Yu et al. 2022): improve a policy by reinforcement learning, with a critic that sees the whole flock."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import MAPPOConfig, TrainConfig
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.callbacks import Callback
from modgnn_rl.trainers.collection import FlockCollector, flocks_of
from modgnn_rl.trainers.journal import Journal, flight_metrics, reward_metrics
from modgnn_rl.trainers.ppo import Improver
from modgnn_rl.trainers.setup import initial_policy

__all__ = ["mappo"]


def mappo(
    config: TrainConfig,
    run: RunFolder,
    logger: GuardedLogger,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
) -> dict[str, ModGNN]:
    """Improve a policy by MAPPO, from a cloned one (``config.init_from``) or from scratch.

    Round by round, the policy flies with noise, advantages are estimated, and policy and critic learn from these
    flights alone. The reward knows nothing of the expert; the error against it is measured all the same.

    Args:
        config: the run's settings, ``config.trainer`` being a `MAPPOConfig`.
        run: the folder to leave metrics and checkpoints in.
        logger: the dashboard.
        expert: what the error is measured against; default: Reynolds flocking.
        callbacks: people's own code.

    Returns:
        the trained policy, the moving average of the weights, by the name of its model.
    """
    settings: MAPPOConfig = config.trainer
    world, sizes = config.env, config.env.sizes
    learner = Improver(initial_policy(config), settings, world.state_key, config.seed)
    expert = expert or Reynolds.for_env(world)
    name = config.model.name
    flocks = [
        FlockCollector(
            world,
            flocks_of(size, config),
            size,
            (learner.actor, expert),
            steps=settings.round_steps,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
        )
        for size in sizes
    ]

    with Journal(
        run, logger, {name: learner}, flocks, settings.iterations, settings, callbacks, unit="rounds"
    ) as journal:
        for index in range(settings.iterations):
            start = 0.0 if config.init_from is None else settings.anchor  # a fresh policy is nothing to stay near to
            anchor = anchor_weight(index - settings.critic_warmup, start, settings.anchor_rounds)
            metrics = {"noise": learner.actor.noise, "anchor": anchor}
            for group in flocks:
                flights = journal.show(index + 1, group.continue_flights())
                metrics |= flight_metrics(flights, world) | reward_metrics(flights, world)
                losses = learner.improve(flights, only_critic=index < settings.critic_warmup, anchor=anchor)
                metrics |= {f"{group.num_agents}/{name}": value for name, value in losses.items()}
            for key in ("reward", "error"):
                metrics[key] = sum(metrics[f"{size}/{key}"] for size in sizes) / len(sizes)
            if journal.note(index + 1, metrics, 1, reward=metrics["reward"], error=metrics["error"]):
                break

    return {name: learner.flown}


def anchor_weight(index: int, start: float, rounds: int) -> float:
    """Weight of the pull towards the first policy in one round: ``start``, fading linearly to 0 over ``rounds``."""
    return start if rounds == 0 else start * min(1.0, max(0.0, 1 - index / rounds))
