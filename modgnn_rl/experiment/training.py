"""A whole training run: from a configuration to a run folder with a policy and its evaluation table."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import TrainConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.errors import one_line
from modgnn_rl.experiment.evaluate import evaluate_policies
from modgnn_rl.experiment.resume import changed_config, differences, requires_restart, stored_config
from modgnn_rl.registry import TRAINERS
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

    Ctrl-C and SIGTERM let the round end, write a checkpoint and raise `modgnn_rl.utils.signals.Stopped`; `resume` goes
    on from there, or from the last checkpoint before whatever else ended the run. In processes that ``torchrun`` has
    started, all train together; the first alone writes into the folder and evaluates.

    Args:
        config: all settings.
        expert: whom to learn from: any TensorDictModule that reads the environment's keys and writes
            ``("agents", "expert_action")``; default: Reynolds flocking. Errors in the evaluation are against it too.
        callbacks: people's own code, see `modgnn_rl.trainers.loop.callbacks`.
        evaluate: whether to evaluate the policies at the end.

    Raises:
        InputError: a bad setting, or a device or a logger that this machine does not have; nothing is created then.
    """
    config = _checked(config, expert)
    with distributed.process_group(config.device):
        run = _new_run(config)
        with _lock(run):
            distributed.print_rank0(f"Training in {run.path}")
            return _work(config, run, expert, callbacks, evaluate=evaluate)


def resume(
    folder: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    *,
    expert: TensorDictModuleBase | None = None,
    callbacks: Sequence[Callback] = (),
    evaluate: bool = True,
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
        evaluate: whether to evaluate the policies at the end.

    Raises:
        InputError: no run, no readable checkpoint, a change that cannot be, or a run that goes on elsewhere.
    """
    run = RunFolder.open(folder)
    old = stored_config(run)
    config = changed_config(old, changes or {})
    changed = differences(old, config)
    config = _checked(config, expert)
    with distributed.process_group(config.device), _lock(run):
        checkpoint = load_checkpoint(run.checkpoints) if has_checkpoint(run.checkpoints) else None
        anew = requires_restart(changed)
        if changed and distributed.is_first():
            run = run.with_config(OmegaConf.to_yaml(OmegaConf.structured(config)))
        where = "its start, for it has no checkpoint yet" if checkpoint is None else f"round {checkpoint.step}"
        distributed.print_rank0(f"Resuming {run.path} from {where}")
        if anew and checkpoint is not None:
            distributed.print_rank0(f"Flocks begin anew, with no data, because of {', '.join(anew)}")
        elif distributed.size() > 1 and checkpoint is not None:
            distributed.print_rank0(
                "Flocks begin anew, with no data, in all processes but the first, whose flocks are kept"
            )
        return _work(config, run, expert, callbacks, checkpoint, restore_rollouts=not anew, evaluate=evaluate)


def _checked(config: TrainConfig, expert: TensorDictModuleBase | None) -> TrainConfig:
    """The settings of a run, with the model settled, after everything that can be refused has been looked at."""
    check(config)
    prepare_torch(distributed.own_device(config.device), config.threads)
    check_logger(config)
    config = resolve_model(config)
    check_training(config, expert)
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
    restore_rollouts: bool = True,
    evaluate: bool,
) -> RunFolder:
    """Train from the beginning or from a checkpoint, then evaluate, which the first process does alone."""
    first = distributed.is_first()
    loggers = make_logger(config, run) if first else LoggerGroup({})
    dashboards = [DashboardCallback(config, run, loggers, expert)] if loggers else []
    with GracefulInterrupt().listen() as interrupt:
        own = distributed.own_part(config, checkpoint.step if checkpoint else 0)
        context = TrainContext(
            config=own,
            expert=Reynolds.for_env(config.env) if expert is None else expert,
            run=run,
            loggers=loggers,
            callbacks=[*callbacks, *dashboards],
            checkpoint=checkpoint,
            restore_rollouts=restore_rollouts and first,
            interrupt=interrupt,
        )
        try:
            policies = TRAINERS[config.trainer.name].load()(context)
            distributed.leave()
            if not first:
                return run
            if evaluate:
                run.note_status("evaluating")
                sizes = as_list(config.evaluation.num_agents or config.env.num_agents)
                env_config, settings, device = config.env, config.evaluation, own.device
                tables = evaluate_policies(run, policies, env_config, settings, sizes, device, expert=expert)
                log_evaluation(loggers, tables)
            run.note_status("finished")
        except BaseException as error:
            if first:
                _note_end(run, error)
            raise
        finally:
            for where in loggers.close():
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
