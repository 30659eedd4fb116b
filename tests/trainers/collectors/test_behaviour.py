"""Laws of the expert's share and of the mixture."""

from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import TensorDict

from modgnn_rl.errors import InputError
from modgnn_rl.trainers.collectors.behaviour import BetaMixture, beta_schedule


def _share(schedule, index):
    return beta_schedule(schedule, index, start=0.8, decay=0.5, last_round=10)


def test_schedules_have_their_closed_forms():
    assert [_share("constant", k) for k in (0, 9)] == [0.8, 0.8]
    assert _share("linear", 5) == pytest.approx(0.4)
    assert _share("exponential", 3) == pytest.approx(0.1)


@pytest.mark.parametrize("schedule", ["constant", "linear", "exponential"])
def test_the_expert_leaves_in_the_end(schedule):
    shares = [_share(schedule, k) for k in range(12)]
    assert all(later <= earlier for earlier, later in itertools.pairwise(shares))
    assert shares[10] == shares[11] == 0.0


def _fly(mixture, flocks, agents=3):
    actions = TensorDict({"action": torch.zeros(flocks, agents, 3), "expert_action": torch.ones(flocks, agents, 3)})
    return mixture(TensorDict({"agents": actions.auto_batch_size_()}, [flocks]))


def test_one_flies_all_agents_of_a_flock_for_a_stretch():
    mixture = BetaMixture(0.5, 4, torch.Generator().manual_seed(0))
    rollouts = torch.stack([_fly(mixture, 200)["agents", "action"] for _ in range(8)])
    assert (rollouts == rollouts[:, :, :1, :1]).all()
    flown = rollouts[:, :, 0, 0]
    assert (flown[:4] == flown[0]).all()
    assert (flown[4:] == flown[4]).all()
    assert (flown[0] != flown[4]).any()


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_share_is_the_share_of_flocks(share):
    mixture = BetaMixture(share, 1, torch.Generator().manual_seed(0))
    mixed = _fly(mixture, 4000)
    assert mixed["expert_flies"].float().mean() == pytest.approx(share, abs=0.03)
    assert (mixed["agents", "action"][..., 0, 0].bool() == mixed["expert_flies"].squeeze(-1)).all()


def test_a_new_share_holds_from_the_next_toss_on():
    mixture = BetaMixture(1.0, 3, torch.Generator().manual_seed(0))
    flown = []
    for _ in range(6):
        flown.append(bool(_fly(mixture, 10)["expert_flies"].all()))
        mixture.beta = 0.0
    assert flown == [True] * 3 + [False] * 3


def test_an_unknown_schedule_is_refused():
    with pytest.raises(InputError, match="schedule 'linaer'"):
        _share("linaer", 0)
