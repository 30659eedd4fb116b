"""Recurrent state of agents in TorchRL environments.

NaN stands for a vector that an agent does not hold, at the start of an episode or after a reboot; `missing` makes such
a state.
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
    """A state of the shape of ``like`` in which nothing is held."""
    return torch.full_like(like, torch.nan)


class RecurrentStatePrimer(TensorDictPrimer):
    """Primer whose shapes follow the environment that it is appended to, so that a module serves any number of agents.

    It adds the state to the environment's specs and zeroes it at resets. The module must check ``is_init``, and ignore
    the state where an episode begins.

    Args:
        module: the module that owns the state; it runs once on the zero observation to infer the shapes.
        keys: root keys of the state, which the module writes under ``"next"``.
        is_init: key of the flag that an episode begins.

    Raises:
        InputError: when it is appended, if the module needs data that the environment does not provide.
    """

    def __init__(self, module: TensorDictModuleBase, keys: Sequence[str], *, is_init: NestedKey = "is_init") -> None:
        super().__init__(primers=Composite({key: Unbounded(()) for key in keys}), expand_specs=False)
        self._keys, self._is_init = tuple(keys), is_init
        # A bound method, because the module must not become a submodule of the environment; None once shapes are known.
        self._run_once: Callable[[TensorDictBase], TensorDictBase] | None = module.forward

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Infer the state's shapes from the environment's observations, then add it to the spec."""
        self._infer_shapes()
        return super().transform_observation_spec(observation_spec)

    def _reset_func(self, *args: Any, **kwargs: Any) -> Any:
        self._infer_shapes()
        return super()._reset_func(*args, **kwargs)

    def _infer_shapes(self) -> None:
        if self._run_once is None:
            return
        spec = self.parent.observation_spec
        data = spec.zero()
        data[self._is_init] = torch.ones(*spec.shape, 1, dtype=torch.bool, device=spec.device)
        try:
            with torch.no_grad(), set_recurrent_mode(False):
                state = self._run_once(data)["next"]
        except InputError as error:
            raise InputError(
                f"the policy cannot read the environment's observations ({error}); a transform that prepares them must "
                "be appended before the policy's primer"
            ) from error
        like = {key: state[key] for key in self._keys}
        specs = {key: Unbounded(value.shape, device=value.device, dtype=value.dtype) for key, value in like.items()}
        self.primers = Composite(specs, shape=spec.shape, device=spec.device)
        self._run_once = None
