"""A scenario of VMAS as an environment of TorchRL, with what a task needs and random numbers of its own."""

from __future__ import annotations

import contextlib
import importlib
import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Unbounded
from torchrl.envs import MarlGroupMapType, VmasEnv

from modgnn_rl.errors import InputError

__all__ = ["POSITION", "ScenarioEnv"]

POSITION = ("agents", "position")
MARKED = ("goal", "target", "package", "food", "landmark")  # landmarks with such names are marked in replays


class ScenarioEnv(VmasEnv):
    """A scenario with all agents in one group, their positions, the places to mark, and success.

    It has random numbers of its own: those of VMAS belong to all environments of a process together, so that an
    evaluation would change what is sampled in training.

    Args:
        scenario: name of the scenario.
        num_envs: B.
        seed: of the random numbers.
        device: of the tensors.
        discrete: whether actions are discrete.
        options: arguments of the scenario.
    """

    def __init__(
        self,
        scenario: str,
        num_envs: int,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        discrete: bool = False,
        options: dict[str, Any],
    ) -> None:
        with seeded_vmas(seed) as random_state:
            super().__init__(
                scenario=scenario,
                num_envs=num_envs,
                continuous_actions=not discrete,
                device=device,
                seed=seed,
                group_map=MarlGroupMapType.ALL_IN_ONE_GROUP,
                scenario_kwargs=options,
            )
        self._random_state = random_state

    def _make_specs(self, env: Any) -> None:
        super()._make_specs(env)
        if self.het_specs:
            raise InputError(
                f"scenario '{self.scenario_name}' has agents of different kinds, and one policy acts for all; choose a "
                "scenario whose agents observe and do the same"
            )
        observed = self.full_observation_spec_unbatched  # type: ignore[has-type]
        observed[POSITION] = Unbounded((self.n_agents, 2), device=self.device)
        observed["landmarks"] = Unbounded((len(self._marked()), 2), device=self.device)
        observed["success"] = Binary(shape=(1,), dtype=torch.bool, device=self.device)
        self.full_observation_spec_unbatched = observed

    def _make_unbatched_group_specs(self, group: str) -> Any:
        return (*super()._make_unbatched_group_specs(group)[:3], None)

    def read_info(self, infos: dict[str, Tensor]) -> None:
        """Nothing: the scenarios' further values are not stored."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with self._own_random_state():
            return self._with_landmarks(super()._reset(tensordict, **kwargs))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self._own_random_state():
            return self._with_landmarks(super()._step(tensordict))

    def _with_landmarks(self, result: TensorDictBase) -> TensorDictBase:
        result[POSITION] = torch.stack([agent.state.pos for agent in self.agents], 1)
        marked = [landmark.state.pos for landmark in self._marked()]
        result["landmarks"] = (
            torch.stack(marked, 1) if marked else torch.zeros(*self.batch_size, 0, 2, device=self.device)
        )
        failed = getattr(self.scenario, "on_the_ground", torch.zeros((), dtype=torch.bool, device=self.device))
        result["success"] = result["done"] & ~failed.unsqueeze(-1)
        return result

    def _marked(self) -> list[Any]:
        return [mark for mark in self.world.landmarks if any(word in mark.name for word in MARKED)]

    @contextlib.contextmanager
    def _own_random_state(self) -> Iterator[None]:
        with shared_random_state() as shared:
            shared[:] = self._random_state
            yield
            self._random_state = list(shared)


@contextlib.contextmanager
def shared_random_state() -> Iterator[list[Any]]:
    """The random state of all VMAS environments, a list to change; it is restored at the end."""
    shared = importlib.import_module("vmas.simulator.environment").Environment.vmas_random_state
    before = list(shared)
    try:
        yield shared
    finally:
        shared[:] = before


@contextlib.contextmanager
def seeded_vmas(seed: int) -> Iterator[list[Any]]:
    """Let VMAS begin with a seed; the list is its random state at the end."""
    after: list[Any] = []
    with shared_random_state() as shared:
        states = torch.Generator().manual_seed(seed).get_state(), np.random.RandomState(seed % 2**32).get_state()
        shared[:] = [*states, random.Random(seed).getstate()]
        yield after
        after[:] = shared
