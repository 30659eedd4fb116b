"""Every task with every trainer, for about a minute each: returns of the policies beside expert and reference rows.

    python benchmarks/tasks.py                       # a quarter of an hour on one core; needs modgnn-rl[vmas]
    python benchmarks/tasks.py --tasks coverage transport --trainers dagger

Each row is also one command; with more rounds policies come closer to the expert, or past it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from typing import Any

from modgnn_rl.configs.schema import EvaluationConfig, TrainConfig
from modgnn_rl.experiment.training import train
from modgnn_rl.registry import TASKS, TRAINERS

SCENARIOS = ("navigation", "flocking", "balance", "wheel", "transport", "discovery")
ENVS: dict[str, dict[str, Any]] = {"coverage": {}} | {
    scenario: {"name": "vmas", "scenario": scenario, "max_steps": 100, "comm_range": 2.0} for scenario in SCENARIOS
}
SETTINGS: dict[str, dict[str, Any]] = {
    "bc": {"num_envs": 32, "cloning_steps": 100, "cloning_updates": 2000, "batch_size": 128},
    "dagger": {
        "num_envs": 16, "cloning_steps": 100, "cloning_updates": 300, "rounds": 30, "steps_per_round": 50,
        "updates_per_round": 50, "batch_size": 128,
    },
    "mappo": {
        "num_envs": 32, "steps_per_round": 100, "rounds": 25, "epochs": 10, "num_minibatches": 8, "noise": 0.6,
        "critic_warmup": 0,
    },
}  # fmt: skip


def command(env: dict[str, Any], trainer: str) -> str:
    """The command line of a row."""
    name = env.get("name", "coverage")
    words = [f"env={name}", *(f"env.{key}={value}" for key, value in env.items() if key != "name")]
    words += [f"trainer={trainer}", *(f"trainer.{key}={value}" for key, value in SETTINGS[trainer].items())]
    return f"python -m modgnn_rl.train {' '.join(words)}"


def measure(env: dict[str, Any], trainer: str) -> dict[str, dict[str, Any]]:
    """Train and evaluate; returns the rows of the evaluation table by policy."""
    kind = TASKS[env.get("name", "coverage")].option("settings")
    settings = TRAINERS[trainer].option("settings")(**SETTINGS[trainer])
    with tempfile.TemporaryDirectory() as runs, contextlib.redirect_stdout(io.StringIO()):
        evaluation = EvaluationConfig(num_flocks=32)
        run = train(TrainConfig(env=kind(**env), trainer=settings, evaluation=evaluation, runs=runs, threads=1))
        tables = json.loads((run.path / "evaluation.json").read_text(encoding="utf-8"))
    (table,) = tables.values()
    rows: dict[str, dict[str, Any]] = table["rows"]
    return rows


def main(tasks: list[str], trainers: list[str]) -> None:
    """Print the table, then the commands."""
    print("| task | trainer | policy's return [95 %] | expert's | doing nothing | error | success |")
    print("|---|---|---|---|---|---|---|")
    for task in tasks:
        for trainer in trainers:
            rows = measure(ENVS[task], trainer)
            (name,) = set(rows) - {"expert", "zero action"}
            reward = rows[name]["reward"]
            cells = [task, trainer, f"{reward['mean']:.2f} [{reward['low']:.2f}, {reward['high']:.2f}]"]
            cells += [f"{rows[other]['reward']['mean']:.2f}" for other in ("expert", "zero action")]
            cells += [f"{rows[name]['error']['mean']:.3f}"]
            cells += [f"{rows[name]['success']['mean']:.0%}" if "success" in rows[name] else "-"]
            print(f"| {' | '.join(cells)} |", flush=True)
    print("\nThe commands:\n")
    for trainer in trainers:
        print(command(ENVS[tasks[0]], trainer))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(ENVS), choices=list(ENVS))
    parser.add_argument("--trainers", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    arguments = parser.parse_args()
    main(arguments.tasks, arguments.trainers)
