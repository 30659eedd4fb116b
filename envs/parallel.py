"""Flocks in several worker processes, for physics that uses one core, such as PyBullet's.

This is TorchRL's `ParallelEnv`, configured to create no environment in the parent and to wait without busy waiting.
Workers end with their parent, however the parent ends; if a worker dies, the others are ended and an error names it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import ParallelEnv

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv, checked_config
from modgnn_rl.errors import InputError
from modgnn_rl.utils.internals import parallel_env_processes
from modgnn_rl.utils.seeds import derive_seed
from modgnn_rl.utils.signals import follow_parent

__all__ = ["ParallelFlocks", "make_worker_env", "parallel_flocks"]

TERMINATE_TIMEOUT = 2.0  # s that a terminated worker has to end before it is killed


class ParallelFlocks(ParallelEnv):
    """Flocking environments in worker processes; see `parallel_flocks`."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self._worker_errors():
            return super()._step(tensordict)

    def _reset(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        with self._worker_errors():
            return super()._reset(tensordict, **kwargs)

    def close(self, **kwargs: Any) -> None:
        """Stop the workers."""
        threads = torch.get_num_threads()
        with self._worker_errors():
            super().close(**kwargs)
        torch.set_num_threads(threads)  # TorchRL would add one for each worker

    @contextmanager
    def _worker_errors(self) -> Iterator[None]:
        """End all workers when one has died, which closes its pipe."""
        try:
            yield
        except (EOFError, OSError) as error:
            workers = parallel_env_processes(self)
            for worker in workers:
                worker.join(0.1)
            dead = [index for index, worker in enumerate(workers) if not worker.is_alive()]
            _end(workers)
            self.is_closed = True
            codes = ", ".join(f"{index} (exit code {workers[index].exitcode})" for index in dead)
            raise RuntimeError(
                f"of {self.num_workers} worker processes, these have died: {codes or 'unknown'}; their error messages "
                "are above. The other workers were stopped; create the environment again"
            ) from error


def parallel_flocks(
    workers: int,
    num_envs: int,
    num_agents: int | Sequence[int] | None = None,
    *,
    config: FlockingConfig | None = None,
    seed: int | None = None,
    dtype: torch.dtype = torch.float32,
    stagger: bool = False,
    **settings: Any,
) -> ParallelFlocks:
    """Create one environment with a batch of ``[workers, num_envs]`` flocks, stepped in parallel in worker processes.

    Workers are spawned, so a script must call this under ``if __name__ == "__main__":``. Each worker uses one thread,
    and the parent holds no environment. Workers end when the environment is closed and when the parent ends, however it
    ends; they ignore Ctrl-C, which the parent handles.

    Args:
        workers: number of worker processes, at best one per core.
        num_envs: flocks in each worker.
        num_agents: agents in each flock, see `modgnn_rl.envs.flocking.env.FlockingEnv`; default: the configuration's.
        config: settings of the environment; default: ``FlockingConfig(**settings)``.
        seed: seed from which each worker's seed is derived; equal seeds give equal rollouts, bit for bit.
        dtype: floating-point type of the physics and of all outputs.
        stagger: see `modgnn_rl.envs.flocking.env.FlockingEnv`.
        settings: fields of `FlockingConfig`, if no ``config`` is given.

    Raises:
        InputError: a setting is out of range.
        RuntimeError: a worker fails, now or later.
    """
    if not isinstance(workers, int) or workers < 1:
        raise InputError(f"workers={workers!r} is not a positive integer")
    common = {
        "num_envs": num_envs,
        "num_agents": num_agents,
        "config": checked_config(config, settings),
        "dtype": dtype,
        "stagger": stagger,
    }
    seeds = [None if seed is None else derive_seed(seed, "worker", index) for index in range(workers)]
    return ParallelFlocks(
        workers,
        make_worker_env,
        create_env_kwargs=[{**common, "seed": own} for own in seeds],
        num_threads=torch.get_num_threads(),
        mp_start_method="spawn",
        use_buffers=False,
        metadata_from_workers=True,
        daemon=True,
    )


def _end(workers: Sequence[Any]) -> None:
    """End processes, by force if they do not react."""
    for worker in workers:
        worker.terminate()
    deadline = time.monotonic() + TERMINATE_TIMEOUT
    for worker in workers:
        worker.join(max(0.0, deadline - time.monotonic()))
        if worker.is_alive():
            worker.kill()
            worker.join()


def make_worker_env(**kwargs: Any) -> FlockingEnv:
    """Create the environment of a worker, in its process, which ignores Ctrl-C and ends with its parent."""
    follow_parent()
    return FlockingEnv(**kwargs)
