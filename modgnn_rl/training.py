"""A whole training run: from a configuration to a run folder with a policy and its evaluation table."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, FlockingConfig, TrainConfig, as_list
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation import evaluate
from modgnn_rl.loading import load_policy, stored_world
from modgnn_rl.loggers import check_logger, make_logger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.settings import check
from modgnn_rl.table import as_markdown, read_tables, summarise_flights
from modgnn_rl.trainers.bc import bc
from modgnn_rl.trainers.callbacks import Callback
from modgnn_rl.trainers.dagger import dagger
from modgnn_rl.trainers.mappo import mappo
from modgnn_rl.trainers.setup import check_training, settle_model

__all__ = ["TRAINERS", "evaluate_policies", "evaluate_run", "prepare_torch", "train"]

TRAINERS = {"bc": bc, "dagger": dagger, "mappo": mappo}


def train(
    config: TrainConfig, *, expert: TensorDictModuleBase | None = None, callbacks: Sequence[Callback] = ()
) -> RunFolder:
    """Train a policy, evaluate it, and leave everything in a new run folder.

    Args:
        config: all settings.
        expert: whom to learn from: any TensorDictModule that reads the environment's keys and writes
            ``("agents", "expert_action")``; default: Reynolds flocking. Errors in the evaluation are against it too.
        callbacks: people's own code, see `modgnn_rl.trainers.callbacks`.

    Raises:
        InputError: a bad setting, or a device or a logger that this machine does not have; nothing is created then.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    check_logger(config.logger)
    config = settle_model(config)
    check_training(config)
    if expert is not None and getattr(config.trainer, "dataset", None):
        raise InputError(
            "trainer.dataset holds the labels of Reynolds flocking, not those of your expert; leave one out"
        )
    name = config.name or f"{config.trainer.name}-{config.model.name}"
    run = RunFolder.create(config.runs, name, OmegaConf.to_yaml(OmegaConf.structured(config)))
    print(f"Training in {run.path}", flush=True)
    logger = make_logger(config.logger, run)
    try:
        policies = TRAINERS[config.trainer.name](config, run, logger, expert=expert, callbacks=callbacks)
        sizes = as_list(config.evaluation.num_agents or config.env.num_agents)
        tables = evaluate_policies(run, policies, config.env, config.evaluation, sizes, config.device, expert=expert)
        errors = {
            f"evaluation/{size}/{row}/error": figures["error"]["mean"]
            for size, table in tables.items()
            for row, figures in table.items()
            if figures["error"] is not None
        }
        logger.log(int(run.read_metrics()[-1]["step"]), errors)
    except KeyboardInterrupt:
        print(f"Stopped; the policy so far is in {run.path}", file=sys.stderr)
        raise
    finally:
        where = logger.close()
        if where:
            print(where)
    return run


def evaluate_policies(
    run: RunFolder,
    policies: Mapping[str, ModGNN],
    world: FlockingConfig,
    settings: EvaluationConfig,
    sizes: list[int],
    device: str,
    changes: str = "",
    expert: TensorDictModuleBase | None = None,
) -> dict[int, dict[str, Any]]:
    """Fly a run's policies and the reference policies, and write the table of each size into the run folder.

    Tables of other sizes that the folder holds already are kept; a world changed since training has files of its own.

    Returns:
        for each number of agents, the table that `modgnn_rl.table.summarise_flights` makes.
    """
    tables = {}
    for size in sizes:
        flights = evaluate(
            policies,
            world,
            num_agents=size,
            num_flocks=settings.num_flocks,
            steps=settings.steps,
            seed=settings.seed,
            device=device,
            expert=expert,
        )
        tables[size] = summarise_flights(flights, settings.seed)
    flown = {"num_flocks": settings.num_flocks, "steps": settings.steps, "seed": settings.seed}
    new = {str(size): {**flown, "rows": table} for size, table in tables.items()}
    title = f"{run.path.name} in a world with {changes}" if changes else run.path.name
    print(f"\n{as_markdown(new, title)}", flush=True)
    file = evaluation_file(run, changes)
    entries = sorted({**read_tables(file), **new}.items(), key=lambda entry: int(entry[0]))
    run.write(file.name, json.dumps(dict(entries), indent=2) + "\n")
    run.write(file.with_suffix(".md").name, as_markdown(dict(entries), title))
    return tables


def evaluation_file(run: RunFolder, changes: str = "") -> Path:
    """Where the figures of an evaluation are, in the world of training or in a changed one; the table is beside them.

    Args:
        run: the run folder.
        changes: ``name=value`` of all that was changed, separated by commas.
    """
    return run.path / (f"evaluation-{changes.replace('/', '_')}.json" if changes else "evaluation.json")


def evaluate_run(config: EvaluateConfig) -> Path:
    """Evaluate the policy of a run, in the world that it was trained in or in another.

    Returns:
        the file of figures.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or no such device.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    policy = load_policy(config.run, device=config.device)
    run = RunFolder.open(config.run)
    changes = {name: value for name, value in vars(config.env).items() if value is not None}
    try:
        world: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(stored_world(run)), changes))
    except OmegaConfBaseException as error:
        raise InputError(f"env.{error.full_key}: {str(error.msg).splitlines()[0]}") from error
    sizes = as_list(config.evaluation.num_agents or world.num_agents)
    named = ",".join(f"{name}={value}" for name, value in sorted(changes.items()))
    evaluate_policies(run, {run.config["model"]["name"]: policy}, world, config.evaluation, sizes, config.device, named)
    return evaluation_file(run, named)


def prepare_torch(device: str, threads: int) -> None:
    """Choose the number of threads, keep TorchRL's notices off the terminal, and make sure that the device exists.

    Raises:
        InputError: there is no such device.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device={device} cannot be used ({reason}); device=cpu works everywhere") from error
