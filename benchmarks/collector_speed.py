"""How fast flocks fly in this process, in worker processes and on Ray.

    python benchmarks/collector_speed.py

Rollouts of moment_force with the expert's labels, as a training run makes them; 32 flocks of 32 agents, two workers,
one thread each. The collectors take turns; medians.
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
from modgnn_rl.trainers.collectors.local import FlockCollector
from modgnn_rl.trainers.collectors.remote import RemoteCollector
from modgnn_rl.utils.device import prepare_torch

FLOCKS, AGENTS, STEPS, WORKERS = 32, 32, 40, 2
REPETITIONS = 5


def make(name: str, physics: str) -> FlockCollector | RemoteCollector:
    """Flocks of one collector."""
    flown = (make_model("moment_force", seed=0), Reynolds())
    env_config = FlockingConfig(physics=physics)
    if name == "single":
        return FlockCollector(env_config, FLOCKS, AGENTS, flown, steps=STEPS, seed=0)
    workers = CollectorConfig(name, workers=WORKERS)
    return RemoteCollector(env_config, FLOCKS, AGENTS, flown, steps=STEPS, seed=0, collector=workers)


def speeds(names: list[str], physics: str) -> dict[str, float]:
    """Flock steps a second of each collector, all there at once, one flying at a time."""
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
