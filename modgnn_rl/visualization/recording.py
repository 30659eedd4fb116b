"""The record of a rollout that images, videos, the viewer and the replay page draw; it does not depend on the task.

A `Frame` is one step; a `Recording` holds the frames of a rollout compactly.
"""

from __future__ import annotations

import dataclasses
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
    "edge_array",
    "quantise",
    "range_flips",
    "recording_stride",
    "shortest_edges",
]

Array = NDArray[Any]

QUANTUM = 2.0**-10  # m; positions are stored as multiples of it, so that all programs compute the same distances
MAX_QUANTA = 2**28  # agents farther away are drawn at this distance
NO_MARKS: Array = np.zeros((0, 3))
MAX_STATES = 200_000  # default limit of agents x steps in a recording


class Frame(NamedTuple):
    """N agents at one step.

    Attributes:
        position: m [N, 3]; agents with a NaN are not drawn.
        arrow: vectors drawn at the agents, such as target velocities, m/s [N, 3].
        edges: receiver and sender of each communication edge, int64 [E, 2].
        present: agents that have not dropped out, bool [N].
        marks: places to mark, such as goals, m [M, 3].
        leader: index of the agent that is shown as a star; None: no agent.
        quaternion: attitudes from body to world, x, y, z, w [N, 4]; None: level.
    """

    position: Array
    arrow: Array
    edges: Array
    present: Array
    marks: Array = NO_MARKS
    leader: int | None = None
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
    """A rollout of N agents at T steps.

    Attributes:
        position: in multiples of `QUANTUM`, int32 [T, N, 3].
        arrow: vectors drawn at the agents, none longer than ``max_arrow`` [T, N, 3].
        present: agents that have not dropped out, bool [T, N].
        flips: for each step, the edges by which the graph differs from "all present agents within ``comm_range``", see
            `range_flips`.
        metrics: by name.
        stride: control steps from one recorded step to the next.
        comm_range: m.
        max_arrow: length of the longest arrow.
        frequency: steps a second, Hz.
        marks: places to mark, in multiples of `QUANTUM`, int32 [T, M, 3]; default: none.
        leader: index of the agent that is shown as a star; None: no agent.
        dims: dimension of the task's space; with fewer than three, rollouts are shown from above.
        arrow_name: what the arrows are; empty: there are none.
    """

    position: Array
    arrow: Array
    present: Array
    flips: list[Array]
    metrics: dict[str, MetricSeries]
    stride: int
    comm_range: float
    max_arrow: float
    frequency: float
    marks: Array | None = None
    leader: int | None = None
    dims: int = 3
    arrow_name: str = "action"

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
        marks = NO_MARKS if self.marks is None else self.marks[index] * QUANTUM
        metres = quanta.astype(np.float64) * QUANTUM
        return Frame(metres, self.arrow[index], edges, present, marks, self.leader)

    def extended(self, steps: int) -> Recording:
        """The recording with its last frame repeated, so that it has as many steps as a longer one."""
        more = steps - len(self)
        if more <= 0:
            return self

        def repeat(values: Array) -> Array:
            return np.concatenate((values, np.repeat(values[-1:], more, 0)))

        return dataclasses.replace(
            self,
            position=repeat(self.position),
            arrow=np.concatenate((self.arrow, np.zeros((more, *self.arrow.shape[1:]), self.arrow.dtype))),
            present=repeat(self.present),
            flips=[*self.flips, *[self.flips[-1]] * more],
            marks=None if self.marks is None else repeat(self.marks),
            metrics={
                name: series._replace(values=np.concatenate((series.values, np.full(more, np.nan))))
                for name, series in self.metrics.items()
            },
        )


def edge_array(adjacency: torch.Tensor) -> Array:
    """Receiver and sender of each edge, int64 [E, 2], of one flock's matrix [N, N], or padded list [2, E']."""
    is_list = adjacency.dtype == torch.int64 and adjacency.shape[-2] == 2
    edges = adjacency[:, adjacency[0] >= 0].flip(0).t() if is_list else adjacency.nonzero()
    return edges.cpu().numpy()


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
