"""Device and threads of torch."""

from __future__ import annotations

import logging

import torch

from modgnn_rl.errors import InputError

__all__ = ["prepare_torch"]


def prepare_torch(device: str, threads: int) -> None:
    """Set the number of threads, silence TorchRL's notices, and check that the device works.

    Raises:
        InputError: the device does not exist or cannot be used.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device={device} cannot be used ({reason}); device=cpu works everywhere") from error
