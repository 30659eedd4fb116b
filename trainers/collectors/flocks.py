"""Flights for training: flocks that never stop flying, the expert's label at every state that they visit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter

from modgnn_rl.configs.schema import REFERENCE_SIZE, CollectorConfig, FlockingConfig, ImitationConfig, TrainConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.models.equivariant import is_equivariant
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.behaviour import Disturbance, Ensemble, Mixture, SafetyGate, spread
from modgnn_rl.trainers.collectors.remote import RemoteFlights
from modgnn_rl.trainers.common.state import Part, Tensors
from modgnn_rl.trainers.imitation.loss import are_alike
from modgnn_rl.utils.seeds import derive_seed, seeded

__all__ = [
    "FlockCollector",
    "Flocks",
    "as_windows",
    "flocks_of",
    "flocks_of_all_sizes",
    "make_flights",
    "named_flocks",
    "reservoir_places",
    "stores_messages",
    "validation_flocks",
    "window_of",
]


class FlockCollector:
    """Flocks of one size that never stop flying, flown through TorchRL's `Collector`.

    Each call of `continue_flights` goes on where they were.

    Args:
        config: the world.
        num_envs: flocks flown at once, B.
        num_agents: agents in each, N.
        behaviour: the modules that fly and label, in this order (weights changed in place are flown at once).
        steps: steps of one call of `continue_flights`.
        seed: seeds the environment, and the draws of modules that draw from torch's global generator.
        device: where flocks and data live.
    """

    def __init__(
        self,
        config: FlockingConfig,
        num_envs: int,
        num_agents: int,
        behaviour: Sequence[TensorDictModuleBase],
        *,
        steps: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env = FlockingEnv(
            num_envs, num_agents, config=config, seed=derive_seed(seed, "env"), device=device, stagger=True
        )
        self.noise = torch.Generator().manual_seed(derive_seed(seed, "noise"))
        with seeded(seed, device):  # the collector tries the policy out
            self.collector = Collector(
                self.env,
                TensorDictSequential(*behaviour),
                frames_per_batch=num_envs * steps,
                total_frames=-1,
                auto_register_policy_transforms=True,
                trust_policy=True,
                no_cuda_sync=True,
            )
        self._flights: Iterator[TensorDictBase] = iter(self.collector)

    @torch.no_grad()
    def continue_flights(self) -> TensorDictBase:
        """Continue the flights by some steps; flights [B, T]. Torch's global generators are left as they were."""
        seed = int(torch.randint(2**31, (), generator=self.noise))
        with seeded(seed, self.env.device):
            return next(self._flights)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        return {"env": self.env.generator, "faults": self.env.faults.generator, "noise": self.noise}

    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What a checkpoint holds of the flights."""
        # TorchRL has no public name for what it carries from step to step, messages among it; its own numbers of
        # trajectories need not be the same.
        carried = self.collector._carrier.exclude("collector").flatten_keys("/")
        return {"env": self.env.snapshot(), "carried": dict(carried.items())}, {}

    def restore(self, tensors: Tensors, values: dict[str, Any]) -> None:
        """Go on from what `state` gave.

        Raises:
            KeyError, RuntimeError: these are flights of other flocks.
        """
        self.env.restore(tensors["env"])
        carried = self.collector._carrier
        found = TensorDict(tensors["carried"], carried.batch_size, device=self.env.device).unflatten_keys("/")
        self.collector._carrier = carried.select("collector").update(found)

    def close(self) -> None:
        """End the flights."""
        self.collector.shutdown()


def make_flights(
    collector: CollectorConfig | None, config: FlockingConfig, *arguments: Any, **options: Any
) -> FlockCollector | RemoteFlights:
    """Flocks of one size, flown in this process (also for None) or by workers; for the arguments see `FlockCollector`.

    Raises:
        InputError: see `RemoteFlights`.
    """
    if collector is None or collector.name == "single":
        return FlockCollector(config, *arguments, **options)
    return RemoteFlights(config, *arguments, **options, collector=collector)


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


def reservoir_places(
    seen: int, count: int, capacity: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Reservoir sampling (Vitter 1985): which of new items replace which, so that all ever seen are kept alike.

    Args:
        seen: items seen before, at least ``capacity``.
        count: new items.
        capacity: items kept.
        generator: source of randomness.

    Returns:
        places in the store, and the new items that go there, int64 [R] each; no place comes twice.
    """
    items = torch.arange(count)
    chance = torch.rand(count, generator=generator, dtype=torch.float64)
    drawn = (chance * (seen + items + 1)).long()
    stays = drawn < capacity
    place, item = drawn[stays], items[stays]
    last = torch.full((capacity,), -1).scatter_reduce(0, place, item, "amax")  # a later item goes over an earlier one
    place = (last >= 0).nonzero().squeeze(-1)
    return place, last[place]


def window_of(policies: Sequence[ModGNN], settings: ImitationConfig) -> int:
    """Steps of the windows that policies learn from: one, with the stored messages, where that is enough."""
    if are_alike(policies) and stores_messages(policies[0]) and not settings.hide_velocity:
        return 1
    return max(policy.window for policy in policies)


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


def stores_messages(policy: ModGNN) -> bool:
    """Whether a policy is trained with the messages that it received in flight; if not, windows make them anew.

    They must hold no trace of a parameter, and turn with a rotated state: as sums of observations do, and as all does
    that an equivariant policy sends, whose states need no rotation.
    """
    return policy.sends_plain_data and (len(policy.layers) == 1 or is_equivariant(policy))


def flocks_of(size: int, config: TrainConfig) -> int:
    """How many flocks of a size a run flies at once, so that each size has as many agents."""
    return max(1, round(REFERENCE_SIZE * config.trainer.num_envs / len(config.env.sizes) / size))


def as_windows(flights: TensorDictBase, length: int, every: int) -> TensorDictBase:
    """Cut flights [B, T] into overlapping windows [B * n, length] whose last steps are ``every`` steps apart."""
    last = torch.arange(length - 1, flights.shape[1], every, device=flights.device)
    steps = last.unsqueeze(-1) + torch.arange(1 - length, 1, device=flights.device)
    return flights[:, steps].flatten(0, 1)
