"""Workers that collect rollouts: processes on this machine, or actors of Ray. Each runs a `LocalCollector`.

TorchRL's collectors with several workers end all of them when one dies. Here each worker can be replaced alone.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import logging
import multiprocessing
import os
import pickle
import secrets
import shutil
import signal
import socket
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Protocol

import cloudpickle
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import BetaMixture
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.utils.seeds import derive_seed
from modgnn_rl.utils.signals import follow_parent

__all__ = ["ProcessWorker", "RayWorker", "Worker", "WorkerCollector", "WorkerEndedError", "get_weights", "pack"]

RAY_MEMORY = 256 * 2**20  # bytes of Ray's object store on this machine; rollouts pass through it


class WorkerEndedError(Exception):
    """A worker has ended, or was ended because it did not answer; the message says how."""


class _Pickler(cloudpickle.Pickler):
    """Pickles random generators, too, and modules defined in the user's own script."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, torch.Generator):
            return torch.Generator, (str(value.device),)
        return super().reducer_override(value)


class _PickleModule:
    """The functions of `pickle` that `torch.save` uses."""

    Pickler = _Pickler
    dumps, load, loads = cloudpickle.dumps, pickle.load, pickle.loads


def pack(spec: RolloutSpec, behaviour: Sequence[TensorDictModuleBase]) -> bytes:
    """What a worker collects, in a form that can be sent; generators lose their state.

    Raises:
        InputError: a module cannot be sent.
    """
    file = io.BytesIO()
    try:
        torch.save((spec, list(behaviour)), file, pickle_module=_PickleModule)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        names = ", ".join(type(module).__name__ for module in behaviour)
        raise InputError(
            f"one of the modules of the acting policy ({names}) cannot be sent to other processes ({error}); make it "
            "picklable, or use collector=single"
        ) from error
    return file.getvalue()


def get_weights(behaviour: Sequence[TensorDictModuleBase]) -> bytes:
    """The weights and extra state of modules, as `WorkerCollector.collect` takes them."""
    file = io.BytesIO()
    torch.save(nn.ModuleList(behaviour).state_dict(), file)
    return file.getvalue()


class WorkerCollector:
    """The collector inside a worker. It returns pickled results: tensors would pass through files in shared memory."""

    def start(self, packed: bytes) -> bytes:
        """Create the `LocalCollector`; returns host and process id.

        Args:
            packed: made by `pack`. Generators of modules are seeded by the module's ``seed_role``, or its class name.
        """
        follow_parent()
        logging.getLogger("torchrl").setLevel(logging.WARNING)
        torch.set_num_threads(1)
        spec, behaviour = torch.load(io.BytesIO(packed), weights_only=False)
        self.behaviour = nn.ModuleList(behaviour)
        generators = {}
        for name, module in self.behaviour.named_modules():
            for key, value in vars(module).items():
                if isinstance(value, torch.Generator):
                    role = getattr(module, "seed_role", type(module).__name__.lower())
                    generators[f"{name}.{key}"] = value.manual_seed(derive_seed(spec.seed, role))
        self.collector = LocalCollector(spec, behaviour)
        self.generators = self.collector.generators | generators
        mixtures = [module for module in self.behaviour.modules() if isinstance(module, BetaMixture)]
        self.mixtures = {f"mixture{number}": mixture for number, mixture in enumerate(mixtures)}
        return pickle.dumps((socket.gethostname(), os.getpid()))

    def collect(self, weights: bytes) -> bytes:
        """Continue the rollouts with these weights; returns [B, T] on the CPU."""
        self._load(weights)
        return pickle.dumps(self.collector.collect().to("cpu"))

    def state(self) -> bytes:
        """The state of rollouts and generators for a checkpoint."""
        tensors, _ = self.collector.state()
        tensors["generators"] = {name: generator.get_state() for name, generator in self.generators.items()}
        tensors |= {name: mixture.state() for name, mixture in self.mixtures.items()}
        return pickle.dumps({group: {key: value.cpu() for key, value in own.items()} for group, own in tensors.items()})

    def restore(self, weights: bytes, state: bytes) -> bytes:
        """Resume from the result of `state`."""
        self._load(weights)
        tensors = pickle.loads(state)
        self.collector.restore(tensors, {})
        for name, generator in self.generators.items():
            generator.set_state(tensors["generators"][name])
        for name, mixture in self.mixtures.items():
            mixture.restore(tensors[name])
        return pickle.dumps(None)

    def _load(self, weights: bytes) -> None:
        self.behaviour.load_state_dict(torch.load(io.BytesIO(weights), map_location="cpu", weights_only=True))


class Worker(Protocol):
    """A worker; `call` begins to call a method of its `WorkerCollector`, `result` waits for the result."""

    pid: int | None

    def call(self, method: str, *arguments: bytes) -> None:
        """Begin a call."""

    def result(self, timeout: float) -> Any:
        """Wait for the result of the call, at most ``timeout`` s.

        Raises:
            WorkerEndedError: the worker has ended, or did not answer in time.
            Exception: raised in the worker, which still runs.
        """

    def kill(self) -> None:
        """End the worker at once."""


class ProcessWorker:
    """A worker process on this machine; ``address`` is not used."""

    def __init__(self, address: str | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, pipe = context.Pipe()
        self._process = context.Process(target=_serve, args=(pipe,), daemon=True)
        self._process.start()
        pipe.close()  # so that the end of the worker is the end of the pipe
        self.pid = self._process.pid

    def call(self, method: str, *arguments: bytes) -> None:
        """Begin a call; see `Worker`."""
        self._answer = _in_thread(self._call, pickle.dumps((method, arguments)))

    def _call(self, message: bytes) -> Any:
        try:
            self._pipe.send_bytes(message)  # waits for ever for a process that was stopped: hence the thread
            is_error, value = pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError) as error:
            self._process.join()
            raise WorkerEndedError(f"exit code {self._process.exitcode}") from error
        if is_error:
            raise value
        return pickle.loads(value)

    def result(self, timeout: float) -> Any:
        """Wait for the result of the call; see `Worker`."""
        try:
            return self._answer.result(timeout)
        except FutureTimeoutError as error:
            self.kill()
            raise WorkerEndedError(f"no answer within {timeout:g} s") from error

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection) -> None:
    """Run in a worker process: answer calls until the pipe ends."""
    collector = WorkerCollector()
    with contextlib.suppress(EOFError, OSError):
        while True:
            method, arguments = pickle.loads(pipe.recv_bytes())
            try:
                answer = (False, getattr(collector, method)(*arguments))
            except Exception as error:
                answer = (True, error)
            pipe.send_bytes(cloudpickle.dumps(answer))


def _in_thread(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Call a function in a thread that does not keep this process alive."""
    future: Future[Any] = Future()

    def run() -> None:
        try:
            future.set_result(function(*arguments))
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, daemon=True).start()
    return future


class RayWorker:
    """An actor of the Ray cluster at ``address``, or of Ray on this machine, which ends with this process."""

    def __init__(self, address: str | None = None) -> None:
        _start_ray(address)
        import ray

        num_cpus, num_gpus = 0 if address is None else 1, 0.01 if torch.cuda.is_available() else 0
        actor: Any = ray.remote(WorkerCollector)
        self._actor = actor.options(num_cpus=num_cpus, num_gpus=num_gpus).remote()
        self.pid: int | None = None

    def call(self, method: str, *arguments: bytes) -> None:
        """Begin a call; see `Worker`."""
        self._is_start = method == "start"
        self._answer = getattr(self._actor, method).remote(*arguments)

    def result(self, timeout: float) -> Any:
        """Wait for the result of the call; see `Worker`."""
        import ray
        from ray.exceptions import GetTimeoutError, RayError, RayTaskError

        try:
            value = pickle.loads(ray.get(self._answer, timeout=timeout))
        except GetTimeoutError as error:
            if self.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)  # Ray waits for a process that was stopped
            self.kill()
            raise WorkerEndedError(f"no answer within {timeout:g} s") from error
        except RayTaskError as error:
            raise (error.cause if isinstance(error.cause, Exception) else error) from error
        except RayError as error:
            raise WorkerEndedError(str(error).strip().splitlines()[0].rstrip(".")) from error
        if self._is_start and value[0] == socket.gethostname():
            self.pid = value[1]
        return value

    def kill(self) -> None:
        """End the actor at once."""
        import ray

        if ray.is_initialized():
            ray.kill(self._actor)


def _start_ray(address: str | None) -> None:
    """Start Ray on this machine, or connect to a cluster, unless this process has done so; it ends with the process.

    Raises:
        InputError: Ray does not start, or no cluster answers.
    """
    import ray

    if ray.is_initialized():
        return
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    folder = tempfile.mkdtemp(prefix="modgnn_rl-ray-")
    options: dict[str, Any] = {"address": address}
    if address is None:
        if "RAY_AUTH_TOKEN_PATH" not in os.environ:  # else Ray writes a token into the home directory
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        options = {"address": "local", "num_cpus": 1, "object_store_memory": RAY_MEMORY, "include_dashboard": False}
        options |= {"_temp_dir": folder, "_system_config": {"worker_niceness": 0}}
    on_sigterm = signal.getsignal(signal.SIGTERM)
    atexit.register(_stop_ray, folder)
    try:
        ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
    except Exception as error:
        _stop_ray(folder)
        reason = str(error).strip().splitlines()[0]
        where = "on this machine"
        if address is not None:
            where = f"at collector.ray_address={address} with the RAY_AUTH_MODE and token set here"
        raise InputError(f"Ray cannot be used {where} ({reason}); collector=process does not need it") from error
    if callable(on_sigterm):  # Ray has replaced the run's handler
        signal.signal(signal.SIGTERM, on_sigterm)


def _stop_ray(folder: str) -> None:
    import ray

    ray.shutdown()
    shutil.rmtree(folder, ignore_errors=True)
