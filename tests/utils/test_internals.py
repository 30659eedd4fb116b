"""What a new version of another library breaks in `modgnn_rl.utils.internals`."""

from __future__ import annotations

import pytest

from modgnn_rl.envs.parallel import parallel_flocks
from modgnn_rl.utils.internals import parallel_env_processes, parse_hydra_flags


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
