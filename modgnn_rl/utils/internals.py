"""Private names of other libraries, each with the reason why no public one serves.

A new version of such a library may break what is here and nothing else; ``tests/utils/test_internals.py`` says how.
Libraries are imported inside the functions: the command line imports this module and must not wait for torch.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torch import nn
    from torchrl.collectors import Collector

__all__ = [
    "collector_carrier",
    "has_hooks",
    "is_functorch_active",
    "parallel_env_processes",
    "parse_hydra_flags",
    "set_collector_carrier",
    "wandb_process",
]


def parse_hydra_flags(arguments: Sequence[str]) -> argparse.Namespace:
    """The flags and overrides of a command line as `hydra.main` will read them.

    `hydra.main` parses ``sys.argv`` itself and keeps its parser private. A command needs to know beforehand whether it
    runs one job or several, and to report an unknown flag in one line.

    Args:
        arguments: command line without the program's name.

    Returns:
        namespace with ``overrides``, ``multirun``, ``shell_completion``, ``config_dir`` and Hydra's other flags.

    Raises:
        SystemExit: for an unknown flag, after argparse has printed its usage.
    """
    from hydra._internal.utils import get_args_parser

    return get_args_parser().parse_args(list(arguments))


def parallel_env_processes(env: Any) -> list[Any]:
    """The worker processes of a TorchRL `ParallelEnv`, by worker index, as `multiprocessing.Process` objects.

    `ParallelEnv` keeps them private. They are needed to name a worker that has died, with its exit code, and to end the
    others at once: `ParallelEnv.close` waits for workers that are busy.
    """
    return list(env._workers)


def has_hooks(module: nn.Module) -> bool:
    """Whether calling a module also calls hooks, forward or backward, that someone registered on it.

    PyTorch registers and removes hooks in public but does not list them. `modgnn_rl.nn.fused` computes layers without
    calling their modules, and must not where hooks wait for the call.
    """
    return any((module._forward_hooks, module._forward_pre_hooks, module._backward_hooks, module._backward_pre_hooks))


def is_functorch_active() -> bool:
    """Whether a transform of ``torch.func`` (``vmap``, ``grad``, ...) is running.

    PyTorch has no public name for it. Under such a transform shapes must not depend on data, so that graphs have to be
    dense and NumPy cannot be used.
    """
    import torch

    return torch._C._functorch.maybe_current_level() is not None


def collector_carrier(collector: Collector) -> TensorDictBase:
    """The data that TorchRL's `Collector` carries from one step to the next [B], such as observations and messages.

    A checkpoint needs them, so that rollouts resume where they were. TorchRL's ``state_dict`` of a collector holds the
    states of environment and policy only.
    """
    carrier: TensorDictBase = collector._carrier
    return carrier


def set_collector_carrier(collector: Collector, carrier: TensorDictBase) -> None:
    """Replace the data that a `Collector` carries to the next step [B]; see `collector_carrier`."""
    collector._carrier = carrier


def wandb_process() -> Any:
    """The helper process of Weights & Biases (a `subprocess.Popen`), or None if it is not running.

    When it hangs, `wandb.finish` and `wandb.teardown` wait for it without end, and the interpreter waits for it at
    exit. There is no public handle to end it.
    """
    from wandb.sdk import wandb_setup

    helper = wandb_setup.singleton().assert_service()._proc
    return None if helper is None else helper._process
