"""A whole training run: from a configuration to a run folder with a policy and its evaluation table."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, FlockingConfig, TrainConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.envs.flocking.recording import Recorder, spacing
from modgnn_rl.errors import InputError, one_line
from modgnn_rl.evaluation.rollout import evaluate
from modgnn_rl.evaluation.table import as_markdown, read_tables, summarise_flights
from modgnn_rl.experiment.resume import begins_anew, changed_config, differences, stored_config
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.checkpoint import Checkpoint, has_checkpoint, load_checkpoint
from modgnn_rl.tracking.loading import changed_world, load_policy
from modgnn_rl.tracking.loggers import Dashboards, check_logger, make_logger
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.bc import bc
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.dagger import dagger
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.loop.context import Session
from modgnn_rl.trainers.loop.dashboard_callback import Watch, log_evaluation
from modgnn_rl.trainers.loop.setup import check_training, settle_model
from modgnn_rl.trainers.mappo import mappo
from modgnn_rl.utils.signals import Interruption
from modgnn_rl.visualization.html import write_replay

__all__ = ["TRAINERS", "evaluate_policies", "evaluate_run", "prepare_torch", "resume", "train"]

REPLAY_FRAMES = 250  # of the replay beside a table: keeping more would take longer than a second
TRAINERS = {"bc": bc, "dagger": dagger, "mappo": mappo}


def train(
    config: TrainConfig, *, expert: TensorDictModuleBase | None = None, callbacks: Sequence[Callback] = ()
) -> RunFolder:
    """Train a policy, evaluate it, and leave everything in a new run folder.

    Ctrl-C and SIGTERM let the round end, write a checkpoint and raise `modgnn_rl.utils.signals.Stopped`; `resume` goes
    on from there, or from the last checkpoint before whatever else ended the run. In processes that ``torchrun`` has
    started, all train together; the first alone writes into the folder and evaluates.

    Args:
        config: all settings.
        expert: whom to learn from: any TensorDictModule that reads the environment's keys and writes
            ``("agents", "expert_action")``; default: Reynolds flocking. Errors in the evaluation are against it too.
        callbacks: people's own code, see `modgnn_rl.trainers.loop.callbacks`.

    Raises:
        InputError: a bad setting, or a device or a logger that this machine does not have; nothing is created then.
    """
    config = _checked(config, expert)
    with distributed.joined(config.device):
        run = _new_run(config)
        with _lock(run):
            distributed.say(f"Training in {run.path}")
            return _work(config, run, expert, callbacks)


def resume(
    folder: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
) -> RunFolder:
    """Go on with a run that was stopped, killed, or ended, from its last checkpoint.

    On the CPU, with one thread and the settings unchanged, it ends with the weights, metrics and data with which it
    would have ended had it never stopped.

    Args:
        folder: the run folder.
        changes: new values of settings by their dotted names, as in ``{"trainer.rounds": 160, "logger": "csv"}``. The
            model, the trainer and the seed cannot change. In another world, or with another number of agents, flocks
            begin anew, with no data.
        expert: as `train` was given it.
        callbacks: as `train` was given them; they begin with what checkpoints hold of them.

    Raises:
        InputError: no run, no readable checkpoint, a change that cannot be, or a run that goes on elsewhere.
    """
    run = RunFolder.open(folder)
    old = stored_config(run)
    config = changed_config(old, changes or {})
    changed = differences(old, config)
    config = _checked(config, expert)
    with distributed.joined(config.device), _lock(run):
        checkpoint = load_checkpoint(run.checkpoints) if has_checkpoint(run.checkpoints) else None
        anew = begins_anew(changed)
        if changed and distributed.is_first():
            run = run.with_config(OmegaConf.to_yaml(OmegaConf.structured(config)))
        where = "its start, for it has no checkpoint yet" if checkpoint is None else f"round {checkpoint.step}"
        distributed.say(f"Resuming {run.path} from {where}")
        if anew and checkpoint is not None:
            distributed.say(f"Flocks begin anew, with no data, because of {', '.join(anew)}")
        elif distributed.size() > 1 and checkpoint is not None:
            distributed.say("Flocks begin anew, with no data, in all processes but the first, whose flocks are kept")
        return _work(config, run, expert, callbacks, checkpoint, keeps_flocks=not anew)


def _checked(config: TrainConfig, expert: TensorDictModuleBase | None) -> TrainConfig:
    """The settings of a run, with the model settled, after everything that can be refused has been looked at."""
    check(config)
    prepare_torch(distributed.own_device(config.device), config.threads)
    check_logger(config)
    config = settle_model(config)
    check_training(config)
    if expert is not None and getattr(config.trainer, "dataset", None):
        raise InputError(
            "trainer.dataset holds the labels of Reynolds flocking, not those of your expert; leave one out"
        )
    return config


def _new_run(config: TrainConfig) -> RunFolder:
    """A new folder that the first process makes; others learn where it is."""
    if not distributed.is_first():
        return RunFolder(Path(distributed.texts("")[0]), {})
    name = config.name or f"{config.trainer.name}-{config.model.name}"
    run = RunFolder.create(config.runs, name, OmegaConf.to_yaml(OmegaConf.structured(config)))
    distributed.texts(str(run.path))
    return run


def _lock(run: RunFolder) -> contextlib.AbstractContextManager[None]:
    """The lock of a run folder, which the first process holds for all."""
    return run.lock() if distributed.is_first() else contextlib.nullcontext()


def _work(
    config: TrainConfig,
    run: RunFolder,
    expert: TensorDictModuleBase | None,
    callbacks: Sequence[Callback],
    checkpoint: Checkpoint | None = None,
    *,
    keeps_flocks: bool = True,
) -> RunFolder:
    """Train from the beginning or from a checkpoint, then evaluate, which the first process does alone."""
    first = distributed.is_first()
    dashboards = make_logger(config, run) if first else Dashboards({})
    watches = [Watch(config, run, dashboards, expert)] if dashboards else []
    with Interruption().listen() as interruption:
        own = distributed.own_part(config, checkpoint.step if checkpoint else 0)
        keeps_flocks = keeps_flocks and first
        session = Session(own, run, dashboards, expert, [*callbacks, *watches], checkpoint, keeps_flocks, interruption)
        try:
            policies = TRAINERS[config.trainer.name](session)
            distributed.leave()
            if not first:
                return run
            run.note_status("evaluating")
            sizes = as_list(config.evaluation.num_agents or config.env.num_agents)
            world, settings, device = config.env, config.evaluation, own.device
            tables = evaluate_policies(run, policies, world, settings, sizes, device, expert=expert)
            log_evaluation(dashboards, tables)
            run.note_status("finished")
        except BaseException as error:
            if first:
                _note_end(run, error)
            raise
        finally:
            for where in dashboards.close():
                print(where)
    return run


def _note_end(run: RunFolder, error: BaseException) -> None:
    """Say in the run folder, and where it was asked for on the terminal, that a run has ended before its time."""
    stopped = isinstance(error, KeyboardInterrupt)
    with contextlib.suppress(OSError):
        run.note_status("stopped" if stopped else "failed", reason=one_line(error))
    if stopped:
        resuming = shlex.quote(f"resume={run.path}")
        print(f"Stopped; to go on: python -m modgnn_rl.train {resuming}", file=sys.stderr, flush=True)


def evaluate_policies(
    run: RunFolder,
    policies: Mapping[str, ModGNN],
    world: FlockingConfig,
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
        for each number of agents, the table that `modgnn_rl.evaluation.table.summarise_flights` makes.
    """
    tables, replays = {}, {}
    for size in sizes:
        every = spacing(size, settings.steps, REPLAY_FRAMES)
        replays[size] = {name: Recorder(world, every) for name in (*policies, "expert")}
        flights = evaluate(
            policies,
            world,
            num_agents=size,
            num_flocks=settings.num_flocks,
            steps=settings.steps,
            seed=settings.seed,
            device=device,
            expert=expert,
            watches=replays[size],
        )
        tables[size] = summarise_flights(flights, settings.seed)
    flown = {"num_flocks": settings.num_flocks, "steps": settings.steps, "seed": settings.seed}
    new = {str(size): {**flown, "rows": table} for size, table in tables.items()}
    title = f"{run.path.name} in a world with {changes}" if changes else run.path.name
    file = evaluation_file(run, changes)
    entries = sorted({**read_tables(file), **new}.items(), key=lambda entry: int(entry[0]))
    run.write(file.name, json.dumps(dict(entries), indent=2) + "\n")
    run.write(file.with_suffix(".md").name, as_markdown(dict(entries), title))
    print(f"\n{as_markdown(new, title)}", flush=True)
    for size, recorders in replays.items():
        page = file.with_name(file.stem.replace("evaluation", f"replay-{size}", 1) + ".html")
        recordings = {name: recorder.recording() for name, recorder in recorders.items()}
        write_replay(page, recordings, title, {"seed": settings.seed, "flock": f"1 of {settings.num_flocks}"})
        print(f"A flight of {size} agents to watch in a browser: {page}", flush=True)
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
    world, changes = changed_world(run, config.env)
    sizes = as_list(config.evaluation.num_agents or world.num_agents)
    best = {"checkpoint": "best"} if config.checkpoint == "best" else {}
    named = ",".join(f"{name}={value}" for name, value in sorted({**changes, **best}.items()))
    evaluate_policies(run, {run.config["model"]["name"]: policy}, world, config.evaluation, sizes, config.device, named)
    return evaluation_file(run, named)


def prepare_torch(device: str, threads: int) -> None:
    """Choose the number of threads, keep TorchRL's notices off the terminal, and make sure that the device exists.

    Raises:
        InputError: there is no such device.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device={device} cannot be used ({reason}); device=cpu works everywhere") from error
