"""A whole training run: from a configuration to a run folder with a policy and its evaluation table."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import one_line
from modgnn_rl.experiment.evaluate import evaluate_policies
from modgnn_rl.experiment.resume import changed_config, differences, requires_restart, stored_config
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TRAINERS
from modgnn_rl.task import Task, make_task
from modgnn_rl.tracking.checkpoint import Checkpoint, has_checkpoint, load_checkpoint
from modgnn_rl.tracking.loggers import LoggerGroup, check_logger, make_logger
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.dashboard_callback import DashboardCallback, log_evaluation
from modgnn_rl.trainers.loop.setup import check_training, resolve_model
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.utils.signals import GracefulInterrupt

__all__ = ["resume", "train"]


def train(
    config: TrainConfig,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
    evaluate: bool = True,
) -> RunFolder:
    """Train a policy, evaluate it, and leave everything in a new run folder.

    Ctrl-C and SIGTERM let the current round end, write a checkpoint and raise `modgnn_rl.utils.signals.Stopped`.
    `resume` continues from there, or, whatever else ended the run, from the last checkpoint. Processes started by
    ``torchrun`` train together; only the first one writes into the folder and evaluates.

    Args:
        config: all settings. They are checked here, before anything is created; trainers rely on that.
        expert: the policy to imitate, and to measure errors against: any TensorDictModule that reads the environment's
            keys and writes ``("agents", "expert_action")``. Default: the task's own.
        callbacks: your own code, see `modgnn_rl.trainers.loop.callbacks`.
        evaluate: whether to evaluate the policies at the end.

    Returns:
        the run folder.

    Raises:
        InputError: an invalid setting, or a device or logger that this machine does not have; nothing is created then.
    """
    config, task = _checked(config, expert)
    with distributed.process_group(config.device):
        run = _new_run(config)
        with _lock(run):
            distributed.print_rank0(f"Training in {run.path}")
            return _run(config, run, task, callbacks, evaluate=evaluate)


def resume(
    folder: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
    evaluate: bool = True,
) -> RunFolder:
    """Resume a run that was stopped, was killed, or has ended, from its last checkpoint.

    On the CPU, with one thread and unchanged settings, it ends with the same weights, metrics and data as an
    uninterrupted run.

    Args:
        folder: the run folder.
        changes: new values of settings by their dotted names, as in ``{"trainer.rounds": 160, "logger": "csv"}``. The
            model, the trainer and the seed cannot change. With another environment, or another number of agents,
            environments and training data start afresh.
        expert: as `train` was given it.
        callbacks: as `train` was given them; their state is restored from the checkpoint.
        evaluate: whether to evaluate the policies at the end.

    Returns:
        the run folder.

    Raises:
        InputError: no run, no readable checkpoint, a change that is not possible, or a run that is training elsewhere.
    """
    run = RunFolder.open(folder)
    old = stored_config(run)
    config = changed_config(old, changes or {})
    changed = differences(old, config)
    config, task = _checked(config, expert)
    with distributed.process_group(config.device), _lock(run):
        checkpoint = load_checkpoint(run.checkpoints) if has_checkpoint(run.checkpoints) else None
        restarts = requires_restart(changed)
        if changed and distributed.is_first():
            run = run.with_config(OmegaConf.to_yaml(OmegaConf.structured(config)))
        _announce(run, checkpoint, restarts)
        return _run(config, run, task, callbacks, checkpoint, restore_rollouts=not restarts, evaluate=evaluate)


def _announce(run: RunFolder, checkpoint: Checkpoint | None, restarts: Sequence[str]) -> None:
    """Print where a run resumes from, and which of its environments start afresh."""
    if checkpoint is None:
        distributed.print_rank0(f"Resuming {run.path} from its start: it has no checkpoint yet")
        return
    distributed.print_rank0(f"Resuming {run.path} from round {checkpoint.step}")
    if restarts:
        distributed.print_rank0(f"Environments and training data start afresh because of {', '.join(restarts)}")
    elif distributed.size() > 1:
        distributed.print_rank0("Environments and training data start afresh in all processes but the first")


def _checked(config: TrainConfig, expert: TensorDictModuleBase | None) -> tuple[TrainConfig, Task]:
    """The settings of a run with the model resolved, and its task, after all checks that need no run folder."""
    check(config)
    prepare_torch(distributed.own_device(config.device), config.threads)
    check_logger(config)
    task = make_task(config.env).with_expert(expert)
    config = resolve_model(config, task)
    check_training(config, task)
    return config, task


def _new_run(config: TrainConfig) -> RunFolder:
    """The new run folder, which the first process makes and the others are told of."""
    if not distributed.is_first():
        return RunFolder(Path(distributed.texts("")[0]), {})
    name = config.name or f"{config.trainer.name}-{config.model.name}"
    run = RunFolder.create(config.runs, name, OmegaConf.to_yaml(OmegaConf.structured(config)))
    distributed.texts(str(run.path))
    return run


def _lock(run: RunFolder) -> contextlib.AbstractContextManager[None]:
    """The lock of a run folder, which the first process holds for all."""
    return run.lock() if distributed.is_first() else contextlib.nullcontext()


def _run(
    config: TrainConfig,
    run: RunFolder,
    task: Task,
    callbacks: Sequence[Callback],
    checkpoint: Checkpoint | None = None,
    *,
    restore_rollouts: bool = True,
    evaluate: bool,
) -> RunFolder:
    """Train, from the start or from a checkpoint, and evaluate, which the first process does alone."""
    first = distributed.is_first()
    with GracefulInterrupt().listen() as interrupt, _loggers(config, run) as loggers, _status_of_failure(run):
        dashboards = [DashboardCallback(config, task, run, loggers)] if loggers else []
        context = TrainContext(
            config=distributed.own_part(config, checkpoint.step if checkpoint else 0),
            task=task,
            run=run,
            loggers=loggers,
            callbacks=[*callbacks, *dashboards],
            checkpoint=checkpoint,
            restore_rollouts=restore_rollouts and first,
            interrupt=interrupt,
        )
        policies = TRAINERS[config.trainer.name].load()(context)
        distributed.leave()
        if first and evaluate:
            _evaluate(config, run, task, policies, loggers, context.config.device)
        if first:
            run.note_status("finished")
    return run


def _evaluate(
    config: TrainConfig,
    run: RunFolder,
    task: Task,
    policies: Mapping[str, ModGNN],
    loggers: LoggerGroup,
    device: str,
) -> None:
    """Evaluate the policies, and show the tables on dashboards."""
    run.note_status("evaluating")
    tables = evaluate_policies(run, policies, task, config.evaluation, device)
    log_evaluation(loggers, tables)


@contextlib.contextmanager
def _loggers(config: TrainConfig, run: RunFolder) -> Iterator[LoggerGroup]:
    """The loggers of the first process; at the end they are closed, and it is printed where they have written."""
    loggers = make_logger(config, run) if distributed.is_first() else LoggerGroup({})
    try:
        yield loggers
    finally:
        for line in loggers.close():
            print(line)


@contextlib.contextmanager
def _status_of_failure(run: RunFolder) -> Iterator[None]:
    """Write into the run folder why a run has failed or was stopped; after Ctrl-C, print how to resume it, too."""
    try:
        yield
    except BaseException as error:
        if distributed.is_first():
            stopped = isinstance(error, KeyboardInterrupt)
            with contextlib.suppress(OSError):
                run.note_status("stopped" if stopped else "failed", reason=one_line(error))
            if stopped:
                arguments = shlex.quote(f"resume={run.path}")
                print(f"Stopped. To resume: python -m modgnn_rl.train {arguments}", file=sys.stderr, flush=True)
        raise
