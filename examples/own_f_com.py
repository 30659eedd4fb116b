"""Write your own f_com, and see what it learns from the expert.

    python examples/own_f_com.py

The f_com below is the expert's rule for one neighbour, with its three gains left open. They are fitted to the expert's
forces on rollouts of the expert, then the policy acts by itself. Agents that hear everybody find the expert's own
gains, 0.06, 0.8 and 0.02. Agents that hear only their neighbours find gains that make up for those whom they do not
hear.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.actions import Ball
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.models.blocks import Zero

MAX_SPEED = 0.92  # m/s


class Force(nn.Module):
    """The force that one neighbour exerts: cohesion, separation and alignment, with learned gains."""

    def __init__(self) -> None:
        super().__init__()
        self.gains = nn.Parameter(torch.zeros(3))

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        """Forces of links [E, 3], from position and velocity of their two ends [E, 6]."""
        offset, drift = (sender - receiver).split(3, -1)
        distance, speed = offset.norm(dim=-1, keepdim=True), drift.norm(dim=-1, keepdim=True)
        return torch.stack((offset * distance, -offset / distance**3, drift * speed), -1) @ self.gains


def rollout(
    policy: TensorDictModuleBase, comm_range: float, num_envs: int, num_agents: int, steps: int
) -> TensorDictBase:
    """Rollouts [B, T], and at every state the expert's forces: its actions before they are clipped to `MAX_SPEED`."""
    env = TransformedEnv(FlockingEnv(num_envs, num_agents, seed=0, comm_range=comm_range), InitTracker())
    if isinstance(policy, ModGNN):
        env.append_transform(policy.make_tensordict_primer())
    forces = Reynolds(max_speed=math.inf, action=("agents", "force"))
    with torch.no_grad():
        return forces(env.rollout(steps, policy))


def error(policy: ModGNN, rollouts: TensorDictBase, f_final: nn.Module | None = None) -> Tensor:
    """Mean squared difference to the expert's forces; what ``f_final`` makes of these, if it is given."""
    with set_recurrent_mode(True):
        action = policy(rollouts.select(*policy.in_keys, strict=False))["agents", "action"]
    forces = rollouts["agents", "force"]
    difference = action - (forces if f_final is None else f_final(forces))
    # Agent 0 is the leader, which the policy does not control; at the first step there are no messages yet.
    return difference[:, 1:, 1:].square().mean()


def fit(policy: ModGNN, rollouts: TensorDictBase) -> None:
    """Least squares by L-BFGS."""
    optimiser = torch.optim.LBFGS(policy.parameters(), max_iter=30, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = error(policy, rollouts)
        value.backward()
        return value

    optimiser.step(loss)


def main(
    comm_ranges: Sequence[float] = (2.0, 3.5, 100.0), num_envs: int = 8, num_agents: int = 16, steps: int = 96
) -> dict[float, tuple[list[float], float]]:
    """Fit and roll out a policy for each communication range, m.

    Returns:
        gains, and error of the policy's actions on its own rollouts, m²/s², for each range.
    """
    results = {}
    head = Ball(MAX_SPEED, 3)
    print("hears, m   cohesion   separation   alignment   error on its own rollouts, m²/s²")
    for comm_range in comm_ranges:
        f_com = Force()
        policy = ModGNN(ModGNNLayer(hops=1, f_com=f_com, f_pre=[Zero(3), None]))
        size = (comm_range, num_envs, num_agents, steps)
        fit(policy, rollout(Reynolds(action=("agents", "action")), *size))
        policy.layers[0].f_final = head
        gains = f_com.gains.tolist()
        with torch.no_grad():
            results[comm_range] = gains, error(policy, rollout(policy, *size), head).item()
        print("{:8g} {:10.3f} {:12.3f} {:11.3f} {:17.5f}".format(comm_range, *gains, results[comm_range][1]))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--comm-ranges", type=float, nargs="+", default=(2.0, 3.5, 100.0), help="m")
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--num-agents", type=int, default=16)
    parser.add_argument("--steps", type=int, default=96)
    main(**vars(parser.parse_args()))
