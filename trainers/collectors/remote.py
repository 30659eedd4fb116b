"""Flocks that other processes fly: on this machine, or on a Ray cluster."""

from __future__ import annotations

import atexit
import dataclasses
import importlib.util
import os
import pickle
import socket
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import CollectorConfig, FlockingConfig
from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.worker import WorkerSpec, packed, weights_of
from modgnn_rl.trainers.collectors.workers import ProcessWorker, RayWorker, Worker, WorkerEndedError, close_all
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["RemoteCollector", "check_collector"]

MAX_RESTARTS = 3  # times in a row that a worker may end until training does
REACHING = 2.0  # longest wait for a Ray cluster to answer, s
IDS = ("collector", "traj_ids")
KINDS: dict[str, type[Worker]] = {"process": ProcessWorker, "ray": RayWorker}


def check_collector(config: CollectorConfig, num_envs: int) -> None:
    """Refuse what cannot be: Ray that is not installed or does not answer, or more workers than flocks.

    Args:
        config: which workers.
        num_envs: flocks that they share.

    Raises:
        InputError: one of these.
    """
    if config.name == "ray" and importlib.util.find_spec("ray") is None:
        raise InputError("collector=ray needs Ray, which is not installed; run: pip install 'modgnn-rl[ray]'")
    host, _, port = (config.ray_address or "").removeprefix("ray://").rpartition(":")
    if config.name == "ray" and host and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout=REACHING).close()
        except OSError as error:  # Ray itself would try for minutes
            raise InputError(
                f"no Ray cluster answers at collector.ray_address={config.ray_address} ({error}); start it with "
                "'ray start --head', or leave the address out to start Ray here"
            ) from error
    if config.name != "single" and (config.workers or 1) > num_envs:
        raise InputError(
            f"collector.workers={config.workers} cannot share {num_envs} flocks of one size; give at most as many "
            "workers, or fly more flocks (trainer.num_envs)"
        )


class RemoteCollector:
    """Flocks of one size that workers fly, each a part of them, in step with each other.

    What `modgnn_rl.trainers.collectors.local.FlockCollector` does in this process, with the same data. The first
    worker's flocks are those of a `FlockCollector` with the seed ``derive_seed(seed, "worker", 0)``, and so on. A
    worker that dies, or does not answer, is replaced, and its flocks begin anew; a warning says so.

    Args:
        config: the world.
        num_envs: flocks flown at once by all workers together, B.
        num_agents: agents in each, N.
        behaviour: the modules that fly and label, in this order; copies of them fly, and take over their state (weights
            changed in place, who flies) with each call.
        steps: steps of one call of `collect`, T.
        seed: from which each worker derives its own.
        device: where flocks fly, and where their rollouts are brought; between processes they pass through the CPU's
            memory.
        collector: which workers.

    Raises:
        InputError: more workers than flocks, a module that cannot be sent, or no Ray.
    """

    def __init__(
        self,
        config: FlockingConfig,
        num_envs: int,
        num_agents: int,
        behaviour: Sequence[TensorDictModuleBase],
        *,
        steps: int,
        seed: int,
        device: torch.device | str = "cpu",
        collector: CollectorConfig,
    ) -> None:
        check_collector(collector, num_envs)
        count = collector.workers or min(_cores(), num_envs)
        self.num_agents, self.device, self.collector = num_agents, torch.device(device), collector
        self.behaviour = behaviour
        modules = packed(behaviour)
        shares = [num_envs // count + (index < num_envs % count) for index in range(count)]
        self._flights = [
            WorkerSpec(config, share, num_agents, modules, steps, derive_seed(seed, "worker", index), str(device))
            for index, share in enumerate(shares)
        ]
        self.noise = [torch.Generator().manual_seed(derive_seed(rollout.seed, "noise")) for rollout in self._flights]
        self._replacements = [0] * count
        self._first_ids, self._next_ids = [0] * count, [0] * count
        self._workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, close_all, self._workers)
        for index in range(count):
            self._workers.append(self._start_worker(index))
        atexit.register(self._finalizer)  # else multiprocessing would wait for workers that nobody has closed

    def collect(self) -> TensorDictBase:
        """Continue the rollouts by some steps; rollouts [B, T].

        Raises:
            InputError: a worker ends again and again.
            Exception: what was raised in a worker that is still there, such as an `InputError` on a NaN.
        """
        weights = weights_of(self.behaviour)
        seeds = [int(torch.randint(2**31, (), generator=noise)) for noise in self.noise]
        flown = self._ask_all("fly", [(weights, seed) for seed in seeds])
        rollouts = [self._with_own_ids(index, rollouts) for index, rollouts in enumerate(flown)]
        return torch.cat(rollouts).to(self.device)

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """What a checkpoint holds of the rollouts, worker by worker."""
        states = self._ask_all("state", [()] * len(self._workers))
        return {f"worker{index}-{group}": own[group] for index, own in enumerate(states) for group in own}, {}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Go on from what `state` gave.

        Raises:
            KeyError, RuntimeError: these are rollouts of other flocks, or of another number of workers.
        """
        weights = weights_of(self.behaviour)
        states: list[TensorGroups] = [{} for _ in self._workers]
        for name, group in tensors.items():
            worker, _, key = name.partition("-")
            if worker.startswith("worker"):
                states[int(worker.removeprefix("worker"))][key] = group
        self._ask_all("restore", [(weights, pickle.dumps(state)) for state in states])

    def _ask_all(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Call a method of each worker's collector, with its own arguments, and wait for all."""
        for worker, own in zip(self._workers, arguments, strict=True):
            worker.ask(method, *own)
        answers: list[Any] = []
        errors: list[Exception] = []
        for index, own in enumerate(arguments):  # none is left busy, whatever goes wrong
            try:
                answers.append(self._answer(index, method, own))
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]
        return answers

    def _answer(self, index: int, method: str, arguments: tuple[Any, ...]) -> Any:
        """The answer of a worker that was asked, or of the one that replaces it."""
        who = f"worker {index} of the {len(self._workers)} that fly flocks"
        for life in range(MAX_RESTARTS):
            if life:
                self._workers[index].ask(method, *arguments)
            worker = self._workers[index]
            try:
                return worker.answer(self.collector.timeout)
            except WorkerEndedError as error:
                how = str(error)
            if life < MAX_RESTARTS - 1:
                warnings.warn(
                    f"{who} (process {worker.process}) has ended ({how}) and is replaced; its "
                    f"{self._flights[index].num_envs} flocks begin anew",
                    RuntimeWarning,
                    stacklevel=4,
                )
                self._replace(index)
        raise InputError(
            f"{who} has ended {MAX_RESTARTS} times in a row (at last: {how}); fewer workers (collector.workers) "
            f"need less "
            "memory, slow ones a longer collector.timeout, and collector=single needs none"
        )

    def _replace(self, index: int) -> None:
        ended = self._workers[index]
        self._replacements[index] += 1
        self._first_ids[index] = self._next_ids[index]
        self._workers[index] = self._start_worker(index)
        close_all([ended])

    def _start_worker(self, index: int) -> Worker:
        """Start a worker; one that replaces another has a seed of its own."""
        rollout = self._flights[index]
        if self._replacements[index]:
            seed = derive_seed(rollout.seed, "replacement", self._replacements[index])
            rollout = dataclasses.replace(rollout, seed=seed)
        return KINDS[self.collector.name](rollout, self.collector.ray_address)

    def _with_own_ids(self, index: int, rollouts: TensorDictBase) -> TensorDictBase:
        """Rollouts whose trajectory ids, which each worker counts from 0, are those of no other rollout."""
        ids = rollouts[IDS] + self._first_ids[index]
        self._next_ids[index] = int(ids.max()) + 1
        return rollouts.set(IDS, ids * len(self._workers) + index)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random in this process, by name; what draws in the workers is part of `state`."""
        return {f"noise-{index}": noise for index, noise in enumerate(self.noise)}

    def close(self) -> None:
        """End the workers."""
        self._finalizer()
        atexit.unregister(self._finalizer)


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
