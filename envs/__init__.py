"""Environments: physics engines behind one interface, and the flocking environment for TorchRL and Gymnasium."""

from gymnasium.envs.registration import register, registry

from modgnn_rl.envs.flocking import FlockingEnv
from modgnn_rl.envs.physics import Physics, TorchPhysics

__all__ = ["FlockingEnv", "Physics", "TorchPhysics"]

if "modgnn_rl/Flocking-v0" not in registry:
    register(
        id="modgnn_rl/Flocking-v0",
        entry_point="modgnn_rl.envs.gymnasium_env:GymnasiumFlocking",
        vector_entry_point="modgnn_rl.envs.gymnasium_env:GymnasiumFlocks",
    )
