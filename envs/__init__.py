"""Environments: physics engines behind one interface, and the flocking environment for TorchRL."""

from modgnn_rl.envs.flocking import FlockingEnv
from modgnn_rl.envs.physics import Physics, TorchPhysics

__all__ = ["FlockingEnv", "Physics", "TorchPhysics"]
