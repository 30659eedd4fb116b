"""What every trainer starts from: checked settings, policies, learners."""

from __future__ import annotations

import contextlib
import dataclasses

from modgnn_rl.actions import Discrete
from modgnn_rl.configs.schema import ModelConfig, TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import configured_model
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.task import Task
from modgnn_rl.tracking.loading import load_policy, load_task, stored_model
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.collectors.remote import check_collector
from modgnn_rl.trainers.collectors.rollout_buffer import num_envs_of_size
from modgnn_rl.trainers.imitation.learner import ImitationLearner
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "check_imitation",
    "check_steps",
    "check_training",
    "check_updates",
    "initial_policy",
    "make_learner",
    "members_of",
    "resolve_model",
]


def make_learner(config: TrainConfig, task: Task, updates: tuple[int, int], member: int = 0) -> ImitationLearner:
    """The learner of a run, or one of several that differ in their initial weights.

    Args:
        config: the run's settings.
        task: of the run.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
        member: index of the learner.
    """
    return ImitationLearner(initial_policy(config, task, member), task, config.trainer, updates, config.seed)


def initial_policy(config: TrainConfig, task: Task, member: int = 0) -> ModGNN:
    """The policy that a run starts from, on its device: that of another run, or a new one of ``config.model``.

    Raises:
        InputError: no readable run ``config.init_from``.
    """
    if config.init_from is not None:
        return load_policy(config.init_from, device=config.device).train()
    role = ("model", member) if member else ("model",)
    return configured_model(config.model, task, derive_seed(config.seed, *role)).to(config.device)


def members_of(config: TrainConfig) -> dict[str, TrainConfig]:
    """The settings of each policy that a run trains, by name; several where the trainer has the option ``members``."""
    members = TRAINERS[config.trainer.name].option("members")
    return {config.model.name: config} if members is None else members(config)


def resolve_model(config: TrainConfig, task: Task) -> TrainConfig:
    """The settings with the model that is trained: that of ``init_from``, that of the first of several, or the task's.

    Raises:
        InputError: no readable run ``config.init_from``, or it has another model than the settings name.
    """
    if config.init_from is not None:
        model = stored_model(RunFolder.open(config.init_from))
        if config.model not in (model, ModelConfig()):
            raise InputError(
                f"model={config.model} is not that of init_from={config.init_from}, {model}; leave the model out, it "
                "is taken from there"
            )
        return dataclasses.replace(config, model=model)
    named = dataclasses.replace(config.model, name=config.model.name or task.default_model)
    config = dataclasses.replace(config, model=named)
    return dataclasses.replace(config, model=next(iter(members_of(config).values())).model)


def check_training(config: TrainConfig, task: Task) -> None:
    """Refuse what the ranges of single settings do not, before anything is created.

    Args:
        config: the settings, with the model resolved.
        task: of the run.

    Raises:
        InputError: sizes that repeat or have no agent to train, a model without parameters, several policies that would
            start with the same weights, agents that do not fit into the ball they start in, workers that cannot be
            used, or what the trainer itself refuses (its option ``check``).
    """
    sizes = task.sizes
    if len(set(sizes)) != len(sizes) or min(sizes) < task.min_agents:
        raise InputError(f"env.num_agents={sizes} must list each number once, and none below {task.min_agents}")
    members = list(members_of(config).values())
    if config.init_from is not None and len(members) > 1:
        raise InputError(
            "several policies cannot all start from that of init_from, they would stay equal: leave it out, or train "
            "one policy"
        )
    if config.init_from is not None:
        _check_widths(load_task(RunFolder.open(config.init_from)), task, config.init_from)
    policies = [initial_policy(member, task) for member in members]
    for member, policy in zip(members, policies, strict=True):
        if not list(policy.parameters()):
            raise InputError(f"model.name={member.model.name} with model.hops={member.model.hops} has nothing to learn")
    check = TRAINERS[config.trainer.name].option("check")
    if check is not None:
        check(config, policies, task)
    for size in sizes:
        check_collector(config.collector, num_envs_of_size(config, size))
        with contextlib.closing(task.training_env(1, size, config.seed, "cpu")) as env:
            env.reset()


def _check_widths(old: Task, new: Task, folder: str) -> None:
    """Refuse a policy whose task has other observations or actions."""
    widths = [(task.layout.width, task.actions.width) for task in (old, new)]
    if widths[0] != widths[1]:
        raise InputError(
            f"init_from={folder} is a policy for task '{old.name}', with {widths[0][0]} numbers in an observation and "
            f"{widths[0][1]} in an action; task '{new.name}' has {widths[1][0]} and {widths[1][1]}: start from a run "
            "with the same"
        )


def check_imitation(config: TrainConfig, task: Task) -> None:
    """Refuse to imitate an expert that is not there, and settings that the task's observations or actions exclude."""
    settings, trainer = config.trainer, config.trainer.name
    if task.teacher is None:
        raise InputError(
            f"trainer={trainer} imitates an expert, which task '{task.name}' does not have; use trainer=mappo"
        )
    if settings.hide_velocity and task.layout.vectors < 2:
        raise InputError(
            f"trainer.hide_velocity={settings.hide_velocity} needs observations with a velocity, and those of task "
            f"'{task.name}' have none: set it to 0"
        )
    if isinstance(task.actions, Discrete):
        distances = {"noise": 0.0, "dart": False, "gate": "none"}  # settings that compare or change actions as vectors
        for name, off in distances.items():
            if getattr(settings, name, off) != off:
                raise InputError(
                    f"trainer.{name}={getattr(settings, name)} is for continuous actions, and those of task "
                    f"'{task.name}' are discrete: use trainer.{name}={str(off).lower()}"
                )


def check_updates(config: TrainConfig, name: str) -> None:
    """Refuse fewer updates than there are flock sizes, which share them; ``name`` is the trainer's setting."""
    updates, sizes = getattr(config.trainer, name), len(config.env.sizes)
    if 0 < updates < sizes:
        raise InputError(f"trainer.{name}={updates} is too few for {sizes} flock sizes; give at least one to each")


def check_steps(config: TrainConfig, name: str, needed: int) -> None:
    """Refuse rollouts shorter than the windows that are cut from them; ``name`` is the trainer's setting."""
    steps = getattr(config.trainer, name)
    if steps < needed:
        raise InputError(
            f"trainer.{name}={steps} is too short for this model, whose messages are recomputed from the steps before; "
            f"it needs at least {needed}"
        )
