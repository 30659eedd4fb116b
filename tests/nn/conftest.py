"""Fixtures of the tests of graphs and layers."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from modgnn_rl.nn import aggregation, graph


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Sets the size of blocks to a few edges, none of which are stored for the backward pass."""

    def set_size(size: int) -> None:
        monkeypatch.setattr(graph, "BLOCK", {"cpu": size})
        monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", 0)

    return set_size
