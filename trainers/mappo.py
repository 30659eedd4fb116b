"""MAPPO (Yu et al. 2022): reinforcement learning with a critic that sees the whole flock."""

from __future__ import annotations

from collections.abc import Sequence

from modgnn_rl.configs.schema import MAPPOConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.task import Task
from modgnn_rl.trainers.collectors.remote import make_collector
from modgnn_rl.trainers.collectors.rollout_buffer import training_spec
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.metrics import mean_over_sizes, reward_metrics, rollout_metrics
from modgnn_rl.trainers.loop.setup import check_steps, initial_policy
from modgnn_rl.trainers.loop.training_loop import TrainingLoop
from modgnn_rl.trainers.ppo.actor import GaussianActor
from modgnn_rl.trainers.ppo.learner import PPOLearner, ppo_window

__all__ = ["kl_coef_of_round", "mappo"]


def check_mappo(config: TrainConfig, policies: Sequence[ModGNN], task: Task) -> None:
    """Refuse rollouts that are too short."""
    check_steps(config, "steps_per_round", ppo_window(policies[0], config.trainer)[1])


@TRAINERS.register("mappo", settings=MAPPOConfig, objective="reward", check=check_mappo, fixed=("critic_hidden",))
def mappo(context: TrainContext) -> dict[str, ModGNN]:
    """Improve a policy with MAPPO, from a pretrained policy (``config.init_from``) or from scratch.

    In every round the policy acts with noise, advantages are estimated, and policy and critic are updated on these
    rollouts alone. The reward does not involve the expert; the error against it is only measured.

    Args:
        context: the run, ``context.config.trainer`` being a `MAPPOConfig`.

    Returns:
        the trained policy, the moving average of the weights, by the name of its model.
    """
    config, settings, task = context.config, context.config.trainer, context.task
    learner = PPOLearner(initial_policy(config, task), task, settings, config.seed)
    specs = {size: training_spec(config, task, size, settings.steps_per_round) for size in task.sizes}
    behaviour = [learner.actor] if task.teacher is None else [learner.actor, task.teacher]
    collectors = {size: make_collector(spec, behaviour, config.collector) for size, spec in specs.items()}

    name = config.model.name
    with TrainingLoop(context, {name: learner}, collectors, total=settings.rounds, unit="rounds") as loop:
        for index in loop.rounds(1, settings.rounds):
            kl_coef = 0.0 if config.init_from is None else kl_coef_of_round(settings, index)
            metrics = {"kl_coef": kl_coef, "learning_rate": settings.learning_rate}
            if isinstance(learner.actor, GaussianActor):
                metrics["noise"] = learner.actor.noise
            for size, collector in collectors.items():
                rollouts = loop.on_collect(collector.collect())
                metrics |= rollout_metrics(rollouts, task) | reward_metrics(rollouts, task)
                losses = learner.update(rollouts, kl_coef=kl_coef, critic_only=index <= settings.critic_warmup)
                metrics |= {f"{size}/{key}": value for key, value in losses.items()}
            shown = {
                key: mean_over_sizes(metrics, key, task.sizes) for key in ("reward", "error") if key in task.metrics
            }
            loop.log(metrics | shown, 1, {name: -shown["reward"]}, **shown)

    return {name: learner.ema_policy}


def kl_coef_of_round(settings: MAPPOConfig, index: int) -> float:
    """The weight of the KL penalty in a round: ``kl_coef``, which decays to 0 over ``kl_rounds`` after the warm-up.

    Args:
        settings: of the trainer.
        index: number of the round, from 1.
    """
    if settings.kl_rounds == 0:
        return settings.kl_coef
    done = (index - 1 - settings.critic_warmup) / settings.kl_rounds
    return settings.kl_coef * min(1.0, max(0.0, 1 - done))
