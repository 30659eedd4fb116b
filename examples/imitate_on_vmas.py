"""DAgger on a VMAS scenario with a custom expert: robots that pass each other without colliding.

    pip install vmas
    python examples/imitate_on_vmas.py

In VMAS' "navigation", each robot has a goal and is penalised for collisions. The expert below sees all robots: it
steers towards its goal and keeps to the right of robots nearby, whose velocity and goal it knows. The policy receives
these from its neighbours only, one step late. A mixture of both acts, the expert labels every state, and the policy
learns from all of them. Its error falls from 0.85 to 0.004, and its return rises from -0.07 to 1.01, the expert's;
without communication (``--hops 0``) the return is -1.03.

The group of agents is called ``robots`` here, to show where the keys are set.
"""

from __future__ import annotations

import argparse

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, InitTracker, StepCounter, TransformedEnv, UnaryTransform, VmasEnv
from torchrl.modules import get_primers_from_module

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.models.blocks import mlp
from modgnn_rl.trainers.collectors.behaviour import BetaMixture
from modgnn_rl.trainers.collectors.windows import slice_windows
from modgnn_rl.trainers.imitation.loss import imitation_loss

OBSERVATION, ACTION, EXPERT = ("robots", "observation"), ("robots", "action"), ("robots", "expert")
COMM_RANGE, REACH = 1.0, 0.4  # m; of communication, and of evasion


def neighbours(observation: Tensor) -> Tensor:
    """Adjacency of robots that are near each other: [*B, N, 6] -> bool [*B, N, N]."""
    position = observation[..., :2]
    distance = torch.cdist(position, position)
    return (distance < COMM_RANGE) & ~torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)


def make_env(num_envs: int, num_agents: int, steps: int, seed: int) -> TransformedEnv:
    """VMAS' navigation, observed without rays: position, velocity and offset from the goal."""
    robots = {"robots": [f"agent_{number}" for number in range(num_agents)]}
    env = VmasEnv("navigation", num_envs=num_envs, seed=seed, group_map=robots, n_agents=num_agents, shared_rew=False)
    return TransformedEnv(
        env,
        Compose(
            UnaryTransform([OBSERVATION], [OBSERVATION], fn=lambda observation: observation[..., :6]),
            UnaryTransform([OBSERVATION], ["adjacency"], fn=neighbours),
            StepCounter(steps),
            InitTracker(),
        ),
    )


def keep_right(observation: Tensor) -> Tensor:
    """The expert: accelerations [*B, N, 2] towards the goals, away from and to the right of robots nearby."""
    position, velocity, offset = observation.split(2, -1)
    apart = position.unsqueeze(-2) - position.unsqueeze(-3)
    distance = apart.norm(dim=-1, keepdim=True).clamp(min=1e-3)
    away = apart / distance
    right = torch.stack((-away[..., 1], away[..., 0]), -1)
    others = 1 - torch.eye(position.shape[-2]).unsqueeze(-1)
    force = (others * (REACH / distance - 1).clamp(min=0) * (away + 0.5 * right)).sum(-2)
    return (3 * force - 3 * offset - 4 * velocity).clamp(-1, 1)


def make_policy(hops: int, hidden: int = 64) -> ModGNN:
    """ModGNN with networks of a robot's own velocity and goal, of the messages of each hop, and of their sum."""
    own = nn.Sequential(HidePosition(), mlp(6, hidden, hidden))
    f_pre = [own, *(mlp(6, hidden, hidden) for _ in range(hops))]
    f_final = nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2), nn.Hardtanh())
    return ModGNN(ModGNNLayer(hops, f_pre=f_pre, f_final=f_final), observation=OBSERVATION, action=ACTION)


class HidePosition(nn.Module):
    """Zero the position."""

    def forward(self, observation: Tensor) -> Tensor:
        """Keep velocity and offset from the goal: [..., 6] -> [..., 6]."""
        return nn.functional.pad(observation[..., 2:], (2, 0))


@torch.no_grad()
def rollout(policy: TensorDictModuleBase, num_envs: int, num_agents: int, steps: int) -> tuple[float, float]:
    """Error of a policy's actions against the expert's, and return of a robot, in closed loop."""
    env = make_env(num_envs, num_agents, steps, seed=1)
    primer = get_primers_from_module(policy, warn=False)
    if primer is not None:
        env.append_transform(primer)
    rollouts = env.rollout(steps, policy, break_when_any_done=False)
    difference = rollouts[ACTION] - keep_right(rollouts[OBSERVATION])
    ended = rollouts["next", "done"].cumsum(1) - rollouts["next", "done"].long() > 0
    reward = torch.where(ended.unsqueeze(-1), 0.0, rollouts["next", "robots", "reward"])
    return difference.square().mean().item(), reward.sum(1).mean().item()


def main(
    hops: int = 1,
    num_envs: int = 64,
    num_agents: int = 4,
    steps: int = 100,
    rounds: int = 12,
    updates: int = 100,
    seed: int = 0,
) -> dict[str, tuple[float, float]]:
    """Train.

    Returns:
        error and return of the policy before and after training, and of the expert.
    """
    torch.manual_seed(seed)
    policy, expert = make_policy(hops), TensorDictModule(keep_right, [OBSERVATION], [EXPERT])
    size = (num_envs, num_agents, steps)
    results = {"policy before": rollout(policy, *size)}
    generator = torch.Generator().manual_seed(seed)
    mixture = BetaMixture(1.0, steps, generator, action=ACTION, expert_action=EXPERT)
    collector = Collector(
        make_env(*size, seed),
        TensorDictSequential(policy, expert, mixture),
        frames_per_batch=num_envs * steps,
        total_frames=num_envs * steps * rounds,
        auto_register_policy_transforms=True,  # makes the messages recurrent state of the environment
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(num_envs * steps * rounds), batch_size=256)
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-3)
    all_robots = torch.ones(256, num_agents, dtype=torch.bool)

    for number, rollouts in enumerate(collector):
        mixture.beta = 0.5 ** (number + 1)  # probability that the expert acts in the next round
        data = rollouts.select(*policy.in_keys, EXPERT, strict=False)
        buffer.extend(slice_windows(data, policy.window, stride=1))
        losses = []
        for _ in range(updates):
            loss = imitation_loss(policy, buffer.sample(), all_robots, expert_action=EXPERT)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        print(f"round {number + 1}: loss {sum(losses) / updates:.4f}")
    results["policy"] = rollout(policy, *size)
    results["expert"] = rollout(TensorDictModule(keep_right, [OBSERVATION], [ACTION]), *size)
    for name, (error, total) in results.items():
        print(f"{name}: error {error:.4f}, return {total:.3f}")
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hops", type=int, default=1, help="communication hops K")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-agents", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100, help="length of an episode")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--updates", type=int, default=100, help="gradient steps in each round")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
