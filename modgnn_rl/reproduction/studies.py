"""The studies by name: models, and the settings in which they are evaluated."""

from __future__ import annotations

import bisect
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from modgnn_rl.actions import Ball
from modgnn_rl.configs.schema import ReproduceConfig, ScaleConfig, TaskConfig, as_list
from modgnn_rl.layout import STATE, Layout
from modgnn_rl.models.factory import make_model
from modgnn_rl.task import make_task

__all__ = [
    "HOPS",
    "PERTURBATIONS",
    "EvalSetting",
    "ModelVariant",
    "Study",
    "equal_hidden",
    "perturbation_name",
    "study_of",
]

GNNS = ("modgnn_mlp", "no_mid", "no_pre", "gcn", "gcn_final")
HOPS = (1, 2, 3)
KINDS = ("modgnn_mlp", "modgnn_adjacency", "gat", "mpnn")  # of f_com; ModGNN-MLP's is the Laplacian
SHAPES = ((1, 1), (1, 2), (1, 3), (2, 1), (3, 1))  # layers and hops
RANGES = (2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0)  # m, of the paper's task
SHARES = (0.5, 0.75, 1.0, 1.5, 2.0)  # of the range in training, of other tasks
PERTURBATIONS: dict[str, tuple[tuple[float, dict[str, Any]], ...]] = {
    "packet loss": tuple((share, {"message_loss": share}) for share in (0.1, 0.3, 0.5)),
    "delay, steps": tuple((steps, {"delay": int(steps)}) for steps in (1, 2, 4, 8)),
    "noise of positions, m, and velocities, m/s": tuple(
        (noise, {"position_noise": noise, "velocity_noise": noise}) for noise in (0.02, 0.05, 0.1, 0.2)
    ),
    "dropouts of an agent, 1/s": tuple((rate, {"dropout_rate": rate}) for rate in (0.01, 0.05, 0.1)),
}


@dataclass(frozen=True)
class ModelVariant:
    """A model that is trained and evaluated."""

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
class EvalSetting:
    """How policies are evaluated: agents, episodes, steps, and env settings that differ from training."""

    name: str
    num_agents: int
    flocks: int
    steps: int
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """Models, trained alike, and settings to evaluate them in.

    Attributes:
        family: studies of one family share their trainings.
        variants: the models.
        settings: the evaluation settings.
        updates: updates of each cloned model.
        trained: number of agents in training.
    """

    family: str
    variants: Sequence[ModelVariant]
    settings: Sequence[EvalSetting]
    updates: int
    trained: int

    def applies(self, variant: ModelVariant, setting: EvalSetting) -> bool:
        """Whether a model can be evaluated in a setting; Central serves one number of agents."""
        return variant.model != "central" or setting.num_agents == self.trained


def study_of(config: ReproduceConfig) -> Study:
    """The study that a configuration asks for."""
    scale, trained = config.scale, config.env.reference_size
    every = [ModelVariant(model, hops) for model in GNNS for hops in HOPS]
    further = [ModelVariant(model, hops) for model in as_list(config.models or []) for hops in as_list(config.hops)]
    usual = EvalSetting(f"study-{trained}", trained, scale.study_episodes, scale.study_steps)
    if config.study == "communication":
        kinds = [ModelVariant(model, hops) for model in KINDS for hops in (1, 2)]
        return Study("communication", kinds, [usual], scale.study_updates, trained)
    if config.study == "layers":
        task = make_task(config.env)
        shapes = [
            ModelVariant(model, hops, layers, equal_hidden(model, layers, hops, task.layout, task.actions.width))
            for model in ("modgnn_mlp", "no_mid", "no_pre")
            for layers, hops in SHAPES
        ]
        return Study("layers", shapes, [usual], scale.study_updates, trained)
    if config.study == "tables":
        sizes = dict.fromkeys([*scale.sizes, trained])
        settings = [EvalSetting(f"N{size}", size, scale.eval_episodes, scale.eval_steps) for size in sizes]
        variants = dict.fromkeys([*every, ModelVariant("central", 1), *further])
        return Study("tables", list(variants), settings, scale.updates, trained)
    settings = {"range": _ranges, "faults": _perturbed, "size": _sizes}[config.study](scale, config.env)
    return Study("tables", list(dict.fromkeys([*every, *further])), settings, scale.updates, trained)


def _ranges(scale: ScaleConfig, env: TaskConfig) -> list[EvalSetting]:
    episodes = (env.reference_size, scale.study_episodes, scale.study_steps)
    own = (
        RANGES
        if env.name == ReproduceConfig().env.name
        else [share * float(getattr(env, "comm_range", 1.0)) for share in SHARES]
    )
    return [EvalSetting(f"range-{reach}", *episodes, {"comm_range": reach}) for reach in own]


def _perturbed(scale: ScaleConfig, env: TaskConfig) -> list[EvalSetting]:
    episodes = (env.reference_size, scale.study_episodes, scale.study_steps)
    changes = [change for levels in PERTURBATIONS.values() for _, change in levels]
    return [
        EvalSetting(f"study-{env.reference_size}", *episodes),
        *(EvalSetting(perturbation_name(change), *episodes, change) for change in changes),
    ]


def perturbation_name(change: Mapping[str, Any]) -> str:
    """The name of the evaluation setting with a perturbation."""
    name, level = next(iter(change.items()))
    return f"fault-{name}-{level}"


def _sizes(scale: ScaleConfig, env: TaskConfig) -> list[EvalSetting]:
    """Settings by flock size; fewer episodes of larger flocks, so that the number of agents is about the same."""
    return [
        EvalSetting(
            f"size-{size}",
            size,
            max(2, scale.study_episodes * min(env.reference_size, size) // size),
            scale.study_steps,
        )
        for size in dict.fromkeys([*scale.study_sizes, env.reference_size])
    ]


@functools.cache
def equal_hidden(model: str, layers: int, hops: int, layout: Layout = STATE, width: int = 3) -> int:
    """The hidden width with which a model has about as many parameters as ModGNN-MLP with K = 1."""

    def parameters(model: str, hops: int, hidden: int, layers: int) -> int:
        policy = make_model(model, hops, hidden, layers=layers, layout=layout, head=Ball(1.0, width), seed=0)
        return policy.num_parameters

    wanted = parameters("modgnn_mlp", 1, 32, 1)
    wider = bisect.bisect(range(1, 256), wanted, key=lambda hidden: parameters(model, hops, hidden, layers)) + 1
    return min((max(1, wider - 1), wider), key=lambda hidden: abs(parameters(model, hops, hidden, layers) - wanted))
