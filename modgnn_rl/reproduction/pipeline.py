"""A study as jobs: expert episodes, models trained on them, and their results."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
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
from modgnn_rl.data.collect import collect_dataset
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.reproduction.jobs import Job, Result
from modgnn_rl.reproduction.measurements import (
    REFERENCES,
    VALIDATION,
    evaluate_references,
    evaluate_variant,
    evaluation_job,
    validate_references,
    validate_variant,
)
from modgnn_rl.reproduction.studies import EvalSetting, ModelVariant, Study
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["jobs_of"]


def jobs_of(config: ReproduceConfig, study: Study, folder: Path) -> list[Job]:
    """The jobs of a study: a dataset, trainings, and evaluations of references and policies."""
    jobs = [_dataset_job(config, folder)]
    evaluations = [
        Job(
            f"{REFERENCES}-{setting.name}",
            functools.partial(evaluate_references, config, setting),
            4 * _rollout_cost(setting),
            group=REFERENCES,
        )
        for setting in study.settings
    ]
    validate = functools.partial(validate_references, config, folder)
    jobs.append(Job(f"{REFERENCES}-{VALIDATION}", validate, 1.0, ("dataset",), group=REFERENCES))
    for seed in range(config.seeds):
        for group in _groups(study):
            jobs.append(_cloning_job(config, study, group, seed, folder))
            for variant in group:
                jobs += _stages_after(config, study, variant, seed, folder)
                evaluations += _evaluation_jobs(config, study, variant, seed, folder)
    return jobs + evaluations


def _dataset_job(config: ReproduceConfig, folder: Path) -> Job:
    cost = config.scale.episodes * config.scale.steps * 1e-4
    is_valid = functools.partial(_dataset_exists, folder)
    return Job("dataset", functools.partial(_collect, config, folder), cost, is_valid=is_valid, group="dataset")


def _evaluation_jobs(
    config: ReproduceConfig, study: Study, variant: ModelVariant, seed: int, folder: Path
) -> Iterator[Job]:
    """Yield validation and rollouts of one trained policy."""
    policy, group = _policy_job(config.after, study, variant, seed), _group_of(study, config.after)
    name = functools.partial(evaluation_job, config, variant, seed, study)
    validate = functools.partial(validate_variant, config, folder, variant)
    yield Job(name(VALIDATION), validate, 1.0, (policy, "dataset"), group=group)
    for setting in study.settings:
        if study.applies(variant, setting):
            run = functools.partial(evaluate_variant, config, folder, variant, setting)
            yield Job(name(setting.name), run, _rollout_cost(setting), (policy,), group=group)


def _group_of(study: Study, stage: str) -> str:
    """The file that results of a study's trainings and policies are stored in."""
    return f"{study.family}-{stage}"


def _rollout_cost(setting: EvalSetting) -> float:
    """Seconds, roughly: a constant, and the cost of steps and of pairs of agents."""
    return 0.5 + setting.steps * (0.015 + setting.flocks * 5e-4 * (setting.num_agents / 32) ** 1.7)


def _groups(study: Study) -> list[list[ModelVariant]]:
    """Variants that differ only in their hops; they are trained side by side."""
    groups: dict[tuple[Any, ...], list[ModelVariant]] = {}
    for variant in study.variants:
        groups.setdefault((variant.model, variant.layers, variant.hidden), []).append(variant)
    return list(groups.values())


def _policy_job(after: str, study: Study, variant: ModelVariant, seed: int) -> str:
    """The name of the job that trains a variant's policy."""
    if after == "cloning":
        group = next(group for group in _groups(study) if variant in group)
        hops = "".join(str(member.hops) for member in group)
        return f"{study.family}-cloning-{dataclasses.replace(variant, hops=int(hops)).key}-seed{seed}"
    return f"{study.family}-{after}-{variant.key}-seed{seed}"


def _cloning_job(config: ReproduceConfig, study: Study, group: list[ModelVariant], seed: int, folder: Path) -> Job:
    scale, first = config.scale, group[0]
    name = _policy_job("cloning", study, first, seed)
    trainer = BCConfig(
        hops=[variant.hops for variant in group],
        dataset=str(folder / "dataset"),
        num_val_envs=scale.val_episodes,
        cloning_steps=4,  # steps of the rollouts on which the error is logged
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
    links = scale.batch_size * sum(variant.hops * (variant.layers or 1) for variant in group)
    cost = 3.0 + study.updates * (0.01 * len(group) + 3e-4 * links)  # seconds, roughly
    return _training_job(training, group, folder, cost, "dataset", _group_of(study, "cloning"))


def _stages_after(config: ReproduceConfig, study: Study, variant: ModelVariant, seed: int, folder: Path) -> list[Job]:
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
    before, jobs = "cloning", []
    for stage, trainer, cost in stages[: ("cloning", "dagger", "mappo").index(config.after)]:
        name = _policy_job(stage, study, variant, seed)
        need = _policy_job(before, study, variant, seed)
        training = dataclasses.replace(_training(config, folder, name, seed), trainer=trainer)
        jobs.append(_training_job(training, [variant], folder, cost, need, _group_of(study, stage)))
        before = stage
    return jobs


def _training_job(
    training: TrainConfig, variants: Sequence[ModelVariant], folder: Path, cost: float, dependency: str, group: str
) -> Job:
    run = functools.partial(_train, training, variants, folder)
    is_valid = functools.partial(_policies_exist, folder)
    return Job(Path(training.runs).name, run, cost, (dependency,), is_valid, group)


def _policies_exist(folder: Path, result: Result) -> bool:
    return all((folder / path).exists() for path in result["policies"].values())


def _training(config: ReproduceConfig, folder: Path, name: str, seed: int) -> TrainConfig:
    """Settings that all trainings share; equal seeds sample equal batches, whatever the model."""
    return TrainConfig(
        env=config.env,
        evaluation=EvaluationConfig(num_flocks=2, steps=4),  # policies are evaluated by jobs of their own
        seed=derive_seed(config.seed, "seed", seed),
        device=config.device,
        threads=config.threads,
        runs=str(folder / "runs" / name),
        name="run",
    )


def _dataset_exists(folder: Path, result: Result) -> bool:
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
    collect_dataset(rollouts)
    return {"episodes": rollouts.episodes}


def _train(config: TrainConfig, group: Sequence[ModelVariant], folder: Path, done: Mapping[str, Result]) -> Result:
    """Train, or resume a stopped training; returns the policies' folders in the reproduction's, by variant."""
    if not isinstance(config.trainer, BCConfig):
        (before,) = done.values()
        config = dataclasses.replace(config, init_from=str(folder / before["policies"][group[0].key]))
    root = Path(config.runs)
    root.mkdir(parents=True, exist_ok=True)
    begun = sorted(file.parent for file in root.glob("*/config.yaml"))
    # The output of the trainer is kept beside the run.
    with (root / "output.txt").open("a", encoding="utf-8") as output, contextlib.redirect_stdout(output):
        if not begun:
            run = train(config)
        else:
            run = RunFolder.open(begun[-1])
            run = run if run.state == "finished" else resume(begun[-1])
    path = run.path.relative_to(folder)
    names = {variant.key: f"{variant.model}-K{variant.hops}" for variant in group}
    return {"policies": {key: str(path / name if len(group) > 1 else path) for key, name in names.items()}}
