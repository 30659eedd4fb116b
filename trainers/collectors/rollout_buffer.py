"""Rollouts of imitation learning, labelled by the expert, and the replay buffers that keep them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter

from modgnn_rl.configs.schema import CollectorConfig, ImitationConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.task import Task
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, Ensemble, SafetyGate, ensemble_std
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.remote import make_collector
from modgnn_rl.trainers.collectors.windows import reservoir_indices, slice_windows, window_length
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "ImitationCollector",
    "RolloutBuffer",
    "WindowBuffer",
    "make_buffer",
    "make_buffers",
    "make_validation_buffers",
    "num_envs_of_size",
    "training_spec",
]


class ImitationCollector:
    """Collects rollouts of a mixture of policy and expert, every state labelled by the expert.

    Args:
        spec: which rollouts.
        policies: the policies that learn. The first acts, beside the expert; a gate may compare all of them.
        expert: writes ``("agents", "expert_action")``.
        hold_steps: steps between two decisions of the mixture.
        gate: lets the expert act where the policy errs.
        collector: which processes collect; default: this one.

    Attributes:
        mixture, action_noise: parts of the behaviour policy that trainers set.
    """

    def __init__(
        self,
        spec: RolloutSpec,
        policies: Sequence[ModGNN],
        expert: TensorDictModuleBase,
        *,
        hold_steps: int,
        gate: SafetyGate | None = None,
        collector: CollectorConfig | None = None,
    ) -> None:
        self.mixture = BetaMixture(1.0, hold_steps, torch.Generator().manual_seed(derive_seed(spec.seed, "mixture")))
        self.action_noise = ActionNoise(0.0, torch.Generator().manual_seed(derive_seed(spec.seed, "disturbance")))
        actor = Ensemble(policies) if gate is not None and gate.measure is ensemble_std else policies[0]
        gates = [] if gate is None else [gate]
        self.collector = make_collector(spec, (actor, expert, self.mixture, *gates, self.action_noise), collector)
        self.mixture.restart()  # the collector has run the policy once

    def collect(self, beta: float) -> TensorDictBase:
        """Continue the rollouts; returns [B, T]. ``beta`` is the probability that the expert acts."""
        self.mixture.beta = beta
        return self.collector.collect()

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random generators of the collector, by name."""
        own = {"mixture": self.mixture.generator, "disturbance": self.action_noise.generator}
        return {**self.collector.generators, **own}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state of the rollouts for a checkpoint, without generators: tensors and plain values."""
        tensors, values = self.collector.state()
        return {**tensors, "mixture": self.mixture.state()}, {**values, "action_noise": self.action_noise.scale}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Resume from the result of `state`.

        Raises:
            KeyError, RuntimeError: the state is that of other rollouts.
        """
        self.collector.restore(tensors, values)
        self.mixture.restore(tensors["mixture"])
        self.action_noise.scale = float(values["action_noise"])

    def close(self) -> None:
        """Close the environments."""
        self.collector.close()


class WindowBuffer:
    """A replay buffer of windows of rollouts.

    Args:
        settings: window stride, capacity, batch size and what is replaced when the buffer is full.
        window: steps in a window, W.
        keys: keys of rollouts that are stored.
        seed: seeds the sampling of batches and of what is replaced.
        device: device of the data.

    Attributes:
        replay: TorchRL's buffer, of windows [S, W].
        seen: number of windows that were ever added.
    """

    def __init__(
        self,
        settings: ImitationConfig,
        window: int,
        keys: set[NestedKey],
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings, self.window, self.keys, self.seen = settings, window, keys, 0
        self.generators = {
            "places": torch.Generator().manual_seed(derive_seed(seed, "places")),
            "batches": torch.Generator(device).manual_seed(derive_seed(seed, "batches")),
        }
        # Without compilable=True, storage and writer start a process each to share their counters.
        self.replay = ReplayBuffer(
            storage=LazyTensorStorage(settings.capacity, device=device, compilable=True),
            writer=RoundRobinWriter(compilable=True),
            sampler=RandomSampler(),
            batch_size=settings.batch_size,
            generator=self.generators["batches"],
        )

    def extend(self, rollouts: TensorDictBase) -> None:
        """Add the windows of rollouts [B, T]; a full buffer replaces what ``settings.replacement`` says."""
        capacity = self.settings.capacity
        windows = slice_windows(rollouts.select(*self.keys, strict=False), self.window, self.settings.stride)
        room = max(0, capacity - self.seen) if self.settings.replacement == "reservoir" else len(windows)
        if room:
            self.replay.extend(windows[:room])
        if room < len(windows):
            generator = self.generators["places"]
            index, item = reservoir_indices(self.seen + room, len(windows) - room, capacity, generator)
            self.replay[index.to(windows.device)] = windows[room + item.to(windows.device)]
        self.seen += len(windows)

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The data for a checkpoint, if ``settings.checkpoint_data`` asks for them."""
        if not self.settings.checkpoint_data or not len(self.replay):
            return {}, {"seen": self.seen}
        data = dict(self.replay[:].flatten_keys("/").items())
        return {"data": data}, {"seen": self.seen, "writer": self.replay.writer.state_dict()}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Restore the result of `state`; the buffer stays empty if that has no data."""
        if "data" in tensors:
            rows = len(next(iter(tensors["data"].values())))
            self.replay.extend(TensorDict(tensors["data"], [rows, self.window]).unflatten_keys("/"))
            self.replay.writer.load_state_dict(values["writer"])
            self.seen = int(values["seen"])


class RolloutBuffer:
    """A collector and the buffer for its rollouts: what a trainer has for each number of agents.

    Args:
        collector: collects rollouts.
        windows: keeps them.
    """

    def __init__(self, collector: ImitationCollector, windows: WindowBuffer) -> None:
        self.collector, self.windows = collector, windows

    def collect(self, beta: float) -> TensorDictBase:
        """Continue the rollouts; returns [B, T]. ``beta`` is the probability that the expert acts."""
        return self.collector.collect(beta)

    def extend(self, rollouts: TensorDictBase) -> None:
        """Add rollouts [B, T] to the data."""
        self.windows.extend(rollouts)

    @property
    def buffer(self) -> ReplayBuffer:
        """The data: windows [S, W]."""
        return self.windows.replay

    @property
    def seen(self) -> int:
        """Number of windows that were ever added."""
        return self.windows.seen

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random generators of collector and buffer, by name."""
        return {**self.collector.generators, **self.windows.generators}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state of rollouts and data for a checkpoint, without generators: tensors and plain values."""
        (tensors, values), (data, counts) = self.collector.state(), self.windows.state()
        return {**tensors, **data}, {**values, **counts}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Resume from the result of `state`.

        Raises:
            KeyError, RuntimeError: the state is that of other rollouts or data.
        """
        self.collector.restore(tensors, values)
        self.windows.restore(tensors, values)

    def close(self) -> None:
        """Close the environments."""
        self.collector.close()


def make_buffer(
    spec: RolloutSpec,
    settings: ImitationConfig,
    policies: Sequence[ModGNN],
    expert: TensorDictModuleBase,
    *,
    hold_steps: int,
    gate: SafetyGate | None = None,
    collector: CollectorConfig | None = None,
) -> RolloutBuffer:
    """A collector, and a buffer for windows as long as the policies need; see `ImitationCollector`, `WindowBuffer`."""
    window = window_length(policies, settings)
    keys = {*(key for policy in policies for key in policy.in_keys), ("agents", "controlled"), *expert.out_keys[:1]}
    if window > 1:
        keys -= {policy.messages_key for policy in policies}
    windows = WindowBuffer(settings, window, keys, spec.seed, spec.device)
    return RolloutBuffer(
        ImitationCollector(spec, policies, expert, hold_steps=hold_steps, gate=gate, collector=collector), windows
    )


def make_buffers(
    config: TrainConfig,
    task: Task,
    policies: Sequence[ModGNN],
    *,
    steps: int,
    hold_steps: int,
    gate: SafetyGate | None = None,
) -> dict[int, RolloutBuffer]:
    """The buffers of a training run, by number of agents; see `make_buffer`."""
    return {
        size: make_buffer(
            training_spec(config, task, size, steps),
            config.trainer,
            policies,
            task.teacher,
            hold_steps=hold_steps,
            gate=gate,
            collector=config.collector,
        )
        for size in config.env.sizes
    }


def make_validation_buffers(
    config: TrainConfig,
    task: Task,
    policies: Sequence[ModGNN],
    *,
    steps: int,
    hold_steps: int,
) -> dict[int, RolloutBuffer]:
    """Buffers of ``trainer.num_val_envs`` environments whose rollouts are for validation, collected in this process."""
    validation = dataclasses.replace(
        config,
        trainer=dataclasses.replace(config.trainer, num_envs=config.trainer.num_val_envs),
        seed=derive_seed(config.seed, "validation"),
        collector=CollectorConfig(),
    )
    return make_buffers(validation, task, policies, steps=steps, hold_steps=hold_steps)


def training_spec(config: TrainConfig, task: Task, size: int, steps: int) -> RolloutSpec:
    """The rollouts of a training run with ``size`` agents, ``steps`` steps at a time."""
    num_envs, seed = num_envs_of_size(config, size), derive_seed(config.seed, "flocks", size)
    return RolloutSpec(task.training_env, num_envs, size, steps, seed, config.device)


def num_envs_of_size(config: TrainConfig, size: int) -> int:
    """Environments with ``size`` agents each that run in parallel; all sizes have the same number of agents in all."""
    return max(1, round(config.env.reference_size * config.trainer.num_envs / len(config.env.sizes) / size))
