"""MAPPO of BenchMARL and of modgnn_rl on the same VMAS scenarios: return, wall time and frames a second.

    python -m venv /tmp/peer && /tmp/peer/bin/pip install benchmarl vmas      # it needs an older TorchRL
    python benchmarks/peers.py --benchmarl /tmp/peer/bin/python

Both see the same number of frames, in batches of as many environments and steps, with as many passes and minibatches,
networks of about as many weights, and one thread. Ours is ``modgnn_mlp`` without communication (K = 0), as BenchMARL's
network has none, and with one hop (K = 1). Evaluation: 64 episodes of the final policy without noise.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from modgnn_rl import load_policy, make_task
from modgnn_rl.configs.schema import MAPPOConfig, ModelConfig, TrainConfig
from modgnn_rl.envs.vmas import VmasConfig
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.evaluation.statistics import interquartile_interval
from modgnn_rl.experiment.training import train

AGENTS, STEPS, NUM_ENVS, EPOCHS, MINIBATCHES, EPISODES = 4, 100, 60, 10, 15, 64


def ours(hops: int, scenario: str, seed: int, frames: int) -> dict[str, Any]:
    """Train with modgnn_rl; returns seconds and the return of each episode."""
    torch.set_num_threads(1)
    env = VmasConfig(scenario=scenario, num_agents=AGENTS, max_steps=STEPS, comm_range=2.0)
    trainer = MAPPOConfig(
        num_envs=NUM_ENVS,
        steps_per_round=STEPS,
        rounds=frames // (NUM_ENVS * STEPS),
        epochs=EPOCHS,
        num_minibatches=MINIBATCHES,
        agents_per_state=AGENTS,
        critic_warmup=0,
        critic_hidden=32,
        noise=0.6,
        gae_lambda=0.9,
    )
    with tempfile.TemporaryDirectory() as folder:
        model = ModelConfig(name="modgnn_mlp", hops=hops)
        config = TrainConfig(env=env, model=model, trainer=trainer, seed=seed, runs=folder)
        start = time.perf_counter()
        run = train(config, evaluate=False)
        seconds = time.perf_counter() - start
        policy = load_policy(run.path)
    metrics = rollout(policy, make_task(env), num_agents=AGENTS, num_flocks=EPISODES, steps=STEPS, seed=seed + 1000)
    return {"seconds": seconds, "returns": metrics["reward"].tolist(), "parameters": policy.num_parameters}


def benchmarl(python: str, scenario: str, seed: int, frames: int) -> dict[str, Any]:
    """The same with BenchMARL, in another environment."""
    script = Path(__file__).with_name("peers_benchmarl.py")
    numbers = {
        "seed": seed, "frames": frames, "num-envs": NUM_ENVS, "steps": STEPS, "agents": AGENTS, "epochs": EPOCHS,
        "minibatches": MINIBATCHES, "episodes": EPISODES,
    }  # fmt: skip
    options = [word for name, value in numbers.items() for word in (f"--{name}", str(value))]
    done = subprocess.run([python, str(script), scenario, *options], check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main(python: str | None, scenarios: list[str], seeds: int, frames: int) -> None:
    """Print a table, a row for each scenario and program."""
    print(f"{frames:,} frames, {seeds} seeds, {EPISODES} episodes each, one thread, torch {torch.__version__}")
    print("| scenario | program | weights | return, IQM [95 %] | each seed | s | frames/s |")
    print("|---|---|---|---|---|---|---|")
    programs: dict[str, Callable[[str, int, int], dict[str, Any]]] = {
        f"modgnn_rl, K = {hops}": functools.partial(ours, hops) for hops in (0, 1)
    }
    if python is not None:
        programs["BenchMARL"] = functools.partial(benchmarl, python)
    for scenario in scenarios:
        for name, program in programs.items():
            runs = [program(scenario, seed, frames) for seed in range(seeds)]
            interval = interquartile_interval(np.array([run["returns"] for run in runs]), rng=np.random.default_rng(0))
            means = ", ".join(f"{np.mean(run['returns']):.1f}" for run in runs)
            seconds = float(np.mean([run["seconds"] for run in runs]))
            cells = [scenario, name, f"{runs[0]['parameters']:,}"]
            cells += [f"{interval.value:.1f} [{interval.low:.1f}, {interval.high:.1f}]", means, f"{seconds:.0f}"]
            print(f"| {' | '.join(cells)} | {frames / seconds:,.0f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--benchmarl", help="Python of an environment with BenchMARL; without it only ours is run")
    parser.add_argument("--scenarios", nargs="+", default=["balance", "navigation"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=120_000)
    arguments = parser.parse_args()
    main(arguments.benchmarl, arguments.scenarios, arguments.seeds, arguments.frames)
