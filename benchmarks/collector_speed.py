"""Speed of collecting rollouts in this process, in worker processes and on Ray.

    python benchmarks/collector_speed.py

Rollouts of moment_force with the expert's labels, as in a training run; 32 flocks of 32 agents, two workers with one
thread each. The collectors run in turn; medians.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import statistics
import time
from importlib.metadata import version

from modgnn_rl import make_model
from modgnn_rl.configs.schema import CollectorConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.trainers.collectors.remote import RemoteCollector, make_collector
from modgnn_rl.utils.device import prepare_torch

FLOCKS, AGENTS, STEPS, WORKERS = 32, 32, 40, 2
REPETITIONS = 5


def make(name: str, physics: str) -> LocalCollector | RemoteCollector:
    """A collector by name."""
    spec = RolloutSpec(FlockingTask(FlockingConfig(physics=physics)).training_env, FLOCKS, AGENTS, STEPS, seed=0)
    behaviour = (make_model("moment_force", seed=0), Reynolds())
    return make_collector(spec, behaviour, CollectorConfig(name, workers=WORKERS))


def speeds(names: list[str], physics: str) -> dict[str, float]:
    """Flock steps per second of each collector; all exist at once, and one runs at a time."""
    collectors = {name: make(name, physics) for name in names}
    times: dict[str, list[float]] = {name: [] for name in names}
    try:
        for _ in range(REPETITIONS + 1):  # the first starts them
            for name, collector in collectors.items():
                start = time.perf_counter()
                collector.collect()
                times[name].append(time.perf_counter() - start)
    finally:
        for collector in collectors.values():
            collector.close()
    return {name: FLOCKS * STEPS / statistics.median(values[1:]) for name, values in times.items()}


def main() -> None:
    """Print a table."""
    prepare_torch("cpu", 1)
    names = ["single", "process", *(["ray"] if importlib.util.find_spec("ray") else [])]
    packages = ["torch", "torchrl", *names[2:]]
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    print(f"{versions}, {platform.machine()}, {os.cpu_count()} cores; {FLOCKS} flocks of {AGENTS} agents;")
    print(f"{WORKERS} workers, one thread each; flock steps a second, medians of {REPETITIONS}\n")
    print("| physics | " + " | ".join(names) + " |")
    print("|---|" + "---:|" * len(names))
    for physics in ("torch", "bullet"):
        found = speeds(names, physics)
        print(f"| {physics} | " + " | ".join(f"{found[name]:.0f}" for name in names) + " |", flush=True)


if __name__ == "__main__":
    main()
