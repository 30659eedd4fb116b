"""Several processes that train together do what one does, and end together."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import warnings
from typing import Any

import pytest
import torch
import torch.distributed as dist

from modgnn_rl import make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, MAPPOConfig, ModelConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError, NotFinite
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.imitation.learner import ImitationLearner
from modgnn_rl.trainers.imitation.loss import imitation_loss
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.ppo.actor import GaussianActor
from modgnn_rl.trainers.ppo.learner import PPOLearner
from modgnn_rl.utils.signals import Stopped

ENV = FlockingConfig(num_agents=4, max_steps=15)
IMITATION: dict[str, Any] = {"num_envs": 2, "capacity": 150, "num_val_envs": 2, "checkpoint_minutes": 0}
DAGGER: dict[str, Any] = {
    **IMITATION,
    "batch_size": 16,
    "cloning_steps": 12,
    "cloning_updates": 4,
    "rounds": 3,
    "steps_per_round": 12,
    "updates_per_round": 3,
}
# By trainer.
RUNS: dict[str, dict[str, Any]] = {
    "bc": {**IMITATION, "cloning_steps": 24, "cloning_updates": 6, "dart": True, "models": ["gcn", "pair_force"]},
    "dagger": {**DAGGER, "beta_rounds": 3},
    "mappo": {
        "num_envs": 2,
        "steps_per_round": 12,
        "critic_warmup": 1,
        "num_minibatches": 2,
        "checkpoint_minutes": 0,
        "model": ModelConfig(hidden=8),
    },
}


def _in_two_processes(tmp_path, function, *arguments, as_torchrun=False):
    """What a function returns in each of two processes, or the exception that it raises there."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def work(number):
        environment = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "RANK": number, "WORLD_SIZE": 2}
        os.environ |= {name: str(value) for name, value in environment.items()}
        if as_torchrun:
            os.environ |= {"TORCHELASTIC_RUN_ID": "test", "LOCAL_RANK": str(number), "LOCAL_WORLD_SIZE": "2"}
        else:
            dist.init_process_group("gloo")
        with (tmp_path / f"output-{number}").open("w") as output, contextlib.redirect_stdout(output):
            try:
                result = function(*arguments)
            except Exception as error:
                result = error
        torch.save(result, tmp_path / f"result-{number}")

    processes = [multiprocessing.get_context("fork").Process(target=work, args=(number,)) for number in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    return [torch.load(tmp_path / f"result-{number}", weights_only=False) for number in range(2)]


def _double(data):
    return data.apply(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)


def _weights(learner):
    """All that a learner holds, and its plain values."""
    tensors, values = learner.state()
    named = {f"{group}.{name}": value.clone() for group, held in tensors.items() for name, value in held.items()}
    return named, values


def _assert_close(one, other):
    assert one[1] == other[1]
    assert set(one[0]) == set(other[0])
    for name, value in one[0].items():
        torch.testing.assert_close(other[0][name], value, rtol=1e-9, atol=1e-12, msg=name)


# Double precision, so that rounding does not hide a wrong weight.
@pytest.mark.parametrize("split", [5, 16])
def test_steps_on_parts_of_a_batch_are_the_steps_on_the_whole(tmp_path, split):
    settings = DAggerConfig(batch_size=32, learning_rates=[1e-2, 1e-2, 1e-2])
    policy = make_model("modgnn_mlp", seed=0)
    spec = RolloutSpec(FlockingTask(ENV).training_env, 8, 6, steps=20, seed=0)
    data = make_buffer(spec, settings, [policy], Reynolds(), hold_steps=20)
    data.extend(data.collect(1.0))
    chance = torch.Generator().manual_seed(1)
    batches = [_double(data.buffer.sample()) for _ in range(4)]
    receivers = [random_receivers(torch.rand(32, 6, generator=chance) < 0.5, 3, chance) for _ in batches]

    def learn():
        learner = ImitationLearner(
            make_model("modgnn_mlp", seed=0).double(), FlockingTask(ENV), settings, (2, 4), seed=0
        )
        parts = [slice(0, split), slice(split, None)]
        part = parts[distributed.rank()] if distributed.size() > 1 else slice(None)
        for batch, chosen in zip(batches, receivers, strict=True):
            own, counted = batch[part].clone(), chosen[part]
            learner.optimizer.zero_grad()
            loss = imitation_loss(learner.policy, own, counted)
            loss.backward()
            learner.step(loss, own, counted)
        return *_weights(learner), learner.gradient_norm

    alone = learn()
    for result in _in_two_processes(tmp_path, learn):
        _assert_close(alone, result)
        assert result[2] == pytest.approx(alone[2], rel=1e-9)


def test_updates_on_parts_of_the_rollouts_are_the_updates_on_the_whole(tmp_path):
    settings = MAPPOConfig(num_minibatches=1, epochs=3, agents_per_state=100, critic_hidden=8, learning_rate=1e-2)
    actor = GaussianActor(make_model("moment_force", seed=0), 0.3)
    spec = RolloutSpec(FlockingTask(ENV).training_env, 4, 4, steps=10, seed=0)
    collector = LocalCollector(spec, (actor, Reynolds()))
    rollouts = [_double(collector.collect().clone()) for _ in range(2)]
    chance = torch.Generator().manual_seed(1)
    for each in rollouts:
        controlled = each["agents", "controlled"]
        each["agents", "controlled"] = controlled & (torch.rand(controlled.shape, generator=chance) < 0.6)

    def update():
        learner = PPOLearner(make_model("moment_force", seed=0), FlockingTask(ENV), settings, seed=0)
        for module in (learner.actor, learner.averaged, learner.reference_policy, learner.critic, learner.loss):
            module.double()
        for number, each in enumerate(rollouts):
            own = each[2 * distributed.rank() :][:2] if distributed.size() > 1 else each
            learner.update(own.clone(), critic_only=number == 0, kl_coef=0.1)
        return _weights(learner)

    alone = update()
    for result in _in_two_processes(tmp_path, update):
        _assert_close(alone, result)


def test_a_nan_in_one_process_is_handled_by_all(tmp_path):
    settings = DAggerConfig(on_nonfinite="skip")
    policy = make_model("gcn", seed=0)
    spec = RolloutSpec(FlockingTask(ENV).training_env, 4, 6, steps=20, seed=0)
    data = make_buffer(spec, settings, [policy], Reynolds(), hold_steps=20)
    data.extend(data.collect(1.0))
    batch = data.buffer.sample()

    def learn(on_nonfinite):
        learner = ImitationLearner(
            make_model("gcn", seed=0), FlockingTask(ENV), DAggerConfig(on_nonfinite=on_nonfinite), (2, 4), seed=0
        )
        before, own = _weights(learner)[0], batch.clone()
        if distributed.rank() == 1:
            own["agents", "expert_action"][3, 0, 2] = torch.nan
        receivers = own["agents", "controlled"][:, -1]
        loss = imitation_loss(learner.policy, own, receivers)
        loss.backward()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            learner.step(loss, own, receivers)
        after = _weights(learner)[0]
        return all(torch.equal(value, after[name]) for name, value in before.items()), [str(w.message) for w in caught]

    (kept, told), other = _in_two_processes(tmp_path, learn, "skip")
    assert kept
    assert other == (True, [])
    assert "of agent 2 at step 0 of window 3 of its data is nan" in told[0]
    for error in _in_two_processes(tmp_path, learn, "stop"):
        assert isinstance(error, NotFinite)
        assert "of agent 2 at step 0 of window 3 of its data is nan" in str(error)


def test_means_over_processes(tmp_path):
    own = [{"a": 1.0, "b": torch.nan, "c": torch.nan}, {"a": 4.0, "b": 3.0, "c": torch.nan}]
    values = torch.randn(30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def measure():
        number = distributed.rank()
        part = values[:7] if number == 0 else values[7:]
        flags = distributed.any_of(number == 0, number == 1, False)
        return distributed.mean(own[number]), torch.stack(distributed.mean_and_std(part)), flags

    for means, moments, flags in _in_two_processes(tmp_path, measure):
        assert (means["a"], means["b"]) == (2.5, 3.0)
        assert means["c"] != means["c"]
        torch.testing.assert_close(moments, torch.stack([values.mean(), values.std()]))
        assert flags == [True, True, False]


def test_a_process_of_weight_zero_is_ignored(tmp_path):
    def reduce():
        first = distributed.rank() == 0
        parameter = torch.zeros(2, requires_grad=True)
        parameter.grad = torch.tensor([1.0, 2.0]) if first else torch.full((2,), torch.nan)
        loss = distributed.reduce_gradients([parameter], torch.tensor(3.0 if first else torch.nan), torch.tensor(first))
        return [*parameter.grad.tolist(), float(loss)]

    assert _in_two_processes(tmp_path, reduce) == [[1.0, 2.0, 3.0]] * 2


def test_diverging_weights_are_detected(tmp_path):
    def check():
        weights = torch.ones(5)
        distributed.check_alike([weights], "after round 3")
        weights[3] += 1e-7 * distributed.rank()
        distributed.check_alike([weights], "after round 4")

    for error in _in_two_processes(tmp_path, check):
        assert isinstance(error, InputError)
        assert "process 1 differ from those of process 0 after round 4" in str(error)


class Spy(Callback):
    """Keeps the starts of the rollouts and the last policies; stops one process in a round."""

    def __init__(self, stop_at=None, stops=0):
        self.starts, self.stop_at, self.stops = [], stop_at, stops

    def on_collect(self, index, rollouts):
        """Look at the rollouts."""
        self.starts.append(rollouts["agents", "observation"][:, 0].clone())
        if index == self.stop_at and distributed.rank() == self.stops:
            os.kill(os.getpid(), signal.SIGTERM)

    def on_start(self, policies):
        """Keep the policies."""
        self.policies = policies


def _train(config, act=train, **spying):
    spy, stopped = Spy(**spying), 0
    try:
        act(config, callbacks=[spy], evaluate=False)
    except Stopped as stop:
        stopped = stop.code
    weights = [policy.state_dict() for policy in spy.policies.values()]
    return weights, spy.starts, stopped


@pytest.mark.parametrize("name", ["dagger", *(pytest.param(name, marks=pytest.mark.slow) for name in ("bc", "mappo"))])
def test_a_run_of_two_processes(tmp_path, name, small_config):
    config = small_config(tmp_path / "runs", name, **{"env": ENV, "model": ModelConfig(), **RUNS[name]})
    (weights, starts, _), (others, elsewhere, _) = _in_two_processes(tmp_path, _train, config, as_torchrun=True)
    for one, other in zip(weights, others, strict=True):
        assert all(torch.equal(value, other[key]) for key, value in one.items())
    assert starts[0].shape == elsewhere[0].shape == (8, 4, 6)  # 2 x 32 agents in flocks of 4, shared by two
    assert not torch.isclose(starts[0][:, 0, :3], elsewhere[0][:, 0, :3]).any()
    (folder,) = (tmp_path / "runs").iterdir()
    run = RunFolder.open(folder)
    assert run.state == "finished"
    assert run.config["trainer"]["num_envs"] == 2
    assert (tmp_path / "output-0").read_text() == f"Training in {folder}\n"
    assert (tmp_path / "output-1").read_text() == ""
    saved = load_checkpoint(run.checkpoints).tensors["policy"]
    assert all(torch.equal(value, saved[key]) for key, value in weights[0].items())


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_signal_to_one_process_stops_all_and_the_run_resumes(tmp_path, name, small_config):
    config = small_config(tmp_path / "runs", name, **{"env": ENV, "model": ModelConfig(), **RUNS[name]})
    spying = {"stop_at": 1, "stops": 1}
    results = _in_two_processes(tmp_path, lambda: _train(config, **spying), as_torchrun=True)
    assert [stopped for *_, stopped in results] == [143, 143]
    (folder,) = (tmp_path / "runs").iterdir()
    run = RunFolder.open(folder)
    assert run.state == "stopped"
    (weights, *_), (others, *_) = _in_two_processes(tmp_path, _train, folder, resume, as_torchrun=True)
    for one, other in zip(weights, others, strict=True):
        assert all(torch.equal(value, other[key]) for key, value in one.items())
    assert run.state == "finished"
    steps = [record["step"] for record in run.read_metrics()]
    assert steps == list(range(steps[0], steps[0] + len(steps)))


def _torchrun(runs, **changes):
    """A long run of two processes, as a person starts it, once the first rounds are over."""
    trainer = {**DAGGER, "rounds": 100_000, **changes}
    settings = [f"trainer.{name}={value}" for name, value in trainer.items()]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    command += ["-m", "modgnn_rl.train", "trainer=dagger", "env.num_agents=4", "env.max_steps=15", *settings]
    output = (runs.parent / "output").open("w")
    process = subprocess.Popen([*command, f"runs={shlex.quote(str(runs))}"], stdout=output, stderr=output)
    deadline = time.monotonic() + 120
    while not list(runs.glob("*/checkpoints/step_*[1-9]")):
        assert process.poll() is None, (runs.parent / "output").read_text()
        assert time.monotonic() < deadline
        time.sleep(0.2)
    (folder,) = runs.iterdir()
    return process, RunFolder.open(folder), runs.parent / "output"


@pytest.mark.slow
def test_sigterm_to_torchrun_leaves_a_checkpoint(tmp_path):
    process, run, output = _torchrun(tmp_path / "runs")
    process.terminate()
    process.wait(40)
    assert run.state == "stopped"
    assert load_checkpoint(run.checkpoints).step == len(run.read_metrics()) == run.status["round"]
    assert output.read_text().count("To resume: python -m modgnn_rl.train") == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_a_killed_process_ends_the_other(tmp_path, number):
    process, run, output = _torchrun(tmp_path / "runs")
    children = subprocess.run(
        ["ps", "--ppid", str(process.pid), "-o", "pid="], capture_output=True, text=True, check=True
    ).stdout.split()
    first = json.loads((run.path / "status.json").read_text())["pid"]
    (victim,) = [int(pid) for pid in children if (int(pid) == first) == (number == 0)]
    os.kill(victim, signal.SIGKILL)
    process.wait(60)
    assert process.returncode != 0
    assert run.state == ("killed" if number == 0 else "failed")
    (line,) = re.findall(r"^error: process.*$", output.read_text(), re.MULTILINE)
    assert f"process {1 - number} of 2 lost the others" in line
    assert "continue from the last checkpoint with resume=" in line
    load_checkpoint(run.checkpoints)
