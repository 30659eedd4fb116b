"""Compilation that falls back to the plain function."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

__all__ = ["compiled"]

Args = ParamSpec("Args")
Result = TypeVar("Result")

# Fused multiply-add, with one rounding instead of two: the physics takes a seventh less time.
OPTIONS: dict[str, Any] = {"cpp.enable_floating_point_contract_flag": "fast"}
MAX_COMPILATIONS = 64  # combinations of shapes and settings for which one function is compiled in one process


def compiled(function: Callable[Args, Result], enabled: bool = True) -> Callable[Args, Result]:
    """Compile a pure function of tensors with ``torch.compile``; if that fails, warn once and run it uncompiled.

    The first call with new shapes, types or numbers compiles, which takes seconds; PyTorch caches the result on disk
    for the next process.

    Args:
        function: the function.
        enabled: false returns the function itself.
    """
    if not enabled:
        return function
    # Each environment compiles on its own: the compilations of one do not count towards the limit of another.
    limits: dict[str, Any] = {"recompile_limit": MAX_COMPILATIONS, "isolate_recompiles": True}
    fast = torch.compile(function, fullgraph=True, dynamic=False, options=OPTIONS, **limits)
    works = True

    def run(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        nonlocal works
        if works:
            try:
                return fast(*args, **kwargs)
            except Exception as error:  # compilers fail in many ways
                result = function(*args, **kwargs)  # raises if the arguments are wrong
                works = False
                reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                name = getattr(function, "__name__", "a function")
                warnings.warn(f"{name} cannot be compiled here and runs uncompiled ({reason})", stacklevel=2)
                return result
        return function(*args, **kwargs)

    return run
