"""modgnn_rl: imitation learning of robot swarms with ModGNN, on TorchRL.

The names below are imported when they are first used, so that ``python -m modgnn_rl.train --help`` need not wait for
torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from modgnn_rl.deploy.agent import Agent
    from modgnn_rl.models.factory import make_model
    from modgnn_rl.nn.modgnn import ModGNN, ModGNNLayer
    from modgnn_rl.tracking.loading import load_policy

__version__ = "0.1.0"
__all__ = ["Agent", "ModGNN", "ModGNNLayer", "__version__", "load_policy", "make_model"]

_HOMES = {
    "Agent": "modgnn_rl.deploy.agent",
    "ModGNN": "modgnn_rl.nn.modgnn",
    "ModGNNLayer": "modgnn_rl.nn.modgnn",
    "load_policy": "modgnn_rl.tracking.loading",
    "make_model": "modgnn_rl.models.factory",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
