"""Rollouts collected in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector

from modgnn_rl.configs.schema import CollectorConfig, FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.trainers.collectors.remote import RemoteCollector
from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.seeds import derive_seed, seeded

__all__ = ["FlockCollector", "make_collector"]


class FlockCollector:
    """Flocks of one size that never stop flying, flown through TorchRL's `Collector`.

    Each call of `collect` goes on where they were.

    Args:
        config: the world.
        num_envs: flocks flown at once, B.
        num_agents: agents in each, N.
        behaviour: the modules that fly and label, in this order (weights changed in place are flown at once).
        steps: steps of one call of `collect`.
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
    def collect(self) -> TensorDictBase:
        """Continue the rollouts by some steps; rollouts [B, T]. Torch's global generators are left as they were."""
        seed = int(torch.randint(2**31, (), generator=self.noise))
        with seeded(seed, self.env.device):
            return next(self._flights)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        return {"env": self.env.generator, "faults": self.env.perturbations.generator, "noise": self.noise}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """What a checkpoint holds of the rollouts."""
        # TorchRL has no public name for what it carries from step to step, messages among it; its own numbers of
        # trajectories need not be the same.
        carried = self.collector._carrier.exclude("collector").flatten_keys("/")
        return {"env": self.env.snapshot(), "carried": dict(carried.items())}, {}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Go on from what `state` gave.

        Raises:
            KeyError, RuntimeError: these are rollouts of other flocks.
        """
        self.env.restore(tensors["env"])
        carried = self.collector._carrier
        found = TensorDict(tensors["carried"], carried.batch_size, device=self.env.device).unflatten_keys("/")
        self.collector._carrier = carried.select("collector").update(found)

    def close(self) -> None:
        """End the rollouts."""
        self.collector.shutdown()


def make_collector(
    collector: CollectorConfig | None, config: FlockingConfig, *arguments: Any, **options: Any
) -> FlockCollector | RemoteCollector:
    """Flocks of one size, flown in this process (also for None) or by workers; for the arguments see `FlockCollector`.

    Raises:
        InputError: see `RemoteCollector`.
    """
    if collector is None or collector.name == "single":
        return FlockCollector(config, *arguments, **options)
    return RemoteCollector(config, *arguments, **options, collector=collector)
