"""Expert episodes from a folder written by ``python -m modgnn_rl.collect``.

Example::

    dataset = EpisodeDataset.open("datasets/32-agents")
    buffer = dataset.buffer(length=2, batch_size=256, generator=torch.Generator().manual_seed(0))
    batch = buffer.sample()  # windows [256, 2] with the keys of the environment and the expert's actions

A task says what is stored of a state, and how graphs and labels follow from it: `modgnn_rl.task.Task.stored`.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, RandomSampler, ReplayBuffer
from torchrl.data.replay_buffers import Storage

from modgnn_rl.configs.schema import TaskConfig, as_list
from modgnn_rl.data.manifest import LOCK, MANIFEST, STATE, Manifest, check_shard
from modgnn_rl.errors import InputError
from modgnn_rl.task import Task, make_task

__all__ = ["EpisodeDataset", "EpisodeWindows"]


class EpisodeDataset:
    """Expert episodes of one env config and flock size; see `open`.

    Attributes:
        path: the folder.
        manifest: its manifest.
        env_config: env config of the episodes.
        episodes: number of episodes, E.
        steps: steps per episode, T.
        num_agents: agents in a flock, N.
        shards: the episodes, memory-mapped TensorDicts [E_k, T] that hold "state" [E_k, T, N, S]. Changes to them stay
            in this process.
        task: of the episodes.
        device: device of the tensors that `windows` returns.
    """

    def __init__(self, path: Path, manifest: Manifest, shards: list[TensorDict], device: torch.device | str) -> None:
        self.path, self.manifest, self.shards = path, manifest, shards
        self.env_config: Any = manifest.env_config
        self.episodes, self.steps, self.num_agents = manifest.episodes, manifest.steps, manifest.num_agents
        self.device = torch.device(device)
        self.task: Task = make_task(self.env_config)

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], *, verify: bool = True, device: torch.device | str = "cpu"
    ) -> EpisodeDataset:
        """Open a complete and undamaged dataset; nothing that is loaded can execute code.

        Args:
            path: its folder.
            verify: compare the hashes of all files (one to three seconds per gigabyte); names and sizes are always
                compared.
            device: device of the tensors that `windows` returns.

        Raises:
            InputError: it is not a dataset, of another version, incomplete, damaged, or contains other files.
        """
        path = Path(path)
        manifest = Manifest.read(path)
        if not manifest.is_complete:
            raise InputError(
                f"{path} is incomplete ({len(manifest.shards)} of {len(manifest.shapes)} shards); re-run the same "
                "python -m modgnn_rl.collect to complete it"
            )
        if foreign := sorted(set(os.listdir(path)) - {MANIFEST, LOCK, *manifest.shapes}):
            raise InputError(f"{path / foreign[0]} does not belong to the dataset: move it elsewhere")
        shards = []
        for name, shape in manifest.shapes.items():
            try:
                check_shard(path / name, manifest.shards[name], shape, verify=verify)
                # A private mapping: changes to the tensor do not reach the file.
                state = torch.from_file(str(path / name / STATE), shared=False, size=math.prod(shape))
            except (OSError, ValueError, RuntimeError) as error:
                raise InputError(
                    f"{path / name} is damaged ({error}): restore it, or re-run the same python -m modgnn_rl.collect"
                ) from error
            shards.append(TensorDict({"state": state.view(shape)}, shape[:2]))
        return cls(path, manifest, shards, device)

    def check_env_config(self, env_config: TaskConfig) -> None:
        """Check that an env config is that of the episodes.

        Raises:
            InputError: the settings that differ.
        """
        wanted = {name: value for name, value in vars(env_config).items() if name not in env_config.irrelevant_to_data}
        size = as_list(wanted["num_agents"])
        wanted["num_agents"] = size[0] if len(size) == 1 else size
        different = self.manifest.differences({f"env.{name}": value for name, value in wanted.items()})
        if different:
            raise InputError(
                f"the rollouts in {self.path} have another env config: {different}; use the same settings, or collect "
                "rollouts with these"
            )

    def __len__(self) -> int:
        """Number of flock states, E T; state t of rollout e has the index e T + t."""
        return self.episodes * self.steps

    def states(self, index: Tensor, length: int) -> Tensor:
        """What is stored of the ``length`` steps up to each index, on the CPU.

        Steps before the start of an episode repeat its first state.

        Args:
            index: indices of flock states, int64 [S].
            length: steps W of each window.

        Returns:
            states, as the task stores them [S, W, N, ...].

        Raises:
            InputError: an index is out of range, or the length is below 1.
        """
        index = index.cpu()
        if length < 1 or (len(index) and not 0 <= int(index.min()) <= int(index.max()) < len(self)):
            raise InputError(
                f"windows of length {length} at indices {index.tolist()[:3]}... are out of range; lengths start at "
                f"1, and "
                f"indices are 0 to {len(self) - 1}"
            )
        episode, step = index // self.steps, self._steps(index, length).clamp(min=0)
        shard, row = episode // self.manifest.num_envs, (episode % self.manifest.num_envs).unsqueeze(-1)
        states = torch.empty(*step.shape, self.num_agents, self.manifest.width)
        for number in shard.unique().tolist():
            chosen = shard == number
            states[chosen] = self.shards[number]["state"][row[chosen], step[chosen]]
        return states

    def windows(self, index: Tensor, length: int) -> TensorDict:
        """Windows of episodes with the keys of the environment and the expert's actions.

        A window that starts before its episode repeats the first state with ``is_init`` set, so that a policy has no
        messages there; a window of ``policy.window`` steps gives exact actions at its end.

        Args:
            index: index of the last state of each window, int64 [S], see ``len``.
            length: steps W of each window.

        Returns:
            [S, W], with ``("agents", "observation")`` [S, W, N, F], ``("agents", "controlled")`` [S, W, N],
            ``("agents", "expert_action")`` [S, W, N, A], ``adjacency`` [S, W, N, N] and ``is_init`` [S, W, 1].
        """
        windows = self.task.restored(self.states(index, length).to(self.device))
        is_init = (self._steps(index, length) <= 0).unsqueeze(-1).to(self.device)
        return windows.set("is_init", is_init | windows["is_init"] if "is_init" in windows else is_init)

    def _steps(self, index: Tensor, length: int) -> Tensor:
        """Time steps of windows, [S, W]; negative before the start of the episode."""
        return (index % self.steps).unsqueeze(-1) + torch.arange(1 - length, 1, device=index.device)

    def buffer(
        self,
        length: int,
        batch_size: int,
        *,
        episodes: range | None = None,
        generator: torch.Generator | None = None,
    ) -> ReplayBuffer:
        """A TorchRL replay buffer of windows, sampled with replacement.

        Args:
            length: steps of each window.
            batch_size: windows in a batch.
            episodes: range of episodes to sample from; default: all.
            generator: source of randomness; default: torch's own.
        """
        return ReplayBuffer(
            storage=EpisodeWindows(self, length, range(self.episodes) if episodes is None else episodes, generator),
            sampler=RandomSampler(),
            writer=ImmutableDatasetWriter(),
            collate_fn=_identity,  # `get` returns a whole batch
            batch_size=batch_size,
            generator=generator,
        )


class EpisodeWindows(Storage):
    """Episodes of a dataset as a storage for TorchRL's replay buffers; item i is the window that ends at state i.

    TorchRL's ``TensorStorage`` serves single states. Windows contain several, within one episode, and graphs and labels
    are computed for each batch: stored, they would take 50 times the space.

    Args:
        dataset: the dataset.
        length: steps of each window.
        episodes: range of episodes to serve.
        generator: source of randomness; its device is that of the indices.

    Raises:
        InputError: the dataset does not contain these episodes.
    """

    def __init__(
        self, dataset: EpisodeDataset, length: int, episodes: range, generator: torch.Generator | None = None
    ) -> None:
        if not 0 <= episodes.start < episodes.stop <= dataset.episodes or episodes.step != 1:
            raise InputError(f"{episodes} is not a range of the {dataset.episodes} episodes of {dataset.path}")
        # `compilable=False` would share a counter between processes, which starts an extra process.
        super().__init__(len(episodes) * dataset.steps, compilable=True)
        self.dataset, self.length, self.episodes = dataset, length, episodes
        self.device = None if generator is None else generator.device

    def __len__(self) -> int:
        """Number of windows."""
        return self.max_size

    def get(self, index: Any) -> TensorDictBase:
        """The windows [S, W] that end at these states [S] of the rollouts, or the one [W] that ends at one state."""
        index = torch.as_tensor(index)
        windows = self.dataset.windows(index.view(-1) + self.episodes.start * self.dataset.steps, self.length)
        return windows if index.ndim else windows[0]


def _identity(batch: TensorDictBase) -> TensorDictBase:
    return batch
