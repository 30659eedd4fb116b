"""Rollouts collected by workers: processes on this machine, or actors of a Ray cluster."""

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

from modgnn_rl.configs.schema import CollectorConfig
from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.trainers.collectors.workers import ProcessWorker, RayWorker, Worker, WorkerEndedError, get_weights, pack
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["RemoteCollector", "check_collector", "make_collector"]

MAX_RESTARTS = 3  # times in a row that a worker may end before training ends
CONNECT_TIMEOUT = 2.0  # longest wait for a Ray cluster to answer, s
START_TIMEOUT = 120.0  # longest wait for a worker to start, in addition to collector.timeout, s
IDS = ("collector", "traj_ids")
WORKERS: dict[str, type[ProcessWorker] | type[RayWorker]] = {"process": ProcessWorker, "ray": RayWorker}


def make_collector(
    spec: RolloutSpec, behaviour: Sequence[TensorDictModuleBase], config: CollectorConfig | None = None
) -> LocalCollector | RemoteCollector:
    """A collector in this process (``single``, the default) or with workers; see `LocalCollector`, `RemoteCollector`.

    Raises:
        InputError: see `RemoteCollector`.
    """
    if config is None or config.name == "single":
        return LocalCollector(spec, behaviour)
    return RemoteCollector(spec, behaviour, config)


def check_collector(config: CollectorConfig, num_envs: int) -> None:
    """Check that the workers can be started.

    Args:
        config: which workers.
        num_envs: environments that they share.

    Raises:
        InputError: Ray is not installed or does not answer, or there are more workers than environments.
    """
    if config.name == "ray" and importlib.util.find_spec("ray") is None:
        raise InputError("collector=ray needs Ray, which is not installed; run: pip install 'modgnn-rl[ray]'")
    host, _, port = (config.ray_address or "").removeprefix("ray://").rpartition(":")
    if config.name == "ray" and host and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT).close()
        except OSError as error:  # Ray itself would try for minutes
            raise InputError(
                f"no Ray cluster answers at collector.ray_address={config.ray_address} ({error}); start it with "
                "'ray start --head', or leave the address out to start Ray on this machine"
            ) from error
    if config.name != "single" and (config.workers or 1) > num_envs:
        raise InputError(
            f"collector.workers={config.workers} cannot share {num_envs} flocks of one size; use at most as many "
            "workers, or more flocks (trainer.num_envs)"
        )


class RemoteCollector:
    """Collects rollouts with workers, each of which has some of the environments.

    Worker i collects what `LocalCollector` would with the seed ``derive_seed(seed, "worker", i)``. A worker that dies
    or does not answer is replaced with a warning, and its environments start from new initial states.

    Args:
        spec: which rollouts, of all workers together. They pass between processes through the CPU's memory.
        behaviour: modules that act and label, in this order. The workers have copies, whose weights and extra state
            are updated with each call.
        config: which workers.

    Raises:
        InputError: see `check_collector`; or a module cannot be sent to other processes.
    """

    def __init__(self, spec: RolloutSpec, behaviour: Sequence[TensorDictModuleBase], config: CollectorConfig) -> None:
        check_collector(config, spec.num_envs)
        count = config.workers or min(_cores(), spec.num_envs)
        self.spec, self.behaviour, self.config = spec, behaviour, config
        self.shares = [spec.num_envs // count + (index < spec.num_envs % count) for index in range(count)]
        self._restarts, self._is_starting = [0] * count, [True] * count
        self._first_ids, self._next_ids = [0] * count, [0] * count
        self.workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, _kill_all, self.workers)
        for index in range(count):
            self.workers.append(self._start_worker(index))
        atexit.register(self._finalizer)  # before Ray ends, which then runs still

    def collect(self) -> TensorDictBase:
        """Continue the rollouts; returns [B, T].

        Raises:
            InputError: a worker has ended several times in a row.
            Exception: raised in a worker that still runs, such as an `InputError` on NaN.
        """
        weights = get_weights(self.behaviour)
        parts = self._call_all("collect", [(weights,)] * len(self.workers))
        rollouts = [self._with_unique_ids(index, part) for index, part in enumerate(parts)]
        return torch.cat(rollouts).to(self.spec.device)

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state of all workers, their generators included, for a checkpoint: tensors and plain values."""
        states = self._call_all("state", [()] * len(self.workers))
        return {f"worker{index}-{group}": own[group] for index, own in enumerate(states) for group in own}, {}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Resume from the result of `state`.

        Raises:
            KeyError, RuntimeError: the state is that of other environments, or of another number of workers.
        """
        states: list[TensorGroups] = [{} for _ in self.workers]
        for name, group in tensors.items():
            worker, _, key = name.partition("-")
            if worker.startswith("worker"):
                states[int(worker.removeprefix("worker"))][key] = group
        weights = get_weights(self.behaviour)
        self._call_all("restore", [(weights, pickle.dumps(state)) for state in states])

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """Random generators in this process: none; those of the workers are part of `state`."""
        return {}

    def close(self) -> None:
        """End the workers."""
        self._finalizer()
        atexit.unregister(self._finalizer)

    def _call_all(self, method: str, arguments: Sequence[tuple[bytes, ...]]) -> list[Any]:
        """Call a method of each worker with its own arguments, and wait for all results."""
        for index in range(len(self.workers)):
            if not self._is_starting[index]:
                self.workers[index].call(method, *arguments[index])
        results: list[Any] = []
        errors: list[Exception] = []
        for index, own in enumerate(arguments):  # waits for all, so that no worker is busy after an error
            try:
                results.append(self._result(index, method, own))
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]
        return results

    def _result(self, index: int, method: str, arguments: tuple[bytes, ...]) -> Any:
        """The result of a worker, or of the one that replaces it."""
        who = f"worker {index} of the {len(self.workers)} that collect rollouts"
        for attempt in range(MAX_RESTARTS):
            worker = self.workers[index]
            try:
                if self._is_starting[index]:
                    worker.result(self.config.timeout + START_TIMEOUT)
                    self._is_starting[index] = False
                    worker.call(method, *arguments)
                return worker.result(self.config.timeout)
            except WorkerEndedError as error:
                how = str(error)
            if attempt < MAX_RESTARTS - 1:
                warnings.warn(
                    f"{who} (process {worker.pid}) has ended ({how}) and is replaced; its {self.shares[index]} "
                    "environments are reset",
                    RuntimeWarning,
                    stacklevel=4,
                )
                worker.kill()
                self._restarts[index] += 1
                self._first_ids[index] = self._next_ids[index]
                self.workers[index] = self._start_worker(index)
        raise InputError(
            f"{who} has ended {MAX_RESTARTS} times in a row (the last time: {how}); use fewer workers "
            "(collector.workers) if memory runs out, a longer collector.timeout if they are slow, or collector=single"
        )

    def _start_worker(self, index: int) -> Worker:
        """Start a worker, without waiting for it; each that replaces another has a new seed."""
        seed = derive_seed(self.spec.seed, "worker", index)
        if self._restarts[index]:
            seed = derive_seed(seed, "replacement", self._restarts[index])
        spec = dataclasses.replace(self.spec, num_envs=self.shares[index], seed=seed)
        packed = pack(spec, self.behaviour)
        worker = WORKERS[self.config.name](self.config.ray_address)
        worker.call("start", packed)
        self._is_starting[index] = True
        return worker

    def _with_unique_ids(self, index: int, rollouts: TensorDictBase) -> TensorDictBase:
        """Rollouts with trajectory ids, which each worker counts from 0, that differ between workers."""
        ids = rollouts[IDS] + self._first_ids[index]
        self._next_ids[index] = int(ids.max()) + 1
        return rollouts.set(IDS, ids * len(self.workers) + index)


def _kill_all(workers: Sequence[Worker]) -> None:
    for worker in workers:
        worker.kill()


def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
