"""Derived seeds."""

from __future__ import annotations

from modgnn_rl.utils.seeds import derive_seed


def test_seeds_differ_between_roles_and_runs_and_stay_the_same():
    seeds = [derive_seed(seed, role, number) for seed in range(50) for role in ("env", "model") for number in range(5)]
    assert len(set(seeds)) == len(seeds)
    assert derive_seed(0, "env", 1) == derive_seed(0, "env", 1) == 73959161


def test_any_non_negative_seed_works():
    assert 0 <= derive_seed(2**40, "env") < 2**32
