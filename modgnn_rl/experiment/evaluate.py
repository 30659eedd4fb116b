"""Evaluate the policies of a run: roll out, summarise, and write table and replay into the run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, FlockingConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.envs.flocking.recording import FlockRecorder
from modgnn_rl.evaluation.rollout import evaluate
from modgnn_rl.evaluation.table import evaluation_markdown, read_tables, summarise_rollouts
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.loading import load_policy, override_env_config
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.visualization.html import write_replay
from modgnn_rl.visualization.recording import recording_stride

__all__ = ["REPLAY_FRAMES", "evaluate_policies", "evaluate_run", "evaluation_file"]

REPLAY_FRAMES = 250  # of the replay beside a table: keeping more would take longer than a second


def evaluate_policies(
    run: RunFolder,
    policies: Mapping[str, ModGNN],
    env_config: FlockingConfig,
    settings: EvaluationConfig,
    sizes: list[int],
    device: str,
    changes: str = "",
    expert: TensorDictModuleBase | None = None,
) -> dict[int, dict[str, Any]]:
    """Fly a run's policies and the reference policies, and write the table of each size into the run folder.

    Beside it goes a replay of the first flock, flown by the policies and by the expert. Tables of other sizes that the
    folder holds already are kept; a world changed since training has files of its own.

    Returns:
        for each number of agents, the table that `modgnn_rl.evaluation.table.summarise_rollouts` makes.
    """
    tables, replays = {}, {}
    for size in sizes:
        stride = recording_stride(size, settings.steps, REPLAY_FRAMES)
        replays[size] = {name: FlockRecorder(env_config, stride) for name in (*policies, "expert")}
        rollouts = evaluate(
            policies,
            env_config,
            num_agents=size,
            num_flocks=settings.num_flocks,
            steps=settings.steps,
            seed=settings.seed,
            device=device,
            expert=expert,
            watches=replays[size],
        )
        tables[size] = summarise_rollouts(rollouts, settings.seed)
    flown = {"num_flocks": settings.num_flocks, "steps": settings.steps, "seed": settings.seed}
    new = {str(size): {**flown, "rows": table} for size, table in tables.items()}
    title = f"{run.path.name} in a world with {changes}" if changes else run.path.name
    file = evaluation_file(run, changes)
    entries = sorted({**read_tables(file), **new}.items(), key=lambda entry: int(entry[0]))
    run.write(file.name, json.dumps(dict(entries), indent=2) + "\n")
    run.write(file.with_suffix(".md").name, evaluation_markdown(dict(entries), title))
    print(f"\n{evaluation_markdown(new, title)}", flush=True)
    for size, recorders in replays.items():
        page = file.with_name(file.stem.replace("evaluation", f"replay-{size}", 1) + ".html")
        recordings = {name: recorder.recording() for name, recorder in recorders.items()}
        write_replay(page, recordings, title, {"seed": settings.seed, "flock": f"1 of {settings.num_flocks}"})
        print(f"A rollout of {size} agents to watch in a browser: {page}", flush=True)
    return tables


def evaluation_file(run: RunFolder, changes: str = "") -> Path:
    """Where the figures of an evaluation are, in the world of training or in a changed one; the table is beside them.

    Args:
        run: the run folder.
        changes: ``name=value`` of all that was changed, separated by commas.
    """
    return run.path / (f"evaluation-{changes.replace('/', '_')}.json" if changes else "evaluation.json")


def evaluate_run(config: EvaluateConfig) -> Path:
    """Evaluate the policy of a run, in the world that it was trained in or in another.

    Returns:
        the file of figures.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or no such device.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    policy = load_policy(config.run, device=config.device, which=config.checkpoint)
    run = RunFolder.open(config.run)
    env_config, changes = override_env_config(run, config.env)
    sizes = as_list(config.evaluation.num_agents or env_config.num_agents)
    best = {"checkpoint": "best"} if config.checkpoint == "best" else {}
    named = ",".join(f"{name}={value}" for name, value in sorted({**changes, **best}.items()))
    evaluate_policies(
        run, {run.config["model"]["name"]: policy}, env_config, config.evaluation, sizes, config.device, named
    )
    return evaluation_file(run, named)
