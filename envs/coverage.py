"""Coverage: robots spread over a square so that each point has one nearby. The template of a task of your own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.nn import functional
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from modgnn_rl.configs.schema import TaskConfig
from modgnn_rl.configs.settings import setting
from modgnn_rl.layout import Layout
from modgnn_rl.registry import METRICS, TASKS
from modgnn_rl.task import ACTION, EXPERT_ACTION, OBSERVATION, Task

__all__ = ["Coverage", "CoverageConfig", "CoverageEnv", "coverage_cost", "voronoi"]

DT, DAMPING = 0.1, 1.0  # step, s; friction, 1/s
MAX_ACCELERATION = 1.0  # along each axis, m/s²
RESOLUTION = 24  # points along a side of the square, of which cells are computed


@dataclass
class CoverageConfig(TaskConfig):
    """Robots that spread over a square."""

    name: str = setting("coverage", "task", choices=TASKS)
    max_steps: int = setting(100, "steps after which an episode is truncated", ge=1)
    side: float = setting(2.0, "side of the square (m)", gt=0)
    comm_range: float = setting(1.0, "distance within which robots hear each other (m)", gt=0)
    tolerance: float = setting(0.05, "success: distance of all robots from the centroids of their cells (m)", gt=0)


def voronoi(position: Tensor, side: float) -> tuple[Tensor, Tensor]:
    """Divide a square around the origin, of a side in m, among robots at positions, m [*B, N, 2], on a grid of points.

    Returns:
        centroids of the robots' cells, m [*B, N, 2], and the mean squared distance of a point to its robot, m² [*B].
    """
    line = side * ((torch.arange(RESOLUTION).to(position) + 0.5) / RESOLUTION - 0.5)
    points = torch.cartesian_prod(line, line)
    cost, owner = (position.unsqueeze(-2) - points).square().sum(-1).min(-2)  # of each point
    cell = functional.one_hot(owner, position.shape[-2]).to(position).transpose(-1, -2)  # [*B, N, points]
    count = cell.sum(-1, keepdim=True)
    return torch.where(count > 0, cell @ points / count.clamp(min=1), position), cost.mean(-1)


class CoverageEnv(EnvBase):
    """B squares with N robots each, which observe their positions, m, and velocities, m/s, and accelerate.

    Episodes begin at random places within a quarter of the square; the reward is the negative cost of `voronoi`.
    """

    def __init__(self, num_envs: int, num_agents: int, side: float, seed: int, device: torch.device | str) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.side, self.generators = side, {"coverage": torch.Generator().manual_seed(seed)}  # stored in checkpoints
        self.state = torch.zeros(num_envs, num_agents, 4, device=self.device)  # what the robots observe
        action = Bounded(-MAX_ACCELERATION, MAX_ACCELERATION, (num_envs, num_agents, 2))
        self.observation_spec = Composite({OBSERVATION: Unbounded(self.state.shape)}, shape=[num_envs])
        self.action_spec = Composite({ACTION: action}, shape=[num_envs])
        self.reward_spec = Unbounded((num_envs, 1))
        self.done_spec = Binary(shape=(num_envs, 1), dtype=torch.bool)

    def _set_seed(self, seed: int | None) -> None:
        self.generators["coverage"].manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        begins = None if tensordict is None else tensordict.get("_reset", None)
        corner, place = torch.rand(2, *self.state.shape[:2], 2, generator=self.generators["coverage"]) - 0.5
        position = self.side * (corner[:, :1] + place) / 2
        fresh = torch.cat((position, torch.zeros_like(position)), -1).to(self.device)
        self.state = fresh if begins is None else torch.where(begins.unsqueeze(-1), fresh, self.state)
        return TensorDict({OBSERVATION: self.state.clone()}, self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        position, velocity = self.state.split(2, -1)
        velocity = velocity + DT * (tensordict[ACTION] - DAMPING * velocity)
        moved = (position + DT * velocity).clamp(-self.side / 2, self.side / 2)  # walls
        self.state = torch.cat((moved, (moved - position) / DT), -1)
        reward = -voronoi(moved, self.side)[1].unsqueeze(-1)
        result = {OBSERVATION: self.state.clone(), "reward": reward, **self.full_done_spec.zero()}
        return TensorDict(result, self.batch_size, device=self.device)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state, as tensors by name; with it, a resumed run continues bit for bit."""
        return {"robots": self.state.clone()}

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Return to what `snapshot` returned."""
        self.state = snapshot["robots"].to(self.device, copy=True)


@TASKS.register("coverage", settings=CoverageConfig, units={"error": "m²/s⁴"})
class Coverage(Task):
    """Robots that spread over a square; the expert is Lloyd's algorithm."""

    config: CoverageConfig
    frequency = 1 / DT
    # Two vectors, position and velocity. In a mirror the square is the same; moved or turned it is another.
    layout = Layout(4, dims=2, vectors=2, symmetries=("reflection",))

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> CoverageEnv:
        """See `Task.make_env`; the graph follows from the positions and ``comm_range``."""
        return CoverageEnv(num_envs, num_agents, self.config.side, seed, device)

    def expert(self) -> TensorDictModule:
        """Lloyd's algorithm."""
        return TensorDictModule(self.lloyd, in_keys=[OBSERVATION], out_keys=[EXPERT_ACTION])

    def lloyd(self, observation: Tensor) -> Tensor:
        """Accelerate towards the centroid of one's cell, as a damped spring does, m/s² [*B, N, 2]."""
        position, velocity = observation.split(2, -1)
        to_centroid = voronoi(position, self.config.side)[0] - position
        return (4 * to_centroid - 3 * velocity).clamp(-MAX_ACCELERATION, MAX_ACCELERATION)

    def positions(self, data: TensorDictBase) -> Tensor:
        """Positions, m [*B, N, 2]."""
        return data[OBSERVATION][..., :2]

    def targets(self, data: TensorDictBase) -> Tensor:
        """The centroids, m [*B, N, 2], which replays mark."""
        return voronoi(self.positions(data), self.config.side)[0]

    def success(self, data: TensorDictBase) -> Tensor:
        """Whether all robots are at the centroids of their cells, bool [*B]."""
        return (self.positions(data) - self.targets(data)).norm(dim=-1).amax(-1) < self.config.tolerance


@METRICS.register(
    "coverage_cost",
    task="coverage",
    title="coverage cost",
    unit="m²",
    better="lower",
    about="mean squared distance from a point of the square to the nearest robot, at the end of the episode",
    settings=("side",),
    over_time="last",
    cell="{mean:.4f} [{low:.4f}, {high:.4f}]",
    replay=True,
)
def coverage_cost(position: Tensor, side: float) -> Tensor:
    """The coverage cost of robots at positions, m [*B, N, 2], in a square of this side, m, as `voronoi` computes it."""
    return voronoi(position[..., :2], side)[1]
