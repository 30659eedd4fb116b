"""Workers that fly flocks elsewhere: processes of this machine, or actors of Ray, each with a TorchRL collector.

TorchRL's collectors of several workers end with the first worker that dies. So each worker here is a collector of its
own, with one worker, and can be replaced alone.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import secrets
import shutil
import signal
import socket
import tempfile
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from threading import Lock, Thread
from typing import Any, TypeVar

import torch
from torchrl.collectors import MultiSyncCollector

from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.worker import WorkerCollector, WorkerSpec

__all__ = ["ProcessWorker", "RayWorker", "Worker", "WorkerEndedError", "close_all"]

RAY_MEMORY = 256 * 2**20  # bytes that Ray's store of objects may take here: rollouts pass through it
STARTING = 120.0  # longest wait for a worker to start, s
PATIENCE = 5.0  # longest wait for a worker to end by itself, s

Result = TypeVar("Result")


class WorkerEndedError(Exception):
    """A worker has ended, or was ended because it did not answer; the message says how."""


class Worker:
    """A TorchRL collector with one worker, and threads that wait for it, so that nobody waits for ever.

    Args:
        rollout: what it flies.
        address: of a Ray cluster.

    Attributes:
        process: number of its process; None as long as it is starting.
        started: done when it has started.
    """

    def __init__(self, rollout: WorkerSpec, address: str | None = None) -> None:
        self.rollout, self.address = rollout, address
        self.process: int | None = None
        self.collector: Any = None
        self.started = _in_thread(self._start)
        self._answer: Future[Any] = self.started

    def ask(self, method: str, *arguments: Any) -> None:
        """Begin a call of a method of the worker's `WorkerCollector`."""
        self._answer = _in_thread(self._ask, method, *arguments)

    def answer(self, timeout: float) -> Any:
        """Wait for the result of the call that was begun.

        Args:
            timeout: longest wait, s; a worker that takes longer is ended. Starting does not count.

        Raises:
            WorkerEndedError: the worker has ended.
            Exception: what was raised in a worker that is still there.
        """
        if self._answer in wait([self._answer], timeout + (0.0 if self.started.done() else STARTING)).done:
            return self._answer.result()
        self.kill()
        wait([self._answer], PATIENCE)
        raise WorkerEndedError(f"no answer within {timeout:g} s")

    def _ask(self, method: str, *arguments: Any) -> Any:
        self.started.result()
        return self._call(method, *arguments)

    def kill(self) -> None:
        """End the worker at once; a future not done yet raises `WorkerEndedError`."""
        raise NotImplementedError

    def close(self) -> None:
        """End the worker, at once if it is busy."""
        if not self._answer.done():
            self.kill()
            wait([self._answer], PATIENCE)
        if self.collector is not None:
            self.collector.shutdown(timeout=PATIENCE)

    def _start(self) -> None:
        raise NotImplementedError

    def _call(self, method: str, *arguments: Any) -> Any:
        raise NotImplementedError


def close_all(workers: Sequence[Worker]) -> None:
    """End workers, all at once."""
    threads = torch.get_num_threads()
    wait([_in_thread(worker.close) for worker in workers])
    torch.set_num_threads(threads)  # TorchRL would take as many more as there were workers


class _OneProcess(MultiSyncCollector):
    """A collector that its worker knows while it is still starting, so that the process can be ended."""

    def __init__(self, worker: Worker) -> None:
        worker.collector = self
        super().__init__(
            [worker.rollout.make_env],
            collector_class=WorkerCollector,
            num_threads=torch.get_num_threads(),
            auto_register_policy_transforms=True,
            total_frames=-1,
            **worker.rollout.options,
        )


class ProcessWorker(Worker):
    """A process of this machine, held by TorchRL's `MultiSyncCollector`."""

    def _start(self) -> None:
        try:
            _OneProcess(self)
        except Exception as error:
            explained = self._explained(error)
            if isinstance(explained, WorkerEndedError) and self.collector.procs[0].exitcode == 0:
                explained = error  # it said why it cannot start, and left
            if isinstance(error, InputError):
                explained = InputError(str(error).partition("\n\nWorker traceback")[0])
            raise explained from error
        self.process = self.collector.procs[0].pid

    def _call(self, method: str, *arguments: Any) -> Any:
        try:
            return pickle.loads(self.collector.map_fn(method, [arguments])[0])
        except Exception as error:
            raise self._explained(error) from error

    def _explained(self, error: Exception) -> Exception:
        for process in getattr(self.collector, "procs", []):
            process.join(1.0 if isinstance(error, (EOFError, OSError)) else 0.1)
            if not process.is_alive():
                return WorkerEndedError(f"exit code {process.exitcode}")
        return error

    def kill(self) -> None:
        """End the worker at once; a future not done yet raises `WorkerEndedError`."""
        for process in getattr(self.collector, "procs", []):
            process.kill()


class RayWorker(Worker):
    """An actor of Ray, held by TorchRL's `RayCollector`; Ray starts with the first and ends with the last of them."""

    host: str | None = None

    def __init__(self, rollout: WorkerSpec, address: str | None = None) -> None:
        _Ray.begin(address)
        super().__init__(rollout, address)

    def _start(self) -> None:
        from torchrl.collectors.distributed import RayCollector

        on_gpu = torch.device(self.rollout.device).type != "cpu"
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*weight", category=UserWarning)
            self.collector = RayCollector(
                [self.rollout.make_env],
                collector_class=WorkerCollector,
                collector_kwargs={"auto_register_policy_transforms": True},
                remote_configs={"num_cpus": 0 if self.address is None else 1, "num_gpus": 0.01 if on_gpu else 0},
                sync=True,
                **self.rollout.options,
            )
        self.host, self.process = self._call("whereabouts")

    def _call(self, method: str, *arguments: Any) -> Any:
        from ray.exceptions import RayError, RayTaskError

        try:
            return pickle.loads(self.collector.map_fn(method, [arguments])[0])
        except RayTaskError as error:
            raise (error.cause if isinstance(error.cause, Exception) else error) from error
        except RayError as error:
            raise WorkerEndedError(str(error).strip().splitlines()[0].rstrip(".")) from error

    def kill(self) -> None:
        """End the worker at once; a future not done yet raises `WorkerEndedError`."""
        import ray

        if self.process is not None and self.host == socket.gethostname():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.process, signal.SIGKILL)  # Ray would ask it to end, and it may not be able to
        for actor in getattr(self.collector, "remote_collectors", []):
            ray.kill(actor)

    def close(self) -> None:
        """End the worker, and with the last one Ray."""
        super().close()
        _Ray.end()


class _Ray:
    """Ray, from the first worker that needs it to the last; one that runs already in this process is left alone."""

    lock = Lock()
    workers = 0
    is_ours = False
    folder: str | None = None

    @classmethod
    def begin(cls, address: str | None) -> None:
        """Start Ray, or connect to the cluster, in the main thread: what Ray starts ends with the thread."""
        import ray

        with cls.lock:
            if not ray.is_initialized():
                os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
                options = cls._small() if address is None else {"address": address}
                cls.is_ours = True
                on_sigterm = signal.getsignal(signal.SIGTERM)
                try:
                    ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
                except Exception as error:
                    cls._end()
                    reason = str(error).strip().splitlines()[0]
                    where = "on this machine"
                    if address is not None:
                        where = (
                            f"at collector.ray_address={address}, with the RAY_AUTH_MODE and token that are set here"
                        )
                    raise InputError(f"Ray cannot be used {where} ({reason}); collector=process needs none") from error
                if callable(on_sigterm):  # Ray has put its own in the place of a run's
                    signal.signal(signal.SIGTERM, on_sigterm)
            cls.workers += 1

    @classmethod
    def end(cls) -> None:
        """End Ray with its last worker, and take away what it has left on this machine."""
        with cls.lock:
            cls.workers -= 1
            if cls.workers == 0 and cls.is_ours:
                cls._end()

    @classmethod
    def _small(cls) -> dict[str, Any]:
        """How to start Ray here."""
        if "RAY_AUTH_TOKEN_PATH" not in os.environ:  # else Ray would put a password into the home directory
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        cls.folder = tempfile.mkdtemp(prefix="modgnn_rl-ray-")
        return {
            "address": "local",
            "num_cpus": 1,
            "object_store_memory": RAY_MEMORY,
            "include_dashboard": False,
            "_temp_dir": cls.folder,
            "_system_config": {"worker_niceness": 0},
        }

    @classmethod
    def _end(cls) -> None:
        import ray

        ray.shutdown()
        cls.is_ours = False
        if cls.folder is not None:
            shutil.rmtree(cls.folder, ignore_errors=True)
            cls.folder = None


def _in_thread(function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """Call a function in a thread that does not keep this process from ending."""
    future: Future[Result] = Future()

    def run() -> None:
        try:
            result = function(*arguments)
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    Thread(target=run, daemon=True).start()
    return future
