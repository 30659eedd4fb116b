"""The training loop that all trainers share: rounds, metrics, checkpoints, callbacks and signals."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Protocol

from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.state import Checkpointable, Learner
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.loop.checkpointer import BestPolicies, Checkpointer
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.metrics_writer import MetricsWriter
from modgnn_rl.utils.progress import Progress
from modgnn_rl.utils.signals import Stopped

__all__ = ["Rollouts", "TrainingLoop"]

BEST_ROUNDS = 5  # rounds over which the scores of the best policy are averaged


class Rollouts(Checkpointable, Protocol):
    """Environments that a run collects from."""

    def close(self) -> None:
        """Shut them down."""


class TrainingLoop:
    """Counts the rounds of a run, writes metrics and checkpoints, calls callbacks and obeys signals.

    Entering it resumes the run from the context's checkpoint; leaving it shuts the environments down. In distributed
    training the first process alone writes, and metrics are means over all.

    Example::

        with TrainingLoop(context, {"policy": learner}, buffers, total=updates) as loop:
            for index in loop.rounds(1, 80):
                rollouts = loop.on_collect(...)
                loop.log({"loss": loss}, updates_per_round, {"policy": loss})

    Args:
        context: the run.
        learners: by name; the first is the one that `modgnn_rl.load_policy` finds.
        rollouts: environments that the run collects training data from, by flock size.
        validation: those for validation data, by flock size.
        total: updates, or whatever ``unit`` says, of the whole run.
        unit: what is counted.

    Attributes:
        round: number of rounds completed.
        step: number of the current round.
        state: values that the trainer itself needs in order to resume; checkpoints hold them (JSON only).
    """

    def __init__(
        self,
        context: TrainContext,
        learners: Mapping[str, Learner],
        rollouts: Mapping[int, Rollouts],
        validation: Mapping[int, Rollouts] | None = None,
        *,
        total: int,
        unit: str = "updates",
    ) -> None:
        self.context, self.learners, self.total, self.unit = context, dict(learners), total, unit
        named = {f"rollouts-{size}": group for size, group in rollouts.items()}
        self.rollouts = named | {f"validation-{size}": group for size, group in (validation or {}).items()}
        self.checkpointer = Checkpointer(context.run, context.config.trainer, self.learners, self.rollouts)
        self.best = BestPolicies(context.run, self.learners)
        self.state: dict[str, Any] = {}
        self.round = self.step = self.count = 0
        self._stops = False
        self._seconds = 0.0

    @property
    def policies(self) -> dict[str, ModGNN]:
        """The policies so far, by the learners' names."""
        return {name: learner.ema_policy for name, learner in self.learners.items()}

    def __enter__(self) -> TrainingLoop:
        """Resume from the checkpoint, if there is one, and start the progress bar."""
        self._restore()
        distributed.broadcast(self._weights())
        self._start = time.monotonic()
        name = self.context.config.trainer.name
        self.writer = MetricsWriter(self.context.run, self.context.loggers, self.unit)
        self.progress = Progress(name, self.total, unit=self.unit, done=self.count)
        self._write_status("training")
        for callback in self.context.callbacks:
            callback.on_start(self.policies)
        if distributed.is_first():
            self.progress.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop progress bar and environments; unless there was an exception, write the last checkpoint."""
        if distributed.is_first():
            self.progress.__exit__(kind, error, trace)
        try:
            if kind is None:
                self._save_best()
                self._save(fatal=True)
                for callback in self.context.callbacks:
                    callback.on_end(self.policies)
        finally:
            for group in self.rollouts.values():
                group.close()

    def rounds(self, first: int, last: int) -> Iterator[int]:
        """Numbers of the rounds that remain; between rounds, checkpoints are written and signals obeyed.

        Args:
            first: number of the first round of the run.
            last: number of its last round.

        Raises:
            modgnn_rl.utils.signals.Stopped: there was a signal; raised after the current round and its checkpoint.
        """
        interrupt = self.context.interrupt
        advice = "Stopping after this round, with a checkpoint. Press again to stop at once, without one."
        with interrupt.deferred(advice if distributed.is_first() else ""):
            while first + self.round <= last and not self._stops:
                self.step = first + self.round
                yield self.step
                self.round += 1
                if self.round % BEST_ROUNDS == 0:
                    self._save_best()
                interrupted, is_due, self._stops = distributed.any_of(
                    interrupt.is_requested, self.checkpointer.is_due, self._stops
                )
                if interrupted:
                    self._save(fatal=True)
                    self._write_status("stopped")
                    interrupt.check()
                    raise Stopped(signal.SIGTERM)  # the signal went to another process
                if is_due:
                    self._save()

    def on_collect(self, rollouts: TensorDictBase) -> TensorDictBase:
        """Show rollouts to the callbacks before they are trained on; returns the same rollouts."""
        for callback in self.context.callbacks:
            callback.on_collect(self.step, rollouts)
        return rollouts

    def log(self, metrics: Mapping[str, float], count: int, scores: Mapping[str, float], **shown: float | str) -> None:
        """Record the metrics of the current round.

        Args:
            metrics: by name.
            count: how much of ``total`` was done in this round.
            scores: by the learner's name; the policy with the lowest score, averaged over some rounds, is the best.
            shown: what the progress bar shows.
        """
        self.count += count
        metrics, scores = distributed.mean(metrics), distributed.mean(scores)
        if distributed.is_first():
            self.best.add(scores)
            self.writer.write(self.step, metrics, count)
            self.progress.update(count, **{name: metrics.get(name, value) for name, value in shown.items()})
        stops = [callback.on_round(self.step, metrics) for callback in self.context.callbacks]  # all are called
        self._stops = any(stops)

    def _save_best(self) -> None:
        if distributed.is_first():
            self.best.save(self.round)

    def _save(self, *, fatal: bool = False) -> None:
        """Write a checkpoint, after a check that all processes have the same weights."""
        distributed.check_alike(self._weights(), f"after round {self.round}")
        self.writer.flush(fatal=fatal)
        values = {
            "round": self.round,
            "count": self.count,
            "loop": self.state,
            "callbacks": {name: callback.state() for name, callback in self._named_callbacks()},
            "seconds": self._seconds_trained,
            **self.best.state(),
        }
        if self.checkpointer.save(self.round, values, fatal=fatal):
            self._write_status("training")

    def _restore(self) -> None:
        """Resume from the context's checkpoint, if there is one."""
        checkpoint = self.context.checkpoint
        if checkpoint is None:
            if distributed.is_first():
                self.context.run.cut_metrics(0)
            return
        try:
            values = self.checkpointer.restore(checkpoint, with_rollouts=self.context.restore_rollouts)
            self.round, self.count, self.state = int(values["round"]), int(values["count"]), values["loop"]
            self._seconds = float(values["seconds"])
            self.best.restore(values)
            for name, callback in self._named_callbacks():
                callback.restore(values["callbacks"].get(name, {}))
            if distributed.is_first():
                self.context.run.cut_metrics(int(values["metrics_bytes"]))
        except (KeyError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"{checkpoint.path} does not fit this run ({reason}): resume it with the settings and the version that "
                "wrote it, or start a new run with init_from="
            ) from error

    def _weights(self) -> list[Tensor]:
        """All tensors of the learners."""
        groups = [group for learner in self.learners.values() for group in learner.state()[0].values()]
        return [value for group in groups for value in group.values()]

    def _named_callbacks(self) -> list[tuple[str, Callback]]:
        """The callbacks by class, and a number for those of the same class."""
        callbacks = self.context.callbacks
        kinds = [type(callback).__qualname__ for callback in callbacks]
        return [
            (f"{kind}-{kinds[:index].count(kind)}", callback)
            for index, (kind, callback) in enumerate(zip(kinds, callbacks, strict=True))
        ]

    @property
    def _seconds_trained(self) -> float:
        return self._seconds + time.monotonic() - self._start

    def _write_status(self, state: str) -> None:
        """Write the status of the run; a full disk does not stop it."""
        if not distributed.is_first():
            return
        progress: dict[str, Any] = {"round": self.round, "done": self.count, "total": self.total, "unit": self.unit}
        with contextlib.suppress(OSError):
            self.context.run.note_status(state, **progress, seconds=round(self._seconds_trained, 1))
