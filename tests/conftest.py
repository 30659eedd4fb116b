"""What all tests share: one thread, hypothesis without a clock, and small training runs."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import settings

from modgnn_rl.configs.schema import FlockingConfig, ModelConfig, TrainConfig
from modgnn_rl.registry import TRAINERS

# Small tensors gain nothing from threads, and thread pools of parallel runs fight for the same cores.
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"

# A busy machine is no failure; in CI the same examples are tried every time.
# `--hypothesis-profile=thorough` tries more.
settings.register_profile("default", deadline=None, max_examples=40)
settings.register_profile("ci", deadline=None, max_examples=40, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=500)
settings.load_profile("ci" if os.environ.get("CI") else "default")

# Settings of trainers with which a run takes about a second.
SMALL: dict[str, dict[str, Any]] = {
    "bc": {"num_envs": 1, "batch_size": 16, "cloning_steps": 8, "cloning_updates": 4, "num_val_envs": 2},
    "dagger": {
        "num_envs": 1,
        "batch_size": 16,
        "cloning_steps": 8,
        "cloning_updates": 2,
        "rounds": 3,
        "steps_per_round": 4,
        "updates_per_round": 2,
        "num_val_envs": 1,
    },
    "mappo": {
        "num_envs": 1,
        "rounds": 3,
        "steps_per_round": 4,
        "critic_warmup": 0,
        "epochs": 1,
        "num_minibatches": 1,
        "critic_hidden": 8,
    },
}


@pytest.fixture(scope="session")
def small_config() -> Callable[..., TrainConfig]:
    """Makes configurations of small training runs: ``small_config(runs, "dagger", rounds=2, seed=1)``.

    Settings of the trainer and of the whole run are given alike, by their names.
    """

    def make(runs: Path, trainer: str, **settings: Any) -> TrainConfig:
        names = {field.name for field in dataclasses.fields(TrainConfig)}
        whole = {name: value for name, value in settings.items() if name in names}
        own = {name: value for name, value in settings.items() if name not in names}
        return TrainConfig(
            trainer=TRAINERS[trainer].option("settings")(**{**SMALL[trainer], **own}),
            runs=str(runs),
            threads=1,
            **{"env": FlockingConfig(num_agents=4), "model": ModelConfig(name="pair_force", hidden=8), **whole},
        )

    return make
