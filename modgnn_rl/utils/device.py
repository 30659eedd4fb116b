"""Device and threads of torch."""

from __future__ import annotations

import logging

import torch

from modgnn_rl.errors import InputError

__all__ = ["prepare_torch"]


def prepare_torch(device: str, threads: int) -> None:
    """Choose the number of threads, keep TorchRL's notices off the terminal, and make sure that the device exists.

    Raises:
        InputError: there is no such device.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if threads:
        torch.set_num_threads(threads)
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device={device} cannot be used ({reason}); device=cpu works everywhere") from error
