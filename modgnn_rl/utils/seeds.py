"""Independent random seeds for each part of a run."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator

import numpy as np
import torch

__all__ = ["derive_seed", "seeded"]


def derive_seed(seed: int, *role: str | int) -> int:
    """Derive the random seed of one part of a run, independent of other parts and other runs.

    Args:
        seed: the seed of the run.
        role: what it is for, for example ``"flocks", 32``.

    Returns:
        a 32-bit seed.
    """
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in role]
    return int(np.random.SeedSequence([seed, *words]).generate_state(1)[0])


@contextlib.contextmanager
def seeded(seed: int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Seed the global generators of the CPU and of one device, and restore their states at the end.

    For code that samples from the global generators: initial weights, distributions.

    Args:
        seed: seed of both generators.
        device: device whose generator is seeded besides the CPU's; those of other devices stay as they are.
    """
    device = torch.device(device)
    accelerators = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(accelerators, device_type="cuda" if device.type == "cpu" else device.type):
        torch.default_generator.manual_seed(seed)  # torch.manual_seed would also seed the other devices
        for accelerator in accelerators:
            with torch.get_device_module(accelerator).device(accelerator):
                torch.get_device_module(accelerator).manual_seed(seed)
        yield
