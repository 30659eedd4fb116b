"""A study in cells: the expert's rollouts, models trained on them, and what is measured of these."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from modgnn_rl.configs.schema import (
    BCConfig,
    CollectConfig,
    DAggerConfig,
    EvaluationConfig,
    MAPPOConfig,
    ModelConfig,
    ReproduceConfig,
    TrainConfig,
)
from modgnn_rl.data.collect import collect
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.reproduction.measurements import VALIDATION, flight_cell, fly_references, fly_subject, look_on, validate
from modgnn_rl.reproduction.studies import Study, Subject, World
from modgnn_rl.reproduction.tasks import Cell, Result
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["cells_of"]


def cells_of(config: ReproduceConfig, study: Study, folder: Path) -> list[Cell]:
    """What a study takes: a dataset, trainings, rollouts of the references and of all policies in all worlds."""
    scale = config.scale
    cost = scale.episodes * scale.steps * 1e-4
    is_there = functools.partial(_is_dataset_there, folder)
    cells = [Cell("dataset", functools.partial(_collect, config, folder), cost, is_there=is_there)]
    rollouts = []
    for env_config in study.worlds:
        cost = 4 * _flight_cost(env_config)
        rollouts.append(
            Cell(f"references-{env_config.name}", functools.partial(fly_references, config, env_config), cost)
        )
    cells.append(Cell(f"references-{VALIDATION}", functools.partial(look_on, config, folder), 1.0, ("dataset",)))
    for seed in range(config.seeds):
        for group in _groups(study):
            cells.append(_cloning_cell(config, study, group, seed, folder))
            for subject in group:
                cells += _stages_after(config, study, subject, seed, folder)
                needs = (_policy_cell(config.after, study, subject, seed),)
                look = functools.partial(validate, config, folder, subject)
                rollouts.append(
                    Cell(flight_cell(config, subject, seed, study, VALIDATION), look, 1.0, (*needs, "dataset"))
                )
                for env_config in filter(functools.partial(study.flies, subject), study.worlds):
                    work = functools.partial(fly_subject, config, folder, subject, env_config)
                    rollouts.append(
                        Cell(
                            flight_cell(config, subject, seed, study, env_config.name),
                            work,
                            _flight_cost(env_config),
                            needs,
                        )
                    )
    return cells + rollouts


def _flight_cost(env_config: World) -> float:
    """Seconds, roughly: a rollout, a step and a pair of agents have costs of their own."""
    return 0.5 + env_config.steps * (0.015 + env_config.flocks * 5e-4 * (env_config.num_agents / 32) ** 1.7)


def _groups(study: Study) -> list[list[Subject]]:
    """Subjects that differ in their hops only: they are trained side by side."""
    groups: dict[tuple[Any, ...], list[Subject]] = {}
    for subject in study.subjects:
        groups.setdefault((subject.model, subject.layers, subject.hidden), []).append(subject)
    return list(groups.values())


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
        num_val_envs=scale.val_episodes,
        cloning_steps=4,  # of the rollouts that it looks at while it trains
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
    return _training_cell(training, group, folder, cost, "dataset")


def _stages_after(config: ReproduceConfig, study: Study, subject: Subject, seed: int, folder: Path) -> list[Cell]:
    """DAgger from the cloned policy, and MAPPO from that, as far as asked for."""
    scale = config.scale
    dagger = DAggerConfig(
        rounds=scale.dagger_rounds,
        num_envs=scale.num_envs,
        cloning_steps=min(200, scale.steps),
        cloning_updates=0,
        batch_size=scale.batch_size,
        rotate=False,
    )
    mappo = MAPPOConfig(
        rounds=scale.mappo_rounds,
        num_envs=scale.num_envs,
        critic_warmup=min(10, scale.mappo_rounds // 4),
        kl_rounds=min(50, scale.mappo_rounds // 2),
    )
    stages: list[tuple[str, DAggerConfig | MAPPOConfig, float]] = [
        ("dagger", dagger, 2.0 * scale.dagger_rounds),
        ("mappo", mappo, 5.0 * scale.mappo_rounds),
    ]
    before, cells = "cloning", []
    for stage, trainer, cost in stages[: ("cloning", "dagger", "mappo").index(config.after)]:
        name = _policy_cell(stage, study, subject, seed)
        need = _policy_cell(before, study, subject, seed)
        training = dataclasses.replace(_training(config, folder, name, seed), trainer=trainer)
        cells.append(_training_cell(training, [subject], folder, cost, need))
        before = stage
    return cells


def _training_cell(training: TrainConfig, group: Sequence[Subject], folder: Path, cost: float, need: str) -> Cell:
    work = functools.partial(_train, training, group, folder)
    return Cell(Path(training.runs).name, work, cost, (need,), functools.partial(_are_policies_there, folder))


def _are_policies_there(folder: Path, result: Result) -> bool:
    return all((folder / path).exists() for path in result["policies"].values())


def _training(config: ReproduceConfig, folder: Path, name: str, seed: int) -> TrainConfig:
    """What all trainings share; equal seeds draw equal batches, whatever the model."""
    return TrainConfig(
        env=config.env,
        evaluation=EvaluationConfig(num_flocks=2, steps=4),  # rollouts are cells of their own
        seed=derive_seed(config.seed, "seed", seed),
        device=config.device,
        threads=config.threads,
        runs=str(folder / "runs" / name),
        name="run",
    )


def _is_dataset_there(folder: Path, result: Result) -> bool:
    return (folder / "dataset").exists()


def _collect(config: ReproduceConfig, folder: Path, done: Mapping[str, Result]) -> Result:
    scale = config.scale
    rollouts = CollectConfig(
        env=config.env,
        episodes=scale.episodes + scale.val_episodes,
        steps=scale.steps,
        seed=derive_seed(config.seed, "dataset"),
        output=str(folder / "dataset"),
        device=config.device,
        threads=config.threads,
    )
    collect(rollouts)
    return {"episodes": rollouts.episodes}


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
