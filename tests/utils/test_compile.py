"""Compiled functions: equal to plain ones, and plain ones where compiling fails."""

from __future__ import annotations

import shutil
import warnings

import pytest
import torch
from torch import Tensor

from modgnn_rl.utils.compile import compiled

COMPILER = shutil.which("g++") or shutil.which("clang++")


def double_sine(x: Tensor, factor: float) -> Tensor:
    return 2 * factor * x.sin()


def uncompilable(x: Tensor) -> Tensor:
    torch._dynamo.graph_break()
    return x + 1


def test_without_compilation_the_function_is_returned() -> None:
    assert compiled(double_sine, enabled=False) is double_sine


@pytest.mark.skipif(COMPILER is None, reason="torch.compile needs a C++ compiler on the CPU")
@pytest.mark.parametrize("shapes", [2, pytest.param(12, marks=pytest.mark.slow)])
def test_compiled_equals_plain_for_every_shape(shapes: int) -> None:
    fast = compiled(double_sine)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        for size in range(1, shapes + 1):  # 12 are more than torch.compile takes by itself
            x = torch.linspace(0, 1, size)
            torch.testing.assert_close(fast(x, 0.5), double_sine(x, 0.5))


def test_code_that_cannot_be_compiled_runs_uncompiled_with_one_warning() -> None:
    fast = compiled(uncompilable)
    with pytest.warns(UserWarning, match="uncompilable cannot be compiled here and runs uncompiled"):
        assert fast(torch.zeros(2)).tolist() == [1, 1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fast(torch.zeros(3)).tolist() == [1, 1, 1]


@pytest.mark.skipif(COMPILER is None, reason="torch.compile needs a C++ compiler on the CPU")
def test_an_error_in_the_arguments_is_not_a_failure_to_compile() -> None:
    fast = compiled(double_sine)
    with pytest.raises(AttributeError):
        fast(None, 1.0)  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert fast(torch.zeros(2), 1.0).tolist() == [0, 0]
