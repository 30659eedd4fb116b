"""Reservoir sampling: what was ever seen is kept with one probability."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from modgnn_rl import make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.trainers.collectors.flocks import FlockBuffer
from modgnn_rl.trainers.collectors.windows import reservoir_places


@given(capacity=st.integers(1, 12), seen=st.integers(0, 30), count=st.integers(0, 40), seed=st.integers(0, 1000))
def test_places_and_items_exist_and_none_comes_twice(capacity, seen, count, seed):
    generator = torch.Generator().manual_seed(seed)
    place, item = reservoir_places(capacity + seen, count, capacity, generator)
    assert place.shape == item.shape
    assert len(place) <= min(count, capacity)
    assert len(set(place.tolist())) == len(set(item.tolist())) == len(place)
    assert all(0 <= value < capacity for value in place.tolist())
    assert all(0 <= value < count for value in item.tolist())


@pytest.mark.parametrize(
    ("capacity", "counts"),
    [
        (10, [3, 3, 3]),  # fewer than there is room for, again and again
        (6, [40]),  # many more than there is room for, at once
        (5, [2, 20, 1, 0, 9]),
        (1, [4]),
    ],
)
def test_every_item_ever_seen_is_kept_with_one_probability(capacity, counts):
    trials, total = 1500, capacity + sum(counts)
    generator = torch.Generator().manual_seed(0)
    kept = torch.zeros(total)
    for _ in range(trials):
        store, seen = torch.arange(capacity), capacity
        for count in counts:
            place, item = reservoir_places(seen, count, capacity, generator)
            store[place] = seen + item
            seen += count
        assert len(set(store.tolist())) == capacity
        kept[store] += 1
    probability = capacity / total
    # Chi-square of the counts, whose expectation is total - capacity; its standard deviation is below sqrt(2 total).
    chi_square = ((kept / trials - probability).square() * trials / probability).sum()
    assert chi_square < (total - capacity) + 5 * (2 * total) ** 0.5


def test_a_loop_written_after_vitter_keeps_the_same():
    """Algorithm R, item by item, on the same draws."""
    capacity, seen, count = 7, 15, 30
    place, item = reservoir_places(seen, count, capacity, torch.Generator().manual_seed(3))
    chance = torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    store = dict.fromkeys(range(capacity), -1)
    for number in range(count):
        drawn = int(chance[number] * (seen + number + 1))
        if drawn < capacity:
            store[drawn] = number
    assert dict(zip(place.tolist(), item.tolist(), strict=True)) == {k: v for k, v in store.items() if v >= 0}


def _flocks(replacement, capacity):
    settings = DAggerConfig(stride=1, capacity=capacity, batch_size=4, replacement=replacement)
    policy = make_model("pair_force", hidden=8, seed=0)
    return FlockBuffer(FlockingConfig(), settings, 2, 3, [policy], Reynolds(), steps=5, hold_steps=5, seed=0)


@pytest.mark.parametrize(("replacement", "oldest"), [("fifo", False), ("reservoir", True)])
def test_a_reservoir_keeps_old_states_and_a_queue_does_not(replacement, oldest):
    flocks = _flocks(replacement, capacity=25)
    flown = []
    for _ in range(8):  # 10 states each
        rollouts = flocks.fly(0.5)
        flown.append(rollouts["agents", "observation"].flatten(0, 1))
        flocks.keep(rollouts)
    assert flocks.seen == 80
    assert len(flocks.buffer) == 25
    stored = flocks.buffer[:]["agents", "observation"].squeeze(1)
    seen = torch.cat(flown)
    same = (stored.unsqueeze(1) == seen).all(-1).all(-1)
    assert (same.sum(1) == 1).all()  # each is one of those flown, and
    assert same.sum(0).max() == 1  # none is there twice
    rounds = same.float().argmax(1) // 10
    assert bool((rounds < 4).any()) == oldest
    assert flocks.buffer.sample().batch_size == (4, 1)


def test_all_data_of_a_state_are_replaced_together():
    flocks = _flocks("reservoir", capacity=12)
    for _ in range(5):
        flocks.keep(flocks.fly(0.5))
    stored = flocks.buffer[:]
    expected = Reynolds()(stored.select(("agents", "observation")))["agents", "expert_action"]
    torch.testing.assert_close(stored["agents", "expert_action"], expected)


def test_a_reservoir_fills_up_before_anything_goes():
    """The round that finds room for a part of its states keeps that part, and draws for the rest."""
    flocks, store = _flocks("reservoir", capacity=25), []
    for _ in range(4):
        rollouts = flocks.fly(0.5)
        draws = flocks.noise.clone_state()
        flocks.keep(rollouts)
        new = list(rollouts["agents", "observation"].flatten(0, 1))
        room, seen = 25 - len(store), flocks.seen - len(new)
        store, new = store + new[:room], new[room:]
        if new:
            for place, item in zip(*reservoir_places(seen + room, len(new), 25, draws), strict=True):
                store[place] = new[item]
    assert torch.equal(flocks.buffer[:]["agents", "observation"].squeeze(1), torch.stack(store))
