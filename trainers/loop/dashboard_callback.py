"""What dashboards show of a training beyond its metrics: reference lines, actions, videos, the evaluation table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.errors import one_line
from modgnn_rl.evaluation.recording import record
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.metrics import over_flocks
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import METRICS, TRAINERS
from modgnn_rl.task import Task
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.seeds import derive_seed, seeded
from modgnn_rl.visualization.video import VIDEO_STRIDE, check_video, write_video

__all__ = ["DashboardCallback", "log_evaluation"]

STEPS = 200  # of a reference rollout and of a video
FLOCKS = 4  # of the reference size; fewer if there are more agents
CHART_ROUNDS = 10  # rounds between two points of a reference line
MAX_ACTIONS = 30_000  # components in a histogram


class DashboardCallback(Callback):
    """Logs the metrics of the reference policies, histograms of actions, and videos to dashboards.

    Training is bit-equal with and without it. What fails is left out from then on, with one warning.

    Args:
        config: settings of the run.
        task: of the run.
        run: the run folder; videos go to its ``videos/``.
        loggers: dashboards to log to.
    """

    def __init__(
        self,
        config: TrainConfig,
        task: Task,
        run: RunFolder,
        loggers: LoggerGroup,
    ) -> None:
        self.config, self.task, self.run, self.loggers = config, task, run, loggers
        self.policies: Mapping[str, ModGNN] = {}
        self.references: dict[str, dict[str, float]] = {}  # by metric, then by reference policy
        self.shown: set[str] = set()  # metrics with reference lines
        self.last = self.last_video = 0  # rounds
        self._failed: set[str] = set()

    def on_start(self, policies: Mapping[str, ModGNN]) -> None:
        """Roll out the reference policies, and check that videos can be made."""
        self.policies = policies
        self._attempt("reference rollouts", self._roll_out_references)
        if self._makes_videos:
            self._attempt("videos", check_video)

    def on_collect(self, index: int, rollouts: TensorDictBase) -> None:
        """Log a histogram of the components of the actions, m/s."""
        self._attempt("actions", lambda: self._log_actions(index, rollouts))

    def on_round(self, index: int, metrics: Mapping[str, float]) -> None:
        """Extend the reference lines, and make a video, if it is time to."""
        found = {name for name in metrics if self._reference_of(name) in self.references}
        is_time = index % CHART_ROUNDS == 0 or not found <= self.shown
        self.shown |= found
        self.last = index
        if is_time:
            self._attempt("reference lines", self._log_references)
        if self._makes_videos and index and index % self.config.video_rounds == 0:
            self._attempt("videos", self._log_video)

    def on_end(self, policies: Mapping[str, ModGNN]) -> None:
        """Extend the reference lines to the last round, and make a video of the final policy."""
        if self.last % CHART_ROUNDS:
            self._attempt("reference lines", self._log_references)
        if self._makes_videos and self.last_video != self.last:
            self._attempt("videos", self._log_video)

    @property
    def _makes_videos(self) -> bool:
        return self.config.video_rounds > 0 and self.loggers.shows_videos and self.task.has_positions

    @property
    def _steps(self) -> int:
        return min(STEPS, self.config.env.max_steps)

    def _attempt(self, what: str, action: Callable[[], Any]) -> None:
        """Run what must neither stop the training nor touch its random numbers."""
        if what in self._failed or not self.loggers:
            return
        try:
            with seeded(derive_seed(self.config.seed, "watching"), self.config.device):
                action()
        except Exception as error:  # whatever a dashboard lacks, training continues
            self._failed.add(what)
            warnings.warn(
                f"dashboards no longer show {what} ({one_line(error)}); training continues",
                RuntimeWarning,
                stacklevel=3,
            )

    def _roll_out_references(self) -> None:
        """Log a table of the reference policies' metrics for each size, and keep them for the lines."""
        metrics = self.task.metrics
        for size in self.task.sizes:
            rows = {
                name: self._reference_metrics(policy, size) for name, policy in self.task.reference_policies().items()
            }
            for name in metrics:
                self.references[f"{size}/{name}"] = {policy: row[name] for policy, row in rows.items()}
            table: list[list[str | float]] = [[policy, *row.values()] for policy, row in rows.items()]
            self.loggers.log_table(f"references/{size}", ["policy", *metrics], table)
        for name in {entry.option("objective") for entry in TRAINERS.values()} & set(metrics):
            lines = [self.references[f"{size}/{name}"] for size in self.task.sizes]
            self.references[name] = {policy: sum(line[policy] for line in lines) / len(lines) for policy in lines[0]}

    def _reference_metrics(self, policy: TensorDictModuleBase, size: int) -> dict[str, float]:
        """Metrics of a reference policy, by name; like those of a trainer's rollouts, sums are per step."""
        episodes = rollout(
            policy,
            self.task,
            num_agents=size,
            num_flocks=max(1, FLOCKS * self.config.env.reference_size // size),
            steps=self._steps,
            seed=derive_seed(self.config.seed, "references", size),
            device=self.config.device,
        )
        is_sum = {name: METRICS[name].options["over_time"] == "sum" for name in self.task.metrics}
        return {
            name: over_flocks(name, episodes[name]) / (self._steps if total else 1) for name, total in is_sum.items()
        }

    def _reference_of(self, metric: str) -> str:
        """The name in ``references`` of a metric, whose own name may begin with a policy's."""
        return metric if metric in self.references else "/".join(metric.split("/")[-2:])

    def _log_references(self) -> None:
        lines = {name: self.references[self._reference_of(name)] for name in sorted(self.shown)}
        self.loggers.log_references(self.last, lines)

    def _log_actions(self, index: int, rollouts: TensorDictBase) -> None:
        actions = rollouts["agents", "action"][rollouts["agents", "controlled"]].flatten()
        size = rollouts["agents", "action"].shape[-2]
        self.loggers.log_histogram(index, f"{size}/actions", actions[:: max(1, len(actions) // MAX_ACTIONS)])

    def _log_video(self) -> None:
        """Log a video of the first policy at the first size, always from the same start so that videos compare."""
        folder, size = self.run.path / "videos", self.task.sizes[0]
        recording = record(
            next(iter(self.policies.values())),
            self.task,
            num_agents=size,
            steps=self._steps,
            seed=derive_seed(self.config.seed, "references", size),
            stride=VIDEO_STRIDE,
            device=self.config.device,
        )
        folder.mkdir(exist_ok=True)
        path = folder / f"round_{self.last:05d}.mp4"
        write_video(path, recording)
        self.last_video = self.last
        self.loggers.log_video(self.last, f"{size}/rollout", path)


def log_evaluation(loggers: LoggerGroup, tables: Mapping[int, Mapping[str, Any]]) -> None:
    """Log the evaluation to dashboards, one table for each number of agents.

    Args:
        loggers: dashboards to log to.
        tables: by number of agents, as `modgnn_rl.evaluation.table.summarise_rollouts` makes them.
    """
    for size, table in tables.items():
        metrics = [name for name in METRICS if any(name in row for row in table.values())]
        rows: list[list[str | float]] = []
        for policy, row in table.items():
            cells = {name: row.get(name) or {} for name in metrics}
            values = [cell.get("min", cell.get("mean", math.nan)) for cell in cells.values()]
            rows.append([policy, *values, *(cells.get("error", {}).get(end, math.nan) for end in ("low", "high"))])
        loggers.log_table(f"evaluation/{size}", ["policy", *metrics, "error, low", "error, high"], rows)
