"""A whole training run: from a configuration to a run folder with a policy and its evaluation table."""

from __future__ import annotations

import logging
from typing import Any

import torch
from omegaconf import OmegaConf

from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, FlockingConfig, TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation import evaluate
from modgnn_rl.loading import load_policy, stored_world
from modgnn_rl.loggers import check_logger, make_logger
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.table import as_json, as_markdown, summarise_flights
from modgnn_rl.trainers.bc import bc
from modgnn_rl.trainers.dagger import dagger

__all__ = ["TRAINERS", "evaluate_policy", "evaluate_run", "prepare_torch", "train"]

TRAINERS = {"bc": bc, "dagger": dagger}


def train(config: TrainConfig) -> RunFolder:
    """Train a policy, evaluate it, and leave everything in a new run folder.

    Raises:
        InputError: a device or a logger that this machine does not have; nothing is created then.
    """
    prepare_torch(config.device, config.threads)
    check_logger(config.logger)
    name = config.name or f"{config.trainer.name}-{config.model.name}"
    run = RunFolder.create(config.runs, name, OmegaConf.to_yaml(OmegaConf.structured(config)))
    print(f"Training in {run.path}")
    logger = make_logger(config.logger, run)
    policy = TRAINERS[config.trainer.name](config, run, logger)
    sizes = _sizes(config.evaluation, config.env)
    tables = evaluate_policy(run, policy, config.env, config.evaluation, sizes, config.device)
    errors = {
        f"evaluation/{size}/{row}/error": figures["error"]["mean"]
        for size, table in tables.items()
        for row, figures in table.items()
    }
    logger.log(int(run.read_metrics()[-1]["step"]), errors)
    where = logger.close()
    if where:
        print(where)
    return run


def evaluate_policy(
    run: RunFolder,
    policy: ModGNN,
    world: FlockingConfig,
    settings: EvaluationConfig,
    sizes: list[int],
    device: str,
) -> dict[int, dict[str, Any]]:
    """Fly a run's policy and the reference policies, and write the table of each size into the run folder.

    Returns:
        for each number of agents, the table that `modgnn_rl.table.summarise_flights` makes.
    """
    tables = {}
    for size in sizes:
        flights = evaluate(
            {run.config["model"]["name"]: policy},
            world,
            num_agents=size,
            num_flocks=settings.num_flocks,
            steps=settings.steps,
            seed=settings.seed,
            device=device,
        )
        tables[size] = summarise_flights(flights, settings.seed)
    about = {"num_flocks": settings.num_flocks, "steps": settings.steps, "seed": settings.seed}
    text = as_markdown(tables, f"{run.path.name}: {settings.num_flocks} flights of {settings.steps} steps")
    run.write("evaluation.json", as_json(tables, about))
    run.write("evaluation.md", text)
    print(f"\n{text}")
    return tables


def evaluate_run(config: EvaluateConfig) -> RunFolder:
    """Evaluate the policy of a finished run.

    Raises:
        InputError: no such run, no readable policy in it, or no such device.
    """
    prepare_torch(config.device, config.threads)
    policy = load_policy(config.run, device=config.device)
    run = RunFolder.open(config.run)
    world = stored_world(run)
    sizes = _sizes(config.evaluation, world)
    evaluate_policy(run, policy, world, config.evaluation, sizes, config.device)
    return run


def prepare_torch(device: str, threads: int) -> None:
    """Choose the number of threads, keep TorchRL's notices off the terminal, and make sure that the device exists.

    Raises:
        InputError: there is no such device.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device={device} cannot be used ({reason}); device=cpu works everywhere") from error


def _sizes(settings: EvaluationConfig, world: FlockingConfig) -> list[int]:
    """The flock sizes to evaluate: those asked for, else those of training."""
    if settings.num_agents is None:
        return world.sizes
    return [settings.num_agents] if isinstance(settings.num_agents, int) else list(settings.num_agents)
