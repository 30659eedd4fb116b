"""What every imitation trainer starts from: policy, learner, expert."""

from __future__ import annotations

import contextlib

from modgnn_rl.configs.schema import BCConfig, ImitationConfig, TrainConfig
from modgnn_rl.dataset import FlightDataset
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.errors import InputError
from modgnn_rl.models import configured_model
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.learner import Learner

__all__ = ["check_training", "make_learner"]


def make_learner(config: TrainConfig, updates: tuple[int, int]) -> Learner:
    """The learner of a run: a fresh policy of ``config.model`` on the run's device.

    Args:
        config: the run's settings.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
    """
    policy = configured_model(config.model, config.env, derive_seed(config.seed, "model"))
    return Learner(policy.to(config.device), config.trainer, updates, config.seed)


def check_training(config: TrainConfig) -> None:
    """Refuse what the ranges of single settings do not, before anything is created.

    Raises:
        InputError: sizes that repeat or hold no agent to train, too few updates for the sizes, a model with nothing to
            learn, agents that do not fit into the ball they start in, or a dataset that is damaged or does not fit.
    """
    settings: ImitationConfig = config.trainer
    sizes = config.env.sizes
    if len(set(sizes)) != len(sizes) or min(sizes) < 2:
        raise InputError(
            f"env.num_agents={sizes} must name each size once, and none below 2: the leader is not trained"
        )
    for name in ("cloning_updates", "round_updates"):
        updates = getattr(settings, name, None)
        if updates and updates < len(sizes):
            raise InputError(f"trainer.{name}={updates} is too few for {len(sizes)} sizes; give at least one to each")
    if not list(make_learner(config, (0, 0)).policy.parameters()):
        raise InputError(f"model.name={config.model.name} with model.hops={config.model.hops} has nothing to learn")
    for size in sizes:
        with contextlib.closing(FlockingEnv(1, size, config=config.env, seed=config.seed)) as env:
            env.reset()
    if isinstance(settings, BCConfig) and settings.dataset:
        dataset = FlightDataset.open(settings.dataset)
        dataset.check_world(config.env)
        if dataset.episodes <= settings.held_out:
            raise InputError(
                f"trainer.held_out={settings.held_out} leaves nothing to train on of the {dataset.episodes} episodes "
                f"in {settings.dataset}; lower it, or collect more"
            )
