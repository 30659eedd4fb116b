"""What a new version of another library breaks in `modgnn_rl.utils.internals`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import wandb
from torch import Tensor, nn

from modgnn_rl import make_model
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.envs.parallel import parallel_flocks
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.utils.internals import (
    collector_carrier,
    has_hooks,
    is_functorch_active,
    parallel_env_processes,
    parse_hydra_flags,
    set_collector_carrier,
    wandb_process,
)


def test_hydra_flags_have_the_fields_that_the_command_line_reads() -> None:
    """Else: `modgnn_rl.cli.command` cannot tell a multirun, Tab or a typing error in a flag."""
    flags = parse_hydra_flags(["--multirun", "seed=0,1", "--config-dir", "mine"])
    assert (flags.multirun, flags.overrides, flags.config_dir) == (True, ["seed=0,1"], "mine")
    assert not flags.shell_completion
    assert parse_hydra_flags(["-sc", "query=bash"]).shell_completion


def test_an_unknown_hydra_flag_is_named_after_the_usage(capsys: pytest.CaptureFixture[str]) -> None:
    """Else: the command line cannot cut argparse's usage off its error message."""
    with pytest.raises(SystemExit):
        parse_hydra_flags(["--colour"])
    assert capsys.readouterr().err.rpartition("error: ")[2] == "unrecognized arguments: --colour\n"


def test_processes_of_a_parallel_env_are_listed_by_worker_index() -> None:
    """Else: `modgnn_rl.envs.parallel` can neither name a dead worker nor end the others at once."""
    env = parallel_flocks(2, 1, 2, seed=0)
    processes = parallel_env_processes(env)
    assert [process.is_alive() for process in processes] == [True, True]
    env.close()
    assert [process.is_alive() for process in processes] == [False, False]


def _ignore(*_: object) -> None:
    return None


@pytest.mark.parametrize(
    "register",
    [
        nn.Module.register_forward_hook,
        nn.Module.register_forward_pre_hook,
        nn.Module.register_full_backward_hook,
        nn.Module.register_full_backward_pre_hook,
    ],
)
def test_hooks_of_every_kind_are_seen(register: Callable[..., torch.utils.hooks.RemovableHandle]) -> None:
    """Else: `modgnn_rl.nn.fused` skips the hooks of a layer."""
    module = nn.Linear(2, 2)
    assert not has_hooks(module)
    handle = register(module, _ignore)
    assert has_hooks(module)
    handle.remove()
    assert not has_hooks(module)


def test_a_running_transform_of_torch_func_is_seen() -> None:
    """Else: shapes depend on data under ``vmap``, which fails there."""
    seen: list[bool] = []

    def function(x: Tensor) -> Tensor:
        seen.append(is_functorch_active())
        return x.square().sum()

    function(torch.ones(3))
    torch.func.vmap(function)(torch.ones(2, 3))
    torch.func.grad(function)(torch.ones(3))
    assert seen == [False, True, True]


def test_what_a_collector_carries_is_the_next_observation_and_can_be_replaced() -> None:
    """Else: rollouts do not resume where they were in `modgnn_rl.trainers.collectors.local`."""
    make_env = FlockingTask(FlockingConfig()).training_env
    policy = make_model("gcn", seed=0)
    collector = LocalCollector(RolloutSpec(make_env, 2, 3, steps=2, seed=0), [policy])
    rollouts = collector.collect()
    carried = collector_carrier(collector.collector)
    assert torch.equal(carried["agents", "observation"], rollouts["next", "agents", "observation"][:, -1])
    set_collector_carrier(collector.collector, carried.clone())
    assert collector_carrier(collector.collector) is not carried
    collector.close()


def test_wandb_has_a_process_that_can_be_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a helper process that hangs keeps a finished run from exiting."""
    monkeypatch.setenv("WANDB_SILENT", "true")
    run = wandb.init(mode="offline", dir=tmp_path)
    try:
        process = wandb_process()
        assert process.poll() is None
    finally:
        run.finish()
        wandb.teardown()
    assert process.wait(10) is not None
