"""What all tests share: one thread, and hypothesis without a clock."""

from __future__ import annotations

import os

import torch
from hypothesis import settings

# Small tensors gain nothing from threads, and thread pools of parallel runs fight for the same cores.
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"

# A busy machine is no failure; in CI the same examples are tried every time.
# `--hypothesis-profile=thorough` tries more.
settings.register_profile("default", deadline=None, max_examples=40)
settings.register_profile("ci", deadline=None, max_examples=40, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=500)
settings.load_profile("ci" if os.environ.get("CI") else "default")
