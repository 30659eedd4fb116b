"""The paper's evaluation in cells: the expert's flights, models trained on them, their errors there and in flight."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from modgnn_rl.cells import Cell, Outcome, Result
from modgnn_rl.collecting import collect
from modgnn_rl.configs.schema import (
    BCConfig,
    CollectConfig,
    DAggerConfig,
    EvaluationConfig,
    FlockingConfig,
    MAPPOConfig,
    ModelConfig,
    ReproduceConfig,
    TrainConfig,
)
from modgnn_rl.dataset import FlightDataset
from modgnn_rl.evaluation import Flights, fly, reference_policies
from modgnn_rl.experts import LocalReynolds
from modgnn_rl.loading import load_policy
from modgnn_rl.metrics import action_error
from modgnn_rl.progress import Progress
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.imitation import imitation_loss
from modgnn_rl.training import resume, train

__all__ = ["VALIDATION", "Measurements", "Study", "Subject", "World", "cells_of"]

VALIDATION = "validation"  # the world of the expert's held-out flights
STATES = 50  # of each held-out flight that the validation error is taken on
FLIGHT_SEED = 1_000_000
# Figures of a flight, one a flock; the spread is that over time and agents.
FIGURES = ("error", "leader_distance", "cohesion", "separation", "reward", "smallest_distance", "lost", "diverged")


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

    def flies(self, subject: Subject, world: World) -> bool:
        """Whether a model can serve a world; Central serves one number of agents."""
        return subject.model != "central" or world.num_agents == 32


def cells_of(config: ReproduceConfig, study: Study, folder: Path) -> list[Cell]:
    """What a study takes: a dataset, trainings, flights of the references and of all policies in all worlds."""
    scale = config.scale
    cells = [Cell("dataset", functools.partial(_collect, config, folder), cost=scale.episodes * scale.steps * 1e-4)]
    flights = []
    for world in study.worlds:
        cost = 4 * _flight_cost(world)
        flights.append(Cell(f"references-{world.name}", functools.partial(_fly_references, config, world), cost))
    cells.append(Cell(f"references-{VALIDATION}", functools.partial(_look_on, config, folder), 1.0, ("dataset",)))
    for seed in range(config.seeds):
        for group in _groups(study):
            cells.append(_cloning_cell(config, study, group, seed, folder))
            for subject in group:
                cells += _stages_after(config, study, subject, seed, folder)
                needs = (_policy_cell(config.after, study, subject, seed),)
                look = functools.partial(_validate, config, folder, subject)
                flights.append(Cell(_name(config, subject, seed, study, VALIDATION), look, 1.0, (*needs, "dataset")))
                for world in filter(functools.partial(study.flies, subject), study.worlds):
                    work = functools.partial(_fly, config, folder, subject, world)
                    flights.append(
                        Cell(_name(config, subject, seed, study, world.name), work, _flight_cost(world), needs)
                    )
    return cells + flights


def _flight_cost(world: World) -> float:
    """Seconds, roughly: a flight, a step and a pair of agents have costs of their own."""
    return 0.5 + world.steps * (0.015 + world.flocks * 5e-4 * (world.num_agents / 32) ** 1.7)


def _groups(study: Study) -> list[list[Subject]]:
    """Subjects that differ in their hops only: they are trained side by side."""
    groups: dict[tuple[Any, ...], list[Subject]] = {}
    for subject in study.subjects:
        groups.setdefault((subject.model, subject.layers, subject.hidden), []).append(subject)
    return list(groups.values())


def _name(config: ReproduceConfig, subject: Subject, seed: int, study: Study, world: str) -> str:
    return f"{study.family}-{config.after}-{subject.key}-seed{seed}-{world}"


def _policy_cell(after: str, study: Study, subject: Subject, seed: int) -> str:
    """The cell that makes a subject's policy."""
    if after == "cloning":
        group = next(group for group in _groups(study) if subject in group)
        hops = "".join(str(member.hops) for member in group)
        return f"{study.family}-cloning-{dataclasses.replace(subject, hops=int(hops)).key}-seed{seed}"
    return f"{study.family}-{after}-{subject.key}-seed{seed}"


def _cloning_cell(config: ReproduceConfig, study: Study, group: list[Subject], seed: int, folder: Path) -> Cell:
    scale, first = config.scale, group[0]
    name = _policy_cell("cloning", study, first, seed)
    trainer = BCConfig(
        hops=[subject.hops for subject in group],
        dataset=str(folder / "dataset"),
        held_out=scale.held_out,
        cloning_steps=4,  # of the flights that it looks at while it trains
        cloning_updates=study.updates,
        batch_size=scale.batch_size,
        rotate=False,  # the paper did not
        on_nonfinite="skip",
    )
    training = dataclasses.replace(
        _training(config, folder, name, seed),
        model=ModelConfig(first.model, first.hops, first.layers, first.hidden),
        trainer=trainer,
    )
    links = scale.batch_size * sum(subject.hops * (subject.layers or 1) for subject in group)
    cost = 3.0 + study.updates * (0.01 * len(group) + 3e-4 * links)  # seconds, roughly
    return Cell(name, functools.partial(_train, training, group, folder), cost, ("dataset",))


def _stages_after(config: ReproduceConfig, study: Study, subject: Subject, seed: int, folder: Path) -> list[Cell]:
    """DAgger from the cloned policy, and MAPPO from that, as far as asked for."""
    scale = config.scale
    dagger = DAggerConfig(
        rounds=scale.rounds,
        num_envs=scale.num_envs,
        cloning_steps=min(200, scale.steps),
        cloning_updates=0,
        batch_size=scale.batch_size,
        rotate=False,
    )
    mappo = MAPPOConfig(
        iterations=scale.iterations, num_envs=scale.num_envs, critic_warmup=min(10, scale.iterations // 4)
    )
    stages: list[tuple[str, DAggerConfig | MAPPOConfig, float]] = [
        ("dagger", dagger, 2.0 * scale.rounds),
        ("mappo", mappo, 5.0 * scale.iterations),
    ]
    before, cells = "cloning", []
    for stage, trainer, cost in stages[: ("cloning", "dagger", "mappo").index(config.after)]:
        name = _policy_cell(stage, study, subject, seed)
        need = _policy_cell(before, study, subject, seed)
        training = dataclasses.replace(_training(config, folder, name, seed), trainer=trainer)
        cells.append(Cell(name, functools.partial(_train, training, [subject], folder), cost, (need,)))
        before = stage
    return cells


def _training(config: ReproduceConfig, folder: Path, name: str, seed: int) -> TrainConfig:
    """What all trainings share; equal seeds draw equal batches, whatever the model."""
    return TrainConfig(
        env=config.env,
        evaluation=EvaluationConfig(num_flocks=2, steps=4),  # flights are cells of their own
        seed=derive_seed(config.seed, "seed", seed),
        device=config.device,
        threads=config.threads,
        runs=str(folder / "runs" / name),
        name="run",
    )


def _collect(config: ReproduceConfig, folder: Path, done: Mapping[str, Result]) -> Result:
    scale = config.scale
    flights = CollectConfig(
        env=config.env,
        episodes=scale.episodes + scale.held_out,
        steps=scale.steps,
        seed=derive_seed(config.seed, "dataset"),
        output=str(folder / "dataset"),
        device=config.device,
        threads=config.threads,
    )
    collect(flights)
    return {"episodes": flights.episodes}


def _train(config: TrainConfig, group: Sequence[Subject], folder: Path, done: Mapping[str, Result]) -> Result:
    """Train, or go on with what was stopped; the policies' folders, as seen from the reproduction's, by subject."""
    if not isinstance(config.trainer, BCConfig):
        (before,) = done.values()
        config = dataclasses.replace(config, init_from=str(folder / before["policies"][group[0].key]))
    root = Path(config.runs)
    root.mkdir(parents=True, exist_ok=True)
    begun = sorted(file.parent for file in root.glob("*/config.yaml"))
    # What trainers say for people who train one policy is kept beside the run.
    with (root / "output.txt").open("a", encoding="utf-8") as output, contextlib.redirect_stdout(output):
        if not begun:
            run = train(config)
        else:
            run = RunFolder.open(begun[-1])
            run = run if run.state == "finished" else resume(begun[-1])
    path = run.path.relative_to(folder)
    names = {subject.key: f"{subject.model}-K{subject.hops}" for subject in group}
    return {"policies": {key: str(path / name if len(group) > 1 else path) for key, name in names.items()}}


def _policy(config: ReproduceConfig, folder: Path, subject: Subject, done: Mapping[str, Result]) -> Any:
    made = next(result for result in done.values() if "policies" in result)
    return load_policy(folder / made["policies"][subject.key], device=config.device)


def _fly(config: ReproduceConfig, folder: Path, subject: Subject, world: World, done: Mapping[str, Result]) -> Result:
    policy = _policy(config, folder, subject, done)
    with Progress(f"{subject.key} flies in {world.name}", world.flocks * world.steps) as progress:
        return _fly_in(policy, config, world, progress)


def _fly_references(config: ReproduceConfig, world: World, done: Mapping[str, Result]) -> Result:
    policies = reference_policies(_changed(config, world))
    with Progress(f"references fly in {world.name}", len(policies) * world.flocks * world.steps) as progress:
        return {name: _fly_in(policy, config, world, progress) for name, policy in policies.items()}


def _changed(config: ReproduceConfig, world: World) -> FlockingConfig:
    return dataclasses.replace(config.env, num_agents=world.num_agents, **world.changes)


def _fly_in(policy: Any, config: ReproduceConfig, world: World, progress: Progress) -> Result:
    """The figures of flights from the same starts for all policies and seeds."""
    flights = fly(
        policy,
        _changed(config, world),
        num_agents=world.num_agents,
        num_flocks=world.flocks,
        steps=world.steps,
        seed=derive_seed(config.seed, FLIGHT_SEED),
        device=config.device,
        progress=progress,
    )
    return _figures(flights)


def _figures(flights: Flights) -> Result:
    figures = {name: getattr(flights, name).double() for name in FIGURES}
    for name, squares in flights.squares.items():
        figures[f"{name}_square"] = squares
        figures[f"{name}_spread"] = (squares - figures[name].square()).clamp(min=0).sqrt()
    return {name: values.tolist() for name, values in figures.items()}


def _held_out(config: ReproduceConfig, folder: Path, length: int) -> Any:
    """Windows [T, W] of each of the expert's held-out flights, evenly over the flight."""
    dataset = FlightDataset.open(folder / "dataset", verify=False, device=config.device)
    for episode in range(dataset.episodes - config.scale.held_out, dataset.episodes):
        steps = torch.linspace(0, dataset.steps - 1, min(STATES, dataset.steps)).round().long()
        yield dataset.windows(episode * dataset.steps + steps, length)


@torch.no_grad()
def _validate(config: ReproduceConfig, folder: Path, subject: Subject, done: Mapping[str, Result]) -> Result:
    """The error of a policy that looks on while the expert flies, one a flight."""
    policy = _policy(config, folder, subject, done)
    errors = []
    for windows in _held_out(config, folder, policy.window):
        errors.append(float(imitation_loss(policy, windows, windows["agents", "controlled"][:, -1])))
    return {"error": errors}


@torch.no_grad()
def _look_on(config: ReproduceConfig, folder: Path, done: Mapping[str, Result]) -> Result:
    """The same of the references."""
    policies = reference_policies(config.env)
    errors: dict[str, list[float]] = {name: [] for name in policies}
    for windows in _held_out(config, folder, 2):
        now = windows[:, -1]
        for name, policy in policies.items():
            seen = now.copy()
            if isinstance(policy, LocalReynolds):
                seen[policy.cache] = windows["agents", "observation"][:, 0]
            agents = policy(seen)["agents"]
            error = action_error(agents["action"], now["agents", "expert_action"], now["agents", "controlled"])
            errors[name].append(float(error.mean()))
    return {name: {"error": values} for name, values in errors.items()}


class Measurements:
    """What was measured, by row of a table and world.

    Args:
        outcome: of the cells of a study.
        config: its settings.
        study: the study.
    """

    def __init__(self, outcome: Outcome, config: ReproduceConfig, study: Study) -> None:
        self.outcome, self.config, self.study = outcome, config, study

    def values(self, row: Subject | str, world: str, figure: str) -> NDArray[np.float64] | None:
        """A figure of all flights [S, F] of each seed that did not fail; None where all did.

        Args:
            row: a subject, or the name of a reference.
            world: name of the world.
            figure: its name. What is no number counts as infinite: a flight that ended nowhere.
        """
        results = self.outcome.results
        if isinstance(row, str):
            found = [results.get(f"references-{world}", {}).get(row)]
        else:
            seeds = range(self.config.seeds)
            found = [results.get(_name(self.config, row, seed, self.study, world)) for seed in seeds]
        rows = [entry[figure] for entry in found if entry]
        return np.nan_to_num(np.array(rows, dtype=float), nan=np.inf, posinf=np.inf) if rows else None
