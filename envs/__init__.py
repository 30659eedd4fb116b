"""Environments: flocks of quadcopters that follow a leader, for TorchRL, Gymnasium and PettingZoo.

Importing this package registers ``modgnn_rl/Flocking-v0`` with Gymnasium; its public names are imported on first use.
"""

import lazy_loader
from gymnasium.envs.registration import register, registry

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if "modgnn_rl/Flocking-v0" not in registry:
    register(
        id="modgnn_rl/Flocking-v0",
        entry_point="modgnn_rl.envs.flocking.adapters.gymnasium_env:GymnasiumFlocking",
        vector_entry_point="modgnn_rl.envs.flocking.adapters.gymnasium_env:GymnasiumVectorFlocking",
    )
