"""MAPPO (Yu et al. 2022): improve a policy by reinforcement learning, with a critic that sees the whole flock."""

from __future__ import annotations

from modgnn_rl.configs.schema import MAPPOConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.flocks import flocks_of, named_flocks
from modgnn_rl.trainers.collectors.local import make_flights
from modgnn_rl.trainers.loop.context import Session
from modgnn_rl.trainers.loop.metrics import flight_metrics, reward_metrics
from modgnn_rl.trainers.loop.setup import initial_policy
from modgnn_rl.trainers.loop.training_loop import Journal
from modgnn_rl.trainers.ppo.learner import Improver
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["mappo"]


def mappo(session: Session) -> dict[str, ModGNN]:
    """Improve a policy by MAPPO, from a cloned one (``config.init_from``) or from scratch.

    Round by round, the policy flies with noise, advantages are estimated, and policy and critic learn from these
    flights alone. The reward knows nothing of the expert; the error against it is measured all the same.

    Args:
        session: the run, ``session.config.trainer`` being a `MAPPOConfig`; the error is against its expert.

    Returns:
        the trained policy, the moving average of the weights, by the name of its model.
    """
    config = session.config
    settings: MAPPOConfig = config.trainer
    world, sizes = config.env, config.env.sizes
    learner = Improver(initial_policy(config), settings, world.state_key, config.seed)
    name = config.model.name
    flocks = {
        size: make_flights(
            config.collector,
            world,
            flocks_of(size, config),
            size,
            (learner.actor, session.expert),
            steps=settings.round_steps,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
        )
        for size in sizes
    }

    with Journal(session, {name: learner}, named_flocks(flocks, {}), settings.iterations, unit="rounds") as journal:
        for index in journal.rounds(1, settings.iterations):
            start = 0.0 if config.init_from is None else settings.anchor  # a fresh policy is nothing to stay near to
            anchor = anchor_weight(index - 1 - settings.critic_warmup, start, settings.anchor_rounds)
            metrics = {"noise": learner.actor.noise, "anchor": anchor, "learning_rate": settings.learning_rate}
            for size, group in flocks.items():
                flights = journal.show(group.continue_flights())
                metrics |= flight_metrics(flights, world) | reward_metrics(flights, world)
                losses = learner.improve(flights, only_critic=index <= settings.critic_warmup, anchor=anchor)
                metrics |= {f"{size}/{name}": value for name, value in losses.items()}
            for key in ("reward", "error"):
                metrics[key] = sum(metrics[f"{size}/{key}"] for size in sizes) / len(sizes)
            scores = {name: -metrics["reward"]}
            journal.note(metrics, 1, scores, reward=metrics["reward"], error=metrics["error"])

    return {name: learner.flown}


def anchor_weight(index: int, start: float, rounds: int) -> float:
    """Weight of the pull towards the first policy in one round: ``start``, fading linearly to 0 over ``rounds``."""
    return start if rounds == 0 else start * min(1.0, max(0.0, 1 - index / rounds))
