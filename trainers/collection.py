"""Flights for training: flocks that never stop flying, the expert's label at every state that they visit."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter

from modgnn_rl.configs.schema import REFERENCE_SIZE, FlockingConfig, ImitationConfig, TrainConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.mixing import Mixture

__all__ = ["Flocks", "as_windows", "flocks_of_all_sizes"]


class Flocks:
    """Flocks of one size, flown by a mixture of policy and expert through TorchRL's `Collector`, and their data.

    Each call of `fly` continues the flights where they were; `keep` adds windows of them to the replay buffer, and when
    that is full, the oldest go.

    Args:
        config: the world.
        settings: how flights become data.
        num_envs: flocks flown at once, B.
        num_agents: agents in each, N.
        policy: the policy that flies (weights changed in place are flown at once).
        expert: writes ``("agents", "expert_action")``.
        steps: steps of one call of `fly`.
        stretch: steps that the one who flies a flock keeps it.
        seed: seeds the environment, the mixture and the sampling of batches.
        device: where flocks and data live.
    """

    def __init__(
        self,
        config: FlockingConfig,
        settings: ImitationConfig,
        num_envs: int,
        num_agents: int,
        policy: ModGNN,
        expert: TensorDictModuleBase,
        *,
        steps: int,
        stretch: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.num_agents = num_agents
        self.every = settings.every
        # Messages that hold no trace of a parameter are stored; others are made anew from a window.
        self.window = 1 if policy.sends_plain_data else policy.window
        self.keys = {*policy.in_keys, ("agents", "controlled"), *expert.out_keys[:1]}
        if self.window > 1:
            self.keys -= {policy.messages_key}
        self.mixture = Mixture(1.0, stretch, torch.Generator().manual_seed(derive_seed(seed, "mixture")))
        self.env = FlockingEnv(
            num_envs, num_agents, config=config, seed=derive_seed(seed, "env"), device=device, stagger=True
        )
        self.collector = Collector(
            self.env,
            TensorDictSequential(policy, expert, self.mixture),
            frames_per_batch=num_envs * steps,
            total_frames=-1,
            auto_register_policy_transforms=True,
            trust_policy=True,
            no_cuda_sync=True,
        )
        self.mixture.restart()  # the collector has tried the policy out
        self.flights: Iterator[TensorDictBase] = iter(self.collector)
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
        with torch.no_grad():
            return next(self.flights)

    def keep(self, flights: TensorDictBase) -> None:
        """Add flights to the data."""
        self.buffer.extend(as_windows(flights.select(*self.keys, strict=False), self.window, self.every))

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        size = self.num_agents
        return {
            f"{size}.env": self.env.generator,
            f"{size}.faults": self.env.faults.generator,
            f"{size}.mixture": self.mixture.generator,
            f"{size}.batches": self.buffer._rng,
        }

    def close(self) -> None:
        """End the flights."""
        self.collector.shutdown()


def flocks_of_all_sizes(
    config: TrainConfig, policy: ModGNN, expert: TensorDictModuleBase, *, steps: int, stretch: int
) -> list[Flocks]:
    """The flocks of a training run, one group for each size in ``config.env.num_agents``, of as many agents each."""
    sizes = config.env.sizes
    agents = REFERENCE_SIZE * config.trainer.num_envs / len(sizes)
    return [
        Flocks(
            config.env,
            config.trainer,
            max(1, round(agents / size)),
            size,
            policy,
            expert,
            steps=steps,
            stretch=stretch,
            seed=derive_seed(config.seed, "flocks", size),
            device=config.device,
        )
        for size in sizes
    ]


def as_windows(flights: TensorDictBase, length: int, every: int) -> TensorDictBase:
    """Cut flights [B, T] into overlapping windows [B * n, length] whose last steps are ``every`` steps apart."""
    last = torch.arange(length - 1, flights.shape[1], every, device=flights.device)
    steps = last.unsqueeze(-1) + torch.arange(1 - length, 1, device=flights.device)
    return flights[:, steps].flatten(0, 1)
