"""Metrics of every task."""

from __future__ import annotations

import math

import pytest
import torch

from modgnn_rl.actions import Ball, Discrete
from modgnn_rl.evaluation.metrics import action_error


def test_action_error_is_the_mean_over_components_and_controlled_agents() -> None:
    generator = torch.Generator().manual_seed(0)
    action, expert = torch.randn(2, 5, 3, generator=generator), torch.randn(2, 5, 3, generator=generator)
    controlled = torch.tensor([[False, True, True, True, True], [True, False, True, False, False]])
    error = action_error(Ball(1.0, 3).difference(action, expert), controlled)
    for flock in range(2):
        squares = [
            float(action[flock, i, d] - expert[flock, i, d]) ** 2
            for i in range(5)
            if controlled[flock, i]
            for d in range(3)
        ]
        assert float(error[flock]) == pytest.approx(sum(squares) / len(squares))


def test_action_error_ignores_agents_it_does_not_count() -> None:
    action = torch.zeros(3, 2, 3)
    action[0, 0] = torch.tensor([math.nan, math.inf, 1.0])
    controlled = torch.tensor([[False, True], [True, True], [False, False]])
    error = action_error(Ball(1.0, 3).difference(action, torch.full_like(action, 2.0)), controlled)
    assert error[:2].tolist() == [4.0, 4.0]
    assert error[2].isnan()


def test_the_error_of_discrete_actions_is_the_fraction_that_differs() -> None:
    scores = torch.tensor([[[0.1, 2.0, 0.3], [5.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    expert = torch.nn.functional.one_hot(torch.tensor([[1, 0, 1]]), 3).float()
    controlled = torch.ones(1, 3, dtype=torch.bool)
    assert float(action_error(Discrete(3).difference(scores, expert), controlled)) == pytest.approx(1 / 3)
