"""Behaviour cloning: fit the expert's actions on the expert's own flights, as the paper did."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.data import ReplayBuffer

from modgnn_rl.checkpoint import save_checkpoint
from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.dataset import FlightDataset
from modgnn_rl.evaluation import fly
from modgnn_rl.experts import Reynolds
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.callbacks import Callback
from modgnn_rl.trainers.collection import Flocks, flocks_of_all_sizes
from modgnn_rl.trainers.journal import Journal
from modgnn_rl.trainers.learner import Learner, fit_together, validate_together
from modgnn_rl.trainers.setup import DART_PARTS, make_learner, side_by_side

__all__ = ["bc"]

ROUNDS = 40  # parts of the training after each of which the loss is looked at
FLIGHT_ROUNDS = 20  # parts after which the policies fly
FLIGHT_STEPS = 250  # how long


def bc(
    config: TrainConfig,
    run: RunFolder,
    logger: GuardedLogger,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
) -> dict[str, ModGNN]:
    """Train policies by behaviour cloning, one or several side by side on the same batches.

    The expert's flights come from a dataset, or are flown first. The validation error is taken on flights that are not
    trained on. It says little of how a policy flies: it never meets the states that its own errors lead to.

    Args:
        config: the run's settings, ``config.trainer`` being a `BCConfig`.
        run: the folder to leave metrics and checkpoints in; with several policies, a run folder of each lies in it.
        logger: the dashboard.
        expert: writes ``("agents", "expert_action")``; default: Reynolds flocking.
        callbacks: people's own code.

    Returns:
        the trained policies, the moving averages of the weights, by name.
    """
    settings: BCConfig = config.trainer
    sizes = config.env.sizes
    rounds = min(ROUNDS, settings.cloning_updates // len(sizes))
    fitting = settings.cloning_updates // (rounds * len(sizes))
    updates = rounds * fitting * len(sizes)
    members = side_by_side(config)
    by_name = {name: make_learner(member, (updates, updates)) for name, member in members.items()}
    learners, policies = list(by_name.values()), [learner.flown for learner in by_name.values()]
    expert = expert or Reynolds.for_env(config.env)
    parts = DART_PARTS if settings.dart else 1
    flown: dict[str, Any] = {"steps": max(1, settings.cloning_steps // parts), "stretch": settings.cloning_steps}
    held_out = dataclasses.replace(settings, num_envs=settings.held_out)
    unseen_config = dataclasses.replace(config, trainer=held_out, seed=derive_seed(config.seed, "validation"))
    validation = flocks_of_all_sizes(unseen_config, policies, expert, **flown)
    training = [] if settings.dataset else flocks_of_all_sizes(config, policies, expert, **flown)
    flights_at = [part * rounds // parts for part in range(parts)]
    noise, loss = settings.noise, 0.0

    with (
        _own_folders(run, members, by_name),
        Journal(run, logger, by_name, [*training, *validation], updates, settings, callbacks) as journal,
    ):
        if settings.dataset:
            buffers = [_share(settings.dataset, settings, validation[0], max(policy.window for policy in policies))]
        else:
            for group in validation:
                for _ in range(parts):
                    group.keep(group.fly(expert_share=1.0))
            buffers = [group.buffer for group in training]
        for index in range(rounds):
            for group in training * flights_at.count(index):
                group.disturbance.scale = noise = loss**0.5 if settings.dart and index else settings.noise
                group.keep(journal.show(index + 1, group.fly(expert_share=1.0)))
            metrics = {"learning_rate": learners[0].learning_rate, "noise": noise}
            losses = []
            for buffer, unseen in zip(buffers, validation, strict=True):
                found = {
                    "loss": fit_together(learners, buffer, fitting),
                    "validation_loss": validate_together(learners, unseen.buffer),
                }
                losses += found["validation_loss"]
                for name, values in found.items():
                    metrics |= _named(by_name, f"{unseen.num_agents}/{name}", values)
                if (index + 1) % FLIGHT_ROUNDS == 0:
                    metrics |= _errors_in_flight(config, by_name, unseen.num_agents, expert)
            loss = sum(losses) / len(losses)
            if journal.note(index + 1, metrics, fitting * len(sizes), validation_loss=loss):
                break

    return dict(zip(by_name, policies, strict=True))


@contextlib.contextmanager
def _own_folders(run: RunFolder, members: Mapping[str, TrainConfig], by_name: Mapping[str, Learner]) -> Iterator[None]:
    """At the end, after Ctrl-C too, give each of several policies a run folder of its own inside the run's."""
    try:
        yield
    finally:
        for name, member in members.items() if len(members) > 1 else ():
            own = RunFolder.create_inside(run, name, OmegaConf.to_yaml(OmegaConf.structured(member)))
            learner = by_name[name]
            save_checkpoint(own.checkpoints, learner.updates_done, {"policy": learner.flown.state_dict()}, {})


def _named(by_name: dict[str, Any], metric: str, values: Sequence[float]) -> dict[str, float]:
    """One metric of each policy; if there are several, it begins with the policy's name."""
    if len(by_name) == 1:
        return {metric: values[0]}
    return {f"{name}/{metric}": value for name, value in zip(by_name, values, strict=True)}


def _errors_in_flight(
    config: TrainConfig, by_name: dict[str, Any], size: int, expert: TensorDictModuleBase
) -> dict[str, float]:
    """The error of each policy on short flights of its own, from the same starts."""
    settings: BCConfig = config.trainer
    flights = [
        fly(
            learner.flown,
            config.env,
            num_agents=size,
            num_flocks=settings.held_out,
            steps=min(FLIGHT_STEPS, settings.cloning_steps),
            seed=derive_seed(config.seed, "validation"),
            device=config.device,
            expert=expert,
        )
        for learner in by_name.values()
    ]
    return _named(by_name, f"{size}/error", [float(flight.error.mean()) for flight in flights])


def _share(path: str, settings: BCConfig, unseen: Flocks, window: int) -> ReplayBuffer:
    """Share a dataset's flights: the last ``held_out`` become the data of ``unseen``, the others are returned.

    A dataset holds no messages: windows make them anew.
    """
    dataset = FlightDataset.open(path, verify=False, device=unseen.env.device)  # `check_training` has verified it
    seen = dataset.episodes - settings.held_out
    draws: dict[str, Any] = {
        "length": window,
        "batch_size": settings.batch_size,
        "generator": unseen.buffer._rng,  # checkpoints hold it
    }
    unseen.buffer = dataset.buffer(episodes=range(seen, dataset.episodes), **draws)
    return dataset.buffer(episodes=range(seen), **draws)
