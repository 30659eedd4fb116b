"""Duration of an imitation update for several models, and the speedup of training several seeds stacked.

    python benchmarks/trainer_speed.py

One thread, processor time, medians of interleaved runs; flocks of 32 agents in which the expert acts.
"""

from __future__ import annotations

import functools
import platform
import statistics
import time
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from modgnn_rl import ModGNN, make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer
from modgnn_rl.trainers.imitation.learner import ImitationLearner
from modgnn_rl.trainers.imitation.loss import imitation_loss, stacked_losses
from modgnn_rl.utils.device import prepare_torch

REPETITIONS = 9
# Model, layers, states per batch, agents per state that count.
UPDATES = (
    ("pair_force", 1, 256, 4),
    ("moment_force", 2, 256, 4),
    ("pair_force", 2, 64, 16),
    ("pair_force", 2, 256, 4),
)
SEEDS = 5
BATCHES = ((4, 4), (8, 16), (32, 1), (32, 2), (32, 4), (32, 8))  # agents, windows


def interleaved(runs: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Median processor time of each (ms)."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(REPETITIONS + 1):  # the first is a warm-up
        for name, run in runs.items():
            start = time.process_time()
            run()
            times[name].append(1000 * (time.process_time() - start))
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def collected(policies: list[ModGNN], settings: DAggerConfig, num_agents: int = 32) -> ReplayBuffer:
    """Data for these policies, from rollouts of the expert."""
    spec = RolloutSpec(FlockingTask(FlockingConfig()).training_env, 16, num_agents, steps=40, seed=0)
    data = make_buffer(spec, settings, policies, Reynolds(), hold_steps=40)
    data.extend(data.collect(beta=1.0))
    data.close()
    return data.buffer


def updates() -> None:
    """Print the duration of an update for each model."""
    runs = {}
    for name, layers, batch, receivers in UPDATES:
        settings = DAggerConfig(batch_size=batch, agents_per_state=receivers, capacity=2000)
        learner = ImitationLearner(
            make_model(name, layers=layers, seed=0), FlockingTask(FlockingConfig()), settings, (100, 100), seed=0
        )
        data = collected([learner.ema_policy], settings)
        runs[f"{name}, {layers} layer(s), {batch} x {receivers}"] = functools.partial(learner.fit, data, 1)
    times = interleaved(runs)
    first = next(iter(times.values()))
    print("| update, states x receivers | ms | times |\n|---|---:|---:|")
    for label, value in times.items():
        print(f"| {label} | {value:.0f} | {value / first:.1f} |", flush=True)


def one_by_one(policies: list[ModGNN], batch: TensorDictBase, receivers: torch.Tensor) -> None:
    """Compute the gradients of policies one after the other."""
    for policy in policies:
        imitation_loss(policy, batch, receivers).backward()


def seeds() -> None:
    """Print how much faster several seeds of one model train stacked, by the size of a batch of windows."""
    print(f"\n| {SEEDS} seeds at once, windows x agents | " + " | ".join(f"{b} x {n}" for n, b in BATCHES) + " |")
    print("|---|" + "---:|" * len(BATCHES))
    for name in ("modgnn_mlp", "pair_force", "gcn"):
        cells = []
        for agents, windows in BATCHES:
            policies = [make_model(name, seed=seed) for seed in range(SEEDS)]
            batch = collected(
                policies, DAggerConfig(batch_size=windows, capacity=2000, hide_velocity=0.5), agents
            ).sample()
            receivers = batch["agents", "controlled"][:, -1]
            times = interleaved(
                {
                    "loop": functools.partial(one_by_one, policies, batch, receivers),
                    "at once": functools.partial(stacked_losses, policies, batch, receivers),
                }
            )
            cells.append(f"{times['loop'] / times['at once']:.1f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    prepare_torch("cpu", 1)
    print(f"torch {torch.__version__}, {platform.machine()}, one thread; speedup of stacking in the second table\n")
    updates()
    seeds()
