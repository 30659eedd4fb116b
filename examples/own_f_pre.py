"""Compose a policy with your own f_pre, and train it in a plain TorchRL loop.

    python examples/own_f_pre.py

The flock has two roles: every third agent is a scout, which keeps farther from the others than the rest do. A robot
knows its own role, and f_pre reads it, under ``("own", "role")``, when it judges what comes in from a neighbour. The
policy acts, the expert labels the states that it visits, and one optimiser fits all of them (DAgger).
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv, UnaryTransform

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.actions import Ball
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.models.blocks import Scale


class RoleForce(nn.Module):
    """The force that one neighbour exerts along the line to it: a learned function of its distance and one's own role.

    Args:
        hidden: width of the network.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(3, hidden), nn.Tanh(), nn.Linear(hidden, 1))

    def forward(self, relative: Tensor, role: Tensor) -> Tensor:
        """Forces of links [E, 3], from what the Laplacian brings [E, 6] and the receiver's role [E, 1]."""
        offset = relative[..., :3]
        distance = (offset.square().sum(-1, keepdim=True) + 1e-6).sqrt()
        return offset / distance * self.network(torch.cat((distance, distance.log(), role), -1))


def make_policy(hidden: int = 32) -> ModGNN:
    """One hop of forces, beside hop 0, which sees the agent's own velocity only."""
    own_velocity = nn.Sequential(Scale(hide_position=True), nn.Linear(6, 3))
    force = TensorDictModule(RoleForce(hidden), in_keys=["data", ("own", "role")], out_keys=["force"])
    return ModGNN(ModGNNLayer(hops=1, f_pre=[own_velocity, force], f_final=Ball(0.92, 3)))


def make_expert() -> TensorDictSequential:
    """Reynolds' rule, in which scouts have ten times the separation."""
    keys = [("agents", "role"), ("agents", "as_scout"), ("agents", "as_other")]
    return TensorDictSequential(
        Reynolds(separation=8.0, action=keys[1]),
        Reynolds(separation=0.8, action=keys[2]),
        TensorDictModule(lambda role, *of: torch.where(role > 0, *of), keys, [("agents", "expert_action")]),
    )


def roles(observation: Tensor) -> Tensor:
    """1 for scouts, 0 for the others [*B, N, 1]."""
    is_scout = torch.arange(observation.shape[-2], device=observation.device) % 3 == 1
    return is_scout.to(observation.dtype).unsqueeze(-1).expand(*observation.shape[:-1], 1)


def error(policy: ModGNN, batch: TensorDictBase) -> Tensor:
    """Mean squared error of the actions of the agents that the policy controls, m²/s²."""
    action = policy(batch.select(*policy.in_keys, strict=False))["agents", "action"]
    return (action - batch["agents", "expert_action"])[batch["agents", "controlled"]].square().mean()


def main(
    num_envs: int = 16, num_agents: int = 12, steps: int = 48, rounds: int = 8, updates: int = 50, seed: int = 0
) -> tuple[list[float], float]:
    """Train a policy.

    Returns:
        its error on each round's rollouts before it learns from them, and the last one if nobody knew its role, m²/s².
    """
    torch.manual_seed(seed)
    policy, expert = make_policy(), make_expert()
    env = TransformedEnv(
        FlockingEnv(num_envs, num_agents, seed=seed, comm_range=6.0, stagger=True),
        UnaryTransform(in_keys=[("agents", "observation")], out_keys=[("agents", "role")], fn=roles),
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=num_envs * steps,
        total_frames=num_envs * steps * rounds,
        auto_register_policy_transforms=True,  # makes the messages recurrent state of the environment
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(num_envs * steps * rounds), batch_size=256)
    optimiser = torch.optim.Adam(policy.parameters(), lr=3e-3)

    errors: list[float] = []
    for rollouts in collector:
        expert(rollouts)
        with torch.no_grad():
            errors.append(error(policy, rollouts).item())
        print(f"round {len(errors)}: error {errors[-1]:.4f} m²/s²")
        # Single states are enough: what this policy sends holds no trace of its weights (policy.sends_plain_data), so
        # that stored messages stay exact while it learns. Other policies learn from windows, see modgnn_on_vmas.py.
        buffer.extend(rollouts.flatten())
        for _ in range(updates):
            loss = error(policy, buffer.sample())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    rollouts["agents", "role"] = torch.zeros_like(rollouts["agents", "role"])
    with torch.no_grad():
        ignorant = error(policy, rollouts).item()
    print(f"the same rollouts, if nobody knew its role: error {ignorant:.4f} m²/s²")
    return errors, ignorant


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=16, help="flocks rolled out in parallel")
    parser.add_argument("--num-agents", type=int, default=12, help="agents in each, the leader included")
    parser.add_argument("--steps", type=int, default=48, help="steps of each round")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--updates", type=int, default=50, help="gradient steps in each round")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
