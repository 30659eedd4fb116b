"""Where people's own code is called while a trainer works, and stopping on a plateau, which is such code."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase

from modgnn_rl.nn.modgnn import ModGNN

__all__ = ["Callback", "StopOnPlateau"]


class Callback:
    """Called at four places of every trainer; each does nothing unless overridden.

    Example::

        class Print(Callback):
            def on_round(self, index, metrics):
                print(index, metrics["error"])

        modgnn_rl.experiment.training.train(config, callbacks=[Print()])
    """

    def on_start(self, policies: Mapping[str, ModGNN]) -> None:
        """Training begins.

        Args:
            policies: what will be returned at the end, by name; their weights change while training goes on.
        """

    def on_collect(self, index: int, rollouts: TensorDictBase) -> None:
        """Rollouts of a round have come in and are not yet learned from.

        Args:
            index: number of the round.
            rollouts: [B, T]; what is changed in place is learned from.
        """

    def on_round(self, index: int, metrics: Mapping[str, float]) -> bool | None:
        """A round is over.

        Args:
            index: number of the round.
            metrics: as in ``metrics.jsonl``.

        Returns:
            true to stop the training here; the policy is evaluated as at the planned end.
        """

    def on_end(self, policies: Mapping[str, ModGNN]) -> None:
        """Training is over, but not interrupted.

        Args:
            policies: what is returned, by name.
        """

    def state(self) -> dict[str, Any]:
        """What checkpoints hold, as plain JSON values, so that a resumed run goes on exactly; nothing by default."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave, before `on_start`; nothing where the run had no such callback."""


class StopOnPlateau(Callback):
    """Stop when a metric does not fall any more.

    Training stops after a round when the metric's mean over the last ``rounds`` rounds is not at least the share
    ``gain`` below that over the ``rounds`` rounds before them.

    Args:
        rounds: how many rounds are compared with as many before.
        gain: smallest relative improvement.
        after: rounds that are left out at first, while the expert still flies.
        name: the metric; rounds without it do not count.
    """

    def __init__(self, rounds: int, gain: float, *, after: int = 0, name: str = "error") -> None:
        self.rounds, self.gain, self.after, self.name = rounds, gain, after, name
        self.seen: list[float] = []

    def on_round(self, index: int, metrics: Mapping[str, float]) -> bool:
        """Look at the metric."""
        value = metrics.get(self.name, math.nan)
        if index > self.after and math.isfinite(value):
            self.seen.append(value)
        if len(self.seen) < 2 * self.rounds:
            return False
        before, now = sum(self.seen[-2 * self.rounds : -self.rounds]), sum(self.seen[-self.rounds :])
        return now > (1 - self.gain) * before

    def state(self) -> dict[str, Any]:
        """What was seen."""
        return {"seen": self.seen}

    def restore(self, state: Mapping[str, Any]) -> None:
        """See it again."""
        self.seen = list(state.get("seen", []))
