"""Reading and checking the entries of a TensorDict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["as_tuple", "check_leading", "dotted", "read_entry"]


def read_entry(tensordict: TensorDictBase, key: NestedKey, own: tuple[str, ...] | None = None) -> Tensor:
    """A required entry; ``own`` is the name under which keyed submodules read it.

    Raises:
        InputError: it is missing.
    """
    value = tensordict.get(key, None)
    if value is None:
        reader = "the policy" if own is None else f"a submodule, under '{dotted(('own', *own))}',"
        raise InputError(f"'{dotted(key)}' is missing from the data; {reader} needs it: add it, or give another key")
    return value


def check_leading(leading: Sequence[int], named: Mapping[str, Tensor | None], dtype: torch.dtype | None = None) -> None:
    """Check the leading dimensions, and the dtype if given, of entries by name.

    Raises:
        InputError: the first that differs.
    """
    leading = tuple(leading)
    for name, value in named.items():
        if value is not None and tuple(value.shape[: len(leading)]) != leading:
            raise InputError(
                f"{name} has shape {tuple(value.shape)}, but these observations need leading dimensions {leading}"
            )
        if value is not None and dtype is not None and value.dtype != dtype:
            raise InputError(f"{name} has dtype {value.dtype}; it must be {dtype}")


def dotted(key: NestedKey) -> str:
    """A key with dots, as in ``"agents.observation"``."""
    return key if isinstance(key, str) else ".".join(map(str, key))


def as_tuple(key: NestedKey) -> tuple[str, ...]:
    """A key as a tuple of names."""
    key = unravel_key(key)
    return key if isinstance(key, tuple) else (key,)
