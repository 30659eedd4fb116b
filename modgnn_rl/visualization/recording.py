"""The record of a rollout that images, videos, the viewer and the replay page draw; it does not depend on the task.

A `Frame` is one step; a `Recording` holds the frames of a rollout compactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from modgnn_rl.utils.neighbours import near_pairs

__all__ = [
    "QUANTUM",
    "Frame",
    "MetricSeries",
    "Recording",
    "quantise",
    "range_flips",
    "recording_stride",
    "shortest_edges",
]

Array = NDArray[Any]

QUANTUM = 2.0**-10  # m; positions are stored as multiples of it, so that all programs compute the same distances
MAX_QUANTA = 2**28  # agents farther away are drawn at this distance
MAX_STATES = 200_000  # default limit of agents x steps in a recording


class Frame(NamedTuple):
    """N agents at one step; agent 0 is the leader.

    Attributes:
        position: m [N, 3]; agents with a NaN are not drawn.
        target_velocity: m/s [N, 3], drawn as arrows.
        edges: receiver and sender of each communication edge, int64 [E, 2].
        present: agents that have not dropped out, bool [N].
        quaternion: attitudes from body to world, x, y, z, w [N, 4]; None: level.
    """

    position: Array
    target_velocity: Array
    edges: Array
    present: Array
    quaternion: Array | None = None


class MetricSeries(NamedTuple):
    """A metric over the steps of a recording.

    Attributes:
        title: heading of its chart.
        unit: such as ``"m"``.
        values: [T].
    """

    title: str
    unit: str
    values: Array


@dataclass(frozen=True)
class Recording:
    """A rollout of N agents, the leader first, at T steps.

    Attributes:
        position: in multiples of `QUANTUM`, int32 [T, N, 3].
        target_velocity: m/s, within the ball of ``max_speed`` [T, N, 3].
        present: agents that have not dropped out, bool [T, N].
        flips: for each step, the edges by which the graph differs from "all present agents within ``comm_range``", see
            `range_flips`.
        metrics: by name.
        stride: control steps from one recorded step to the next.
        comm_range: m.
        max_speed: m/s.
        frequency: control frequency, Hz.
    """

    position: Array
    target_velocity: Array
    present: Array
    flips: list[Array]
    metrics: dict[str, MetricSeries]
    stride: int
    comm_range: float
    max_speed: float
    frequency: float

    def __len__(self) -> int:
        return len(self.position)

    @property
    def period(self) -> float:
        """Time from one recorded step to the next, s."""
        return self.stride / self.frequency

    def frame(self, index: int) -> Frame:
        """The frame of one of the T steps."""
        quanta, present = self.position[index], self.present[index]
        near = _edges_in_range(quanta, present, self.comm_range)
        codes = np.setxor1d(near, self.flips[index], assume_unique=True)
        edges = np.stack((codes // len(quanta), codes % len(quanta)), -1)
        return Frame(quanta.astype(np.float64) * QUANTUM, self.target_velocity[index], edges, present)


def recording_stride(num_agents: int, steps: int, max_frames: int | None = None) -> int:
    """Stride with which a recording has at most about `MAX_STATES` agent states, and about ``max_frames`` frames."""
    return max(-(-num_agents * steps // MAX_STATES), -(-steps // (max_frames or steps)))


def quantise(position: Array) -> Array:
    """Positions, m [N, 3], as multiples of `QUANTUM`, int32 [N, 3]."""
    quanta: Array = np.rint(position / QUANTUM).clip(-MAX_QUANTA, MAX_QUANTA).astype(np.int32)
    return quanta


def range_flips(edges: Array, quanta: Array, present: Array, comm_range: float) -> Array:
    """The edges by which a graph differs from "all present agents within range of each other".

    Args:
        edges: receiver and sender, int64 [E, 2].
        quanta: positions as multiples of `QUANTUM`, int32 [N, 3].
        present: agents that have not dropped out, bool [N].
        comm_range: m.

    Returns:
        ``receiver * N + sender`` of each edge that only one of the graphs has, ascending, int64.
    """
    near = _edges_in_range(quanta, present, comm_range)
    flips: Array = np.setxor1d(edges[:, 0] * len(quanta) + edges[:, 1], near, assume_unique=True)
    return flips


def _edges_in_range(quanta: Array, present: Array, comm_range: float) -> Array:
    """Edges ``receiver * N + sender`` between present agents [N] within range of each other, ascending."""
    radius = min(comm_range / QUANTUM, 4.0 * MAX_QUANTA)
    _, receiver, sender, _ = near_pairs(torch.from_numpy(quanta).double().unsqueeze(0), radius)
    both = torch.from_numpy(present)
    codes: Array = (receiver * len(quanta) + sender)[both[receiver] & both[sender]].numpy()
    return codes


def shortest_edges(frame: Frame, limit: int) -> Array:
    """The shortest pairs of agents with an edge in either direction, int64 [P, 2] with P <= limit, shortest first."""
    agents = max(1, len(frame.position))
    codes = np.unique(frame.edges.min(-1) * agents + frame.edges.max(-1))
    pairs = np.stack((codes // agents, codes % agents), -1)
    length = np.linalg.norm(frame.position[pairs[:, 0]] - frame.position[pairs[:, 1]], axis=-1)
    drawn = np.isfinite(length)
    shortest: Array = pairs[drawn][np.argsort(length[drawn], kind="stable")[:limit]]
    return shortest
