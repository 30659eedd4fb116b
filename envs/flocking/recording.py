"""What is kept of a rollout to be looked at later: where everybody was, what it was told, who heard whom."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.metrics import action_error, cohesion, leader_distance, separation
from modgnn_rl.utils.neighbours import near_pairs

__all__ = ["METRICS", "QUANTUM", "Recorder", "Recording", "spacing"]

Array = NDArray[Any]

QUANTUM = 2.0**-10  # m; positions are kept as multiples of it, so that distances are the same whoever computes them
FARTHEST = 2**28  # quanta; who is farther away is drawn there
MOST_STATES = 200_000  # agents x steps of a rollout that are kept unless somebody asks for more
METRICS = {
    "error": ("Error against the expert", "m²/s²"),
    "leader_distance": ("Leader to the others' centre", "m"),
    "cohesion": ("Cohesion: diameter", "m"),
    "separation": ("Separation: nearest neighbour", "m"),
}


@dataclass(frozen=True)
class Recording:
    """A rollout of N agents, the leader first, at T steps.

    Attributes:
        position: in quanta, int32 [T, N, 3].
        target_velocity: what the policy said, projected as the world does, m/s [T, N, 3]; zero for agents that it does
            not fly, the velocity for the leader.
        present: agents that have not dropped out, bool [T, N].
        flips: for each step the links ``receiver * N + sender`` in which the radio graph differs from "within
            ``comm_range`` of each other, by these positions, and both present"; ascending.
        metrics: by the names of `METRICS`, [T].
        stride: steps from one that was kept to the next.
        comm_range: m.
        max_speed: m/s.
        frequency: control steps a second, Hz.
    """

    position: Array
    target_velocity: Array
    present: Array
    flips: list[Array]
    metrics: dict[str, Array]
    stride: int
    comm_range: float
    max_speed: float
    frequency: float

    def links(self, index: int) -> Array:
        """Who heard whom at one of the T steps: ``receiver * N + sender``, ascending, int64."""
        near = links_in_range(self.position[index], self.present[index], self.comm_range)
        return np.setxor1d(near, self.flips[index], assume_unique=True)


def spacing(num_agents: int, steps: int, frames: int | None = None) -> int:
    """Steps from one that is kept to the next, so that a recording stays small, or has about so many frames at most."""
    return max(-(-num_agents * steps // MOST_STATES), -(-steps // (frames or steps)))


def links_in_range(position: Array, present: Array, comm_range: float) -> Array:
    """Links ``receiver * N + sender`` between agents [N] within range, by positions in quanta [N, 3]; ascending."""
    radius = min(comm_range / QUANTUM, 4.0 * FARTHEST)
    _, receiver, sender, _ = near_pairs(torch.from_numpy(position).double().unsqueeze(0), radius)
    both = torch.from_numpy(present)
    links: Array = (receiver * len(position) + sender)[both[receiver] & both[sender]].numpy()
    return links


@dataclass
class Recorder:
    """Keeps one flock of the rollouts that `modgnn_rl.evaluation.rollout.rollout` shows it, step by step.

    Args:
        config: the world.
        stride: steps from one that is kept to the next.
        flock: which flock.
    """

    config: FlockingConfig
    stride: int = 1
    flock: int = 0
    seen: int = field(default=0, init=False)
    kept: list[dict[str, Array]] = field(default_factory=list, init=False)

    def __call__(self, tensordict: TensorDictBase) -> None:
        """Look at the flocks before a step, with the policy's and the expert's actions."""
        if self.seen % self.stride == 0:
            self.kept.append(self._look(tensordict[self.flock]))
        self.seen += 1

    def _look(self, flock: TensorDictBase) -> dict[str, Array]:
        agents = flock["agents"]
        position, velocity = flock[self.config.state_key].split(3, -1)
        controlled = agents["controlled"]
        quanta = (position.double() / QUANTUM).round().clamp(-FARTHEST, FARTHEST).int().cpu().numpy()
        present = agents.get("mask", torch.ones_like(controlled)).cpu().numpy()
        target = torch.where(controlled.unsqueeze(-1), agents["action"], 0.0).double()
        target[0] = velocity[0]
        speed = target.norm(dim=-1, keepdim=True).clamp(min=self.config.max_speed)
        heard = _directed_links(flock["adjacency"], len(position)).cpu().numpy()
        near = links_in_range(quanta, present, self.config.comm_range)
        return {
            "position": quanta,
            "target_velocity": (target * self.config.max_speed / speed).float().cpu().numpy(),
            "present": present,
            "flips": np.setxor1d(heard, near, assume_unique=True),
            "error": action_error(agents["action"], agents["expert_action"], controlled).cpu().numpy(),
        }

    def recording(self) -> Recording:
        """What was kept; metrics are taken from the positions that were."""
        parts = {name: [look[name] for look in self.kept] for name in self.kept[0]}
        position = np.stack(parts["position"])
        metres = torch.from_numpy(position).double() * QUANTUM
        shape = {
            "leader_distance": leader_distance(metres),
            "cohesion": cohesion(metres),
            "separation": separation(metres).mean(-1),
        }
        return Recording(
            position=position,
            target_velocity=np.stack(parts["target_velocity"]),
            present=np.stack(parts["present"]),
            flips=parts["flips"],
            metrics={"error": np.stack(parts["error"])} | {name: value.numpy() for name, value in shape.items()},
            stride=self.stride,
            comm_range=self.config.comm_range,
            max_speed=self.config.max_speed,
            frequency=self.config.control_frequency,
        )


def _directed_links(adjacency: Tensor, num_agents: int) -> Tensor:
    """Links ``receiver * N + sender`` of a bool matrix [N, N] or a list of links [2, E]; ascending, int64."""
    if adjacency.dtype == torch.bool:
        return adjacency.flatten().nonzero().squeeze(-1)
    sender, receiver = adjacency[:, adjacency[0] >= 0]
    return (receiver * num_agents + sender).sort().values
