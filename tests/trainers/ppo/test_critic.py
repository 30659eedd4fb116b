"""Laws of the critic: it knows neither the order, nor the place, nor the attitude, nor the size of a flock."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.features import flock_features
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.layout import STATE
from modgnn_rl.trainers.imitation.loss import random_rotations, rotate
from modgnn_rl.trainers.ppo.critic import CentralCritic, PooledCritic

DOUBLE = torch.float64


def _states(flocks, agents, seed=0):
    state = torch.randn(flocks, agents, 6, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    return state * torch.tensor([1.5, 1.5, 1.5, 0.3, 0.3, 0.3], dtype=DOUBLE)


@pytest.fixture(scope="module")
def critic():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return CentralCritic(FlockingTask(FlockingConfig()).critic_input(), hidden=16).double()


def _values(critic, state, mask=None):
    agents = {"observation": state} if mask is None else {"observation": state, "mask": mask}
    shape = state.shape[:-2]
    return critic(TensorDict({"agents": TensorDict(agents, shape)}, shape))["agents", "state_value"]


@given(seed=st.integers(0, 1000), agents=st.integers(2, 8))
def test_permuting_the_followers_permutes_the_values(critic, seed, agents):
    state = _states(2, agents, seed)
    order = torch.cat(
        (torch.zeros(1).long(), 1 + torch.randperm(agents - 1, generator=torch.Generator().manual_seed(seed)))
    )
    torch.testing.assert_close(_values(critic, state[:, order]), _values(critic, state)[:, order])


def test_the_leader_cannot_be_swapped_with_a_follower(critic):
    state = _states(2, 5)
    swapped = state[:, [1, 0, 2, 3, 4]]
    assert (_values(critic, swapped)[:, 2:] - _values(critic, state)[:, 2:]).abs().min() > 1e-4


@given(seed=st.integers(0, 1000), agents=st.integers(1, 6), mirrored=st.booleans())
def test_values_are_invariant_to_translation_rotation_and_reflection(critic, seed, agents, mirrored):
    generator = torch.Generator().manual_seed(seed)
    state = _states(3, agents, seed)
    matrices = random_rotations(3, STATE, state, generator)
    moved = rotate(state, -matrices if mirrored else matrices, 2)
    moved[..., :3] += 20 * torch.randn(3, 1, 3, generator=generator, dtype=DOUBLE)
    torch.testing.assert_close(_values(critic, moved), _values(critic, state), rtol=1e-6, atol=1e-8)


def test_values_depend_on_every_agents_position_and_velocity(critic):
    """Else the laws above would hold of a critic that sees nothing."""
    state = _states(1, 5)
    for agent in range(5):
        for component in (slice(0, 3), slice(3, 6)):
            other = state.clone()
            other[:, agent, component] *= 1.5
            assert (_values(critic, other) - _values(critic, state)).abs().min() > 1e-6


@given(seed=st.integers(0, 1000), agents=st.integers(1, 5), others=st.integers(1, 4))
def test_agents_that_do_not_exist_do_not_affect_values(critic, seed, agents, others):
    state = _states(2, agents, seed)
    garbage = 1e4 * (1 + torch.rand(2, others, 6, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE))
    mask = (torch.arange(agents + others) < agents).expand(2, -1)
    values = _values(critic, torch.cat((state, garbage), 1), mask)
    torch.testing.assert_close(values[:, :agents], _values(critic, state))


def test_agents_that_do_not_exist_do_not_affect_gradients(critic):
    state = torch.cat((_states(2, 3), torch.full((2, 1, 6), 1e4, dtype=DOUBLE)), 1)
    mask = torch.tensor([True, True, True, False]).expand(2, 4)
    gradients = []
    for values in (_values(critic, state, mask)[:, :3], _values(critic, state[:, :3])):
        gradients.append(torch.autograd.grad(values.sum(), list(critic.parameters())))
    for mine, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, theirs)


@pytest.mark.parametrize("agents", [1, 2, 40])
def test_any_number_of_agents_and_any_leading_dimensions(agents):
    critic = CentralCritic(FlockingTask(FlockingConfig()).critic_input(), hidden=8)
    state = _states(6, agents).float()
    values = _values(critic, state.view(2, 3, agents, 6))
    assert values.shape == (2, 3, agents, 1)
    assert values.isfinite().all()
    torch.testing.assert_close(values.view(6, agents, 1), _values(critic, state))
    values.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in critic.parameters())


@pytest.mark.parametrize("there", [0, 1, 3])
def test_masked_pooling_equals_pooling_of_the_smaller_flock(there):
    network = PooledCritic(4, hidden=8).double()
    features = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    mask = (torch.arange(5) < there).expand(2, 5)
    values = network(features, mask)
    if there:
        torch.testing.assert_close(values[:, :there], network(features[:, :there]))
    assert values.isfinite().all()
    torch.testing.assert_close(network(features, torch.ones(2, 5, dtype=torch.bool)), network(features))


def test_features_of_a_flock_computed_by_hand():
    """The leader rests at the origin; a follower 3 m east of it moves west at 1 m/s; another, 0.2 m behind, rests."""
    state = torch.zeros(1, 3, 6, dtype=DOUBLE)
    state[0, 1, 0], state[0, 1, 3], state[0, 2, 0] = 3.0, -1.0, 3.2
    features = flock_features(state)[0]
    assert features.shape == (3, 15)
    assert features[:, 0].tolist() == pytest.approx([0, 1.0, 3.2 / 3], abs=1e-4)  # distance from the leader / 3 m
    assert features[:, 2].tolist() == pytest.approx([0, -1, 0], abs=1e-4)  # its rate of change
    assert features[:, 3].tolist() == pytest.approx([0, 1, 0], abs=1e-3)  # difference of the velocities
    assert features[:, 4].tolist() == pytest.approx([6.2 / 9, (3 - 6.2 / 3) / 3, (3.2 - 6.2 / 3) / 3], abs=1e-4)
    assert features[:, 8].tolist() == pytest.approx([6.2 / 9] * 3, abs=1e-4)
    assert features[:, 12].tolist() == pytest.approx([1, 0.2, 0.2])  # nearest agent, at most 1 m
    assert features[1, 13] == pytest.approx(torch.tensor([-3 / 0.4, -0.2 / 0.4]).exp().sum().item())
    assert features[:, 14].tolist() == pytest.approx([0, 1, 0], abs=1e-3)  # speed
