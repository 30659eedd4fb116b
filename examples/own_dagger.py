"""DAgger as a custom loop, from parts each of which can be replaced.

    python examples/own_dagger.py
    python examples/own_dagger.py --schedule linear --gate near

The environment is controlled by a sequence of modules: the policy acts, the expert labels, `BetaMixture` selects one of
the two for each flock, a `SafetyGate` lets the expert take over, and `ActionNoise` adds noise. All visited states go
into TorchRL's replay buffer, and the policy is fitted to all of them. A schedule is any function of the round, a
gate any function that measures how badly each flock is doing. ``python -m modgnn_rl.train`` runs the same loop with
more to it: an averaged policy, a learning rate schedule, random rotations, several flock sizes, checkpoints.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer

from modgnn_rl import make_model
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.metrics import min_distance
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, SafetyGate, disagreement
from modgnn_rl.trainers.collectors.windows import slice_windows
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.imitation.loss import imitation_loss


def nearness(tensordict: TensorDictBase) -> Tensor:
    """A custom measure: minus the minimum distance in each flock (m) [*B]."""
    return -min_distance(tensordict["agents", "observation"][..., :3])


SCHEDULES: dict[str, Callable[[int], float]] = {
    "exponential": lambda index: 0.6**index,
    "linear": lambda index: max(0.0, 1 - index / 10),
    "never": lambda index: 0.0,  # except in the first round
}
GATES: dict[str, list[SafetyGate]] = {
    "none": [],
    "disagreement": [SafetyGate(disagreement, 0.6)],  # the expert takes over where the policy is 0.6 m/s off
    "near": [SafetyGate(nearness, -0.2)],  # the expert takes over where two agents are closer than 0.2 m
}


def main(
    schedule: str = "exponential",
    gate: str = "disagreement",
    num_envs: int = 32,
    num_agents: int = 16,
    steps: int = 40,
    rounds: int = 16,
    updates: int = 60,
    test_steps: int = 240,
    seed: int = 0,
) -> list[float]:
    """Train a policy; returns its closed-loop error (m²/s²) after each round."""
    env_config = FlockingConfig()
    policy, expert = make_model("pair_force", seed=seed), Reynolds.for_env(env_config)
    generator = torch.Generator().manual_seed(seed)
    mixture, noise = BetaMixture(1.0, steps, generator), ActionNoise(0.05, generator)
    collector = Collector(
        FlockingEnv(num_envs, num_agents, config=env_config, seed=seed, stagger=True),
        TensorDictSequential(policy, expert, mixture, *GATES[gate], noise),
        frames_per_batch=num_envs * steps,
        total_frames=num_envs * steps * rounds,
        auto_register_policy_transforms=True,  # makes the messages recurrent state of the environment
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(num_envs * steps * rounds), batch_size=256)
    optimiser = torch.optim.Adam(policy.parameters(), lr=2e-3)

    errors: list[float] = []
    for rollouts in collector:
        # The last action of such a window is exact: no message depends on older weights.
        buffer.extend(slice_windows(rollouts, policy.window, stride=2))
        for _ in range(updates):
            batch = buffer.sample()
            receivers = random_receivers(batch["agents", "controlled"][:, -1], 8, generator)
            loss = imitation_loss(policy, batch, receivers)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        test = rollout(
            policy, FlockingTask(env_config), num_agents=num_agents, num_flocks=8, steps=test_steps, seed=1_000_000
        )
        errors.append(test["error"].mean().item())
        fraction = rollouts["expert_acts"].float().mean().item()
        print(f"round {len(errors)}: the expert acted in {fraction:4.0%} of steps, then error {errors[-1]:.4f} m²/s²")
        mixture.beta = SCHEDULES[schedule](len(errors))
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--schedule", choices=SCHEDULES, default="exponential", help="probability that the expert acts, by round"
    )
    parser.add_argument("--gate", choices=GATES, default="disagreement", help="when the expert takes over")
    parser.add_argument("--num-envs", type=int, default=32, help="flocks in parallel")
    parser.add_argument("--num-agents", type=int, default=16, help="agents in each, the leader included")
    parser.add_argument("--steps", type=int, default=40, help="steps per round")
    parser.add_argument("--rounds", type=int, default=16)
    parser.add_argument("--updates", type=int, default=60, help="updates per round")
    parser.add_argument("--test-steps", type=int, default=240, help="steps of the test rollouts")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
