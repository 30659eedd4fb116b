"""Checkpoints of a run, and of the best policies of a run."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from modgnn_rl.configs.schema import TrainerConfig
from modgnn_rl.tracking.checkpoint import Checkpoint, save_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.state import Checkpointable, Learner, collect_state, restore_state
from modgnn_rl.trainers.loop.metrics_writer import report_write_error

__all__ = ["BestPolicies", "Checkpointer"]

MAX_TIME_FRACTION = 1 / 70  # of the training time that writing may take: large checkpoints are written less often


class Checkpointer:
    """Writes and restores the checkpoints of a run; in distributed training the first process writes them.

    Args:
        run: the run folder.
        settings: how often, and how many are kept.
        learners: by name; the first is the one that `modgnn_rl.load_policy` finds.
        rollouts: environments with the data collected from them, by name.
    """

    def __init__(
        self,
        run: RunFolder,
        settings: TrainerConfig,
        learners: Mapping[str, Learner],
        rollouts: Mapping[str, Checkpointable],
    ) -> None:
        self.run, self.settings, self.learners, self.rollouts = run, settings, learners, rollouts
        self._saved_round = -1
        self._saved_at, self._pause = time.monotonic(), 0.0

    @property
    def is_due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        period = 60 * self.settings.checkpoint_minutes
        return distributed.is_first() and (period == 0 or time.monotonic() - self._saved_at > max(period, self._pause))

    def save(self, round_: int, values: Mapping[str, Any], *, fatal: bool = False) -> bool:
        """Write a checkpoint unless there is one of this round.

        Args:
            round_: number of rounds completed.
            values: what else to save, limited to what JSON holds.
            fatal: whether it is an error if the checkpoint cannot be written; otherwise there is a warning.

        Returns:
            whether one was written.

        Raises:
            InputError: see ``fatal``.
        """
        if self._saved_round == round_ or not distributed.is_first():
            return False
        start = time.monotonic()
        try:
            tensors, state = collect_state({**self.learners, **self.rollouts})
            state |= {"config": self.run.config, "learners": list(self.learners), **values}
            state["metrics_bytes"] = self.run.sync_metrics()
            save_checkpoint(self.run.checkpoints, round_, tensors, state, keep=self.settings.keep_checkpoints)
            self._saved_round = round_
        except OSError as error:
            report_write_error(self.run, "a checkpoint", error, fatal=fatal)
        self._saved_at = time.monotonic()
        self._pause = (self._saved_at - start) / MAX_TIME_FRACTION
        return self._saved_round == round_

    def restore(self, checkpoint: Checkpoint, *, with_rollouts: bool) -> dict[str, Any]:
        """Return to a checkpoint.

        Args:
            checkpoint: the checkpoint.
            with_rollouts: whether to restore environments and data; if not, they start afresh.

        Returns:
            the values that `save` was given, and all others.

        Raises:
            KeyError, ValueError, RuntimeError: the checkpoint does not fit this run.
        """
        parts = {**self.learners, **(self.rollouts if with_rollouts else {})}
        restore_state(parts, checkpoint, with_generators=distributed.is_first())
        self._saved_round = checkpoint.step
        self._saved_at = time.monotonic()
        return checkpoint.state


class BestPolicies:
    """Saves each policy whenever its mean score over some rounds is the lowest so far.

    Args:
        run: the run folder; with several policies each has its own folder inside.
        learners: by name.
    """

    def __init__(self, run: RunFolder, learners: Mapping[str, Learner]) -> None:
        self.run, self.learners = run, learners
        self._best: dict[str, float] = {}
        self._scores: dict[str, list[float]] = {}

    def add(self, scores: Mapping[str, float]) -> None:
        """Add the scores of one round, by the learners' names; NaN does not count."""
        for name, score in scores.items():
            self._scores.setdefault(name, []).extend([score] if math.isfinite(score) else [])

    def save(self, round_: int) -> None:
        """Save the policies whose mean score since the last call is the best so far."""
        for name, scores in self._scores.items():
            score = sum(scores) / len(scores) if scores else math.inf
            scores.clear()
            if score >= self._best.get(name, math.inf):
                continue
            folder = self.run.best if len(self._scores) == 1 else self.run.path / name / "best"
            policy = {"policy": self.learners[name].ema_policy.state_dict()}
            try:
                save_checkpoint(folder, round_, policy, {"score": score}, keep=1)
                self._best[name] = score
            except OSError as error:
                report_write_error(self.run, "the best policy", error)

    def state(self) -> dict[str, Any]:
        """The best scores, and those since the last call of `save`."""
        return {"best": self._best, "scores": self._scores}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what `state` returned."""
        self._best, self._scores = state["best"], state["scores"]
