"""Independent seeds for everything that is drawn in a run."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator

import numpy as np
import torch

__all__ = ["derive_seed", "seeded"]


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


@contextlib.contextmanager
def seeded(seed: int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Seed torch's global generators of the CPU and of one device; they are put back at the end.

    For code of others that draws from them: initial weights, distributions.

    Args:
        seed: their seed.
        device: whose generator is seeded beside the CPU's; those of other devices are not touched.
    """
    device = torch.device(device)
    accelerators = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(accelerators, device_type="cuda" if device.type == "cpu" else device.type):
        torch.default_generator.manual_seed(seed)  # torch.manual_seed would also seed the other devices
        for accelerator in accelerators:
            with torch.get_device_module(accelerator).device(accelerator):
                torch.get_device_module(accelerator).manual_seed(seed)
        yield
