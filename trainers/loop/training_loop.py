"""What a training run leaves behind while it goes on: metrics, a progress bar, checkpoints."""

from __future__ import annotations

import contextlib
import math
import shlex
import signal
import time
import warnings
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.configs.schema import TrainerConfig
from modgnn_rl.errors import InputError
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.checkpoint import save_checkpoint
from modgnn_rl.trainers.collectors.flocks import FlockBuffer
from modgnn_rl.trainers.collectors.local import FlockCollector
from modgnn_rl.trainers.collectors.remote import RemoteCollector
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.state import Checkpointable, Learner, collect_state, restore_state
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.utils.progress import Progress
from modgnn_rl.utils.signals import Stopped

__all__ = ["TrainingLoop"]

BEST_ROUNDS = 5  # rounds over which scores are averaged
SAVING_SHARE = 1 / 70  # of the time goes into checkpoints at most: large data are written less often


class TrainingLoop:
    """Counts the rounds of a run, writes their metrics and checkpoints, and calls the callbacks.

    A run that goes on from a checkpoint begins with all as it was there, once the journal is entered. Where several
    processes train together, the first alone writes, and metrics are means over all.

    Args:
        context: the run.
        learners: by name; the first is the one that `modgnn_rl.load_policy` finds.
        flocks: the flocks flown, by name; they are closed at the end.
        total: updates, or what else ``unit`` says, of the whole run.
        unit: what is counted.

    Attributes:
        round: rounds that are done.
        step: number of the round that goes on.
        memory: plain values that the trainer needs to go on; checkpoints hold them.
    """

    def __init__(
        self,
        context: TrainContext,
        learners: Mapping[str, Learner],
        flocks: Mapping[str, FlockBuffer | FlockCollector | RemoteCollector],
        total: int,
        *,
        unit: str = "updates",
    ) -> None:
        self.context, self.learners, self.flocks = context, dict(learners), dict(flocks)
        self.settings: TrainerConfig = context.config.trainer
        self.run, self.callbacks = context.run, context.callbacks
        self.state: dict[str, Any] = {}
        self.round = self.step = self.count = 0
        self.total, self.unit = total, unit
        self._wants_to_stop = False
        self._unwritten: list[tuple[int, dict[str, float]]] = []
        self._scores: dict[str, list[float]] = {}
        self._best: dict[str, float] = {}
        self._saved = -1  # the round of the last checkpoint
        self._seconds = self._cost = 0.0

    @property
    def policies(self) -> dict[str, ModGNN]:
        """The policies so far, by the learners' names."""
        return {name: learner.ema_policy for name, learner in self.learners.items()}

    def __enter__(self) -> TrainingLoop:
        """Go on from the checkpoint, if there is one, and start the progress bar."""
        self._restore()
        distributed.broadcast(self._weights())
        self._began = self._saved_at = self._noted_at = time.monotonic()
        self.progress = Progress(self.settings.name, self.total, unit=self.unit, done=self.count)
        self._note_status("training")
        for callback in self.callbacks:
            callback.on_start(self.policies)
        if distributed.is_first():
            self.progress.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop progress bar and rollouts; unless something went wrong, write the last checkpoint."""
        if distributed.is_first():
            self.progress.__exit__(kind, error, trace)
        try:
            if kind is None:
                self._save_best()
                self._save(last=True)
                for callback in self.callbacks:
                    callback.on_end(self.policies)
        finally:
            for group in self.flocks.values():
                group.close()

    def rounds(self, first: int, last: int) -> Iterator[int]:
        """Numbers of the rounds that are left; between two, checkpoints are written and signals heeded.

        Args:
            first: number of the first round of the run.
            last: number of its last.

        Raises:
            modgnn_rl.utils.signals.Stopped: after the round in which a signal came, and after its checkpoint.
        """
        interruption = self.context.interruption
        advice = "Stopping after this round, with a checkpoint; once more stops at once, without one."
        with interruption.deferred(advice if distributed.is_first() else ""):
            while first + self.round <= last and not self._wants_to_stop:
                self.step = first + self.round
                yield self.step
                self.round += 1
                if self.round % BEST_ROUNDS == 0:
                    self._save_best()
                asked, is_due, self._wants_to_stop = distributed.any_of(
                    interruption.is_asked_for, self._is_due, self._wants_to_stop
                )
                if asked:
                    self._save(last=True)
                    self._note_status("stopped")
                    interruption.check()
                    raise Stopped(signal.SIGTERM)  # it was another process that was asked
                if is_due:
                    self._save()

    def on_collect(self, rollouts: TensorDictBase) -> TensorDictBase:
        """Show rollouts of this round to the callbacks before they are learned from; returns them."""
        for callback in self.callbacks:
            callback.on_collect(self.step, rollouts)
        return rollouts

    def log(
        self, metrics: Mapping[str, float], count: int, scores: Mapping[str, float], **figures: float | str
    ) -> None:
        """Record the metrics of this round.

        Args:
            metrics: its metrics.
            count: how much of the total was done in it.
            scores: what makes a policy the best so far, the lower the better, by the learner's name.
            figures: what the progress bar shows.
        """
        self.count += count
        metrics, scores = distributed.mean(metrics), distributed.mean(scores)
        if distributed.is_first():
            self._record(metrics, count, scores, {name: metrics.get(name, value) for name, value in figures.items()})
        wishes = [callback.on_round(self.step, metrics) for callback in self.callbacks]  # all are called
        self._wants_to_stop = any(wishes)

    def _record(
        self, metrics: Mapping[str, float], count: int, scores: Mapping[str, float], figures: Mapping[str, float | str]
    ) -> None:
        """Write the metrics of this round wherever they are looked at; see `log`."""
        for name, score in scores.items():
            self._scores.setdefault(name, []).extend([score] if math.isfinite(score) else [])
        self._unwritten.append((self.step, dict(metrics)))
        self._write_metrics()
        now = time.monotonic()
        speed = {"time/round": now - self._noted_at, f"time/{self.unit}_per_second": count / (now - self._noted_at)}
        self._noted_at = now
        self.context.loggers.log(self.step, {**metrics, **speed})
        self.progress.update(count, **figures)

    def _write_metrics(self, *, last: bool = False) -> None:
        """Append what is not yet written to ``metrics.jsonl``; where that fails, try again after the next round."""
        try:
            while self._unwritten:
                self.run.log(*self._unwritten[0])
                self._unwritten.pop(0)
        except OSError as error:
            self._complain("metrics.jsonl", error, last=last)

    def _save(self, *, last: bool = False) -> None:
        """Write a checkpoint of this round, unless there is one; where that fails, try again later."""
        distributed.check_alike(self._weights(), f"after round {self.round}")
        self._write_metrics(last=last)
        if self._saved == self.round or not distributed.is_first():
            return
        began = time.monotonic()
        try:
            tensors, values = collect_state(self._parts())
            save_checkpoint(
                self.run.checkpoints, self.round, tensors, values | self._values(), keep=self.settings.keep_checkpoints
            )
            self._saved = self.round
            self._note_status("training")
        except OSError as error:
            self._complain("a checkpoint", error, last=last)
        self._saved_at = time.monotonic()
        self._cost = (self._saved_at - began) / SAVING_SHARE

    @property
    def _is_due(self) -> bool:
        """Whether it is time for the next checkpoint; it is the first process that writes them."""
        period = 60 * self.settings.checkpoint_minutes
        return distributed.is_first() and (period == 0 or time.monotonic() - self._saved_at > max(period, self._cost))

    def _save_best(self) -> None:
        """Write the policies whose mean score in the last rounds is the best so far."""
        for name, scores in self._scores.items() if distributed.is_first() else ():
            score = sum(scores) / len(scores) if scores else math.inf
            scores.clear()
            if score >= self._best.get(name, math.inf):
                continue
            folder = self.run.best if len(self._scores) == 1 else self.run.path / name / "best"
            policy = {"policy": self.learners[name].ema_policy.state_dict()}
            try:
                save_checkpoint(folder, self.round, policy, {"score": score}, keep=1)
                self._best[name] = score
            except OSError as error:
                self._complain("the best policy", error, last=False)

    def _parts(self, *, with_flocks: bool = True) -> dict[str, Checkpointable]:
        flocks = {f"flocks-{name}": group for name, group in self.flocks.items()} if with_flocks else {}
        return {**self.learners, **flocks}

    def _weights(self) -> list[Tensor]:
        """All that the learners hold."""
        groups = [group for learner in self.learners.values() for group in learner.state()[0].values()]
        return [value for group in groups for value in group.values()]

    def _values(self) -> dict[str, Any]:
        """What a checkpoint holds of the run itself."""
        return {
            "config": self.run.config,
            "learners": list(self.learners),
            "round": self.round,
            "count": self.count,
            "memory": self.state,
            "callbacks": {name: callback.state() for name, callback in self._named_callbacks()},
            "best": self._best,
            "scores": self._scores,
            "metrics_bytes": self.run.sync_metrics(),
            "seconds": self._seconds + time.monotonic() - self._began,
        }

    def _restore(self) -> None:
        """Go on from the context's checkpoint, or begin."""
        checkpoint = self.context.checkpoint
        first = distributed.is_first()
        if checkpoint is None:
            if first:
                self.run.cut_metrics(0)
            return
        values = checkpoint.state
        try:
            restore_state(self._parts(with_flocks=self.context.keeps_flocks), checkpoint, with_generators=first)
            self.round = self._saved = int(values["round"])
            self.count, self.state, self._best = int(values["count"]), values["memory"], values["best"]
            self._scores = values["scores"]
            self._seconds = float(values["seconds"])
            for name, callback in self._named_callbacks():
                callback.restore(values["callbacks"].get(name, {}))
            if first:
                self.run.cut_metrics(int(values["metrics_bytes"]))
        except (KeyError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"{checkpoint.path} does not fit this run ({reason}): resume with the settings and the version that "
                "made it, or begin a run with init_from="
            ) from error

    def _named_callbacks(self) -> list[tuple[str, Callback]]:
        """The callbacks by their kinds, with a number where there are several of a kind."""
        kinds = [type(callback).__qualname__ for callback in self.callbacks]
        return [
            (f"{kind}-{kinds[:index].count(kind)}", callback)
            for index, (kind, callback) in enumerate(zip(kinds, self.callbacks, strict=True))
        ]

    def _note_status(self, state: str) -> None:
        """Write how the run stands; a disk that is full does not stop it."""
        if not distributed.is_first():
            return
        seconds = self._seconds + time.monotonic() - self._began
        figures: dict[str, Any] = {"round": self.round, "done": self.count, "total": self.total, "unit": self.unit}
        with contextlib.suppress(OSError):
            self.run.note_status(state, **figures, seconds=round(seconds, 1))

    def _complain(self, what: str, error: OSError, *, last: bool) -> None:
        reason = f"{what} cannot be written into {self.run.path} ({error.strerror or error})"
        if last:
            raise InputError(
                f"{reason}: make room, then go on from the last checkpoint with python -m modgnn_rl.train "
                f"{shlex.quote(f'resume={self.run.path}')}"
            ) from error
        warnings.warn(f"{reason}; training goes on, and tries again later", RuntimeWarning, stacklevel=3)
