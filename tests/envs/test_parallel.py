"""Flocks in worker processes: rollouts equal those of one process, and no worker hangs or outlives its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv

from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.parallel import ParallelFlocks, parallel_flocks
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import make_model
from modgnn_rl.utils.internals import parallel_env_processes
from modgnn_rl.utils.seeds import derive_seed

WORKERS, FLOCKS, AGENTS = 2, 2, 3
SCRIPT = """
import sys, time
import torch
from modgnn_rl.envs.parallel import parallel_flocks
from modgnn_rl.utils.internals import parallel_env_processes
if __name__ == "__main__":
    env = parallel_flocks(1, 1, 2, seed=0, physics=sys.argv[1])
    state = env.reset()
    print(*(worker.pid for worker in parallel_env_processes(env)), flush=True)
    if sys.argv[2] == "sleep":
        time.sleep(600)
    if sys.argv[2] == "rollout":
        env.rollout(10**6, auto_reset=False, tensordict=state, break_when_any_done=False)
"""


@pytest.fixture(scope="module")
def env() -> Iterator[ParallelFlocks]:
    env = parallel_flocks(WORKERS, FLOCKS, AGENTS, seed=1, physics="bullet")
    yield env
    env.close(raise_if_closed=False)


def test_rollouts_equal_those_of_one_process(env: ParallelFlocks) -> None:
    assert env.batch_size == (WORKERS, FLOCKS)
    action = torch.randn(WORKERS, FLOCKS, AGENTS, 3, generator=torch.Generator().manual_seed(0))
    alone = [FlockingEnv(FLOCKS, AGENTS, seed=derive_seed(1, "worker", index), physics="bullet") for index in (0, 1)]
    everything: list[EnvBase] = [env, *alone]
    states = [flocks.reset() for flocks in everything]
    for _ in range(3):
        observations = [state["agents", "observation"] for state in states]
        assert torch.equal(observations[0], torch.stack(observations[1:]))
        for state, targets in zip(states, (action, *action), strict=True):
            state["agents", "action"] = targets
        states = [flocks.step(state)["next"] for flocks, state in zip(everything, states, strict=True)]
    assert not torch.equal(states[1]["agents", "observation"], states[2]["agents", "observation"])


def test_recurrent_policies_roll_out(env: ParallelFlocks) -> None:
    policy = make_model("modgnn_mlp", seed=0)

    def rollout(flocks: EnvBase) -> TensorDictBase:
        with torch.no_grad():
            wrapped = TransformedEnv(flocks, Compose(InitTracker(), policy.make_tensordict_primer()))
            return wrapped.rollout(4, policy)

    seed = 7
    env.set_seed(seed)
    rollouts = rollout(env)
    assert rollouts.shape == (WORKERS, FLOCKS, 4)
    for own in rollouts:
        alone = FlockingEnv(FLOCKS, AGENTS, physics="bullet")
        seed = alone.set_seed(seed)
        torch.testing.assert_close(
            rollout(alone)["next", "agents", "observation"], own["next", "agents", "observation"]
        )


def test_the_death_of_a_worker_is_an_error_and_ends_the_others(env: ParallelFlocks) -> None:
    """The last test that uses this environment."""
    state = env.reset()
    workers = parallel_env_processes(env)
    os.kill(workers[1].pid, signal.SIGKILL)
    state["agents", "action"] = torch.zeros(WORKERS, FLOCKS, AGENTS, 3)
    with pytest.raises(RuntimeError, match=r"1 \(exit code -9\)"):
        env.step(state)
    assert not any(worker.is_alive() for worker in workers)


def test_bad_settings_are_errors_in_the_parent() -> None:
    with pytest.raises(InputError, match="workers=0"):
        parallel_flocks(0, 1)
    with pytest.raises(InputError, match="comm_range"):
        parallel_flocks(1, 1, comm_range=-1.0)


def start(tmp_path: Path, *arguments: str) -> tuple[subprocess.Popen[str], list[int]]:
    """Start a process with a worker, in its own process group; returns it and the PIDs of its workers."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert parent.stdout is not None
    return parent, [int(word) for word in parent.stdout.readline().split()]


def have_ended(processes: list[int], within: float = 20.0) -> bool:
    """Whether no process is running any more."""
    end = time.monotonic() + within
    while any(is_running(process) for process in processes):
        if time.monotonic() > end:
            return False
        time.sleep(0.1)
    return True


def is_running(process: int) -> bool:
    """Whether a process exists and is not a zombie."""
    listing = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True)
    return listing.stdout.strip()[:1] not in ("", "Z")


@pytest.mark.slow
def test_workers_end_when_the_parent_is_killed(tmp_path: Path) -> None:
    parent, workers = start(tmp_path, "torch", "sleep")
    assert all(is_running(worker) for worker in workers)
    parent.kill()
    assert have_ended(workers)
    parent.communicate()


@pytest.mark.slow
def test_workers_end_when_the_parent_is_killed_during_a_rollout(tmp_path: Path) -> None:
    parent, workers = start(tmp_path, "bullet", "rollout")
    time.sleep(1)
    parent.kill()
    assert have_ended(workers)
    parent.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("activity", ["sleep", "rollout"])
def test_an_interrupt_ends_all_and_only_the_parent_reports_it(tmp_path: Path, activity: str) -> None:
    parent, workers = start(tmp_path, "bullet", activity)
    time.sleep(1)
    os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    _, errors = parent.communicate(timeout=60)
    assert have_ended(workers)
    assert errors.count("KeyboardInterrupt") == 1


@pytest.mark.slow
def test_workers_end_with_a_parent_that_does_not_close(tmp_path: Path) -> None:
    parent, workers = start(tmp_path, "bullet", "nothing")
    parent.communicate(timeout=60)
    assert parent.returncode == 0
    assert have_ended(workers)


@pytest.mark.slow
def test_failures_in_workers_reach_the_parent() -> None:
    with pytest.raises(RuntimeError, match="num_envs=0 is not a positive integer"):
        parallel_flocks(1, 0)
    env = parallel_flocks(1, 1, 2, seed=0)
    state = env.reset()
    state["agents", "action"] = torch.full((1, 1, 2, 3), torch.nan)
    with pytest.raises(RuntimeError, match=r"0 \(exit code 1\)"):
        env.step(state)
