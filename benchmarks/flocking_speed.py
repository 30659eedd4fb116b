"""Flock-steps per second of the flocking environment, from bare physics to TorchRL's collector, and of its peers.

    python benchmarks/flocking_speed.py                       # one thread, 32 agents, B = 1, 32, 256, 1,024
    python benchmarks/flocking_speed.py --threads 2 --envs 32 --agents 64
    python benchmarks/flocking_speed.py --peers               # PyBullet and VMAS too (VMAS: pip install vmas)

Each row is the median of a few repetitions. A flock-step is one control step (five physics steps) of one flock.
Compiled rows are measured after compilation.
"""

from __future__ import annotations

import argparse
import functools
import logging
import platform
import statistics
import time
from collections.abc import Callable, Iterator

import tensordict
import torch
import torchrl
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.physics.quadcopter import Dynamics
from modgnn_rl.models.factory import make_model

REPETITIONS = 5
BULLET_FLOCKS = 4
VMAS_FLOCKS = 256

Loop = Callable[[], int]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--threads", type=int, default=1, help="number of torch threads")
    parser.add_argument("--agents", type=int, default=32, help="agents per flock")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 32, 256, 1024], help="flocks per batch, B")
    parser.add_argument("--seconds", type=float, default=1.5, help="duration of each measurement (s)")
    parser.add_argument("--peers", action="store_true", help="also measure PyBullet and VMAS")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    print(
        f"torch {torch.__version__}, torchrl {torchrl.__version__}, tensordict {tensordict.__version__}, "
        f"{platform.machine()}, {options.threads} thread(s), {options.agents} agents, default allocator\n"
    )
    table = {envs: measure(envs, options.agents, options.seconds) for envs in options.envs}
    print(f"| flock-steps/s | {' | '.join(f'B = {envs:,}' for envs in options.envs)} |")
    print(f"|---|{'---:|' * len(options.envs)}")
    for name in next(iter(table.values())):
        print(f"| {name} | {' | '.join(f'{table[envs][name]:,.0f}' for envs in options.envs)} |")
    if options.peers:
        print("\n| peer | flock-steps/s |\n|---|---:|")
        for name, flocks, step in peers(options.agents):
            print(f"| {name} | {rate(step, flocks, options.seconds):,.0f} |", flush=True)


def measure(envs: int, agents: int, seconds: float) -> dict[str, float]:
    """Measure all rows for one batch size."""
    rates = {}
    for is_compiled in (False, True):
        how = "compiled" if is_compiled else "eager"
        for name, step in loops(envs, agents, is_compiled):
            with torch.no_grad():
                rates[f"{name}, {how}"] = rate(step, envs, seconds)
    for name in ("pair_force", "modgnn_mlp"):
        labelled = TensorDictSequential(make_model(name, seed=0), Reynolds())
        with torch.no_grad():
            rates[f"Collector, policy {name}, expert labels, eager"] = rate(
                collect(envs, agents, labelled), envs, seconds
            )
    return rates


def loops(envs: int, agents: int, compile: bool) -> Iterator[tuple[str, Loop]]:
    """Yield the rows: a name, and a function that takes some steps and returns how many."""
    config = FlockingConfig(compile=compile)
    env = FlockingEnv(envs, agents, config=config, seed=0)
    env.reset()
    # Actions change, so that no result can be reused.
    targets = [0.5 * torch.randn(envs, agents, 3) for _ in range(3)]
    turn = 0

    def step_physics() -> int:
        nonlocal turn
        turn += 1
        env.physics.step(targets[turn % 3])
        return 1

    yield "physics", step_physics

    expert = Reynolds.for_env(config)

    def step_physics_and_graph() -> int:
        step_physics()
        position, velocity = env.physics.position, env.physics.velocity
        env.communication_graph(position)
        expert.rule(position, velocity)
        return 1

    yield "physics, adjacency, expert's label", step_physics_and_graph

    start = env.reset()

    def step_environment() -> int:
        nonlocal turn
        turn += 1
        start["agents", "action"] = targets[turn % 3]
        env.step(start)
        return 1

    yield "env.step", step_environment

    expert_policy = Reynolds.for_env(config, action=("agents", "action"))
    yield "env.rollout, expert", roll_out(TransformedEnv(env, InitTracker()), expert_policy)
    yield "Collector, expert", collect(envs, agents, expert_policy, config)


def roll_out(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]) -> Loop:
    """A function that takes ten steps with ``env.rollout``."""

    def step() -> int:
        env.rollout(10, policy, break_when_any_done=False)
        return 10

    return step


def collect(envs: int, agents: int, policy: TensorDictModuleBase, config: FlockingConfig | None = None) -> Loop:
    """A function that takes ten steps with TorchRL's collector."""
    collector = Collector(
        FlockingEnv(envs, agents, config=config, seed=0),
        policy,
        frames_per_batch=10 * envs,
        total_frames=-1,
        auto_register_policy_transforms=True,
        trust_policy=True,
        no_cuda_sync=True,
    )
    batches = iter(collector)

    def step() -> int:
        next(batches)
        return 10

    return step


def peers(agents: int) -> Iterator[tuple[str, int, Loop]]:
    """Yield other simulators: name, number of flocks, and a function that takes some steps and returns how many."""
    from modgnn_rl.envs.flocking.physics.bullet import BulletPhysics

    bullet = BulletPhysics(BULLET_FLOCKS, agents, Dynamics())
    bullet.reset(
        torch.arange(BULLET_FLOCKS), torch.rand(BULLET_FLOCKS, agents, 3) * 8, torch.zeros(BULLET_FLOCKS, agents, 3)
    )
    target = 0.5 * torch.randn(BULLET_FLOCKS, agents, 3)

    def step_bullet() -> int:
        bullet.step(target)
        return 1

    yield "PyBullet, physics alone", BULLET_FLOCKS, step_bullet
    env = FlockingEnv(BULLET_FLOCKS, agents, physics="bullet", seed=0)
    yield "PyBullet, env.rollout, expert", BULLET_FLOCKS, roll_out(env, Reynolds(action=("agents", "action")))
    try:
        from torchrl.envs.libs.vmas import VmasEnv

        vmas = VmasEnv("flocking", num_envs=VMAS_FLOCKS, n_agents=agents, continuous_actions=True, seed=0)
    except ImportError:
        return
    yield f"VMAS flocking, env.rollout, B = {VMAS_FLOCKS}", VMAS_FLOCKS, roll_out(vmas, functools.partial(idle, vmas))


def idle(env: EnvBase, data: TensorDictBase) -> TensorDictBase:
    """Zero actions, at no cost."""
    return data.update(env.full_action_spec.zero())


def rate(step: Loop, envs: int, seconds: float) -> float:
    """Flock-steps per second: the median of the repetitions."""
    for _ in range(2):
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
