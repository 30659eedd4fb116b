"""Write DAgger as a loop of one's own, from pieces each of which may be swapped.

    python examples/own_dagger.py
    python examples/own_dagger.py --schedule linear --gate near

A sequence of modules flies: the policy acts, the expert labels, `BetaMixture` lets one of the two fly each flock, a
`SafetyGate` lets the expert take over, and `ActionNoise` adds noise. Every visited state is kept in TorchRL's replay
buffer, and the policy learns from all of them. A schedule is any function of the round, a gate any function that says
how badly each flock flies. ``python -m modgnn_rl.train`` is the same loop with more to it: a moving average of the
weights, a falling learning rate, rotations, several sizes, checkpoints.
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
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, SafetyGate, disagreement
from modgnn_rl.trainers.collectors.windows import slice_windows
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.imitation.loss import imitation_loss


def nearness(tensordict: TensorDictBase) -> Tensor:
    """A measure of one's own: how near the two nearest agents of each flock are, -m [*B]."""
    return -min_distance(tensordict["agents", "observation"][..., :3])


SCHEDULES: dict[str, Callable[[int], float]] = {
    "exponential": lambda index: 0.6**index,
    "linear": lambda index: max(0.0, 1 - index / 10),
    "never": lambda index: 0.0,  # but for the first round
}
GATES: dict[str, list[SafetyGate]] = {
    "none": [],
    "disagreement": [SafetyGate(disagreement, 0.6)],  # the expert flies where the policy is 0.6 m/s off
    "near": [SafetyGate(nearness, -0.2)],  # the expert flies where two agents are closer than 0.2 m
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
    """Train a policy; returns its error on rollouts of its own after each round, m²/s²."""
    env_config = FlockingConfig()
    policy, expert = make_model("pair_force", seed=seed), Reynolds.for_env(env_config)
    generator = torch.Generator().manual_seed(seed)
    mixture, disturbance = BetaMixture(1.0, steps, generator), ActionNoise(0.05, generator)
    collector = Collector(
        FlockingEnv(num_envs, num_agents, config=env_config, seed=seed, stagger=True),
        TensorDictSequential(policy, expert, mixture, *GATES[gate], disturbance),
        frames_per_batch=num_envs * steps,
        total_frames=num_envs * steps * rounds,
        auto_register_policy_transforms=True,  # makes the messages recurrent state of the environment
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(num_envs * steps * rounds), batch_size=256)
    optimiser = torch.optim.Adam(policy.parameters(), lr=2e-3)

    errors: list[float] = []
    for rollouts in collector:
        # The last action of such a window is exact, whatever messages older weights have sent before it.
        buffer.extend(slice_windows(rollouts, policy.window, stride=2))
        for _ in range(updates):
            batch = buffer.sample()
            receivers = random_receivers(batch["agents", "controlled"][:, -1], 8, generator)
            loss = imitation_loss(policy, batch, receivers)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        test = rollout(policy, env_config, num_agents=num_agents, num_flocks=8, steps=test_steps, seed=1_000_000)
        errors.append(test["error"].mean().item())
        expert_flew = rollouts["expert_acts"].float().mean().item()
        print(f"round {len(errors)}: the expert flew {expert_flew:4.0%}, then error {errors[-1]:.4f} m²/s²")
        mixture.beta = SCHEDULES[schedule](len(errors))
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--schedule", choices=SCHEDULES, default="exponential", help="the expert's share by round")
    parser.add_argument("--gate", choices=GATES, default="disagreement", help="when the expert takes over")
    parser.add_argument("--num-envs", type=int, default=32, help="flocks flown at once")
    parser.add_argument("--num-agents", type=int, default=16, help="agents in each, the leader included")
    parser.add_argument("--steps", type=int, default=40, help="steps flown in each round")
    parser.add_argument("--rounds", type=int, default=16)
    parser.add_argument("--updates", type=int, default=60, help="gradient steps in each round")
    parser.add_argument("--test-steps", type=int, default=240, help="steps of the rollouts that are tested on")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
