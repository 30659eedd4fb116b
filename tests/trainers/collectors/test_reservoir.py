"""Reservoir sampling: every item is kept with the same probability."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from modgnn_rl import make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer
from modgnn_rl.trainers.collectors.windows import reservoir_indices


@given(capacity=st.integers(1, 12), seen=st.integers(0, 30), count=st.integers(0, 40), seed=st.integers(0, 1000))
def test_indices_and_items_are_in_range_and_different(capacity, seen, count, seed):
    generator = torch.Generator().manual_seed(seed)
    place, item = reservoir_indices(capacity + seen, count, capacity, generator)
    assert place.shape == item.shape
    assert len(place) <= min(count, capacity)
    assert len(set(place.tolist())) == len(set(item.tolist())) == len(place)
    assert all(0 <= value < capacity for value in place.tolist())
    assert all(0 <= value < count for value in item.tolist())


@pytest.mark.parametrize(
    ("capacity", "counts"),
    [
        (10, [3, 3, 3]),  # fewer than the capacity, several times
        (6, [40]),  # many more than the capacity, at once
        (5, [2, 20, 1, 0, 9]),
        (1, [4]),
    ],
)
def test_every_item_is_kept_with_the_same_probability(capacity, counts):
    trials, total = 1500, capacity + sum(counts)
    generator = torch.Generator().manual_seed(0)
    kept = torch.zeros(total)
    for _ in range(trials):
        store, seen = torch.arange(capacity), capacity
        for count in counts:
            place, item = reservoir_indices(seen, count, capacity, generator)
            store[place] = seen + item
            seen += count
        assert len(set(store.tolist())) == capacity
        kept[store] += 1
    probability = capacity / total
    # Chi-square of the counts, whose expectation is total - capacity; its standard deviation is below sqrt(2 total).
    chi_square = ((kept / trials - probability).square() * trials / probability).sum()
    assert chi_square < (total - capacity) + 5 * (2 * total) ** 0.5


def test_indices_are_those_of_algorithm_r():
    """Vitter's algorithm R, item by item, with the same random numbers."""
    capacity, seen, count = 7, 15, 30
    place, item = reservoir_indices(seen, count, capacity, torch.Generator().manual_seed(3))
    chance = torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    store = dict.fromkeys(range(capacity), -1)
    for number in range(count):
        sampled = int(chance[number] * (seen + number + 1))
        if sampled < capacity:
            store[sampled] = number
    assert dict(zip(place.tolist(), item.tolist(), strict=True)) == {k: v for k, v in store.items() if v >= 0}


def _buffer(replacement, capacity):
    settings = DAggerConfig(stride=1, capacity=capacity, batch_size=4, replacement=replacement)
    policy = make_model("pair_force", hidden=8, seed=0)
    spec = RolloutSpec(FlockingTask(FlockingConfig()).training_env, num_envs=2, num_agents=3, steps=5, seed=0)
    return make_buffer(spec, settings, [policy], Reynolds(), hold_steps=5)


@pytest.mark.parametrize(("replacement", "oldest"), [("fifo", False), ("reservoir", True)])
def test_reservoir_keeps_old_states_and_fifo_does_not(replacement, oldest):
    data = _buffer(replacement, capacity=25)
    collected = []
    for _ in range(8):  # 10 states each
        rollouts = data.collect(0.5)
        collected.append(rollouts["agents", "observation"].flatten(0, 1))
        data.extend(rollouts)
    assert data.seen == 80
    assert len(data.buffer) == 25
    stored = data.buffer[:]["agents", "observation"].squeeze(1)
    seen = torch.cat(collected)
    same = (stored.unsqueeze(1) == seen).all(-1).all(-1)
    assert (same.sum(1) == 1).all()  # each is one of those collected,
    assert same.sum(0).max() == 1  # and none is there twice
    rounds = same.float().argmax(1) // 10
    assert bool((rounds < 4).any()) == oldest
    assert data.buffer.sample().batch_size == (4, 1)


def test_all_data_of_a_state_are_replaced_together():
    data = _buffer("reservoir", capacity=12)
    for _ in range(5):
        data.extend(data.collect(0.5))
    stored = data.buffer[:]
    expected = Reynolds()(stored.select(("agents", "observation")))["agents", "expert_action"]
    torch.testing.assert_close(stored["agents", "expert_action"], expected)


def test_reservoir_is_full_before_anything_is_replaced():
    """A round for whose states there is room in part stores that part, and samples for the rest."""
    data, store = _buffer("reservoir", capacity=25), []
    for _ in range(4):
        rollouts = data.collect(0.5)
        generator = data.generators["places"].clone_state()
        data.extend(rollouts)
        new = list(rollouts["agents", "observation"].flatten(0, 1))
        room, seen = 25 - len(store), data.seen - len(new)
        store, new = store + new[:room], new[room:]
        if new:
            for place, item in zip(*reservoir_indices(seen + room, len(new), 25, generator), strict=True):
                store[place] = new[item]
    assert torch.equal(data.buffer[:]["agents", "observation"].squeeze(1), torch.stack(store))
