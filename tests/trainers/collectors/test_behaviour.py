"""Laws of beta schedules and of the mixture."""

from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import TensorDict

from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import BetaMixture, beta_schedule


def _beta(schedule, index):
    return beta_schedule(schedule, index, start=0.8, decay=0.5, last_round=10)


def test_schedules_have_their_closed_forms():
    assert [_beta("constant", k) for k in (0, 9)] == [0.8, 0.8]
    assert _beta("linear", 5) == pytest.approx(0.4)
    assert _beta("exponential", 3) == pytest.approx(0.1)


@pytest.mark.parametrize("schedule", ["constant", "linear", "exponential"])
def test_beta_falls_to_zero(schedule):
    betas = [_beta(schedule, k) for k in range(12)]
    assert all(later <= earlier for earlier, later in itertools.pairwise(betas))
    assert betas[10] == betas[11] == 0.0


def _act(mixture, flocks, agents=3):
    actions = TensorDict({"action": torch.zeros(flocks, agents, 3), "expert_action": torch.ones(flocks, agents, 3)})
    return mixture(TensorDict({"agents": actions.auto_batch_size_()}, [flocks]))


def test_the_choice_holds_for_all_agents_of_a_flock_and_for_hold_steps():
    mixture = BetaMixture(0.5, 4, torch.Generator().manual_seed(0))
    actions = torch.stack([_act(mixture, 200)["agents", "action"] for _ in range(8)])
    assert (actions == actions[:, :, :1, :1]).all()
    chosen = actions[:, :, 0, 0]
    assert (chosen[:4] == chosen[0]).all()
    assert (chosen[4:] == chosen[4]).all()
    assert (chosen[0] != chosen[4]).any()


@pytest.mark.parametrize("beta", [0.0, 0.25, 1.0])
def test_beta_is_the_fraction_of_flocks_in_which_the_expert_acts(beta):
    mixture = BetaMixture(beta, 1, torch.Generator().manual_seed(0))
    mixed = _act(mixture, 4000)
    assert mixed["expert_acts"].float().mean() == pytest.approx(beta, abs=0.03)
    assert (mixed["agents", "action"][..., 0, 0].bool() == mixed["expert_acts"].squeeze(-1)).all()


def test_a_new_beta_applies_from_the_next_choice_on():
    mixture = BetaMixture(1.0, 3, torch.Generator().manual_seed(0))
    acts = []
    for _ in range(6):
        acts.append(bool(_act(mixture, 10)["expert_acts"].all()))
        mixture.beta = 0.0
    assert acts == [True] * 3 + [False] * 3


def test_an_unknown_schedule_is_refused():
    with pytest.raises(InputError, match="schedule 'linaer'"):
        _beta("linaer", 0)
