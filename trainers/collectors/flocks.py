"""Flights for training: flocks that never stop flying, the expert's label at every state that they visit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter

from modgnn_rl.configs.schema import REFERENCE_SIZE, CollectorConfig, FlockingConfig, ImitationConfig, TrainConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.behaviour import Disturbance, Ensemble, Mixture, SafetyGate, spread
from modgnn_rl.trainers.collectors.local import make_flights
from modgnn_rl.trainers.collectors.windows import as_windows, reservoir_places, window_of
from modgnn_rl.trainers.common.state import Part, Tensors
from modgnn_rl.utils.seeds import derive_seed

__all__ = [
    "Flocks",
    "flocks_of",
    "flocks_of_all_sizes",
    "named_flocks",
    "validation_flocks",
]


class Flocks:
    """Flocks of one size, flown by a mixture of policy and expert, and their data.

    `keep` adds windows of flights to the replay buffer.

    Args:
        config: the world.
        settings: how flights become data.
        num_envs: flocks flown at once, B.
        num_agents: agents in each, N.
        policies: those that learn from the data; the first flies beside the expert (weights changed in place are flown
            at once), all of them if there is a gate that looks at their spread.
        expert: writes ``("agents", "expert_action")``.
        steps: steps of one call of `fly`.
        stretch: steps that the one who flies a flock keeps it.
        gate: lets the expert fly where the policy strays.
        seed: seeds the environment, the mixture and the sampling of batches.
        device: where flocks and data live.
        collector: which processes fly; default: this one.

    Attributes:
        flights: the flights that never end.
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
        stretch: int,
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
        self.mixture = Mixture(1.0, stretch, torch.Generator().manual_seed(derive_seed(seed, "mixture")))
        self.disturbance = Disturbance(0.0, torch.Generator().manual_seed(derive_seed(seed, "disturbance")))
        flown = Ensemble(policies) if gate is not None and gate.measure is spread else policies[0]
        gates = [] if gate is None else [gate]
        behaviour = (flown, expert, self.mixture, *gates, self.disturbance)
        self.flights = make_flights(
            collector, config, num_envs, num_agents, behaviour, steps=steps, seed=seed, device=device
        )
        self.mixture.restart()  # the collector has tried the policy out
        self.seen = 0
        self._owns_data = True
        # Not compilable ones would share their counters between processes, and start one of their own for that.
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(settings.capacity, device=device, compilable=True),
            writer=RoundRobinWriter(compilable=True),
            sampler=RandomSampler(),
            batch_size=settings.batch_size,
            generator=torch.Generator(device).manual_seed(derive_seed(seed, "batches")),
        )

    def fly(self, expert_share: float) -> TensorDictBase:
        """Continue the flights by some steps, and label every state with the expert's action; flights [B, T]."""
        self.mixture.share = expert_share
        return self.flights.continue_flights()

    def keep(self, flights: TensorDictBase) -> None:
        """Add windows of flights to the data; where these are full, what ``settings.replacement`` says goes."""
        windows = as_windows(flights.select(*self.keys, strict=False), self.window, self.settings.every)
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
            **self.flights.generators,
            "places": self.noise,
            "mixture": self.mixture.generator,
            "disturbance": self.disturbance.generator,
            "batches": self.buffer._rng,
        }

    def borrow(self, buffer: ReplayBuffer) -> None:
        """Use data that somebody else keeps; checkpoints do not hold them."""
        self.buffer, self._owns_data = buffer, False

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What a checkpoint holds of flights and data."""
        tensors, values = self.flights.state()
        tensors["mixture"] = self.mixture.state()
        values |= {"disturbance": self.disturbance.scale, "seen": self.seen}
        if self._owns_data and self.settings.checkpoint_data and len(self.buffer):
            tensors["data"] = dict(self.buffer[:].flatten_keys("/").items())
            values["writer"] = self.buffer.writer.state_dict()
        return tensors, values

    def restore(self, tensors: Tensors, values: dict[str, Any]) -> None:
        """Go on from what `state` gave; without data where the checkpoint has none.

        Raises:
            KeyError, RuntimeError: these are flights or data of others.
        """
        self.flights.restore(tensors, values)
        self.mixture.restore(tensors["mixture"])
        self.disturbance.scale = float(values["disturbance"])
        if "data" in tensors:
            rows = len(next(iter(tensors["data"].values())))
            self.buffer.extend(TensorDict(tensors["data"], [rows, self.window]).unflatten_keys("/"))
            self.buffer.writer.load_state_dict(values["writer"])
            self.seen = int(values["seen"])

    def close(self) -> None:
        """End the flights."""
        self.flights.close()


def flocks_of_all_sizes(
    config: TrainConfig,
    policies: Sequence[ModGNN],
    expert: TensorDictModuleBase,
    *,
    steps: int,
    stretch: int,
    gate: SafetyGate | None = None,
) -> dict[int, Flocks]:
    """The flocks of a training run, by their size: all in ``config.env.num_agents``, of as many agents each."""
    return {
        size: Flocks(
            config.env,
            config.trainer,
            flocks_of(size, config),
            size,
            policies,
            expert,
            steps=steps,
            stretch=stretch,
            gate=gate,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
            collector=config.collector,
        )
        for size in config.env.sizes
    }


def validation_flocks(
    config: TrainConfig,
    policies: Sequence[ModGNN],
    expert: TensorDictModuleBase,
    *,
    steps: int,
    stretch: int,
) -> dict[int, Flocks]:
    """The ``trainer.held_out`` flocks of each size whose flights are not trained on, flown in this process."""
    held_out = dataclasses.replace(config.trainer, num_envs=config.trainer.held_out)
    apart = dataclasses.replace(
        config, trainer=held_out, seed=derive_seed(config.seed, "validation"), collector=CollectorConfig()
    )
    return flocks_of_all_sizes(apart, policies, expert, steps=steps, stretch=stretch)


def named_flocks(training: Mapping[int, Part], validation: Mapping[int, Part]) -> dict[str, Any]:
    """All flocks of a run by the names that checkpoints give them."""
    return {
        **{str(size): group for size, group in training.items()},
        **{f"validation-{size}": group for size, group in validation.items()},
    }


def flocks_of(size: int, config: TrainConfig) -> int:
    """How many flocks of a size a run flies at once, so that each size has as many agents."""
    return max(1, round(REFERENCE_SIZE * config.trainer.num_envs / len(config.env.sizes) / size))
