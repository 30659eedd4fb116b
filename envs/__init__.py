"""Environments: physics engines behind one interface, and the flocking environment for TorchRL and Gymnasium."""

from gymnasium.envs.registration import register, registry

from modgnn_rl.envs.flocking.env import FlockingEnv
from modgnn_rl.envs.flocking.physics.engine import Physics, TorchPhysics

__all__ = ["FlockingEnv", "Physics", "TorchPhysics"]

if "modgnn_rl/Flocking-v0" not in registry:
    register(
        id="modgnn_rl/Flocking-v0",
        entry_point="modgnn_rl.envs.flocking.adapters.gymnasium_env:GymnasiumFlocking",
        vector_entry_point="modgnn_rl.envs.flocking.adapters.gymnasium_env:GymnasiumVectorFlocking",
    )
