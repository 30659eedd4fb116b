"""Workers collect the rollouts that one process would, and nothing hangs or is left behind when one dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cloudpickle
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from modgnn_rl import make_model
from modgnn_rl.configs.schema import CollectorConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, Ensemble
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.trainers.collectors.remote import RemoteCollector, check_collector
from modgnn_rl.trainers.collectors.workers import pack
from modgnn_rl.trainers.ppo.actor import GaussianActor
from modgnn_rl.utils.seeds import derive_seed

SEED, AGENTS, STEPS = 3, 4, 4
SHARES = (2, 1)  # flocks of each worker
IDS = ("collector", "traj_ids")
SCRIPT = """
import os, sys
from modgnn_rl import make_model
from modgnn_rl.configs.schema import CollectorConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.remote import RemoteCollector
if __name__ == "__main__":
    spec = RolloutSpec(FlockingTask(FlockingConfig()).training_env, 2, 3, steps=2, seed=0)
    behaviour = (make_model("gcn", seed=0), Reynolds())
    collector = RemoteCollector(spec, behaviour, CollectorConfig(sys.argv[1], 2))
    collector.collect()
    print(*(worker.pid for worker in collector.workers), flush=True)
    while sys.argv[2] == "collect":
        collector.collect()
"""


def behaviour(seed: int = SEED) -> list[TensorDictModuleBase]:
    """A policy with exploration noise, the expert, and the choice between them."""
    generators = [torch.Generator().manual_seed(derive_seed(seed, name)) for name in ("mixture", "disturbance")]
    actor = GaussianActor(make_model("moment_force", seed=0))
    return [actor, Reynolds(), BetaMixture(0.5, 3, generators[0]), ActionNoise(0.1, generators[1])]


def remote(
    name: str = "process", *, timeout: float = 60.0, modules: list[TensorDictModuleBase] | None = None, **env_config
) -> RemoteCollector:
    spec = RolloutSpec(FlockingTask(FlockingConfig(**env_config)).training_env, sum(SHARES), AGENTS, STEPS, SEED)
    workers = CollectorConfig(name, workers=len(SHARES), timeout=timeout)
    return RemoteCollector(spec, modules or behaviour(), workers)


def local(index: int, **env_config) -> tuple[LocalCollector, list[TensorDictModuleBase]]:
    """A collector in this process that should collect the rollouts of a worker."""
    seed = derive_seed(SEED, "worker", index)
    modules = behaviour(seed)
    spec = RolloutSpec(FlockingTask(FlockingConfig(**env_config)).training_env, SHARES[index], AGENTS, STEPS, seed)
    return LocalCollector(spec, modules), modules


def change(modules: Sequence[TensorDictModuleBase]) -> None:
    """Change weights and settings, as trainers do between rollouts."""
    with torch.no_grad():
        for parameter in modules[0].parameters():
            parameter.mul_(0.5)
    modules[2].beta = 0.2
    modules[2].restart()
    modules[3].scale = 0.3


@pytest.fixture(scope="module")
def rollouts() -> Iterator[RemoteCollector]:
    rollouts = remote()
    yield rollouts
    rollouts.close()


def assert_equals_local_rollouts(rollouts: RemoteCollector, **env_config) -> None:
    """Two calls, with other weights and settings in between."""
    here = [local(index, **env_config) for index in range(len(SHARES))]
    for _ in range(2):
        there = rollouts.collect()
        expected: TensorDictBase = torch.cat([collector.collect() for collector, _ in here])
        assert there.shape == (sum(SHARES), STEPS)
        assert (there.exclude(IDS) == expected.exclude(IDS)).all()
        for modules in [rollouts.behaviour, *(modules for _, modules in here)]:
            change(modules)


@pytest.mark.slow
def test_workers_collect_the_rollouts_of_one_process_and_receive_changes(rollouts: RemoteCollector) -> None:
    assert_equals_local_rollouts(rollouts)


def test_rollouts_continue_and_have_unique_ids(rollouts: RemoteCollector) -> None:
    first, second = rollouts.collect(), rollouts.collect()
    torch.testing.assert_close(first["next", "agents", "observation"][:, -1], second["agents", "observation"][:, 0])
    torch.testing.assert_close(first["next", "messages"][:, -1], second["messages"][:, 0])
    assert len(second[IDS][:, 0].unique()) == sum(SHARES)


def test_rollouts_resume_from_a_state(rollouts: RemoteCollector) -> None:
    tensors, values = rollouts.state()
    noise = [generator.get_state() for generator in rollouts.generators.values()]
    expected = rollouts.collect()
    assert not (rollouts.collect() == expected).all()
    rollouts.restore(tensors, values)
    for generator, state in zip(rollouts.generators.values(), noise, strict=True):
        generator.set_state(state)
    assert (rollouts.collect().exclude(IDS) == expected.exclude(IDS)).all()


def test_error_in_a_worker_is_raised_here(rollouts: RemoteCollector) -> None:
    """The last test of these workers."""
    with torch.no_grad():
        for parameter in rollouts.behaviour[0].parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(InputError, match=r"not finite|NaN|nan"):
        rollouts.collect()
    assert all(is_running(worker.pid) for worker in rollouts.workers)


def test_weights_of_all_members_are_in_the_state_of_an_ensemble() -> None:
    ensembles = [Ensemble([make_model("gcn", seed=seed + member) for member in range(2)]) for seed in (0, 5)]
    ensembles[1].load_state_dict(ensembles[0].state_dict())
    for one, other in zip(ensembles[0]._others, ensembles[1]._others, strict=True):
        assert all((one.state_dict()[key] == value).all() for key, value in other.state_dict().items())


def test_too_many_workers_and_unpicklable_modules_are_refused() -> None:
    spec = RolloutSpec(FlockingTask(FlockingConfig()).training_env, 2, 4, steps=1, seed=0)
    with pytest.raises(InputError, match=r"collector\.workers=3 cannot share 2 flocks"):
        RemoteCollector(spec, behaviour(), CollectorConfig("process", workers=3))
    with pytest.raises(InputError, match="cannot be sent to other processes"):
        pack(spec, [TensorDictModule(threading.Lock().acquire, in_keys=["a"], out_keys=["b"])])


def test_error_says_how_to_install_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'modgnn-rl\[ray\]'"):
        remote("ray")


def collect_until_replaced(rollouts: RemoteCollector, process: int | None) -> TensorDictBase:
    """The rollouts in which the second worker was replaced."""
    while True:
        collected = rollouts.collect()
        if rollouts.workers[1].pid != process:
            return collected


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process", "ray"])
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_worker_that_dies_or_hangs_is_replaced(name: str, sent: signal.Signals, delay: float) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    rollouts = remote(name, timeout=5)
    try:
        before = rollouts.collect()
        process = rollouts.workers[1].pid
        threading.Timer(delay, os.kill, (process, sent)).start()
        time.sleep(delay / 2)
        start = time.monotonic()
        with pytest.warns(RuntimeWarning, match=rf"worker 1 of the 2 .*process {process}.* 1 environments are reset"):
            during = collect_until_replaced(rollouts, process)
        assert time.monotonic() - start < 120
        assert during.shape == before.shape
        assert not is_running(process)
        after = rollouts.collect()
        torch.testing.assert_close(during["next", "agents", "observation"][:, -1], after["agents", "observation"][:, 0])
        assert not set(after[IDS][2].tolist()) & set(before[IDS].flatten().tolist())
    finally:
        rollouts.close()


class Dies(TensorDictModuleBase):
    """A module that kills its process."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys: list[str] = []
        self.out_keys: list[str] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Exit."""
        os._exit(7)


def test_unreachable_ray_cluster_is_reported_at_once() -> None:
    pytest.importorskip("ray")
    start = time.monotonic()
    with pytest.raises(InputError, match=r"no Ray cluster answers at collector\.ray_address=127\.0\.0\.1:9 "):
        check_collector(CollectorConfig("ray", ray_address="127.0.0.1:9"), num_envs=4)
    assert time.monotonic() - start < 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:worker . of the 2:RuntimeWarning")
def test_worker_that_dies_three_times_is_an_error() -> None:
    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import the tests
    rollouts = remote(modules=[*behaviour(), Dies()])
    try:
        with pytest.raises(InputError, match=r"worker 0 .* ended 3 times in a row \(the last time: exit code 7\)"):
            rollouts.collect()
    finally:
        rollouts.close()


@pytest.mark.slow
def test_error_while_a_worker_starts_is_raised_here() -> None:
    rollouts = remote(comm_range=-1.0)
    try:
        with pytest.raises(InputError, match=r"^env\.comm_range=-1\.0 is out of range.*\)$"):
            rollouts.collect()
    finally:
        rollouts.close()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "physics"), [("process", "bullet"), ("ray", "torch"), ("ray", "bullet")])
def test_ray_and_other_physics_collect_the_same(name: str, physics: str) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    rollouts = remote(name, physics=physics)
    try:
        assert_equals_local_rollouts(rollouts, physics=physics)
    finally:
        rollouts.close()


def is_running(process: int | None) -> bool:
    """Whether a process runs, which a zombie does not."""
    listing = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True)
    return listing.stdout.strip()[:1] not in ("", "Z")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process", "ray"])
@pytest.mark.parametrize("end", ["forgets to close", "interrupted", "killed"])
def test_workers_end_with_the_parent(tmp_path: Path, name: str, end: str) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    script, scratch = tmp_path / "collect.py", Path(tempfile.mkdtemp(prefix="m"))  # sockets need a short path
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script), name, "leave" if end == "forgets to close" else "collect"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(scratch), "HOME": str(scratch)},
    )
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert len(workers) == 2
    if end == "interrupted":
        os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    elif end == "killed":
        parent.kill()
    _, errors = parent.communicate(timeout=60)
    deadline = time.monotonic() + 20
    while any(is_running(worker) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(is_running(worker) for worker in workers)
    assert errors.count("KeyboardInterrupt") == (end == "interrupted")
    if end != "killed":
        assert not list(scratch.iterdir())
