"""Record a rollout of one flock, for replays, images and videos."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.metrics import compute_metrics, unit_of
from modgnn_rl.registry import METRICS
from modgnn_rl.task import Task
from modgnn_rl.utils.progress import Progress
from modgnn_rl.visualization.recording import QUANTUM, Frame, MetricSeries, Recording, quantise, range_flips

__all__ = ["Recorder", "record"]

Array = NDArray[Any]


class Recorder:
    """Records one flock of a batch; `modgnn_rl.evaluation.rollout.rollout` calls it at each step.

    Args:
        task: says what is drawn.
        stride: steps from one recorded step to the next.
        flock: index of the flock.
    """

    def __init__(self, task: Task, stride: int = 1, flock: int = 0) -> None:
        self.task, self.stride, self.flock = task, stride, flock
        self.steps, self.is_over = 0, False
        plotted = [name for name in task.metrics if METRICS[name].options.get("replay")]
        positions_only = ("position",)
        self._of_positions = [
            name for name in plotted if METRICS[name].options.get("inputs", positions_only) == positions_only
        ]
        self._of_steps = [name for name in plotted if name not in self._of_positions]
        self._recorded: dict[str, list[Array]] = defaultdict(list)

    def __call__(self, tensordict: TensorDictBase) -> None:
        """Record the state before a step, with the policy's and the expert's actions, until the episode is over."""
        self.is_over |= self.steps > 0 and bool(tensordict["is_init"][self.flock])
        if not self.is_over and self.steps % self.stride == 0:
            flock = tensordict[self.flock]
            frame = self.task.frame(flock)
            quanta = quantise(frame.position)
            metrics = compute_metrics(self._of_steps, self.task.config, self.task.measured(flock))
            step = {
                "position": quanta,
                "arrow": frame.arrow,
                "marks": quantise(frame.marks),
                "present": frame.present,
                "flips": range_flips(frame.edges, quanta, frame.present, self.task.comm_range),
                **{name: value.cpu().numpy() for name, value in metrics.items()},
            }
            for name, value in step.items():
                self._recorded[name].append(value)
        self.steps += 1

    def recording(self) -> Recording:
        """The recording so far; metrics of positions are computed here, from the recorded ones."""
        position = np.stack(self._recorded["position"])
        metres = torch.from_numpy(position).double() * QUANTUM
        metrics = compute_metrics(self._of_positions, self.task.config, {"position": metres})
        values = {name: np.stack(self._recorded[name]) for name in self._of_steps}
        values |= {name: value.reshape(len(value), -1).mean(-1).numpy() for name, value in metrics.items()}
        arrows, marks = np.stack(self._recorded["arrow"]), np.stack(self._recorded["marks"])
        return Recording(
            position=position,
            arrow=arrows,
            present=np.stack(self._recorded["present"]),
            flips=self._recorded["flips"],
            metrics={
                name: MetricSeries(
                    METRICS[name].options["title"].capitalize(), unit_of(name, self.task.name), values[name]
                )
                for name in self.task.metrics
                if name in values
            },
            stride=self.stride,
            comm_range=self.task.comm_range,
            max_arrow=self.task.max_arrow or max(1e-6, float(np.linalg.norm(arrows, axis=-1).max())),
            frequency=self.task.frequency,
            marks=marks if marks.shape[1] else None,
            leader=self.task.leader,
            dims=self.task.dims,
            arrow_name=self.task.arrow_name if arrows.any() else "",
        )


def record(
    policy: TensorDictModuleBase,
    task: Task,
    *,
    num_agents: int,
    steps: int,
    seed: int,
    stride: int = 1,
    device: str = "cpu",
    progress: Progress | None = None,
    on_frame: Callable[[Frame], None] | None = None,
) -> Recording:
    """Roll out a policy in one flock and record it.

    Args:
        policy: see `modgnn_rl.evaluation.rollout.rollout`.
        task: of the policy; its expert is the reference of the error.
        num_agents: agents in the flock.
        steps: steps of the rollout, unless the task ends the episode earlier.
        seed: seed of the initial state.
        stride: record every ``stride``-th step.
        device: device of the rollout.
        progress: counts steps.
        on_frame: called with the frame of each step, such as a `modgnn_rl.visualization.viewer.Viewer`.
    """
    recorder = Recorder(task, stride)

    def on_step(tensordict: TensorDictBase) -> None:
        recorder(tensordict)
        if on_frame is not None:
            on_frame(task.frame(tensordict[0]))

    rollout(
        policy,
        task,
        num_agents=num_agents,
        num_flocks=1,
        steps=steps,
        seed=seed,
        device=device,
        progress=progress,
        watch=on_step,
    )
    return recorder.recording()
