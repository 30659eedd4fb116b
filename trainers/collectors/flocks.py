"""Rollouts for training: flocks that never stop flying, the expert's label at every state that they visit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter

from modgnn_rl.configs.schema import REFERENCE_SIZE, CollectorConfig, FlockingConfig, ImitationConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, BetaMixture, Ensemble, SafetyGate, ensemble_std
from modgnn_rl.trainers.collectors.local import make_collector
from modgnn_rl.trainers.collectors.windows import as_windows, reservoir_places, window_of
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "FlockBuffer",
    "flocks_of",
    "make_buffers",
    "make_validation_buffers",
]


class FlockBuffer:
    """Flocks of one size, flown by a mixture of policy and expert, and their data.

    `keep` adds windows of rollouts to the replay buffer.

    Args:
        config: the world.
        settings: how rollouts become data.
        num_envs: flocks flown at once, B.
        num_agents: agents in each, N.
        policies: those that learn from the data; the first flies beside the expert (weights changed in place are flown
            at once), all of them if there is a gate that looks at their spread.
        expert: writes ``("agents", "expert_action")``.
        steps: steps of one call of `fly`.
        hold_steps: steps that the one who flies a flock keeps it.
        gate: lets the expert fly where the policy strays.
        seed: seeds the environment, the mixture and the sampling of batches.
        device: where flocks and data live.
        collector: which processes fly; default: this one.

    Attributes:
        rollouts: the rollouts that never end.
        window: steps of a window of the data.
        mixture, disturbance: who flies, and how it is disturbed.
        buffer: the data.
        seen: windows that were ever added.
    """

    def __init__(
        self,
        config: FlockingConfig,
        settings: ImitationConfig,
        num_envs: int,
        num_agents: int,
        policies: Sequence[ModGNN],
        expert: TensorDictModuleBase,
        *,
        steps: int,
        hold_steps: int,
        gate: SafetyGate | None = None,
        seed: int,
        device: torch.device | str = "cpu",
        collector: CollectorConfig | None = None,
    ) -> None:
        self.settings, self.device = settings, torch.device(device)
        self.noise = torch.Generator().manual_seed(derive_seed(seed, "places"))
        self.window = window_of(policies, settings)
        self.keys = {*(key for policy in policies for key in policy.in_keys), ("agents", "controlled")}
        self.keys |= {*expert.out_keys[:1]}
        if self.window > 1:
            self.keys -= {policy.messages_key for policy in policies}
        self.mixture = BetaMixture(1.0, hold_steps, torch.Generator().manual_seed(derive_seed(seed, "mixture")))
        self.action_noise = ActionNoise(0.0, torch.Generator().manual_seed(derive_seed(seed, "disturbance")))
        flown = Ensemble(policies) if gate is not None and gate.measure is ensemble_std else policies[0]
        gates = [] if gate is None else [gate]
        behaviour = (flown, expert, self.mixture, *gates, self.action_noise)
        self.rollouts = make_collector(
            collector, config, num_envs, num_agents, behaviour, steps=steps, seed=seed, device=device
        )
        self.mixture.restart()  # the collector has tried the policy out
        self.seen = 0
        self.sampling = torch.Generator(device).manual_seed(derive_seed(seed, "batches"))
        # Not compilable ones would share their counters between processes, and start one of their own for that.
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(settings.capacity, device=device, compilable=True),
            writer=RoundRobinWriter(compilable=True),
            sampler=RandomSampler(),
            batch_size=settings.batch_size,
            generator=self.sampling,
        )

    def fly(self, beta: float) -> TensorDictBase:
        """Continue the rollouts by some steps, and label every state with the expert's action; rollouts [B, T]."""
        self.mixture.beta = beta
        return self.rollouts.collect()

    def keep(self, rollouts: TensorDictBase) -> None:
        """Add windows of rollouts to the data; where these are full, what ``settings.replacement`` says goes."""
        windows = as_windows(rollouts.select(*self.keys, strict=False), self.window, self.settings.stride)
        room = max(0, self.settings.capacity - self.seen) if self.settings.replacement == "reservoir" else len(windows)
        if room:
            self.buffer.extend(windows[:room])
        if room < len(windows):
            place, item = reservoir_places(self.seen + room, len(windows) - room, self.settings.capacity, self.noise)
            self.buffer[place.to(windows.device)] = windows[room + item.to(windows.device)]
        self.seen += len(windows)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        return {
            **self.rollouts.generators,
            "places": self.noise,
            "mixture": self.mixture.generator,
            "disturbance": self.action_noise.generator,
            "batches": self.sampling,
        }

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """What a checkpoint holds of rollouts and data."""
        tensors, values = self.rollouts.state()
        tensors["mixture"] = self.mixture.state()
        values |= {"disturbance": self.action_noise.scale, "seen": self.seen}
        if self.settings.checkpoint_data and len(self.buffer):
            tensors["data"] = dict(self.buffer[:].flatten_keys("/").items())
            values["writer"] = self.buffer.writer.state_dict()
        return tensors, values

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Go on from what `state` gave; without data where the checkpoint has none.

        Raises:
            KeyError, RuntimeError: these are rollouts or data of others.
        """
        self.rollouts.restore(tensors, values)
        self.mixture.restore(tensors["mixture"])
        self.action_noise.scale = float(values["disturbance"])
        if "data" in tensors:
            rows = len(next(iter(tensors["data"].values())))
            self.buffer.extend(TensorDict(tensors["data"], [rows, self.window]).unflatten_keys("/"))
            self.buffer.writer.load_state_dict(values["writer"])
            self.seen = int(values["seen"])

    def close(self) -> None:
        """End the rollouts."""
        self.rollouts.close()


def make_buffers(
    config: TrainConfig,
    policies: Sequence[ModGNN],
    expert: TensorDictModuleBase,
    *,
    steps: int,
    hold_steps: int,
    gate: SafetyGate | None = None,
) -> dict[int, FlockBuffer]:
    """The flocks of a training run, by their size: all in ``config.env.num_agents``, of as many agents each."""
    return {
        size: FlockBuffer(
            config.env,
            config.trainer,
            flocks_of(size, config),
            size,
            policies,
            expert,
            steps=steps,
            hold_steps=hold_steps,
            gate=gate,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
            collector=config.collector,
        )
        for size in config.env.sizes
    }


def make_validation_buffers(
    config: TrainConfig,
    policies: Sequence[ModGNN],
    expert: TensorDictModuleBase,
    *,
    steps: int,
    hold_steps: int,
) -> dict[int, FlockBuffer]:
    """The ``trainer.num_val_envs`` flocks of each size whose rollouts are not trained on, flown in this process."""
    held_out = dataclasses.replace(config.trainer, num_envs=config.trainer.num_val_envs)
    apart = dataclasses.replace(
        config, trainer=held_out, seed=derive_seed(config.seed, "validation"), collector=CollectorConfig()
    )
    return make_buffers(apart, policies, expert, steps=steps, hold_steps=hold_steps)


def flocks_of(size: int, config: TrainConfig) -> int:
    """How many flocks of a size a run flies at once, so that each size has as many agents."""
    return max(1, round(REFERENCE_SIZE * config.trainer.num_envs / len(config.env.sizes) / size))
