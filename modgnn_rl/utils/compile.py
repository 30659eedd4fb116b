"""Compiled functions that fall back to plain ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

__all__ = ["compiled"]

Args = ParamSpec("Args")
Result = TypeVar("Result")

# A product and a sum in one instruction and one rounding: faster by a seventh in the physics.
OPTIONS: dict[str, Any] = {"cpp.enable_floating_point_contract_flag": "fast"}
SHAPES = 64  # sets of shapes and settings that one function is compiled for in one process


def compiled(function: Callable[Args, Result], enabled: bool = True) -> Callable[Args, Result]:
    """Compile a pure function of tensors with ``torch.compile``; where that fails, warn once and run it as it is.

    It is compiled at the first call with new shapes, types or numbers, which takes seconds; PyTorch keeps the result
    on disk, so that the next process needs less.

    Args:
        function: the function.
        enabled: false returns the function itself.
    """
    if not enabled:
        return function
    # Each environment compiles for itself: what one of them was compiled for does not count against the others.
    limits: dict[str, Any] = {"recompile_limit": SHAPES, "isolate_recompiles": True}
    fast = torch.compile(function, fullgraph=True, dynamic=False, options=OPTIONS, **limits)
    works = True

    def run(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        nonlocal works
        if works:
            try:
                return fast(*args, **kwargs)
            except Exception as error:  # whatever the compilers of this machine have against it
                result = function(*args, **kwargs)  # what is wrong with the arguments is raised here
                works = False
                reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                name = getattr(function, "__name__", "a function")
                warnings.warn(f"{name} cannot be compiled here and runs uncompiled ({reason})", stacklevel=2)
                return result
        return function(*args, **kwargs)

    return run
