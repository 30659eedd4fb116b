"""Recurrent state of agents in TorchRL environments.

A vector that an agent does not hold (at the start of an episode, after a reboot) is NaN; `missing` makes such a state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules import set_recurrent_mode

from modgnn_rl.errors import InputError

__all__ = ["RecurrentStatePrimer", "missing"]


def missing(like: Tensor) -> Tensor:
    """A state of the shape of ``like`` that says that nothing is held."""
    return torch.full_like(like, torch.nan)


class RecurrentStatePrimer(TensorDictPrimer):
    """Primer whose shapes follow the environment that it is appended to, so that a module serves any number of agents.

    It adds the keys to the environment's specs and zeroes them at resets; modules look at ``is_init`` and read no cache
    there.

    Args:
        module: the module that owns the state; run once on the zero observation to learn the shapes.
        keys: the root keys of its state, which it writes under ``"next"``.
        is_init: the key under which the module looks whether an episode begins.

    Raises:
        InputError: when it is appended, if the module needs data that the environment does not have.
    """

    def __init__(self, module: TensorDictModuleBase, keys: Sequence[str], *, is_init: NestedKey = "is_init") -> None:
        super().__init__(primers=Composite({key: Unbounded(()) for key in keys}), expand_specs=False)
        self._keys, self._is_init = tuple(keys), is_init
        # A bound method, since the module must not become a part of the environment; None once the shapes are known.
        self._run_once: Callable[[TensorDictBase], TensorDictBase] | None = module.forward

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Size the state by the environment's observations, then add it to the spec."""
        self._size()
        return super().transform_observation_spec(observation_spec)

    def _reset_func(self, *args: Any, **kwargs: Any) -> Any:
        self._size()
        return super()._reset_func(*args, **kwargs)

    def _size(self) -> None:
        if self._run_once is None:
            return
        spec = self.parent.observation_spec
        seen = spec.zero()
        seen[self._is_init] = torch.ones(*spec.shape, 1, dtype=torch.bool, device=spec.device)
        try:
            with torch.no_grad(), set_recurrent_mode(False):
                state = self._run_once(seen)["next"]
        except InputError as error:
            raise InputError(
                f"the policy cannot run on what the environment emits ({error}); what is made of observations must be "
                "made by a transform that is appended before the policy's memory"
            ) from error
        like = {key: state[key] for key in self._keys}
        specs = {key: Unbounded(value.shape, device=value.device, dtype=value.dtype) for key, value in like.items()}
        self.primers = Composite(specs, shape=spec.shape, device=spec.device)
        self._run_once = None
