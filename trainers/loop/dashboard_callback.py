"""What dashboards show beyond metrics: reference policies, actions, videos, and the final table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import REFERENCE_SIZE, TrainConfig
from modgnn_rl.errors import one_line
from modgnn_rl.evaluation.recording import record
from modgnn_rl.evaluation.rollout import EpisodeMetrics, reference_policies, rollout
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.seeds import derive_seed, seeded
from modgnn_rl.visualization.video import VIDEO_STRIDE, check_video, write_video

__all__ = ["DashboardCallback", "log_evaluation"]

STEPS = 200  # of a reference rollout and of a video
FLOCKS = 4  # of 32 agents; larger flocks are fewer
CHART_ROUNDS = 10  # rounds after which reference lines are extended
MAX_ACTIONS = 30_000  # components in a histogram


class DashboardCallback(Callback):
    """Shows on dashboards the metrics of reference policies, the distribution of the actions, and videos.

    Training is bitwise the same with and without it. A part that fails is turned off, with one warning.

    Args:
        config: the run's settings.
        run: the run folder; videos go into ``videos/`` there.
        loggers: the dashboards.
        expert: the policy to imitate; default: Reynolds flocking.
    """

    def __init__(
        self,
        config: TrainConfig,
        run: RunFolder,
        loggers: LoggerGroup,
        expert: TensorDictModuleBase | None = None,
    ) -> None:
        self.config, self.run, self.loggers, self.expert = config, run, loggers, expert
        self.policies: Mapping[str, ModGNN] = {}
        self.lines: dict[str, dict[str, float]] = {}  # of each metric: the value of each reference policy
        self.shown: set[str] = set()  # metrics with lines
        self.last = self.last_video = 0  # rounds
        self._failed: set[str] = set()

    def on_start(self, policies: Mapping[str, ModGNN]) -> None:
        """Roll out the reference policies, and check whether videos can be made."""
        self.policies = policies
        self._attempt("reference rollouts", self._roll_out_references)
        if self._makes_videos:
            self._attempt("videos", check_video)

    def on_collect(self, index: int, rollouts: TensorDictBase) -> None:
        """Show a histogram of the components of the actions (m/s)."""
        self._attempt("actions", lambda: self._show_actions(index, rollouts))

    def on_round(self, index: int, metrics: Mapping[str, float]) -> None:
        """Extend the reference lines and make a video, when it is time for them."""
        found = {name for name in metrics if self._line(name) in self.lines}
        is_time = index % CHART_ROUNDS == 0 or not found <= self.shown
        self.shown |= found
        self.last = index
        if is_time:
            self._attempt("reference lines", self._draw_lines)
        if self._makes_videos and index and index % self.config.video_rounds == 0:
            self._attempt("videos", self._make_video)

    def on_end(self, policies: Mapping[str, ModGNN]) -> None:
        """Extend the reference lines to the end, and make a video of the final policy."""
        if self.last % CHART_ROUNDS:
            self._attempt("reference lines", self._draw_lines)
        if self._makes_videos and self.last_video != self.last:
            self._attempt("videos", self._make_video)

    @property
    def _makes_videos(self) -> bool:
        return self.config.video_rounds > 0 and self.loggers.shows_videos

    def _attempt(self, what: str, action: Callable[[], Any]) -> None:
        """Do something that must neither stop the training nor affect its random numbers."""
        if what in self._failed or not self.loggers:
            return
        try:
            with seeded(derive_seed(self.config.seed, "watching"), self.config.device):
                action()
        except Exception as error:  # whatever is missing, training continues
            self._failed.add(what)
            warnings.warn(
                f"dashboards show no {what} from now on ({one_line(error)}); training continues",
                RuntimeWarning,
                stacklevel=3,
            )

    def _roll_out_references(self) -> None:
        """Measure the reference policies at each flock size."""
        env_config = self.config.env
        for size in env_config.sizes:
            rows = {
                name: _measures(
                    rollout(
                        policy,
                        env_config,
                        num_agents=size,
                        num_flocks=max(1, FLOCKS * REFERENCE_SIZE // size),
                        steps=self._steps,
                        seed=derive_seed(self.config.seed, "references", size),
                        device=self.config.device,
                        expert=self.expert,
                    ),
                    self._steps,
                )
                for name, policy in reference_policies(env_config, self.expert).items()
            }
            measures = list(next(iter(rows.values())))
            self.lines |= {f"{size}/{name}": {who: row[name] for who, row in rows.items()} for name in measures}
            table: list[list[str | float]] = [[who, *row.values()] for who, row in rows.items()]
            self.loggers.log_table(f"references/{size}", ["flown by", *measures], table)
        for name in ("error", "reward"):
            lines = [self.lines[f"{size}/{name}"] for size in env_config.sizes]
            self.lines[name] = {who: sum(line[who] for line in lines) / len(lines) for who in lines[0]}

    @property
    def _steps(self) -> int:
        return min(STEPS, self.config.env.max_steps)

    def _line(self, metric: str) -> str:
        """The name of a metric in `lines`, without the name of a policy before it."""
        return metric if metric in self.lines else "/".join(metric.split("/")[-2:])

    def _draw_lines(self) -> None:
        self.loggers.log_references(self.last, {name: self.lines[self._line(name)] for name in sorted(self.shown)})

    def _show_actions(self, index: int, rollouts: TensorDictBase) -> None:
        actions = rollouts["agents", "action"][rollouts["agents", "controlled"]].flatten()
        size = rollouts["agents", "action"].shape[-2]
        self.loggers.log_histogram(index, f"{size}/actions", actions[:: max(1, len(actions) // MAX_ACTIONS)])

    def _make_video(self) -> None:
        """Make a video of the first policy at the first size, always from the same start, for comparison."""
        env_config, folder = self.config.env, self.run.path / "videos"
        size = env_config.sizes[0]
        recording = record(
            next(iter(self.policies.values())),
            env_config,
            num_agents=size,
            steps=self._steps,
            seed=derive_seed(self.config.seed, "references", size),
            stride=VIDEO_STRIDE,
            device=self.config.device,
            expert=self.expert,
        )
        folder.mkdir(exist_ok=True)
        path = folder / f"round_{self.last:05d}.mp4"
        write_video(path, recording)
        self.last_video = self.last
        self.loggers.log_video(self.last, f"{size}/rollout", path)


def _measures(rollouts: EpisodeMetrics, steps: int) -> dict[str, float]:
    """Metrics of rollouts by the names that `rollout_metrics` gives them."""
    names = ("error", "leader_distance", "cohesion", "separation", "collision_rate", "lost", "diverged")
    means = {name: float(getattr(rollouts, name).double().mean()) for name in names}
    smallest, reward = float(rollouts.min_distance.min()), float(rollouts.reward.mean()) / steps
    return {**means, "min_distance": smallest, "reward": reward}


def log_evaluation(loggers: LoggerGroup, tables: Mapping[int, Mapping[str, Any]]) -> None:
    """Show the evaluation on loggers, a table for each number of agents.

    Args:
        loggers: where.
        tables: by number of agents, as `modgnn_rl.evaluation.table.summarise_rollouts` makes them.
    """
    means = ("error", "leader_distance", "cohesion", "separation", "collision_rate", "reward")
    plain = ("smallest_distance_ever", "lost", "diverged")
    columns = ["flown by", "error", "error, low", "error, high", *means[1:], *plain]
    for size, table in tables.items():
        rows = []
        for name, row in table.items():
            error, *others = (row[mean] or {} for mean in means)
            figures = [error.get(key, math.nan) for key in ("mean", "low", "high")]
            figures += [other.get("mean", math.nan) for other in others]
            rows.append([name, *figures, *(float(row[name]) for name in plain)])
        loggers.log_table(f"evaluation/{size}", columns, rows)
