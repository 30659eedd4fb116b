"""Flock-steps a second of the flocking environment, from the bare physics up to TorchRL's collector.

    python benchmarks/flocking_speed.py                       # one thread, 32 agents, B = 1, 32, 256
    python benchmarks/flocking_speed.py --threads 2 --envs 32 --agents 64

Each row is the median over a few repetitions; a flock-step is one control step (five physics steps) of one flock.
"""

from __future__ import annotations

import argparse
import logging
import platform
import statistics
import time
from collections.abc import Callable, Iterator

import tensordict
import torch
import torchrl
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv

from modgnn_rl.envs import FlockingEnv, TorchPhysics
from modgnn_rl.experts import Reynolds
from modgnn_rl.models import make_model

REPETITIONS = 5


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--agents", type=int, default=32, help="agents in a flock")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 32, 256], help="flocks in a batch, B")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of one repetition")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    print(
        f"torch {torch.__version__}, torchrl {torchrl.__version__}, tensordict {tensordict.__version__}, "
        f"{platform.machine()}, {options.threads} thread(s), {options.agents} agents, eager, default allocator"
    )
    table = {envs: measure(envs, options.agents, options.seconds) for envs in options.envs}
    print(f"\n| flock-steps/s | {' | '.join(f'B = {envs}' for envs in options.envs)} |")
    print(f"|---|{'---:|' * len(options.envs)}")
    for name in next(iter(table.values())):
        print(f"| {name} | {' | '.join(f'{table[envs][name]:,.0f}' for envs in options.envs)} |")


@torch.no_grad()
def measure(envs: int, agents: int, seconds: float) -> dict[str, float]:
    """Measure all rows for one batch size."""
    return {name: rate(step, envs, seconds) for name, step in loops(envs, agents)}


def loops(envs: int, agents: int) -> Iterator[tuple[str, Callable[[], int]]]:
    """Yield the rows: a name, and a function that flies some steps and returns how many."""
    physics = TorchPhysics(envs, agents)
    target = torch.zeros(envs, agents, 3)

    def fly_physics() -> int:
        physics.step(target)
        return 1

    yield "physics alone", fly_physics

    env = FlockingEnv(envs, agents, seed=0)
    start = env.reset()

    def fly_environment() -> int:
        start["agents", "action"] = target
        env.step(start)
        return 1

    yield "environment: physics, adjacency, reward, done", fly_environment

    expert = Reynolds(action=("agents", "action"))

    def fly_expert() -> int:
        env.step(expert(start))
        return 1

    yield "environment and expert", fly_expert

    for name, policy in policies():
        tracked = TransformedEnv(FlockingEnv(envs, agents, seed=0), InitTracker())
        if hasattr(policy, "make_tensordict_primer"):
            tracked.append_transform(policy.make_tensordict_primer())
        yield f"rollout, {name}", roll_out(tracked, policy)
        labelled = TensorDictSequential(policy, Reynolds())
        yield f"Collector with expert labels, {name}", collect(envs, agents, labelled)


def policies() -> Iterator[tuple[str, TensorDictSequential]]:
    """Yield what flies: nothing that computes, then the models."""
    yield "expert as policy", Reynolds(action=("agents", "action"))
    for name in ("pair_force", "modgnn_mlp"):
        yield name, make_model(name, seed=0)


def roll_out(env: TransformedEnv, policy: TensorDictSequential) -> Callable[[], int]:
    """A function that flies ten steps with ``env.rollout``."""

    def fly() -> int:
        env.rollout(10, policy, break_when_any_done=False)
        return 10

    return fly


def collect(envs: int, agents: int, policy: TensorDictSequential) -> Callable[[], int]:
    """A function that flies ten steps with TorchRL's collector."""
    collector = Collector(
        FlockingEnv(envs, agents, seed=0),
        policy,
        frames_per_batch=10 * envs,
        total_frames=-1,
        auto_register_policy_transforms=True,
        trust_policy=True,
    )
    batches = iter(collector)

    def fly() -> int:
        next(batches)
        return 10

    return fly


def rate(step: Callable[[], int], envs: int, seconds: float) -> float:
    """Flock-steps a second: the median over the repetitions."""
    step()
    rates = []
    for _ in range(REPETITIONS):
        begin, steps = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds / REPETITIONS:
            steps += step()
        rates.append(steps * envs / (time.perf_counter() - begin))
    return statistics.median(rates)


if __name__ == "__main__":
    main()
