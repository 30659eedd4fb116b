"""What every trainer starts from: a configuration that makes sense, policies, learners."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

from modgnn_rl.configs.schema import (
    BCConfig,
    DAggerConfig,
    MAPPOConfig,
    ModelConfig,
    TrainConfig,
    TrainerConfig,
    as_list,
)
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import configured_model
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.loading import load_policy, stored_model
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.collectors.flocks import flocks_of
from modgnn_rl.trainers.collectors.remote import check_collector
from modgnn_rl.trainers.collectors.windows import window_of
from modgnn_rl.trainers.imitation.learner import ImitationLearner
from modgnn_rl.trainers.ppo.learner import ppo_window
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["DART_PARTS", "check_training", "initial_policy", "make_learner", "resolve_model", "side_by_side"]

DART_PARTS = 4  # parts of the rollouts between which the noise is set anew


def make_learner(config: TrainConfig, updates: tuple[int, int], member: int = 0) -> ImitationLearner:
    """The learner of a run, or one of several that differ in the weights that they begin with.

    Args:
        config: the run's settings.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
        member: which of several.
    """
    return ImitationLearner(initial_policy(config, member), config.trainer, updates, config.seed)


def initial_policy(config: TrainConfig, member: int = 0) -> ModGNN:
    """The policy that a run begins with: that of another run, or a fresh one of ``config.model``; on the run's device.

    Raises:
        InputError: no readable run ``config.init_from``.
    """
    if config.init_from is not None:
        return load_policy(config.init_from, device=config.device).train()
    role = ("model", member) if member else ("model",)
    return configured_model(config.model, config.env, derive_seed(config.seed, *role)).to(config.device)


def side_by_side(config: TrainConfig) -> dict[str, TrainConfig]:
    """The settings of each policy that behaviour cloning trains at once, by name: model, hops, seed.

    One policy goes by the name of its model.
    """
    settings: BCConfig = config.trainer
    alone = dataclasses.replace(settings, models=None, hops=None, seeds=1)
    members = {}
    for name in as_list(settings.models or config.model.name):
        for hops in as_list(config.model.hops if settings.hops is None else settings.hops):
            for seed in range(settings.seeds):
                members[f"{name}-K{hops}" + (f"-seed{seed}" if settings.seeds > 1 else "")] = dataclasses.replace(
                    config,
                    trainer=alone,
                    model=dataclasses.replace(config.model, name=name, hops=hops),
                    seed=derive_seed(config.seed, "member", seed) if seed else config.seed,
                )
    return members if len(members) > 1 else {member.model.name: member for member in members.values()}


def resolve_model(config: TrainConfig) -> TrainConfig:
    """The settings with the model of the run that training begins with, or the first of several trained side by side.

    Raises:
        InputError: no readable run ``config.init_from``, or another model was asked for, or several.
    """
    if isinstance(config.trainer, BCConfig) and (config.trainer.models, config.trainer.hops) != (None, None):
        if config.init_from is not None:
            raise InputError(
                "trainer.models and trainer.hops name fresh policies, init_from one that is there; leave out one or "
                "the other"
            )
        return dataclasses.replace(config, model=next(iter(side_by_side(config).values())).model)
    if config.init_from is None:
        return config
    model = stored_model(RunFolder.open(config.init_from))
    if config.model not in (model, ModelConfig()):
        raise InputError(
            f"model={config.model} is not that of init_from={config.init_from}, {model}; leave the model out, it comes "
            "from there"
        )
    return dataclasses.replace(config, model=model)


def _members(config: TrainConfig) -> list[TrainConfig]:
    """The settings of each policy that is trained."""
    settings = config.trainer
    if isinstance(settings, DAggerConfig) and settings.gate == "ensemble":
        return [config] * settings.ensemble
    return list(side_by_side(config).values()) if isinstance(settings, BCConfig) else [config]


def _check_flights(settings: TrainerConfig, policies: Sequence[ModGNN]) -> None:
    """Refuse rollouts shorter than the windows that are cut from them."""
    if isinstance(settings, MAPPOConfig):
        name, steps, needed = "steps_per_round", settings.steps_per_round, ppo_window(policies[0], settings)[1]
    elif isinstance(settings, DAggerConfig):
        name, steps, needed = "steps_per_round", settings.steps_per_round, window_of(policies, settings)
    elif isinstance(settings, BCConfig) and not settings.dataset:
        parts = DART_PARTS if settings.dart else 1
        name, steps, needed = "cloning_steps", settings.cloning_steps, parts * window_of(policies, settings)
    else:
        return
    if steps < needed:
        raise InputError(
            f"trainer.{name}={steps} is too short for this model, whose messages are made anew from the steps before; "
            f"it needs at least {needed}"
        )


def check_training(config: TrainConfig) -> None:
    """Refuse what the ranges of single settings do not, before anything is created.

    Raises:
        InputError: sizes that repeat or hold no agent to train, too few updates for the sizes, a model with nothing to
            learn, several policies that would begin alike, rollouts too short to learn from, agents that do not fit
            into the ball they start in, or a dataset that is damaged or does not fit.
    """
    settings: TrainerConfig = config.trainer
    sizes = config.env.sizes
    if len(set(sizes)) != len(sizes) or min(sizes) < 2:
        raise InputError(
            f"env.num_agents={sizes} must name each size once, and none below 2: the leader is not trained"
        )
    for name in ("cloning_updates", "updates_per_round"):
        updates = getattr(settings, name, None)
        if updates and updates < len(sizes):
            raise InputError(f"trainer.{name}={updates} is too few for {len(sizes)} sizes; give at least one to each")
    if config.init_from is not None and len(_members(config)) > 1:
        raise InputError(
            "several policies cannot all begin with that of init_from, and stay alike: leave it out, or train one"
        )
    members = _members(config)
    policies = [initial_policy(member) for member in members]
    for member, policy in zip(members, policies, strict=True):
        if not list(policy.parameters()):
            raise InputError(f"model.name={member.model.name} with model.hops={member.model.hops} has nothing to learn")
    _check_flights(settings, policies)
    for size in sizes:
        check_collector(config.collector, flocks_of(size, config))
        with contextlib.closing(FlockingEnv(1, size, config=config.env, seed=config.seed)) as env:
            env.reset()
    if isinstance(settings, BCConfig) and settings.dataset:
        dataset = EpisodeDataset.open(settings.dataset)
        dataset.check_world(config.env)
        if dataset.episodes <= settings.num_val_envs:
            raise InputError(
                f"trainer.num_val_envs={settings.num_val_envs} leaves nothing to train on of the "
                f"{dataset.episodes} episodes "
                f"in {settings.dataset}; lower it, or collect more"
            )
