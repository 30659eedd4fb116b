"""The studies by name: which models fly where."""

from __future__ import annotations

import bisect
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from modgnn_rl.configs.schema import REFERENCE_SIZE, ReproduceConfig, ScaleConfig, as_list
from modgnn_rl.models.factory import make_model

__all__ = ["FAULTS", "HOPS", "Study", "Subject", "World", "equal_hidden", "fault_name", "study_of"]

GNNS = ("modgnn_mlp", "no_mid", "no_pre", "gcn", "gcn_final")
HOPS = (1, 2, 3)
KINDS = ("modgnn_mlp", "modgnn_adjacency", "gat", "mpnn")  # of f_com; ModGNN-MLP's is the Laplacian
SHAPES = ((1, 1), (1, 2), (1, 3), (2, 1), (3, 1))  # layers and hops
RANGES = (2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0)  # m
FAULTS: dict[str, tuple[tuple[float, dict[str, Any]], ...]] = {
    "share of messages lost": tuple((share, {"message_loss": share}) for share in (0.1, 0.3, 0.5)),
    "delay, steps": tuple((steps, {"delay": int(steps)}) for steps in (1, 2, 4, 8)),
    "noise of positions, m, and velocities, m/s": tuple(
        (noise, {"position_noise": noise, "velocity_noise": noise}) for noise in (0.02, 0.05, 0.1, 0.2)
    ),
    "drop-outs of an agent, 1/s": tuple((rate, {"dropout_rate": rate}) for rate in (0.01, 0.05, 0.1)),
}


@dataclass(frozen=True)
class Subject:
    """A model that is trained and flown."""

    model: str
    hops: int
    layers: int | None = None
    hidden: int = 32

    @property
    def key(self) -> str:
        """Its name in files."""
        shape = "" if self.layers is None else f"-L{self.layers}-h{self.hidden}"
        return f"{self.model}-K{self.hops}{shape}"


@dataclass(frozen=True)
class World:
    """Where policies are flown: how many flocks of how many agents, how long, and what is other than in training."""

    name: str
    num_agents: int
    flocks: int
    steps: int
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """Models, trained alike, and worlds to fly them in.

    Attributes:
        family: studies of one family share their trainings.
        subjects: the models.
        worlds: the worlds.
        updates: updates of each cloned model.
    """

    family: str
    subjects: Sequence[Subject]
    worlds: Sequence[World]
    updates: int

    def flies(self, subject: Subject, env_config: World) -> bool:
        """Whether a model can serve a world; Central serves one number of agents."""
        return subject.model != "central" or env_config.num_agents == 32


def study_of(config: ReproduceConfig) -> Study:
    """The models and worlds of a study."""
    scale = config.scale
    every = [Subject(model, hops) for model in GNNS for hops in HOPS]
    further = [Subject(model, hops) for model in as_list(config.models or []) for hops in as_list(config.hops)]
    usual = World("study-32", REFERENCE_SIZE, scale.study_episodes, scale.study_steps)
    if config.study == "communication":
        kinds = [Subject(model, hops) for model in KINDS for hops in (1, 2)]
        return Study("communication", kinds, [usual], scale.study_updates)
    if config.study == "layers":
        shapes = [
            Subject(model, hops, layers, equal_hidden(model, layers, hops))
            for model in ("modgnn_mlp", "no_mid", "no_pre")
            for layers, hops in SHAPES
        ]
        return Study("layers", shapes, [usual], scale.study_updates)
    if config.study == "tables":
        worlds = [World(f"N{size}", size, scale.eval_episodes, scale.eval_steps) for size in scale.sizes]
        subjects = dict.fromkeys([*every, Subject("central", 1), *further])
        return Study("tables", list(subjects), worlds, scale.updates)
    worlds = {"range": _ranges, "faults": _faulty, "size": _sizes}[config.study](scale)
    return Study("tables", list(dict.fromkeys([*every, *further])), worlds, scale.updates)


def _ranges(scale: ScaleConfig) -> list[World]:
    flown = (REFERENCE_SIZE, scale.study_episodes, scale.study_steps)
    return [World(f"range-{reach}", *flown, {"comm_range": reach}) for reach in RANGES]


def _faulty(scale: ScaleConfig) -> list[World]:
    flown = (REFERENCE_SIZE, scale.study_episodes, scale.study_steps)
    changes = [change for levels in FAULTS.values() for _, change in levels]
    return [World("study-32", *flown), *(World(fault_name(change), *flown, change) for change in changes)]


def fault_name(change: Mapping[str, Any]) -> str:
    """The name of the world with a fault."""
    name, level = next(iter(change.items()))
    return f"fault-{name}-{level}"


def _sizes(scale: ScaleConfig) -> list[World]:
    """Flocks of more agents are fewer, so that about as many agents fly."""
    return [
        World(f"size-{size}", size, max(2, scale.study_episodes * min(REFERENCE_SIZE, size) // size), scale.study_steps)
        for size in scale.study_sizes
    ]


@functools.cache
def equal_hidden(model: str, layers: int, hops: int) -> int:
    """The width of the hidden layers with which a model has as many parameters as ModGNN-MLP with K = 1, nearly."""

    def parameters(model: str, hops: int, hidden: int, layers: int) -> int:
        return sum(weights.numel() for weights in make_model(model, hops, hidden, layers=layers, seed=0).parameters())

    wanted = parameters("modgnn_mlp", 1, 32, 1)
    wider = bisect.bisect(range(1, 256), wanted, key=lambda hidden: parameters(model, hops, hidden, layers)) + 1
    return min((max(1, wider - 1), wider), key=lambda hidden: abs(parameters(model, hops, hidden, layers) - wanted))
