"""Callbacks: your own code, called while a trainer works; early stopping is one of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase

from modgnn_rl.nn.modgnn import ModGNN

__all__ = ["Callback", "StopOnPlateau"]


class Callback:
    """Base class of callbacks; every trainer calls the four methods below, which do nothing unless overridden.

    Example::

        class Print(Callback):
            def on_round(self, index, metrics):
                print(index, metrics["error"])

        modgnn_rl.experiment.training.train(config, callbacks=[Print()])
    """

    def on_start(self, policies: Mapping[str, ModGNN]) -> None:
        """Called when training starts or resumes.

        Args:
            policies: the policies that training will return, by name; their weights change during training.
        """

    def on_collect(self, index: int, rollouts: TensorDictBase) -> None:
        """Called when rollouts have been collected, before they are trained on.

        Args:
            index: number of the round.
            rollouts: [B, T]; changes made in place affect the training.
        """

    def on_round(self, index: int, metrics: Mapping[str, float]) -> bool | None:
        """Called at the end of a round.

        Args:
            index: number of the round.
            metrics: as in ``metrics.jsonl``.

        Returns:
            true to stop training after this round; the policies are then evaluated as usual.
        """

    def on_end(self, policies: Mapping[str, ModGNN]) -> None:
        """Called when training has ended, unless it was interrupted.

        Args:
            policies: the policies that training returns, by name.
        """

    def state(self) -> dict[str, Any]:
        """The state for checkpoints, as values that JSON can hold, so that runs resume exactly; default: empty."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what `state` returned; called before `on_start`, with ``{}`` if the run had no such callback."""


class StopOnPlateau(Callback):
    """Stops training when a metric no longer decreases.

    Training stops after a round if the metric's mean over the last ``rounds`` rounds is above ``1 - gain`` times its
    mean over the ``rounds`` rounds before them.

    Args:
        rounds: number of rounds to average over.
        gain: smallest relative decrease that counts as an improvement.
        after: number of the round after which rounds count, for example when the expert no longer acts.
        name: the metric; rounds in which it is missing or NaN do not count.
    """

    def __init__(self, rounds: int, gain: float, *, after: int = 0, name: str = "error") -> None:
        self.rounds, self.gain, self.after, self.name = rounds, gain, after, name
        self.seen: list[float] = []

    def on_round(self, index: int, metrics: Mapping[str, float]) -> bool:
        """Compare the metric with that of earlier rounds."""
        value = metrics.get(self.name, math.nan)
        if index > self.after and math.isfinite(value):
            self.seen.append(value)
        if len(self.seen) < 2 * self.rounds:
            return False
        before, now = sum(self.seen[-2 * self.rounds : -self.rounds]), sum(self.seen[-self.rounds :])
        return now > (1 - self.gain) * before

    def state(self) -> dict[str, Any]:
        """The values seen so far."""
        return {"seen": self.seen}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what `state` returned."""
        self.seen = list(state.get("seen", []))
