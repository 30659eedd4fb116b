"""The expert's demonstrations: rollouts in which the expert acts, or a dataset of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torchrl.data import ReplayBuffer

from modgnn_rl.configs.schema import BCConfig, TrainConfig
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.rollout_buffer import RolloutBuffer, make_buffers, make_validation_buffers
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.trainers.loop.context import TrainContext
from modgnn_rl.trainers.loop.training_loop import Rollouts, TrainingLoop
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["DART_PARTS", "Demonstrations", "collect_validation", "make_demonstrations"]

DART_PARTS = 4  # parts in which DART collects, each with the noise that fits the policy's error by then


class Buffer(Rollouts, Protocol):
    """Environments, or a dataset in their place, with the windows to learn from."""

    @property
    def buffer(self) -> ReplayBuffer:
        """Windows [S, W]."""


class Demonstrations(Protocol):
    """The data of behaviour cloning."""

    @property
    def training(self) -> Mapping[int, Buffer]:
        """Training data, by flock size."""

    @property
    def validation(self) -> Mapping[int, Buffer]:
        """Validation data, by flock size."""

    def collect(self, loop: TrainingLoop) -> dict[str, float]:
        """Collect what is due in the current round; returns metrics."""


def make_demonstrations(context: TrainContext, policies: Sequence[ModGNN], rounds: int) -> Demonstrations:
    """The demonstrations for behaviour cloning: the dataset of ``config.trainer``, or rollouts of the expert.

    Args:
        context: the run.
        policies: the policies that learn from them.
        rounds: number of rounds of the training.
    """
    if context.config.trainer.dataset is not None:
        return _Dataset(context.config, policies)
    return _ExpertRollouts(context, policies, rounds)


class _ExpertRollouts:
    """Rollouts in which the expert acts, with noise; with DART the noise follows the policy's error.

    DART (Laskey et al. 2017) chooses the noise with which the expert makes the policy's mistakes, so that it shows how
    to recover: here the standard deviation is the root of the policy's mean squared error on validation data.
    """

    def __init__(self, context: TrainContext, policies: Sequence[ModGNN], rounds: int) -> None:
        config, task = context.config, context.task
        self.settings: BCConfig = config.trainer
        self.parts = DART_PARTS if self.settings.dart else 1
        self.starts = [part * rounds // self.parts for part in range(self.parts)]  # rounds before each part
        steps = max(1, self.settings.cloning_steps // self.parts)
        options: dict[str, Any] = {"steps": steps, "hold_steps": self.settings.cloning_steps}
        self.validation = make_validation_buffers(config, task, policies, **options)
        self.training = make_buffers(config, task, policies, **options)

    def collect(self, loop: TrainingLoop) -> dict[str, float]:
        """Let the expert act where a part starts, and in any case if there are no data yet."""
        for buffer in self.training.values():
            for _ in range(max(self.starts.count(loop.step - 1), not buffer.seen)):
                is_adapted = self.settings.dart and loop.step > 1
                noise = loop.state["validation_loss"] ** 0.5 if is_adapted else self.settings.noise
                buffer.collector.action_noise.scale = noise
                buffer.extend(loop.on_collect(buffer.collect(beta=1.0)))
        collect_validation(self.validation, self.parts)
        return {"noise": next(iter(self.training.values())).collector.action_noise.scale}


def collect_validation(buffers: Mapping[int, RolloutBuffer], times: int) -> None:
    """Let the expert act in the validation environments, ``times`` times, unless they have data already."""
    for buffer in buffers.values():
        for _ in range(0 if buffer.seen else times):
            buffer.extend(buffer.collect(beta=1.0))


@dataclass
class _DatasetBuffer:
    """Some episodes of a dataset in the place of environments; of these, checkpoints hold only the generator."""

    buffer: ReplayBuffer
    generators: dict[str, torch.Generator]

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        return {}, {}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        pass

    def close(self) -> None:
        pass


class _Dataset:
    """A dataset of episodes, the last ``num_val_envs`` of which are for validation; windows recompute the messages."""

    def __init__(self, config: TrainConfig, policies: Sequence[ModGNN]) -> None:
        settings: BCConfig = config.trainer
        # The trainer's check has verified it.
        dataset = EpisodeDataset.open(str(settings.dataset), verify=False, device=config.device)
        (size,) = config.env.sizes
        window, first_val = max(policy.window for policy in policies), dataset.episodes - settings.num_val_envs
        seed = derive_seed(derive_seed(config.seed, "validation"), "flocks", size)
        generator = torch.Generator(config.device).manual_seed(derive_seed(seed, "batches"))

        def part(episodes: range) -> Mapping[int, _DatasetBuffer]:
            buffer = dataset.buffer(window, settings.batch_size, episodes=episodes, generator=generator)
            return {size: _DatasetBuffer(buffer, {"batches": generator})}

        self.training, self.validation = part(range(first_val)), part(range(first_val, dataset.episodes))

    def collect(self, loop: TrainingLoop) -> dict[str, float]:
        return {}
