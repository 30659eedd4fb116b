"""How well policies fly: rollouts from the same starts, measured, beside the expert's and those of doing nothing."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.envs.flocking.metrics import (
    action_error,
    cohesion,
    collision_rate,
    is_diverged,
    leader_distance,
    leader_lost,
    min_distance,
    separation,
)
from modgnn_rl.utils.progress import Progress

__all__ = ["EpisodeMetrics", "evaluate", "make_eval_env", "reference_policies", "rollout"]

QUARTERS = 4
FRAME = 10  # cohesion, the only costly metric, is taken at each tenth step


@dataclasses.dataclass
class EpisodeMetrics:
    """What was measured on rollouts, one entry a flock [F], averaged over its steps (and agents).

    Attributes:
        error: mean squared error of the action against the expert's, per component, m^2/s^2, over controlled agents.
        error_by_quarter: the same in the four quarters of the rollout [F, 4].
        leader_distance: distance of the leader from the centre of mass of the others, m.
        cohesion: diameter of the smallest enclosing sphere, m.
        separation: distance to the nearest neighbour, m.
        squares: means of the squares of the last three, for standard deviations over time, agents and flocks.
        min_distance: smallest distance of two agents at any step, m.
        collision_rate: mean number of touching pairs.
        reward: reward of an agent, summed over the rollout.
        lost: nobody is within range of the leader at the end, bool.
        diverged: an agent was farther than ``max_distance`` from the centre of mass at some step, bool.
    """

    error: Tensor
    error_by_quarter: Tensor
    leader_distance: Tensor
    cohesion: Tensor
    separation: Tensor
    squares: dict[str, Tensor]
    min_distance: Tensor
    collision_rate: Tensor
    reward: Tensor
    lost: Tensor
    diverged: Tensor


def reference_policies(
    config: FlockingConfig, expert: TensorDictModuleBase | None = None
) -> dict[str, TensorDictModuleBase]:
    """The rows that every table has: the expert, the expert with a policy's eyes, and doing nothing.

    Of an expert of one's own, only it and doing nothing.
    """
    key = ("agents", "action")
    idle = TensorDictModule(_zero_action, in_keys=[("agents", "observation")], out_keys=[key])
    if expert is not None:
        fly_it = TensorDictModule(_as_it_is, in_keys=expert.out_keys[:1], out_keys=[key])
        return {"expert": TensorDictSequential(expert, fly_it), "zero action": idle}
    return {
        "expert": Reynolds.for_env(config, action=key),
        "LocalReynolds(hops=2)": LocalReynolds.for_env(config, hops=2, action=key),
        "LocalReynolds(hops=1)": LocalReynolds.for_env(config, hops=1, action=key),
        "zero action": idle,
    }


def _as_it_is(action: Tensor) -> Tensor:
    return action.clone()


def _zero_action(observation: Tensor) -> Tensor:
    return torch.zeros_like(observation[..., :3])


def make_eval_env(
    policy: TensorDictModuleBase,
    config: FlockingConfig,
    num_flocks: int,
    num_agents: int,
    *,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """A world in which every flock flies ``steps`` steps, whatever happens to it, with the policy's recurrent state."""
    env_config = dataclasses.replace(config, max_distance=torch.inf, max_colliding=1.0, max_steps=steps)
    base = FlockingEnv(num_flocks, num_agents, config=env_config, seed=seed, device=device)
    primers = get_primers_from_module(policy, warn=False)
    return TransformedEnv(base, Compose(InitTracker(), *([primers] if primers is not None else [])))


@torch.no_grad()
def rollout(
    policy: TensorDictModuleBase,
    config: FlockingConfig,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    expert: TensorDictModuleBase | None = None,
    watch: Callable[[TensorDictBase], None] | None = None,
) -> EpisodeMetrics:
    """Fly fresh flocks with a policy to the end of the episode and measure them.

    Every flock is flown for all steps, also a diverged one, so that none drops out of the averages. Rollouts with equal
    seeds have the same starts and the same leaders, whatever the policy.

    Args:
        policy: reads the environment's keys, writes ``("agents", "action")``; its recurrent state is added by itself.
        config: the world.
        num_agents: agents in a flock, N.
        num_flocks: flocks, F.
        steps: steps of a rollout.
        seed: seed of starts and leaders.
        device: where to fly.
        progress: counts flock-steps.
        expert: what errors are measured against, writes ``("agents", "expert_action")``; default: Reynolds flocking.
        watch: is shown the flocks before each step, with both actions; see
            `modgnn_rl.envs.flocking.recording.FlockRecorder`.
    """
    env = make_eval_env(policy, config, num_flocks, num_agents, steps=steps, seed=seed, device=device)
    expert = expert or Reynolds.for_env(config)
    means = _Means(num_flocks, device)
    quarters = torch.zeros(num_flocks, QUARTERS, device=device)
    closest = torch.full((num_flocks,), torch.inf, device=device)
    diverged = torch.zeros(num_flocks, dtype=torch.bool, device=device)
    tensordict = env.reset()
    with contextlib.closing(env), set_recurrent_mode(False):
        for step in range(steps):
            position = tensordict[config.state_key][..., :3]
            tensordict = expert(policy(tensordict))
            if watch is not None:
                watch(tensordict)
            agents = tensordict["agents"]
            error = action_error(agents["action"], agents["expert_action"], agents["controlled"])
            quarters[:, step * QUARTERS // steps] += error
            means.add("error", error)
            means.add("leader_distance", leader_distance(position))
            means.add("separation", separation(position))
            means.add("collision_rate", collision_rate(position, config.collision_distance))
            if step % FRAME == 0:
                means.add("cohesion", cohesion(position))
            closest = torch.minimum(closest, min_distance(position))
            diverged |= is_diverged(position, config.max_distance)
            tensordict = env.step(tensordict)
            means.add("reward", tensordict["next", "agents", "reward"].squeeze(-1))
            tensordict = env.step_mdp(tensordict)
            if progress is not None:
                progress.update(num_flocks)
    counts = torch.bincount(torch.arange(steps) * QUARTERS // steps, minlength=QUARTERS).to(device)
    return EpisodeMetrics(
        error=means["error"],
        error_by_quarter=quarters / counts,
        leader_distance=means["leader_distance"],
        cohesion=means["cohesion"],
        separation=means["separation"],
        squares={
            name: means.squares[name] / means.count[name] for name in ("leader_distance", "cohesion", "separation")
        },
        min_distance=closest,
        collision_rate=means["collision_rate"],
        reward=means["reward"] * steps,
        lost=leader_lost(tensordict[config.state_key][..., :3], config.comm_range),
        diverged=diverged,
    )


class _Means:
    """Running means over steps and agents, one entry a flock."""

    def __init__(self, flocks: int, device: torch.device | str) -> None:
        self.zero = torch.zeros(flocks, device=device, dtype=torch.float64)
        self.sums: dict[str, Tensor] = {}
        self.squares: dict[str, Tensor] = {}
        self.count: dict[str, int] = {}

    def add(self, name: str, value: Tensor) -> None:
        """Add one step's values [F] or [F, N]."""
        value = value.double().reshape(len(value), -1)
        self.sums[name] = self.sums.get(name, self.zero) + value.mean(-1)
        self.squares[name] = self.squares.get(name, self.zero) + value.square().mean(-1)
        self.count[name] = self.count.get(name, 0) + 1

    def __getitem__(self, name: str) -> Tensor:
        return self.sums[name] / self.count[name]


def evaluate(
    policies: Mapping[str, TensorDictModuleBase],
    config: FlockingConfig,
    *,
    num_agents: int,
    num_flocks: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    expert: TensorDictModuleBase | None = None,
    watches: Mapping[str, Callable[[TensorDictBase], None]] | None = None,
) -> dict[str, EpisodeMetrics]:
    """Fly each policy, and the reference policies, from the same starts; progress is shown. See `rollout`.

    With an expert of one's own, the reference is it and doing nothing. ``watches``, by name of the policy, are shown
    its rollouts.
    """
    policies = {**policies, **reference_policies(config, expert)}
    total = len(policies) * num_flocks * steps
    rollouts = {}
    with Progress(f"evaluate, {num_agents} agents", total) as progress:
        for name, policy in policies.items():
            progress.update(flying=name)
            rollouts[name] = rollout(
                policy,
                config,
                num_agents=num_agents,
                num_flocks=num_flocks,
                steps=steps,
                seed=seed,
                device=device,
                progress=progress,
                expert=expert,
                watch=(watches or {}).get(name),
            )
    return rollouts
