"""Rollouts of worker processes: those of one process, and nothing hangs, is lost or left behind when a worker dies."""

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
from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, Ensemble
from modgnn_rl.trainers.collectors.local import FlockCollector
from modgnn_rl.trainers.collectors.remote import RemoteCollector, check_collector
from modgnn_rl.trainers.collectors.worker import packed
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
from modgnn_rl.trainers.collectors.remote import RemoteCollector
if __name__ == "__main__":
    flown = (make_model("gcn", seed=0), Reynolds())
    rollouts = RemoteCollector(FlockingConfig(), 2, 3, flown, steps=2, seed=0, collector=CollectorConfig(sys.argv[1],
    2)) rollouts.collect()
    print(*(worker.process for worker in rollouts._workers), flush=True)
    while sys.argv[2] == "fly":
        rollouts.collect()
"""


def behaviour(seed: int = SEED) -> list[TensorDictModuleBase]:
    """A policy that explores, the expert, and who of them flies."""
    generators = [torch.Generator().manual_seed(derive_seed(seed, name)) for name in ("mixture", "disturbance")]
    actor = GaussianActor(make_model("moment_force", seed=0))
    return [actor, Reynolds(), BetaMixture(0.5, 3, generators[0]), ActionNoise(0.1, generators[1])]


def remote(
    name: str = "process", *, timeout: float = 60.0, flown: list[TensorDictModuleBase] | None = None, **env_config
):
    return RemoteCollector(
        FlockingConfig(**env_config),
        sum(SHARES),
        AGENTS,
        flown or behaviour(),
        steps=STEPS,
        seed=SEED,
        collector=CollectorConfig(name, workers=len(SHARES), timeout=timeout),
    )


def local(index: int, **env_config) -> tuple[FlockCollector, list[TensorDictModuleBase]]:
    """What a worker should fly, in this process."""
    seed = derive_seed(SEED, "worker", index)
    flown = behaviour(seed)
    return FlockCollector(FlockingConfig(**env_config), SHARES[index], AGENTS, flown, steps=STEPS, seed=seed), flown


def change(flown: Sequence[TensorDictModuleBase]) -> None:
    """What trainers do between rollouts."""
    with torch.no_grad():
        for parameter in flown[0].parameters():
            parameter.mul_(0.5)
    flown[2].share = 0.2
    flown[2].restart()
    flown[3].scale = 0.3


@pytest.fixture(scope="module")
def rollouts() -> Iterator[RemoteCollector]:
    rollouts = remote()
    yield rollouts
    rollouts.close()


def assert_flies_as_one_process(rollouts: RemoteCollector, **env_config) -> None:
    """Two calls, with other weights and settings in between."""
    here = [local(index, **env_config) for index in range(len(SHARES))]
    for _ in range(2):
        there = rollouts.collect()
        expected: TensorDictBase = torch.cat([flocks.collect() for flocks, _ in here])
        assert there.shape == (sum(SHARES), STEPS)
        assert (there.exclude(IDS) == expected.exclude(IDS)).all()
        for flown in [rollouts.behaviour, *(flown for _, flown in here)]:
            change(flown)


@pytest.mark.slow
def test_each_worker_flies_as_one_process_would_and_hears_of_changes(rollouts: RemoteCollector) -> None:
    assert_flies_as_one_process(rollouts)


def test_flights_go_on_and_each_has_an_id_of_its_own(rollouts: RemoteCollector) -> None:
    first, second = rollouts.collect(), rollouts.collect()
    torch.testing.assert_close(first["next", "agents", "observation"][:, -1], second["agents", "observation"][:, 0])
    torch.testing.assert_close(first["next", "messages"][:, -1], second["messages"][:, 0])
    assert len(second[IDS][:, 0].unique()) == sum(SHARES)


def test_flights_go_on_from_a_state(rollouts: RemoteCollector) -> None:
    tensors, values = rollouts.state()
    noise = [generator.get_state() for generator in rollouts.generators.values()]
    flown = rollouts.collect()
    assert not (rollouts.collect() == flown).all()
    rollouts.restore(tensors, values)
    for generator, state in zip(rollouts.generators.values(), noise, strict=True):
        generator.set_state(state)
    assert (rollouts.collect().exclude(IDS) == flown.exclude(IDS)).all()


def test_error_in_a_worker_is_raised_here(rollouts: RemoteCollector) -> None:
    """The last test of these workers."""
    with torch.no_grad():
        for parameter in rollouts.behaviour[0].parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(InputError, match=r"not finite|NaN|nan"):
        rollouts.collect()
    assert all(worker.collector.procs[0].is_alive() for worker in rollouts._workers)


def test_members_of_an_ensemble_travel_with_its_state() -> None:
    ensembles = [Ensemble([make_model("gcn", seed=seed + member) for member in range(2)]) for seed in (0, 5)]
    ensembles[1].load_state_dict(ensembles[0].state_dict())
    for one, other in zip(ensembles[0]._others, ensembles[1]._others, strict=True):
        assert all((one.state_dict()[key] == value).all() for key, value in other.state_dict().items())


def test_what_cannot_be_shared_out_or_sent_is_refused_at_once() -> None:
    with pytest.raises(InputError, match=r"collector\.workers=3 cannot share 2 flocks"):
        RemoteCollector(
            FlockingConfig(), 2, 4, behaviour(), steps=1, seed=0, collector=CollectorConfig("process", workers=3)
        )
    with pytest.raises(InputError, match="cannot be sent to other processes"):
        packed([TensorDictModule(threading.Lock().acquire, in_keys=["a"], out_keys=["b"])])


def test_ray_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'modgnn-rl\[ray\]'"):
        remote("ray")


def fly_until_replaced(rollouts: RemoteCollector, process: int) -> TensorDictBase:
    """The rollouts in which the second worker was replaced."""
    while True:
        flown = rollouts.collect()
        if rollouts._workers[1].process != process:
            return flown


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process", "ray"])
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_worker_that_dies_or_hangs_is_replaced(name: str, blow: signal.Signals, delay: float) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    rollouts = remote(name, timeout=5)
    try:
        before = rollouts.collect()
        process = rollouts._workers[1].process
        threading.Timer(delay, os.kill, (process, blow)).start()
        time.sleep(delay / 2)
        start = time.monotonic()
        with pytest.warns(RuntimeWarning, match=rf"worker 1 of the 2 .*process {process}.* its 1 flocks begin anew"):
            during = fly_until_replaced(rollouts, process)
        assert time.monotonic() - start < 120
        assert during.shape == before.shape
        assert not is_running(process)
        after = rollouts.collect()
        torch.testing.assert_close(during["next", "agents", "observation"][:, -1], after["agents", "observation"][:, 0])
        assert not set(after[IDS][2].tolist()) & set(before[IDS].flatten().tolist())
    finally:
        rollouts.close()


class Dies(TensorDictModuleBase):
    """A module that ends its process."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys: list[str] = []
        self.out_keys: list[str] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """End."""
        os._exit(7)


def test_cluster_that_does_not_answer_is_named_at_once() -> None:
    pytest.importorskip("ray")
    start = time.monotonic()
    with pytest.raises(InputError, match=r"no Ray cluster answers at collector\.ray_address=127\.0\.0\.1:9 "):
        check_collector(CollectorConfig("ray", ray_address="127.0.0.1:9"), num_envs=4)
    assert time.monotonic() - start < 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:worker . of the 2:RuntimeWarning")
def test_worker_that_dies_again_and_again_is_an_error() -> None:
    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import the tests
    rollouts = remote(flown=[*behaviour(), Dies()])
    try:
        with pytest.raises(InputError, match=r"worker 0 .* ended 3 times in a row \(at last: exit code 7\)"):
            rollouts.collect()
    finally:
        rollouts.close()


@pytest.mark.slow
def test_what_keeps_a_worker_from_starting_is_raised_here() -> None:
    rollouts = remote(comm_range=-1.0)
    try:
        with pytest.raises(InputError, match=r"^env\.comm_range=-1\.0 is out of range.*\)$"):
            rollouts.collect()
    finally:
        rollouts.close()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "physics"), [("process", "bullet"), ("ray", "torch"), ("ray", "bullet")])
def test_other_physics_and_ray_fly_the_same(name: str, physics: str) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    rollouts = remote(name, physics=physics)
    try:
        assert_flies_as_one_process(rollouts, physics=physics)
    finally:
        rollouts.close()


def is_running(process: int) -> bool:
    """Whether a process is there, and not only waits for somebody to read its exit code."""
    listing = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True)
    return listing.stdout.strip()[:1] not in ("", "Z")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process", "ray"])
@pytest.mark.parametrize("end", ["forgets to close", "interrupted", "killed"])
def test_workers_end_with_the_parent(tmp_path: Path, name: str, end: str) -> None:
    if name == "ray":
        pytest.importorskip("ray")
    script, scratch = tmp_path / "fly.py", Path(tempfile.mkdtemp(prefix="m"))  # sockets need a short path
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script), name, "leave" if end == "forgets to close" else "fly"],
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
