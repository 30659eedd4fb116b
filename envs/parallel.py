"""Flocks in several processes, for physics that runs on one core, such as PyBullet's.

TorchRL's parallel environment does the work. Here it is told to build nothing in the parent and to wait without
spinning; workers end with their parent however that ends, and a worker that dies ends the others with a clear error.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import parent_process
from threading import Thread
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import ParallelEnv

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv, checked_config
from modgnn_rl.errors import InputError
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["ParallelFlocks", "make_flocks", "parallel_flocks"]


class ParallelFlocks(ParallelEnv):
    """Environments in processes of their own; see `parallel_flocks`."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self._watch():
            return super()._step(tensordict)

    def _reset(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        with self._watch():
            return super()._reset(tensordict, **kwargs)

    def close(self, **kwargs: Any) -> None:
        """End the workers."""
        threads = torch.get_num_threads()
        with self._watch():
            super().close(**kwargs)
        torch.set_num_threads(threads)  # TorchRL would take as many more as there were workers

    @contextmanager
    def _watch(self) -> Iterator[None]:
        """End all workers where one has died, which shows as the end of its pipe."""
        try:
            yield
        except (EOFError, OSError) as error:
            for worker in self._workers:
                worker.join(0.1)
            dead = [index for index, worker in enumerate(self._workers) if not worker.is_alive()]
            self._terminate_and_join_workers(self._workers, timeout=2.0)
            self.is_closed = True
            codes = ", ".join(f"{index} (exit code {self._workers[index].exitcode})" for index in dead)
            raise RuntimeError(
                f"of {self.num_workers} processes that fly flocks, these have ended: {codes or 'unknown'}; what they "
                "said is above; the others have been ended, so build the environment anew"
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
    """Fly flocks in several processes at once: one environment with a batch of ``[workers, num_envs]`` flocks.

    The processes are started anew (spawned), so a script that calls this does so under
    ``if __name__ == "__main__":``. Each has one thread, and the parent holds no environment of its own. They end when
    the environment is closed and when the parent ends, however it ends; Ctrl-C is left to the parent.

    Args:
        workers: number of processes; as many as there are cores.
        num_envs: flocks in each of them.
        num_agents: agents in each flock, see `modgnn_rl.envs.flocking.env.FlockingEnv`; default: the configuration's.
        config: settings of the world; default: ``FlockingConfig(**settings)``.
        seed: seed from which each process derives its own; equal seeds give equal rollouts, bit for bit.
        dtype: floating-point type of the physics and of everything emitted.
        stagger: see `modgnn_rl.envs.flocking.env.FlockingEnv`.
        settings: fields of `FlockingConfig`, when no ``config`` is given.

    Raises:
        InputError: on a setting out of range.
        RuntimeError: when a worker fails, now or later.
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
        make_flocks,
        create_env_kwargs=[{**common, "seed": own} for own in seeds],
        num_threads=torch.get_num_threads(),
        mp_start_method="spawn",
        use_buffers=False,
        metadata_from_workers=True,
        daemon=True,
    )


def make_flocks(**kwargs: Any) -> FlockingEnv:
    """The environment of a worker, in its process: Ctrl-C is left to the parent, and the process ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    return FlockingEnv(**kwargs)


def _end_with_parent() -> None:
    """End this process when its parent has gone, whatever it is doing."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
