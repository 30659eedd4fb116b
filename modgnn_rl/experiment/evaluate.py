"""Evaluate the policies of a run: roll out, summarise, and write tables and replays into the run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.evaluation.recording import Recorder
from modgnn_rl.evaluation.rollout import evaluate
from modgnn_rl.evaluation.table import evaluation_markdown, read_tables, summarise_rollouts
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.task import Task
from modgnn_rl.tracking.loading import changed_task, load_policy, load_task
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.visualization.html import write_replay
from modgnn_rl.visualization.recording import recording_stride

__all__ = ["evaluate_policies", "evaluate_run", "evaluation_file"]

MAX_REPLAY_FRAMES = 250  # writing more would take longer than a second


def evaluate_policies(
    run: RunFolder,
    policies: Mapping[str, ModGNN],
    task: Task,
    settings: EvaluationConfig,
    device: str,
    *,
    changes: str = "",
) -> dict[int, dict[str, Any]]:
    """Evaluate a run's policies beside the reference policies, and write tables and replays into the run folder.

    Args:
        run: the run folder.
        policies: by name.
        task: of the policies; the numbers of agents are its, unless the settings have their own.
        settings: of the evaluation.
        device: of the rollouts.
        changes: differences from the run's own environment as ``name=value``, separated by commas; they name the files.

    Returns:
        for each number of agents, what `modgnn_rl.evaluation.table.summarise_rollouts` returns.
    """
    tables, recorders = {}, {}
    steps = settings.steps or task.evaluation_steps
    for size in as_list(settings.num_agents or task.sizes):
        stride = recording_stride(size, steps, MAX_REPLAY_FRAMES)
        recorded = [*policies, *(["expert"] if task.teacher is not None else [])] if task.has_positions else []
        recorders[size] = {name: Recorder(task, stride) for name in recorded}
        rollouts = evaluate(
            policies,
            task,
            num_agents=size,
            num_flocks=settings.num_flocks,
            steps=steps,
            seed=settings.seed,
            device=device,
            watches=recorders[size],
        )
        tables[size] = summarise_rollouts(rollouts, task, settings.seed)
    about = {"num_flocks": settings.num_flocks, "steps": steps, "seed": settings.seed, "task": task.name}
    title = f"{run.path.name} with {changes}" if changes else run.path.name
    file = evaluation_file(run, changes)
    print(f"\n{_write_tables(run, file, tables, about, title)}", flush=True)
    for size, page in _write_replays(file, recorders, settings, title).items():
        print(f"Replay of {size} agents, for a browser: {page}", flush=True)
    return tables


def _write_tables(run: RunFolder, file: Path, tables: Mapping[int, Any], about: Mapping[str, Any], title: str) -> str:
    """Add tables to a file of JSON and the Markdown page beside it, which may have some of other sizes.

    Returns:
        the new tables as Markdown.
    """
    new = {str(size): {**about, "rows": table} for size, table in tables.items()}
    entries = dict(sorted({**read_tables(file), **new}.items(), key=lambda entry: int(entry[0])))
    run.write(file.name, json.dumps(entries, indent=2) + "\n")
    run.write(file.with_suffix(".md").name, evaluation_markdown(entries, title))
    return evaluation_markdown(new, title)


def _write_replays(
    file: Path, recorders: Mapping[int, Mapping[str, Recorder]], settings: EvaluationConfig, title: str
) -> dict[int, Path]:
    """Write a replay of the first flock for each number of agents, beside the file of the tables."""
    pages = {}
    for size, by_policy in recorders.items():
        if not by_policy:
            continue
        pages[size] = file.with_name(file.stem.replace("evaluation", f"replay-{size}", 1) + ".html")
        recordings = {name: recorder.recording() for name, recorder in by_policy.items()}
        write_replay(pages[size], recordings, title, {"seed": settings.seed, "flock": f"1 of {settings.num_flocks}"})
    return pages


def evaluation_file(run: RunFolder, changes: str = "") -> Path:
    """The JSON file of an evaluation; its Markdown page is beside it.

    Args:
        run: the run folder.
        changes: differences from the run's own environment as ``name=value``, separated by commas.
    """
    return run.path / (f"evaluation-{changes.replace('/', '_')}.json" if changes else "evaluation.json")


def evaluate_run(config: EvaluateConfig, run: RunFolder | None = None) -> Path:
    """Evaluate the policy of a run, in the environment of its training or in a changed one.

    Args:
        config: the settings.
        run: the folder that ``config.run`` names, if it is open already.

    Returns:
        the JSON file of the evaluation.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or no such device.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    run = run or RunFolder.open(config.run)
    trained_on = load_task(run)
    policy = load_policy(run, device=config.device, which=config.checkpoint, task=trained_on)
    task, changed = changed_task(trained_on, config.env)
    best = {"checkpoint": "best"} if config.checkpoint == "best" else {}
    changes = ",".join(f"{name}={value}" for name, value in sorted({**changed, **best}.items()))
    policies = {run.config["model"]["name"]: policy}
    evaluate_policies(run, policies, task, config.evaluation, config.device, changes=changes)
    return evaluation_file(run, changes)
