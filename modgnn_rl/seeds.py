"""Independent seeds for everything that is drawn in a run."""

from __future__ import annotations

import zlib

import numpy as np

__all__ = ["derive_seed"]


def derive_seed(seed: int, *role: str | int) -> int:
    """A seed for one role in a run, independent of those for other roles and of those of other runs.

    Args:
        seed: the seed of the run.
        role: what is drawn with it, for example ``"flocks", 32``.

    Returns:
        a seed of 32 bits.
    """
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in role]
    return int(np.random.SeedSequence([seed, *words]).generate_state(1)[0])
