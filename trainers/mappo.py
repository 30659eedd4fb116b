"""MAPPO (Yu et al. 2022): improve a policy by reinforcement learning, with a critic that sees the whole flock."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import MAPPOConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.trainers.collectors.flocks import flocks_of, named_buffers
from modgnn_rl.trainers.collectors.local import make_collector
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.metrics import reward_metrics, rollout_metrics
from modgnn_rl.trainers.loop.setup import check_steps, initial_policy
from modgnn_rl.trainers.loop.training_loop import TrainingLoop
from modgnn_rl.trainers.ppo.learner import PPOLearner, ppo_window
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["mappo"]


def check_mappo(config: TrainConfig, policies: Sequence[ModGNN], expert: TensorDictModuleBase | None) -> None:
    """Refuse rollouts that are too short."""
    check_steps(config, "steps_per_round", ppo_window(policies[0], config.trainer)[1])


@TRAINERS.register("mappo", settings=MAPPOConfig, objective="reward", check=check_mappo)
def mappo(context: TrainContext) -> dict[str, ModGNN]:
    """Improve a policy by MAPPO, from a cloned one (``config.init_from``) or from scratch.

    Round by round, the policy flies with noise, advantages are estimated, and policy and critic learn from these
    rollouts alone. The reward knows nothing of the expert; the error against it is measured all the same.

    Args:
        context: the run, ``context.config.trainer`` being a `MAPPOConfig`; the error is against its expert.

    Returns:
        the trained policy, the moving average of the weights, by the name of its model.
    """
    config = context.config
    settings: MAPPOConfig = config.trainer
    env_config, sizes = config.env, config.env.sizes
    learner = PPOLearner(initial_policy(config), settings, env_config.state_key, config.seed)
    name = config.model.name
    flocks = {
        size: make_collector(
            config.collector,
            env_config,
            flocks_of(size, config),
            size,
            (learner.actor, context.expert),
            steps=settings.steps_per_round,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
        )
        for size in sizes
    }

    with TrainingLoop(context, {name: learner}, named_buffers(flocks, {}), settings.rounds, unit="rounds") as loop:
        for index in loop.rounds(1, settings.rounds):
            start = 0.0 if config.init_from is None else settings.kl_coef  # a fresh policy is nothing to stay near to
            anchor = anchor_weight(index - 1 - settings.critic_warmup, start, settings.kl_rounds)
            metrics = {"noise": learner.actor.noise, "kl_coef": anchor, "learning_rate": settings.learning_rate}
            for size, group in flocks.items():
                rollouts = loop.on_collect(group.collect())
                metrics |= rollout_metrics(rollouts, env_config) | reward_metrics(rollouts, env_config)
                losses = learner.update(rollouts, only_critic=index <= settings.critic_warmup, anchor=anchor)
                metrics |= {f"{size}/{name}": value for name, value in losses.items()}
            for key in ("reward", "error"):
                metrics[key] = sum(metrics[f"{size}/{key}"] for size in sizes) / len(sizes)
            scores = {name: -metrics["reward"]}
            loop.log(metrics, 1, scores, reward=metrics["reward"], error=metrics["error"])

    return {name: learner.ema_policy}


def anchor_weight(index: int, start: float, rounds: int) -> float:
    """Weight of the pull towards the first policy in one round: ``start``, fading linearly to 0 over ``rounds``."""
    return start if rounds == 0 else start * min(1.0, max(0.0, 1 - index / rounds))
