"""Rollouts collected in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector

from modgnn_rl.trainers.common.state import TensorGroups
from modgnn_rl.utils.internals import collector_carrier, set_collector_carrier
from modgnn_rl.utils.seeds import derive_seed, seeded

__all__ = ["EnvFactory", "LocalCollector", "RolloutSpec"]

EnvFactory = Callable[[int, int, int, torch.device | str], Any]


@dataclass(frozen=True)
class RolloutSpec:
    """Which rollouts a collector collects.

    Attributes:
        make_env: ``make_env(num_envs, num_agents, seed, device)`` returns a TorchRL environment [B], such as
            `modgnn_rl.task.Task.training_env`. It has the attribute ``generators`` (random generators by name), and
            the methods ``snapshot`` and ``restore`` unless its attribute ``has_snapshots`` is false.
        num_envs: environments that run in parallel, B.
        num_agents: agents in each, N.
        steps: steps of each call of `LocalCollector.collect`, T.
        seed: seeds the environments, and modules of the acting policy that use torch's global generators.
        device: device of environments and rollouts.
    """

    make_env: EnvFactory
    num_envs: int
    num_agents: int
    steps: int
    seed: int
    device: torch.device | str = "cpu"


class LocalCollector:
    """Collects rollouts in this process, through TorchRL's `Collector`; they continue from one call to the next.

    Args:
        spec: which rollouts.
        behaviour: modules that act and label, in this order. Weights that are changed in place are used at once.
    """

    def __init__(self, spec: RolloutSpec, behaviour: Sequence[TensorDictModuleBase]) -> None:
        self.env = spec.make_env(spec.num_envs, spec.num_agents, derive_seed(spec.seed, "env"), spec.device)
        self.noise = torch.Generator().manual_seed(derive_seed(spec.seed, "noise"))
        self.policy = TensorDictSequential(*behaviour)
        with seeded(spec.seed, spec.device):  # the collector runs the policy once
            self.collector = Collector(
                self.env,
                self.policy,
                frames_per_batch=spec.num_envs * spec.steps,
                total_frames=-1,
                auto_register_policy_transforms=True,
                trust_policy=True,
                no_cuda_sync=True,
            )
        self._rollouts: Iterator[TensorDictBase] = iter(self.collector)

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Continue the rollouts; returns [B, T]. The state of torch's global generators is preserved."""
        seed = int(torch.randint(2**31, (), generator=self.noise))
        with seeded(seed, self.env.device):
            return next(self._rollouts)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random generators of the collector, by name."""
        return {**self.env.generators, "noise": self.noise}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state of the rollouts for a checkpoint, without generators: tensors and plain values.

        It is empty if the environment has no snapshots; a resumed run then begins new episodes.
        """
        if not getattr(self.env, "has_snapshots", True):
            return {}, {}
        # The messages are carried from step to step; the trajectory ids of TorchRL need not be restored.
        carried = collector_carrier(self.collector).exclude("collector").flatten_keys("/")
        return {"env": self.env.snapshot(), "carried": dict(carried.items())}, {}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Resume from the result of `state`.

        Raises:
            KeyError, RuntimeError: the state is that of other environments.
        """
        if not getattr(self.env, "has_snapshots", True):
            return
        self.env.restore(tensors["env"])
        carrier = collector_carrier(self.collector)
        restored = TensorDict(tensors["carried"], carrier.batch_size, device=self.env.device).unflatten_keys("/")
        set_collector_carrier(self.collector, carrier.select("collector").update(restored))

    def close(self) -> None:
        """Close the environments."""
        self.collector.shutdown()
