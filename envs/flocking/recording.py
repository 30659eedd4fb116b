"""Recording of flocks: what `modgnn_rl.visualization` draws, from the environment's tensordicts."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.metrics import compute_metrics
from modgnn_rl.registry import METRICS
from modgnn_rl.visualization.recording import QUANTUM, Frame, MetricSeries, Recording, quantise, range_flips

__all__ = ["FlockRecorder", "edge_array", "flock_frame"]

Array = NDArray[Any]


def flock_frame(flock: TensorDictBase, config: FlockingConfig) -> Frame:
    """What is drawn of one flock.

    Args:
        flock: the environment's keys and ``("agents", "action")``, without batch dimension.
        config: settings of the environment.

    Returns:
        the frame; its target velocities are those the environment uses: actions projected onto the ball of
        ``max_speed``, zero for agents that have dropped out, and for the leader its velocity.
    """
    agents = flock["agents"]
    position, velocity = flock[config.state_key].split(3, -1)
    controlled = agents["controlled"]
    target = torch.where(controlled.unsqueeze(-1), agents["action"], 0.0).double()
    target[0] = velocity[0]
    speed = target.norm(dim=-1, keepdim=True).clamp(min=config.max_speed)
    return Frame(
        position=position.double().cpu().numpy(),
        target_velocity=(target * config.max_speed / speed).float().cpu().numpy(),
        edges=edge_array(flock["adjacency"]),
        present=agents.get("mask", torch.ones_like(controlled)).cpu().numpy(),
    )


def edge_array(adjacency: Tensor) -> Array:
    """Receiver and sender of each edge, int64 [E, 2], of one flock's matrix, bool [N, N], or padded list [2, E']."""
    is_matrix = adjacency.dtype == torch.bool
    edges = adjacency.nonzero() if is_matrix else adjacency[:, adjacency[0] >= 0].flip(0).t()
    array: Array = edges.cpu().numpy()
    return array


class FlockRecorder:
    """Records one flock of a batch; `modgnn_rl.evaluation.rollout.rollout` calls it at each step.

    Args:
        config: settings of the environment.
        stride: control steps from one recorded step to the next.
        flock: index of the flock.
    """

    def __init__(self, config: FlockingConfig, stride: int = 1, flock: int = 0) -> None:
        self.config, self.stride, self.flock = config, stride, flock
        self.steps = 0
        plotted = [name for name, entry in METRICS.items() if entry.options.get("replay")]
        positions_only = ("position",)
        self._of_positions = [
            name for name in plotted if METRICS[name].options.get("inputs", positions_only) == positions_only
        ]
        self._of_actions = [name for name in plotted if name not in self._of_positions]
        self._recorded: dict[str, list[Array]] = defaultdict(list)

    def __call__(self, tensordict: TensorDictBase) -> None:
        """Record the state before a step, with the policy's and the expert's actions."""
        if self.steps % self.stride == 0:
            flock = tensordict[self.flock]
            frame = flock_frame(flock, self.config)
            quanta = quantise(frame.position)
            quantities = {name: flock["agents", name] for name in ("action", "expert_action", "controlled")}
            quantities["position"] = flock[self.config.state_key][..., :3]
            metrics = compute_metrics(self._of_actions, self.config, quantities)
            step = {
                "position": quanta,
                "target_velocity": frame.target_velocity,
                "present": frame.present,
                "flips": range_flips(frame.edges, quanta, frame.present, self.config.comm_range),
                **{name: value.cpu().numpy() for name, value in metrics.items()},
            }
            for name, value in step.items():
                self._recorded[name].append(value)
        self.steps += 1

    def recording(self) -> Recording:
        """The recording so far; metrics of positions are computed here, from the recorded ones."""
        position = np.stack(self._recorded["position"])
        metres = torch.from_numpy(position).double() * QUANTUM
        metrics = compute_metrics(self._of_positions, self.config, {"position": metres})
        values = {name: np.stack(self._recorded[name]) for name in self._of_actions}
        values |= {name: value.reshape(len(value), -1).mean(-1).numpy() for name, value in metrics.items()}
        return Recording(
            position=position,
            target_velocity=np.stack(self._recorded["target_velocity"]),
            present=np.stack(self._recorded["present"]),
            flips=self._recorded["flips"],
            metrics={
                name: MetricSeries(entry.options["title"].capitalize(), entry.options["unit"], values[name])
                for name, entry in METRICS.items()
                if name in values
            },
            stride=self.stride,
            comm_range=self.config.comm_range,
            max_speed=self.config.max_speed,
            frequency=self.config.control_frequency,
        )
